"""Radial B-spline surface: a dome whose control points keep their directions from a centre c.

    S(x, y) = c + Σ_i Σ_j B_i(u(x)) B_j(v(y)) ρ_ij d_ij,    ρ_ij = R + h_ij,

with the basis and the knots of bspline.py, the fixed unit vectors d_ij = d(x_i, y_j) of the chart of a sphere
(charts.py) at the uniform control points, and free distances ρ_ij.  S is a polynomial B-spline in space, which CAD
holds exactly as it is.  For equal distances S is a sphere but for R (pitch / R)² / 4 (1 + u² + v²)^-2: its chart is a
harmonic map of the sphere, so that this error is radial.

A ray o + s i meets the surface where the two components of S(x, y) - o across the ray are zero.  Newton's method finds
(x, y) from the point at which the ray leaves the sphere of radius R.  As for height fields (interfaces.py) the root is
found without gradient, and one differentiable Newton step adds the implicit gradient.

Light leaves the glass at the first crossing.  Let ρ(p) be the distance of the surface in the direction of p - c.  A ray
from inside at the distance b from c makes the angle α with the direction from c, sin α = b / |p - c|.  It crosses the
surface once if cot α exceeds |∇_s log ρ| wherever |p - c| is at least the smallest distance ρ_min of the surface:

    b² (1 + G²) < ρ_min²,    G an upper bound of |∇_s log ρ|.

All other rays are *steep* to the surface.  They approach the first crossing by steps of (ρ(p) - |p - c|) / (1 + G ρ b /
ρ_min²), which do not pass it, before Newton's method takes over.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.numerics.reductions import elementary
from bstcad.optics.surfaces.bspline import BSplineSurface, evaluate, interpolating_net
from bstcad.optics.surfaces.charts import Chart, SphereChart
from bstcad.optics.surfaces.motion import Motion, along_axis
from bstcad.optics.surfaces.outlines import POINTS_AROUND, Circle, Outline
from bstcad.optics.surfaces.rays import Rays, dot
from bstcad.optics.surfaces.surfaces import Patch, Surface, Vectors, points_on

NEWTON_STEPS = 20  # maximum number of Newton steps, after which a ray misses; a smooth dome needs 3 to 5
FLATTEST = 0.05  # lowest start of the search for the height over a point (x, y), as a fraction of R
MAX_STEP = 0.25  # largest Newton step, as a fraction of R
MIN_COSINE = 1e-6  # smallest cosine of the angle of incidence at which a ray meets the surface
APPROACH_STEPS = 400  # maximum number of steps of the approach, after which a ray misses
APPROACH_DISTANCE = 1e-4  # distance from the surface at which an approach ends, as a fraction of R
APPROACH_COSINE = 1e-2  # smallest cosine of incidence at which Newton's method may lead on from the approach
DIRECTION_TOLERANCE = 1e-9  # largest distance of control points from their directions, as a fraction of R
CARRYING_STEPS = 6  # corrections of the distances of a surface after a small motion
DIRECTION_STEPS = 4  # corrections of (x, y) by which the surface is found in a given direction
SILHOUETTE_RINGS = 181  # number of angles from the axis among which the silhouette is searched
RIM_POINTS = 1440  # number of points of a rim at which its height and its distance from the axis are examined
STANDOFF = 0.01  # distance before the surface at which rays to it start, as a fraction of R
ROOT_TOLERANCE = 64  # distance from the ray at which the search ends, in units of R times the precision of the numbers


class Met(NamedTuple):
    """Points at which rays meet a radial surface."""

    position: Tensor  # (3, …) relative to the centre, mm
    normal: Tensor  # (3, …) outward normal, not of unit length
    x: Tensor  # coordinates in the chart, mm
    y: Tensor
    found: Tensor  # True for rays that meet the net


class RadialBounds(NamedTuple):
    """Bounds of the distances of a radial surface from its centre."""

    nearest: float  # lower bound of ρ, mm
    farthest: float  # upper bound of ρ, mm
    steepest: float  # upper bound of |∂ρ/∂ω|, ω an angle at the centre, mm per rad


@dataclass(frozen=True)
class RadialSurface(BSplineSurface):
    """S(x, y) = c + Σ_i Σ_j B_i(u(x)) B_j(v(y)) (R + h_ij) d_ij; c = (0, 0, z), x and y in the chart (mm)."""

    radius: float = 1.0  # R, from whose sphere the heights h are measured (mm)
    kind: Any = "radial"

    @classmethod
    def sphere(cls, z: float, radius: float, half_extent: tuple[float, float], sides: tuple[int, int]) -> RadialSurface:
        """Return the net of a sphere about (0, 0, z); half_extent: of the net in the chart (mm)."""
        half_x, half_y = half_extent
        zero = torch.zeros(sides, dtype=torch.float64)
        return cls(z, zero, (-half_x, half_x), (-half_y, half_y), radius=radius)

    @classmethod
    def from_control_points(cls, net: np.ndarray, z: float | None = None) -> RadialSurface:
        """Return the surface of a control net (m, n, 3) (mm) about (0, 0, z); ValueError if it is not radial.

        R is the mean distance.  The directions of the corners give the extent of the net in the chart.
        """
        z = 0.0 if z is None else z
        from_centre = net - np.array([0.0, 0.0, z])
        rho = np.sqrt((from_centre**2).sum(-1))
        chart = SphereChart(float(rho.mean()))
        x, y, _ = chart.coordinates(torch.from_numpy(np.ascontiguousarray(np.moveaxis(from_centre, -1, 0))))
        of_x, of_y = ((float(p[0, 0]), float(p[-1, -1])) for p in (x, y))
        surface = cls(z, torch.from_numpy(rho - chart.radius), of_x, of_y, radius=chart.radius)
        return surface._checked(net)

    @staticmethod
    def like(surface: Surface, net: np.ndarray, heights: np.ndarray | None = None) -> RadialSurface:
        """Return a radial surface with other control points (m, n, 3) (mm); ValueError if they leave its directions.

        heights: h_ij (m, n) of these points, if known to the last bit; None: computed from the points, and so rounded.
        """
        assert isinstance(surface, RadialSurface)
        if heights is None:
            heights = np.sqrt(((net - np.array([0.0, 0.0, surface.z])) ** 2).sum(-1)) - surface.radius
        return replace(surface, heights=torch.from_numpy(heights))._checked(net)

    def _checked(self, net: np.ndarray) -> Self:
        """Return the surface; ValueError if its control points are not `net` (m, n, 3) (mm)."""
        off = float(np.abs(self.control_points() - net).max())
        if not off <= DIRECTION_TOLERANCE * self.radius:
            raise ValueError(f"the control points leave the directions of a radial net by {off:.3g} mm")
        return self

    @cached_property
    def chart(self) -> SphereChart:
        """Chart of the sphere of radius R about the centre."""
        return SphereChart(self.radius)

    @property
    def standoff(self) -> float:
        """Distance (mm) before the surface at which a ray starts; points in a direction are known to the pitch²."""
        return STANDOFF * self.radius

    @property
    def directions(self) -> Tensor:
        """Unit vectors d_ij of the control points, (3, m, n), float64 on the CPU."""
        return _directions(self.x, self.y, self.shape, self.chart)

    @property
    def potential(self) -> Tensor:
        """R log(1 + h / R) of the control points (m, n), mm: the heights whose slopes stage 1 fits."""
        return self.radius * elementary(torch.log1p, self.heights / self.radius)

    def with_potential(self, f: Tensor) -> RadialSurface:
        """Return the surface with the distances R exp(f / R)."""
        return replace(self, heights=self.radius * elementary(torch.expm1, f / self.radius))

    def from_vertex(self) -> RadialSurface:
        """Return the surface scaled about its centre so that its vertex, on the axis, has the distance R."""
        axis = torch.zeros(1, dtype=self.heights.dtype, device=self.heights.device)
        vertex = float(self.at(axis, axis).position[2])
        return replace(self, heights=(self.radius + self.heights) * (self.radius / vertex) - self.radius)

    @property
    def vertex_z(self) -> float:
        """Position (mm) of the vertex on the axis."""
        axis = torch.zeros(1, dtype=self.heights.dtype, device=self.heights.device)
        return float(self.z + self.at(axis, axis).position[2])

    def scaled(self, factor: float, about: float) -> RadialSurface:
        """Return the surface scaled by a factor about the point of the axis at z = `about` (mm)."""
        (x_0, x_1), (y_0, y_1), z = self.x, self.y, about + factor * (self.z - about)
        x, y = (factor * x_0, factor * x_1), (factor * y_0, factor * y_1)
        return replace(self, z=z, heights=factor * self.heights, x=x, y=y, radius=factor * self.radius)

    def carried(self, motion: Motion) -> RadialSurface:
        """Return the surface after a small motion, as distances from the same centre.

        The point c + ρ d of the moved surface was at q before the motion.  The residual ρ_surface(q) - |q - c| is added
        to ρ until it vanishes; each step multiplies it by about the slope of log ρ times the angle of the motion.  The
        control points change by the difference of the distances in their directions.
        """
        centre = np.array([0.0, 0.0, self.z])
        back, d = motion.inverse, self.directions
        rotation = torch.from_numpy(np.ascontiguousarray(back.rotation))
        shift = torch.tensor(back.point(tuple(centre.tolist())), dtype=torch.float64) - torch.from_numpy(centre)
        exact = replace(self, heights=self.heights.detach().cpu().double())
        before = exact._below(d)[2]
        rho = before
        for _ in range(CARRYING_STEPS):
            place = rho * d
            q = torch.stack([dot(row, place) + s for row, s in zip(rotation, shift, strict=True)])
            rho = rho + exact._below(q)[2] - torch.sqrt(dot(q, q))
        change = torch.from_numpy(interpolating_net((rho - before).numpy()))
        return replace(self, heights=self.heights + change.to(self.heights))

    def shifted(self, axis: int, by: float, half: float) -> RadialSurface:
        """Return the surface shifted by `by` (mm) along x (axis 0) or y (1); its net reaches beyond `half` as it is."""
        return self.carried(Motion.of(shift=along_axis(axis, by)))

    def tilted(self, axis: int, angle: float) -> RadialSurface:
        """Return the surface rotated by a small angle (degrees) about x (axis 0) or y (1) through its vertex."""
        return self.carried(Motion.of(turn=along_axis(axis, angle), about=(0.0, 0.0, self.vertex_z)))

    def control_points(self) -> np.ndarray:
        """Return the control net (m, n, 3) in mm, float64, x along the first axis."""
        rho = self.radius + self.heights.detach().cpu().double()
        net = np.moveaxis((rho * self.directions).numpy(), 0, -1).copy()
        net[..., 2] += self.z
        return net

    def at(self, x: Tensor, y: Tensor) -> Patch:
        """Return S - c and its derivatives at (x, y) (mm) of the chart, differentiable in the heights and in x, y."""
        u, v = self.along_net(x, y)
        directions = self.directions.to(self.heights)
        parts = [evaluate((self.radius + self.heights) * d, u, v) for d in directions]
        value, along_u, along_v = (torch.stack(same) for same in zip(*parts, strict=True))
        return Patch(value, along_u / self.pitch[0], along_v / self.pitch[1])

    def position_and_normal(self, x: Tensor, y: Tensor) -> tuple[Vectors, Vectors]:
        """Return the components of S - c (mm) and of ∂S/∂x × ∂S/∂y at (x, y) (mm) of the chart."""
        patch = self.at(x, y)
        (p_x, p_y, p_z), (n_x, n_y, n_z) = patch.position, patch.normal
        return (p_x, p_y, p_z), (n_x, n_y, n_z)

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (distance from the centre - R in mm, ∂f/∂x, ∂f/∂y) at (x, y) (mm) of the chart; f: see charts.py."""
        patch = self.at(x, y)
        n_x, n_y, n_d = self.chart.local(patch.position, patch.normal)
        share = self.chart.stretch(patch.position) / n_d
        rho = torch.sqrt((patch.position * patch.position).sum(0))
        return rho - self.radius, -share * n_x, -share * n_y

    def sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (z in mm, ∂z/∂x, ∂z/∂y) where the lines parallel to z through (x, y) in mm leave the dome.

        Lines that miss the dome give the plane through its centre.
        """
        origin = torch.stack([x, y, torch.zeros_like(x)])
        along = torch.tensor([0.0, 0.0, 1.0]).to(origin).view(3, *([1] * x.ndim)).expand_as(origin)
        height = torch.sqrt((self.radius**2 - x * x - y * y).clamp(min=(FLATTEST * self.radius) ** 2))
        start = self.chart.coordinates(torch.stack([x, y, height]))
        p, q, found = self._newton(origin, along, start[:2], torch.ones_like(x, dtype=torch.bool))
        patch = self.at(p, q)
        n_x, n_y, n_z = patch.normal
        values = self.z + patch.position[2], -n_x / n_z, -n_y / n_z
        z, z_x, z_y = (
            torch.where(found, value, torch.full_like(value, base))
            for value, base in zip(values, (float(self.z), 0.0, 0.0), strict=True)
        )
        return z, z_x, z_y

    def rim(self, outline: Outline) -> np.ndarray:
        """Return points (RIM_POINTS, 3) (mm) at equal angles over a circle of the chart; ValueError for no circle."""
        return points_on(self, *Circle(circle_radius(outline)).around(RIM_POINTS + 1)[:-1].T)

    def opening(self, outline: Outline) -> Circle:
        """Return the smallest circle about the axis (mm) around the rim over an outline of the chart."""
        return Circle(float(np.hypot(*self.rim(outline)[:, :2].T).max()))

    def plan(self, outline: Outline) -> Circle:
        """Return the smallest circle about the axis that holds the part inside an outline of the chart, along z."""
        x, y = (torch.from_numpy(p) for p in outline.rim_points())
        a, b = (torch.cat([share * p for share in torch.linspace(0.5, 1.0, 26, dtype=torch.float64)]) for p in (x, y))
        position = self.plain().at(a, b).position
        return Circle(float(torch.hypot(position[0], position[1]).max()))

    def silhouette(self, outline: Outline, count: int = POINTS_AROUND) -> np.ndarray:
        """Return points (count, 2) (mm) around the part inside a circle of the chart, seen along the axis."""
        theta = np.linspace(0.0, self.chart.angle(circle_radius(outline), self.radius), SILHOUETTE_RINGS)
        psi = np.linspace(0.0, 2 * math.pi, count)
        points, _ = self.towards(theta[:, None], psi)
        r = np.hypot(points[..., 0], points[..., 1]).max(axis=0)
        return np.stack([r * np.cos(psi), r * np.sin(psi)], axis=1)

    def section(self, outline: Outline, upright: bool, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return u and z (mm) of points at equal angles from the centre, see `Surface.section`."""
        radius = circle_radius(outline)
        ends = np.array([-radius, radius]), np.zeros(2)
        rim = points_on(self, *(ends[::-1] if upright else ends)) - (0.0, 0.0, self.z)
        low, high = np.arctan2(np.hypot(rim[:, 0], rim[:, 1]), rim[:, 2])
        theta = np.linspace(-low, high, count)
        points, _ = self.towards(np.abs(theta), np.where(theta < 0, math.pi, 0.0) + upright * math.pi / 2)
        return points[:, int(upright)], points[:, 2]

    def towards(self, theta: np.ndarray, psi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the points (…, 3) (mm) in directions from the centre, and the unit normals (…, 3) there.

        theta, psi: angle from +z, and azimuth from +x towards +y (rad).  ValueError if there is no point.
        """
        theta, psi = np.broadcast_arrays(theta, psi)
        sin = np.sin(theta)
        along = torch.from_numpy(np.stack([sin * np.cos(psi), sin * np.sin(psi), np.cos(theta)]))
        flux, status = torch.ones(theta.shape, dtype=torch.float64), torch.zeros(theta.shape, dtype=torch.uint8)
        met = self.plain().meet(Rays(torch.zeros_like(along), along, flux, status, z=self.z))
        if not bool(met.found.all()):
            raise ValueError("lens.back: the dome has no point in some directions; reduce lens.back.half_angle")
        unit = met.normal / torch.sqrt((met.normal * met.normal).sum(0))
        points, normals = (np.moveaxis(part.numpy(), 0, -1).copy() for part in (met.position, unit))
        points[..., 2] += self.z
        return points, normals

    def in_chart(self, chart: Chart) -> RadialSurface:
        """Return the surface in the chart of another radius, with the same directions of its control points.

        The coordinates of a chart are proportional to its radius R, and the distances R + h do not depend on it.
        """
        if not isinstance(chart, SphereChart):
            return super().in_chart(chart)
        factor = chart.radius / self.radius
        (x0, x1), (y0, y1) = self.x, self.y
        heights = self.heights + (self.radius - chart.radius)
        x, y = (factor * x0, factor * x1), (factor * y0, factor * y1)
        return replace(self, heights=heights, x=x, y=y, radius=chart.radius)

    def sags(self, outline: Outline) -> tuple[float, float]:
        """Return the lowest and highest z (mm) over the centre of the control points that act inside the outline."""
        net = self.control_points()
        x, y = ((p.abs() - 2 * pitch).clamp(min=0) for p, pitch in zip(self.places, self.pitch, strict=True))
        z = net[..., 2][outline.contains(x, y).numpy()] - self.z
        return min(float(z.min()), 0.0), max(float(z.max()), 0.0)

    def meet(self, rays: Rays) -> Met:
        """Return where rays from inside meet the surface, with the implicit gradient in rays and heights.

        Rays that miss the net, meet it from behind or at grazing incidence, or that the search does not find, are not
        `found`; their values are those of the vertex and have no gradient.
        """
        origin = torch.stack([*rays.position[:2], rays.above(self.z)])
        along = rays.direction
        with torch.no_grad():
            x, y, found = self._root(origin.detach(), along.detach(), rays.alive)
        zero = torch.zeros_like(origin)
        origin = torch.where(found, origin, zero)
        axis = torch.tensor([0.0, 0.0, 1.0]).to(along).view(3, *([1] * (along.ndim - 1)))
        along = torch.where(found, along, axis.expand_as(along))
        a, b = across(along)
        patch = self.at(x, y)
        offset = patch.position - origin
        with torch.no_grad():
            (m_xx, m_xy), (m_yx, m_yy) = ((dot(e, patch.along_x), dot(e, patch.along_y)) for e in (a, b))
            det = m_xx * m_yy - m_xy * m_yx
            inverse = [m / det for m in (m_yy, -m_xy, -m_yx, m_xx)]
        off_a, off_b = dot(a, offset), dot(b, offset)
        x = x - (inverse[0] * off_a + inverse[1] * off_b)
        y = y - (inverse[2] * off_a + inverse[3] * off_b)
        patch = self.at(x, y)
        return Met(patch.position, patch.normal, x=x, y=y, found=found)

    def arrive(self, rays: Rays, height: Tensor) -> Rays:
        """Return rays from inside moved along their lines to heights (mm) over the sphere of radius R."""
        origin = torch.stack([*rays.position[:2], rays.above(self.z)])
        path = path_to_sphere(origin, rays.direction, self.radius + height)
        return replace(rays, position=origin + path * rays.direction, z=self.z, chart=self.chart)

    @cached_property
    def bounds(self) -> RadialBounds:
        """Bounds of ρ, by the legs of the control net.

        The nine points of a span lie within √2 pitch / R of one direction.  Half the square of this angle is the
        largest relative difference between their mean and the shortest of them, and it also adds to the slopes.
        """
        rho, d = self.radius + self.heights.detach().cpu().double(), self.directions
        angle = max(self.pitch) / self.radius
        legs = (rho.diff(dim=axis).abs() / torch.sqrt((d.diff(dim=axis + 1) ** 2).sum(0)) for axis in (0, 1))
        slopes = [float(leg.max()) for leg in legs]
        farthest = float(rho.max())
        return RadialBounds(float(rho.min()) * (1 - angle**2), farthest, math.hypot(*slopes) + angle**2 * farthest)

    def _root(self, origin: Tensor, along: Tensor, alive: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (x, y, found) of the first points ahead of rays from `origin` (3, …) along unit vectors (3, …)."""
        nearest, farthest, steepest = self.bounds
        middle, square = dot(origin, along), dot(origin, origin)
        offset = (square - middle * middle).clamp(min=0)  # b²
        steep = alive & ~((square < nearest**2) & (offset * (1 + (steepest / nearest) ** 2) < nearest**2))
        start = self.chart.coordinates(origin + path_to_sphere(origin, along, self.radius) * along)
        x, y, found = self._newton(origin, along, start[:2], alive & ~steep)
        if bool(steep.any()):
            index = steep.nonzero(as_tuple=True)
            at: tuple[slice | Tensor, ...] = (slice(None), *index)
            few, ahead = origin[at], along[at]
            path, place, arrived = self._approach(few, ahead)
            at_x, at_y, met = self._newton(few, ahead, place, arrived)
            root = dot(ahead, self.at(at_x, at_y).position - few)
            near = (root - path).abs() <= APPROACH_DISTANCE / APPROACH_COSINE * self.radius  # otherwise tangent
            x[index], y[index], found[index] = at_x, at_y, met & near
        return x, y, found

    def _newton(
        self, origin: Tensor, along: Tensor, start: Sequence[Tensor], searching: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return (x, y, found) by Newton's method from the coordinates `start`; 0 for rays that are not found."""
        a, b = across(along)
        x, y = (torch.where(searching, p, torch.zeros_like(p)) for p in start)
        x, y = x.clamp(*self.x), y.clamp(*self.y)
        tolerance = ROOT_TOLERANCE * torch.finfo(x.dtype).eps * self.radius
        found = torch.zeros_like(searching)
        for _ in range(NEWTON_STEPS):
            patch = self.at(x, y)
            offset = patch.position - origin
            off_a, off_b = dot(a, offset), dot(b, offset)
            ahead = dot(along, offset) >= -tolerance
            outward = dot(patch.normal, along)
            steep = outward > MIN_COSINE * torch.sqrt(dot(patch.normal, patch.normal))
            met = (torch.maximum(off_a.abs(), off_b.abs()) <= tolerance) & ahead & steep
            found = searching & met
            if bool((found | ~searching).all()):
                break
            (m_xx, m_xy), (m_yx, m_yy) = ((dot(e, patch.along_x), dot(e, patch.along_y)) for e in (a, b))
            det = m_xx * m_yy - m_xy * m_yx
            det = torch.where(det.abs() > 1e-12, det, torch.full_like(det, 1e-12))
            step_x, step_y = (m_yy * off_a - m_xy * off_b) / det, (m_xx * off_b - m_yx * off_a) / det
            length = torch.sqrt(step_x * step_x + step_y * step_y) / (MAX_STEP * self.radius)
            shorter = torch.where(found, 0.0, 1.0).to(x) / length.clamp(min=1.0)
            x, y = (x - shorter * step_x).clamp(*self.x), (y - shorter * step_y).clamp(*self.y)
        return torch.where(found, x, torch.zeros_like(x)), torch.where(found, y, torch.zeros_like(y)), found

    def _approach(self, origin: Tensor, along: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor], Tensor]:
        """Return (path (mm) to just inside the first crossing, (x, y) there, True where there is one) of steep rays.

        Rays that start outside have left the glass already.
        """
        nearest, farthest, steepest = self.bounds
        middle, square = dot(origin, along), dot(origin, origin)
        offset = torch.sqrt((square - middle * middle).clamp(min=0))
        rate = 1 + steepest * offset / nearest**2
        inside = square < nearest**2
        path = torch.where(inside, path_to_sphere(origin, along, nearest), torch.zeros_like(middle))
        end = path_to_sphere(origin, along, farthest)
        near = APPROACH_DISTANCE * self.radius
        arrived, x, y = torch.zeros_like(inside), torch.zeros_like(path), torch.zeros_like(path)
        moving = torch.arange(len(path), device=path.device)  # numbers of the rays under way, ever fewer
        for step in range(APPROACH_STEPS):
            place = origin[:, moving] + path[moving] * along[:, moving]
            x[moving], y[moving], rho = self._below(place)
            residual = rho - torch.sqrt(dot(place, place))
            begun = residual >= -near if step == 0 else torch.ones_like(moving, dtype=torch.bool)
            arrived[moving] = begun & (residual <= near)
            left = begun & ~arrived[moving] & (path[moving] <= end[moving])
            if not bool(left.any()):
                break
            moving = moving[left]
            path[moving] = path[moving] + residual[left] / rate[moving]
        return path, (x, y), arrived

    def _below(self, place: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (x, y, ρ) of the surface in the directions of places (3, …); beyond the net, at its nearest edge."""
        to_x, to_y, _ = self.chart.coordinates(place)
        x, y = to_x.clamp(*self.x), to_y.clamp(*self.y)
        for _ in range(DIRECTION_STEPS):
            now_x, now_y, h = self.chart.coordinates(self.at(x, y).position)
            x, y = (x + to_x - now_x).clamp(*self.x), (y + to_y - now_y).clamp(*self.y)
        return x, y, self.radius + h


def require_radial(surface: Surface) -> RadialSurface:
    """Return a radial surface, in float64; TypeError for another one."""
    if not isinstance(surface, RadialSurface):
        raise TypeError(f"the {surface.kind} is no surface of distances from a centre")
    return surface.plain()


def circle_radius(outline: Outline) -> float:
    """Return the radius (mm, in the chart) of the outline of a radial surface; ValueError unless it is a circle."""
    if not isinstance(outline, Circle):
        raise ValueError(f"lens.outline: {outline.words} is not a circle; give a dome a circle in its chart")
    return float(outline.radius)


@lru_cache(maxsize=8)  # the distances change in tailoring, the directions do not
def _directions(x: tuple[float, float], y: tuple[float, float], sides: tuple[int, int], chart: SphereChart) -> Tensor:
    along = (torch.linspace(*ends, m, dtype=torch.float64) for ends, m in zip((x, y), sides, strict=True))
    return chart.direction(*torch.meshgrid(*along, indexing="ij"))


def path_to_sphere(origin: Tensor, along: Tensor, radius: Tensor | float) -> Tensor:
    """Return the path (mm) to the point at which a ray leaves a sphere about 0, or comes nearest to it."""
    middle = dot(origin, along)
    square = middle * middle - dot(origin, origin) + radius**2
    return torch.sqrt(square.clamp(min=0)) - middle


def across(along: Tensor) -> tuple[Tensor, Tensor]:
    """Return two unit vectors (3, …) perpendicular to unit vectors and to each other (Duff et al. 2017, JCGT 6, 1)."""
    d_x, d_y, d_z = along
    sign = torch.where(d_z >= 0, torch.ones_like(d_z), -torch.ones_like(d_z))
    a = -1 / (sign + d_z)
    b = d_x * d_y * a
    return (
        torch.stack([1 + sign * d_x * d_x * a, sign * b, -sign * d_x]),
        torch.stack([b, sign + d_y * d_y * a, -d_y]),
    )
