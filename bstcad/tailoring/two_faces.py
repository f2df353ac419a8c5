"""Stage 1 of a lens whose front is freeform: the front brings the light to its places on the back, which turns it.

Let the light behind the lens be known (light_behind.py): through each place t of a target one ray, which
followed back meets the back face at b(t).  The front has to send each b(t) its light: a transport in slope coordinates
as in slope_map.py, from points q of the front to the slopes p(q, b) that Snell's law asks for there,

    y = -(p(q, b) - ∇g(q)),    ∇g(q) ≈ p(q, r(q)) - r(q) ∂p/∂b,

r the affine map that stretches the front's light over that of the back: y hardly depends on q for a fixed b.  (The
sign: a front turns light against its slope.)  The back then has to turn each ray that arrives into the wanted
direction, which is a matter of its slopes alone: of two congruences of rays with eikonals Φ in the glass and Φ' behind
it every level set of n Φ - Φ' is such a face.  The back moves b(t), and so the rounds repeat, each from the faces and
the places of the round before.

A lens of which the front alone is free sends the light by way of a back that is given: there b is the place of the back
through which light from q comes to the target's t.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bstcad.optics import sampling
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.emitters import Emitter
from bstcad.optics.interfaces import cross
from bstcad.optics.irradiance import Screen
from bstcad.optics.kernels.reductions import total
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.rays import Rays
from bstcad.optics.reach import kept_from_reflection, slopes_towards
from bstcad.optics.receivers import Receiver
from bstcad.scene.quality import COARSEST_GRID
from bstcad.tailoring import light_behind, stage1
from bstcad.tailoring.light_behind import LightBehind
from bstcad.tailoring.machinability import moved_clear
from bstcad.tailoring.run import Parameters, Step, Task
from bstcad.tailoring.slope_fit import Fit, fit_slopes
from bstcad.tailoring.slope_map import (
    GATHERED,
    GATHERING,
    REACH,
    SAMPLES,
    SUBCELLS,
    FaceGrid,
    SlopeMap,
    corners_of,
    face_grid,
    light_density,
    lit_window,
    pixel_corners,
    rays_at,
    spread_density,
)
from bstcad.transport.bfm import Step as TransportStep
from bstcad.transport.mapping import Frame, solve

NUDGE = 1e-4  # of the thickness: step of the difference quotients of the slopes
CLOSING = 6  # Newton steps to the place of the back by which light comes to a place
# Of these rounds the last one is on all of the transport's grid and of the nets, the others on half of the grid and on
# the last net but one, until both faces fit each other.  (After two such rounds alone, two photographs have half as
# much error again by blocks of 4 and of 32 pixels.)
FINE_ROUNDS = 4
SETTLED = 0.003  # half widths of the front, RMS: the coarse rounds end where places moved by less

Grid = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class FrontRound:
    """Where the stage stands between two rounds."""

    round: int  # of those that are done
    lens: Parameters
    wanted: SlopeMap  # that the front follows; its places are q(t) (mm) of the rays behind the lens
    back: Grid  # b(t) (mm) through those of target[0]


class Aims(NamedTuple):
    """Where the front shall send the light."""

    picture: np.ndarray  # (r, c) the light between each four of its rays, row 0 = y max
    back: np.ndarray  # (3, c + 1, r + 1) mm in space: b of each ray


def steps(task: Task, lens: Lens, state: FrontRound | None = None) -> Iterator[Step]:
    """Stage 1 of a lens with a freeform front, or further from a state: its rounds.

    With one goal alone and both faces free the front stays as it is, and the back does all the work.
    """
    lens = task.heaviest.through(lens)
    if lens.shapes_both and not task.several:
        alone = lens.with_nets(_final(task, lens).nets).shaping("back")
        for step in stage1.steps(task, alone, state):
            yield replace(step, make=lambda step=step: step.make().shaping("front", "back"))
        return
    for last in follow(task, lens, state):
        yield last
    if not task.hasty:
        yield replace(last, state=None, judged=task.rrmsd(last.lens))


def follow(task: Task, lens: Lens, state: FrontRound | None) -> Iterator[Step]:
    """The rounds; all but FINE_ROUNDS work on coarse grids and nets, and end once they are settled."""
    knobs, z, done, wanted = task.knobs, lens.back.z, 0, None
    light = behind_lens(task, lens)
    if state is not None:
        lens, done, wanted, b = state.lens.applied(lens), state.round, state.wanted, state.back
    turn = min(done, knobs.rounds - 1)
    while turn < knobs.rounds:
        if turn >= done:
            left = knobs.rounds - turn
            fine = left <= FINE_ROUNDS
            halvings = 0 if left == 1 else 1 if fine else 2
            cells = max(COARSEST_GRID, knobs.transport_grid // 2**halvings)
            level = knobs.levels[max(-1 - halvings, -len(knobs.levels))] if fine else knobs.levels[0]
            lens = lens.with_nets(
                net.refined(sides) for net, sides in zip(lens.nets, task.sides(lens, level), strict=True)
            )
            fit = stage1.FINE if fine else stage1.COARSE
            places = None if wanted is None else wanted.places
            lens, wanted, b = _round(task, lens, light, places, turn=turn, cells=cells, fit=fit)
            lens = moved_clear(lens, z, task.least, task.bounds)
            task.tidy()
        turn = max(turn + 1, knobs.rounds - FINE_ROUNDS if wanted.moved <= SETTLED else 0)
        yield Step(
            partial(_final, task, lens), FrontRound(turn, Parameters.of(lens), wanted, b),
            mapping=wanted.mapping, places=b, progress=("stage 1", turn, knobs.rounds, ""),
        )  # fmt: skip


def _final(task: Task, lens: Lens) -> Lens:
    """The lens with all of its control points."""
    sides = task.sides(lens, task.knobs.levels[-1])
    return lens.with_nets(net.refined(each) for net, each in zip(lens.nets, sides, strict=True))


def behind_lens(task: Task, lens: Lens) -> LightBehind | None:
    """The light that the lens has to send out; None: its back is given, and one picture alone is asked for."""
    if not lens.shapes("back"):
        return None
    light = light_behind.of_task(task)
    near = min(task.goals, key=lambda goal: goal.receiver.plane.throw(0.0))
    return light_behind.uncrossed(light, near.receiver, lens.back, task.knobs.transport_grid)


def _round(
    task: Task, lens: Lens, light: LightBehind | None, places: Grid | None, *, turn: int, cells: int,
    fit: tuple[Fit, float],
) -> tuple[Lens, SlopeMap, Grid]:  # fmt: skip
    """One round: the lens, the map that its front follows, and b(t)."""
    source, first = task.heaviest.source, task.goals[0]
    front = lens.shaping("front")
    window = lit_window(source, front)
    if light is None:
        picture, back = first.picture, _by_way_of_back(source, front, window, first.receiver, places=places)
        through = back[:2]
    else:
        picture, back = light.picture, light.meeting(lens.back)
        through = light.places_of(first.receiver, back[:2])

    def progress(s: TransportStep) -> None:
        task.progress("stage 1", turn, task.knobs.rounds, f"{s.grid}² cells, mass error {s.mass_error:.4f}")

    wanted = front_map(
        source, front, window, Aims(picture, back), n=cells, places=places, iterations=task.knobs.transport_iterations,
        progress=progress,
    )  # fmt: skip
    own = [min(2 * max(net.shape), task.knobs.rays) for net in lens.nets]
    grid = face_grid(source, front, window, own[0])
    x, y, z_x, z_y = _flat(grid, wanted.slopes)
    lens = lens.with_front(_fitted(lens.front, grid, x, y, z_x=z_x, z_y=z_y, fit=fit))
    if light is not None:
        window = lit_window(source, lens)
        grid = face_grid(source, lens, window, own[-1])
        law = lens.last_freeform.law
        out = light.leaving(lens.back, *sampling.grid(window, grid.shape))
        slopes = kept_from_reflection(grid.at_face, slopes_towards(grid.at_face, out, law), law)
        x, y = (p.reshape(-1) for p in sampling.grid(window, grid.shape))
        z_x, z_y = (s.reshape(-1) for s in slopes)
        lens = lens.with_back(_fitted(lens.back, grid, x, y, z_x=z_x, z_y=z_y, fit=fit))
    return lens, wanted, tuple(through)


def _flat(grid: FaceGrid, slopes) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """x, y and the slopes at the cells of a grid, each (n,)."""
    x, y = (p.reshape(-1) for p in sampling.grid(grid.window, grid.shape))
    return x, y, *slopes(x, y)


def _fitted(
    net: BSplineSurface, grid: FaceGrid, x: Tensor, y: Tensor, *, z_x: Tensor, z_y: Tensor, fit: tuple[Fit, float]
) -> BSplineSurface:
    """The net with the slopes wanted where light meets it; elsewhere with its own, by a small weight; its vertex stays.

    x, y, z_x, z_y: (n,), of the cells of the grid.
    """
    how, unlit = fit
    lit = (grid.density > 0).reshape(-1)
    _, *own = net.relative_sag_and_slope(x, y)
    z_x, z_y = (torch.where(lit, z.to(x), now) for z, now in zip((z_x, z_y), own, strict=True))
    weight = torch.where(lit, 1.0, unlit).to(x)
    return fit_slopes(net, x, y, z_x=z_x, z_y=z_y, weight=weight, fit=how).from_vertex().moved(net.z)


def front_map(
    source: Emitter, lens: Lens, window: Rectangle, aims: Aims, n: int, places: Grid | None, **solver
) -> SlopeMap:
    """The slopes of the front that send the light to the aims, by transport on n x n cells.

    lens: its front alone is free; places: q of each aim in the round before.  The map's own places are q.
    """
    side = max(window.width, window.height)
    grid = face_grid(source, lens, Rectangle(side, side), n * SUBCELLS)
    rho = grid.density.cpu().double().numpy().reshape(n, SUBCELLS, n, SUBCELLS).mean((1, 3))
    back = torch.from_numpy(aims.back)
    lit = corners_of(aims.picture)
    low, high = (np.array([f(p[lit]) for p in aims.back[:2]]) for f in (np.min, np.max))
    stretch, shift = (high - low) / (window.width, window.height), (low + high) / 2
    if places is None:
        q_x, q_y = ((p - s) / k for p, s, k in zip(aims.back[:2], shift, stretch, strict=True))
        places = tuple(np.clip(q, -side / 2, side / 2) for q in (q_x, q_y))
    net = _gathering(grid, lens, back, stretch=stretch, shift=shift)
    slopes = _slopes_at(rays_at(grid, places), back, lens)
    _, *g = net.relative_sag_and_slope(*(torch.from_numpy(q) for q in places))
    y_x, y_y = (own.numpy() - p.numpy() for p, own in zip(slopes, g, strict=True))
    sigma, frame = spread_density(aims.picture, (y_x, y_y), n)
    mapping = solve(light_density(rho, side), sigma, Frame((0.0, 0.0), side), frame, **solver)
    now = mapping.inverse(y_x, y_y)
    moved = math.sqrt(np.mean(sum((a - b)[lit] ** 2 for a, b in zip(now, places, strict=True)))) / (side / 2)
    return SlopeMap(mapping, net, -1.0, places=now, moved=moved)


def _slopes_at(rays: Rays, aims: Tensor, lens: Lens) -> tuple[Tensor, Tensor]:
    """The slopes that send rays at the front to aims (3, …) mm in space."""
    way = aims - _in_space(rays)
    return slopes_towards(rays, way / torch.sqrt((way * way).sum(0)), lens.last_freeform.law)


def _in_space(rays: Rays) -> Tensor:
    """(3, …) the rays' places in space (mm)."""
    return torch.stack([*rays.position[:2], rays.above(0.0)])


