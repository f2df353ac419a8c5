"""5. Rays that cross a face twice, or only behind their start.

A line may meet a face twice or more, or behind its start.  Newton's method takes whichever root it falls into (rayx
#467), a closed form the one its sign was written for (DeepLens #66), and a hit behind the start is taken for one ahead
(optiland #753).  Here a spline's control legs bound its slopes, which says of each ray whether its root is the only
one; where it need not be, the ray is led to the first crossing by steps that cannot pass one (interfaces.py).  A
sphere's root is that of its near cap.  What starts behind a face, or meets it only behind its start or outside the
outline, is a miss.
"""

from __future__ import annotations

import math

import pytest
import torch

from bstcad.optics.kernels import forward
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace import trace
from tests.by_slope import intersect
from tests.hard_cases.lenses import DTYPES, ENGINES, NAMES, eps, first_crossing, largest, tracing
from tests.lenses import SQUARE, N, bundle, net, places, uniform
from tests.tracing import from_first_net_plain

HALF = 10.0


def waves(depth: float, number: float, dtype=torch.float64) -> BSplineSurface:
    """Waves both ways, slopes up to depth · number / 10."""
    k = number / HALF
    return net(lambda x, y: depth * torch.cos(k * x) * torch.cos(k * y + 0.4), m=33, half=HALF, dtype=dtype)


def from_below(back: BSplineSurface, steepest: float, n: int, dtype=torch.float64, seed=0):
    """Rays from below the face, up to `steepest` degrees off the axis."""
    x, y = uniform((2, n), seed, -9.5, 9.5)
    angle, turn = math.radians(steepest) * uniform(n, seed + 1), 2 * math.pi * uniform(n, seed + 2)
    way = torch.stack([torch.sin(angle) * torch.cos(turn), torch.sin(angle) * torch.sin(turn), torch.cos(angle)], 1)
    start = torch.stack([x, y, torch.full_like(x, back.z + float(back.heights.min()) - 0.5)], 1)
    return bundle(start, way, dtype)


STEEP = [(0.5, 3.0, 42.0), (2.0, 6.0, 42.0), (1.0, 12.0, 60.0), (2.0, 12.0, 42.0), (2.0, 12.0, 75.0)]


@DTYPES
@pytest.mark.parametrize(("depth", "number", "degrees"), STEEP)
def test_of_many_roots_of_a_spline_the_first_ahead_counts(depth, number, degrees, dtype, holds):
    back = waves(depth, number, dtype)
    rays = from_below(back, degrees, 400, dtype)
    at, z_x, z_y = intersect(back, rays, SQUARE, Status.VIGNETTED)
    truth, _ = first_crossing(back, rays)
    t = ((places(at) - places(rays)) * rays.direction.double()).sum(0)
    dx, dy, dz = rays.direction
    along = dz - z_x * dx - z_y * dy
    met = ~truth.isnan()
    assert int(met.sum()) > 300
    assert not (at.alive & ~met).any()  # where there is no root there is no hit
    # a crossing at less than 1e-3 to the face may be called a miss; F is then flat and small for long
    missed = met & ~at.alive
    assert int(missed.sum()) <= 0.005 * 400
    found = met & at.alive
    # F is known to some units of the lens's size and the hit by the cosine of incidence; the truth is that of float64
    error = ((t - truth).abs() * along.double().clamp(min=1e-2))[found]
    holds(f"distance of the hit from the first crossing, {NAMES[dtype]}", largest(error), 16 * HALF * eps(dtype), "mm")
    assert (along[found] > -1e-3).all()  # from inside: light leaves there


@pytest.mark.parametrize(("depth", "number", "degrees"), STEEP)
def test_all_forms_choose_the_same_root(depth, number, degrees):
    back = waves(depth, number)
    rays = from_below(back, degrees, 3000)
    lens = Lens.between(Plane(8.0), back, SQUARE, N)
    landed = {}
    for engine in ("plain", "fused"):
        with tracing(engine) as through_back:
            landed[engine] = through_back(rays, lens, 200.0)
    one, two = landed["plain"], landed["fused"]
    assert torch.equal(one.status, two.status)
    lands = one.alive
    off = (one.position - two.position)[:, lands].abs() / (1 + one.position[:, lands] ** 2)
    assert largest(off) < 1e-9  # the same crossing; beside it they would part by millimetres


