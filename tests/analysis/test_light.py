"""Light through a lens where geometry knows it: drawn rays, apertures that light needs, margins, the source's image."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.analysis.light import (
    FAN_RAYS,
    GRID_LINES,
    blur,
    bundle,
    fan,
    finest_detail,
    margins,
    needed_apertures,
    ray_map,
)
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import MIRROR
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace.source_images import even_image, images
from tests.lenses import net

INDEX = 1.5
FRONT, BLOCK = Plane(2.0), Rectangle(16.0, 12.0)


def lens_of(sag=None, front=FRONT, outline=BLOCK, m=33, z=10.0, **more):
    """A lens whose net, as large as the outline's box, has the heights sag(x, y)."""
    return Lens.between(front, net(sag, z, m, outline.half_extent), outline, **{"index": INDEX} | more)


class TestDrawnRays:
    TARGET = LevelPlane(300.0)
    EXACT = 1e-9  # mm; the trace stops at 1e-12 of the lens's size, the way to the screen makes a hundred times more
    BEAM = CollimatedSource(Circle(6.0), z=-5.0)
    LAMP = PointSource((0.4, 0.0, -30.0))
    SOURCES = pytest.mark.parametrize("source", [BEAM, LAMP], ids=["beam", "lamp"])
    ROUGH = lens_of(
        lambda x, y: 0.05 * torch.sin(x / 2) * torch.cos(y / 3) - 0.01 * (x * x + y * y), front=Sphere(2.0, 0.01)
    )

    @staticmethod
    def at(surface, points):
        """z, ∂z/∂x and ∂z/∂y of a surface over points (n, 3)."""
        return np.stack([part.numpy() for part in surface.sag_and_slope(*torch.from_numpy(points.T[:2].copy()))])

    @SOURCES
    def test_the_fan_runs_from_the_source_over_both_faces_to_the_target(self, source):
        rays, (front, back) = fan(source, self.ROUGH, self.TARGET), (self.ROUGH.front, self.ROUGH.back)
        assert rays.shape[1:] == (4, 3) and FAN_RAYS - 2 <= len(rays) <= FAN_RAYS  # an outermost ray may be vignetted
        start = source.position if source is self.LAMP else [*rays[0, 1, :2], source.start(front.z)]
        assert np.array_equal(rays[0, 0], start)
        for stop, face in ((1, front), (2, back)):
            assert np.abs(self.at(face, rays[:, stop])[0] - rays[:, stop, 2]).max() < self.EXACT
            assert self.ROUGH.outline.contains(*torch.from_numpy(rays[:, stop, :2].T.copy())).all()
        assert (rays[:, 3, 2] == self.TARGET.z).all() and (np.diff(rays[:, :, 2], axis=1) > 0).all()

    def test_rays_that_do_not_arrive_are_not_drawn(self):
        steep = lens_of(lambda x, y: 2.0 * x, Plane(-10.0))  # beyond the critical angle everywhere
        assert fan(self.BEAM, steep, self.TARGET).shape == (0, 4, 3)
        near = fan(
            PointSource((0.0, 0.0, -2.0)), lens_of(front=Plane(0.0)), self.TARGET
        )  # the sides take the outer rays
        assert 0 < len(near) <= FAN_RAYS and np.isfinite(near).all()

    def test_a_bundle_carries_the_light_that_arrives(self):
        ways, flux = bundle(self.BEAM, lens_of(), self.TARGET, 100)
        assert ways.shape == (len(flux), 4, 3) and flux.sum() == pytest.approx(1.0, abs=0.02)  # cells on the beam's rim

    @pytest.mark.parametrize("index", [INDEX, 1.0], ids=["glass", "air"])
    def test_a_flat_plate_maps_a_beam_onto_itself(self, index):
        start, end = ray_map(self.BEAM, lens_of(index=index), self.TARGET)
        lit = np.isfinite(start).all(axis=-1)
        assert start.shape == end.shape == (GRID_LINES, GRID_LINES, 2)
        assert lit.mean() == pytest.approx(np.pi / 4, abs=0.1)
        assert np.abs(end - start)[lit].max() < self.EXACT and np.hypot(*start[lit].T).max() <= 6.0

    def test_without_bending_a_lamp_casts_a_shadow_in_proportion(self):
        """Index 1: a point (x, y) of the front's plane lands where the straight line from the lamp does."""
        start, end = ray_map(self.LAMP, lens_of(lambda x, y: 0.1 * x, index=1.0), self.TARGET)
        lamp = np.array(self.LAMP.position)
        straight = lamp[:2] + (start - lamp[:2]) * (self.TARGET.z - lamp[2]) / (2.0 - lamp[2])
        lit = np.isfinite(end).all(axis=-1)
        assert lit.sum() > 0.8 * GRID_LINES**2 and np.abs(end - straight)[lit].max() < 1e-8
        assert np.array_equal(np.isnan(start), np.isnan(end))  # a lost ray is drawn on neither side