def _gathering(grid: FaceGrid, lens: Lens, back: Tensor, stretch: np.ndarray, shift: np.ndarray) -> BSplineSurface:
    """g of the module's docstring, as a net of GATHERING points a side over the lit part of a grid."""
    thin = tuple(slice(step // 2, None, step) for step in (max(1, n // SAMPLES) for n in grid.shape))
    faces = replace(grid.at_face, **{k: getattr(grid.at_face, k)[(..., *thin)] for k in ("position", "direction")})
    x, y, z = _in_space(faces).cpu().double()
    height = float(total(back[2]) / back[2].numel())
    reference = torch.stack([stretch[0] * x + shift[0], stretch[1] * y + shift[1], torch.full_like(x, height)])
    lit = grid.density[thin] > 0
    z_x, z_y = _slopes_at(faces, reference, lens)
    step = NUDGE * (height - float(total(z) / z.numel()))
    quotient = 0.0
    for axis, here in enumerate((z_x, z_y)):  # ∂p/∂b, a number: the mean over the light
        nudge = torch.zeros((3, 1, 1), dtype=reference.dtype)
        nudge[axis] = step
        there = _slopes_at(faces, reference + nudge, lens)[axis]
        quotient += float(total((there - here)[lit]) / lit.sum()) / (2 * step)
    wanted = (p - r * quotient for p, r in zip((z_x, z_y), reference[:2], strict=True))
    half_x, half_y = (REACH * size / 2 for size in (grid.window.width, grid.window.height))
    flat = torch.zeros((GATHERING, GATHERING), dtype=torch.float64)
    net = BSplineSurface(0.0, flat, (-half_x, half_x), (-half_y, half_y))
    return fit_slopes(net, *(p.reshape(-1).cpu().double() for p in (x, y, *wanted, lit)), fit=GATHERED)


def _by_way_of_back(
    source: Emitter, lens: Lens, window: Rectangle, screen: Screen, *, places: Grid | None
) -> np.ndarray:
    """(3, c + 1, r + 1) b(t): where light from the places q of the front meets the back to come to the pixels' corners.

    By Newton's method with difference quotients.  places: None in the first round: q on the straight way from the axis.
    """
    t = torch.stack([torch.from_numpy(p) for p in pixel_corners(screen)])
    back = replace(lens.interfaces[lens.number_of("back")], outline=lens.unbounded().outline, losses=())
    plane = screen.plane
    grid = face_grid(source, lens, window, SAMPLES)
    q = rays_at(grid, places or tuple(np.zeros_like(p.numpy()) for p in t))
    q = replace(q, flux=torch.ones_like(t[0]), status=torch.zeros(t[0].shape, dtype=torch.uint8), taken={})
    b = q.position[:2].clone()
    for _ in range(CLOSING):
        miss = _landing(q, b, back, plane) - t
        step = NUDGE * (lens.back.z - lens.front.z)
        shifted = [torch.stack([b[0] + step * i, b[1] + step * (1 - i)]) for i in (1, 0)]
        (xx, yx), (xy, yy) = ((_landing(q, at, back, plane) - t - miss) / step for at in shifted)
        det = xx * yy - xy * yx
        det = torch.where(det.abs() > 0, det, torch.ones_like(det))
        b = b - torch.stack([yy * miss[0] - xy * miss[1], xx * miss[1] - yx * miss[0]]) / det
    height = lens.back.sag_and_slope(b[0], b[1])[0]
    return torch.stack([b[0], b[1], height]).numpy()


def _landing(q: Rays, b: Tensor, back, plane: Receiver) -> Tensor:
    """(2, …) where light from the front by way of places b of the back lands (mm)."""
    height = back.surface.sag_and_slope(b[0], b[1])[0]
    way = torch.stack([b[0], b[1], height]) - _in_space(q)
    rays = replace(q, direction=way / torch.sqrt((way * way).sum(0)), axial=False)
    return plane.land(cross(rays, back).rays).position
