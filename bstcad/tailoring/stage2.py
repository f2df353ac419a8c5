"""Stages 2 and 3: the irradiance itself, by ray tubes.

Each evaluation traces the same corners of a sheet of tubes, so that the merit is smooth and without noise, and a gain
on it is a gain for the lens.  In the Sobolev variable (merit.py) L-BFGS needs some hundred evaluations where Adam on
raw control points needs thousands.

Stage 3 is for a source of some size, in place of stage 2: the same search by the light of the source's middle, blurred
by its image (source_image.py); first of a small source, then of a larger one, at last of the source as it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from bstcad.optics.channels import channels_of, points
from bstcad.optics.kernels.reductions import elementary
from bstcad.optics.lens import Lens
from bstcad.optics.measure import a_side, images, rrmsd_by_tubes
from bstcad.optics.sides import both, coarser
from bstcad.scene.blank import Bounds
from bstcad.scene.quality import Tailoring
from bstcad.tailoring.grazing import Grazing
from bstcad.tailoring.machinability import excess, held, weight
from bstcad.tailoring.merit import CoarseVariable, Merit, SobolevVariable, local_weight
from bstcad.tailoring.minimise import Best, Reached, Search, lbfgs, minimise
from bstcad.tailoring.net_variables import NetVariables, along_light
from bstcad.tailoring.reachable import coarse
from bstcad.tailoring.run import EVALUATED, Parameters, Step, Task
from bstcad.tailoring.source_image import Spread

Shares = tuple[tuple[float, float], ...]  # (tubes a side, evaluations) of each round, as shares of the knobs
ROUNDS = ((1 / 2, 0.51), (2 / 3, 0.41), (1.0, 0.08))
# The same where even the last round has fewer than DENSE tubes a control cell each way.  The first ones then bend the
# net between the tubes where they see nothing, which the last one has to mend.  (Found, for 1025 control points by two
# tubes a cell: the portrait ends at 0.018 where it would end at 0.020 by the shares above in the same time.)
SPARSE, DENSE = ((1 / 2, 0.40), (3 / 4, 0.35), (1.0, 0.25)), 2.5
# For several goals: two nets have twice the freedom to bend between the tubes.
JOINT = ((2 / 3, 0.45), (1.0, 0.35), (4 / 3, 0.2))
# Two pictures take twice the evaluations of one, and more in proportion to the side of a net of more than OF_SIDE
# control points: the variable leaves the Hessian a power of the Laplacian.  (Letters before a portrait, 769 points:
# RRMSD 0.057 and 0.062 after 196 evaluations in three rounds, 0.047 and 0.057 after 309 in these two.)
PICTURES, OF_SIDE = ((2 / 3, 1.4), (4 / 3, 0.7)), 513
# Where RRMSD is above FAR_OFF on LARGE pixels, which a net that is only too coarse for the picture gets right, light
# has to move far: (pixels along the longer side, tubes a side, evaluations) of the rounds before those, the last of
# which comes again after the first of those; and how many times the evaluations those have then.
COARSE, MORE = ((32, 256, 60), (64, 384, 60)), 1.5
# Factor of the evaluations where those are one round, which then comes last, since no stage may end with a round that
# sees few pixels.  (A draft of a plate bound to 2 mm: RRMSD 0.264 by 1.5 times, 0.236 by 3, but 0.408 if 60 evaluations
# on 64 pixels come last.)
MORE_ALONE = 3.0
LARGE, FAR_OFF = 16, 0.04
SEEN, BY = 16, 8  # places a side of the lens, and points of a source, by which the width of its image is measured
FEW = 30  # evaluations: fewer make one round, since each has its own start to pay for
NET = 65  # control points along the longer side, at most: the comparison shall cost a fraction of a second
TUBES = 128  # a side
COMPARED = 6  # evaluations in each precision
# (of the source, evaluations), as shares of all; what its images leave out is measured anew in each round
SIZES = ((1 / 3, 1 / 8), (2 / 3, 1 / 8), (1.0, 1 / 4), (1.0, 1 / 4), (1.0, 1 / 4))
A_CELL, A_PIXEL = 2.0, 1.1  # tubes a control cell and a pixel a side, at least: what is finer the source's image blurs


@dataclass(frozen=True)
class Round:
    """One round of a stage: its light, tubes and evaluations."""

    task: Task  # its channels are the light of this round
    tubes: int  # a side of the sheet of each channel
    evaluations: int
    stage: str = "stage 2"  # of which it is a part
    pixels: int | None = None  # along the longer side, that it sees instead of the target's
    spread: Spread | None = None  # of a source of some size, whose points the task's channels are
    share: float = 1.0  # size of the source in this round, as a part of its full size

    @property
    def name(self) -> str:
        """For the list of times."""
        sheets = len(self.task.channels if self.spread is None else self.spread.centre)
        tubes = f"{self.tubes}² tubes" if sheets == 1 else f"{sheets} × {self.tubes}² tubes"
        return ", ".join([self.stage, *([f"{self.pixels} pixels"] if self.pixels else []), tubes])

    def merit(self, lens: Lens) -> Merit:
        """By tubes launched for a lens."""
        task = self.task if self.pixels is None else coarsened(self.task, self.pixels)
        return Merit.of(
            task.channels if self.spread is None else self.spread.centre, lens, self.tubes, task.goals,
            overshoot=_pull(task, lens), wave=task.wave, own=task.merit, spread=self.spread,
            seed=None if task.hasty else task.knobs.seed,
        )  # fmt: skip


@dataclass(frozen=True)
class Place:
    """Which search of a stage is under way."""

    round: int
    done: int  # evaluations before this search
    round_end: int  # evaluations at the end of this round
    goal_by_tubes: float  # RRMSD by its own tubes at which it asks whether the accuracy is reached
    sheet_from: Parameters  # of the lens that the tubes were launched for
    search_from: Parameters  # of the lens that this search started from


@dataclass(frozen=True)
class TubeSearch:
    """Where a stage by tubes stands between two steps of a search."""

    place: Place
    best: Best  # of this search
    search: Search


def steps(task: Task, lens: Lens, state: TubeSearch | None = None) -> Iterator[Step]:
    """Stage 2: rounds with fewer tubes first, if there are enough evaluations for them, and all tubes in the last.

    The error is large at first, and few tubes resolve it as well as many; the last round corrects the finer errors.
    """
    coarse, fine = coarse_rounds(task, lens), tuple(sheets(task.knobs, shares_of(task)))
    times = 1.0 if not coarse else MORE if len(fine) > 1 else MORE_ALONE
    first, *others = (Round(task, tubes, round(times * count)) for tubes, count in fine)
    again = coarse[-1:] if others else ()
    return run_rounds((*coarse, first, *again, *others), lens, state)


def coarse_rounds(task: Task, lens: Lens) -> tuple[Round, ...]:
    """Rounds by few pixels, tubes and control points for a lens after stage 1 whose picture is wrong at large, or ().

    Where the map has not come to rest, near a lamp or a wall, light has to move far: many evaluations at first, but
    each costs a thirtieth, and the tubes need not tell the cells of the lens's own net.
    """
    most = min(max(task.goals[0].receiver.shape) - 1, task.knobs.side // 2)  # pixels that the net can tell
    rounds = [Round(task, tubes, evaluations, pixels=pixels) for pixels, tubes, evaluations in COARSE if pixels <= most]
    if not rounds or task.merit is not None or task.several or task.hasty or not task.knobs.stage2_iterations:
        return ()  # of several goals: two nets bend between so few tubes
    seen, tubes = coarsened(task, LARGE), COARSE[0][1]
    [goal] = seen.goals
    far_off = rrmsd_by_tubes(lens.plain(), seen.channels, goal.receiver, target=goal.picture, n=tubes) > FAR_OFF
    return tuple(rounds) if far_off else ()


def coarsened(task: Task, pixels: int) -> Task:
    """The task with at most so many pixels along the longer side."""
    return replace(task, goals=tuple(coarse(goal, pixels) for goal in task.goals))


def shares_of(task: Task) -> Shares | None:
    """The rounds of several goals, and of a preview; None: of one goal."""
    if task.hasty:
        return ((1.0, 1.0),)
    if len(task.goals) == 1:
        return JOINT if task.several else None
    larger = max(1.0, task.knobs.side / OF_SIDE)
    return tuple((tubes, larger * share) for tubes, share in PICTURES)


def sheets(knobs: Tailoring, shares: Shares | None = None) -> Iterator[tuple[int, int]]:
    """(tubes a side, evaluations) of each round; no fewer tubes than control points: they could not tell them apart."""
    shares = shares or (ROUNDS if knobs.rays >= DENSE * knobs.side else SPARSE)
    if knobs.stage2_iterations < FEW:
        shares = ((1.0, 1.0),)
    least = min(knobs.rays, knobs.side)
    for tubes, share in shares:
        yield max(round(tubes * knobs.rays), least), round(share * knobs.stage2_iterations)


def run_rounds(rounds: Sequence[Round], lens: Lens, state: TubeSearch | None = None) -> Iterator[Step]:
    """A stage, one round after the other, or on from a state of it.

    Ends when the evaluations are spent, on a plateau of the last round, or when its light reaches the accuracy asked
    for, as `Task.rrmsd` finds it by rays.
    """
    accuracy = rounds[0].task.knobs.accuracy
    begin = Parameters.of(lens)
    place = state.place if state else Place(0, 0, 0, accuracy or 0.0, sheet_from=begin, search_from=begin)
    total = sum(each.evaluations for each in rounds)
    if state is None:
        yield Step(lambda: lens)
    for number in range(place.round, len(rounds)):
        now, bound_weight = rounds[number], weight(number, len(rounds))
        task, part = now.task, now.name
        if state is None:
            place = replace(place, round=number, round_end=place.done + now.evaluations, sheet_from=Parameters.of(lens))
        if place.round_end <= place.done:
            continue
        launched, merit = place.sheet_from.applied(lens), None
        grazing = task.edge and Grazing.of(task.edge, launched)
        while place.done < place.round_end:
            if state is None:
                place = replace(place, search_from=Parameters.of(lens))
            begun = place.search_from.applied(lens)
            task.tidy()
            variables = variables_of(task, begun, now.pixels)  # which takes some memory: before the sheet does
            if merit is None:
                merit = now.merit(launched)
                task.tidy()
            bounds = held(begun, task.bounds, task.least)
            problem = Problem(begun, merit, bounds, bound_weight, grazing=grazing)
            for reached, step in _search(now, problem, variables, place, total=total, state=state):
                yield replace(step, part=part)
                if reached.reason:
                    break
            lens, state, judged = step.lens, None, None
            place, reason = replace(place, done=place.done + reached.best.evaluations), reached.reason
            if reason == "accuracy" and (judged := task.rrmsd(lens)) > accuracy:
                # the tubes flatter a little: ask more of them
                place = replace(place, goal_by_tubes=place.goal_by_tubes * accuracy / judged)
                reason = "evaluations"  # so it will have been, if none are left
            elif reason != "evaluations":
                break
        del merit, problem  # else two sheets would stand beside each other
        judged = None if task.hasty else judged or task.rrmsd(lens)
        whole = task.channels == rounds[-1].task.channels  # is this all of the light, and not of a smaller source?
        if judged is not None and accuracy is not None and judged <= accuracy:
            reason = "accuracy"  # by rays: a round may end there though its own goal, by tubes, is not reached
        reason = reason if number == len(rounds) - 1 or (reason == "accuracy" and whole) else ""
        yield Step(lambda lens=lens: lens, judged=judged, whole=whole, part=part, ends=True, reason=reason)
        if reason:
            return


def _pull(task: Task, lens: Lens) -> float:
    """Weight of light beyond the border (1 / pixel²); less for a source whose image is w pixels wide.

    Within w of the border some light falls outside whatever the lens does, and to be pulled in would blur the edge.
    """
    overshoot = task.knobs.overshoot
    if points(task.channels) == 1:
        return overshoot
    few, light = task.channels, task.heaviest
    if task.spreads:
        source = replace(task.spreads[-1].source, wavelength=light.source.wavelength)
        few = channels_of(source, lambda _: light.index, BY)  # whose second moments are those of all points
    return overshoot / (1 + max(images(few, lens, goal.receiver, SEEN).width() for goal in task.goals) ** 2)


def _search(
    now: Round, problem: Problem, variables: NetVariables, place: Place, *, total: int,
    state: TubeSearch | None,
) -> Iterator[tuple[Reached, Step]]:  # fmt: skip
    """One run of the minimiser from the lens of a problem, or on from a saved state; it also ends at the goal.

    total: evaluations of all rounds.
    """
    lens, evaluations = problem.lens, place.round_end - place.done
    work = 0.0  # the first step has other work before it: its time is not known
    for reached in search(lens, problem, variables, evaluations=evaluations, state=state):
        best, reason = reached.best, reached.reason
        step = Step(partial(improved, lens, variables, best), work=work, skipped=reached.skipped)
        if not reached.skipped:
            done = min(place.done + best.evaluations, total)  # a line search may run over a little
            of_few = f" on {now.pixels} pixels" if now.pixels else ""
            of_few += f", with {100 * now.share:.0f} % of the source's size" if now.share < 1 else ""
            step = replace(step, progress=(now.stage, done, total, f"RRMSD {best.figure:.4f}{of_few}"))
            if now.pixels is None:
                step = replace(step, rrmsd=best.figure)
                reason = "accuracy" if best.figure <= place.goal_by_tubes else reason
        if reached.state is not None and not reason:
            step = replace(step, state=TubeSearch(place, best, reached.state))
        yield replace(reached, reason=reason), step
        work = problem.merit.tubes / EVALUATED


@dataclass(frozen=True)
class Problem:
    """Merit and gradients in all freeform interfaces for a fixed sheet of tubes a channel.

    The fused kernels keep only where each corner lands, not its path: memory is some 100 bytes a corner and does not
    grow with control points.
    """

    lens: Lens
    merit: Merit
    bounds: Bounds | None = None  # on the tailored faces; the excess over them adds to the merit
    bound_weight: float = 0.0  # of the excess
    grazing: Grazing | None = None  # keeps light at the edge of its reach from total reflection

    def __call__(self, heights: Sequence[Tensor]) -> tuple[float, list[Tensor], float]:
        """(merit, ∂merit/∂heights of each net, RRMSD) at the heights of the nets (mm)."""
        leaves = [h.detach().requires_grad_() for h in heights]
        lens = self.lens.with_heights(leaves)
        merit, rrmsd = self.merit(self.merit.landing(lens))
        gradients = list(torch.autograd.grad(merit, leaves))
        value = float(merit.detach())
        if self.bounds is not None:
            over = excess(lens.plain(), self.bounds)
            if over.mean_square:
                pairs = zip(gradients, over.gradients, strict=True)
                gradients = [g + self.bound_weight * own.to(g) for g, own in pairs]
            value += self.bound_weight * over.mean_square
        if self.grazing is not None:
            over, gradient, _ = self.grazing(heights[-1])
            value, gradients[-1] = value + over, gradients[-1] + gradient
        return value, gradients, float(rrmsd)


def variables_of(task: Task, lens: Lens, pixels: int | None = None) -> NetVariables:
    """The variable of each freeform interface, for the light of the task; pixels: by nets of about as many cells."""
    nets = lens.nets
    if pixels is not None:
        lens = lens.with_nets(net.refined(coarser(net.shape, pixels + 1)) for net in nets)
    light = task.heaviest
    seen = light.through(lens)
    weights = [
        _mean(
            local_weight(light.source, seen, goal.picture, screen=goal.receiver, number=number) for goal in task.goals
        )
        for number in lens.freeform
    ]
    if pixels is not None:
        return NetVariables(tuple(CoarseVariable.of(*each) for each in zip(nets, lens.nets, weights, strict=True)))
    blocks = tuple(SobolevVariable.of(net, weight) for net, weight in zip(nets, weights, strict=True))
    if lens.shapes_both and len(task.goals) > 1:
        return NetVariables(blocks, *along_light(light.source, seen, task.goals))
    return NetVariables(blocks)


def _mean(weights: Iterable[Tensor]) -> Tensor:
    """The geometric mean of the weights for several goals; of one itself."""
    first, *others = weights
    if not others:
        return first
    logarithm = sum((elementary(torch.log, w) for w in others), elementary(torch.log, first))
    return elementary(torch.exp, logarithm / (1 + len(others)))


def search(
    lens: Lens,
    problem: Problem,
    variables: NetVariables,
    evaluations: int,
    state: TubeSearch | None = None,
) -> Iterator[Reached]:
    """L-BFGS on the heights of all nets, from those of `lens`, in one block of Sobolev variables c a net."""
    start = [net.heights for net in lens.nets]

    def in_c(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        heights = _moved(start, variables, [c.detach() for c in parameters])
        merit, gradients, rrmsd = problem(heights)
        return merit, variables.adjoint(gradients), rrmsd

    method = lbfgs(variables.zeros(), evaluations, state and state.search)
    return minimise(in_c, method, evaluations, state.best if state else Best())


def improved(lens: Lens, variables: NetVariables, best: Best) -> Lens:
    """The lens with the best nets of a search that began at it; itself if every value of that was not finite."""
    if not best.parameters:
        return lens
    return lens.with_heights(_moved([net.heights for net in lens.nets], variables, best.parameters))


def _moved(start: Sequence[Tensor], variables: NetVariables, c: Sequence[Tensor]) -> list[Tensor]:
    """The heights (mm) of each net at c."""
    return [h + change for h, change in zip(start, variables.heights(c), strict=True)]


Stage2 = Callable[[Task, Lens, Any], Iterator[Step]]


@dataclass(frozen=True)
class Grown:
    """Where stage 3 stands between two steps of a search."""

    grown: TubeSearch


def with_stage3(before: Stage2 | None, task: Task, lens: Lens, state: Any = None) -> Iterator[Step]:
    """Stage 3, or on from a state of it; before it a stage 2 for the source's middle, unless that is None.

    The lens after stage 2 is judged by the light of the whole source.
    """
    if before is not None and not isinstance(state, Grown):
        for last in before(task, lens, state):
            if last.ends:
                whole = task.whole
                last = replace(last, judged=whole.rrmsd(last.lens))
            yield replace(last, reason="")
        lens, state = last.lens, None
    rounds = stage3_rounds(task)
    if before is None:
        rounds = (*coarse_rounds(task, lens), *rounds)
    for step in run_rounds(rounds, lens, state and state.grown):
        yield replace(step, state=step.state and Grown(step.state))


def stage3_rounds(task: Task) -> tuple[Round, ...]:
    """One for each of SIZES."""
    lights = (
        replace(task, channels=channels, grown=(), spreads=(spread,))
        for channels, spread in zip(task.grown, task.spreads, strict=True)
    )
    if task.hasty:
        *_, light = lights
        return (Round(light, task.knobs.rays, task.knobs.stage2_iterations, stage="stage 3", spread=light.spreads[0]),)
    screens = [goal.receiver for goal in task.goals]
    counts = blurred_sheets(task.knobs, (max(each.columns for each in screens), max(each.rows for each in screens)))
    return tuple(
        Round(light, tubes, evaluations, stage="stage 3", spread=spread, share=share)
        for light, spread, (tubes, evaluations), (share, _) in zip(lights, task.spreads, counts, SIZES, strict=True)
    )


def blurred_sheets(knobs: Tailoring, pixels: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """(tubes a side, evaluations) of each round for a source of some size; pixels: columns and rows.

    A sheet of n tubes a side has n √(m_x / m_y) along x and n √(m_y / m_x) along y over a net of m_x x m_y points.
    """
    total = knobs.stage2_iterations * (2 if knobs.stage2_iterations < FEW else 1)  # each is cheap, and all have a start
    (m_x, m_y), (columns, rows) = both(knobs.levels[-1]), pixels
    oblong = math.sqrt(m_x / m_y)
    a_pixel = A_PIXEL * max(columns / oblong, rows * oblong)
    tubes = min(knobs.rays, math.ceil(max(A_CELL * knobs.side, a_pixel)))
    for _, share in SIZES:
        yield tubes, round(share * total)


@dataclass(frozen=True)
class Comparison:
    """How two twins of a lens part, tailored in float32 and in float64."""

    control_points: int  # along the longer side
    merit: float  # relative difference before the first step
    gradient: float  # the same, of its norm
    evaluations: int  # of each
    rrmsd_float64: float  # after them, both judged by the same tubes in float64
    rrmsd_float32: float
    heights: float  # mm; largest difference of a control point


def compare_precisions(task: Task, lens: Lens) -> Comparison:
    """Tailor `lens` to the irradiance in both precisions, by the same tubes and the same number of evaluations.

    Rounding decides where a line search ends; the two may part by more than rounding and be equally good.
    """
    lens = lens.with_nets(net.refined(coarser(net.shape, NET)) for net in lens.nets)
    (merit, gradient, single), (exact, wanted, double) = (
        _tried(task, lens.to(d)) for d in (torch.float32, torch.float64)
    )
    n, goal = round(a_side(task.channels) * (TUBES + 1)), task.goals[0]
    rrmsd = [rrmsd_by_tubes(end, task.channels, goal.receiver, target=goal.picture, n=n) for end in (single, double)]
    pairs = zip(single.nets, double.nets, strict=True)
    return Comparison(
        control_points=max(max(net.shape) for net in lens.nets),
        merit=abs(merit / exact - 1),
        gradient=float((gradient - wanted).norm() / wanted.norm()),
        evaluations=COMPARED,
        rrmsd_float64=rrmsd[1],
        rrmsd_float32=rrmsd[0],
        heights=max(float((a.heights - b.heights).abs().max()) for a, b in pairs),
    )


def _tried(task: Task, lens: Lens) -> tuple[float, Tensor, Lens]:
    """(merit and gradient at the start, the lens after COMPARED evaluations in its own precision, in float64)."""
    n = min(TUBES, task.knobs.rays)
    merit = Merit.of(task.channels, lens, n, task.goals[:1], overshoot=task.knobs.overshoot, own=task.merit)
    problem, variables = Problem(lens, merit), variables_of(task, lens)
    value, gradients, _ = problem([net.heights for net in lens.nets])
    *_, last = search(lens, problem, variables, COMPARED)
    flat = torch.cat([g.reshape(-1).double().cpu() for g in gradients])
    return value, flat, improved(lens, variables, last.best).plain()
