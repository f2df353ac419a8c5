"""2. Incidence exactly at the critical angle, and 1e-2 to 1e-8 rad from it.

The derivative of refraction grows without bound towards the critical angle.  DiffOptics clamps the square under the
root at 1e-8 and loses the gradient of every ray below that; elsewhere it is infinite (mitsuba3 #279).  Here the
value is exact, and so is the derivative η² cos θ / cos θ' as long as cos θ' > 1e-3 (5e-7 rad from the angle); nearer it
keeps its sign and stays at what it is there.  A reflected ray has no gradient.  Fresnel losses are not built: a ray
carries all of its light through or none, so R + T = 1 is that of a flag, and the ledger is what is summed here.
"""

from __future__ import annotations

import math
from dataclasses import replace
from decimal import Decimal, localcontext

import pytest
import torch

from bstcad.optics.lens.interfaces import MIN_COS_REFRACTION, Refract
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.rays import Rays, Status
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace import tubes
from tests.by_slope import deflect
from tests.hard_cases import exact
from tests.hard_cases.lenses import DTYPES, NAMES, eps, landing_gradient, largest
from tests.lenses import N, bundle, lens_of, uniform, wavy
from tests.tracing import simulated

OFFSETS = [s * 10.0**-k for k in range(2, 9) for s in (1, -1)] + [0.0]
CRITICAL = math.asin(1 / N)
ETA = Decimal(N)


def meeting(angle: float, dtype) -> tuple[Rays, torch.Tensor, torch.Tensor]:
    """A ray at an angle from the normal of a level face, its slopes, and its direction; the last two take gradients."""
    way = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64).to(dtype).requires_grad_()
    rays = replace(bundle((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), dtype), direction=way[:, None])
    return rays, torch.zeros((2, 1), dtype=dtype).requires_grad_(), way


def cosine_squared(way: torch.Tensor) -> Decimal:
    """cos² θ' = 1 - η² (1 - cos² θ) of the direction as the floats have it, exactly."""
    with localcontext(prec=exact.DIGITS):
        return 1 - ETA * ETA * (1 - exact.number(way.detach()[2]) ** 2)


@DTYPES
@pytest.mark.parametrize("offset", OFFSETS)
def test_flag_and_direction(offset, dtype, holds):
    rays, slopes, way = meeting(CRITICAL + offset, dtype)
    after = deflect(rays, *slopes, Refract(N, 1.0)).rays
    truth = cosine_squared(way)
    assert after.status[0] in (Status.ALIVE, Status.TOTAL_REFLECTION)
    if abs(truth) > 4 * eps(dtype):  # cos² is a difference of numbers of order 1: two products and a difference
        assert bool(after.alive[0]) is (truth > 0)
    if abs(offset) >= 32 * eps(dtype):  # d cos² / dθ is 2.2 there
        assert bool(after.alive[0]) is (offset < 0)
    error = abs(float(after.direction.detach().double().norm()) - 1)
    holds(f"length of the direction minus 1, {NAMES[dtype]}", error, 4 * eps(dtype))
    if after.alive[0]:
        height = float(after.direction[2].detach())  # cos θ'; its square is off by some units
        figure = f"error of cos² θ' (θ': angle of refraction), compared with 60 digits, {NAMES[dtype]}"
        holds(figure, abs(height**2 - float(truth)), 4 * eps(dtype))
    assert torch.equal(after.flux, rays.flux)


@DTYPES
@pytest.mark.parametrize("offset", OFFSETS)
def test_the_gradient_is_the_derivative_up_to_its_cap(offset, dtype, holds):
    """∂ cos θ' / ∂ cos θ on a level face; all other derivatives follow from it by the chain rule."""
    rays, slopes, way = meeting(CRITICAL + offset, dtype)
    after = deflect(rays, *slopes, Refract(N, 1.0)).rays
    g_way, g_slopes = torch.autograd.grad(after.direction[2].sum(), (way, slopes), materialize_grads=True)
    everything = [*torch.autograd.grad(deflect(rays, *slopes, Refract(N, 1.0)).rays.direction.sum(), (way, slopes),
                                       materialize_grads=True), g_way, g_slopes]  # fmt: skip
    assert all(torch.isfinite(g).all() for g in everything)
    cap = N * N / MIN_COS_REFRACTION
    # a slope turns the normal by less than itself, and the normal enters with η cos θ and cos θ' besides: 4 η
    holds(f"largest derivative of the direction, {NAMES[dtype]}", max(largest(g) for g in everything), 2 * cap + 4 * N)
    if not after.alive[0]:
        assert not any(g.any() for g in everything)
        return
    cosine = math.sqrt(max(float(cosine_squared(way)), 0.0))
    expected = N * N * float(way[2].detach()) / max(cosine, MIN_COS_REFRACTION)
    # cos² is known to 2 units, and the derivative is divided by its root: relative 1 / max(cos², MIN_COS_REFRACTION²)
    error = abs(float(g_way[2]) / expected - 1) * max(cosine, MIN_COS_REFRACTION) ** 2
    holds(f"relative error of ∂ cos θ' / ∂ cos θ, times cos² θ', {NAMES[dtype]}", error, 4 * eps(dtype))


