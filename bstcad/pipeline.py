"""design(scene): the stages in order and nothing else."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from bstcad.optics import sampling
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.irradiance import Screen, rrmsd
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.rays import Rays
from bstcad.optics.simulation import Simulation, clear_window, launch, simulate, window
from bstcad.optics.sources import Source
from bstcad.optics.surfaces import Sphere
from bstcad.optics.trace import into_glass, trace
from bstcad.quality import Tailoring
from bstcad.scene import Scene
from bstcad.sentences import SceneError
from bstcad.tailoring import aim, paper, stage2
from bstcad.tailoring.curvature import best_curvature
from bstcad.tailoring.merit import IrradianceMerit, landing
from bstcad.tailoring.minimise import BestSoFar
from bstcad.tailoring.slope_map import SlopeMap, back_grid, follow, lit_window, slope_map
from bstcad.tailoring.stage1 import refine, tailor_to_aim
from bstcad.transport.mapping import Mapping
from bstcad.verify.shape import describe

if TYPE_CHECKING:
    import cadquery

FEW = 0.4  # share of stage 2's evaluations done with a quarter of the rays
SPARE = 1.02  # tailoring traces this much more than what gets through now, each way

Progress = Callable[[str, int, int, str], None]  # stage, done, total, text


def quiet(step: object) -> None:
    """A transport progress that says nothing."""


def silent(stage: str, done: int, total: int, text: str) -> None:
    """A progress that says nothing."""


@dataclass(frozen=True)
class Stage:
    """How one stage went."""

    name: str
    seconds: float
    rrmsd: float | None  # by the tent, after it


@dataclass
class Log:
    """The clock of a design: what took how long, and how the RRMSD fell."""

    progress: Progress
    began: float = field(default_factory=time.perf_counter)
    stages: list[Stage] = field(default_factory=list)
    history: list[tuple[float, float]] = field(default_factory=list)  # (seconds since the start, RRMSD by the tent)
    skipped: int = 0  # steps left out because their gradient was not finite

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.perf_counter() - self.began

    def note(self, value: float) -> None:
        """One point of the history."""
        self.history.append((self.seconds, value))

    def end(self, name: str, value: float | None = None) -> None:
        """A stage ends; its time runs from the end of the one before."""
        spent = sum(stage.seconds for stage in self.stages)
        self.stages.append(Stage(name, self.seconds - spent, value))
        if value is not None:
            self.note(value)


@dataclass(frozen=True)
class Design:
    """A tailored lens and how it was found."""

    scene: Scene
    lens: Lens  # float64, on the CPU
    target: np.ndarray  # (pixels, pixels), row 0 = y max, sum 1
    mapping: Mapping  # the transport map that stage 1 aimed at
    stages: tuple[Stage, ...]
    history: tuple[tuple[float, float], ...]
    skipped_steps: int
    device: str

    def solid(self) -> cadquery.Solid:
        """The exact solid, for cadquery."""
        from bstcad.cad.solid import lens_solid

        return lens_solid(self.lens)


@dataclass(frozen=True)
class Task:
    """What the stages share."""

    source: Source
    screen: Screen
    target: np.ndarray
    knobs: Tailoring
    log: Log

    def simulate(self, lens: Lens) -> Simulation:
        """The lens's irradiance by as many rays as stage 2 uses, but others."""
        return simulate(self.source, lens, self.screen, self.knobs.rays, self.knobs.seed + 1)

    def merit(self) -> IrradianceMerit:
        """What stage 2 makes small."""
        return IrradianceMerit.of(self.screen, torch.from_numpy(self.target), self.knobs.overshoot)

    def rrmsd(self, lens: Lens) -> float:
        """RRMSD by the tent."""
        return float(rrmsd(self.simulate(lens).tent, torch.from_numpy(self.target).to(lens.back.heights.device)))


