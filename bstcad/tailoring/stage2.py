"""Stages 2 and 3: minimise the error of the traced irradiance, starting from the surface of stage 1.

Stage 2 minimises RRMSD² plus penalties on light beside the target and lost light (merit.py), on violated bounds
(machinability.py) and on total internal reflection (grazing.py).  As in Wang et al. 2023, the RRMSD is the relative
root mean square difference between the target irradiance E and the traced irradiance E^s over all pixels:

    RRMSD = sqrt(Σ_ij |E^s_ij - E_ij|² / Σ_ij E_ij²).

(In the merit E^s is divided by the transmitted flux; in a reported RRMSD it is scaled to the sum 1.)  The paper traces
random rays.  Here each evaluation traces the corners of a fixed sheet of flux tubes and integrates their flux over the
pixels exactly, so that the merit has no noise and is smooth while no tube is lost.  The variables are the heights of
the control points of all nets, in a Sobolev variable (merit.py), so that L-BFGS needs 50 to 300 evaluations, while
Adam on the heights needs thousands.  Most rounds of stage 2 have more tubes than the round before.

For a source of finite size, stage 3 replaces stage 2 and also starts from the surface of stage 1.  It traces the light
of the centre of the source and blurs the picture by the image of the source (source_image.py), in rounds that increase
the size of the source to its full size; coarse rounds for the centre alone may precede.  The paper's procedure
(tailoring/baselines/paper.py) is an exception: it runs stage 2 for the centre of the source, and then stage 3.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel, channels_of, points_per_line
from bstcad.optics.surfaces.sides import as_pair, coarser
from bstcad.optics.trace.measure import rrmsd_by_tubes, side_factor
from bstcad.optics.trace.source_images import images
from bstcad.tailoring.driver import ROUGH_RAYS, TUBES_PER_SECOND, Parameters, Stage, StageStep, Steps, Task, maker
from bstcad.tailoring.folds import Folds, needs_no_folds
from bstcad.tailoring.grazing import Grazing
from bstcad.tailoring.machinability import active_bounds, excess, round_weight
from bstcad.tailoring.merit import FOUR_POINTS, CoarseVariable, Merit, SobolevVariable, local_weight
from bstcad.tailoring.minimise import PLATEAU, Best, Iterate, LbfgsState, Pairs, Plateau, lbfgs, minimise
from bstcad.tailoring.net_variables import NetVariables, along_light
from bstcad.tailoring.reachable import resample
from bstcad.tailoring.settings import Bounds, Settings
from bstcad.tailoring.source_image import ExtendedSource

RoundFractions = tuple[tuple[float, float], ...]  # (tubes per side, evaluations) of rounds, relative to the settings
# Rounds if the last one has DENSE_TUBES tubes or more per cell of the control net along each axis.
DENSE_ROUNDS, DENSE_TUBES = ((1 / 2, 0.51), (2 / 3, 0.41), (1.0, 0.08)), 2.5
# Rounds if, of these, the first has fewer than DENSE_TUBES tubes per cell, for a lens without bounds on its shape and
# at most SHORT_EVALUATIONS.  The last round corrects what the others distort between the tubes; these end on the
# plateau FEW_TUBES.  (Letters after 76 evaluations: RRMSD 0.0253 on pixels and 0.043 on half pixels; after 83, with a
# power of the share of 0.18, 0.0257 and 0.042.  With 300 evaluations, as in fine quality, and the merit of pixels
# alone, short rounds ended at 0.0168 instead of 0.0148.)
SHORT_ROUNDS, FEW_TUBES, SHORT_EVALUATIONS = ((5 / 12, 0.43), (5 / 8, 0.22), (0.91, 0.12)), Plateau(5, 0.03), 150
# Rounds if the last one has fewer than DENSE_TUBES tubes per cell.  The first rounds then distort the net between the
# tubes, and the last one has to correct this, with MAX_TUBES tubes per side or fewer, since more need much memory; if
# these are too few, with as many as the settings state.  (1025 control points, portrait: RRMSD 0.0175 after 54
# evaluations with 2733 tubes per side at last, and 0.0177 after 97, in a quarter more time, with 2050.)
FINER_ROUNDS, SPARSE_ROUNDS = ((1 / 2, 0.3), (1.0, 0.2), (4 / 3, 0.05)), ((1 / 2, 0.40), (3 / 4, 0.35), (1.0, 0.25))
MAX_TUBES = 3100
# Rounds for a picture and a wavefront: two nets can distort between the tubes, and so need more tubes.
WAVEFRONT_ROUNDS = ((2 / 3, 0.45), (1.0, 0.35), (4 / 3, 0.2))
# Rounds for several pictures, and the number of control points per side above which the evaluations grow in proportion:
# with LAPLACIAN_POWER = 0.5, the Hessian in the Sobolev variable still contains a power of the Laplacian.  Two nets
# distort between the tubes, the less the more tubes there are.  (Two photographs, 769 points per side: RRMSDs 0.027 and
# 0.038 after 206 and 103 evaluations in the rounds (2/3, 4/3); 0.027 and 0.031 after 73, 73 and 15 in three rounds, in
# three quarters of the time.)
PICTURES_ROUNDS, PICTURES_SIDE = ((2 / 3, 1.2), (4 / 3, 0.5), (2.0, 0.1)), 513
# Ratio of the RRMSD by tubes to the RRMSD by rays at which such a round ends before the last, since further evaluations
# would mostly fit the nets to the tubes; and evaluations between two comparisons.
DISTORTION_RATIO, COMPARISON_INTERVAL = 0.5, 25
# Coarse rounds: (pixels along the longer side, tubes per side, evaluations).  They precede the fine rounds if light has
# to move far: if the RRMSD exceeds FAR_OFF_RRMSD on LARGE_PIXELS pixels along the longer side.  Any net resolves so few
# pixels, so such an error means that light is in the wrong place.  In stage 2 the last coarse round is repeated after
# the first fine round, if other fine rounds follow.
COARSE_ROUNDS = ((32, 256, 60), (64, 384, 60))
LARGE_PIXELS, FAR_OFF_RRMSD = 16, 0.04
# Factor of the evaluations of the fine rounds of stage 2 after coarse rounds, and the factor of a single fine round,
# since no coarse round can follow it: a stage must not end with few pixels.  (Draft of a plate with at most 2 mm of
# glass: RRMSD 0.264 with a factor of 1.5, 0.236 with 3, but 0.408 if 60 evaluations on 64 pixels come last.)
EVALUATION_FACTOR, SINGLE_ROUND_FACTOR = 1.5, 3.0
IMAGE_POSITIONS, SECOND_MOMENT_POINTS = 16, 8  # cells per side of the back, source points, for the source image's width
# Evaluations of the only round that refines an earlier lens, as a fraction of those of the stage.  (Letters, thickness
# 50 µm and index 3e-4 off: RRMSD 0.0222, as designed; docs/how-to/blank-as-built.md.)
REFINING_SHARE = 0.1
# The merit: cells per control point along a side in the last round, less than a power of two by a factor of at most
# 2^CELL_MARGIN; most cells of a picture, for its memory.
CELLS_PER_POINT, CELL_MARGIN, MAX_CELLS = 4.0, 0.25, 1 << 22
# Share in the squared error of the errors on cells smaller than a pixel, for one control point per lit pixel; power by
# which it falls with their number for a target with detail, since more points correct the light inside a pixel more
# easily; share of the errors on cells smaller than each further size in the rest.
CELL_SHARE, CELL_SHARE_POWER, FINER_SHARE = 0.21, 0.33, 0.2
MIN_EVALUATIONS = 30  # evaluations below which stage 2 has a single round and stage 3 gets twice as many
# Rounds of stage 3: (size of the source, evaluations), as fractions of the full size and of all evaluations.  Each
# round measures the error of the blur anew (source_image.py).
SOURCE_SIZES = ((1 / 3, 1 / 8), (2 / 3, 1 / 8), (1.0, 1 / 4), (1.0, 1 / 4), (1.0, 1 / 4))
TUBES_PER_CELL, TUBES_PER_PIXEL = 2.0, 1.1  # tubes per axis in a cell and a pixel in stage 3: the blur hides detail


@dataclass(frozen=True)
class TubeRound:
    """Light, tubes and evaluations of one round of stage 2 or 3."""

    task: Task  # task whose channels are the light by which the round is rated
    tubes: int  # tubes per side in the sheet of each channel
    evaluations: int  # largest number of evaluations
    stage: str = "stage 2"  # name of the stage
    pixels: int | None = None  # pixels along the longer side of a coarse target; None: the pixels of the target
    source: ExtendedSource | None = None  # source that blurs the picture; None: no blur
    source_size: float = 1.0  # size of the source in this round, as a fraction of its full size
    plateau: Plateau = PLATEAU  # plateau at which the round ends
    resolved: bool = False  # True if the tubes resolve the net's shortest waves (`resolves_net`)
    ends_distorted: bool = False  # True if the round ends at DISTORTION_RATIO
    # shares of the squared errors on pixels, half pixels, quarters … in the merit; their sum is 1
    shares: tuple[float, ...] = (1.0,)

    @property
    def cells(self) -> int:
        """Number of the smallest cells along each side of a pixel on which the picture is rated."""
        return 1 << (len(self.shares) - 1)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Channels that the tubes carry; if a source blurs the picture, those of its centre."""
        return self.task.channels if self.source is None else self.source.centre

    @property
    def level(self) -> float:
        """Level λ_0 of the variables: of waves of four half pixels, or four points; infinite if not resolved.

        For waves above it the merit hardly grows faster, since a pixel averages over them.
        """
        if not self.resolved:
            return math.inf
        cells = min(finest_cells(self.task), 2) * pixels_of(self.task)  # per side
        return FOUR_POINTS * max(1.0, cells / self.task.settings.side) ** 2

    def takes_over(self, before: TubeRound) -> bool:
        """Return True if L-BFGS keeps the steps stored by the round before: it has nearly the same merit and variables.

        In sparse rounds for one goal, these steps distort the net between the tubes.
        """
        return (self.resolved and before.resolved) or (before.ends_distorted and self.stage == before.stage)

    @property
    def name(self) -> str:
        """Name of the round in the list of times."""
        sheets = len(self.channels)
        tubes = f"{self.tubes}² tubes" if sheets == 1 else f"{sheets} × {self.tubes}² tubes"
        return ", ".join([self.stage, *([f"{self.pixels} pixels"] if self.pixels else []), tubes])

    def merit(self, lens: Lens) -> Merit:
        """Return the merit of this round, with tubes launched for `lens`."""
        task = self.task if self.pixels is None else with_pixels(self.task, self.pixels)
        overshoot = _overshoot_weight(task, lens) / self.cells**2  # per cell²
        goals = tuple(goal.on_cells(self.cells) for goal in task.goals)
        merit = Merit.of(self.channels, lens, self.tubes, goals, overshoot=overshoot, wave=task.wave)
        merit = replace(merit, picture_error=task.merit, shares=self.shares)
        # the blur by a source hides folds; two nets that form several goals converge slowly without them
        may_fold = task.merit is not None or not task.effort.refines_merit or task.several or task.extended_sources
        if not may_fold and any(map(needs_no_folds, task.goals)):
            with torch.no_grad():
                landed = merit.landing(lens).on_goals
            pairs = zip(task.goals, landed, strict=True)
            cell = pixels_of(task) / task.settings.side  # side (pixels) of even light of a cell of the net
            folds = (Folds.of(goal, merit.light.sheets, each, cell) for goal, each in pairs)
            merit = replace(merit, folds=tuple(folds))
        if self.source is None:
            return merit
        return merit.with_blur(self.source, lens, task.effort.blur, task.settings.seed)

    def run(
        self, problem: Problem, variables: NetVariables, position: SearchPosition, total: int,
        state: TubeSearch | None, pairs: Pairs,
    ) -> Iterator[tuple[Iterate, StageStep]]:  # fmt: skip
        """Yield (iterate, step) of a search from a lens or state, until the RRMSD is `position.goal_by_tubes` or less.

        total: evaluations of all rounds.  pairs: those of the search before, for `lbfgs`.
        """
        lens, evaluations = problem.lens, position.round_end - position.done
        work = 0.0  # unknown for the first step, which includes other work
        for iterate in minimise_merit(
            lens, problem, variables, evaluations, state=state, pairs=pairs, plateau=self.plateau
        ):
            best, reason = iterate.best, iterate.reason
            step = StageStep(partial(with_best_nets, lens, variables, best), work=work, skipped=iterate.skipped)
            if not iterate.skipped:
                done = min(position.done + best.evaluations, total)
                detail = f" on {self.pixels} pixels" if self.pixels else ""
                if self.source_size < 1:
                    detail += f", with {100 * self.source_size:.0f} % of the source's size"
                step = replace(step, progress=(self.stage, done, total, f"RRMSD {best.figure:.4f}{detail}"))
                if self.pixels is None:
                    step = replace(step, rrmsd=best.figure)
                    reason = "accuracy" if best.figure <= position.goal_by_tubes else reason
                if self.ends_distorted and not reason and best.evaluations % COMPARISON_INTERVAL == 0:
                    rough = self.task.rrmsd(step.lens, self.task.effort.between_stages(self.task.goals, ROUGH_RAYS))
                    distorted = best.figure < DISTORTION_RATIO * rough
                    reason = "distortion" if distorted else ""
            if iterate.state is not None and not reason:
                step = replace(step, state=TubeSearch(position, best, iterate.state))
            yield replace(iterate, reason=reason), step
            work = problem.merit.tubes / TUBES_PER_SECOND


