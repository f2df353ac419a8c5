"""Plane, sphere and conic: their equation, the laws of their foci, and autograd; digits of a sphere: hard case 7."""

import math

import pytest
import torch

from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.surfaces import Conic, Plane, Recess, Sphere, Toroid, sag
from bstcad.optics.trace.trace import to_first_net
from tests.by_slope import intersect
from tests.lenses import SQUARE, bundle, lens_of, net

N = 1.5
CONSTANTS = (-30.0, -2.25, -1.0, -1 / 2.25, 0.0, 0.7, 5.0)
BEAM = CollimatedSource(Circle(9.0))


def places(n=400, reach=8.0, dtype=torch.float64):
    x, y = reach * (2 * torch.rand((2, n), generator=torch.Generator().manual_seed(1), dtype=dtype) - 1)
    return x, y


def behind(front, source=BEAM):
    """Rays in the glass behind a front at z = 15."""
    x, y = places(reach=6.0)
    rays = to_first_net(source.rays_through(x, y, front.z, 1.0), lens_of(net(z=60.0), front, index=N))
    assert rays.alive.all()
    return rays


def crossing_error(rays, x, y, z):
    """Largest distance (mm) of the rays' lines from a point."""
    to = torch.tensor([x, y, z], dtype=torch.float64)[:, None] - torch.stack([*rays.position[:2], rays.above(0.0)])
    return float(torch.linalg.cross(to, rays.direction, dim=0).norm(dim=0).max())


@pytest.mark.parametrize("radius", [30.0, 60.0])
def test_an_ellipsoid_brings_a_parallel_beam_to_its_far_focus(radius):
    """An ellipsoid of eccentricity 1 / n has k = -1 / n² and its focus R n / (n - 1) behind the vertex, in glass."""
    rays = behind(Conic(15.0, 1 / radius, -1 / N**2))
    assert crossing_error(rays, 0.0, 0.0, 15.0 + radius * N / (N - 1)) < 1e-9  # mm


def test_a_hyperboloid_makes_the_light_of_its_far_focus_parallel():
    """A hyperboloid of eccentricity n: k = -n², from a point R / (n - 1) before the vertex."""
    radius = 10.0
    rays = behind(Conic(15.0, 1 / radius, -(N**2)), PointSource((0.0, 0.0, 15.0 - radius / (N - 1))))
    assert float(rays.direction[:2].abs().max()) < 1e-12


@pytest.mark.parametrize("constant", CONSTANTS)
@pytest.mark.parametrize("curvature", [0.0, 1e-9, 0.03, -0.03])
def test_points_fulfil_the_equation(constant, curvature):
    x, y = places()
    h, z_x, z_y = Conic(0.0, curvature, constant).relative_sag_and_slope(x, y)
    residual = curvature * (x * x + y * y) - 2 * h + (1 + constant) * curvature * h * h
    assert float(residual.abs().max()) < 1e-14
    normal = 1 - (1 + constant) * curvature * h  # its gradient is (c x, c y, -(1 - (1 + k) c z))
    torch.testing.assert_close(z_x * normal, curvature * x, rtol=1e-13, atol=1e-16)
    torch.testing.assert_close(z_y * normal, curvature * y, rtol=1e-13, atol=1e-16)


@pytest.mark.parametrize("constant", CONSTANTS)
@pytest.mark.parametrize("curvature", [0.0, 0.03, -0.03])
def test_rays_meet_it_where_it_is(constant, curvature):
    surface = Conic(15.0, curvature, constant)
    x, y = places(reach=6.0)
    at, *_ = intersect(
        surface, PointSource((2.0, -1.0, 3.0)).rays_through(x, y, 15.0, 1.0), SQUARE, Status.MISSED_FRONT
    )
    assert at.alive.all()
    found = torch.from_numpy(sag(surface, *at.position[:2].numpy()))
    torch.testing.assert_close(at.above(0.0), found, rtol=0, atol=1e-12)


