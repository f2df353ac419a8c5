"""Flux tubes: exact clipping against sums over points, the fused form against the plain one, conserved light."""

import itertools

import pytest
import torch

from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen, rrmsd
from bstcad.optics.surfaces.outlines import EVERYWHERE, Circle, Rectangle, Rounded
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace import tubes
from bstcad.optics.trace.trace import to_first_net
from tests.by_slope import intersect
from tests.lenses import lens_of, net
from tests.tracing import simulated

SHAPE = (7, 9)


def torn(n, seed, spread=1.3, low=-2.0, high=11.0):
    """Corners of a grid that is thrown about: folded, thin and partly beyond the screen."""
    random = torch.Generator().manual_seed(seed)
    x, y = torch.meshgrid(*[torch.linspace(low, high, n + 1, dtype=torch.float64)] * 2, indexing="ij")
    corner = torch.stack([x, y]) + spread * torch.randn((2, n + 1, n + 1), generator=random, dtype=torch.float64)
    return corner, torch.rand((n, n), generator=random, dtype=torch.float64)


FORMS = pytest.mark.parametrize("form", (tubes.collect, tubes.collect_plain), ids=("fused", "plain"))


@FORMS
def test_clipping_is_the_limit_of_many_points(form):
    corner, flux = torn(6, 0)
    k = 300
    s = (torch.arange(k, dtype=torch.float64) + 0.5) / k
    u, v = torch.meshgrid(s, s, indexing="ij")
    u, v = torch.where(u + v > 1, 1 - u, u), torch.where(u + v > 1, 1 - v, v)  # folded onto one triangle
    expected = torch.zeros(SHAPE, dtype=torch.float64)
    first, second, third = tubes.triangles(corner)
    for t in range(first.shape[1]):
        a, b, c = (p[:, t, None, None] for p in (first, second, third))
        x, y = a + u * (b - a) + v * (c - a)
        inside = (x >= 0) & (x < SHAPE[1]) & (y >= 0) & (y < SHAPE[0])
        index = (y.floor() * SHAPE[1] + x.floor())[inside].long()
        part = flux.reshape(-1)[t % flux.numel()] / 2 / k**2
        expected.view(-1).index_add_(0, index, part.expand(index.shape))
    assert float((form(corner, flux, SHAPE)[0] - expected).abs().max() / expected.max()) < 2e-3


@FORMS
def test_all_light_on_the_screen_is_counted_once(form):
    corner, flux = torn(12, 1, spread=0.5, low=2.0, high=5.0)
    found, outside = form(corner, flux, SHAPE)
    assert float(outside) == 0.0
    assert float(found.sum()) == pytest.approx(float(flux.sum()), rel=1e-12)
    assert float(found.min()) > -1e-12


@FORMS
@pytest.mark.parametrize("shift", [(-40.0, 0.0), (40.0, 0.0), (0.0, -40.0), (0.0, 40.0), (1e7, -1e7)])
def test_light_beside_the_screen_is_on_none_of_it(form, shift):
    corner, flux = torn(5, 2)
    corner = corner + torch.tensor(shift, dtype=torch.float64)[:, None, None]
    found, outside = form(corner, flux, SHAPE)
    assert float(found.abs().max()) < 1e-12
    beyond = [p - p.clamp(0, size) for p, size in zip(corner, (9, 7), strict=True)]
    squares = sum(tubes.middle(b**2) for b in beyond)
    assert float(outside) == pytest.approx(float((flux * squares).sum()), rel=1e-12)


