"""Point-by-point integration of a ray mapping: the traditional construction of a surface from a transport map.

Wang et al. 2023 compare their tailoring with this construction (sections 1 and 3.3, after Luo et al. 2010).  The map is
that of Wang et al., from the vertex plane of the first surface to the target (slope_map.py).  Rays through a grid
on that plane are traced up to the back.  At a point of a ray, Snell's law and the aim of the ray give the slopes p =
∂z/∂x and q = ∂z/∂y of the back.  From the initial point on, each point a gives the point b on the next ray, where

    z_b - z_a = (p_a + p_b) / 2 (x_b - x_a) + (q_a + q_b) / 2 (y_b - y_a)

(the trapezoidal rule).  As in Heun's method, p_b and q_b are the slopes at the point where the ray of b meets the
tangent plane of a.  (The explicit rule, with the tangent plane alone, has an error of first order in the step.)  The
integration runs first along one line through the initial point, then across from each point of this line.  A map that
is not integrable, as off axis, gives heights that depend on the order; no averaging and no optimisation follow.  The
back is the least-squares fit of the net to the points.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from bstcad.optics.lens.interfaces import TANGENCY_TOLERANCE, Law
from bstcad.optics.lens.lens import Lens
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.bspline import BSplineSurface, evaluate, net_gradient
from bstcad.optics.surfaces.rays import Rays, dot
from bstcad.optics.surfaces.sides import Sides, as_pair
from bstcad.optics.trace.reach import wanted_slopes
from bstcad.optics.trace.trace import clear_window, to_first_net
from bstcad.optics.trace.unfolding import image_from_last_net
from bstcad.runs.files import SceneError
from bstcad.tailoring import slope_map
from bstcad.tailoring.baselines.paper import transport
from bstcad.tailoring.driver import StageStep, Task
from bstcad.tailoring.machinability import place_back
from bstcad.tailoring.slope_fit import conjugate_gradients, monomials, with_polynomial
from bstcad.transport.mapping import Mapping

MAX_STARTS = 3  # largest number of initial points; if the back is too near to the front, the next lies farther along +z
FITTED_POINTS_PER_CELL = 4  # fitted points per side of a control cell of the coarser nets; the last net uses all points
# Fits of the coarsest net, the nets in between and the last: weight of the second differences relative to heights,
# conjugate-gradient iterations, and degree of a polynomial that is fitted first.  The first fit extrapolates smoothly
# where no light falls; the last follows the points.
COARSEST_FIT, MIDDLE_FIT, FINEST_FIT = (1e-2, 200, 3), (1e-3, 100, 0), (1e-4, 30, 0)

First = Literal["x", "y"]  # axis of the first line of the integration


@dataclass(frozen=True)
class SurfacePoints:
    """Points of the back on the rays of a grid."""

    position: Tensor  # (3, n, n) mm; z is relative to the plane of the initial point
    reached: Tensor  # (n, n) bool, False: the ray, or an earlier ray of its line, is lost before the back


def steps(task: Task, lens: Lens, state: None = None) -> Iterator[StageStep]:
    """Yield the steps of the method: the map, then points and net, which take seconds and cannot be interrupted."""
    lens = task.heaviest.through(lens)
    mapping = transport(task, lens)
    yield StageStep(None, part="transport", ends=True)
    task.progress("integration", 0, 1, "")
    lens = follow_points(task, lens, mapping)
    yield StageStep(lambda: lens, mapping=mapping, progress=("integration", 1, 1, ""))


@torch.no_grad()
def follow_points(task: Task, lens: Lens, mapping: Mapping, first: First = "x") -> Lens:
    """Return the lens whose back is the net fitted to the points that the integration of the map gives.

    The initial point lies on the ray through the centre of the first surface, in the plane of the back.  If the back
    would come too near to the front, the integration is repeated from a point further along +z.  first: as in `march`.
    """
    settings, screen = task.settings, task.goals[0].screen
    source, exact, z = task.heaviest.source, lens.plain(), lens.back.z
    area, n = clear_window(source, exact), settings.rays // 2 * 2 + 1  # odd: one ray through the centre
    x, y = sampling.grid(area, n)
    coming = to_first_net(source.rays_through(x, y, exact.entrance.z, area.area / n**2), exact)
    aim, receiver = slope_map.aim_points(mapping, exact, screen, x=x, y=y), image_from_last_net(exact, screen.receiver)
    for _ in range(MAX_STARTS):
        start = exact.back.z
        points = march(coming, aim, receiver, law=exact.last_tailored.law, z=start, first=first)
        lit = points.reached & (coming.flux > 0) & exact.apertures[1].contains(*points.position[:2])
        back = fit_net(exact.back_net, points, lit, settings.levels)
        exact = place_back(exact.with_back(back), z, task.min_thickness)
        if exact.back.z == start:
            break
    return lens.with_back(replace(exact.back_net, heights=exact.back_net.heights.to(lens.back_net.heights)))


@torch.no_grad()
def march(coming: Rays, aim: Tensor, receiver: Receiver, law: Law, z: float, first: First = "x") -> SurfacePoints:
    """Return points of a face that sends rays (n, n), n odd, to aims (2, n, n) on the `receiver`.

    coming: rays on the way to the face.  z: z (mm) of the point on the middle ray.  first: axis of the first line;
    all others cross it.  A lost ray, or one parallel to the face, ends its line.  SceneError if the middle ray is lost.
    """
    middle = aim.shape[-1] // 2
    if not bool(coming.alive[middle, middle]):
        raise SceneError(
            "source: the ray through the centre of the first surface does not reach the back, where point-by-point "
            'integration begins; move the source, or choose tailoring.method = "least-squares"'
        )
    grid = _Grid.of(coming, aim, z)  # x along the first axis
    grid = grid if first == "x" else grid.transposed()
    line = grid[:, middle : middle + 1]
    begin = line[middle : middle + 1, :]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # a step has so few numbers that a second thread only delays the first
    try:
        along = _outwards(line, begin.origin, begin.alive, receiver=receiver, law=law)
        starts = _transposed(along.position), _transposed(along.reached)
        across = _outwards(grid.transposed(), *starts, receiver=receiver, law=law)
    finally:
        torch.set_num_threads(threads)
    return across if first == "y" else SurfacePoints(_transposed(across.position), _transposed(across.reached))


def _transposed(t: Tensor) -> Tensor:
    return t.transpose(-1, -2).contiguous()


@dataclass(frozen=True)
class _Grid:
    """Rays and their aims: the first axis counts the rays along a line, the second counts the lines."""

    origin: Tensor  # (3, rays, lines) mm, intersection with the plane of the initial point; z is zero
    direction: Tensor  # (3, rays, lines) unit vectors
    aim: Tensor  # (2, rays, lines) coordinates on the receiver, in its unit
    alive: Tensor  # (rays, lines) bool
    rays: Rays  # bundle that states sense and plane of the rays

    @classmethod
    def of(cls, coming: Rays, aim: Tensor, z: float) -> _Grid:
        """Return the grid of the rays; z: plane (mm) of the initial point.  Lost rays get arbitrary finite values."""
        alive = coming.alive
        straight = torch.tensor([0.0, 0.0, coming.sense]).to(aim).view(3, 1, 1)
        direction = torch.where(alive, coming.direction, straight)
        origin = coming.position - coming.above(z) / direction[2] * direction
        origin = torch.where(alive, origin, torch.zeros_like(origin))
        origin[2] = 0.0
        return cls(origin, direction, aim, alive=alive, rays=replace(coming, z=z))

    def __getitem__(self, where: tuple) -> _Grid:
        return self._mapped(lambda t: t[(..., *where)])

    def transposed(self) -> _Grid:
        return self._mapped(_transposed)

    def _mapped(self, change: Callable[[Tensor], Tensor]) -> _Grid:
        origin, direction, aim, alive = map(change, (self.origin, self.direction, self.aim, self.alive))
        return _Grid(origin, direction, aim, alive, rays=self.rays)

    def normals(self, position: Tensor, receiver: Receiver, law: Law) -> Tensor:
        """Return normals (3, rays, lines), n = (-p, -q, 1), of a face that sends rays from positions (mm) to aims."""
        at = replace(self.rays, position=position, direction=self.direction)
        p, q = wanted_slopes(at, self.aim, receiver, law)
        return torch.stack([-p, -q, torch.ones_like(p)])

    def meet(self, point: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        """Return where rays meet the planes through `point` with `normal`, (3, rays, lines) mm, and True for hits."""
        along = dot(normal, self.direction)
        ok = self.rays.sense * along > TANGENCY_TOLERANCE * torch.sqrt(dot(normal, normal))
        path = dot(normal, point - self.origin) / torch.where(ok, along, torch.ones_like(along))
        return torch.where(ok, self.origin + path * self.direction, point), ok


def _outwards(grid: _Grid, position: Tensor, reached: Tensor, receiver: Receiver, law: Law) -> SurfacePoints:
    """Integrate lines outwards from their points on the middle ray, `position` (3, 1, lines) mm and `reached`."""
    middle = grid.alive.shape[0] // 2
    points, all_reached = torch.zeros_like(grid.origin), torch.zeros_like(grid.alive)
    points[:, [middle]], all_reached[[middle]] = position, reached
    normal = grid[[middle], :].normals(position, receiver, law)
    for k in range(1, middle + 1):
        pair = [middle - k, middle + k]
        rays = grid[pair, :]
        tangent, meets = rays.meet(position, normal)  # the explicit rule
        mean = (normal + rays.normals(tangent, receiver, law)) / 2
        position, meets_again = rays.meet(position, mean)  # the trapezoidal rule
        normal = rays.normals(position, receiver, law)
        reached = reached & rays.alive & meets & meets_again
        points[:, pair], all_reached[pair] = position, reached
    return SurfacePoints(points, all_reached)


@torch.no_grad()
def fit_net(surface: BSplineSurface, points: SurfacePoints, used: Tensor, levels: tuple[Sides, ...]) -> BSplineSurface:
    """Fit nets with `levels` control points per side by least squares (`fit_heights`) to the points `used` (n, n) bool.

    Each net starts from the surface of the previous net, the first from a plane; only the last uses all points.
    """
    nets = levels if len(levels) > 1 else 2 * levels
    fits = (COARSEST_FIT, *(MIDDLE_FIT for _ in nets[1:-1]), FINEST_FIT)
    surface, n = surface.refined(nets[0]), used.shape[-1]
    surface = replace(surface, heights=torch.zeros_like(surface.heights))
    for net, (bending, count, degree) in zip(nets, fits, strict=True):
        m = max(as_pair(net))
        stride = 1 if bending == FINEST_FIT[0] else max(1, n // (FITTED_POINTS_PER_CELL * m))
        sampled = used[::stride, ::stride]
        x, y, z = (p[::stride, ::stride][sampled] for p in points.position)
        cells = math.prod(points * stride / n for points in as_pair(net))  # cells of the net per point
        surface = fit_heights(surface.refined(net), x, y, z=z, bending=bending / cells, count=count, degree=degree)
    return surface


def fit_heights(
    surface: BSplineSurface, x: Tensor, y: Tensor, z: Tensor, bending: float, count: int, degree: int
) -> BSplineSurface:
    """Minimise Σ |h(x, y) - z|² + bending Σ |second differences|² by `count` conjugate-gradient iterations.

    x, y, z: (n,) mm, z relative to the surface's plane.  The iteration starts from the heights of the surface,
    after the fit of a polynomial of this degree if it is not zero.
    """
    u, v = surface.along_net(x, y)
    zero = torch.zeros_like(u)

    def normal_equations(residual: Tensor) -> Tensor:
        return net_gradient(surface.heights, u, v, (residual, zero, zero))

    h = surface.heights
    if degree:
        terms = [torch.ones_like(h), *monomials(surface, degree)]
        h = with_polynomial(h, terms, lambda h: evaluate(h, u, v)[:1], data=(z,), weight=torch.ones_like(z))
    residual = normal_equations(z - evaluate(h, u, v)[0]) - bending * bending_gradient(h)
    h = conjugate_gradients(
        lambda p: normal_equations(evaluate(p, u, v)[0]) + bending * bending_gradient(p), h, residual, count
    )
    return replace(surface, heights=h)


def bending_gradient(h: Tensor) -> Tensor:
    """Return half the gradient of Σ (h_xx² + 2 h_xy² + h_yy²), second differences of a net (m, n): zero for a plane."""
    g = torch.zeros_like(h)
    for to, of in ((g, h), (g.T, h.T)):
        second = of[2:] - 2 * of[1:-1] + of[:-2]
        to[2:] += second
        to[1:-1] -= 2 * second
        to[:-2] += second
    mixed = 2 * (h[1:, 1:] - h[1:, :-1] - h[:-1, 1:] + h[:-1, :-1])
    g[1:, 1:] += mixed
    g[1:, :-1] -= mixed
    g[:-1, 1:] -= mixed
    g[:-1, :-1] += mixed
    return g
