"""Point-by-point integration of a ray mapping: the traditional way from a transport map to a surface.

Wang et al. 2023 compare their tailoring with it (sections 1 and 3.3; its source is Luo et al. 2010).  The map is their
own, from the plane of the front's vertex to places on the target (slope_map.py).  Rays through a grid of that plane
are known as far as the back, and at a point of one of them Snell's law and the ray's aim give the slopes p = ∂z/∂x
and q = ∂z/∂y that the back needs there.  From an initial point each point gives the next one, b after a, where ray b
meets

    z_b - z_a = (p_a + p_b) / 2 (x_b - x_a) + (q_a + q_b) / 2 (y_b - y_a)

the trapezoidal rule, by Heun's method: p_b and q_b are those of the point in which ray b meets the tangent plane of a.
(The tangent plane alone, the explicit rule, errs by the first power of the step.)  The way leads first along one line
through the initial point, then from each point of it across.  A map that is no surface's, as off axis, gives other
heights on other ways; nothing evens that out, and no optimisation follows.  The back is the least-squares fit of the
points by the net.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from bstcad.baselines.paper import transport
from bstcad.optics import sampling
from bstcad.optics.bspline import BSplineSurface, evaluate, net_gradient
from bstcad.optics.interfaces import ALONG, Law
from bstcad.optics.lens import Lens
from bstcad.optics.rays import Rays
from bstcad.optics.receivers import Receiver
from bstcad.optics.sides import Sides, both
from bstcad.optics.trace import clear_window, to_first_net
from bstcad.optics.unfolding import seen_from_last_net
from bstcad.scene.errors import SceneError
from bstcad.tailoring import slope_map
from bstcad.tailoring.machinability import moved_clear
from bstcad.tailoring.run import Step, Task
from bstcad.tailoring.slope_fit import conjugate_gradients, monomials, wanted_slopes, with_polynomial
from bstcad.transport.mapping import Mapping

STARTS = 3  # initial points tried, each as far along +z as the front needs by the points of the one before
DENSE = 4  # points a control cell each way that a coarse net is fitted to; the last one is fitted to all
# Weight of the net's second differences beside heights, conjugate-gradient steps, and degree of a polynomial that is
# fitted first: on the coarsest net, those in between and the last.  The first goes on smoothly where no light falls,
# the last gives way to the points.
STIFF, BETWEEN, FINE = (1e-2, 200, 3), (1e-3, 100, 0), (1e-4, 30, 0)

First = Literal["x", "y"]


@dataclass(frozen=True)
class Points:
    """Where the back is on each ray of a grid."""

    position: Tensor  # (3, n, n) mm; the third counts from the plane of the initial point
    reached: Tensor  # (n, n) bool; False: the ray is lost before the back, or one before it on the way was


def steps(task: Task, lens: Lens, state: None = None) -> Iterator[Step]:
    """The map, then the points and the net through them; seconds, which cannot be left half way."""
    lens = task.heaviest.through(lens)
    mapping = transport(task, lens)
    yield Step(None, part="transport", ends=True)
    task.progress("integration", 0, 1, "")
    lens = follow_points(task, lens, mapping)
    yield Step(lambda: lens, mapping=mapping, progress=("integration", 1, 1, ""))


@torch.no_grad()
def follow_points(task: Task, lens: Lens, mapping: Mapping, first: First = "x") -> Lens:
    """The lens whose back is the net through the points of the map.

    Its initial point is on the ray through the middle of the first surface, in the plane of the back; where the back
    would then come too near to the front, it begins anew from as far along +z as that takes.
    """
    knobs, screen = task.knobs, task.goals[0].receiver
    source, exact, z = task.heaviest.source, lens.plain(), lens.back.z
    area, n = clear_window(source, exact), knobs.rays // 2 * 2 + 1  # odd: one ray is through the middle
    x, y = sampling.grid(area, n)
    coming = to_first_net(source.rays(x, y, exact.entrance.z, area.area / n**2), exact)
    aim, plane = slope_map.aim_points(mapping, exact, screen, x=x, y=y), seen_from_last_net(exact, screen.plane)
    for _ in range(STARTS):
        start = exact.back.z
        points = march(coming, aim, plane, law=exact.last_freeform.law, z=start, first=first)
        back = fitted(exact.back, points, lit(points, coming, exact), knobs.levels)
        exact = moved_clear(exact.with_back(back), z, task.least)
        if exact.back.z == start:
            break
    return lens.with_back(exact.back.with_parameters(heights=exact.back.heights.to(lens.back.heights)))


def lit(points: Points, coming: Rays, lens: Lens) -> Tensor:
    """True for points that light meets inside the clear aperture."""
    return points.reached & (coming.flux > 0) & lens.apertures[1].contains(*points.position[:2])


@torch.no_grad()
def march(coming: Rays, aim: Tensor, plane: Receiver, law: Law, z: float, first: First = "x") -> Points:
    """The points of a face that sends rays (n, n), n odd, to their aims (2, n, n) mm, from that of the middle ray at z.

    coming: on their way to it; first: the axis along which the first line runs, all others run across it.  A ray that
    is lost, or that runs along the face, ends its line.  SceneError if the middle one is lost.
    """
    middle = aim.shape[-1] // 2
    if not bool(coming.alive[middle, middle]):
        raise SceneError(
            "source: its ray through the middle of the first surface does not reach the back, where point-by-point "
            'integration begins; move the source, or choose tailoring.method = "least-squares"'
        )
    grid = _Grid.of(coming, aim, z)  # x along the first axis
    grid = grid if first == "x" else grid.turned()
    line = grid[:, middle : middle + 1]
    begin = line[middle : middle + 1, :]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # a step of the march has so few numbers that a second thread only makes the first wait
    try:
        along = _outwards(line, begin.origin, begin.alive, plane=plane, law=law)
        across = _outwards(grid.turned(), _swapped(along.position), _swapped(along.reached), plane=plane, law=law)
    finally:
        torch.set_num_threads(threads)
    return across if first == "y" else Points(_swapped(across.position), _swapped(across.reached))


def _swapped(t: Tensor) -> Tensor:
    return t.transpose(-1, -2).contiguous()


@dataclass(frozen=True)
class _Grid:
    """Rays, one behind the other along the first axis, in lines beside each other along the second; and their aims."""

    origin: Tensor  # (3, rays, lines) mm, where they cross the plane of the initial point; the third is zero
    direction: Tensor  # (3, rays, lines)
    aim: Tensor  # (2, rays, lines) mm
    alive: Tensor  # (rays, lines)
    rays: Rays  # whose sense and plane they share

    @classmethod
    def of(cls, coming: Rays, aim: Tensor, z: float) -> _Grid:
        """The grid of rays on their way to the face; a lost ray may be anything finite."""
        alive = coming.alive
        straight = torch.tensor([0.0, 0.0, coming.sense]).to(aim).view(3, 1, 1)
        direction = torch.where(alive, coming.direction, straight)
        origin = coming.position - coming.above(z) / direction[2] * direction
        origin = torch.where(alive, origin, torch.zeros_like(origin))
        origin[2] = 0.0
        return cls(origin, direction, aim, alive=alive, rays=replace(coming, z=z))

    def __getitem__(self, where: tuple) -> _Grid:
        """Some of them."""
        parts = (t[(..., *where)] for t in (self.origin, self.direction, self.aim, self.alive))
        return _Grid(*parts, self.rays)

    def turned(self) -> _Grid:
        """Lines are rays, and rays are lines."""
        return _Grid(*map(_swapped, (self.origin, self.direction, self.aim, self.alive)), self.rays)

    def normals(self, position: Tensor, plane: Receiver, law: Law) -> Tensor:
        """(3, rays, lines) n = (-p, -q, 1) of the face that sends each ray from its position (mm) to its aim."""
        at = replace(self.rays, position=position, direction=self.direction)
        p, q = wanted_slopes(at, self.aim, plane, law)
        return torch.stack([-p, -q, torch.ones_like(p)])

    def meet(self, point: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        """(where the rays meet the planes through points (3, rays, lines) mm across these normals, do they)."""
        along = _dot(normal, self.direction)
        ok = self.rays.sense * along > ALONG * torch.sqrt(_dot(normal, normal))
        path = _dot(normal, point - self.origin) / torch.where(ok, along, torch.ones_like(along))
        return torch.where(ok, self.origin + path * self.direction, point), ok


def _outwards(grid: _Grid, position: Tensor, reached: Tensor, plane: Receiver, law: Law) -> Points:
    """Lines of points, both ways from that on the middle ray of each: position (3, 1, lines) mm, reached (1, lines)."""
    middle = grid.alive.shape[0] // 2
    points, all_reached = torch.zeros_like(grid.origin), torch.zeros_like(grid.alive)
    points[:, [middle]], all_reached[[middle]] = position, reached
    normal = grid[[middle], :].normals(position, plane, law)
    for k in range(1, middle + 1):
        both = [middle - k, middle + k]
        rays = grid[both, :]
        tangent, meets = rays.meet(position, normal)  # the explicit rule
        mean = (normal + rays.normals(tangent, plane, law)) / 2
        position, meets_again = rays.meet(position, mean)  # the trapezoidal rule
        normal = rays.normals(position, plane, law)
        reached = reached & rays.alive & meets & meets_again
        points[:, both], all_reached[both] = position, reached
    return Points(points, all_reached)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@torch.no_grad()
def fitted(surface: BSplineSurface, points: Points, used: Tensor, levels: tuple[Sides, ...]) -> BSplineSurface:
    """Least squares: min Σ |h(x, y) - z|² over the points used, (n, n) bool, on one net after another.

    Each net starts from the surface of the net before, the first from a plane; only the last uses all points.
    """
    nets = levels if len(levels) > 1 else 2 * levels
    ways = (STIFF, *(BETWEEN for _ in nets[1:-1]), FINE)
    surface, n = surface.refined(nets[0]), used.shape[-1]
    surface = replace(surface, heights=torch.zeros_like(surface.heights))
    for net, (bending, count, degree) in zip(nets, ways, strict=True):
        m = max(both(net))
        every = 1 if bending == FINE[0] else max(1, n // (DENSE * m))
        some = used[::every, ::every]
        x, y, z = (p[::every, ::every][some] for p in points.position)
        cells = math.prod(points * every / n for points in both(net))  # of the net, a point
        surface = fit_heights(surface.refined(net), x, y, z=z, bending=bending / cells, count=count, degree=degree)
    return surface


def fit_heights(
    surface: BSplineSurface, x: Tensor, y: Tensor, z: Tensor, bending: float, count: int, degree: int
) -> BSplineSurface:
    """min Σ |h(x, y) - z|² + bending Σ |second differences|², by so many conjugate-gradient steps.

    x, y and z, from the surface's plane, are (n,) mm; begins with the surface's own heights, and with a polynomial of
    this degree besides, if it is not zero.
    """
    u, v = surface.along_net(x, y)
    zero = torch.zeros_like(u)

    def normal_equations(residual: Tensor) -> Tensor:
        return net_gradient(surface.heights, u, v, (residual, zero, zero))

    h = surface.heights
    if degree:
        terms = [torch.ones_like(h), *monomials(surface, degree)]
        h = with_polynomial(h, terms, lambda h: evaluate(h, u, v)[:1], wanted=(z,), weight=torch.ones_like(z))
    residual = normal_equations(z - evaluate(h, u, v)[0]) - bending * bent(h)
    return replace(
        surface,
        heights=conjugate_gradients(
            lambda p: normal_equations(evaluate(p, u, v)[0]) + bending * bent(p), h, residual, count
        ),
    )


def bent(h: Tensor) -> Tensor:
    """Half the gradient of Σ (h_xx² + 2 h_xy² + h_yy²), second differences of a net (m, m): zero for a plane."""
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
