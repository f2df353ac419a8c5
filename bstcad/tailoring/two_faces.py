"""Stage 1 of a lens with two freeform faces: the front sends each ray to a prescribed point of the back.

The back deflects the ray into its prescribed direction.  These rays behind the lens are known (light_behind.py): the
ray through a point t of a target, traced backwards, meets the back at b(t).  The front has to send the light of t to
b(t).  This is a transport problem in slope coordinates as in slope_map.py, from points q of the front to the slopes
p(q, b) that follow from Snell's law,

    y = -(p(q, b) - ∇g(q)),    ∇g(q) ≈ p(q, r(q)) - r(q) ∂p/∂b,

where ∂p/∂b is a number and r the affine map from the light on the front to the light on the back, so that y hardly
depends on q for a fixed b.  (The minus sign: light that enters glass is deflected against the slope of the face.)  Then
the back is fitted to the slopes that deflect each ray into its direction behind the lens.  Such a face exists.  Let Φ
and Φ' be the optical paths along the rays in the glass and behind the lens, with |∇Φ| = n and |∇Φ'| = 1.  By Snell's
law a face with normals along ∇(Φ - Φ') deflects these rays as required, so each surface Φ - Φ' = const is a solution.
A new back changes b(t), and so there are several rounds, each from the faces and the points of the last round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import FRONT
from bstcad.optics.numerics.reductions import total
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.rays import Rays
from bstcad.optics.trace.reach import limit_refraction, slopes_towards
from bstcad.tailoring import slope_map, stage1
from bstcad.tailoring.driver import Parameters, Steps, Task
from bstcad.tailoring.effort import GATHERING
from bstcad.tailoring.light_behind import LightBehind, light_for_task, without_crossings
from bstcad.tailoring.machinability import place_back
from bstcad.tailoring.slope_fit import Fit, fit_slopes
from bstcad.tailoring.slope_map import FaceGrid, SlopeMap, Slopes
from bstcad.transport.bfm import TransportStep
from bstcad.transport.mapping import Points, Solver

POINT_SHIFT = 1e-4  # shift of a point of the back for difference quotients of slopes, relative to the thickness
# Number of fine rounds: the last one has the full grid and nets, the others have half as many cells per side and the
# second finest nets.  Several rounds are needed until the faces fit each other.  (With two, the errors of two
# photographs, averaged over blocks of 4 to 32 pixels, are 1.5 times larger.)
FINE_PAIR_ROUNDS = 4
SETTLED_FRONT = 0.003  # largest `SlopeMap.moved` (relative RMS change of q(t)) at which the coarse rounds end


@dataclass(frozen=True)
class FrontRound(stage1.SlopeRound):
    """State between two rounds of stage 1 for two freeform faces.

    `slopes` is the map of the front; its face points are q(t) (mm), where the rays through t meet the front.
    """

    back: Points  # points b(t) (mm) of the back for the pixel corners of the first target


def steps(task: Task, lens: Lens, state: stage1.SlopeRound | None = None) -> Steps:
    """Yield the steps of stage 1 for a lens with a freeform front, from its start or from a saved state.

    For a single picture without a wavefront, or if light does not cross front and back in succession, stage 1 tailors
    only the last net (stage1.py).
    """
    lens = task.heaviest.through(lens)
    if not (lens.has_two_tailored_faces and task.several):
        alone = replace(task.refined(lens, task.settings.levels[-1]), tailored=lens.tailored_numbers[-1:])
        yield from stage1.steps(task, alone, state)
        return
    for last in follow_rays(task, lens, state if isinstance(state, FrontRound) else None):
        yield last
    if task.effort.rates_lenses:
        yield replace(last, state=None, rays_rrmsd=task.rrmsd(last.lens))


def follow_rays(task: Task, lens: Lens, state: FrontRound | None) -> Steps:
    """Yield a step per round: coarse rounds until the map has settled, then FINE_PAIR_ROUNDS fine ones."""
    task = task.with_imaged_receivers(lens)
    settings, z = task.settings, lens.back.z
    near = min(task.goals, key=lambda goal: goal.screen.receiver.throw(0.0))
    light = without_crossings(light_for_task(task), near.screen, lens.back, settings.transport_grid)
    slopes, b, done = (None, None, 0) if state is None else (state.slopes, state.back, state.round)
    lens = lens if state is None else state.lens.apply_to(lens)
    number = min(done, settings.rounds - 1)
    while number < settings.rounds:
        if slopes is None or b is None or number >= done:
            left = settings.rounds - number
            fine = left <= FINE_PAIR_ROUNDS
            halvings = 0 if left == 1 else 1 if fine else 2
            cells = max(task.effort.coarsest_grid, settings.transport_grid // 2**halvings)
            level = settings.levels[max(-1 - halvings, -len(settings.levels))] if fine else settings.levels[0]
            lens = task.refined(lens, level)
            fit = stage1.FINE_FACE_FIT if fine else stage1.COARSE_FACE_FIT
            q = None if slopes is None else slopes.face_points
            lens, slopes, b = _round(task, lens, light, q, number=number, cells=cells, fit=fit)
            lens = place_back(lens, z, task.min_thickness, task.bounds)
            task.tidy()
        settled = slopes.moved <= SETTLED_FRONT
        number = stage1.next_round(number, settings.rounds, fine=FINE_PAIR_ROUNDS, settled=settled)
        yield stage1.round_step(task, lens, FrontRound(number, Parameters.of(lens), slopes, b), b)


def _round(
    task: Task, lens: Lens, light: LightBehind, q: Points | None, *, number: int, cells: int, fit: Fit
) -> tuple[Lens, SlopeMap, Points]:
    """Run a round; return the lens, the map of its front, and b(t) for the pixel corners of the first target."""
    source, front = task.heaviest.source, lens.with_tailored(FRONT)
    window, met = slope_map.lit_window(source, front), light.intersect(lens.back)
    b_x, b_y = light.sampled_at(task.goals[0].screen, met[:2])

    def progress(s: TransportStep) -> None:
        task.progress("stage 1", number, task.settings.rounds, f"{s.grid}² cells, mass error {s.mass_error:.4f}")

    grid = slope_map.square_grid(source, front, window, cells)
    solver = Solver(task.settings.transport_iterations, progress=progress)
    slopes = front_map(front, grid, window, light.picture, b=met, q=q, solver=solver)
    front_side, back_side = (min(2 * max(net.shape), task.settings.rays) for net in lens.nets)
    grid = slope_map.face_grid(source, front, window, front_side)
    lens = lens.with_front(slope_map.fit_to_map(front, slopes, grid, fit).front)
    window = slope_map.lit_window(source, lens)
    grid = slope_map.face_grid(source, lens, window, back_side)
    law = lens.last_tailored.law
    out = light.directions_at(lens.back, *sampling.grid(window, grid.shape))
    needed = limit_refraction(grid.at_face, slopes_towards(grid.at_face, out, law), law)
    x, y = (p.reshape(-1) for p in sampling.grid(window, grid.shape))
    back, lit = lens.back_net, (grid.density > 0).reshape(-1)
    _, *present = back.relative_sag_and_slope(x, y)
    z_x, z_y = (torch.where(lit, z.reshape(-1).to(x), now) for z, now in zip(needed, present, strict=True))
    fitted = fit_slopes(back, x, y, z_x=z_x, z_y=z_y, weight=torch.where(lit, 1.0, fit.unlit).to(x), fit=fit)
    return lens.with_back(fitted.from_vertex().moved(back.z)), slopes, (b_x, b_y)


def front_map(
    lens: Lens, grid: FaceGrid, window: Rectangle, picture: np.ndarray, b: np.ndarray, q: Points | None, solver: Solver
) -> SlopeMap:
    """Return the map of the front that sends the light to its points on the back, by optimal transport.

    lens: only its front is freeform.  grid: `square_grid` of its lit `window`.  picture: (r, c) flux of each tube,
    between four rays, row 0 = y max.  b: (3, c + 1, r + 1) points where these rays meet the back (mm).  q: points
    where they meet the front (mm) in the last round; None: by the inverse affine map.  The result contains the new q.
    """
    lit = slope_map.lit_corners(picture)
    low, high = (np.array([f(p[lit]) for p in b[:2]]) for f in (np.min, np.max))
    stretch, shift = (high - low) / (window.width, window.height), (low + high) / 2
    if q is None:
        half = grid.window.width / 2
        q_x, q_y = (np.clip((p - s) / k, -half, half) for p, s, k in zip(b[:2], shift, stretch, strict=True))
        q = q_x, q_y
    aims = torch.from_numpy(b)
    g = _gathering(grid, lens, aims, stretch=stretch, shift=shift)
    needed = _slopes_at(slope_map.rays_at(grid, q), aims, lens)
    return slope_map.transport_slopes(grid, picture, g, needed, points=q, sign=-1.0, solver=solver)


def _slopes_at(rays: Rays, aims: Tensor, lens: Lens) -> Slopes:
    """Return the slopes of the front that send rays to points (3, …) mm in space."""
    path = aims - _in_space(rays)
    return slopes_towards(rays, path / torch.sqrt((path * path).sum(0)), lens.last_tailored.law)


def _in_space(rays: Rays) -> Tensor:
    return torch.stack([*rays.position[:2], rays.above(0.0)])


def _gathering(grid: FaceGrid, lens: Lens, back: Tensor, stretch: np.ndarray, shift: np.ndarray) -> BSplineSurface:
    """Return g (see the module) fitted to the lit part of a grid; back: b (3, …) mm; r(q) = stretch q + shift."""
    few = grid.thinned(GATHERING.samples)
    x, y, z = _in_space(few.at_face).cpu().double()
    height = float(total(back[2]) / back[2].numel())
    r = torch.stack([stretch[0] * x + shift[0], stretch[1] * y + shift[1], torch.full_like(x, height)])
    p, lit = _slopes_at(few.at_face, r, lens), few.density > 0
    step = POINT_SHIFT * (height - float(total(z) / z.numel()))
    quotient = 0.0
    for axis in (0, 1):  # ∂p/∂b as one number, the mean over the light
        nudge = torch.zeros((3, 1, 1), dtype=r.dtype)
        nudge[axis] = step
        shifted = _slopes_at(few.at_face, r + nudge, lens)[axis]
        quotient += float(total((shifted - p[axis])[lit]) / lit.sum()) / (2 * step)
    return slope_map.fit_gathering(few, (p[0] - r[0] * quotient, p[1] - r[1] * quotient), GATHERING.fit)
