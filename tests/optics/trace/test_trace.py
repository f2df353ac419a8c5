"""The trace against Snell's law, closed-form lenses, and finite differences."""

import math
from dataclasses import replace

import pytest
import torch

from bstcad.optics.lens.interfaces import Refract
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace import trace
from tests.by_slope import deflect, intersect
from tests.lenses import SQUARE, N, bundle, net, places, tilted, wavy
from tests.tracing import from_first_net_plain, stratified


def from_point(n=40, half=9.0, z=15.0, source=None, dtype=torch.float64):
    x, y = stratified(Rectangle(2 * half, 2 * half), n, 0, dtype)
    return (source or PointSource()).rays_through(x, y, z, 1.0)


def heading(rays, surface, outline=SQUARE):
    return intersect(surface, rays, outline, Status.VIGNETTED)


# Snell's law


def random_incidence(n=2000, seed=0):
    """Directions and slopes with the ray coming from the side of -z."""
    random = torch.Generator().manual_seed(seed)
    direction = torch.randn((3, n), generator=random, dtype=torch.float64)
    direction[2] = direction[2].abs() + 0.1
    z_x, z_y = torch.randn((2, n), generator=random, dtype=torch.float64)
    direction = direction / direction.norm(dim=0)
    ahead = direction[2] - z_x * direction[0] - z_y * direction[1] > 1e-3
    return bundle((0.0, 0.0, 0.0), direction.T[ahead]), z_x[ahead], z_y[ahead]


def normal(z_x, z_y):
    n = torch.stack([-z_x, -z_y, torch.ones_like(z_x)])
    return n / n.norm(dim=0)


@pytest.mark.parametrize(("n_in", "n_out"), [(1.0, N), (N, 1.0), (1.0, 3.0), (1.5, 1.5)])
def test_snell_on_cross_products(n_in, n_out):
    before, z_x, z_y = random_incidence()
    after = deflect(before, z_x, z_y, Refract(n_in, n_out)).rays
    ok, big_n = after.alive, normal(z_x, z_y)
    assert int(ok.sum()) > 100
    tangential = torch.linalg.cross(before.direction, big_n, dim=0)
    refracted = torch.linalg.cross(after.direction, big_n, dim=0)
    torch.testing.assert_close((n_out * refracted)[:, ok], (n_in * tangential)[:, ok], rtol=0, atol=1e-14)
    torch.testing.assert_close(after.direction.norm(dim=0), torch.ones_like(z_x), rtol=0, atol=1e-14)
    assert float((refracted * before.direction).sum(0)[ok].abs().max()) < 1e-15  # d, d' and N lie in one plane
    assert ((after.direction * big_n).sum(0)[ok] > 0).all()  # the light goes on
    sine = n_in / n_out * tangential.norm(dim=0)
    assert torch.equal(after.status == Status.TOTAL_REFLECTION, sine >= 1)
    assert not after.axial


# Hits


def test_hits_lie_on_the_surface():
    for surface in (wavy(z=15.0), Sphere(15.0, -0.03), Sphere(15.0, 0.05), Plane(15.0)):
        rays = from_point(half=6.0)
        at, z_x, z_y = heading(rays, surface)
        assert at.alive.all()
        z, s_x, s_y = surface.sag_and_slope(at.position[0], at.position[1])
        torch.testing.assert_close(at.above(0.0), z, rtol=0, atol=1e-14 * 15)
        torch.testing.assert_close((z_x, z_y), (s_x, s_y), rtol=0, atol=1e-12)
        off_line = torch.linalg.cross(places(at) - places(rays), rays.direction, dim=0)
        assert float(off_line.norm(dim=0).max()) < 1e-13


@pytest.mark.parametrize("form", [trace.from_first_net, from_first_net_plain])
def test_a_ray_that_turns_back_does_not_land(form):
    """60° from the axis in glass, the back face tilted by 20°: it leaves at 74.6° from the normal, 94.6° from the axis,
    and moves away from the screen; its line meets the screen's plane only behind it."""
    back = tilted(-math.tan(math.radians(20)))
    leaving = bundle([[-3.0, 0.0, 19.0]], [[math.sin(math.radians(60)), 0.0, math.cos(math.radians(60))]])
    lens = Lens.between(Plane(15.0), back, SQUARE, 1.5)
    at_back, z_x, z_y = heading(leaving, back)
    turned = deflect(at_back, z_x, z_y, Refract(1.5, 1.0)).rays.direction[:, 0].tolist()
    leaves = math.degrees(math.asin(1.5 * math.sin(math.radians(40))))
    assert math.degrees(math.acos(turned[2])) == pytest.approx(20 + leaves)
    assert not form(leaving, lens, LevelPlane(1000.0)).alive.any()