def near_critical(back: BSplineSurface, n: int, spread: float) -> Rays:
    """Rays in the glass that meet a face under the critical angle less up to `spread`, and lead on to the screen."""
    x, y = uniform((2, n), 0, -8.0, 8.0)
    h, p, q = back.relative_sag_and_slope(x, y)
    normal = torch.nn.functional.normalize(torch.stack([-p, -q, torch.ones_like(p)]), dim=0)
    across = uniform((3, n), 1, -1.0, 1.0)
    across = torch.nn.functional.normalize(across - (across * normal).sum(0) * normal, dim=0)
    angle = CRITICAL - spread * uniform(n, 2)
    way = torch.cos(angle) * normal + torch.sin(angle) * across
    out = across[2]  # light that leaves along the face goes this way
    ahead = (way[2] > 0.3) & (out > 0.1)
    start = torch.stack([x, y, back.z + h]) - 2 * way
    return bundle(start.T[ahead], way.T[ahead])


@pytest.mark.parametrize("spread", [2e-16, 1e-9, 1e-5])
def test_the_back_face_keeps_to_the_same_rule_in_every_form(spread, holds):
    """Thousands of rays within some units of the angle, where cos² rounds to nothing in one form and not in another."""
    back = wavy(m=9, depth=3.0, ripple=0.2)
    rays = near_critical(back, 40_000, spread)
    count = rays.flux.numel()
    assert count > 3000
    gradients, found = [], {}
    for engine in ("plain", "mixed", "fused"):
        landed, g = landing_gradient(rays, lens_of(back, Plane(8.0)), 1000.0, engine)
        assert torch.isfinite(landed.position[:, landed.alive]).all() and torch.isfinite(g).all()
        assert {int(s) for s in landed.status.unique()} <= {Status.ALIVE, Status.TOTAL_REFLECTION, Status.VIGNETTED}
        gradients.append(largest(g) / int(landed.alive.sum()))
        found[engine] = landed.status, g
    # per ray: a slope turns d' by at most 2 η² / MIN_COS_REFRACTION, and the landing moves by throw / ez² < 1e3 / 0.1²
    # of that angle; a control point acts on two slopes, by less than 2 / pitch each
    bound = 2 * N * N / MIN_COS_REFRACTION * 1e5 * 2 * 2 / back.pitch[0]
    figure = "derivative of a landing point by a control point, divided by its theoretical limit"
    holds(figure, max(gradients) / bound, 1.0)
    if spread == 1e-5:  # where the cap sets in; nearer the angle one form reflects other rays than the other
        (status, plain), (other, fused) = found["plain"], found["fused"]
        assert torch.equal(status, other)
        # cos θ' > MIN_COS_REFRACTION is known to 1e-16 / MIN_COS_REFRACTION², and below that it hardly counts
        figure = "difference between compiled and plain gradient at the critical angle, float64"
        bound = 100 * eps(plain.dtype) / MIN_COS_REFRACTION**2
        holds(figure, largest(plain - fused) / largest(plain), bound)


@DTYPES
def test_tubes_across_the_angle(dtype, holds):
    """A bowl whose rim reflects a cone's light: tubes carry what rays find to leave, but for those on the border."""
    back = wavy(dtype, m=33, depth=5.0, ripple=0.0)
    lens = lens_of(replace(back, heights=back.heights.requires_grad_()), Plane(15.0), Circle(9.0), 1.6)
    n, source, screen = 61, PointSource(profile="uniform", half_angle=30.0), Screen(60.0, (-1e9, 1e9), (-1e9, 1e9), 8)
    told = simulated(source, lens, screen, 400, 0).flux
    leaves = told["on target"] + told["off target"]
    assert told["total internal reflection"] > 0.02
    sheet = tubes.launch_tubes(source, lens, n)
    corners = sheet.landing(lens, LevelPlane(screen.z))
    through = corners.alive
    some = through[1:, 1:] | through[1:, :-1] | through[:-1, 1:] | through[:-1, :-1]
    whole, border = float(sheet.arriving_flux(corners).sum()), float(sheet.flux[some].sum())
    # 400² stratified rays: a rim of 400 cells of which half a cell is random
    assert whole - 1e-3 <= leaves <= border + 1e-3
    picture, outside = sheet.collect(corners, screen)
    won = abs(float(picture.detach().sum()) - whole)
    holds("tubes across the critical angle: part of their light that is lost or gained", won, n * eps(torch.float64))
    (g,) = torch.autograd.grad(picture.square().sum() + outside, lens.back.heights)
    assert torch.isfinite(g).all()
    holds("sum of the ledger across the critical angle, minus 1", abs(sum(told.values()) - 1), 400 * eps(torch.float64))
