"""The slope fit against surfaces that are known, and Snell's law inverted against Snell's law."""

import math

import pytest
import torch

from bstcad.optics.lens.interfaces import Refract
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.receivers import LevelPlane, TiltedPlane
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace.reach import MAX_SLOPE, largest_deflection, wanted_slopes
from bstcad.optics.trace.trace import to_first_net, trace
from bstcad.tailoring.merit import mean_square_miss
from bstcad.tailoring.slope_fit import Fit, fit_slopes, tailor_to_aim
from tests.by_slope import deflect, intersect
from tests.lenses import SQUARE, net
from tests.tracing import stratified


def surface(m, phase, size=0.05):
    return net(lambda x, y: size * torch.sin(0.3 * x + phase) * torch.cos(0.2 * y), m=m)


@pytest.mark.parametrize(
    ("source", "front"),
    [
        (CollimatedSource(Circle(8.0)), Plane(8.0)),
        (PointSource(), Sphere(15.0, 0.02)),
        (PointSource((1.0, -2.0, 0.0)), Plane(15.0)),
    ],
    ids=("collimated", "point", "off axis"),
)
@pytest.mark.parametrize(
    "plane", [LevelPlane(900.0), TiltedPlane((40.0, -9.0, 900.0), (35.0, -50.0))], ids=["level", "tilted"]
)
def test_wanted_slopes_are_snells_law_inverted(source, front, plane):
    """Slopes measured on a traced lens are the ones wanted for where its rays land."""
    lens = Lens.between(front, surface(17, 1.0, 0.4), SQUARE, 1.488)
    x, y = sampling.grid(Rectangle(11.0, 11.0), 15)
    rays = source.rays_through(x, y, front.z, 1.0)
    landed = trace(rays, lens, plane)
    at_face, z_x, z_y = intersect(lens.back, to_first_net(rays, lens), SQUARE, Status.VIGNETTED)
    assert landed.alive.all()
    wanted = wanted_slopes(at_face, landed.position, plane, Refract(1.488, 1.0))
    for found, slope in zip(wanted, (z_x, z_y), strict=True):
        torch.testing.assert_close(found, slope, rtol=0, atol=1e-10)  # Newton's stop on the sag


@pytest.mark.parametrize("index", [1.05, 1.488, 2.4])
@pytest.mark.parametrize("reach", [300.0, 900.0, 1e5])
def test_an_aim_that_no_face_can_reach_turns_the_ray_as_far_as_one_can(index, reach):
    """Never reflected, never steeper than it may be, towards the aim, and as far as it goes where that is the limit."""
    x, y = torch.meshgrid(*[torch.linspace(-3.0, 3.0, 7, dtype=torch.float64)] * 2, indexing="ij")
    lens = Lens.between(Plane(8.0), net(m=5), SQUARE, index)
    in_glass = to_first_net(CollimatedSource(Circle(8.0)).rays_through(x, y, 8.0, 1.0), lens)
    at_face, _, _ = intersect(lens.back, in_glass, SQUARE, Status.VIGNETTED)
    aim = torch.stack([torch.full_like(x, reach), torch.full_like(x, -0.2 * reach)])
    z_x, z_y = wanted_slopes(at_face, aim, LevelPlane(500.0), Refract(index, 1.0))
    steepness = torch.sqrt(z_x**2 + z_y**2)
    out = deflect(at_face, z_x, z_y, Refract(index, 1.0)).rays
    turned = torch.acos((out.direction * at_face.direction).sum(0))
    asked = math.atan(math.hypot(reach, 0.2 * reach) / 480.0)
    assert out.alive.all() and float(steepness.max()) <= MAX_SLOPE * (1 + 1e-12)
    assert (out.direction[0] > 0).all() and (out.direction[1] < 0).all()
    if asked > largest_deflection(index) + 0.02 and float(steepness.max()) < 0.99 * MAX_SLOPE:
        torch.testing.assert_close(turned, torch.full_like(turned, largest_deflection(index)), rtol=0, atol=1e-9)


@pytest.mark.parametrize("fit", [Fit(bending=0.0, steps=60), Fit(bending=0.0, steps=60, degree=3)])
def test_a_surface_comes_back_from_its_slopes(fit):
    true = surface(17, 0.7)
    x, y = (p.reshape(-1) for p in stratified(SQUARE, 40, 0))
    _, z_x, z_y = true.sag_and_slope(x, y)
    found = fit_slopes(net(m=17), x, y, z_x, z_y, torch.ones_like(x), fit)
    off = found.from_vertex().heights - true.from_vertex().heights
    assert float(off.abs().max()) < 1e-8  # mm


def test_a_polynomial_goes_on_where_no_ray_falls():
    """Slopes of a paraboloid, known in a disc only: the fit finds the corners too."""
    x, y = (p.reshape(-1) for p in stratified(SQUARE, 60, 0))
    inside = (x * x + y * y < 81.0).to(x)
    found = fit_slopes(net(m=17), x, y, 0.3 + 0.02 * x, 0.01 * y, inside, Fit(bending=1e-2, steps=40, degree=3))
    corner = torch.tensor([9.5], dtype=torch.float64)
    _, z_x, z_y = found.sag_and_slope(corner, corner)
    assert float(z_x) == pytest.approx(0.49, abs=1e-2) and float(z_y) == pytest.approx(0.095, abs=1e-2)


def test_tailor_to_aim_lands_where_a_surface_can():
    """A stretched grid, near the axis: the map is a gradient but for the finite throw, so a surface follows it."""
    source, lens = CollimatedSource(Circle(8.0)), Lens.between(Plane(8.0), net(m=33), SQUARE, 1.488)
    x, y = sampling.grid(Rectangle(16.0, 16.0), 66)
    rays, screen = source.rays_through(x, y, 8.0, 1.0), LevelPlane(1000.0)
    aim = torch.stack([4 * x, 3 * y])
    lens = tailor_to_aim(lens, rays, aim, screen, 4)
    miss = float(mean_square_miss(trace(rays, lens, screen), aim).sqrt())
    assert miss < 0.15  # mm, of 32: eight steps of conjugate gradients