def test_the_fused_form_is_the_plain_one_with_its_gradient():
    """Folded, thin, degenerate and huge triangles; corners on pixel borders."""
    corner, flux = torn(20, 3)
    corner[:, 3, 3:6] = corner[:, 3, 3:4]  # three corners in one point
    corner[:, 8] = corner[:, 8].round()  # on the borders
    corner[0, 15, 15] = 4e4  # far off the screen
    weight = torch.rand(SHAPE, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    results = []
    for form in (tubes.collect, tubes.collect_plain):
        leaf, light = corner.clone().requires_grad_(), flux.clone().requires_grad_()
        image, outside = form(leaf, light, SHAPE)
        merit = (image * weight).sum() + 0.3 * outside
        results.append((image.detach(), outside.detach(), *torch.autograd.grad(merit, (leaf, light))))
    (image, outside, gradient, in_flux), (plain, plain_outside, plain_gradient, plain_in_flux) = results
    assert float((in_flux - plain_in_flux).abs().max()) < 1e-10 * float(plain_in_flux.abs().max())
    assert float(outside) == pytest.approx(float(plain_outside), rel=1e-12)
    torch.testing.assert_close(image, plain, rtol=0, atol=1e-11)
    on_border = torch.zeros_like(gradient, dtype=torch.bool)
    on_border[:, 7:10] = True  # a kink: both forms give a one-sided derivative, not always of the same side
    close = (gradient - plain_gradient).abs() < 1e-9 * (1 + plain_gradient.abs())
    assert bool((close | on_border).all())


@FORMS
def test_an_edge_through_the_corners_of_pixels_has_the_gradient_of_its_neighbours(form):
    """Pieces at a corner have no length, but the derivatives of their ends have; central differences agree to O(h)."""
    n, h = 4, 1e-6
    even = torch.linspace(0.3, 6.7, n + 1, dtype=torch.float64)  # the diagonals with x = y meet whole numbers
    corner, flux = torch.stack(torch.meshgrid(even, even, indexing="ij")), torch.ones((n, n), dtype=torch.float64)
    weight = torch.rand(SHAPE, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    leaf = corner.clone().requires_grad_()
    (gradient,) = torch.autograd.grad((form(leaf, flux, SHAPE)[0] * weight).sum(), leaf)
    for place in itertools.product(range(2), range(n + 1), range(n + 1)):
        step = torch.zeros_like(corner)
        step[place] = h
        ahead, behind = (float((form(c, flux, SHAPE)[0] * weight).sum()) for c in (corner + step, corner - step))
        assert float(gradient[place]) == pytest.approx((ahead - behind) / (2 * h), abs=1e-5)


# --- launching --------------------------------------------------------------------------------------------------------


def lens_behind(front, outline):
    """outline: of the lens, or the clear apertures of front and back."""
    back = net(lambda x, y: 0.02 * torch.cos(1.33 * x), m=33, half=12.0)
    return lens_of(back, front, **({"clear": outline} if isinstance(outline, tuple) else {"outline": outline}))


SMALL, LARGE = Rounded(11.0, 13.0, corner_radius=3.0), Rounded(12.0, 14.0, corner_radius=4.0)
SOURCES = {
    "beam inside the lens": (CollimatedSource(Circle(8.0)), Plane(8.0), Rectangle(20.0, 20.0)),
    "gaussian beam": (CollimatedSource(Circle(8.0), profile="gaussian", radius_1e2=5.0), Plane(8.0), Circle(9.0)),
    "beam larger than the lens": (CollimatedSource(Rectangle(30.0, 30.0)), Plane(8.0), Circle(9.0)),
    "beam cut by two sides": (CollimatedSource(Rectangle(30.0, 8.0)), Sphere(8.0, 0.02), Rectangle(16.0, 16.0)),
    "beam over part of the lens": (CollimatedSource(Rectangle(10.0, 40.0)), Plane(8.0), Rectangle(20.0, 20.0)),
    "point, cut by the back": (
        PointSource(profile="gaussian", half_angle_1e2=30.0),
        Plane(15.0),
        Rectangle(20.0, 20.0),
    ),
    "point near a round lens": (PointSource((1.0, -0.5, 9.0)), Sphere(15.0, 0.03), Circle(10.0)),
    "narrow cone off axis": (
        PointSource((1.0, 0.5, 0.0), profile="uniform", half_angle=12.0),
        Plane(15.0),
        Circle(9.0),
    ),
    "beam cut by a front with round corners": (
        CollimatedSource(Rectangle(30.0, 30.0)),
        Sphere(8.0, 0.02),
        (SMALL, LARGE),
    ),
    "point cut by a back with round corners": (PointSource((1.0, -0.5, 0.0)), Plane(15.0), (LARGE, SMALL)),
}


@pytest.mark.parametrize("name", SOURCES)
def test_tubes_hold_the_light_that_rays_find_behind_the_lens(name):
    """Flux and picture of both, the picture on few pixels so that the rays have little noise."""
    source, front, outline = SOURCES[name]
    lens = lens_behind(front, outline)
    screen = Screen(100.0, (-60.0, 60.0), (-60.0, 45.0), (12, 9))
    sheet = tubes.launch_tubes(source, lens, 200)
    found = sheet.picture(lens, screen)
    rays = simulated(source, lens, screen, 1000, 0)
    assert float(found.sum()) == pytest.approx(rays.flux["on target"], rel=3e-3)
    assert float(rrmsd(found, rays.box)) < 0.01


@pytest.mark.parametrize("name", SOURCES)
def test_rays_meet_the_back_where_they_are_sent(name):
    source, front, outline = SOURCES[name]
    lens = lens_behind(front, outline)
    x, y = tubes.corners(Rectangle(14.0, 12.0), 300)
    p, q, at_back = tubes.rays_to(source, lens, x, y)
    entered = to_first_net(source.rays_through(p, q, lens.front.z, 1.0), lens.unbounded())
    hit, _, _ = intersect(lens.back, entered, EVERYWHERE, 2)
    assert bool(at_back.alive.all())
    torch.testing.assert_close(hit.position, at_back.position, rtol=0, atol=3e-7)
    torch.testing.assert_close(hit.direction.expand_as(at_back.direction), at_back.direction, rtol=0, atol=3e-8)


@pytest.mark.parametrize("n", [20, 100])  # the finer grid starts from a coarse one
@pytest.mark.parametrize("front", [Plane(15.0), Sphere(15.0, 0.03)], ids=("plane", "sphere"))
def test_rays_of_several_sources_are_those_of_each(front, n):
    """A tilted chip, whose points lie at different heights."""
    chip = PointSource((1.0, -0.5, 2.0), width=2.0, height=1.0, tilt=(20.0, 30.0))
    sources = [chip.element(x, y) for x, y in ((0.0, 0.0), (1.0, 0.5), (-1.0, 0.25))]
    lens, places = lens_behind(front, Circle(9.0)), tubes.corners(Circle(8.0), n)
    *points, rays = tubes.rays_to(sources, lens, *places)
    for k, source in enumerate(sources):
        *own, alone = tubes.rays_to(source, lens, *places)
        assert bool(rays.alive[k].all()) and float(alone.direction[0].std()) > 0.1
        torch.testing.assert_close(torch.stack([p[k] for p in points]), torch.stack(own), rtol=0, atol=3e-7)
        torch.testing.assert_close(rays.direction[:, k], alone.direction, rtol=0, atol=3e-8)
        torch.testing.assert_close(rays.position[:, k], alone.position, rtol=0, atol=1e-12)


@pytest.mark.parametrize("pixels", [(7, 11), (11, 7), (24, 5)])
def test_an_even_beam_gives_each_pixel_its_area(pixels):
    """Through a plate a rectangular beam lands as it is, cut by two sides of the screen: areas known by hand."""
    lens, beam = lens_of(net(z=12.0), Plane(8.0)), Rectangle(9.0, 12.0)
    screen = Screen(50.0, (-3.3, 6.7), (-8.1, 4.9), pixels)
    sides = zip((screen.x, screen.y), pixels, strict=True)
    edges = (torch.linspace(*ends, n + 1, dtype=torch.float64) for ends, n in sides)
    x, y = (e.clamp(-half, half).diff() for e, half in zip(edges, beam.half_extent, strict=True))
    exact = y.flip(0)[:, None] * x / beam.area  # row 0 = y max
    for found in (
        tubes.picture(CollimatedSource(beam), lens, screen, 31),
        tubes.launch_tubes(CollimatedSource(beam), lens, 31).picture(lens, screen),
    ):
        assert found.shape == screen.shape == (pixels[1], pixels[0])
        torch.testing.assert_close(found, exact, rtol=0, atol=1e-8)  # the sheet lies 1e-9 of its size inside the beam
