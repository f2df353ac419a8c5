"""The record of report.json put together from a design, its proof and its diagnosis, with the remarks on them.

A remark is a sentence with its figure for each wish of the scene that a design does not fulfil, checked or not.  A lens
may be right to the last nanometre and still lose light, or be thicker than drawn, because the scene left no other way;
who reads only "passed" or "failed" should not have to search the tables for that.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.ndimage

from bstcad.analysis.light import FinestDetail, finest_detail
from bstcad.measured.form_error import MAP
from bstcad.measured.made_part import MadePart
from bstcad.optics.lens import Lens
from bstcad.report.light_figures import rrmsd
from bstcad.report.prescription import prescription
from bstcad.report.record import LEFT_OUT, Contents, LeftOut, Line, Making
from bstcad.report.units import Rows, paragraphs, percent, tables
from bstcad.scene.scene import Scene
from bstcad.verify.checks import CUT, DEFAULT_RRMSD_LIMIT, Proof
from bstcad.verify.verdict import verdict

if TYPE_CHECKING:
    from bstcad.optics.sources import Collimated, Point
    from bstcad.scene.scene import Scene
    from bstcad.scene.target import Target

DARK = 0.01  # of the picture's mean: darker is dark
UNLIT = 0.1  # of the target's irradiance: a pixel with less of it was left dark
PATCH = 5e-3  # of the lit area: less of it left dark is not worth a sentence
OUTLIERS = 0.01  # of the points of a made part: more outliers are worth a sentence


def contents_of(
    scene: Scene, lens: Lens, target: np.ndarray, proof: Proof, *, making: Making,
    circumstances: Mapping[str, Any], estimates: tuple[LeftOut, ...], diagnosis: Mapping[str, Any],
) -> Contents:  # fmt: skip
    """The contents of report.json.

    lens: as designed.  circumstances: version, machine and versions of libraries now, which those of its making
    precede.  estimates: of the effects that are left out.  diagnosis: convergence, remaining_error, limits and bounds.
    """
    known = {key: value for key, value in vars(making).items() if value is not None}
    light, dark = proof.light, proof.light.leak
    contents = Contents(
        **{**circumstances, **known},
        **diagnosis,
        name=scene.name,
        title=scene.title,
        verdict=verdict(proof.passed, ()),
        passed=proof.passed,
        rrmsd=light.rrmsd,
        rrmsd_tent=light.tent,
        rrmsd_noise=light.standard_error,
        light_on_target=light.flux["on target"],
        efficiency=light.efficiency,
        flux=light.flux,
        prescription=prescription(scene, lens, proof.shape),
        checks=proof.checks,
        effects={
            "simulated": tuple(what for what, _ in simulated(scene)),
            "left_out": tuple(LEFT_OUT[entry.kind] for entry in estimates),
        },
        seed=scene.tailoring.seed,
        leak=dark and dark.share,
        contrast=dark and dark.contrast,
        optic=scene.optic,
        quality=scene.tailoring.quality,
        rrmsd_asked=scene.accept.rrmsd,
        rays_traced=light.rays,
        shape=proof.shape,
        stability=proof.stability,
        blur=proof.blur,
        finest_detail=_finest_detail(scene, proof, estimates),
        lines=tuple(Line(line.wavelength, line.share, rrmsd(target, line.picture)) for line in proof.lines),
        estimates=estimates,
    )
    return _remarked(contents, *remarks(contents, scene, target, light.picture))


def with_part(contents: Contents, part: MadePart, place: str = "") -> Contents:
    """The contents with a made part, whose checks join the verdict; place: path of its folder from the report's."""
    measured = part.facts | {"deviation_map": [f"{place}{name}" for name in MAP]}
    passed, checks = contents.passed and part.facts["passed"], (*contents.checks, *part.checks)
    contents = replace(contents, checks=checks, passed=passed, measured=measured)
    share = part.facts["outliers"]["share"]
    if share <= OUTLIERS:
        return _remarked(contents)
    return _remarked(
        contents,
        f"{percent(share)} of the measured points are outliers and were left out: dust, glints or slips of the "
        "instrument. Clean the part and measure it again to be sure.",
    )


