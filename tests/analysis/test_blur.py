"""The image of the source on the target: of a plate that bends nothing, by similar triangles; and what it blurs."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.analysis.blur import blur, finest_detail
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.channels import Channel
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.measure import even_image, images
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.sources import Point
from bstcad.optics.surfaces import Plane

FAR, BACK = -20.0, 10.0  # mm; planes of the source and of the back face
SCREEN = Screen(310.0, (-60.0, 60.0), (-40.0, 40.0), (60, 40))  # ten times as far behind the back; pixels of 2 mm


def plate(index=1.0):
    """Flat on both sides; of index 1 it bends nothing."""
    back = BSplineSurface(BACK, torch.zeros((9, 9), dtype=torch.float64), (-6.0, 6.0), (-6.0, 6.0))
    return Lens(Plane(BACK - 6.0), back, Circle(4.0), index)


def disc(diameter, index=1.0, count=150):
    """Points that cover a disc evenly, each a channel."""
    k = np.arange(count) + 0.5
    r, turn = diameter / 2 * np.sqrt(k / count), k * math.pi * (3 - math.sqrt(5))
    source = Point((0.0, 0.0, FAR), profile="lambertian")
    places = zip(r * np.cos(turn), r * np.sin(turn), strict=True)
    return tuple(Channel(replace(source, position=(x, y, FAR)), index, 1 / count) for x, y in places)


def test_through_a_hole_a_source_is_seen_magnified_by_the_ratio_of_distances():
    """300 mm behind, 30 mm before: a disc of 1 mm is seen as one of 10 mm, five pixels."""
    found = blur(disc(1.0), plate(), SCREEN, np.ones(SCREEN.shape), n=6)
    assert found.width == pytest.approx(10.0, rel=0.01)  # 150 points for a disc
    assert found.pixels == pytest.approx(found.width / 2, rel=1e-12)


def test_glass_brings_the_source_nearer():
    """Near the axis a plate of thickness t counts as t / n."""
    small = replace(plate(1.5), outline=Circle(0.5))
    assert blur(disc(0.1, 1.5), small, SCREEN, np.ones(SCREEN.shape), n=6).width == pytest.approx(
        0.1 * 300 / (24 + 6 / 1.5), rel=0.01
    )


def test_a_point_has_no_image_and_a_small_source_blurs_little():
    target = np.random.default_rng(0).random(SCREEN.shape)
    assert blur(disc(0.0, count=1), plate(), SCREEN, target, n=6) is None
    found = blur(disc(1e-6), plate(), SCREEN, target, n=6)
    assert found.width == pytest.approx(1e-5, rel=0.01) and found.rrmsd < 1e-4


def test_the_mean_image_is_that_of_the_disc():
    """Sum 1, its centroid in the middle, and even inside."""
    coarse = replace(SCREEN, pixels=(30, 20))
    mean = images(disc(4.0, count=1000), plate(), coarse, 5).mean()
    rows, columns = (np.arange(k) - (k - 1) / 2 for k in mean.shape)
    assert mean.sum() == pytest.approx(1.0)
    assert (mean.sum(1) * rows).sum() == pytest.approx(0.0, abs=1e-9)
    assert (mean.sum(0) * columns).sum() == pytest.approx(0.0, abs=1e-9)
    inside = np.hypot(rows[:, None], columns) < 4  # of 5 pixels
    assert mean[inside].std() < 0.05 * mean[inside].mean()


def test_even_light_loses_at_its_edges_alone_and_stripes_lose_all():
    wide = disc(1.0)  # seen as five pixels
    middle = np.zeros(SCREEN.shape)
    middle[10:30, 15:45] = 1.0
    stripes = np.zeros(SCREEN.shape)
    stripes[:, ::2] = 1.0  # two pixels a period
    even, edged, fine = (
        blur(wide, plate(), SCREEN, target, n=6).rrmsd for target in (np.ones(SCREEN.shape), middle, stripes)
    )
    assert even < edged < fine
    assert 0.6 < fine < 0.8  # of 0.707, all of them gone
    # a straight edge across a disc of diameter D: ∫ err² = 2 D ∫_0^1/2 (share beyond)² du = 0.0676 D
    assert edged == pytest.approx(math.sqrt(0.0676 * 5 * 100 / 600), rel=0.1)


def test_light_counts_by_its_flux():
    """Two points, one of them dark: no image of two."""
    here, there = disc(1.0, count=2)
    both, one = (
        blur((here, replace(there, weight=w)), plate(), SCREEN, np.ones(SCREEN.shape), n=6) for w in (0.5, 0.0)
    )
    assert one.width < 1e-9 < 1 < both.width


@pytest.mark.parametrize(("extent", "width"), [(Circle(4.0), 8.0), (Rectangle(6.0, 6.0), 6 * math.sqrt(4 / 3))])
def test_an_even_image_is_as_wide_as_the_disc_of_its_variance(extent, width):
    """Per axis R² / 4 of a disc, s² / 12 of a square."""
    assert even_image(extent).width() == pytest.approx(width, rel=1e-6)
    assert even_image(extent).mean().sum() == pytest.approx(1.0)


def test_the_finest_detail_is_the_source_s_image_on_pixels_and_shrinks_with_the_distance():
    """Of 10 mm and pixels of 2 mm; the nearer target is in fact lit with so small an image."""
    target = np.ones(SCREEN.shape)
    here = blur(disc(1.0), plate(), SCREEN, target, n=6)
    found = finest_detail(here.pixels, plate(), SCREEN, "source.diameter = 1 mm")
    assert found.width == pytest.approx(math.sqrt(10**2 + 4 / 3 * 2**2), rel=0.01)
    assert (found.distance, found.nearer_distance, found.assumed) == (300.0, None, False)  # 2.5 times 120 mm
    small = replace(SCREEN, x=(-20.0, 20.0), y=(-20.0, 20.0), pixels=40)
    found = finest_detail(10.0, plate(), small, "source.diameter = 1 mm")  # pixels of 1 mm
    assert found.nearer_distance == 100.0
    there = blur(disc(1.0), plate(), replace(small, z=BACK + 100.0), np.ones(small.shape), n=6)
    assert found.nearer_width == pytest.approx(math.sqrt(there.width**2 + 4 / 3), rel=0.01)
