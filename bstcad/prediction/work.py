"""How much work a design is: amounts of it, each of which has a price in units of the calibration.

    seconds = Σ amount · price · unit

The unit is that of ray tubes, on all processors, or that of text and transforms, on one (calibration.py).  Prices are
found stage by stage, from what the stages of whole designs took.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from bstcad.prediction.calibration import Units
from bstcad.scene.quality import COARSEST_GRID, Tailoring
from bstcad.scene.scene import Scene
from bstcad.tailoring.run import EVALUATED
from bstcad.tailoring.slope_map import SUBCELLS
from bstcad.tailoring.stage1 import aimed
from bstcad.tailoring.stage2 import sheets

TUBES, NET, PIXELS, CELLS, ITERATIONS = 1024, 513, 512, 256, 40  # a side, or in all: amounts are in multiples of these
JUDGED, TRACED = 2.0, 6.0e6  # judging PIXELS² pixels between stages is as long as 2 x TUBES² tubes; tubes a second
TYPICAL = 0.04  # RRMSD of a design of which none is known
RAYS, ROUGHLY = 3.5, 1.0  # of a proof, and of a draft's, in units of a second of rays


@dataclass(frozen=True)
class Kind:
    """A kind of work."""

    stage: str  # in which it is done
    unit: str  # "tubes" or "serial"


KINDS = {
    "start": Kind("start", "serial"),  # imports, and the end of the process
    "pixels": Kind("start", "serial"),
    "rounds": Kind("stage 1", "serial"),
    "transport": Kind("stage 1", "serial"),
    "slope fit": Kind("stage 1", "serial"),  # control points of the last two rounds
    "front": Kind("stage 1", "serial"),  # sought
    "other way": Kind("stage 1", "serial"),  # rays of its last fit, if it is tried
    "rays found": Kind("stage 1", "tubes"),  # of a point, through given places of the back, by Broyden's method
    "first judging": Kind("stage 1", "tubes"),
    "evaluations": Kind("stage 2", "tubes"),
    "roots": Kind("stage 2", "tubes"),  # rays of a point, whose hits are found by Newton's method
    "launched": Kind("stage 2", "tubes"),  # tubes of a point, at the start of each round
    "crossings": Kind("stage 2", "tubes"),  # of tubes and pixel borders
    "variable": Kind("stage 2", "tubes"),  # control points, in each evaluation
    "writing": Kind("write", "serial"),
    "net written": Kind("write", "serial"),
    "rays": Kind("verify", "tubes"),
    "tubes": Kind("verify", "tubes"),
    "net read": Kind("verify", "serial"),
    "report": Kind("report", "serial"),
    "pictures": Kind("report", "serial"),
    "steps of Adam": Kind("Adam", "tubes"),  # of the paper's procedure, of which no design is predicted
}


def amounts(scene: Scene, rrmsd: float = TYPICAL, other_way: bool = False) -> dict[str, float]:
    """How much of each of KINDS a design has to do that comes to this RRMSD; does its stage 1 try the other way?"""
    m, (columns, rows) = scene.lens.back.control_points, scene.target.columns_rows
    knobs, net, pixels = scene.tailoring.resolved(m), (m / NET) ** 2, columns * rows / PIXELS**2
    spread = len(scene.channels()) ** 0.5
    point = scene.source.kind == "point"
    judged = JUDGED * pixels ** (2 / 3)  # rays as run.BETWEEN has them
    adam, slopes = knobs.method == "adam", knobs.method == "least-squares"
    rounds = [] if adam else [(tubes / TUBES, evaluations) for tubes, evaluations in sheets(knobs)]
    traced = spread * sum(tubes**2 * count for tubes, count in rounds)
    evaluations = traced + len(rounds) * judged * EVALUATED / TRACED  # each round is judged at its end
    steps = knobs.stage1_iterations * len(knobs.levels) + knobs.stage2_iterations
    return {
        "start": 1.0,
        "pixels": pixels,
        "rounds": knobs.rounds if slopes else 0.0,
        "transport": _transport(knobs),
        "slope fit": sum((level / NET) ** 2 for level in knobs.levels[-2:]) if slopes else 0.0,
        "front": 1.0 if scene.lens.front.free else 0.0,
        "other way": (aimed(m, knobs.rays) / TUBES) ** 2 if other_way else 0.0,
        "rays found": _rays_found(knobs) if point else 0.0,
        "first judging": judged,
        "evaluations": evaluations,
        "roots": traced if point else 0.0,
        "launched": spread * sum(tubes**2 for tubes, _ in rounds) if point else 0.0,
        "crossings": spread * sum(tubes * count for tubes, count in rounds) * math.sqrt(pixels),
        "variable": net * sum(count for _, count in rounds),
        "writing": 1.0,
        "net written": net,
        "rays": (ROUGHLY if knobs.quality == "draft" else RAYS) * (2.0 if point else 1.0),
        "tubes": ((2 * m + 5) / TUBES) ** 2 if scene.source.extent is None else 0.0,
        "net read": net,
        "report": 1.0,
        "pictures": pixels,
        "steps of Adam": steps * spread * (knobs.rays / TUBES) ** 2 if adam else 0.0,
    }


def seconds(work: Mapping[str, float], prices: Mapping[str, float], unit: Units) -> float:
    """What the work takes where the units take so long."""
    return sum(amount * prices.get(kind, 0.0) * getattr(unit, KINDS[kind].unit) for kind, amount in work.items())


def memory_amounts(scene: Scene) -> dict[str, float]:
    """What takes memory, in the amounts whose prices are GB."""
    m, (columns, rows) = scene.lens.back.control_points, scene.target.columns_rows
    rays = scene.tailoring.resolved(m).rays
    corners = (rays / TUBES) ** 2
    return {
        "libraries": 1.0,
        "corners": corners,
        "roots": corners if scene.source.kind == "point" else 0.0,
        "net": (m / NET) ** 2,
        "pixels": columns * rows / PIXELS**2,
    }


def memory_gb(scene: Scene, prices: Mapping[str, float]) -> float:
    """The most that both processes of a design hold, as a sum."""
    return sum(amount * prices[kind] for kind, amount in memory_amounts(scene).items())


def _transport(knobs: Tailoring) -> float:
    """Cells and iterations of all rounds."""
    return sum((grid / CELLS) ** 2 for grid in _grids(knobs)) * knobs.transport_iterations / ITERATIONS


def _rays_found(knobs: Tailoring) -> float:
    """Those of the cells of all rounds, and those of the last fit of slopes."""
    fitted = min(2 * knobs.levels[-1], knobs.rays)
    return sum((SUBCELLS * grid / TUBES) ** 2 for grid in _grids(knobs)) + (fitted / TUBES) ** 2


def _grids(knobs: Tailoring) -> list[int]:
    """Cells a side of the transport in each round; Wang et al.'s is one map."""
    if knobs.method != "least-squares":
        return [knobs.transport_grid]
    return [max(COARSEST_GRID, knobs.transport_grid // 2 ** min(left, 2)) for left in range(knobs.rounds)]
