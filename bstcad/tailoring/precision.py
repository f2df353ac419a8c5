"""How much the precision of the arithmetic matters: the same few steps of stage 2 in float32 and in float64."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from bstcad.optics.lens import Lens
from bstcad.optics.measure import a_side, rrmsd_by_tubes
from bstcad.tailoring.merit import TubeMerit
from bstcad.tailoring.run import Task
from bstcad.tailoring.slope_fit import refine
from bstcad.tailoring.stage2 import Problem, improved, search, variables_of

EVALUATIONS = 6
TUBES = 128  # a side
NET = 65  # control points a side, at most: the comparison shall cost a fraction of a second


@dataclass(frozen=True)
class Comparison:
    """What came of the two."""

    control_points: int  # a side
    merit: float  # relative difference before the first step
    gradient: float  # the same, of its norm
    evaluations: int  # of each
    rrmsd_float64: float  # after them, both judged by the same tubes in float64
    rrmsd_float32: float
    heights: float  # mm; largest difference of a control point


def compare(task: Task, lens: Lens) -> Comparison:
    """Tailor `lens` to the irradiance in both precisions, by the same tubes and the same number of evaluations.

    Rounding decides where a line search ends; the two may part by more than rounding and be equally good.
    """
    lens = lens.with_nets(refine(net, min(net.m, NET)) for net in lens.nets)
    single, double = (_Way(task, lens.to(d)) for d in (torch.float32, torch.float64))
    n = round(a_side(task.channels) * (TUBES + 1))
    judged = [rrmsd_by_tubes(way.end, task.channels, task.screen, task.target, n) for way in (single, double)]
    return Comparison(
        max(net.m for net in lens.nets),
        abs(single.merit / double.merit - 1),
        float((single.gradient - double.gradient).norm() / double.gradient.norm()),
        EVALUATIONS,
        judged[1],
        judged[0],
        max(float((a.heights - b.heights).abs().max()) for a, b in zip(single.end.nets, double.end.nets, strict=True)),
    )


class _Way:
    """From `lens`, in its own precision: merit and gradient at the start, and the lens at the end in float64."""

    def __init__(self, task: Task, lens: Lens) -> None:
        target, n = torch.from_numpy(task.target).to(lens.like.device), min(TUBES, task.knobs.rays)
        merit = TubeMerit.of(task.channels, lens, n, task.screen, target, task.knobs.overshoot)
        problem, variables = Problem(lens, merit), variables_of(task, lens)
        self.merit, gradients, _ = problem([net.heights for net in lens.nets])
        self.gradient = torch.cat([g.reshape(-1).double().cpu() for g in gradients])
        *_, last = search(lens, problem, variables, EVALUATIONS)
        self.end = improved(lens, variables, last.best).plain()
