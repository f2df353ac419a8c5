"""Sources: flux against closed forms, rays against the points they were asked for, windows against the trace."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.light.profiles import Profile
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.rays import axes
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace.trace import to_first_net, window
from tests.lenses import Measured, lens_of, net
from tests.tracing import stratified

Z = 15.0
DISC, SQUARE = Circle(12.0), Rectangle(24.0, 10.0)


def flux(source, window, z=Z, n=1000):
    """Midpoint sum of the irradiance over a window."""
    x, y = sampling.grid(window, n)
    return float(source.irradiance(x, y, z).sum()) * window.area / n**2


@pytest.mark.parametrize("aperture", [DISC, SQUARE], ids=str)
@pytest.mark.parametrize("profile", [{}, {"profile": "gaussian", "radius_1e2": 7.0}], ids=str)
def test_all_light_of_a_collimated_beam_passes_its_aperture(aperture, profile):
    source = CollimatedSource(aperture, **profile)
    window = source.window(Rectangle(5.0, 5.0), Z, (0.0,))
    assert (window.width / 2, window.height / 2) == aperture.half_extent
    # cells on the rim of a disc are in or out as a whole: 1e-4 at 1000 cells a side
    assert flux(source, window) == pytest.approx(1, rel=2e-4 if aperture is DISC else 1e-6)
    outside = torch.tensor([aperture.half_extent[0] + 1e-6, 30.0], dtype=torch.float64)
    assert source.irradiance(outside, torch.zeros_like(outside), Z).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (3.0, -2.0, 5.0)], ids=str)
def test_all_light_of_a_point_source_crosses_a_large_plane(place):
    d = Z - place[2]
    gaussian = PointSource(position=place, profile="gaussian", half_angle_1e2=30.0)
    assert flux(gaussian, Rectangle(8 * d, 8 * d)) == pytest.approx(1, rel=1e-6)
    cone = PointSource(position=place, profile="uniform", half_angle=35.0)
    assert flux(cone, Rectangle(4 * d, 4 * d)) == pytest.approx(1, rel=1e-3)  # the rim's cells
    cone = PointSource(position=place, half_angle=60.0)  # on a disc of radius 1.73 d
    assert flux(cone, Rectangle(5 * d, 5 * d)) == pytest.approx(1, rel=1e-3)  # the rim's cells
    [disc, (x, y)] = cone.spot(Z)
    assert (disc.radius, x, y) == pytest.approx((d * math.tan(math.radians(60)), *place[:2]))
    half = 40 * d  # a share d² / (R² + d²) passes beside a disc of radius R; the square's inner circle has R = half
    assert 1 - 1 / 40**2 - 1e-3 < flux(PointSource(position=place), Rectangle(2 * half, 2 * half)) < 1


@pytest.mark.parametrize("z", (4.0, 1000.0))
@pytest.mark.parametrize(("profile", "half_angle"), [("lambertian", 90.0), ("lambertian", 35.0), ("uniform", 35.0)])
def test_irradiance_is_intensity_times_cosine_over_distance_squared(profile, half_angle, z):
    edge = math.cos(math.radians(half_angle))
    law = {"profile": profile} | ({} if half_angle == 90.0 else {"half_angle": half_angle})

    def intensity(cos):
        within = cos / (math.pi * (1 - edge**2)) if profile == "lambertian" else 1 / (2 * math.pi * (1 - edge))
        return (cos >= edge).double() * within

    source = PointSource(position=(1.0, 2.0, 3.0), **law)
    generator = torch.Generator().manual_seed(0)
    x, y = (torch.rand((2, 1000), generator=generator, dtype=torch.float64) - 0.5) * 3 * (z - 3)
    d2 = (x - 1) ** 2 + (y - 2) ** 2 + (z - 3) ** 2
    cos = (z - 3) / d2.sqrt()
    torch.testing.assert_close(source.irradiance(x, y, z), intensity(cos) * cos / d2, rtol=1e-12, atol=0)


SOURCES = [
    CollimatedSource(DISC, z=2.0),
    CollimatedSource(SQUARE, profile="gaussian", radius_1e2=5.0, z=-7.0),
    PointSource(position=(1.0, 2.0, 3.0)),
    PointSource(position=(-4.0, 0.0, -100.0), profile="uniform", half_angle=20.0),
    PointSource(profile="gaussian", half_angle_1e2=30.0),
    CollimatedSource(DISC, tilt=(0.0, 25.0)),
    CollimatedSource(SQUARE, profile="gaussian", radius_1e2=5.0, z=-7.0, tilt=(-10.0, 25.0), centre=(2.0, -3.0)),
    PointSource(position=(1.0, 2.0, 3.0), tilt=(40.0, -30.0)),
]


@pytest.mark.parametrize("dtype", (torch.float32, torch.float64))
@pytest.mark.parametrize("source", SOURCES, ids=str)
def test_rays_pass_the_points_they_were_asked_for(source, dtype):
    x, y = stratified(Rectangle(20.0, 8.0), 8, 0, dtype)
    rays = source.rays_through(x, y, Z, 0.3)
    eps = torch.finfo(dtype).eps
    assert rays.position.shape == rays.direction.shape == (3, 8, 8) and rays.position.dtype == dtype
    torch.testing.assert_close(rays.direction.norm(dim=0), torch.ones_like(x), rtol=0, atol=4 * eps)
    assert (rays.direction[2] > 0).all() and rays.alive.all()
    t = -rays.above(Z) / rays.direction[2]
    asked = torch.stack([x, y, torch.full_like(x, Z - rays.z)])
    atol = 8 * eps * float(t.max())  # rounding of the distance to the source
    torch.testing.assert_close(rays.position + t * rays.direction, asked, rtol=0, atol=atol)
    torch.testing.assert_close(rays.flux, source.irradiance(x, y, Z) * 0.3, rtol=4 * eps, atol=0)
    start = source.start(Z) if isinstance(source, CollimatedSource) else source.position[2]
    assert rays.z == start and not rays.position[2].any()


FRONTS = [Plane(Z), Sphere(Z, -0.06), Sphere(Z, -0.03), Sphere(Z, 0.05)]
PLACES = [(0.0, 0.0, 0.0), (3.0, 0.0, 5.0), (-30.0, 12.0, 0.0)]
WIDE = [PointSource(position=place) for place in PLACES]
WIDE += [CollimatedSource(Circle(200.0), tilt=tilt) for tilt in ((0.0, 30.0), (-20.0, 10.0), (45.0, 0.0))]


@pytest.mark.parametrize("outline", [Rectangle(24.0, 6.0), Circle(10.0)], ids=str)
@pytest.mark.parametrize("front", FRONTS, ids=str)
@pytest.mark.parametrize("source", WIDE, ids=str)
def test_no_ray_from_outside_the_window_enters_the_lens(source, front, outline):
    """Rays through a plane three windows wide: those that enter the front face all start inside the window."""
    lens = lens_of(net(z=40.0, half=12.0), front, outline)
    area = window(source, lens)
    x, y = stratified(Rectangle(3 * area.width, 3 * area.height), 120, 0)
    entered = to_first_net(source.rays_through(x, y, Z, 1.0), lens).alive
    inside = (x.abs() <= area.width / 2) & (y.abs() <= area.height / 2)
    assert int((entered & inside).sum()) > 10
    assert not (entered & ~inside).any()


# --- tilted -----------------------------------------------------------------------------------------------------------

PROFILES = [
    {"profile": "lambertian"},
    {"profile": "lambertian", "half_angle": 35.0},
    {"profile": "uniform", "half_angle": 35.0},
    {"profile": "gaussian", "half_angle_1e2": 30.0},
]
TILTS = [(20.0, 0.0), (-15.0, 30.0), (0.0, 60.0), (80.0, 10.0)]


@pytest.mark.parametrize("z", [Z, -9.0])
@pytest.mark.parametrize("tilt", TILTS, ids=str)
@pytest.mark.parametrize("law", PROFILES, ids=str)
def test_a_tilted_source_is_the_same_source_seen_from_its_own_frame(law, tilt, z):
    """E / D of both: E = I D / d³, and I knows no frame.  To a plane below, all is turned about the axis."""
    source, straight = PointSource((3.0, -2.0, 5.0), tilt=tilt, **law), PointSource(**law)
    frame, sense = np.array(source.axes), 1 if z > 5 else -1
    seen = 0
    for x, y in np.random.default_rng(0).uniform(-30, 30, (200, 2)):
        r = np.array([x - 3.0, y + 2.0, z - 5.0])
        own = sense * frame @ r
        found = float(source.irradiance(torch.tensor([x]), torch.tensor([y]), z))
        wanted = 0.0
        if own[2] > 0:
            wanted = float(straight.irradiance(*(torch.tensor([p]) for p in own[:2]), own[2])) * abs(r[2]) / own[2]
            seen += wanted > 0
        assert found == pytest.approx(wanted, rel=1e-11, abs=1e-300)
    assert seen > 5


@pytest.mark.parametrize("z", [None, -20.0], ids=str)
@pytest.mark.parametrize("profile", [{}, {"profile": "gaussian", "radius_1e2": 7.0}], ids=str)
@pytest.mark.parametrize("aperture", [DISC, SQUARE], ids=str)
def test_a_tilted_beam_has_all_its_flux_on_any_plane_and_is_shifted_along_its_way(aperture, profile, z):
    source = CollimatedSource(aperture, tilt=(10.0, 30.0), z=z, centre=(1.0, -2.0), **profile)
    wide = Rectangle(80.0, 80.0)
    x, y = sampling.grid(wide, 1600)
    e = source.irradiance(x, y, Z) * wide.area / 1600**2
    assert float(e.sum()) == pytest.approx(1, rel=3e-3)  # cells on the rim
    n = source.axes[2]
    way = 0.0 if z is None else (Z - z) / n[2]
    middle = (1.0 + way * n[0], -2.0 + way * n[1])
    assert (float((e * x).sum()), float((e * y).sum())) == pytest.approx(middle, abs=0.05)
    assert source.shift(Z) == pytest.approx(middle, abs=1e-12)
    assert source.spot(Z) == (aperture, pytest.approx(middle))


def test_a_tilted_beam_says_that_it_is_not_axial():
    x, y = sampling.grid(Rectangle(2.0, 2.0), 4)
    rays = CollimatedSource(DISC, tilt=(10.0, 30.0)).rays_through(x, y, Z, 1.0)
    assert not rays.axial and rays.z < 0
    assert rays.direction[:, 0, 0].tolist() == pytest.approx(axes((10.0, 30.0))[2], rel=1e-15)
    below = CollimatedSource(DISC, tilt=(10.0, 30.0), z=40.0).rays_through(x, y, Z, 1.0)
    torch.testing.assert_close(below.direction, -rays.direction)
    assert below.sense == -1
    moved = CollimatedSource(DISC, centre=(1.0, 0.0)).rays_through(x, y, Z, 1.0)
    assert moved.axial and torch.equal(moved.position[0], x)


@pytest.mark.parametrize(
    ("place", "tilt"),
    [(PLACES[0], (10.0, 0.0)), (PLACES[1], (0.0, 40.0)), (PLACES[1], (-30.0, -30.0)), (PLACES[1], (50.0, 40.0))],
    ids=str,
)
def test_window_of_a_tilted_cone_holds_it_and_no_more(place, tilt):
    cone = PointSource(place, half_angle=15.0, tilt=tilt)
    area = cone.window(Rectangle(250.0, 250.0), Z, (0.0,))
    x, y = sampling.grid(Rectangle(250.0, 250.0), 1000)
    lit = cone.irradiance(x, y, Z) > 0
    for p, middle, size in ((x, place[0], area.width), (y, place[1], area.height)):
        reach = float((p[lit] - middle).abs().max())
        assert size == 250.0 or size / 2 == pytest.approx(reach + abs(middle), abs=0.3)
        assert float(p[lit].abs().max()) <= size / 2


@pytest.mark.parametrize(
    ("wavelength", "main"),
    [
        (587.6, 587.6),
        (((656.3, 1.0), (587.6, 1.0), (486.1, 1.0)), 587.6),  # sorted or not
        (((486.1, 1.0), (587.6, 1.0), (656.3, 2.0)), 656.3),
        (((486.1, 1.0), (587.6, 2.0), (656.3, 2.0)), 587.6),  # of two in the middle the shorter
    ],
    ids=str,
)
def test_the_main_line_is_the_heaviest_and_of_equals_the_middle_one(wavelength, main):
    source = PointSource(wavelength=wavelength)
    lines = source.lines
    assert source.main_wavelength == lines[0][0] == main
    assert math.fsum(share for _, share in lines) == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize("by", [0.1, -0.2])
def test_a_wider_cone_has_a_larger_tangent_and_a_measured_light_has_none(by):
    def tangents(angles):
        return np.tan(np.radians(angles))

    uniform = PointSource((0.0, 0.0, -50.0), profile="uniform", half_angle=12.0)
    assert tangents(uniform.with_wider_cone(by).half_angle) == pytest.approx((1 + by) * tangents(12.0))
    both = PointSource((0.0, 0.0, -50.0), profile="gaussian", half_angle_1e2=(20.0, 9.0)).with_wider_cone(by)
    assert tangents(both.half_angle_1e2) == pytest.approx((1 + by) * tangents([20.0, 9.0]))
    assert PointSource((0.0, 0.0, -50.0)).with_wider_cone(by) is None
    assert PointSource(intensity=Measured(Profile(whole=2.0)), half_angle=9.0).with_wider_cone(by) is None
