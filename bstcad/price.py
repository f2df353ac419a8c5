"""What a finished design cost, where its error sits, and what limits it: from what the run knows anyway.

Everything comes from its pictures and its history but one small sheet of tubes, by which the cells of the control net
are counted: together less than a hundredth of a design.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from bstcad.analysis.bottleneck import Limit, limits
from bstcad.analysis.control_cells import ControlCells, control_cells
from bstcad.analysis.convergence import Ending, ending
from bstcad.analysis.remaining_error import remaining
from bstcad.optics.lens import Lens
from bstcad.report.record import Making
from bstcad.report.remedies import because
from bstcad.scene.machining import KEYS
from bstcad.scene.scene import Scene
from bstcad.tailoring.machinability import BOUNDED, UNBOUNDED
from bstcad.tailoring.stage2 import FEW

SIZES = "stage 3, "  # how the parts of a design begin that are for one size of the source each


def of_bounds(scene: Scene, making: Making, at_bounds: Mapping[str, float] | None) -> dict[str, Any] | None:
    """The entry `bounds` of report.json: the bounds on the back, where it is at them, and what they cost.

    By the rays that judge each stage; at_bounds: part of the back that is at each.  None: the scene asks for none.
    """
    asked = {key: value for key in KEYS if (value := getattr(scene.lens, key)) is not None}
    if not asked:
        return None
    judged = {stage.name: stage.rrmsd for stage in making.stages}
    return {
        "asked": asked,
        "at": dict(at_bounds or {}),
        "rrmsd": judged.get(BOUNDED),
        "rrmsd_freed": judged.get(UNBOUNDED),
    }


@dataclass(frozen=True)
class Price:
    """The three entries of report.json."""

    convergence: dict[str, Any] | None  # analysis.convergence.Ending; None: there is no curve
    remaining_error: dict[str, Any]  # analysis.remaining_error.Remaining, and `outside`
    limits: tuple[dict[str, Any], ...]  # analysis.bottleneck.Limit and what to change, in a sentence; the best first


def price(
    scene: Scene, making: Making, lens: Lens, picture: np.ndarray, target: np.ndarray, rrmsd: float, efficiency: float,
    blurred: float = 0.0,
) -> Price:  # fmt: skip
    """Of a design.  lens: as re-read, which throws this picture (rows, columns), of the target's sum and this RRMSD.

    blurred: RRMSD of the target blurred by the source's size; 0 for a point.
    """
    curve = ending(
        [(point.seconds, point.rrmsd) for point in making.history],
        [(stage.seconds, stage.rrmsd) for stage in making.stages],
        _whole_since(making),
    )
    screen = scene.target.screen
    where = asdict(remaining(picture, target, screen.per_mm)) | {"outside": 1 - efficiency}
    light = max(scene.of_size(0.0).channels(), key=lambda channel: channel.weight)
    found = _limits(scene, making, curve, rrmsd, control_cells(light, lens, screen, target), blurred)
    told = tuple(asdict(limit) | {"because": because(limit, scene)} for limit in found)
    return Price(None if curve is None else asdict(curve), where, told)


def _limits(
    scene: Scene, making: Making, curve: Ending | None, rrmsd: float, cells: ControlCells, blurred: float
) -> tuple[Limit, ...]:
    knobs, twins = scene.tailoring.resolved(scene.lens.back.control_points), making.twins
    if knobs.method == "integration":  # its map limits it, and no knob does
        return ()
    own = curve.rrmsd if curve is not None and knobs.method == "least-squares" else None
    singles = None
    if knobs.precision == "float32" and twins is not None:
        singles = (twins.rrmsd_float32, twins.rrmsd_float64)
    anew = knobs.method == "least-squares" and knobs.stage2_iterations < FEW
    return limits(rrmsd, curve, own, cells, _grown(making), singles, anew, blurred)


def _whole_since(making: Making) -> float:
    """Seconds since the start at which the last size of the source began; 0 for a source that is a point."""
    last = max((k for k, stage in enumerate(making.stages) if stage.name.startswith(SIZES)), default=0)
    return math.fsum(stage.seconds for stage in making.stages[:last])


def _grown(making: Making) -> Sequence[float]:
    """RRMSD after each size of the source, with its own light; none of a source that is a point."""
    found = [stage.rrmsd for stage in making.stages if stage.name.startswith(SIZES)]
    return [value for value in found if value is not None and math.isfinite(value)]
