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
from bstcad.optics.sources import Point, Source
from bstcad.optics.surfaces import Sphere
from bstcad.optics.trace import into_glass, trace
from bstcad.quality import Tailoring
from bstcad.scene import Scene
from bstcad.tailoring import aim, paper, stage1, stage2
from bstcad.tailoring.curvature import best_curvature
from bstcad.tailoring.merit import IrradianceMerit, landing
from bstcad.tailoring.minimise import BestSoFar
from bstcad.transport.mapping import Mapping

if TYPE_CHECKING:
    import cadquery

COARSE_TURNS = 2  # of map and coarse fit, until what gets through the lens is known
FEEDBACK_COARSER = 4  # the feedback's transport grid, against the map's: it corrects distortions, not details
FEW = 0.4  # share of stage 2's evaluations done with a quarter of the rays
SPARE = 1.02  # tailoring traces this much more than what gets through now, each way

Progress = Callable[[str, int, int, str], None]  # stage, done, total, text


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
    """From a scene to a tailored lens: transport map, stage 1, feedback, stage 2."""
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


def find_map(task: Task, lens: Lens, n: int) -> Mapping:
    """The transport map for what gets through `lens`, on n x n cells."""
    knobs, report = task.knobs, task.log.progress

    def step(s) -> None:
        report("transport", s.iteration, knobs.transport_iterations, f"{s.grid}² cells, mass error {s.mass_error:.4f}")

    return aim.map_to_target(task.source, lens, task.target, task.screen, n, knobs.transport_iterations, step)


@dataclass(frozen=True)
class Grid:
    """Rays through the cell centres of the clear part of the front's vertex plane: what stage 1 works with."""

    x: torch.Tensor  # (n, n) mm, on that plane
    y: torch.Tensor
    rays: Rays

    @classmethod
    def of(cls, task: Task, lens: Lens) -> Grid:
        """Two rays a control cell each way: with one, the fit of the slopes has a checkerboard null space."""
        area, n = clear_window(task.source, lens), 2 * lens.back.m
        like = {"dtype": lens.back.heights.dtype, "device": lens.back.heights.device}
        x, y = (t.to(**like) for t in sampling.grid(area, n))
        return cls(x, y, task.source.rays(x, y, lens.front.z, area.area / n**2))


# ---- quality draft, standard, fine -----------------------------------------------------------------------------------


def by_least_squares(task: Task, lens: Lens) -> tuple[Lens, Mapping]:
    """Stage 1 as least squares, transport feedback, stage 2 in the Sobolev variable."""
    lens = coarse_lens(task, lens)
    mapping = find_map(task, lens, task.knobs.transport_grid)
    task.log.end("transport")
    lens = follow(task, lens, mapping)
    task.log.end("stage 1", task.rrmsd(lens))
    if task.knobs.feedback:
        lens = feedback(task, lens)
    return refine_irradiance(task, lens), mapping


def coarse_lens(task: Task, lens: Lens) -> Lens:
    """What gets through a lens with a point source depends on the lens: go round on the coarsest net until it is known.

    Here the curvature of a spherical front is found too.
    """
    if not isinstance(task.source, Point):
        return lens
    n = max(64, task.knobs.transport_grid // 4)
    for turn in range(COARSE_TURNS):
        mapping = find_map(task, lens, n)
        if turn == 0 and isinstance(lens.front, Sphere) and lens.front.optimise:
            lens = best_curvature(lambda tried, mapping=mapping: landing_merit(task, tried, mapping), lens)
            mapping = find_map(task, lens, n)
        lens = fit(task, lens, mapping, task.knobs.stage1_iterations)
    return lens


def landing_merit(task: Task, lens: Lens, mapping: Mapping) -> float:
    """Mean squared miss (mm²) of the best back face that goes with this front."""
    lens = fit(task, lens, mapping, task.knobs.stage1_iterations)
    grid = Grid.of(task, lens)
    wanted = aim.aim_points(mapping, grid.x, grid.y)
    return float(landing(trace(grid.rays, lens, task.screen.z), wanted))


def fit(task: Task, lens: Lens, mapping: Mapping, repeats: int) -> Lens:
    """The back face that follows the map, on the net it has."""
    grid = Grid.of(task, lens)
    wanted = aim.aim_points(mapping, grid.x, grid.y)
    return stage1.tailor_to_map(lens, grid.rays, wanted, task.screen.z, repeats)


def follow(task: Task, lens: Lens, mapping: Mapping) -> Lens:
    """Stage 1 on ever finer nets; the finer ones start so close that two repeats are enough."""
    levels = task.knobs.levels
    for done, m in enumerate(levels):
        task.log.progress("stage 1", done, len(levels), f"{m} control points")
        lens = replace(lens, back=stage1.refine(lens.back, m))
        lens = fit(task, lens, mapping, task.knobs.stage1_iterations if done == 0 else 2)
    task.log.progress("stage 1", len(levels), len(levels), "")
    return lens


def feedback(task: Task, lens: Lens) -> Lens:
    """Move the aim points by the small transport from the simulated to the wanted picture, as long as that helps."""
    knobs, log = task.knobs, task.log
    best = log.stages[-1].rrmsd
    n = max(64, knobs.transport_grid // FEEDBACK_COARSER)
    for turn in range(knobs.feedback):
        log.progress("feedback", turn, knobs.feedback, f"RRMSD {best:.4f}")
        grid = Grid.of(task, lens)
        wanted = aim.correct(task.source, lens, grid.rays, task.target, task.screen, n, knobs.seed + turn, lambda _: None)
        tried = stage1.tailor_to_map(lens, grid.rays, wanted, task.screen.z, 2)
        found = task.rrmsd(tried)
        log.note(min(found, best))
        if not found < best:
            break
        lens, best = tried, found
    log.progress("feedback", knobs.feedback, knobs.feedback, f"RRMSD {best:.4f}")
    log.end("feedback", best)
    return lens


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
    mapping = find_map(task, lens, knobs.transport_grid)
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