def test_axial_closed_form_is_the_newton_answer():
    x, y = stratified(Rectangle(22.0, 22.0), 30, 0)
    axial = CollimatedSource(Circle(12.0)).rays_through(x, y, 8.0, 1.0)
    searched = replace(axial, axial=False)
    for front in (Plane(8.0), Sphere(8.0, -0.03)):
        lens = Lens.between(front, wavy(), SQUARE, N)
        closed, newton = (
            from_first_net_plain(trace.to_first_net(b, lens), lens, LevelPlane(1000.0)) for b in (axial, searched)
        )
        assert torch.equal(closed.status, newton.status) and 0 < int(closed.alive.sum()) < 900
        there = closed.alive
        torch.testing.assert_close(closed.position[:, there], newton.position[:, there], rtol=0, atol=1e-9)


# Lenses with closed answers


def test_a_plane_parallel_plate_shifts_and_does_not_turn():
    """Lateral shift t sin θ (1 - cos θ / (n cos θ')), the textbook's."""
    rays, thickness = from_point(half=6.0), 5.0
    lens = Lens.between(Plane(15.0), net(z=15.0 + thickness), SQUARE, N)
    at_back, z_x, z_y = heading(trace.to_first_net(rays, lens), lens.back)
    out = deflect(at_back, z_x, z_y, Refract(N, 1.0)).rays
    assert out.alive.all()
    torch.testing.assert_close(out.direction, rays.direction, rtol=0, atol=1e-14)
    sine = rays.direction[:2].norm(dim=0)
    cos_in, cos_glass = rays.direction[2], torch.sqrt(1 - (sine / N) ** 2)
    shift = torch.linalg.cross(places(out), rays.direction, dim=0).norm(dim=0)  # the source is the origin
    expected = thickness * sine * (1 - cos_in / (N * cos_glass))
    torch.testing.assert_close(shift, expected, rtol=0, atol=1e-13)
    # and so it lands: tan θ in air, tan θ' in glass
    landed = trace.trace(rays, lens, LevelPlane(500.0))
    reach = sine / cos_in * (500.0 - thickness) + thickness * sine / N / cos_glass
    torch.testing.assert_close(landed.position.norm(dim=0), reach, rtol=0, atol=1e-11)


@pytest.mark.parametrize("curvature", [0.02, -0.02])
@pytest.mark.parametrize("z", [25.0, 100.0, 1000.0])
def test_paraxial_rays_follow_the_transfer_matrix(curvature, z):
    """Curved front, flat back: power (n - 1) c; with thickness t the ray of height h lands at
    h (1 - (n - 1) c t / n) - h (n - 1) c (z - z_back); the focus is f - t / n behind the back, f = 1 / ((n - 1) c)."""
    thickness, power = 6.0, (N - 1) * curvature
    lens = Lens.between(Sphere(14.0, curvature), net(), SQUARE, N)
    h = torch.tensor([1e-3, 2e-3], dtype=torch.float64)
    rays = CollimatedSource(Circle(5.0)).rays_through(h, -h, 0.0, 1.0)
    expected = h * (1 - power * thickness / N) - h * power * (z - 20.0)
    landed = trace.trace(rays, lens, LevelPlane(z))
    atol = 10 * float(h.max()) ** 3 * curvature**2 * z * abs(curvature) + 1e-15 * z  # third-order aberration
    torch.testing.assert_close(landed.position, torch.stack([expected, -expected]), rtol=0, atol=atol)
    if curvature > 0:
        at_focus = trace.trace(rays, lens, LevelPlane(20.0 + 1 / power - thickness / N))
        assert float(at_focus.position.abs().max()) < 1e-9


def test_a_prism_deviates_by_its_closed_form():
    """Flat front, back tilted by α: sin(α + δ) = n sin α for rays along the axis, δ towards the thicker side."""
    slope = 0.3
    x, y = sampling.grid(SQUARE, 5)
    rays = CollimatedSource(Circle(30.0)).rays_through(x, y, 0.0, 1.0)
    landed = trace.trace(rays, Lens.between(Plane(8.0), tilted(slope), SQUARE, N), LevelPlane(1000.0))
    tilt = math.atan(slope)
    turn = math.asin(N * math.sin(tilt)) - tilt
    # normal (-s, 0, 1): leaving glass the ray bends away from the normal, to +x
    expected = x + math.tan(turn) * (1000 - 20 - slope * x)
    torch.testing.assert_close(landed.position, torch.stack([expected, y]), rtol=0, atol=1e-10)


# Gradients


@pytest.mark.parametrize("curvature", [0.0, -0.03])
@pytest.mark.parametrize("kind", ["point", "collimated"])
def test_gradient_in_curvature_net_and_start_is_finite_differences(kind, curvature):
    """The implicit gradient of both hits: everything a designer may tailor, and the rays themselves."""
    start = wavy(m=5)
    source = PointSource() if kind == "point" else CollimatedSource(Circle(12.0))

    def landing(heights, curvature, x, y):
        lens = Lens.between(Sphere(15.0, curvature), replace(start, heights=heights), SQUARE, N)
        return trace.trace(source.rays_through(x, y, 15.0, 1.0), lens, LevelPlane(60.0)).position

    x, y = (a.reshape(-1).requires_grad_() for a in stratified(Rectangle(12.0, 12.0), 2, 0))
    c = torch.tensor(curvature, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(landing, (start.heights.clone().requires_grad_(), c, x, y), fast_mode=True)
