"""The shape in numbers, on lenses known in closed form, and radii and slopes against scipy's B-splines."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from bstcad.analysis.shape import describe, ripple, slope_octaves, survey, thickness_range
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import BSplineSurface, knots
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from tests.lenses import half_over, net

M = 65
SQUARE, DISC, PLATE = Rectangle(20.0, 20.0), Circle(10.0), Plane(8.0)
OUTLINES = pytest.mark.parametrize("outline", [SQUARE, DISC], ids=lambda outline: outline.shape)
THICKNESSES = ("centre_thickness", "edge_thickness_min", "edge_thickness_max", "thickness_min", "thickness_max")
ZERO = 1e-9  # mm; rounding of heights of 20 mm leaves 1e-14 of them


def lens_of(sag, outline=DISC, front=PLATE, z=20.0) -> Lens:
    """The lens whose back is the quadratic spline next to z + sag(x, y); a round one's net reaches past the rim.

    Control heights (-1 10 -1)/8 of the samples, each way: exact for a parabola, and no end span disturbs the next.
    """
    half, place = half_over(outline, M), np.arange(-1, M + 1) * 2 / (M - 1) - 1
    f = sag(half[0] * place[:, None], half[1] * place[None, :])
    f = (10 * f[1:-1] - f[:-2] - f[2:]) / 8
    heights = torch.from_numpy((10 * f[:, 1:-1] - f[:, :-2] - f[:, 2:]) / 8)
    return Lens.between(front, net(heights, z, half=half), outline, 1.5)


def cap(radius, sign=1.0):
    """Sag of a sphere, bending towards sign z."""
    return lambda x, y: sign * (x * x + y * y) / (radius + np.sqrt(radius**2 - x * x - y * y))


@OUTLINES
def test_a_plate_is_as_thick_everywhere_and_has_no_radius(outline):
    shape = describe(lens_of(lambda x, y: 0 * x * y, outline))
    assert [shape[name] for name in THICKNESSES] == pytest.approx([12.0] * 5, abs=ZERO)
    assert (shape["sag_pv"], shape["departure_best_sphere"]) == pytest.approx((0.0, 0.0), abs=ZERO)  # from a plane
    assert shape["slope_max_deg"] == pytest.approx(0.0, abs=1e-6)
    assert shape["radius_min_concave"] is None and shape["radius_min_convex"] is None


@pytest.mark.parametrize("radius", [30.0, 200.0])
@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["valley", "dome"])
def test_a_spherical_back_is_told_by_its_radius(radius, sign):
    lens = lens_of(cap(radius, sign))
    shape, bend = describe(lens), 3 * 10.0 / (radius**2 - 10.0**2)  # z'''/z'' at the rim: z'' is constant in a span
    rise = radius - np.sqrt(radius**2 - 10.0**2)
    hollow, dome = ("radius_min_concave", "radius_min_convex")[:: int(sign)]
    least = radius * (1 - bend * lens.back.pitch[0] / 2)
    assert shape[hollow] == pytest.approx(least, rel=1e-3)  # a valley of the back is hollow: a tool must fit into it
    assert shape[dome] is None and shape["departure_best_sphere"] < 1e-4 * rise
    assert shape["sag_pv"] == pytest.approx(rise, rel=1e-5)
    assert shape["slope_max_deg"] == pytest.approx(np.degrees(np.arcsin(10.0 / radius)), rel=1e-3)
    edge = 12.0 + sign * rise
    wanted = [12.0, edge, edge, min(12.0, edge), max(12.0, edge)]
    assert [shape[name] for name in THICKNESSES] == pytest.approx(wanted, abs=1e-5)


def test_thickness_counts_from_a_curved_front_and_is_negative_where_faces_cross():
    shape = describe(lens_of(cap(100.0), front=Sphere(8.0, 0.01)))
    assert [shape[name] for name in THICKNESSES] == pytest.approx([12.0] * 5, abs=1e-5)
    lens = lens_of(cap(30.0, -1.0), z=9.0)
    shape = describe(lens)
    assert shape["thickness_min"] == pytest.approx(1.0 - (30.0 - np.sqrt(800.0)), abs=1e-5)  # -0.7 mm
    assert thickness_range(lens) == (shape["thickness_min"], shape["thickness_max"])


def test_only_the_inside_of_the_edge_is_searched_for_the_thinnest_place():
    """A wedge of 1 + x / 5 mm is 1 mm or thicker over the half disc x > 0, and thinner where the disc is moved to."""
    lens = lens_of(lambda x, y: x / 5 + 0 * y, SQUARE, z=9.0)
    turn = np.linspace(-np.pi / 2, np.pi / 2, 301)
    half = np.stack([4 * np.cos(turn), 4 * np.sin(turn)], axis=1)
    half = np.concatenate([half, np.stack([np.zeros(50), np.linspace(4, -4, 50)], axis=1)])
    assert thickness_range(lens)[0] == pytest.approx(-1.0)
    assert thickness_range(lens, half) == pytest.approx((1.0, 1.8), abs=1e-9)
    assert thickness_range(lens, half - [6.0, 0.0]) == pytest.approx((-0.2, 0.6), abs=1e-9)


@OUTLINES
def test_a_saddle_bends_both_ways_and_no_sphere_is_nearer_than_the_plane(outline):
    """z = a x y: principal curvatures ± a where it is level, PV and departure a (x y)max each way."""
    a = 1e-3
    shape = describe(lens_of(lambda x, y: a * x * y, outline))
    pv = 2 * a * (100.0 if outline is SQUARE else 50.0)  # mm; at the corners, or at 45° of the rim
    assert (shape["radius_min_concave"], shape["radius_min_convex"]) == pytest.approx((1 / a, 1 / a), rel=1e-3)
    assert (shape["sag_pv"], shape["departure_best_sphere"]) == pytest.approx((pv, pv), rel=1e-3)


def test_tilt_is_no_departure():
    tilted = describe(lens_of(lambda x, y: 0.1 * x - 0.2 * y))
    assert tilted["departure_best_sphere"] == pytest.approx(0.0, abs=ZERO)
    assert tilted["slope_max_deg"] == pytest.approx(np.degrees(np.arctan(np.hypot(0.1, 0.2))), rel=1e-9)
    assert tilted["sag_pv"] == pytest.approx(2 * 10.0 * np.hypot(0.1, 0.2), rel=1e-6)  # along the steepest diameter


def test_departure_is_the_rest_beside_the_best_sphere():
    """A ripple of known height on a known sphere, too fine for a sphere to follow; on a slope along the normal."""
    height = 1e-3  # mm, PV 2e-3
    shape = describe(lens_of(lambda x, y: cap(80.0)(x, y) + height * np.cos(2 * x) * np.cos(2 * y)))
    assert shape["departure_best_sphere"] == pytest.approx(2 * height, rel=0.05)
    steep = describe(lens_of(lambda x, y: 0.7 * x - 0.7 * y + height * np.cos(2 * x) * np.cos(2 * y)))
    assert steep["departure_best_sphere"] == pytest.approx(2 * height / np.sqrt(1 + 0.7**2 + 0.7**2), rel=0.05)


def test_the_slope_energy_of_a_mode_lies_in_its_octave():
    """Cosines of the net, each in the octave of its frequency; a flat or tilted net has no energy at all."""
    place = np.pi * (np.arange(M) + 0.5) / M
    for k, octave in ((60, -1), (33, -1), (32, -2), (20, -2), (9, -3)):
        heights = torch.from_numpy(np.cos(k * place)[:, None] * np.cos(3 * place))
        energy = slope_octaves(BSplineSurface(20.0, heights, (-10.0, 10.0), (-10.0, 10.0)))
        assert energy[octave] > 0.98 * energy.sum(), k
    assert slope_octaves(net(lambda x, y: 0.03 * x - 0.1 * y, m=M)).sum() < 1e-24


@pytest.mark.parametrize("k", [(50, 20), (40, 45), (10, 40)])
def test_height_and_slope_of_a_ripple_are_those_of_the_face(k):
    """One cosine in the highest octave, by points all over the face; a kink along the rim of the net is no ripple."""
    heights = np.outer(*(np.cos(i * np.pi * (np.arange(M) + 0.5) / M) for i in k))
    face = BSplineSurface(20.0, torch.from_numpy(1e-3 * heights), (-10.0, 10.0), (-7.0, 7.0))
    at = np.random.default_rng(0).uniform(-0.95, 0.95, (2, 40_000))
    z, z_x, z_y = (v.numpy() for v in face.sag_and_slope(*torch.from_numpy(at * [[10.0], [7.0]])))
    found = ripple(face)
    assert found.height == pytest.approx(float(np.sqrt(((z - 20.0) ** 2).mean())), rel=0.03)
    assert found.slope == pytest.approx(float(np.sqrt((z_x**2 + z_y**2).mean())), rel=0.03)
    dome = lens_of(lambda x, y: np.cos(x / 6) * np.cos(y / 6)).back
    assert ripple(dome).slope == 0.0


class TestSurvey:
    """The smallest radii and the steepest slope, in each knot span up to its ends."""

    M, HALF = 41, 5.0
    WHOLE, ROUND = Rectangle(10.0, 10.0), Circle(4.4)
    SIDE = 1e-12  # distance from which a knot is approached from one side, as a fraction of a span

    def rough(self, outline, heights=None):
        """A back of waves as short as its net can hold: its second derivatives jump at every knot."""
        if heights is None:
            heights = torch.from_numpy(np.random.default_rng(5).normal(0.0, 0.02, (self.M, self.M)))
        half = (-self.HALF, self.HALF)
        return Lens.between(Plane(0.0), BSplineSurface(3.0, heights, half, half), outline, 1.5)

    def spline(self, lens):
        """(x, y of the places (mm), slope, the two principal curvatures) with five places a span each way.

        z(t, s) and x(t) are B-splines of the same knots; z_x = z_t / x_t, z_xx = (z_tt - z_x x_tt) / x_t².
        """
        quarters = np.clip([0.0, 0.25, 0.5, 0.75, 1.0], self.SIDE, 1 - self.SIDE)
        t = (np.arange(self.M - 2)[:, None] + quarters).ravel()
        eye, line, h = np.eye(self.M), np.linspace(-self.HALF, self.HALF, self.M), lens.back.heights.numpy()
        value, first, second = (BSpline(knots(self.M), eye, 2)(t, order) for order in range(3))
        place, speed, bend = value @ line, first @ line, second @ line
        along = first / speed[:, None]  # d/dx of the basis
        twice = (second - along * bend[:, None]) / speed[:, None] ** 2
        p, q = along @ h @ value.T, value @ h @ along.T
        r, s, u = twice @ h @ value.T, along @ h @ along.T, value @ h @ twice.T
        metric = np.stack([1 + p * p, p * q, p * q, 1 + q * q], -1).reshape(*p.shape, 2, 2)
        second_form = np.stack([r, s, s, u], -1).reshape(*p.shape, 2, 2) / np.sqrt(1 + p * p + q * q)[..., None, None]
        both = np.sort(np.linalg.eigvals(np.linalg.solve(metric, second_form)).real, axis=-1)
        x, y = np.meshgrid(place, place, indexing="ij")
        return x, y, np.hypot(p, q), both

    @pytest.mark.parametrize("outline", [WHOLE, Rectangle(7.3, 4.1), ROUND], ids=("whole", "less", "round"))
    def test_on_a_grid_four_times_finer_than_the_net(self, outline):
        lens = self.rough(outline)
        x, y, slope, curved = self.spline(lens)
        held = outline.contains(*(torch.from_numpy(p * (1 - 1e-9)) for p in (x, y))).numpy()
        concave, convex = 1 / curved[..., 1][held].max(), -1 / curved[..., 0][held].min()
        found = survey(lens)
        assert (found.concave.largest, found.convex.largest) == pytest.approx((concave, convex), rel=1e-7)
        steepest = np.degrees(np.arctan(slope[held].max()))
        assert steepest * (1 - 1e-9) <= found.slope.largest <= steepest * 1.02  # the rim counts, too
        middles = curved[2::5, 2::5][held[2::5, 2::5]]
        assert 1 / middles[:, 1].max() > 1.1 * concave  # the middles of spans alone would say more

    def test_the_description_has_the_figures_that_bounds_are_held_to(self):
        lens = self.rough(self.ROUND)
        shape, found = describe(lens, 65), survey(lens, concave=0.5, convex=0.5, slope=30.0)
        assert (shape["radius_min_concave"], shape["radius_min_convex"]) == (
            found.concave.largest,
            found.convex.largest,
        )
        assert shape["slope_max_deg"] == found.slope.largest and 0 < found.concave.at_bound < 1

    def test_the_back_outside_the_outline_does_not_count(self):
        lens = self.rough(self.ROUND)
        heights = lens.back.heights.clone()
        heights[:4, :4] += 3.0 * torch.rand(4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        spiked = self.rough(self.ROUND, heights)
        assert survey(spiked) == survey(lens)
        whole, also = (vars(survey(replace(each, outline=self.WHOLE))) for each in (lens, spiked))
        assert all(whole[kind] != also[kind] for kind in ("concave", "convex", "slope"))

    def test_the_slope_of_the_rim_counts(self):
        """z = x² / 2 R over a round lens is steepest at two points of its rim, between the places of the grid."""
        heights = net(lambda x, y: x**2 / 40.0, m=self.M, half=self.HALF).heights
        slope = survey(self.rough(Circle(4.37), heights)).slope
        assert slope.largest == pytest.approx(math.degrees(math.atan(4.37 / 20.0)), rel=1e-9)
        assert re.match(r"at \(-?4.37, ", slope.where)

    def test_no_digit_depends_on_the_number_of_threads(self):
        lens, threads, found = self.rough(self.ROUND), torch.get_num_threads(), []
        try:
            for count in (1, 3):
                torch.set_num_threads(count)
                found.append(survey(lens, concave=0.1, convex=0.1, slope=20.0))
        finally:
            torch.set_num_threads(threads)
        assert found[0] == found[1]
