"""OpticStudio's grid sag: its density follows from the net, and how far the light moves by it is stated truly."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicHermiteSpline

from bstcad.exports import grid_sag
from bstcad.exports.grid_sag import MAX_SHIFT, GridLight, GridSag, shift_by_patches, table_note
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import MIRROR
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane, sag
from tests.exports.test_exports import read_zemax

OUTLINE, THROW = Rectangle(8.0, 6.0), 200.0  # mm
BEAM = GridLight(CollimatedSource(OUTLINE), (Screen(4.0 + THROW, (-20.0, 20.0), (-15.0, 15.0), (160, 120)),))


def wavy(shape=(21, 17), past=2, outline=OUTLINE):
    """A plate whose back has waves of all lengths that its net can hold, which reaches `past` spans past the rim."""
    heights = torch.from_numpy(np.random.default_rng(7).normal(0.0, 0.002, shape))
    ends = [half * (m - 1) / (m - 1 - 2 * past) for half, m in zip(outline.half_extent, shape, strict=True)]
    back = BSplineSurface(4.0, heights, (-ends[0], ends[0]), (-ends[1], ends[1]))
    return Lens.between(Plane(1.0), back, outline, 1.49)


def interpolated(text, x, y):
    """∂z/∂x and ∂z/∂y of a grid sag at points, cell by cell along x and then along y, by SciPy's cubics."""
    at_x, at_y, (z, z_x, z_y, z_xy) = read_zemax(text)
    along, across = (CubicHermiteSpline(at_x, value, slope, axis=1) for value, slope in ((z, z_x), (z_y, z_xy)))
    found = []
    for px, py in zip(x, y, strict=True):
        in_x, in_y = ([each(px, nu) for each in (along, across)] for nu in (1, 0))
        found.append([CubicHermiteSpline(at_y, *in_x)(py), CubicHermiteSpline(at_y, *in_y)(py, 1)])
    return np.array(found).T


@pytest.mark.parametrize("points", [None, 21, 60])
def test_the_light_moves_as_far_as_is_stated(points):
    """A slope that is off by δ turns light by (n - 1) δ, as long as the face is nearly level."""
    lens = wavy()
    grid = GridSag.of(lens, lens.back, points, BEAM)
    x, y = np.random.default_rng(1).uniform(-1.0, 1.0, (2, 1500)) * np.array([[4.0], [3.0]])
    slopes = np.array([part.numpy() for part in lens.back.sag_and_slope(*map(torch.from_numpy, (x, y)))[1:]])
    off = (lens.index - 1) * THROW * np.linalg.norm(interpolated(grid.text(), x, y) - slopes, axis=0)
    at = grid.grid.x, grid.grid.y
    assert [each[-1] for each in at] == pytest.approx([4.0, 3.0]) == [-each[0] for each in at]  # as large as the lens
    if points is None:  # through the knots, with one point between two: nothing moves
        assert off.max() < 1e-9 and grid.shift.maximum < 1e-9 and [len(each) for each in at] == [33, 25]
        assert "without --points" not in grid.note("a.dat")
    else:
        assert grid.shift.rms == pytest.approx(np.sqrt((off**2).mean()), rel=0.1)  # by 1500 points
        assert grid.shift.maximum == pytest.approx(off.max(), rel=0.3)
        assert ("without --points" in grid.note("a.dat")) == (grid.shift.maximum > MAX_SHIFT * grid.shift.pixel)
        assert grid.shift.pixel == 0.25 and f"{points} x" in grid.note("a.dat")


@pytest.mark.parametrize("outline", [OUTLINE, Circle(3.0)], ids=lambda outline: outline.shape)
def test_where_the_lens_reaches_into_the_end_spans_the_grid_gets_finer(outline):
    """There the net is no polynomial in x: it takes a grid of some cells a span, still through all knots."""
    lens = wavy((21, 21), past=0, outline=outline)
    grid = GridSag.of(lens, lens.back, light=replace(BEAM, source=CollimatedSource(outline)))
    cells = np.array(lens.back.pitch) / grid.grid.step
    assert cells == pytest.approx(cells.round()) and cells[0] >= 2
    assert 0 < grid.shift.maximum <= MAX_SHIFT * grid.shift.pixel
    assert shift_by_patches(lens, lens.back, GridSag.of(lens, lens.back, 21).patches, BEAM).rms > 10 * grid.shift.rms


def test_light_of_a_point_and_a_face_before_it_are_judged_too():
    """Rays that run askew meet the patches where they meet the face."""
    lens = wavy()
    lens = lens.with_front(lens.back.moved(1.0)).with_back(Plane(4.0))
    throw = GridLight(PointSource((0.0, 0.0, -30.0), half_angle=5.0, profile="uniform"), BEAM.screens)
    exact, coarse = (GridSag.of(lens, lens.front, points, throw).shift for points in (None, 21))
    assert exact.maximum < 1e-9 < 1e-3 < coarse.rms < coarse.maximum
    beside = replace(throw, source=PointSource((300.0, 0.0, -30.0), half_angle=1.0, profile="uniform"))
    assert GridSag.of(lens, lens.front, 21, beside).shift is None
    assert "no light reaches the target" in table_note(lens, lens.front, "sag.csv", points=21, light=beside)


def test_a_mirror_is_judged_by_its_own_light():
    """A slope that is off by δ turns reflected light by 2 δ: four times as far as through a lens of index 1.5."""
    through = replace(wavy(), index=1.5)
    mirror = replace(through, passes=MIRROR).with_front(Plane(-2.0))
    lenses = through, mirror
    moved = [shift_by_patches(lens, lens.back, GridSag.of(lens, lens.back, 21).patches, BEAM) for lens in lenses]
    assert moved[1].rms == pytest.approx(4 * moved[0].rms, rel=0.02)


def test_a_large_grid_ends_at_the_knots_beyond_the_rim(monkeypatch):
    """The large grid has a quarter of the points, wherever the rim lies between the knots."""
    monkeypatch.setattr(grid_sag, "MAX_FLUSH_POINTS", 33 * 25 - 1)
    for lens in (wavy(), wavy(past=1.8)):
        each = GridSag.of(lens, lens.back, None, BEAM)
        assert (len(each.grid.x), len(each.grid.y)) == (18, 14) and each.shift.maximum < 1e-9
        assert 4.0 < each.grid.x[-1] < 4.0 + each.grid.step[0] and each.grid.x[0] == pytest.approx(-each.grid.x[-1])


def test_a_narrow_lens_has_the_five_points_that_opticstudio_asks_for():
    lens = wavy((21, 9), outline=Rectangle(8.0, 0.5))
    for points in (None, 9):
        grid = GridSag.of(lens, lens.back, points)
        assert len(grid.grid.y) >= 5 and len(grid.grid.x) >= 5 and grid.shift is None
        x, y, (z, *_) = read_zemax(grid.text())
        assert x[-1] >= 4.0 - 1e-9 and y[-1] >= 0.25 - 1e-9
        assert np.abs(z + sag(lens.back, 0.0, 0.0) - sag(lens.back, *np.meshgrid(x, y))).max() < 1e-12
