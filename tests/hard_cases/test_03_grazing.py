"""3. Tangent and grazing rays.

Where a ray only touches a face, a square root passes through zero and a denominator changes its sign; prysm (#78) went
on with the other sign, and the ray left on the wrong side.  Here such a ray is flagged: denominators keep their sign
down to a floor, a face stands no steeper than its equator, and what is not flagged has its hit on the face, comes from
before it and goes on behind it.
"""

from __future__ import annotations

import math
from decimal import localcontext

import pytest
import torch

from bstcad.optics.kernels import forward
from bstcad.optics.lens.interfaces import Refract
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.surfaces import MIN_COS2, Plane, Sphere
from bstcad.optics.trace import trace
from tests.by_slope import deflect, intersect
from tests.hard_cases import exact
from tests.hard_cases.lenses import DTYPES, ENGINES, NAMES, eps, first_crossing, largest, tracing
from tests.lenses import N, bundle, lens_of, net, places, uniform, wavy
from tests.tracing import from_first_net_plain

OFFSETS = [s * 10.0**-k for k in range(1, 13) for s in (1, -1)] + [0.0]
WIDE = Rectangle(60.0, 60.0)
R = 20.0


def touching(offset: float, degrees: float, dtype):
    """A ray at `degrees` from the axis that passes a ball of radius R, vertex at z = 15, at R (1 + offset)."""
    angle = math.radians(degrees)
    out = torch.tensor([math.cos(angle), 0.0, -math.sin(angle)], dtype=torch.float64)  # of the ball where it touches
    way = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)
    point = torch.tensor([0.0, 0.0, 15.0 + R], dtype=torch.float64) + R * (1 + offset) * out
    return bundle(point - 12.0 * way, way, dtype)


def discriminant(rays, sphere: Sphere):
    """(cos θ)² of the line with the sphere, from the numbers as they are; negative: it passes."""
    with localcontext(prec=exact.DIGITS):
        p, d = exact.vector(rays.position[:, 0]), exact.unit(exact.vector(rays.direction[:, 0]))
        c = exact.number(sphere.curvature)
        q = p - exact.vector((0.0, 0.0, exact.number(sphere.z) + 1 / c))
        b = q @ d
        return float((b * b - q @ q) * c * c + 1)


@DTYPES
@pytest.mark.parametrize("degrees", [10.0, 45.0, 80.0])
@pytest.mark.parametrize("offset", OFFSETS)
def test_a_ray_beside_a_ball_hits_or_passes(offset, degrees, dtype, holds):
    """Inside by any distance that floats resolve it hits, outside it is flagged; nothing leaves on the wrong side."""
    sphere, rays = Sphere(15.0, 1 / R), touching(offset, degrees, dtype)
    truth = discriminant(rays, sphere)
    at, z_x, z_y = intersect(sphere, rays, WIDE, Status.MISSED_FRONT)
    resolved = abs(truth) > 16 * eps(dtype)  # a difference of two squares of order 1, from places of some R
    if resolved and truth < 0:
        assert at.status.tolist() == [int(Status.MISSED_FRONT)]
    if truth > 2e-6:  # cosine above 1e-3 in float32's last digits too, and below the equator's guard
        assert at.alive.all()
    if not at.alive.all():
        return
    x, y, z = places(at)[:, 0].tolist()
    error = abs(math.hypot(x, y, z - 15.0 - R) - R)
    # cos² is a difference; a path is known to its square root, and the hit leaves the ball by cos times that
    holds(f"distance of a grazing hit from the sphere, {NAMES[dtype]}", error, 16 * R * eps(dtype), "mm")
    inside = deflect(at, z_x, z_y, Refract(1.0, N)).rays
    normal = torch.stack([-z_x, -z_y, torch.ones_like(z_x)])
    before, behind = ((b.direction * normal).sum(0) for b in (at, inside))
    assert before > 0 or inside.status.tolist() == [int(Status.TOTAL_REFLECTION)]
    if inside.alive.all():
        assert behind > 0 and (inside.direction * rays.direction).sum() > 0  # it goes on, bent by less than 90°


@pytest.mark.parametrize("curvature", [0.1, -0.1])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_along_the_axis_at_the_equator(curvature, dtype, holds):
    """A beam wider than the sphere: outside it is flagged; inside it refracts by the sphere's own normal."""
    radius = torch.tensor([10.0 * (1 + offset) for offset in OFFSETS], dtype=torch.float64).to(dtype)
    lens = Lens.between(Sphere(15.0, curvature), wavy(dtype, z=40.0), WIDE, N)
    rays = CollimatedSource(Circle(30.0)).rays_through(radius, torch.zeros_like(radius), 0.0, 1.0)
    inside = trace.to_first_net(rays, lens)
    c = float(torch.tensor(curvature, dtype=dtype))
    left = 1 - (c * radius.double()) ** 2  # cos² of incidence
    assert torch.equal(inside.alive[left > 2 * MIN_COS2], torch.ones_like(left[left > 2 * MIN_COS2], dtype=torch.bool))
    assert (inside.status[left < MIN_COS2 / 2] == int(Status.MISSED_FRONT)).all()
    at = inside.alive
    sine, cosine = c * radius.double()[at], left[at].sqrt()
    turned = torch.asin(sine / N) - torch.asin(sine)
    off = (inside.direction[0, at].double() - torch.sin(turned)).abs()
    # cos² is known to some units, so the angle to units over the cosine
    figure = f"error of the direction refracted near a sphere's equator, times the cosine of incidence, {NAMES[dtype]}"
    holds(figure, largest(off * cosine), 8 * eps(dtype))
    if dtype == torch.float64:
        found = forward.land(CollimatedSource(Circle(30.0)), lens, LevelPlane(300.0), radius, torch.zeros_like(radius))
        plain = from_first_net_plain(inside, lens, LevelPlane(300.0))
        assert torch.equal(found.status, plain.status)