@dataclass(frozen=True)
class SearchPosition:
    """Position of a search within its stage."""

    round: int  # number of the round, from 0
    done: int  # evaluations of the stage before this search
    round_end: int  # evaluations of the stage at the end of this round
    goal_by_tubes: float  # RRMSD with tubes at which the search stops for a check with rays; lowered if rays disagree
    sheet_from: Parameters  # lens for which the tubes were launched
    search_from: Parameters  # lens from which this search started


@dataclass(frozen=True)
class TubeSearch:
    """State of stage 2 between two steps of a search."""

    position: SearchPosition
    best: Best  # best point of this search
    lbfgs: LbfgsState


def steps(task: Task, lens: Lens, state: TubeSearch | None = None) -> Steps:
    """Yield the steps of stage 2: if the evaluations suffice, rounds with few tubes come first.

    Few tubes resolve the large errors at the start as well as many tubes do.  The last round corrects finer errors.
    """
    fine = tuple(sheet_sizes(task.settings, round_shares(task)))
    if task.refines:
        return run_rounds((_fine_round(task, fine[-1][0], refining_evaluations(task.settings), True),), lens, state)
    coarse = coarse_rounds(task, lens)
    factor = 1.0 if not coarse else EVALUATION_FACTOR if len(fine) > 1 else SINGLE_ROUND_FACTOR
    last = len(fine) - 1
    first, *others = (_fine_round(task, tubes, round(factor * n), k == last) for k, (tubes, n) in enumerate(fine))
    again = coarse[-1:] if others else ()
    return run_rounds((*coarse, first, *again, *others), lens, state)