def design(scene: Scene, *, device: str = "auto", progress: Progress = silent) -> Design:
    """From a scene to a tailored lens: transport map, stage 1, stage 2."""
    torch.manual_seed(scene.tailoring.seed)
    device = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    target = scene.target
    knobs = scene.tailoring.resolved(scene.lens.back.control_points)
    screen = Screen(target.z, target.x, target.y, target.pixels)
    task = Task(scene.source, screen, target.irradiance(), knobs, Log(progress))
    lens = blank(scene, knobs.levels[0], getattr(torch, knobs.precision), device)
    task.log.end("picture")
    lens, mapping = (by_the_paper if knobs.method == "adam" else by_least_squares)(task, lens)
    lens = replace(lens, back=lens.back.to(torch.float64, "cpu"))
    if isinstance(lens.front, Sphere):
        lens = replace(lens, front=replace(lens.front, curvature=float(lens.front.curvature)))
    log = task.log
    return Design(scene, lens, task.target, mapping, tuple(log.stages), tuple(log.history), log.skipped, device)


def blank(scene: Scene, m: int, dtype: torch.dtype, device: str) -> Lens:
    """The lens before tailoring: a flat net of m x m control points.

    The net of a round lens reaches two spans past the rim, where x(t) is linear.
    """
    outline = scene.lens.outline
    reach = (m - 1) / (m - 5) if isinstance(outline, Circle) else 1.0
    half_x, half_y = (reach * half for half in outline.half_extent)
    heights = torch.zeros((m, m), dtype=dtype, device=device)
    back = BSplineSurface(scene.lens.back.z, heights, (-half_x, half_x), (-half_y, half_y))
    return Lens(scene.lens.front, back, outline, scene.index)


# ---- quality draft, standard, fine -----------------------------------------------------------------------------------


def by_least_squares(task: Task, lens: Lens) -> tuple[Lens, Mapping]:
    """Stage 1: rounds of transport in slope coordinates and least squares; stage 2 in the Sobolev variable."""
    if isinstance(lens.front, Sphere) and lens.front.optimise:
        lens = curved_front(task, lens)
    lens, wanted = follow_slopes(task, lens)
    task.log.end("stage 1", task.rrmsd(lens))
    check_thickness(lens)
    return refine_irradiance(task, lens), wanted.mapping


