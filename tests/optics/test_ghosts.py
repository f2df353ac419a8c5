"""Ghosts: flux by Fresnel's closed form, landing by hand and by rays traced here with numpy, a ledger that closes."""

import math

import numpy as np
import pytest
import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.channels import Channel
from bstcad.optics.collimated import Collimated
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.losses import Absorption, Coating, Fresnel, Losses
from bstcad.optics.measure import Effort, measure
from bstcad.optics.outlines import EVERYWHERE, Circle, Rectangle
from bstcad.optics.point import Point
from bstcad.optics.receivers import LevelPlane
from bstcad.optics.surfaces import Plane, Sphere
from bstcad.optics.trace import OFF, ON, follow_ghost, ghost, ghost_light
from tests.hard_cases.lenses import bundle, places, wavy

EXACT = 1e-12
N = 1.5
WAVELENGTH = 587.6
BARE = Losses(Fresnel(WAVELENGTH))


def plane(z, slope=0.0, half=60.0):
    """A plane through (0, 0, z) whose height grows by `slope` per mm along x."""
    x = torch.linspace(-half, half, 9, dtype=torch.float64)
    return BSplineSurface(z, (slope * x)[:, None].expand(9, 9).contiguous(), (-half, half), (-half, half))


def plate(losses=BARE, index=N, thickness=4.0, outline=EVERYWHERE):
    return Lens(Plane(10.0), plane(10.0 + thickness), outline, index, losses=losses)


def fresnel(n_in, n_out, degrees, kind):
    """R in sines or tangents of the angles: sin²(θ - θ') / sin²(θ + θ'), tan²(θ - θ') / tan²(θ + θ')."""
    a = math.radians(degrees)
    b = math.asin(n_in / n_out * math.sin(a))
    f = math.sin if kind == "s" else math.tan
    return (f(a - b) / f(a + b)) ** 2 if a else ((n_in - n_out) / (n_in + n_out)) ** 2


# --- flux -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", [1.33, 1.5, 1.9])
def test_at_normal_incidence_a_plate_sends_t_r_r_t(index):
    r = ((index - 1) / (index + 1)) ** 2
    out, _ = follow_ghost(bundle((1.0, 2.0, 0.0), (0.0, 0.0, 1.0)), plate(index=index))
    assert float(out.flux) == pytest.approx((1 - r) ** 2 * r * r, rel=EXACT)
    assert bool(out.alive) and out.sense == 1
    # nor is it moved
    assert out.position[0, 0] == 1.0 and out.position[1, 0] == 2.0 and float(out.direction[2]) == 1.0