def refining_evaluations(settings: Settings) -> int:
    """Return the number of evaluations of the round that refines an earlier lens."""
    return math.ceil(REFINING_SHARE * settings.stage2_iterations)


def _fine_round(task: Task, tubes: int, evaluations: int, is_last: bool) -> TubeRound:
    resolved, cells = resolves_net(task), finest_cells(task)
    few = tubes < DENSE_TUBES * task.settings.side
    ends_early = resolved and few and task.settings.stage2_iterations <= SHORT_EVALUATIONS
    return TubeRound(
        task, tubes, evaluations, plateau=FEW_TUBES if ends_early else PLATEAU, resolved=resolved,
        ends_distorted=len(task.goals) > 1 and task.effort.divides_rounds and not is_last,
        shares=shares_on_cells(task, cells if is_last or cells <= 2 else cells // 2),
    )  # fmt: skip


def pixels_of(task: Task) -> float:
    """Return the pixels per side of the square with as many pixels as the largest target."""
    return max(math.sqrt(math.prod(goal.screen.shape)) for goal in task.goals)


def finest_cells(task: Task) -> int:
    """Return the cells along each side of a pixel that the last round rates, a power of two.

    They are about a quarter as wide as the cells of the net, if the light were spread evenly.  Where a picture is
    bright, its pixels have more cells of the net: ten for letters.  Half pixels are rated in any case, and are the
    smallest cells for several goals, with which two nets converge faster.
    """
    if task.merit is not None or not task.effort.refines_merit:
        return 1
    wanted = math.log2(CELLS_PER_POINT * task.settings.side / pixels_of(task))
    most = math.log2(MAX_CELLS / max(math.prod(goal.screen.shape) for goal in task.goals)) / 2
    most = min(most, 1.0) if task.several else most
    return 1 << max(0, math.floor(min(max(wanted + CELL_MARGIN, 1.0), most)))


def shares_on_cells(task: Task, cells: int) -> tuple[float, ...]:
    """Return `TubeRound.shares`: of pixels, half pixels … cells of which `cells` lie along each side of a pixel."""
    lit = max(float(goal.picture.sum() ** 2 / (goal.picture**2).sum()) for goal in task.goals)  # pixels, if even
    share = CELL_SHARE
    if not all(map(needs_no_folds, task.goals)):
        share *= max(1.0, task.settings.side**2 / lit) ** -CELL_SHARE_POWER
    shares, rest = [], 1.0
    for level in range(cells.bit_length() - 1):
        shares.append(rest * (1 - (share if level == 0 else FINER_SHARE)))
        rest -= shares[-1]
    return (*shares, rest)


def coarse_rounds(task: Task, lens: Lens) -> tuple[TubeRound, ...]:
    """Return rounds with few pixels, tubes and variables; () if the light is nearly in place or for several goals.

    If the map has not settled, as for a lamp or a wall close to the lens, light has to move far.  This needs many
    evaluations, each in a thirtieth of the time of a full one; the tubes need not resolve the full net's cells.
    """
    limit = min(max(task.goals[0].screen.shape) - 1, task.settings.side // 2)  # pixels that the net can resolve
    rounds = [TubeRound(task, tubes, count, pixels=pixels) for pixels, tubes, count in COARSE_ROUNDS if pixels <= limit]
    one_round = not task.effort.divides_rounds or not task.settings.stage2_iterations
    if not rounds or one_round or task.merit is not None or task.several:
        return ()  # several goals: two nets would distort between so few tubes
    coarse, tubes = with_pixels(task, LARGE_PIXELS), COARSE_ROUNDS[0][1]
    [goal] = coarse.goals
    far_off = rrmsd_by_tubes(lens.plain(), coarse.channels, goal, n=tubes) > FAR_OFF_RRMSD
    return tuple(rounds) if far_off else ()


def with_pixels(task: Task, pixels: int) -> Task:
    """Return the task with its targets resampled to at most `pixels` along the longer side."""
    return replace(task, goals=tuple(resample(goal, pixels) for goal in task.goals))


def round_shares(task: Task) -> RoundFractions | None:
    """Return the rounds of a task; None: `sheet_sizes` chooses dense, finer or sparse rounds."""
    if not task.effort.divides_rounds:
        return ((1.0, 1.0),)
    if not task.several:
        few = DENSE_ROUNDS[0][0] * task.settings.rays < DENSE_TUBES * task.settings.side  # in the first round
        few = few and task.settings.stage2_iterations <= SHORT_EVALUATIONS
        return SHORT_ROUNDS if few and resolves_net(task) else None
    if len(task.goals) == 1:
        return WAVEFRONT_ROUNDS
    larger = max(1.0, task.settings.side / PICTURES_SIDE)
    return tuple((tubes, larger * share) for tubes, share in PICTURES_ROUNDS)


def resolves_net(task: Task) -> bool:
    """Return True for one goal, no bounds, and a last round with DENSE_TUBES tubes per cell of the net or more.

    Only then L-BFGS moves the shortest waves further (FOUR_POINTS), keeps its pairs from round to round, and ends a
    round early (FEW_TUBES).  Fewer tubes do not correct how this distorts the net between the tubes: a portrait
    with 1025 control points, two tubes per cell, has an RRMSD of 0.022 with all three, and of 0.018 without.
    """
    return task.bounds is None and not task.several and _are_dense(task.settings)


def _are_dense(settings: Settings) -> bool:
    return settings.rays >= DENSE_TUBES * settings.side


def sheet_sizes(settings: Settings, shares: RoundFractions | None = None) -> Iterator[tuple[int, int]]:
    """Yield (tubes per side, evaluations) of each round; tubes: at least min(settings.side, settings.rays)."""
    if shares is None:
        finer = round(FINER_ROUNDS[-1][0] * settings.rays) <= MAX_TUBES
        shares = DENSE_ROUNDS if _are_dense(settings) else FINER_ROUNDS if finer else SPARSE_ROUNDS
    if settings.stage2_iterations < MIN_EVALUATIONS:
        shares = ((1.0, 1.0),)
    for part, share in shares:
        tubes = min(round(part * settings.rays), max(settings.rays, MAX_TUBES))
        yield max(tubes, min(settings.rays, settings.side)), round(share * settings.stage2_iterations)


def run_rounds(rounds: Sequence[TubeRound], lens: Lens, state: TubeSearch | None = None) -> Steps:
    """Yield the steps of a stage, round by round, from its start or from a saved state.

    The stage ends when its evaluations are used up, on a plateau of the last round, or when the RRMSD by rays
    (`Task.rrmsd`) reaches tailoring.accuracy with the source at its full size.
    """
    accuracy, given = rounds[0].task.settings.accuracy or 0.0, Parameters.of(lens)  # 0: no accuracy is required
    first = SearchPosition(0, 0, 0, accuracy, sheet_from=given, search_from=given)
    position = first if state is None else state.position
    total = sum(each.evaluations for each in rounds)
    pairs: Pairs = () if state is None else state.lbfgs.pairs  # steps stored by the last search
    if state is None:
        yield StageStep(lambda: lens)
    for number in range(position.round, len(rounds)):
        this_round, bound_weight = rounds[number], round_weight(number, len(rounds))
        task, part = this_round.task, this_round.name
        if state is None and not (number and this_round.takes_over(rounds[number - 1])):
            pairs = ()
        if state is None:
            end = position.done + this_round.evaluations
            position = replace(position, round=number, round_end=end, sheet_from=Parameters.of(lens))
        if position.round_end <= position.done:
            continue
        sheet_lens, merit = position.sheet_from.apply_to(lens), None
        grazing = None if task.edge is None else Grazing.of(task.edge, sheet_lens)
        while position.done < position.round_end:
            if state is None:
                position = replace(position, search_from=Parameters.of(lens))
            start = position.search_from.apply_to(lens)
            task.tidy()
            # before the sheet, since the variables need much memory
            variables = variables_of(task, start, this_round.pixels, level=this_round.level)
            if merit is None:
                merit = this_round.merit(sheet_lens)
                task.tidy()
            bounds = active_bounds(start, task.bounds, task.min_thickness)
            problem = Problem(start, merit, bounds, bound_weight, grazing=grazing)
            for iterate, step in this_round.run(problem, variables, position, total=total, state=state, pairs=pairs):
                yield replace(step, part=part)
                if iterate.state is not None:
                    pairs = iterate.state.pairs
                if iterate.reason:
                    break
            lens, state, measured = step.lens, None, 0.0  # 0: not measured
            position, reason = replace(position, done=position.done + iterate.best.evaluations), iterate.reason
            if reason == "accuracy" and (measured := task.rrmsd(lens)) > accuracy:
                # goal by tubes, lowered since tubes slightly underestimate the RRMSD
                position = replace(position, goal_by_tubes=position.goal_by_tubes * accuracy / measured)
                reason = "evaluations"  # final reason if no evaluations are left
            elif reason != "evaluations":
                break
        del merit, problem  # free the sheet before the next one is made
        by_rays = (measured or task.rrmsd(lens)) if task.effort.rates_lenses else None
        full = task.channels == rounds[-1].task.channels  # True: the light of the source at full size
        if by_rays is not None and by_rays <= accuracy:
            reason = "accuracy"  # reached according to rays, perhaps not according to tubes
        reason = reason if number == len(rounds) - 1 or (reason == "accuracy" and full) else ""
        yield StageStep(maker(lens), rays_rrmsd=by_rays, at_full_size=full, part=part, ends=True, reason=reason)
        if reason:
            return


def _overshoot_weight(task: Task, lens: Lens) -> float:
    """Return the weight of light outside the target (1 / pixel²), divided by 1 + w² for a source image w pixels wide.

    Within w of the border some light falls outside with any lens, and pulling it inside would blur the edge.
    """
    return task.settings.overshoot / (1 + max(image_widths(task, lens)) ** 2)


def image_widths(task: Task, lens: Lens) -> list[float]:
    """Return the width (pixels) of the image of the source on the receiver of each goal; 0 without extent."""
    if points_per_line(task.channels) == 1:
        return [0.0] * len(task.goals)
    few, light = task.channels, task.heaviest
    if task.extended_sources:
        source = replace(task.extended_sources[-1].source, wavelength=light.source.wavelength)
        few = channels_of(source, lambda _: light.index, SECOND_MOMENT_POINTS)  # with the second moments of the source
    return [images(few, lens, goal.screen, IMAGE_POSITIONS).width() for goal in task.goals]


@dataclass(frozen=True)
class Problem:
    """Merit of stage 2 and its gradients in the heights of all nets, for a fixed sheet of tubes per channel.

    For each tube corner the fused kernels store the landing point and the path length to the face, not the steps of the
    intersection.  They need some 100 bytes of memory per corner, whatever the number of control points.
    """

    lens: Lens
    merit: Merit
    bounds: Bounds | None = None  # bounds on the tailored faces; the excess over them is penalised
    bound_weight: float = 0.0  # weight of this penalty
    grazing: Grazing | None = None  # penalty against total internal reflection

    def __call__(self, heights: Sequence[Tensor]) -> tuple[float, list[Tensor], float]:
        """Return the merit, its gradient in the heights of each net (1/mm), and the RRMSD; heights: by net (mm)."""
        leaves = [h.detach().requires_grad_() for h in heights]
        lens = self.lens.with_heights(leaves)
        merit, rrmsd = self.merit(self.merit.landing(lens))
        gradients = list(torch.autograd.grad(merit, leaves))
        value = float(merit.detach())
        if self.bounds is not None:
            over = excess(lens.plain(), self.bounds)
            if over.mean_square:
                pairs = zip(gradients, over.gradients, strict=True)
                gradients = [g + self.bound_weight * added.to(g) for g, added in pairs]
            value += self.bound_weight * over.mean_square
        if self.grazing is not None:
            penalty, gradient, _ = self.grazing(heights[-1])
            value, gradients[-1] = value + penalty, gradients[-1] + gradient
        return value, gradients, float(rrmsd)


def variables_of(task: Task, lens: Lens, pixels: int | None = None, level: float = math.inf) -> NetVariables:
    """Return the variables of stage 2 for all nets; pixels: cells on a coarser net's longer side; None: no such net.

    level: λ_0 of `SobolevVariable`.
    """
    nets = lens.nets
    if pixels is not None:
        lens = lens.with_nets(net.refined(coarser(net.shape, pixels + 1)) for net in nets)
    source, lens = task.heaviest.source, task.heaviest.through(lens)
    weights = [local_weight(source, lens, task.goals, number) for number in lens.tailored_numbers]
    if pixels is not None:
        each = zip(nets, lens.nets, weights, strict=True)
        return NetVariables(tuple(CoarseVariable.of(*net, precision=torch.float32) for net in each))
    pairs = zip(nets, weights, strict=True)
    blocks = tuple(SobolevVariable.of(net, weight, level=level, precision=torch.float32) for net, weight in pairs)
    if lens.has_two_tailored_faces and len(task.goals) > 1:
        return NetVariables(blocks, *along_light(source, lens, task.goals))
    return NetVariables(blocks)


def minimise_merit(
    lens: Lens, problem: Problem, variables: NetVariables, evaluations: int, state: TubeSearch | None = None,
    pairs: Pairs = (), plateau: Plateau = PLATEAU,
) -> Iterator[Iterate]:  # fmt: skip
    """Run L-BFGS on the heights of all nets, starting from `lens`, in the variables c, one block per net."""
    start = [net.heights for net in lens.nets]

    def in_c(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        heights = _heights_at(start, variables, [c.detach() for c in parameters])
        merit, gradients, rrmsd = problem(heights)
        return merit, variables.adjoint(gradients), rrmsd

    saved = None if state is None else state.lbfgs
    method = lbfgs(variables.zeros(), evaluations, saved, pairs=pairs, plateau=plateau)
    return minimise(in_c, method, evaluations, state.best if state else Best())


def with_best_nets(lens: Lens, variables: NetVariables, best: Best) -> Lens:
    """Return `lens` with the best nets of a search that began at it; `lens` itself if no value was finite."""
    if not best.parameters:
        return lens
    return lens.with_heights(_heights_at([net.heights for net in lens.nets], variables, best.parameters))


def _heights_at(start: Sequence[Tensor], variables: NetVariables, c: Sequence[Tensor]) -> list[Tensor]:
    return [h + change for h, change in zip(start, variables.heights(c), strict=True)]


@dataclass(frozen=True)
class Stage3State:
    """State of stage 3 between two steps of a search."""

    tube_search: TubeSearch


def with_stage3(before: Stage | None, task: Task, lens: Lens, state: Any = None) -> Steps:
    """Yield the steps of stage 3, from its start or from a saved state.

    before: earlier stage, for the centre of the source; None: no such stage.  Its lens is rated with the whole source.
    """
    if before is not None and not isinstance(state, Stage3State):
        for last in before(task, lens, state):
            if last.ends:
                last = replace(last, rays_rrmsd=task.at_full_size.rrmsd(last.lens))
            yield replace(last, reason="")
        lens, state = last.lens, None
    rounds = stage3_rounds(task, lens)
    if task.refines:
        rounds = (replace(rounds[-1], evaluations=refining_evaluations(task.settings)),)
    elif before is None:
        rounds = (*coarse_rounds(task, lens), *rounds)
    for step in run_rounds(rounds, lens, state and state.tube_search):
        yield replace(step, state=step.state and Stage3State(step.state))


def stage3_rounds(task: Task, lens: Lens) -> tuple[TubeRound, ...]:
    """Return the rounds of stage 3, one per entry of SOURCE_SIZES, or one round.

    lens: lens at the start.  Cells narrower than half of the source's image through it are not rated: it blurs them.
    """
    lights = [
        replace(task, channels=channels, sampled_sources=(), extended_sources=(source,))
        for channels, source in zip(task.sampled_sources, task.extended_sources, strict=True)
    ]
    settings, screens = task.settings, [goal.screen for goal in task.goals]
    if not task.effort.divides_rounds:
        source = task.extended_sources[-1]
        return (TubeRound(lights[-1], settings.rays, settings.stage2_iterations, "stage 3", source=source),)
    counts = stage3_sheet_sizes(settings, (max(each.columns for each in screens), max(each.rows for each in screens)))
    cells, seen = finest_cells(task), [width for width in image_widths(lights[-1], lens) if width > 0]  # else no light
    while seen and cells > 1 and cells * min(seen) > 2:
        cells //= 2
    shares = shares_on_cells(task, cells)
    return tuple(
        TubeRound(light, tubes, count, "stage 3", source=light.extended_sources[0], source_size=size, shares=shares)
        for light, (tubes, count), (size, _) in zip(lights, counts, SOURCE_SIZES, strict=True)
    )


def stage3_sheet_sizes(settings: Settings, pixels: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """Yield (tubes per side, evaluations) of each round of stage 3; pixels: columns and rows of the target.

    A sheet of n tubes per side has n √(m_x / m_y) along x and n √(m_y / m_x) along y over a net of m_x x m_y points.
    """
    few = settings.stage2_iterations < MIN_EVALUATIONS
    total = settings.stage2_iterations * (2 if few else 1)  # L-BFGS starts anew in each round
    (m_x, m_y), (columns, rows) = as_pair(settings.levels[-1]), pixels
    oblong = math.sqrt(m_x / m_y)
    for_pixels = TUBES_PER_PIXEL * max(columns / oblong, rows * oblong)
    tubes = min(settings.rays, math.ceil(max(TUBES_PER_CELL * settings.side, for_pixels)))
    for _, share in SOURCE_SIZES:
        yield tubes, round(share * total)


@dataclass(frozen=True)
class PrecisionComparison:
    """Differences between two copies of a lens, one tailored in float32, the other in float64."""

    control_points: int  # control points along the longer side
    merit: float  # difference of the merits at the start, relative to the larger one; 0 if both are 0
    gradient: float  # norm of the difference of the gradients at start, relative to the larger norm; 0 if both are 0
    evaluations: int  # number of evaluations in each precision
    rrmsd_float64: float  # RRMSD at the end of the tailoring in float64; each RRMSD is computed in float64
    rrmsd_float32: float  # RRMSD at the end of the tailoring in float32
    heights: float  # largest difference between the heights of a control point (mm)


def compare_precisions(task: Task, lens: Lens) -> PrecisionComparison:
    """Run a short stage 2 from `lens` in float32 and in float64, with the same tubes and number of evaluations.

    Rounding can change where a line search ends, so the lenses may differ by more than rounding and be equally good.
    """
    lens = lens.with_nets(net.refined(coarser(net.shape, task.effort.compared_net)) for net in lens.nets)
    variables = variables_of(task, lens.to(torch.float64))  # for both: on a target's edge, rounding changes weights
    (merit, gradient, single), (exact_merit, exact_gradient, double) = (
        _tailor_briefly(task, lens.to(d), variables) for d in (torch.float32, torch.float64)
    )
    n, goal = round(side_factor(task.channels) * (task.effort.compared_tubes + 1)), task.goals[0]
    rrmsd = [rrmsd_by_tubes(end, task.channels, goal, n=n) for end in (single, double)]
    pairs = zip(single.nets, double.nets, strict=True)
    return PrecisionComparison(
        control_points=max(max(net.shape) for net in lens.nets),
        merit=_relative(abs(merit - exact_merit), abs(merit), abs(exact_merit)),
        gradient=_relative(*(float(each.norm()) for each in (gradient - exact_gradient, gradient, exact_gradient))),
        evaluations=task.effort.compared_evaluations,
        rrmsd_float64=rrmsd[1],
        rrmsd_float32=rrmsd[0],
        heights=max(float((a.heights - b.heights).abs().max()) for a, b in pairs),
    )


def _relative(difference: float, *sizes: float) -> float:
    """Return a difference divided by the largest of the sizes; 0 if all are 0, as for a picture that the lens makes."""
    return difference / max(sizes) if difference else 0.0


def _tailor_briefly(task: Task, lens: Lens, variables: NetVariables) -> tuple[float, Tensor, Lens]:
    """Return merit and gradient at the start, and the lens after a few evaluations, in the precision of `lens`."""
    n = min(task.effort.compared_tubes, task.settings.rays)
    merit = Merit.of(task.channels, lens, n, task.goals[:1], overshoot=task.settings.overshoot)
    merit = replace(merit, picture_error=task.merit)
    problem = Problem(lens, merit)
    value, gradients, _ = problem([net.heights for net in lens.nets])
    *_, last = minimise_merit(lens, problem, variables, task.effort.compared_evaluations)
    flat = torch.cat([g.reshape(-1).double().cpu() for g in gradients])
    return value, flat, with_best_nets(lens, variables, last.best).plain()