class TestUsed:
    GRID = 0.01  # spacing of the grid of rays, as a fraction of the width of the light
    WIDE = Rectangle(24.0, 24.0)

    def faces(self, source, outline=WIDE, **more):
        return tuple(
            needed_apertures(source, lens_of(front=Plane(10.0), outline=outline, z=20.0, m=9, **more)).values()
        )

    @pytest.mark.parametrize("aperture", [Circle(5.0), Rectangle(8.0, 4.0), Circle(12.0)])
    def test_a_beam_meets_both_faces_of_a_plate_as_it_is(self, aperture):
        for patch in self.faces(CollimatedSource(aperture)):
            assert patch.shape == aperture.shape and patch.half_extent == pytest.approx(aperture.half_extent, rel=0.01)

    @pytest.mark.parametrize("outline", [WIDE, Circle(12.0)])
    def test_light_that_fills_a_face_needs_all_of_it(self, outline):
        assert set(self.faces(CollimatedSource(outline), outline)) == {None}

    def test_a_cone_widens_through_a_plate_as_snell_says(self):
        angle = math.radians(20.0)
        front, back = self.faces(PointSource(profile="uniform", half_angle=20.0))
        radius, inside = 10.0 * math.tan(angle), 10.0 * math.tan(math.asin(math.sin(angle) / INDEX))
        assert (front.radius, back.radius) == pytest.approx((radius, radius + inside), rel=self.GRID)

    def test_a_lamp_of_some_size_needs_more_and_a_strip_of_light_is_not_round(self):
        front, _ = self.faces(PointSource(profile="uniform", half_angle=20.0, diameter=2.0))
        assert front.radius == pytest.approx(10.0 * math.tan(math.radians(20.0)) + 1, rel=self.GRID)
        strip, _ = self.faces(CollimatedSource(Rectangle(12.0, 1.0)), Rectangle(24.0, 1.0))
        assert strip.shape == "rectangle" and strip.width == pytest.approx(12.0, rel=self.GRID)

    def test_a_mirror_has_one_face_that_light_meets(self):
        lamp = PointSource(position=(0.0, 0.0, 50.0), profile="uniform", half_angle=10.0)
        [face] = self.faces(lamp, passes=MIRROR)
        assert face.radius == pytest.approx(30.0 * math.tan(math.radians(10.0)), rel=self.GRID)


