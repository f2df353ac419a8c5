"""The work of a design: amounts of it, each with a price in units of two calibrations.

    seconds = Σ amount · price · unit

One unit is the merit and gradient of 1024 x 1024 ray tubes through a fixed small lens, on all processors, as in most of
a design; the other is text and transforms on one processor, as in the rest.  Seconds of two machines compare when each
is divided by what the units take there, with one version of bstcad.  Prices were fitted stage by stage to the stages of
whole designs (tests/benchmarks/prediction_fit.py).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.channels import Channel
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.sources import Collimated
from bstcad.optics.surfaces import Plane
from bstcad.scene.quality import COARSEST_GRID, Tailoring
from bstcad.scene.scene import Scene
from bstcad.tailoring.merit import TubeMerit
from bstcad.tailoring.run import EVALUATED
from bstcad.tailoring.slope_map import SUBCELLS
from bstcad.tailoring.stage1 import aimed
from bstcad.tailoring.stage2 import Problem, sheets

TUBES, NET, PIXELS, CELLS, ITERATIONS = 1024, 513, 512, 256, 40  # a side, or in all: amounts are in multiples of these

# --- the units --------------------------------------------------------------------------------------------------------

KERNEL_NET, WIDTH, THICKNESS, INDEX = 257, 20.0, 5.0, 1.49  # control points a side; mm
SCREEN = 200.0  # mm from the front
WAVE, PERIODS = 0.003, 3  # mm; over the width
REPEATS = 3  # of an evaluation, at least
LONG, PER_TURN = 2.5, 4  # seconds of a calibration; works of one processor beside each evaluation
NUMBERS, TRANSFORM = 40_000, 512  # of the work of one processor: numbers written and read; a side of a transform


@dataclass(frozen=True)
class Units:
    """Seconds that each unit takes."""

    tubes: float  # an evaluation, on all processors
    serial: float  # text and transforms, on one

    def times(self, factor: float) -> Units:
        """Of a machine that takes so many times as long."""
        return Units(factor * self.tubes, factor * self.serial)


def units() -> Units:
    """The units on this machine now, in three seconds or so.

    Processors that others use too change their pace by two within seconds, and a design takes longer: the mean pace
    counts.  Both units are done in turn and averaged without the tenths that took least and most.
    """
    from scipy.stats import trim_mean  # a third of a second to load, which a design need not pay

    kernel, tubes, serial = Kernel(), [], []
    began = time.perf_counter()
    while time.perf_counter() - began < LONG or len(tubes) < REPEATS:
        tubes.append(_seconds(kernel.once))
        serial.extend(_seconds(serial_work) for _ in range(PER_TURN))
    return Units(*(float(trim_mean(found, 0.1)) for found in (tubes, serial)))


def _seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def serial_work() -> float:
    """Numbers to text and back, as in a STEP file, and a cosine transform, as in a fit of slopes."""
    from scipy.fft import dctn

    written = ",".join(f"{k / 7:.12g}" for k in range(NUMBERS))
    read = np.array([float(word) for word in written.split(",")])
    return float(dctn(np.resize(read, (TRANSFORM, TRANSFORM)), workers=1)[0, 0])


class Kernel:
    """The evaluation of ray tubes, set up once a process."""

    def __init__(self, tubes: int = TUBES) -> None:
        u = torch.linspace(-math.pi * PERIODS, math.pi * PERIODS, KERNEL_NET, dtype=torch.float64)
        outline, span = Rectangle(WIDTH, WIDTH), (-WIDTH / 2, WIDTH / 2)
        back = BSplineSurface(THICKNESS, WAVE * u.cos()[:, None] * u.cos(), span, span)
        lens = Lens(Plane(0.0), back, outline, INDEX)
        target = torch.full((PIXELS, PIXELS), 1.0, dtype=torch.float64)
        channel = Channel(Collimated(outline), INDEX)
        screen = Screen(SCREEN, span, span, PIXELS)
        self.problem = Problem(lens, TubeMerit.of((channel,), lens, tubes, screen, target=target, overshoot=0.03))
        self.heights = back.heights
        self.once()  # compiles and allocates

    def seconds(self) -> float:
        """Of an evaluation now: the least of three, since all disturbances make it longer."""
        return min(_seconds(self.once) for _ in range(REPEATS))

    def once(self) -> None:
        """Evaluate."""
        self.problem([self.heights])


# --- the amounts ------------------------------------------------------------------------------------------------------

JUDGED, TRACED = 2.0, 6.0e6  # judging PIXELS² pixels between stages takes as long as 2 x TUBES² tubes; tubes a second
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
    """The amounts of KINDS in a design that comes to this RRMSD; other_way: does its stage 1 try the other way?"""
    m, (columns, rows) = scene.lens.back.control_points, scene.target.columns_rows
    knobs, net, pixels = scene.tailoring.resolved(m), (m / NET) ** 2, columns * rows / PIXELS**2
    spread = len(scene.channels()) ** 0.5
    point = scene.source.kind == "point"
    judged = JUDGED * pixels ** (2 / 3)  # rays as run.BETWEEN has them
    adam, slopes = knobs.method == "adam", knobs.method == "least-squares"
    rounds = [] if adam else [(tubes / TUBES, evaluations) for tubes, evaluations in sheets(knobs)]
    traced = spread * sum(tubes**2 * count for tubes, count in rounds)
    steps = knobs.stage1_iterations * len(knobs.levels) + knobs.stage2_iterations
    grids = _grids(knobs)
    fitted = min(2 * knobs.levels[-1], knobs.rays)
    found = sum((SUBCELLS * grid / TUBES) ** 2 for grid in grids) + (fitted / TUBES) ** 2
    return {
        "start": 1.0,
        "pixels": pixels,
        "rounds": knobs.rounds if slopes else 0.0,
        "transport": sum((grid / CELLS) ** 2 for grid in grids) * knobs.transport_iterations / ITERATIONS,
        "slope fit": sum((level / NET) ** 2 for level in knobs.levels[-2:]) if slopes else 0.0,
        "front": 1.0 if scene.lens.front.free else 0.0,
        "other way": (aimed(m, knobs.rays) / TUBES) ** 2 if other_way else 0.0,
        "rays found": found if point else 0.0,
        "first judging": judged,
        "evaluations": traced + len(rounds) * judged * EVALUATED / TRACED,  # each round is judged at its end
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


def _grids(knobs: Tailoring) -> list[int]:
    """Cells a side of the transport in each round; Wang et al.'s is one map."""
    if knobs.method != "least-squares":
        return [knobs.transport_grid]
    return [max(COARSEST_GRID, knobs.transport_grid // 2 ** min(left, 2)) for left in range(knobs.rounds)]


def seconds(work: Mapping[str, float], prices: Mapping[str, float], unit: Units) -> float:
    """Σ amount · price · unit."""
    return sum(amount * prices.get(kind, 0.0) * getattr(unit, KINDS[kind].unit) for kind, amount in work.items())


def memory_amounts(scene: Scene) -> dict[str, float]:
    """The amounts that take memory; their prices are GB."""
    m, (columns, rows) = scene.lens.back.control_points, scene.target.columns_rows
    corners = (scene.tailoring.resolved(m).rays / TUBES) ** 2
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