@ENGINES
@DTYPES
@pytest.mark.parametrize("dz", [0.0, 1e-300, 1e-13, -1e-13, 1e-7, -1e-7, 1e-3, -1e-3, -0.3])
def test_rays_along_a_level_back_are_flagged(dz, engine, dtype):
    """Rays in the glass below a level face: parallel to it, nearly so on either side, and away from it."""
    back = net(m=9, half=12.0, dtype=dtype)
    for depth in (5.0, 1e-3, 1e-9):
        rays = bundle((0.0, 0.0, 20.0 - depth), (1.0, 0.2, dz), dtype)
        with tracing(engine) as through_back:
            landed = through_back(rays, lens_of(back, Plane(8.0)), 100.0)
        assert landed.status.tolist()[0] in (Status.VIGNETTED, Status.TOTAL_REFLECTION)
        assert torch.isfinite(landed.position).all()
        if dz <= 0:
            assert landed.status.tolist() == [int(Status.VIGNETTED)]


def crests(dtype=torch.float64) -> BSplineSurface:
    """Waves with crests at different heights, which light in the glass may touch from below."""
    return net(lambda x, y: torch.cos(0.9 * x) * torch.cos(0.5 * y) + 0.05 * x, m=41, dtype=dtype)


@DTYPES
def test_rays_that_graze_the_waves_of_a_spline(dtype, holds):
    """Turned until they just touch a wave, then a little to both sides: the first crossing is the hit, or a flag."""
    back = crests(dtype)
    exactly = back.to(torch.float64)
    x, y = uniform((2, 60), 0, -8.0, 8.0)
    h, p, q = exactly.relative_sag_and_slope(x, y)
    angle = 2 * math.pi * uniform(60, 1)
    along = torch.stack([torch.cos(angle), torch.sin(angle), p * torch.cos(angle) + q * torch.sin(angle)])
    along = along / along.norm(dim=0) * torch.where(along[2] < 0, -1.0, 1.0)  # in the tangent plane, upwards
    normal = torch.nn.functional.normalize(torch.stack([-p, -q, torch.ones_like(p)]), dim=0)
    point = torch.stack([x, y, back.z + h])
    ways = [along + offset * normal for offset in (0.0, *[s * 10.0**-k for k in (1, 2, 3, 4, 6, 9) for s in (1, -1)])]
    rays = bundle(torch.cat([point - way for way in ways], 1).T, torch.cat(ways, 1).T, dtype)
    at, z_x, z_y = intersect(back, rays, Rectangle(20.0, 20.0), Status.VIGNETTED)
    truth, crest = first_crossing(back, rays)
    below = rays.above(back.z).double() < exactly.relative_sag_and_slope(*rays.position[:2].double())[0]
    assert int(below.sum()) > 200 and not (at.alive & ~below).any()
    t = ((places(at) - places(rays)) * rays.direction.double()).sum(0)
    dx, dy, dz = rays.direction
    cosine = (dz - z_x * dx - z_y * dy).double()

    hit = at.alive & ~truth.isnan()
    first = hit & (crest < -1e-3)  # where no wave was touched before, to the millimetre's thousandth
    error = ((t - truth).abs() * cosine.clamp(min=1e-3))[first]
    figure = f"distance of a grazing hit from the first crossing, {NAMES[dtype]}"
    holds(figure, largest(error), 8 * 10 * eps(dtype), "mm")
    # of what only touches a wave by the steps above, the search may say either: there, or where the line goes on to
    assert int(first.sum()) > 100
    assert (crest[at.alive & truth.isnan()] > -1e-3).all()

    missed = below & ~at.alive & ~truth.isnan()
    x, y, z = places(rays)[:, missed] + truth[missed] * rays.direction.double()[:, missed]
    _, p, q = exactly.relative_sag_and_slope(x, y)
    dx, dy, dz = rays.direction.double()[:, missed]
    flat = dz - p * dx - q * dy < 0.07  # 1.4 ln(1 mm / 1e-4 mm) / 200 steps, F' being 1.4 at most: all of it reflected
    # the steps pass a crest that the ray clears by some micrometres, and do not pass one that it touches
    assert (flat | (dz < 0.011) | (crest[missed] > -0.02)).all()
    inside = deflect(at, z_x, z_y, Refract(N, 1.0)).rays
    assert (inside.status[at.alive & (cosine < 0.5)] == int(Status.TOTAL_REFLECTION)).all()  # light leaves up to 42°
