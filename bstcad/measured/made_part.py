"""Judgement of a made part: from a cloud of its back face to its form error, its predicted light, and checks."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import torch

from bstcad.analysis.shape import least_squares
from bstcad.measured import alignment as aligning
from bstcad.measured.alignment import Alignment, Face, Pose
from bstcad.measured.cloud import Cloud
from bstcad.measured.deviation import Deviation, deviation, minimum_zone
from bstcad.measured.form_error import Form, fitted
from bstcad.optics.lens import Lens
from bstcad.optics.measure import Effort, Light, measure
from bstcad.verify.checks import DEFAULT_RRMSD_LIMIT, UNASKED, Nominal
from bstcad.verify.verdict import Check

NEAR = 1e-4  # of the half width: distance of a start that ends the search
FARTHEST = 3e-3  # of the half width, RMS after alignment: a part beyond is of another design
RELIEF = 0.5  # of the design's fine relief: a part with less is of another design
COARSE = 4  # degree of the polynomial that is no fine relief: parts of one optical power share it
NO_RELIEF = 3e-5  # of the half width, RMS: a face with less fine relief is not recognised by it
SCALE = 2e-4  # off 1: size of thermal expansion
SURE = 3.0  # times its uncertainty, for a scale to be off
COVERED = 0.8  # of the face: elsewhere the form is a guess
IN_A_CELL = 20  # mean points in a cell of the grid that tells the measured share of the face
SAMPLED = 20_000  # points for the fine relief
OUTLIERS = 0.1  # of the points near the face: with more, face and outliers cannot be told apart


@dataclass(frozen=True, eq=False)
class MadePart:
    """Result of a cloud of a made part."""

    checks: tuple[Check, ...]
    facts: dict[str, Any]  # entry `measured` of report.json
    deviation: Deviation
    irradiance: np.ndarray = field(repr=False)  # (rows, columns) predicted, row 0 = y max, with the target's sum
    outliers: np.ndarray = field(repr=False)  # (n, 3) mm on the design, left out of the fit


def judge(cloud: Cloud, lens: Lens, nominal: Nominal, effort: Effort | None = None) -> MadePart:
    """The made part of a lens by the cloud of its back face; ValueError if the cloud is not of that face.

    lens: as re-read from the STEP file.  effort: of a measurement of its light.
    """
    lens = replace(lens, outline=lens.apertures[1])  # where a mount cuts the rim, the part has no face beyond
    face = Face.of(lens)
    try:
        placed, axes = _aligned(face, cloud.points)
    except ValueError as error:
        raise ValueError(f"{cloud.path}: {error}") from None
    off = face.height(placed.points)
    form = fitted(face, placed)
    found = deviation(lens, placed, form)
    effort = replace(nominal.effort(effort), witness=False)
    light, high = _light(lens, form, nominal, effort)
    scale, uncertainty = aligning.scale(face, placed)
    checks = (
        Check.true("made part: the cloud is in mm", cloud.unit == "mm", f"its extent is the lens's in {cloud.unit}"),
        Check.true("made part: the axes of the cloud are the design's", not axes, axes),
        *_of_this_lens(face, placed, off),
        Check.at_least("made part: share of the face that was measured", _covered(lens, placed.points), COVERED),
        Check.at_most(
            "made part: outliers among the points of the face, as a share", placed.outlier_share, OUTLIERS,
            where="clean the part and measure it again",
        ),
        Check.at_most(
            "made part: scale of the cloud, off 1", abs(scale - 1), max(SCALE, SURE * uncertainty),
            where=f"it is {scale:.5f} times the design",
        ),
        Check.at_most(
            "made part: decentre in the frame of the cloud", math.hypot(*placed.pose.shift[:2]),
            nominal.accept.decentre, "mm", where=_shift(placed.pose),
        ),
        _rrmsd(light, nominal),
        Check.at_most("made part: RRMSD, were all that the points leave open against it", high, None),
    )  # fmt: skip
    facts = _facts(face, placed, found, cloud, scale=scale, light=light, high=high, checks=checks)
    return MadePart(checks, facts, found, irradiance=light.picture, outliers=placed.outliers)


def _aligned(face: Face, points: np.ndarray) -> tuple[Alignment, str]:
    """(the alignment, the exchange of axes in words, "" if the cloud fits as it is)."""
    pose, kept = aligning.first_pose(face, points, NEAR * face.reach)
    if kept > NEAR * face.reach and (exchange := aligning.exchanged_axes(face, points, kept)):
        matrix, words = exchange
        turned = points @ matrix.T
        placed = aligning.aligned(face, turned, aligning.first_pose(face, turned, NEAR * face.reach)[0])
        if _fits(face, placed):
            return placed, f"{words}{': the face is flipped' if matrix[2, 2] < 0 else ''}"
    return aligning.aligned(face, points, pose), ""


def _fits(face: Face, placed: Alignment) -> bool:
    return all(check.passed for check in _of_this_lens(face, placed, face.height(placed.points)))


def _of_this_lens(face: Face, placed: Alignment, off: np.ndarray) -> tuple[Check, Check]:
    """Is it a part of this design, by its distance from it and by the relief that makes its picture?"""
    share, judged = _relief(face, placed.points, off)
    other = "the cloud is of another lens or of another face"
    limit = FARTHEST * face.reach
    return (
        Check.at_most("made part: distance from the design after alignment, RMS", placed.rms, limit, "mm", where=other),
        Check.at_least(
            "made part: fine relief of the face, as a part of the design's", share, RELIEF if judged else None,
            where=other,
        ),
    )  # fmt: skip


def _covered(lens: Lens, points: np.ndarray) -> float:
    """The share of equal cells over the outline that hold points."""
    cells = int(np.clip(np.sqrt(len(points) / IN_A_CELL), 4, 64))
    edges = [np.linspace(-a, a, cells + 1) for a in lens.outline.half_extent]
    held = np.histogram2d(points[:, 0], points[:, 1], bins=edges)[0] > 0
    middles = (torch.from_numpy((edge[:-1] + edge[1:]) / 2) for edge in edges)
    inside = lens.outline.contains(*torch.meshgrid(*middles, indexing="ij")).numpy()
    return float(held[inside].mean())


def _relief(face: Face, points: np.ndarray, off: np.ndarray) -> tuple[float, bool]:
    """(share of the design's fine relief in the made face, by regression; does the design have any?)."""
    chosen = np.random.default_rng(0).permutation(len(points))[:SAMPLED]
    x, y = (points[chosen, :2] / face.reach).T
    columns = np.stack([x**i * y**j for i in range(COARSE + 1) for j in range(COARSE + 1 - i)], axis=1)
    sag = points[chosen, 2] - face.height(points[chosen])
    fine, change = (part - columns @ least_squares(columns, part) for part in (sag - sag.mean(), off[chosen]))
    if aligning.root_mean_square(fine) <= NO_RELIEF * face.reach:
        return 1.0, False
    return 1 + float(fine @ change / (fine @ fine)), True


def _light(lens: Lens, form: Form, nominal: Nominal, effort: Effort) -> tuple[Light, float]:
    """(light of the lens with the form error, RRMSD with the remaining uncertainty added, mean of both signs)."""
    draw = np.random.default_rng(nominal.seed).normal(size=(form.rest.m, form.rest.m))

    def of(back) -> Light:
        how = {"effort": effort, "ghost": nominal.ghost, "draw": nominal.draw}
        return measure(replace(lens, back=back), nominal.channels, nominal.screen, nominal.target, **how)

    light = of(form.on(lens.back))
    ways = [of(form.on(lens.back, draw, sign)).rrmsd for sign in (1.0, -1.0)]
    return light, max(light.rrmsd, math.sqrt((ways[0] ** 2 + ways[1] ** 2) / 2))


def _rrmsd(light: Light, nominal: Nominal) -> Check:
    asked = nominal.accept.rrmsd
    name = "made part: RRMSD predicted" + (UNASKED if asked is None else "")
    return Check.at_most(name, light.rrmsd, DEFAULT_RRMSD_LIMIT if asked is None else asked)


def _shift(pose: Pose) -> str:
    return "x {:+.4g} mm, y {:+.4g} mm".format(*pose.shift[:2])


def _facts(
    face: Face, placed: Alignment, found: Deviation, cloud: Cloud, *, scale: float, light: Light, high: float,
    checks: tuple[Check, ...],
) -> dict[str, Any]:  # fmt: skip
    """The entries of `measured` in report.json; lengths in mm, angles in degrees, slopes in rad."""
    zone = minimum_zone(face, placed)
    figures = {key: value for key, value in asdict(found).items() if key not in ("x", "y", "form", "bands", "worst")}
    apart = face.distance(placed.outliers)[0]
    return {
        "cloud": cloud.path.name,
        "sha256": cloud.sha256,
        "points": len(placed.points),
        "left_out": {"outside the outline": placed.outside, "off the face": placed.off_face},
        "outliers": {
            "points": len(apart),
            "share": placed.outlier_share,
            "above": int((apart > 0).sum()),
            "farthest": float(np.abs(apart).max(initial=0.0)),
        },
        "unit": cloud.unit,
        "alignment": _removed(placed.pose) | {"undetermined": list(placed.undetermined)},
        "minimum_zone": {"width": zone.width, **_removed(zone.pose)},
        "scale": scale,
        **figures,
        "worst_at": list(found.worst),
        "bands": [asdict(band) for band in found.bands],
        "rrmsd_predicted": light.rrmsd if math.isfinite(light.rrmsd) else None,
        "rrmsd_high": high if math.isfinite(high) else None,
        "passed": all(check.passed for check in checks),
    }


def _removed(pose: Pose) -> dict[str, float]:
    """Pose of the part in its cloud."""
    shifts = dict(zip(("dx", "dy", "dz"), map(float, pose.shift), strict=True))
    return shifts | dict(zip(("rotation_x", "rotation_y", "rotation_z"), map(float, pose.angles), strict=True))