def test_the_other_sheet_of_a_hyperboloid_is_not_met():
    """A ray so flat that it passes over the sheet of the vertex; the other sheet lies behind, at -2 / ((1 + k) c)."""
    surface = Conic(0.0, -0.5, -1.5)
    rays = bundle((-8.0, 0.0, 0.5), (0.995, 0.0, 0.1))
    at, *_ = intersect(surface, rays, Circle(100.0), Status.MISSED_FRONT)
    assert not at.alive.any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_conic_of_constant_zero_is_the_sphere_to_the_bit(dtype):
    x, y = places(dtype=dtype)
    rays = PointSource().rays_through(x, y, 15.0, 1.0)
    for c in (0.02, -0.05):
        conic, sphere = Conic(15.0, c), Sphere(15.0, c)
        assert all(map(torch.equal, conic.sag_and_slope(x, y), sphere.sag_and_slope(x, y)))
        assert all(map(torch.equal, conic.crossing(x, y, rays.direction), sphere.crossing(x, y, rays.direction)))


@pytest.mark.parametrize("constant", CONSTANTS)
def test_gradient_in_both_parameters(constant):
    x, y = places(20)
    parameters = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (0.03, constant)]
    assert torch.autograd.gradcheck(lambda c, k: Conic(0.0, c, k).relative_sag_and_slope(x, y), parameters)


def test_beyond_its_rim_nothing_is_nan():
    x = torch.tensor([1.0, 7.0710678, 8.0, 1e6], dtype=torch.float64, requires_grad=True)
    k = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    surface = Conic(0.0, 0.1, k)  # it ends at 1 / (c sqrt(1 + k)) = 7.07 mm
    values = surface.relative_sag_and_slope(x, torch.zeros_like(x))
    assert surface.reaches(x, torch.zeros_like(x)).tolist() == [True, False, False, False]
    assert all(torch.isfinite(v).all() for v in values)
    assert all(torch.isfinite(g).all() for g in torch.autograd.grad(sum(v.sum() for v in values), (x, k)))


@pytest.mark.parametrize("surface", [Plane(8.0), Sphere(8.0, 0.02), Conic(8.0, -0.03, -2.0)], ids=lambda s: s.kind)
def test_every_surface_answers_the_same_questions(surface):
    changed = {name: value / 2 for name, value in surface.parameters().items()}
    assert surface.with_parameters(**changed).parameters() == changed
    assert surface.moved(9.0).z == 9.0 and surface.moved(9.0).parameters() == surface.parameters()
    tensors = {name: torch.tensor(value, dtype=torch.float64) for name, value in surface.parameters().items()}
    assert surface.with_parameters(**tensors).plain() == surface
    assert math.prod(surface.sags(Circle(5.0))) == 0.0
    low, high = surface.sags(Circle(5.0))
    assert sag(surface, 3.0, 4.0) - surface.z == pytest.approx(low + high, abs=1e-14)


def faces_of_each_kind():
    net = BSplineSurface.fitted(Sphere(15.0, 0.02), (-12.0, 12.0), (-12.0, 12.0), 33)
    return [Plane(15.0), Sphere(15.0, 0.02), Conic(15.0, -0.02, -2.0), net, Recess(Sphere(15.0, -0.08), Circle(5.0))]


@pytest.mark.parametrize("surface", faces_of_each_kind(), ids=lambda surface: type(surface).__name__)
def test_a_scaled_surface_goes_through_the_scaled_points(surface):
    (x, y), factor, about = (p.numpy() for p in places()), 1.01, 12.0
    there = surface.scaled(factor, about)
    assert abs(sag(there, factor * x, factor * y) - about - factor * (sag(surface, x, y) - about)).max() < 1e-12