class TestMargins:
    CRITICAL = math.degrees(math.asin(1 / INDEX))
    SCREEN = Screen(1000.0, (-500.0, 500.0), (-500.0, 500.0), 16)
    BEAM = CollimatedSource(Circle(4.0), z=0.0)

    @staticmethod
    def wedge(degrees):
        """A plane front and a back that rises along x by an angle."""
        outline = Rectangle(10.0, 10.0)
        return lens_of(lambda x, y: x * math.tan(math.radians(degrees)), Plane(5.0), outline, m=9, z=20.0)

    def of(self, lens, source=BEAM, n=64):
        return margins((Channel(source, lens.index),), lens, self.SCREEN, seed=1, n=n)

    @pytest.mark.parametrize("degrees", [0.0, 10.0, 41.0, CRITICAL - 1e-3, CRITICAL + 1e-3, 45.0])
    def test_the_margin_of_a_wedge_is_the_critical_angle_less_its_own(self, degrees):
        """A beam along the axis meets the wedge at the wedge's angle; beyond the critical angle there is no margin."""
        found = self.of(self.wedge(degrees))
        assert found.tir_margin_deg == pytest.approx(self.CRITICAL - degrees, abs=1e-6)  # arccos near 1 keeps 1e-8 rad
        assert found.newton_slope_min == pytest.approx(1.0) and found.non_finite == 0  # d = (0, 0, 1): F' = d_z

    def test_newtons_slope_behind_a_point_source(self):
        """F' = d_z - d_x tan α; least for the ray that leans most along the rise."""
        found = self.of(self.wedge(30.0), PointSource((0.0, 0.0, 0.0)), n=256)
        in_glass = math.asin(math.sin(math.atan(5.0 / 5.0)) / INDEX)  # at most: at the front's rim
        least = math.cos(in_glass) - math.sin(in_glass) * math.tan(math.radians(30.0))
        assert least < found.newton_slope_min < 1.0 and found.tir_margin_deg < self.CRITICAL - 30.0

    def test_light_that_misses_the_back_has_no_margin(self):
        found = self.of(replace(self.wedge(0.0), outline=Circle(1e-9)), replace(self.BEAM, aperture=Circle(1e-3)), n=8)
        assert found.tir_margin_deg is None and found.newton_slope_min is None

    def test_values_that_are_not_finite_are_counted(self):
        lens = self.wedge(5.0)
        heights = lens.back.heights.clone()
        heights[4, 4], heights[2, 7] = float("nan"), float("inf")
        assert self.of(lens.with_back(replace(lens.back, heights=heights)), n=8).non_finite >= 2