def test_the_forward_kernel_chooses_it_too():
    """A near source before a plane front: rays in the glass up to 38° off the axis, waves steeper than that allows."""
    source, lens = PointSource((1.0, 0.5, 12.0)), Lens.between(Plane(15.0), waves(2.5, 12.0), SQUARE, N)
    x, y = uniform((2, 3000), 5, -9.9, 9.9)
    rays = source.rays_through(x, y, 15.0, 1.0)
    in_glass = trace.to_first_net(rays, lens)
    plain = from_first_net_plain(in_glass, lens, LevelPlane(200.0))
    found = forward.land(source, lens, LevelPlane(200.0), x, y)
    assert torch.equal(found.status, plain.status)
    lands = plain.alive
    assert int(lands.sum()) > 300
    off = (found.position - plain.position)[:, lands].abs() / (1 + plain.position[:, lands] ** 2)
    assert largest(off) < 1e-9


@ENGINES
@DTYPES
def test_a_start_behind_the_face_is_a_miss(engine, dtype):
    """Beyond a smooth face, beyond a wave of a steep one, and on the far side of a wave that lies ahead."""
    smooth, steep = waves(0.5, 3.0, dtype), waves(2.0, 12.0, dtype)
    for back in (smooth, steep):
        lens = Lens.between(Plane(8.0), back, SQUARE, N)
        x = torch.linspace(-9.0, 9.0, 60, dtype=torch.float64)
        top = back.z + back.to(torch.float64).relative_sag_and_slope(x, 0 * x)[0] + 0.05
        start = torch.stack([x, 0 * x, top], 1)
        for way in ((0.3, 0.1, 1.0), (-0.8, 0.0, 1.0), (2.0, 0.0, 1.0), (0.0, 0.0, 1.0)):
            rays = bundle(start, way, dtype)
            with tracing(engine) as through_back:
                landed = through_back(rays, lens, 200.0)
            assert not landed.alive.any()
            if back is steep or way[0] ** 2 < 1:
                assert set(landed.status.tolist()) == {int(Status.VIGNETTED)}


@DTYPES
@pytest.mark.parametrize(("curvature", "reach"), [(0.2, 8.0), (0.05, 15.0), (-0.05, 15.0), (-0.2, 8.0)])
def test_of_two_roots_of_a_sphere_the_near_cap_counts(curvature, reach, dtype, holds):
    """Roots of |p + t d - C|² = R² in float64: the one on the side of the vertex, if ahead and inside the outline."""
    outline, radius = Circle(0.8 / abs(curvature)), 1 / curvature
    x, y = uniform((2, 2000), 7, -reach, reach)
    start = torch.stack([uniform(2000, 8, -3.0, 3.0), uniform(2000, 9, -3.0, 3.0), torch.full_like(x, 2.0)], 1)
    rays = bundle(start, torch.stack([x, y, torch.full_like(x, 15.0)], 1) - start, dtype)
    at, _, _ = intersect(Sphere(15.0, curvature), rays, outline, Status.MISSED_FRONT)
    p, d = places(rays), torch.nn.functional.normalize(rays.direction.double(), dim=0)
    q = p - torch.tensor([0.0, 0.0, 15.0 + radius], dtype=torch.float64)[:, None]
    b = (q * d).sum(0)
    gap = b * b - (q * q).sum(0) + radius**2
    both = -b + torch.stack([-gap.clamp(min=0).sqrt(), gap.clamp(min=0).sqrt()])
    z = p[2] + both * d[2] - 15.0
    on_cap = (gap > 0) & (both >= 0) & (z * curvature < 1) & (z * curvature >= -1e-9)
    ends = p + torch.where(on_cap, both, torch.inf).amin(0) * d
    rim = ends[:2].norm(dim=0)
    meets = on_cap.any(0) & (rim <= outline.radius)
    clear = (gap.abs() > 1e-3) & ~((rim - outline.radius).abs() <= 1e-3)
    assert torch.equal(at.alive[clear], meets[clear]) and int(meets.sum()) > 200
    off = ((places(at) - ends).norm(dim=0) * (gap.clamp(min=1e-3).sqrt() * abs(curvature)))[meets & at.alive & clear]
    # |F| to some units of the radius, over the cosine of incidence
    figure = f"distance of the hit from the near cap of a sphere, {NAMES[dtype]}"
    holds(figure, largest(off), 64 * abs(radius) * eps(dtype), "mm")
