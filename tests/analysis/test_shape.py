"""The shape in numbers, on lenses whose numbers are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bstcad.analysis.shape import describe, slope_octaves, thickness_range
from bstcad.optics.bspline import BSplineSurface, position
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.surfaces import Plane, Sphere

M = 65
SQUARE, DISC, PLATE = Rectangle(20.0, 20.0), Circle(10.0), Plane(8.0)
ZERO = 1e-9  # mm; rounding of heights of 20 mm leaves 1e-14 of them


def lens_of(sag, outline=DISC, front=PLATE, z=20.0) -> Lens:
    """The lens whose back is the quadratic spline next to z + sag(x, y); a round one's net reaches past the rim.

    Control heights (-1 10 -1)/8 of the samples, each way: exact for a parabola, and no end span disturbs the next.
    """
    reach = (M - 1) / (M - 5) if isinstance(outline, Circle) else 1.0
    (half_x, half_y), place = (reach * half for half in outline.half_extent), np.arange(-1, M + 1) * 2 / (M - 1) - 1
    f = sag(half_x * place[:, None], half_y * place[None, :])
    f = (10 * f[1:-1] - f[:-2] - f[2:]) / 8
    heights = torch.from_numpy((10 * f[:, 1:-1] - f[:, :-2] - f[:, 2:]) / 8)
    return Lens(front, BSplineSurface(z, heights, (-half_x, half_x), (-half_y, half_y)), outline, 1.5)


def cap(radius, sign=1.0):
    """Sag of a sphere, bending towards sign z."""
    return lambda x, y: sign * (x * x + y * y) / (radius + np.sqrt(radius**2 - x * x - y * y))


@pytest.mark.parametrize("outline", [SQUARE, DISC], ids=lambda o: o.shape)
def test_a_plate_is_as_thick_everywhere_and_has_no_radius(outline):
    shape = describe(lens_of(lambda x, y: 0 * x * y, outline))
    for place in ("centre_thickness", "edge_thickness_min", "edge_thickness_max", "thickness_min", "thickness_max"):
        assert shape[place] == pytest.approx(12.0, abs=ZERO)
    assert shape["sag_pv"] == pytest.approx(0.0, abs=ZERO)
    assert shape["slope_max_deg"] == pytest.approx(0.0, abs=1e-6)
    assert shape["radius_min_concave"] is None and shape["radius_min_convex"] is None
    assert shape["departure_best_sphere"] == pytest.approx(0.0, abs=ZERO)  # its best sphere is the plane


@pytest.mark.parametrize("radius", [30.0, 200.0])
@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["valley", "dome"])
def test_a_spherical_back_is_told_by_its_radius(radius, sign):
    lens = lens_of(cap(radius, sign))
    shape, bend = describe(lens), 3 * 10.0 / (radius**2 - 10.0**2)  # z'''/z'' at the rim: z'' is constant in a span
    rise = radius - np.sqrt(radius**2 - 10.0**2)
    hollow, dome = ("radius_min_concave", "radius_min_convex")[:: int(sign)]
    least = radius * (1 - bend * lens.back.pitch[0] / 2)
    assert shape[hollow] == pytest.approx(least, rel=1e-3)  # a valley of the back is hollow: a tool must fit into it
    assert shape[dome] is None
    assert shape["sag_pv"] == pytest.approx(rise, rel=1e-5)
    assert shape["slope_max_deg"] == pytest.approx(np.degrees(np.arcsin(10.0 / radius)), rel=1e-3)
    assert shape["centre_thickness"] == pytest.approx(12.0, abs=1e-5)
    thick, thin = (12.0 + rise, 12.0) if sign > 0 else (12.0, 12.0 - rise)
    for name, value in (("thickness_max", thick), ("thickness_min", thin)):
        assert shape[name] == pytest.approx(value, abs=1e-5)
    assert shape["edge_thickness_min"] == pytest.approx(12.0 + sign * rise, abs=1e-5)
    assert shape["edge_thickness_max"] == pytest.approx(12.0 + sign * rise, abs=1e-5)
    assert shape["departure_best_sphere"] < 1e-4 * rise


def test_thickness_counts_from_a_curved_front():
    """Concentric-like faces: where front and back bend alike, the thickness along the axis stays the same."""
    shape = describe(lens_of(cap(100.0), front=Sphere(8.0, 0.01)))
    for place in ("centre_thickness", "edge_thickness_min", "thickness_min", "thickness_max"):
        assert shape[place] == pytest.approx(12.0, abs=1e-5)


def test_a_lens_whose_faces_cross_is_thinner_than_nothing():
    shape = describe(lens_of(cap(30.0, -1.0), z=9.0))
    assert shape["thickness_min"] == pytest.approx(1.0 - (30.0 - np.sqrt(800.0)), abs=1e-5)  # -0.7 mm


def test_only_what_is_inside_the_edge_is_looked_at_for_the_thinnest_place():
    """Of 1 + x / 5 mm of glass the half disc over x > 0 has 1 mm and more, and less than none where it is moved to."""
    lens = lens_of(lambda x, y: x / 5 + 0 * y, SQUARE, z=9.0)
    turn = np.linspace(-np.pi / 2, np.pi / 2, 301)
    half = np.stack([4 * np.cos(turn), 4 * np.sin(turn)], axis=1)
    half = np.concatenate([half, np.stack([np.zeros(50), np.linspace(4, -4, 50)], axis=1)])
    assert thickness_range(lens)[0] == pytest.approx(-1.0)
    assert thickness_range(lens, half) == pytest.approx((1.0, 1.8), abs=1e-9)
    assert thickness_range(lens, half - [6.0, 0.0]) == pytest.approx((-0.2, 0.6), abs=1e-9)


@pytest.mark.parametrize("outline", [SQUARE, DISC], ids=lambda o: o.shape)
def test_a_saddle_bends_both_ways_and_no_sphere_is_nearer_than_the_plane(outline):
    """z = a x y: principal curvatures ± a where it is level, PV and departure a (x y)max each way."""
    a = 1e-3
    shape = describe(lens_of(lambda x, y: a * x * y, outline))
    pv = 2 * a * (100.0 if outline is SQUARE else 50.0)  # mm; at the corners, or at 45° of the rim
    assert shape["radius_min_concave"] == pytest.approx(1 / a, rel=1e-3)
    assert shape["radius_min_convex"] == pytest.approx(1 / a, rel=1e-3)
    assert shape["sag_pv"] == pytest.approx(pv, rel=1e-3)
    assert shape["departure_best_sphere"] == pytest.approx(pv, rel=1e-3)


def test_tilt_is_no_departure():
    tilted = describe(lens_of(lambda x, y: 0.1 * x - 0.2 * y))
    assert tilted["departure_best_sphere"] == pytest.approx(0.0, abs=ZERO)
    assert tilted["slope_max_deg"] == pytest.approx(np.degrees(np.arctan(np.hypot(0.1, 0.2))), rel=1e-9)
    assert tilted["sag_pv"] == pytest.approx(2 * 10.0 * np.hypot(0.1, 0.2), rel=1e-6)  # along the steepest diameter


def test_departure_is_what_is_left_when_the_sphere_is_taken_away():
    """A ripple of known height on a known sphere, too fine for a sphere to follow."""
    ripple = 1e-3  # mm, PV 2e-3
    shape = describe(lens_of(lambda x, y: cap(80.0)(x, y) + ripple * np.cos(2 * x) * np.cos(2 * y)))
    assert shape["departure_best_sphere"] == pytest.approx(2 * ripple, rel=0.05)
    steep = describe(lens_of(lambda x, y: 0.7 * x - 0.7 * y + ripple * np.cos(2 * x) * np.cos(2 * y)))
    along_normal = 2 * ripple / np.sqrt(1 + 0.7**2 + 0.7**2)
    assert steep["departure_best_sphere"] == pytest.approx(along_normal, rel=0.05)


@pytest.mark.parametrize("edge", [0.0, 0.02], ids=["waves", "raised edge"])  # mm
@pytest.mark.parametrize("outline", [SQUARE, DISC], ids=lambda o: o.shape)
def test_the_smallest_radii_are_those_of_the_surface_itself(outline, edge):
    """Against the shape operator by differences of the slope, at five places a span each way, its ends included."""
    waves = lens_of(lambda x, y: 0.05 * np.cos(0.7 * x + 0.3) * np.sin(0.6 * y) + 2e-4 * x * y, outline)
    waves.back.heights[0] += edge
    shape = describe(waves)
    (x0, _), (pitch, _) = waves.back.x, waves.back.pitch
    place, beside = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0], dtype=torch.float64), 1e-4
    spans = torch.arange(M - 2)[:, None] + place.clamp(beside, 1 - beside)
    across = x0 + pitch * position(spans.flatten(), M)  # the first and the last span have their own x(t)
    x, y = torch.meshgrid(across, across, indexing="ij")
    inside = waves.outline.contains(x, y)
    x, y, step = x[inside], y[inside], pitch * beside / 2
    slope = waves.back.sag_and_slope
    _, p, q = slope(x, y)
    r = (slope(x + step, y)[1] - slope(x - step, y)[1]) / (2 * step)
    s = (slope(x, y + step)[1] - slope(x, y - step)[1]) / (2 * step)
    t = (slope(x, y + step)[2] - slope(x, y - step)[2]) / (2 * step)
    first = torch.stack([1 + p * p, p * q, p * q, 1 + q * q]).T.view(-1, 2, 2)
    second = torch.stack([r, s, s, t]).T.view(-1, 2, 2) / torch.sqrt(1 + p * p + q * q)[:, None, None]
    curvatures = torch.linalg.eigvals(torch.linalg.solve(first, second)).real  # of the shape operator
    assert shape["radius_min_concave"] == pytest.approx(1 / float(curvatures.max()), rel=1e-3)
    assert shape["radius_min_convex"] == pytest.approx(-1 / float(curvatures.min()), rel=1e-3)


def test_the_slope_energy_of_a_mode_lies_in_its_octave():
    """Cosines of the net, each in the octave of its frequency; a flat or tilted net has no energy at all."""
    place = np.pi * (np.arange(M) + 0.5) / M
    for k, octave in ((60, -1), (33, -1), (32, -2), (20, -2), (9, -3)):
        heights = torch.from_numpy(np.cos(k * place)[:, None] * np.cos(3 * place))
        energy = slope_octaves(BSplineSurface(20.0, heights, (-10.0, 10.0), (-10.0, 10.0)))
        assert energy[octave] > 0.98 * energy.sum(), k
    x = torch.linspace(-1, 1, M, dtype=torch.float64)
    tilted = BSplineSurface(20.0, 0.3 * x[:, None] - x, (-10.0, 10.0), (-10.0, 10.0))
    assert slope_octaves(tilted).sum() < 1e-24