@pytest.mark.parametrize("surface", faces_of_each_kind(), ids=lambda surface: type(surface).__name__)
def test_a_bent_surface_has_so_much_more_curvature_at_its_vertex(surface):
    h, by = 1e-2, 0.001
    higher = sag(surface.bent(by), [-h, 0.0, h], 0.0) - sag(surface, [-h, 0.0, h], 0.0)
    assert (higher[0] - 2 * higher[1] + higher[2]) / h**2 == pytest.approx(by, rel=1e-4)


TOROIDS = [(0.03, 0.05), (0.03, -0.05), (-0.04, 0.0), (0.0, 0.04), (1e-9, 0.05), (0.04, 1e-9)]


@pytest.mark.parametrize(("c_x", "c_y"), TOROIDS)
def test_a_toroid_is_its_circle_along_x_turned_about_the_centre_along_y(c_x, c_y):
    """The points of the circle, turned by up to 25 degrees about z = 1 / c_y, which are shifted along y if c_y = 0."""
    x, y = places()
    circle = sag(Sphere(0.0, c_x), x.numpy(), 0.0)
    if c_y:
        turn, radius = y * abs(c_y), 1 / c_y - torch.from_numpy(circle)
        y, height = radius * torch.sin(turn), torch.from_numpy(circle) + 2 * radius * torch.sin(turn / 2) ** 2
    else:
        height = torch.from_numpy(circle)
    error = abs(sag(Toroid(15.0, c_x, c_y), x.numpy(), y.numpy()) - 15.0 - height.numpy())
    assert error.max() < (1e-13 if abs(c_y) != 1e-9 else 1e-6)  # 1e9 mm away the point itself has no more digits


@pytest.mark.parametrize(("c_x", "c_y"), TOROIDS)
def test_slopes_of_a_toroid_are_the_derivatives_of_its_sag(c_x, c_y):
    x, y = (p.requires_grad_() for p in places(50))
    given = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (c_x, c_y)]
    h, *slopes = Toroid(0.0, c_x, c_y).relative_sag_and_slope(x, y)
    for found, wanted in zip(slopes, torch.autograd.grad(h.sum(), (x, y)), strict=True):
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-14)
    x, y = x.detach(), y.detach()
    assert torch.autograd.gradcheck(lambda *each: Toroid(0.0, *each).relative_sag_and_slope(x, y), given)


def test_a_toroid_ends_where_it_stands_upright_and_beyond_nothing_is_nan():
    x = torch.tensor([0.0, 9.9, 10.1, 0.0, 0.0, 0.0, 50.0], dtype=torch.float64, requires_grad=True)
    y = torch.tensor([0.0, 0.0, 0.0, 4.9, 5.1, 50.0, 50.0], dtype=torch.float64)
    surface = Toroid(0.0, 0.1, 0.2)
    # The circle along x, of 10 mm radius, comes to the line that it turns about at x = 8.7 mm.
    assert surface.reaches(x, y).tolist() == [True, False, False, True, False, False, False]
    values = surface.relative_sag_and_slope(x, y)
    assert all(torch.isfinite(value).all() for value in values)
    assert torch.isfinite(torch.autograd.grad(sum(value.sum() for value in values), x)[0]).all()


@pytest.mark.parametrize("outline", [Rectangle(16.0, 10.0), Circle(7.0)], ids=lambda outline: outline.shape)
@pytest.mark.parametrize(("c_x", "c_y"), TOROIDS)
def test_no_place_inside_the_outline_is_beyond_the_sags_of_a_toroid(c_x, c_y, outline):
    x, y = places(4000)
    inside = outline.contains(x, y)
    h = Toroid(0.0, c_x, c_y).relative_sag_and_slope(x, y)[0][inside]
    low, high = Toroid(15.0, c_x, c_y).sags(outline)
    assert low <= float(h.min()) and float(h.max()) <= high
    assert high - low < 1.1 * max(float(h.max()), 0.0) - 1.1 * min(float(h.min()), 0.0) + 1e-9