class TestBlur:
    """Through a plate that bends nothing, by similar triangles: 30 mm from the source to its back, 300 mm behind."""

    FAR, BACK = -20.0, 10.0  # mm; planes of the source and of the back face
    SCREEN = Screen(310.0, (-60.0, 60.0), (-40.0, 40.0), (60, 40))  # pixels of 2 mm
    EVEN = np.ones(SCREEN.shape)

    def plate(self, index=1.0, radius=4.0):
        lens = lens_of(front=Plane(self.BACK - 6.0), outline=Rectangle(12.0, 12.0), m=9, index=index)
        return replace(lens, outline=Circle(radius))

    def disc(self, diameter, index=1.0, count=80):
        """Points that cover a disc evenly, each a channel."""
        k = np.arange(count) + 0.5
        r, turn = diameter / 2 * np.sqrt(k / count), k * math.pi * (3 - math.sqrt(5))
        source = PointSource((0.0, 0.0, self.FAR), profile="lambertian")
        places = zip(r * np.cos(turn), r * np.sin(turn), strict=True)
        return tuple(Channel(replace(source, position=(x, y, self.FAR)), index, 1 / count) for x, y in places)

    def of(self, channels, target=EVEN, lens=None, screen=SCREEN):
        return blur(channels, lens or self.plate(), screen, target, n=6)

    def test_a_source_is_seen_magnified_by_the_ratio_of_distances_and_nearer_through_glass(self):
        """A disc of 1 mm is seen as one of 10 mm, five pixels; near the axis glass of thickness t counts as t / n."""
        found = self.of(self.disc(1.0))
        assert found.width == pytest.approx(10.0, rel=0.01)  # 80 points for a disc
        assert found.pixels == pytest.approx(found.width / 2, rel=1e-12)
        through_glass = self.of(self.disc(0.1, 1.5), lens=self.plate(1.5, radius=0.5))
        assert through_glass.width == pytest.approx(0.1 * 300 / (24 + 6 / 1.5), rel=0.01)

    def test_a_point_has_no_image_and_a_small_source_blurs_little(self):
        target = np.random.default_rng(0).random(self.SCREEN.shape)
        assert self.of(self.disc(0.0, count=1), target) is None
        found = self.of(self.disc(1e-6), target)
        assert found.width == pytest.approx(1e-5, rel=0.01) and found.rrmsd < 1e-4

    def test_even_light_loses_at_its_edges_alone_and_stripes_lose_all(self):
        middle, stripes = np.zeros((2, *self.SCREEN.shape))
        middle[10:30, 15:45] = stripes[:, ::2] = 1.0  # two pixels a period
        even, edged, fine = (self.of(self.disc(1.0), target).rrmsd for target in (self.EVEN, middle, stripes))
        assert even < edged < fine and 0.6 < fine < 0.8  # of 0.707, all of them gone
        # a straight edge across a disc of diameter D: ∫ err² = 2 D ∫_0^1/2 (share beyond)² du = 0.0676 D
        assert edged == pytest.approx(math.sqrt(0.0676 * 5 * 100 / 600), rel=0.1)

    def test_the_mean_image_is_that_of_the_disc(self):
        """Sum 1, its centroid in the middle, and even inside."""
        mean = images(self.disc(4.0, count=400), self.plate(), replace(self.SCREEN, pixels=(30, 20)), 5).mean((30, 20))
        rows, columns = (np.arange(k) - (k - 1) / 2 for k in mean.shape)
        assert (mean.sum(), mean.sum(1) @ rows, mean.sum(0) @ columns) == pytest.approx((1.0, 0.0, 0.0), abs=1e-9)
        inside = mean[np.hypot(rows[:, None], columns) < 4]  # of 5 pixels
        assert inside.std() < 0.05 * inside.mean()

    @pytest.mark.parametrize(("extent", "width"), [(Circle(4.0), 8.0), (Rectangle(6.0, 6.0), 6 * math.sqrt(4 / 3))])
    def test_an_even_image_is_as_wide_as_the_disc_of_its_variance(self, extent, width):
        """Per axis R² / 4 of a disc, s² / 12 of a square."""
        assert even_image(extent).width() == pytest.approx(width, rel=1e-6)

    def test_the_finest_detail_is_the_source_s_image_on_pixels_and_shrinks_with_the_distance(self):
        """A source of 10 mm and pixels of 2 mm: the nearer target is in fact lit with so small an image."""
        here = self.of(self.disc(1.0))
        found = finest_detail(here.pixels, self.plate(), self.SCREEN, "source.diameter = 1 mm")
        assert found.width == pytest.approx(math.sqrt(10**2 + 4 / 3 * 2**2), rel=0.01)
        assert (found.distance, found.nearer_distance, found.assumed) == (300.0, None, False)  # 2.5 times 120 mm
        small = replace(self.SCREEN, x=(-20.0, 20.0), y=(-20.0, 20.0), pixels=40)  # of 1 mm
        found = finest_detail(10.0, self.plate(), small, "source.diameter = 1 mm")
        assert found.nearer_distance == 100.0
        there = self.of(self.disc(1.0), np.ones(small.shape), screen=replace(small, z=self.BACK + 100.0))
        assert found.nearer_width == pytest.approx(math.sqrt(there.width**2 + 4 / 3), rel=0.01)

    def test_the_finest_detail_is_never_below_the_cells_on_which_the_light_is_right(self):
        """A nearer target does not make the light right on smaller cells."""
        small = replace(self.SCREEN, x=(-20.0, 20.0), y=(-20.0, 20.0), pixels=40)
        free, bound = (finest_detail(10.0, self.plate(), small, "a source", least=least) for least in (0.0, 12.0))
        assert free.nearer_width < free.width < 12.0
        assert (bound.width, bound.nearer_width, bound.source_image) == (12.0, None, free.source_image)
