"""Stage 1 of a lens with two freeform faces: the front sends the light to its points on the back, which turns it.

The rays behind the lens are known (light_behind.py): one through each point t of a target, which traced backwards meets
the back at b(t).  The front has to send the light of t to b(t).  This is a transport problem in slope coordinates as in
slope_map.py, from points q of the front to the slopes p(q, b) that follow from Snell's law,

    y = -(p(q, b) - ∇g(q)),    ∇g(q) ≈ p(q, r(q)) - r(q) ∂p/∂b,

with r the affine map that stretches the light on the front over that on the back, so that y hardly depends on q for a
fixed b.  (The sign: a front turns light against its slope.)  Then the back is fitted to the slopes that turn each
arriving ray into its direction behind the lens.  Such a face exists: if Φ is the eikonal of the rays in the glass and
Φ' that of the rays behind it, each level set of n Φ - Φ' is one.  A new back changes b(t), and so the rounds repeat,
each from the faces and the points of the last round.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from bstcad.optics import sampling
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.emitters import Emitter
from bstcad.optics.kernels.reductions import total
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.rays import Rays
from bstcad.optics.reach import limit_refraction, slopes_towards
from bstcad.scene.quality import COARSEST_GRID
from bstcad.tailoring import stage1
from bstcad.tailoring.light_behind import LightBehind, light_for_task, without_crossings
from bstcad.tailoring.machinability import place_back
from bstcad.tailoring.run import Parameters, StageStep, Task
from bstcad.tailoring.slope_fit import Fit, fit_slopes
from bstcad.tailoring.slope_map import (
    GATHERING_FIT,
    GATHERING_SAMPLES,
    FaceGrid,
    SlopeMap,
    corners_of,
    face_grid,
    fit_gathering,
    fit_to_map,
    lit_window,
    rays_at,
    square_grid,
    transport_slopes,
)
from bstcad.transport.bfm import TransportStep

DIFFERENCE_STEP = 1e-4  # shift of a point for difference quotients of slopes, relative to the thickness
# Number of fine rounds: the last one on the full grid and nets, the others on half of the grid and the second finest
# nets, until both faces fit each other.  (With two, two photographs have 1.5 times the error by blocks of 4 to 32
# pixels.)
FINE_ROUNDS = 4
SETTLED_CHANGE = 0.003  # RMS change of q(t), in half widths of the front, below which the coarse rounds end

Grid = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class FrontRound:
    """State of stage 1 with two freeform faces between two rounds."""

    round: int  # number of rounds done
    lens: Parameters
    wanted: SlopeMap  # map of the front; its places are q(t) (mm) for the rays behind the lens
    back: Grid  # points b(t) (mm) of the back for the pixel corners of the first target


def steps(task: Task, lens: Lens, state: FrontRound | None = None) -> Iterator[StageStep]:
    """Yield the steps of stage 1 for a lens with a freeform front, from its start or from a saved state on.

    With one goal, or if light does not cross both faces in succession, stage 1 tailors the last net alone (stage1.py).
    """
    lens = task.heaviest.through(lens)
    if not (lens.shapes_two_faces and task.several):
        alone = replace(task.refined(lens, task.knobs.levels[-1]), shaped=lens.freeform[-1:])
        yield from stage1.steps(task, alone, state)
        return
    for last in follow_rays(task, lens, state):
        yield last
    if not task.preview:
        yield replace(last, state=None, rays_rrmsd=task.rrmsd(last.lens))


def follow_rays(task: Task, lens: Lens, state: FrontRound | None) -> Iterator[StageStep]:
    """Yield a step per round; all but FINE_ROUNDS use coarse grids and nets, and end once the map settles."""
    task = task.with_imaged_receivers(lens)
    knobs, z, done, wanted = task.knobs, lens.back.z, 0, None
    near = min(task.goals, key=lambda goal: goal.receiver.plane.throw(0.0))
    light = light_for_task(task)
    light = without_crossings(light, near.receiver, lens.back, knobs.transport_grid)
    if state is not None:
        lens, done, wanted, b = state.lens.apply_to(lens), state.round, state.wanted, state.back
    turn = min(done, knobs.rounds - 1)
    while turn < knobs.rounds:
        if turn >= done:
            left = knobs.rounds - turn
            fine = left <= FINE_ROUNDS
            halvings = 0 if left == 1 else 1 if fine else 2
            cells = max(COARSEST_GRID, knobs.transport_grid // 2**halvings)
            level = knobs.levels[max(-1 - halvings, -len(knobs.levels))] if fine else knobs.levels[0]
            lens = task.refined(lens, level)
            fit = stage1.FINE_FACE_FIT if fine else stage1.COARSE_FACE_FIT
            places = None if wanted is None else wanted.places
            lens, wanted, b = _round(task, lens, light, places, turn=turn, cells=cells, fit=fit)
            lens = place_back(lens, z, task.min_thickness, task.bounds)
            task.tidy()
        turn = max(turn + 1, knobs.rounds - FINE_ROUNDS if wanted.moved <= SETTLED_CHANGE else 0)
        yield StageStep(
            partial(task.refined, lens, knobs.levels[-1]), FrontRound(turn, Parameters.of(lens), wanted, b),
            mapping=wanted.mapping, places=b, progress=("stage 1", turn, knobs.rounds, ""),
        )  # fmt: skip


def _round(
    task: Task, lens: Lens, light: LightBehind, places: Grid | None, *, turn: int, cells: int, fit: tuple[Fit, float]
) -> tuple[Lens, SlopeMap, Grid]:
    """Run one round; return the lens, the map of its front, and b(t) for the pixel corners of the first target."""
    source, front = task.heaviest.source, lens.shaping("front")
    window, back = lit_window(source, front), light.intersect(lens.back)
    through = light.sampled_at(task.goals[0].receiver, back[:2])

    def progress(s: TransportStep) -> None:
        task.progress("stage 1", turn, task.knobs.rounds, f"{s.grid}² cells, mass error {s.mass_error:.4f}")

    wanted = front_map(
        source, front, window, light.picture, back=back, n=cells, places=places,
        iterations=task.knobs.transport_iterations, progress=progress,
    )  # fmt: skip
    own = [min(2 * max(net.shape), task.knobs.rays) for net in lens.nets]
    lens = lens.with_front(fit_to_map(front, wanted, face_grid(source, front, window, own[0]), *fit).front)
    window = lit_window(source, lens)
    grid = face_grid(source, lens, window, own[-1])
    law = lens.last_freeform.law
    out = light.directions_at(lens.back, *sampling.grid(window, grid.shape))
    slopes = limit_refraction(grid.at_face, slopes_towards(grid.at_face, out, law), law)
    x, y = (p.reshape(-1) for p in sampling.grid(window, grid.shape))
    back, lit, (how, unlit) = lens.back_net, (grid.density > 0).reshape(-1), fit
    _, *own = back.relative_sag_and_slope(x, y)
    z_x, z_y = (torch.where(lit, z.reshape(-1).to(x), now) for z, now in zip(slopes, own, strict=True))
    fitted = fit_slopes(back, x, y, z_x=z_x, z_y=z_y, weight=torch.where(lit, 1.0, unlit).to(x), fit=how)
    return lens.with_back(fitted.from_vertex().moved(back.z)), wanted, tuple(through)


def front_map(
    source: Emitter, lens: Lens, window: Rectangle, picture: np.ndarray, back: np.ndarray, n: int,
    places: Grid | None, **solver,
) -> SlopeMap:  # fmt: skip
    """Return the map of the front that sends the light to its points on the back, by transport on n x n cells.

    lens: the lens with only its front free.  picture: (r, c) flux between each four rays, row 0 = y max.
    back: (3, c + 1, r + 1) points b of the rays (mm).  places: their q in the last round; None: r inverted.
    The `places` of the result are the new q.
    """
    grid, lit = square_grid(source, lens, window, n), corners_of(picture)
    low, high = (np.array([f(p[lit]) for p in back[:2]]) for f in (np.min, np.max))
    stretch, shift = (high - low) / (window.width, window.height), (low + high) / 2
    if places is None:
        half = grid.window.width / 2
        places = tuple(np.clip((p - s) / k, -half, half) for p, s, k in zip(back[:2], shift, stretch, strict=True))
    aims = torch.from_numpy(back)
    net = _gathering(grid, lens, aims, stretch=stretch, shift=shift)
    needed = _slopes_at(rays_at(grid, places), aims, lens)
    return transport_slopes(grid, picture, net, needed, places=places, sign=-1.0, n=n, **solver)


def _slopes_at(rays: Rays, aims: Tensor, lens: Lens) -> tuple[Tensor, Tensor]:
    """Return the slopes of the front that send rays to points (3, …) mm in space."""
    path = aims - _in_space(rays)
    return slopes_towards(rays, path / torch.sqrt((path * path).sum(0)), lens.last_freeform.law)


def _in_space(rays: Rays) -> Tensor:
    return torch.stack([*rays.position[:2], rays.above(0.0)])


def _gathering(grid: FaceGrid, lens: Lens, back: Tensor, stretch: np.ndarray, shift: np.ndarray) -> BSplineSurface:
    """Return g of the module's docstring, a net of GATHERING_NET points a side over the lit part of a grid."""
    thin = tuple(slice(step // 2, None, step) for step in (max(1, n // GATHERING_SAMPLES) for n in grid.shape))
    faces = replace(grid.at_face, **{k: getattr(grid.at_face, k)[(..., *thin)] for k in ("position", "direction")})
    x, y, z = _in_space(faces).cpu().double()
    height = float(total(back[2]) / back[2].numel())
    reference = torch.stack([stretch[0] * x + shift[0], stretch[1] * y + shift[1], torch.full_like(x, height)])
    lit = grid.density[thin] > 0
    z_x, z_y = _slopes_at(faces, reference, lens)
    step = DIFFERENCE_STEP * (height - float(total(z) / z.numel()))
    quotient = 0.0
    for axis, slope in enumerate((z_x, z_y)):  # ∂p/∂b, one number: its mean over the light
        nudge = torch.zeros((3, 1, 1), dtype=reference.dtype)
        nudge[axis] = step
        shifted = _slopes_at(faces, reference + nudge, lens)[axis]
        quotient += float(total((shifted - slope)[lit]) / lit.sum()) / (2 * step)
    wanted = (p - r * quotient for p, r in zip((z_x, z_y), reference[:2], strict=True))
    return fit_gathering(grid, (x, y, *wanted, lit), GATHERING_FIT)
