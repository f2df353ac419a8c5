"""Plane and sphere against their closed forms in fifty digits, and their slopes against autograd."""

from decimal import Decimal, getcontext

import pytest
import torch

from bstcad.optics.surfaces import Plane, Sphere

getcontext().prec = 50
CURVATURES = (0.0, 1e-9, -1e-9, 1 / 50_000, -1 / 50_000, 0.01, -0.01, 1 / 30)
RADII = (0.0, 0.1, 3.0, 9.7, 14.0)


def exact_sag(c, r2):
    """R - sqrt(R² - r²) in fifty digits, with the sign of c."""
    if c == 0:
        return Decimal(0)
    radius = 1 / Decimal(c)
    root = (radius * radius - Decimal(r2)).sqrt()
    return radius - root if radius > 0 else radius + root


def grid(dtype):
    r = torch.tensor(RADII, dtype=dtype)
    return 0.6 * r, 0.8 * r


@pytest.mark.parametrize("curvature", CURVATURES)
@pytest.mark.parametrize(("dtype", "atol", "rtol"), [(torch.float32, 1e-6, 1e-6), (torch.float64, 0.0, 1e-14)])
def test_sphere_sag_is_the_closed_form(curvature, dtype, atol, rtol):
    """Below 1 nm in float32 and to 1e-14 in float64, also where R - sqrt(R² - r²) has no digit left (R = 50 m)."""
    x, y = grid(dtype)
    h, _, _ = Sphere(15.0, curvature).relative_sag_and_slope(x, y)
    r2 = [Decimal(float(a)) ** 2 + Decimal(float(b)) ** 2 for a, b in zip(x, y, strict=True)]
    for value, expected in zip(h, (float(exact_sag(curvature, r)) for r in r2), strict=True):
        assert float(value) == pytest.approx(expected, rel=rtol, abs=atol)


@pytest.mark.parametrize("curvature", CURVATURES)
def test_sphere_slope_is_the_closed_form(curvature):
    """dz/dx = c x / sqrt(1 - c² r²): the normal points to the centre."""
    x, y = grid(torch.float64)
    h, z_x, z_y = Sphere(15.0, curvature).relative_sag_and_slope(x, y)
    root = torch.sqrt(1 - curvature**2 * (x * x + y * y))
    torch.testing.assert_close(z_x, curvature * x / root, rtol=1e-14, atol=0)
    torch.testing.assert_close(z_y, curvature * y / root, rtol=1e-14, atol=0)
    # each normal line meets the axis in the centre: c (h + x / z_x) = 1
    if curvature:
        off = x != 0
        torch.testing.assert_close((curvature * (h + x / z_x))[off], torch.ones_like(x)[off], rtol=1e-12, atol=0)


@pytest.mark.parametrize("surface", [Plane(8.0), *(Sphere(8.0, c) for c in CURVATURES)], ids=str)
def test_slope_is_the_derivative_of_the_sag(surface):
    x, y = (p.requires_grad_() for p in grid(torch.float64))
    z, z_x, z_y = surface.sag_and_slope(x, y)
    if isinstance(surface, Plane):
        assert z.tolist() == [8.0] * len(RADII) and not z_x.any() and not z_y.any()
        return
    torch.testing.assert_close(torch.autograd.grad(z.sum(), (x, y)), (z_x.detach(), z_y.detach()), rtol=1e-12, atol=0)


@pytest.mark.parametrize("curvature", (0.0, 1e-9, 0.02, -0.05))
def test_gradient_in_the_curvature(curvature):
    """dh/dc = r² / 2 at c = 0; elsewhere against finite differences, of the slopes too."""
    x, y = grid(torch.float64)
    c = torch.tensor(curvature, dtype=torch.float64, requires_grad=True)
    if curvature == 0.0:
        (g,) = torch.autograd.grad(Sphere(0.0, c).relative_sag_and_slope(x, y)[0].sum(), c)
        assert float(g) == pytest.approx(sum(r * r / 2 for r in RADII), rel=1e-12)
    assert torch.autograd.gradcheck(lambda c: Sphere(0.0, c).relative_sag_and_slope(x, y), (c,))


def test_beyond_the_equator_nothing_is_nan():
    """Double where: a point that the sphere does not reach sends no NaN into the gradient of the others."""
    x = torch.tensor([1.0, 9.999999, 10.0, 11.0, 1e6], dtype=torch.float64, requires_grad=True)
    c = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    values = Sphere(0.0, c).relative_sag_and_slope(x, torch.zeros_like(x))
    assert all(torch.isfinite(v).all() for v in values)
    inside = sum(v[0] for v in values)
    gx, gc = torch.autograd.grad(inside, (x, c), retain_graph=True)
    assert torch.isfinite(gx).all() and torch.isfinite(gc)
    gx, gc = torch.autograd.grad(sum(v.sum() for v in values), (x, c))
    assert torch.isfinite(gx).all() and torch.isfinite(gc)