def _remarked(contents: Contents, *more: str) -> Contents:
    """The contents with more remarks, and the verdict that follows."""
    given_up = (*contents.given_up, *more)
    return replace(contents, given_up=given_up, verdict=verdict(contents.passed, given_up))


def _finest_detail(scene: Scene, proof: Proof, estimates: tuple[LeftOut, ...]) -> FinestDetail | None:
    """The detail that the source allows: of the scene's size, or of the size that the estimates assume of a point."""
    screen = scene.target.screen
    if proof.blur:
        of = ", ".join(f"source.{key} = {size}" for key, size in extent(scene.source))
        return finest_detail(proof.blur.pixels, proof.lens, screen, of)
    for entry in estimates:
        if entry.kind == "source size" and entry.blur_pixels is not None:
            return finest_detail(entry.blur_pixels, proof.lens, screen, of=entry.detail, assumed=entry.assumed)
    return None


def simulated(scene: Scene) -> Rows:
    """The physics that is simulated for a scene: words, and the key of the scene that asks for it."""
    return tables("simulated.txt.j2", scene=scene, extent=list(extent(scene.source)), names=LEFT_OUT)["simulated"]


def extent(source: Collimated | Point) -> Iterator[tuple[str, str]]:
    """The keys that give a source a size, each with the size in words."""
    for key in ("diameter", "width", "height", "divergence"):
        if value := getattr(source, key, None):
            yield key, f"{value:g} {'degrees' if key == 'divergence' else 'mm'}"


# --- remarks ----------------------------------------------------------------------------------------------------------


def remarks(report: Contents, scene: Scene, target: np.ndarray, irradiance: np.ndarray) -> list[str]:
    """Remarks on a report, by its target and irradiance (rows, columns), both of one sum; the most important first."""
    allowed = DEFAULT_RRMSD_LIMIT if report.rrmsd_asked is None else report.rrmsd_asked
    return paragraphs(
        "remarks.txt.j2", "remarks", report=report, scene=scene, allowed=allowed, cut=CUT, names=LEFT_OUT,
        unlit=_unlit(target, irradiance, scene.target), lifted=_lifted(target, irradiance),
    )  # fmt: skip


def bounds(found: Mapping[str, Any] | None) -> str:
    """The bounds on the back ([lens] tool_radius, max_slope, thicknesses) and their price; nothing if none is asked."""
    return "".join(paragraphs("remarks.txt.j2", "bounds", found=found))


def _unlit(target: np.ndarray, irradiance: np.ndarray, where: Target) -> dict[str, Any]:
    """The share of the lit part that gets hardly any light; least and largest x and y (mm) of its largest patch."""
    lit = target > DARK * target.mean()
    unlit = lit & (irradiance < UNLIT * target)
    share = float(unlit.sum() / lit.sum())
    if share < PATCH or target[unlit].sum() < PATCH * target.sum():  # which a rim of pixels that are lit in part is not
        return {}
    patches, count = scipy.ndimage.label(unlit, np.ones((3, 3)))
    largest = 1 + np.argmax(scipy.ndimage.sum_labels(unlit, patches, range(1, count + 1)))
    rows, columns = scipy.ndimage.find_objects(patches)[largest - 1]
    x, y = (np.linspace(*ends, pixels + 1) for ends, pixels in zip((where.x, where.y), target.shape[::-1], strict=True))
    return {"share": share, "place": (x[columns.start], x[columns.stop], y[-1 - rows.stop], y[-1 - rows.start])}


def _lifted(target: np.ndarray, irradiance: np.ndarray) -> dict[str, float]:
    """The light on the dark parts of the target, of all light, and its level, of the mean irradiance.

    A smooth face cannot part its light without a seam.
    """
    dark = target < DARK * target.mean()
    light = float((irradiance - target)[dark].sum() / target.sum())
    return {"light": light, "level": float(irradiance[dark].mean() / target.mean()) if dark.any() else 0.0}
