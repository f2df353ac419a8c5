"""A diagnosis of a finished design: the end of its convergence, where its error sits, and what limits it.

It takes the pictures and the history of the run, and one small sheet of tubes by which the cells of the control net are
counted: together less than a hundredth of a design.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from bstcad.analysis.cost import ControlCells, Ending, Limit, control_cells, ending, limits, remaining
from bstcad.optics.lens import Lens
from bstcad.report.record import Making
from bstcad.report.units import about, number, two_digits
from bstcad.scene.scene import Scene
from bstcad.tailoring.machinability import BOUNDED, UNBOUNDED
from bstcad.tailoring.stage2 import FEW

SIZES = "stage 3, "  # how the stages of a design begin that are for one size of the source each
RESTS = 0.01  # power of time by which a curve that falls no faster has come to rest
NOTHING = 0.05  # of the RRMSD: these estimates do not tell less from none


def of_bounds(scene: Scene, making: Making, at_bounds: Mapping[str, float] | None) -> dict[str, Any] | None:
    """The entry `bounds` of report.json: the bounds on the back, where it is at them, and what they cost.

    By the rays that judge each stage; at_bounds: share of the back that is at each.  None: the scene has no bounds.
    """
    asked = {key: getattr(scene.lens, key) for key in scene.lens.bounded_by}
    if not asked:
        return None
    judged = {stage.name: stage.rrmsd for stage in making.stages}
    rrmsd = {"rrmsd": judged.get(BOUNDED), "rrmsd_freed": judged.get(UNBOUNDED)}
    return {"asked": asked, "at": dict(at_bounds or {}), **rrmsd}


@dataclass(frozen=True)
class Diagnosis:
    """Three entries of report.json."""

    convergence: dict[str, Any] | None  # analysis.cost.Ending; None: there is no curve
    remaining_error: dict[str, Any]  # analysis.cost.Remaining, and `outside`
    limits: tuple[dict[str, Any], ...]  # analysis.cost.Limit, and the remedy in a sentence; the largest gain first


def diagnosis(
    scene: Scene, making: Making, lens: Lens, *, picture: np.ndarray, target: np.ndarray, rrmsd: float,
    efficiency: float, blurred: float = 0.0,
) -> Diagnosis:  # fmt: skip
    """Of a design.  lens: as re-read, which throws this picture (rows, columns), of the target's sum and this RRMSD.

    blurred: RRMSD of the target blurred by the source's size; 0 for a point.
    """
    sizes = [k for k, stage in enumerate(making.stages) if stage.name.startswith(SIZES)]
    curve = ending(
        [(point.seconds, point.rrmsd) for point in making.history],
        [(stage.seconds, stage.rrmsd) for stage in making.stages],
        since=math.fsum(stage.seconds for stage in making.stages[: max(sizes, default=0)]),  # of the whole source
    )
    screen = scene.target.screen
    where = asdict(remaining(picture, target, screen.per_mm)) | {"outside": 1 - efficiency}
    light = max(scene.with_source_scaled(0.0).channels(), key=lambda channel: channel.weight)
    cells = control_cells(light, lens, screen, target)
    found = _limits(scene, making, curve, rrmsd=rrmsd, cells=cells, blurred=blurred)
    entries = tuple(asdict(limit) | {"because": because(limit, scene)} for limit in found)
    return Diagnosis(None if curve is None else asdict(curve), where, entries)


def _limits(
    scene: Scene, making: Making, curve: Ending | None, *, rrmsd: float, cells: ControlCells, blurred: float
) -> tuple[Limit, ...]:
    knobs, twins = scene.tailoring.resolved(scene.lens.back.control_points), making.twins
    if knobs.method == "integration":  # its map limits it, and no knob does
        return ()
    ours, single = knobs.method == "least-squares", knobs.precision == "float32" and twins is not None
    grown = [stage.rrmsd for stage in making.stages if stage.name.startswith(SIZES)]
    return limits(
        rrmsd,
        cells,
        curve=curve,
        own=curve.rrmsd if curve is not None and ours else None,
        grown=[value for value in grown if value is not None and math.isfinite(value)],
        singles=(twins.rrmsd_float32, twins.rrmsd_float64) if single else None,
        anew=ours and knobs.stage2_iterations < FEW,
        blurred=blurred,
    )


def because(limit: Limit, scene: Scene) -> str:
    """Why it limits, and behind the last semicolon one step of it in the scene, and the RRMSD after that."""
    why, step = REMEDIES[limit.by](limit.figures, scene)
    if "blurred" in limit.figures:
        why += f"; the source's size alone blurs the target to an RRMSD of {number(limit.figures['blurred'])}"
    left = two_digits(limit.rrmsd)
    share = f"about {number(left)} times the RRMSD" if left < 1 else "the RRMSD as it is"
    return f"{why}; {step} would leave {share if left >= NOTHING else 'hardly any of the RRMSD'}"


Figures = Mapping[str, float]


def _evaluations(found: Figures, scene: Scene) -> tuple[str, str]:
    iterations = scene.tailoring.resolved(scene.lens.back.control_points).stage2_iterations
    falls = f"the curve still falls, as time to the power of {about(-found['power'])}"
    rests = "the curve has come to rest"
    return falls if found["power"] >= RESTS else rests, f"tailoring.stage2_iterations = {2 * iterations}"


def _control_points(found: Figures, scene: Scene) -> tuple[str, str]:
    few, half = (about(found[name]) for name in ("scarce", "median"))
    why = (
        f"a tenth of the lit pixels have less than {few} control cells each, half of them less than {half}; what of "
        f"the target is finer than the cells can make is an RRMSD of {number(found['floor'])}, and with twice as many "
        f"a side of {number(found['finer'])}"
    )
    return why, f"lens.back.control_points = {2 * scene.lens.back.control_points - 1}"


def _tubes(found: Figures, scene: Scene) -> tuple[str, str]:
    knobs = scene.tailoring.resolved(scene.lens.back.control_points)
    own, rays = number(found["own"]), number(found["finer"])
    if scene.source.extent is None:
        why = f"the tubes that tailored it see an RRMSD of {own}, independent rays {rays}"
        return why, f"tailoring.rays = {math.ceil(2**0.5 * knobs.rays)}"
    why = f"the tubes and source points that tailored it see an RRMSD of {own}, rays from other points {rays}"
    return why, f"tailoring.source_points = {2 * knobs.source_points}"


def _source_size(found: Figures, scene: Scene) -> tuple[str, str]:
    third, most, whole = (number(found[name]) for name in ("third", "two thirds", "whole"))
    why = f"with a third, two thirds and all of the source's size there was an RRMSD of {third}, {most} and {whole}"
    return why, "a source of half the size, or the target at half the distance,"


def _precision(found: Figures, scene: Scene) -> tuple[str, str]:
    single, double = (number(found[name]) for name in ("float32", "float64"))
    why = f"float32 comes to an RRMSD of {single} where float64 comes to {double}"
    return why, 'tailoring.precision = "float64"'


REMEDIES = {  # by Limit.by: (why it limits, one step more)
    "evaluations": _evaluations,
    "control points": _control_points,
    "tubes": _tubes,
    "source size": _source_size,
    "precision": _precision,
}
