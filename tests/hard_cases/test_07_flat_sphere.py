"""7. A plane as a sphere of no curvature, and spheres that are nearly planes.

R - sqrt(R² - r²) subtracts two numbers of the size of R: at R = 50 m nothing is left in float32 but noise, 200 % of the
sag, and at curvature 0 it divides by zero (optiland #151, #559).  Here the sag is c r² / (1 + sqrt(1 - c² r²)) and the
path to the sphere c r² / (g + sqrt(g² - c² r²)): sums, of which c = 0 is nothing special, with the derivative in c that
a tailored front starts with.  Truth has sixty digits.
"""

from __future__ import annotations

import math
from decimal import Decimal, localcontext

import pytest
import torch

from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace import trace
from tests.by_slope import intersect
from tests.hard_cases import exact
from tests.hard_cases.lenses import DTYPES, NAMES, engines, eps, largest
from tests.lenses import bundle, lens_of, places, uniform, wavy

FLAT = (0.0, 1e-300, 1e-15, 1e-9, -1e-9, 1 / 50_000, -1 / 50_000, 1e-3, 0.01, -0.01, 1 / 30, -1 / 30)
RIM = 14.0  # mm
BOUND = {torch.float32: 1e-6, torch.float64: 1e-14}  # mm


def disc(dtype, n=200) -> tuple[torch.Tensor, torch.Tensor]:
    """Points to the rim, the axis and its neighbourhood among them."""
    r, turn = RIM * uniform(n, 1).sqrt(), 2 * math.pi * uniform(n, 2)
    r[:5] = torch.tensor([0.0, 1e-30, 1e-6, RIM / 2, RIM], dtype=torch.float64)
    return (r * torch.cos(turn)).to(dtype), (r * torch.sin(turn)).to(dtype)


def exact_sag(c: float, x: float, y: float) -> tuple[Decimal, Decimal]:
    """(sag, slope along the radius) with R - sqrt(R² - r²): sixty digits have enough to lose."""
    with localcontext(prec=exact.DIGITS):
        r2 = exact.number(x) ** 2 + exact.number(y) ** 2
        if abs(c) < 1e-30:
            return exact.number(c) * r2 / 2, exact.number(c) * r2.sqrt()
        radius = 1 / exact.number(c)
        root = (radius * radius - r2).sqrt()
        return (radius - root if radius > 0 else radius + root), r2.sqrt() / root * (1 if radius > 0 else -1)


@DTYPES
@pytest.mark.parametrize("curvature", FLAT)
def test_sag_and_slope_have_all_their_digits(curvature, dtype, holds):
    """The curvature is the float that the program has; in float32 it meets float32 places."""
    x, y = disc(dtype)
    h, z_x, z_y = Sphere(15.0, curvature).relative_sag_and_slope(x, y)
    truth = [exact_sag(curvature, a, b) for a, b in zip(x.tolist(), y.tolist(), strict=True)]
    sag = torch.tensor([float(abs(exact.number(a) - b[0])) for a, b in zip(h.tolist(), truth, strict=True)])
    holds(f"error of the sag, up to 14 mm from the axis, {NAMES[dtype]}", float(sag.max()), BOUND[dtype], "mm")
    size = torch.tensor([float(abs(b[0])) for b in truth])
    relative = (sag / size.clamp(min=1e-300))[size > 1e-30]
    # eight operations, of which the root halves what is before it: relative to the sag itself, however small
    if relative.numel():
        holds(f"error of the sag, relative to the sag, {NAMES[dtype]}", float(relative.max()), 4 * eps(dtype))
    steep = torch.tensor([float(b[1]) for b in truth], dtype=torch.float64)
    along = torch.hypot(z_x.double(), z_y.double()) * (1 if curvature >= 0 else -1)
    holds(f"error of the slope, {NAMES[dtype]}", largest(along - steep), 8 * eps(dtype))


@DTYPES
@pytest.mark.parametrize("source", [PointSource(), CollimatedSource(Circle(12.0))], ids=("point", "collimated"))
def test_no_curvature_is_the_plane_to_the_bit(source, dtype):
    """Closed form and kernels: a sphere of curvature 0, or too small for any sag, traces as the plane does."""
    x, y = (p[:150] * 0.5 for p in disc(dtype))
    fronts = (Plane(15.0), Sphere(15.0, 0.0), Sphere(15.0, -0.0))
    plane, *others = ([found.position for _, found in engines(source, lens_of(wavy(dtype), front), x, y, 300.0)]
                      for front in fronts)  # fmt: skip
    assert all(torch.equal(a, b) for other in others for a, b in zip(other, plane, strict=True))
    tiny = trace.trace(
        source.rays_through(x, y, 15.0, 1.0), lens_of(wavy(dtype), Sphere(15.0, 1e-300)), LevelPlane(300.0)
    ).position
    assert torch.equal(tiny, plane[2])


@DTYPES
@pytest.mark.parametrize("curvature", FLAT)
def test_a_ray_meets_the_nearly_flat_sphere(curvature, dtype, holds):
    """The hit lies on the exact sphere, and the path to it keeps the digits of the sag."""
    x, y = (0.6 * p for p in disc(dtype))
    rays = bundle((1.0, -2.0, 0.0), torch.stack([x, y, torch.full_like(x, 15.0)], 1), dtype)
    sphere = Sphere(15.0, curvature)
    at, _, _ = intersect(sphere, rays, Rectangle(40.0, 40.0), Status.MISSED_FRONT)
    assert at.alive.all()
    on = [exact_sag(curvature, a, b)[0] for a, b in zip(*at.position[:2].tolist(), strict=True)]
    error = max(float(abs(exact.number(a) - b)) for a, b in zip(at.position[2].tolist(), on, strict=True))
    # the sag moves with the hit, by a slope below 1.4: the place is known to two units of 14 mm, the sag to half of one
    holds(f"distance of the hit from the sphere, {NAMES[dtype]}", error, 8 * RIM * eps(dtype), "mm")
    start, way = places(rays), rays.direction.double()
    off_line = torch.linalg.cross(places(at) - start, way, dim=0).norm(dim=0)
    holds(f"distance of the hit from its ray, {NAMES[dtype]}", largest(off_line), 8 * RIM * eps(dtype), "mm")
