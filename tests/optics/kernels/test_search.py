"""The fused search for rays that meet given points against the plain torch form, for all kinds of light and front."""

import pytest
import torch

from bstcad.optics.light.point import PointSource
from bstcad.optics.numerics import kernel_choice
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.optics.trace import tubes
from bstcad.optics.trace.trace import to_first_net
from tests.lenses import lens_of, wavy
from tests.optics.kernels.test_forward import SCENES, deep

HALF = 6.0  # half side (mm) of the square of points, which all the lights reach
RAMP = "point, ramp"  # a face before its front, which no lens has: there the search has no start
EQUATOR = "collimated, beyond the equator"  # some points lie beyond the last rays: there each search ends by chance
GRIDS = {"few": 20, "coarse grid first": 90}  # cells per side; neither number of points is a multiple of a block


def both(monkeypatch, source, lens, n, shape=None):
    """Return what the kernel and the plain form find for the corners of n x n cells."""
    points = tubes.corners(shape or Rectangle(2 * HALF, 2 * HALF), n)
    found = tubes.rays_to(source, lens, *points)
    with monkeypatch.context() as off:
        off.setattr(kernel_choice, "front_kernel", lambda name, *given: None)
        return found, tubes.rays_to(source, lens, *points)


@pytest.mark.parametrize("n", GRIDS.values(), ids=GRIDS)
@pytest.mark.parametrize("name", [name for name in SCENES if name != RAMP])
def test_the_kernel_finds_the_rays_of_the_plain_form(name, n, monkeypatch):
    source, lens, _ = SCENES[name]
    (x, y, rays), (plain_x, plain_y, plain) = both(monkeypatch, source, lens, n)
    there = rays.alive & plain.alive
    assert bool(there.all()) or (name == EQUATOR and float(there.double().mean()) > 0.94)
    for one, other, atol in ((x, plain_x, 1e-6), (y, plain_y, 1e-6), (rays.flux, plain.flux, 1e-6)):
        torch.testing.assert_close(one[there], other[there], rtol=0, atol=atol)
    directions = [each.direction.expand(3, *x.shape)[:, there] for each in (rays, plain)]
    torch.testing.assert_close(*directions, rtol=0, atol=1e-7 if name != EQUATOR else 1e-5)
    assert torch.equal(rays.position, plain.position)
    assert (rays.z, rays.sense, rays.axial) == (plain.z, plain.sense, plain.axial)


def test_rays_meet_the_points_to_the_tolerance():
    """Through a strong front close to the source the rays are traced on to the back, independent of the search."""
    source, lens = PointSource((1.0, -2.0, 10.0)), deep(Sphere(15.0, 0.05), depth=2.0)
    x, y = tubes.corners(Circle(8.0), 57)
    p, q, rays = tubes.rays_to(source, lens, x, y)
    coming = to_first_net(source.rays_through(p, q, lens.front.z, 1.0), lens.unbounded())
    far = (lens.back.z + rays.position[2] - coming.above(0.0)) / coming.direction[2]
    met = coming.position[:2] + far * coming.direction[:2]
    assert bool(rays.alive.all())
    torch.testing.assert_close(met, torch.stack([x, y]), rtol=0, atol=1e-9)


def test_points_that_no_ray_meets_are_lost_in_both_forms(monkeypatch):
    """Behind a front that ends at its equator, 4 mm from the axis, the corners of the square are dark."""
    lens = lens_of(wavy(m=17, depth=0.5, ripple=0.0, z=18.0, half=11.0), Sphere(15.0, 0.25), Circle(9.0), 1.5)
    (_, _, rays), (_, _, plain) = both(monkeypatch, PointSource((0.0, 0.0, 5.0)), lens, 31, Rectangle(18.0, 18.0))
    assert 0.05 < float(rays.alive.double().mean()) < 0.9
    both_lost = ~rays.alive & ~plain.alive
    assert float(both_lost.sum()) >= 0.97 * float((~plain.alive).sum())  # the kernel starts nearer, and finds more


def test_light_without_a_formula_takes_the_plain_form(monkeypatch):
    monkeypatch.setitem(
        kernel_choice.KERNELS["tubes.search"], "cpu", lambda *given, **named: pytest.fail("the kernel is called")
    )
    monkeypatch.setattr(PointSource, "beam", lambda self, z: None)
    assert bool(tubes.rays_to(PointSource(), deep(), *tubes.corners(Circle(5.0), 8))[2].alive.all())