def follow_slopes(task: Task, lens: Lens) -> tuple[Lens, SlopeMap]:
    """Rounds of transport map and slope fit: each starts from the sag and the map of the one before.

    All but the last two work on coarse grids and nets, where they cost next to nothing.
    """
    knobs, log = task.knobs, task.log
    wanted = None
    for turn in range(knobs.rounds):
        left = knobs.rounds - turn
        coarse = max(64, knobs.transport_grid // 2 ** min(left - 1, 2))
        m = knobs.levels[-1] if left <= 2 else knobs.levels[0]

        def step(s, turn: int = turn) -> None:
            log.progress("stage 1", turn, knobs.rounds, f"{s.grid}² cells, mass error {s.mass_error:.4f}")

        lens = replace(lens, back=refine(lens.back, m))
        wanted = slope_map(
            task.source, lens, task.target, task.screen, coarse, wanted,
            iterations=knobs.transport_iterations, progress=step,
        )  # fmt: skip
        lens = follow(lens, wanted, back_grid(task.source, lens, lit_window(task.source, lens), 2 * m))
    log.progress("stage 1", knobs.rounds, knobs.rounds, "")
    return lens, wanted


def curved_front(task: Task, lens: Lens) -> Lens:
    """The front curvature with which the seed's own map comes nearest to what a surface can do, on the coarsest net.

    Its merit is the seed's for stage 1, the mean squared miss of the aim points, with the best back for each curvature.
    """
    coarse = replace(lens, back=refine(lens.back, task.knobs.levels[0]))
    mapping = aim.map_to_target(task.source, coarse, task.target, task.screen, 64, task.knobs.transport_iterations, quiet)
    area, n = clear_window(task.source, coarse), 2 * coarse.back.m
    x, y = (t.to(lens.back.heights) for t in sampling.grid(area, n))
    rays = task.source.rays(x, y, lens.front.z, area.area / n**2)
    wanted = aim.aim_points(mapping, x, y)

    def miss(tried: Lens) -> float:
        return float(landing(trace(rays, tailor_to_aim(tried, rays, wanted, task.screen.z), task.screen.z), wanted))

    return replace(lens, front=best_curvature(miss, coarse).front)


def check_thickness(lens: Lens) -> None:
    """A lens whose back crosses its front is refused before the long stage; SceneError says by how much."""
    thinnest = describe(replace(lens, back=lens.back.to(torch.float64, "cpu")))["thickness_min"]
    if not thinnest > 0:
        raise SceneError(
            f"lens.front.z: the back that this target needs would cross the front by {-thinnest:.3g} mm; "
            f"lower the front by more than that, move the target's light apart or make the lens smaller"
        )


def refine_irradiance(task: Task, lens: Lens) -> Lens:
    """Stage 2: a first round with few rays, where most is won, and a second with all of them."""
    knobs, log = task.knobs, task.log
    rounds = [(n, share) for n, share in ((knobs.rays // 2, FEW), (knobs.rays, 1 - FEW))]
    done = 0
    for turn, (n, share) in enumerate(rounds):
        evaluations = round(share * knobs.stage2_iterations)
        if evaluations == 0:
            continue

        def report(state: BestSoFar, before: int = done) -> None:
            now = min(before + state.evaluations, knobs.stage2_iterations)
            log.progress("stage 2", now, knobs.stage2_iterations, f"RRMSD {state.rrmsd:.4f}")
            log.note(state.rrmsd)

        problem = stage2.Problem(lens, bundle(task, lens, n, knobs.seed + turn), task.merit())
        lens, best = stage2.tailor_to_irradiance(lens, problem, evaluations, report)
        log.skipped += best.skipped
        done += evaluations
    log.end("stage 2", task.rrmsd(lens))
    return lens


def bundle(task: Task, lens: Lens, n: int, seed: int) -> Rays:
    """n x n stratified rays that get (nearly) through, just behind the front face."""
    whole, clear = window(task.source, lens), clear_window(task.source, lens)
    area = Rectangle(min(SPARE * clear.width, whole.width), min(SPARE * clear.height, whole.height))
    return into_glass(launch(task.source, lens, n, seed, area), lens)


# ---- quality paper ---------------------------------------------------------------------------------------------------


def by_the_paper(task: Task, lens: Lens) -> tuple[Lens, Mapping]:
    """The seed's procedure: Adam in both stages, random rays in the second."""
    knobs, log = task.knobs, task.log

    def step(s) -> None:
        log.progress("transport", s.iteration, knobs.transport_iterations, f"mass error {s.mass_error:.4f}")

    mapping = aim.map_to_target(
        task.source, lens, task.target, task.screen, knobs.transport_grid, knobs.transport_iterations, step
    )
    log.end("transport")
    area = clear_window(task.source, lens)
    like = {"dtype": lens.back.heights.dtype, "device": lens.back.heights.device}
    x, y = (t.to(**like) for t in sampling.grid(area, knobs.rays))
    rays = task.source.rays(x, y, lens.front.z, area.area / knobs.rays**2)
    total = knobs.stage1_iterations * len(knobs.levels)

    def stage1_report(state: BestSoFar, level: int) -> None:
        done = level * knobs.stage1_iterations + state.evaluations
        log.progress("stage 1", done, total, f"landing error {state.merit**0.5:.3f} mm RMS")

    wanted = aim.aim_points(mapping, x, y)
    lens = paper.tailor_to_map(
        lens, rays, wanted, task.screen.z, knobs.levels, knobs.stage1_iterations, stage1_report
    )
    log.end("stage 1", task.rrmsd(lens))

    def stage2_report(state: BestSoFar) -> None:
        log.progress("stage 2", state.evaluations, knobs.stage2_iterations, f"RRMSD {state.rrmsd:.4f}")
        log.note(state.rrmsd)

    seeds = itertools.count(knobs.seed + 2)
    bundles = (random_bundle(task, lens, area, knobs.rays**2, seed) for seed in seeds)
    lens, best = paper.tailor_to_irradiance(lens, bundles, task.merit(), knobs.stage2_iterations, stage2_report)
    log.skipped += best.skipped
    log.end("stage 2", task.rrmsd(lens))
    return lens, mapping


def random_bundle(task: Task, lens: Lens, area: Rectangle, count: int, seed: int) -> Rays:
    """`count` independent random rays through the clear part of the vertex plane."""
    like = {"dtype": lens.back.heights.dtype, "device": lens.back.heights.device}
    x, y = (t.to(**like) for t in sampling.random(area, count, seed))
    return task.source.rays(x, y, lens.front.z, area.area / count)