def test_glass_absorbs_along_three_ways_through_it():
    rays, a, t = bundle((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), 0.02, 4.0
    clear, dim = (follow_ghost(rays, plate(Losses(Fresnel(WAVELENGTH), glass)))[0] for glass in (None, Absorption(a)))
    assert float(dim.flux / clear.flux) == pytest.approx(math.exp(-3 * a * t), rel=EXACT)


def test_beyond_the_critical_angle_all_is_reflected():
    """A wedge of 45 degrees turns light by a right angle at its back: R = 1 there, and what leaves is none of it."""
    lens = Lens(Plane(0.0), plane(40.0, 1.0), EVERYWHERE, N, losses=BARE)
    _, down, _, _ = ghost(lens)
    for degrees in (41.9, 45.0, 80.0):
        cos = torch.tensor(math.cos(math.radians(degrees)), dtype=torch.float64)
        assert float(down.losses[-1].share(cos, cos, torch.zeros(()))) == 1.0
    cos = torch.tensor(math.cos(math.radians(41.0)), dtype=torch.float64)  # short of 41.81
    assert 0 < float(down.losses[-1].share(cos, cos, torch.zeros(()))) < 1
    _, total = follow_ghost(bundle((0.0, 0.0, -10.0), (0.0, 0.0, 1.0)), lens)
    assert bool(total)


# --- places -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("front", [Plane(10.0), plane(10.0)], ids=("plane", "spline"))
def test_a_wedge_throws_its_ghost_where_geometry_has_it(front):
    """Angles to the axis in a wedge of angle A: 2 A after the back, 3 A to the back's normal at the exit."""
    wedge, thickness, x0, throw = math.radians(5.0), 4.0, 1.0, 500.0
    slope = -math.tan(wedge)  # the back falls along +x; its normal leans by A towards +x
    lens = Lens(front, plane(10.0 + thickness, slope), EVERYWHERE, N, losses=BARE)
    out, _ = follow_ghost(bundle((x0, 0.0, 0.0), (0.0, 0.0, 1.0)), lens)
    landed = LevelPlane(throw).to(out)

    z1 = thickness + slope * x0  # over the front
    x2 = x0 - z1 * math.tan(2 * wedge)  # on the front, after the back has turned light towards -x, down by 2 A
    # up again from (x2, 0) at -2 A to the axis: x = x2 - s sin 2A, z = s cos 2A = thickness + slope x
    s = (thickness + slope * x2) / (math.cos(2 * wedge) + slope * math.sin(2 * wedge))
    x3, z3 = x2 - s * math.sin(2 * wedge), s * math.cos(2 * wedge)
    leaves = wedge - math.asin(N * math.sin(3 * wedge))  # to the axis
    x4 = x3 + (throw - 10.0 - z3) * math.tan(leaves)
    assert float(landed.position[0]) == pytest.approx(x4, abs=1e-9)
    assert float(landed.position[1]) == pytest.approx(0.0, abs=1e-12)


def by_hand(position, direction, front, back, index):
    """The ghost of one ray between surfaces of revolution (z, curvature), by quadratic equations: (position, flux)."""
    p, d, flux = np.array(position, float), np.array(direction, float) / np.linalg.norm(direction), 1.0

    def hit(p, d, surface):
        z, c = surface
        if c == 0:
            return p + d * (z - p[2]) / d[2], np.array([0.0, 0.0, 1.0])
        centre = np.array([0.0, 0.0, z + 1 / c])
        b, e = d @ (p - centre), (p - centre) @ (p - centre) - 1 / c**2
        ways = [-b + s * math.sqrt(b * b - e) for s in (-1, 1)]
        points = [p + w * d for w in ways if w > 1e-9]
        at = min(points, key=lambda q: abs(q[2] - z))  # the half around the vertex
        return at, (at - centre) * c

    for surface, n_in, n_out, turns in ((front, 1, index, False), (back, index, 1, True), (front, index, 1, True),
                                        (back, index, 1, False)):  # fmt: skip
        p, normal = hit(p, d, surface)
        normal = normal * np.sign(normal @ d)
        theta = math.degrees(math.acos(min(1.0, normal @ d)))
        r = (fresnel(n_in, n_out, theta, "s") + fresnel(n_in, n_out, theta, "p")) / 2
        across = d - (normal @ d) * normal
        if turns:
            d, flux = across - (normal @ d) * normal, flux * r
        else:
            across = across * n_in / n_out
            d, flux = across + math.sqrt(1 - across @ across) * normal, flux * (1 - r)
    return p, d, flux


@pytest.mark.parametrize("curvature", [0.012, -0.008])
def test_a_spherical_front_throws_its_ghost_where_numpy_has_it(curvature):
    """Skew rays from a point, through a sphere and a plane; flux too."""
    position = (2.0, -1.0, -20.0)
    directions = [(0.1, 0.05, 1.0), (-0.15, 0.2, 1.0), (0.0, -0.1, 1.0), (0.2, 0.2, 1.0)]
    lens = Lens(Sphere(10.0, curvature), plane(16.0), EVERYWHERE, N, losses=BARE)
    out, _ = follow_ghost(bundle(position, directions), lens)
    assert bool(out.alive.all())
    for k, direction in enumerate(directions):
        p, d, flux = by_hand(position, direction, (10.0, curvature), (16.0, 0.0), N)
        assert places(out)[:, k].numpy() == pytest.approx(p, abs=1e-9)
        assert out.direction[:, k].numpy() == pytest.approx(d, abs=1e-12)
        assert float(out.flux[k]) == pytest.approx(flux, rel=1e-9)


# --- in a measurement -------------------------------------------------------------------------------------------------

SCREEN = Screen(300.0, (-40.0, 60.0), (-40.0, 40.0), (20, 16))
LOSSES = Losses(Fresnel(WAVELENGTH, coating=Coating(1.38, 60.0)), Absorption(0.01))
EFFORT = Effort(160, accuracy=0.0)


def lens_and_channels():
    """Two wavelengths, some light beyond the critical angle."""
    lens = Lens(Sphere(15.0, -0.02), wavy(depth=3.0), Rectangle(20.0, 20.0), 1.6)
    sources = Point(half_angle=40.0, profile="uniform"), Point(half_angle=35.0, profile="uniform")
    return lens, tuple(Channel(s, n, w, LOSSES) for s, n, w in zip(sources, (1.6, 1.65), (0.3, 0.7), strict=True))


def test_the_ledger_closes_with_the_ghost_in_it():
    lens, channels = lens_and_channels()
    target = np.ones(SCREEN.shape)
    without, within = (measure(lens, channels, SCREEN, target, EFFORT, way) for way in (None, ghost_light))
    assert sum(within.flux.values()) == pytest.approx(1, abs=EXACT)
    assert min(within.flux.values()) >= 0
    assert within.flux[ON] > 0 and within.flux[OFF] > 0
    moved = [line for line, value in without.flux.items() if within.flux[line] != value]
    assert moved == ["reflected at the faces"] or set(moved) == {"reflected at the faces", "total internal reflection"}
    assert within.ghost.sum() / within.picture.sum() == pytest.approx(
        within.flux[ON] / (within.flux[ON] + within.flux["on target"]), rel=0.02
    )
    assert within.picture.sum() == pytest.approx(target.sum(), rel=EXACT)


def test_a_plate_lays_its_ghost_over_the_beam():
    """All of a parallel beam comes back to where it fell: T R R T of the light on the target."""
    beam = Collimated(Circle(5.0))
    lens = plate(outline=Rectangle(20.0, 20.0))
    found = ghost_light(lens, (Channel(beam, N, losses=BARE),), Screen(100.0, (-8.0, 8.0), (-8.0, 8.0), 8), 200, 0)
    r = ((N - 1) / (N + 1)) ** 2
    assert found.flux[ON] == pytest.approx((1 - r) ** 2 * r * r, rel=1e-3)  # the rim of the beam, by 200 rays a side
    assert found.flux[OFF] == 0.0 and float(found.picture.sum()) == pytest.approx(found.flux[ON], rel=EXACT)
