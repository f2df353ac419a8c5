"""Rounds of cutting and measuring: the folders compensated/round-1, round-2, … of a design, each with what to cut next.

A round's folder has the solid with the corrected back (lens.step, lens.stl, part.step), its net (design.npz), the maps
of the round (correction.csv, correction.png) and its figures (compensation.json), from which the next round goes on.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bstcad.designs import folder as folders
from bstcad.designs.designed_lens import DesignedLens
from bstcad.figures.shop_figures import correction_figure
from bstcad.manufacture.measured import compensation
from bstcad.manufacture.measured.cloud import Cloud
from bstcad.manufacture.measured.cloud import load as load_cloud
from bstcad.manufacture.measured.compensation import CompensationRound, CompensationSettings, Statistics
from bstcad.manufacture.shop import by_light
from bstcad.manufacture.shop.production import FIGURES, ROUND_REMEDY, ROUNDS, read_round, write_production_page
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.trace.measure import FULL, Effort
from bstcad.report.units import quantity
from bstcad.runs import files
from bstcad.runs.files import SceneError
from bstcad.scene.schema import MAX_CONTROL_POINTS

FILTER = "Gaussian, ISO 16610-61"
RATING_ACCURACY = 0.05  # relative error of the RRMSDs from which the cutoff is chosen
Progress = Callable[[str, int, int, str], None]


@dataclass(frozen=True)
class Compensated:
    """A round as it was written."""

    folder: Path
    figures: dict[str, Any]  # contents of compensation.json; lengths in mm

    @property
    def sentences(self) -> str:
        """Summary of the round, one fact a line."""
        found, light = self.figures, self.figures["rrmsd"]
        sizes = {key: found[key] for key in ("deviation", "correction", "expected_deviation")}
        pv, rms = ({key: quantity(size[f"{kind}_mm"], "mm") for key, size in sizes.items()} for kind in ("pv", "rms"))
        lines = [
            f"Round {found['round']}, from {found['parts']} measured part{'s' * (found['parts'] > 1)}",
            f"Measured deviation            PV {pv['deviation']}, RMS {rms['deviation']} "
            f"(standard error {quantity(found['standard_error_mm'], 'mm')})",
            f"Correction of the back        PV {pv['correction']}, RMS {rms['correction']}",
            f"Deviation expected to remain  PV {pv['expected_deviation']}, RMS {rms['expected_deviation']}, "
            "if the errors repeat",
            f"RRMSD                         {light['design']:.3g} designed, {light['measured']:.3g} with the measured "
            f"deviation, {light['expected']:.3g} expected",
        ]
        if found["by"] == "light":
            volumes = f"{found['volume_mm3']:.3g} mm³ instead of {found['volume_by_form_mm3']:.3g} mm³ by form"
            stays = {key: quantity(found["may_stay"][f"{key}_mm"], "mm") for key in ("pv", "rms")}
            lines.append(
                f"Form error that may stay      PV {stays['pv']}, RMS {stays['rms']}; the correction has {volumes}"
            )
            lines.append(f"RRMSD                         {light['expected_by_form']:.3g} expected by form")
        return "\n".join(lines)


def compensate(
    made: DesignedLens,
    folder: Path,
    clouds: Sequence[Path],
    settings: CompensationSettings,
    progress: Progress,
    effort: Effort = FULL,
) -> Compensated:
    """Write the next round of a design; ValueError, in one sentence, if it would diverge or a cloud cannot serve.

    folder: folder of the design.  clouds: files of measured points of the parts that were cut last.  effort: upper
    limit of the effort of measuring the light.
    """
    lens = made.lens
    cut, before, used = _last(folder, lens)
    progress("compensate", 0, 2, "form error")
    read = [load_cloud(path, lens.apertures[1]) for path in clouds]
    if again := next((cloud for cloud in read if cloud.sha256 in used), None):
        raise ValueError(f"{again.path}: an earlier round has used this cloud; measure the parts that were cut last")
    goal, cheap = made.goals[0], replace(made.effort(effort), accuracy=RATING_ACCURACY, witness=False)
    found = compensation.next_round(
        lens, cut, read, settings, before=before, decentre=made.scene.accept.decentre,
        rate=lambda back: made.light(lens.with_back(back), goal, cheap).rrmsd,
        staying=lambda deviation, inside: by_light.staying(
            made, deviation, inside, made.light(lens, goal, cheap).rrmsd
        ),
    )  # fmt: skip
    progress("compensate", 1, 2, "light and files")
    figures = _figures(made, found, read, effort)
    place = folder / ROUNDS / f"round-{found.number}"
    following = replace(made, lens=lens.with_back(found.net))
    with folders.replacing(place) as building:
        write_mesh = folders.write_geometry(following, building)
        write_mesh()
        folders.write_design(following, (), building)
        x, y, change, deviation, left = compensation.maps(lens, [found.correction, found.found, found.left])
        rows = np.column_stack([part.ravel() for part in (*np.meshgrid(x, y), change, deviation, left)])
        lines = "\n".join(map(",".join, (map("{:.9g}".format, row) for row in rows[~np.isnan(rows).any(1)])))
        heading = "x [mm],y [mm],correction [mm],deviation [mm],left [mm]"
        (building / "correction.csv").write_text(f"{heading}\n{lines}\n", encoding="utf-8")
        (building / "correction.png").write_bytes(correction_figure(x, y, [deviation, change, left]))
        (building / FIGURES).write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    write_production_page(folder)
    progress("compensate", 2, 2, "")
    return Compensated(place, figures)


def _last(folder: Path, lens: Lens) -> tuple[BSplineSurface, list[Statistics], set[str]]:
    """Return (net that was cut last, deviations of the earlier rounds, hashes of their clouds)."""
    before, used, cut, number = [], set(), lens.back_net, 1
    while (place := folder / ROUNDS / f"round-{number}").is_dir():
        try:
            figures = read_round(place)
        except ValueError as error:
            raise SceneError(error) from None
        before.append(Statistics(figures.deviation.pv_mm, figures.deviation.rms_mm))
        used |= {each.sha256 for each in figures.clouds}
        try:
            net = files.net(place / folders.DESIGN, MAX_CONTROL_POINTS)
        except ValueError as error:
            raise SceneError(f"{place / folders.DESIGN}: cannot be read ({error}); {ROUND_REMEDY}") from None
        if net.shape[:2] != cut.shape:
            raise SceneError(f"{place}: is of another design; remove the folder {folder / ROUNDS}")
        cut = BSplineSurface.from_control_points(net, lens.back_net.z)
        number += 1
    return cut, before, used


def _figures(made: DesignedLens, found: CompensationRound, clouds: Sequence[Cloud], effort: Effort) -> dict[str, Any]:
    """Return the contents of compensation.json."""
    lens, goal = made.lens, made.goals[0]
    back, cheap = lens.back_net, replace(made.effort(effort), witness=False)
    states = {"design": torch.zeros(back.shape), "measured": found.found.heights, "expected": found.left.heights}
    if found.may_stay is not None:
        states["expected_by_form"] = found.left_by_form.heights
    light = {
        name: made.light(lens.with_back(replace(back, heights=back.heights + change)), goal, cheap).rrmsd
        for name, change in states.items()
    }
    sizes = {"deviation": found.deviation, "correction": found.corrected, "expected_deviation": found.expected}
    return {
        "round": found.number,
        "parts": found.parts,
        "clouds": [{"file": each.path.name, "sha256": each.sha256, "points": len(each.points)} for each in clouds],
        "gain": found.gain,
        "filter": FILTER,
        "cutoff_mm": found.cutoff,
        **{name: {f"{key}_mm": value for key, value in asdict(size).items()} for name, size in sizes.items()},
        "by": "form" if found.may_stay is None else "light",
        "volume_mm3": found.volume,
        "volume_by_form_mm3": found.volume_by_form,
        "may_stay": None if found.may_stay is None else {f"{k}_mm": v for k, v in asdict(found.may_stay).items()},
        "standard_error_mm": found.standard_error,
        "noise_mm": found.noise,
        "rrmsd": light,
    }
