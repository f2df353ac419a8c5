"""Figures show the given data: right way up, in mm, with the stated numbers."""

import io
from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from PIL import Image

from bstcad.analysis.shape import describe
from bstcad.designs.course import CurvePoint, StageRecord
from bstcad.figures import drawing, figure_jobs, light_figures
from bstcad.figures.drawing import png
from bstcad.figures.light_figures import (
    View,
    balanced,
    cross_section,
    irradiance_triptych,
    lit_mean,
    primary,
    spectral_lines,
)
from bstcad.optics.lens.lens import Lens
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace.measure import CellError, SpectralLine
from bstcad.scene.picture import to_srgb

X, Y = (0.0, 400.0), (-100.0, 200.0)
LENS, BEHIND = View(X, Y, "lens"), View(X, Y, "behind")


@pytest.fixture(autouse=True)
def coarse_maps(monkeypatch):
    """Maps of 101 x 101 samples: quick, and their laws hold at any number."""
    monkeypatch.setattr(figure_jobs, "MAP_POINTS", 101)


def corner_picture(pixels=16):
    """Bright at row 0, column 0 (x min, y max), grey elsewhere."""
    target = np.full((pixels, pixels), 0.2)
    target[0, 0] = 1.0
    return target


def lens_of(sag, outline=None, m=33, front=None):
    """A lens whose back control points are sag(x, y) above z = 20 over [-10, 10]²."""
    line = torch.linspace(-10.0, 10.0, m, dtype=torch.float64)
    heights = sag(line[:, None], line[None, :]).expand(m, m)
    back = BSplineSurface(20.0, heights, (-10.0, 10.0), (-10.0, 10.0))
    return Lens.between(front or Plane(8.0), back, outline or Rectangle(20.0, 20.0), 1.5)


def maps(lens):
    return figure_jobs.surface_maps(lens)


def pixel_at(figure, axes, x, y):
    """RGB in 0..1 that the drawn figure has at data coordinates (x, y) of axes."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    column, row = axes.transData.transform((x, y))
    image = np.asarray(canvas.buffer_rgba())
    return image[image.shape[0] - 1 - int(row), int(column), :3] / 255.0


class TestIrradianceTriptych:
    @pytest.mark.parametrize("view", [LENS, BEHIND], ids=lambda view: view.seen_from)
    def test_every_place_has_its_light_whichever_way_it_is_seen(self, view):
        figure = irradiance_triptych(corner_picture(), corner_picture().T, view)
        target = figure.axes[0]
        bright = pixel_at(figure, target, 22.0, 184.5)
        others = [pixel_at(figure, target, x, y) for x, y in ((378.0, 184.5), (22.0, -84.5), (378.0, -84.5))]
        assert bright.min() > 0.9
        assert np.max(others) < 0.6
        assert all(axes.get_xlim() == (X[::-1] if view is LENS else X) for axes in figure.axes if axes.images)
        assert view.words in figure.get_supxlabel()

    def test_grey_is_what_a_screen_has_to_be_sent(self):
        """Half the irradiance is 188 of 255, and the scale's ticks are linear."""
        target = np.full((16, 16), 0.5)
        target[:8] = 1.0
        figure = irradiance_triptych(target, target, BEHIND)
        dark, bright = (pixel_at(figure, figure.axes[0], 100.0, y)[0] for y in (0.0, 150.0))
        assert bright == pytest.approx(to_srgb(1 / light_figures.HEADROOM), abs=1 / 127)
        assert dark == pytest.approx(to_srgb(0.5 / light_figures.HEADROOM), abs=1 / 127)
        scale = next(axes for axes in figure.axes if "irradiance" in axes.get_ylabel())
        ticks = [scale.transData.transform((0, tick))[1] for tick in (0.0, 0.5, 1.0)]
        assert ticks[1] - ticks[0] == pytest.approx(ticks[2] - ticks[1])

    def test_a_hot_spot_on_even_light_shows(self):
        """Four pixels among 16 384 are 1.3 times as bright; and the paper is whiter than even light."""
        even = np.ones((128, 128))
        spotted = even.copy()
        spotted[10:12, 20:22] = 1.3
        figure = irradiance_triptych(even, spotted, BEHIND)
        simulated = figure.axes[1]
        x, y = X[0] + 21 * 400 / 128, Y[1] - 11 * 300 / 128
        simulated.lines[-1].set_visible(False)  # the ring around it
        spot, ground = pixel_at(figure, simulated, x, y)[0], pixel_at(figure, simulated, 300.0, 0.0)[0]
        assert ground < 0.92 and spot > ground + 0.08

    def test_difference_is_signed_percent_of_the_mean_lit_irradiance(self):
        target = np.zeros((8, 8))
        target[:, 4:] = 2.0  # half dark: the mean lit irradiance is 2
        irradiance = target.copy()
        irradiance[0, 4], irradiance[7, 7] = 2.2, 1.8
        shown = irradiance_triptych(target, irradiance, BEHIND).axes[2].images[0]
        difference = np.asarray(shown.get_array())
        assert difference[0, 4] == pytest.approx(10.0)
        assert difference[7, 7] == pytest.approx(-10.0)
        low, high = shown.get_clim()
        assert low == -high

    def test_a_floor_under_black_is_not_lit(self):
        target = np.full((10, 10), 0.005)
        target[:, :5] = 1.0
        assert lit_mean(target) == 1.0


@pytest.mark.parametrize("seen_from", ["lens", "behind"])
def test_cuts_go_through_the_centre_and_through_the_brightest_place(seen_from):
    target = np.full((8, 8), 0.1)
    found = target.copy()
    found[1, 2] = 2.0  # row 1, column 2 of 8 over [0, 8]²: y = 6.5, x = 2.5
    found[4, :4] = 0.7  # left half of the row through the centre
    centre_x, centre_y, hot_x, hot_y = cross_section(target, found, View((0.0, 8.0), (0.0, 8.0), seen_from)).axes
    for axes, place in ((centre_x, "(y = 3.5 mm)"), (centre_y, "(x = 4.5 mm)"), (hot_x, "(y = 6.5 mm)")):
        assert place in axes.get_title(loc="left")
    x, values = centre_x.lines[0].get_data()
    assert values[x < 4] == pytest.approx(7.0) and values[x > 4] == pytest.approx(1.0)
    for axes, hot in ((hot_x, 2.5), (hot_y, 6.5)):
        place, values = axes.lines[0].get_data()
        assert place[np.argmax(values)] == hot
    assert centre_x.get_xlim() == hot_x.get_xlim() == ((8.0, 0.0) if seen_from == "lens" else (0.0, 8.0))
    assert centre_y.get_xlim() == hot_y.get_xlim() == (0.0, 8.0)


class TestSurfaceMaps:
    def test_a_tilt_is_taken_off_and_said(self):
        # the ripple of 0.04 mm PV stands on a tilt of 4 mm
        figure = maps(lens_of(lambda x, y: 0.2 * x + 0.02 * torch.sin(x) * torch.cos(y)))
        height = figure.axes[0].images[0].get_array()
        assert "best plane removed" in figure.axes[0].get_title(loc="left")
        assert 30.0 < np.nanmax(height) - np.nanmin(height) < 50.0  # µm
        level = maps(lens_of(lambda x, y: -(x * x + y * y) / 100.0))
        assert "plane" not in level.axes[0].get_title(loc="left")

    def test_slope_of_a_plane_is_its_angle(self):
        slope = maps(lens_of(lambda x, y: 0.3 * x + 0.4 * y)).axes[1].images[0].get_array()
        assert np.allclose(slope, np.degrees(np.arctan(0.5)), atol=1e-9)

    def test_curvature_of_a_parabola(self):
        # degree 2 reproduces z = x²/2R inside: 1/R (1 + x²/R²)^(-3/2) along x, 0 along y; on the axis 1/2R = 0.005/mm
        bend = maps(lens_of(lambda x, y: x * x / 200.0)).axes[2].images[0].get_array()
        x = np.linspace(-10.0, 10.0, bend.shape[1])
        assert np.allclose(bend[25:75, 25:75], (0.005 * (1 + (x / 100.0) ** 2) ** -1.5)[25:75], rtol=1e-9)

    def test_the_steepest_slope_is_that_of_the_net_and_not_of_the_samples(self):
        steep = lens_of(lambda x, y: 0.2 * torch.cos(7 * x) * torch.cos(5 * y))
        said = maps(steep).axes[1].get_title(loc="left")
        assert said == f"Slope: up to {describe(steep)['slope_max_deg']:.3g}°"

    def test_y_max_is_at_the_top(self):
        def bump(x, y):
            return torch.exp(-((x + 6.0) ** 2 + (y - 6.0) ** 2) / 4.0)

        figure = maps(lens_of(bump))
        height = figure.axes[0]
        assert tuple(height.images[0].get_extent()) == (-10.0, 10.0, -10.0, 10.0)
        highest = pixel_at(figure, height, -6.3, 6.3)
        lowest = pixel_at(figure, height, 6.1, -6.1)
        assert np.allclose(highest, to_rgb("#fde737"), atol=0.1)  # the light end of cividis
        assert lowest.sum() < 0.6 * highest.sum()

    def test_nothing_is_shown_outside_a_round_lens(self):
        height = maps(lens_of(lambda x, y: -(x * x + y * y) / 100.0, Circle(9.0))).axes[0].images[0]
        shown = np.isfinite(np.ma.filled(height.get_array(), np.nan))
        assert shown.mean() == pytest.approx(np.pi / 4, abs=0.02)  # a sample is 1 % of the width


class TestSideView:
    def test_the_section_reaches_from_face_to_face(self):
        lens = lens_of(lambda x, y: 0.1 * x + 0.0 * y, front=Sphere(12.0, torch.tensor(-0.02)))
        rays = np.zeros((5, 4, 3)) + np.array([0.0, 12.0, 20.0, 1000.0])[None, :, None] * np.array([0.0, 0.0, 1.0])
        close, whole = figure_jobs.side_view(lens, rays).axes
        rim = close.patches[0].get_xy()
        assert rim[:, 0].max() == pytest.approx(21.0)  # 20 + 0.1 · 10
        assert rim[:, 0].min() == pytest.approx(12.0 - 0.02 * 100 / (1 + np.sqrt(1 - 0.04)))  # sag at the rim
        assert len(close.lines) == len(whole.lines) == 5

    def test_a_tilted_screen_is_drawn_by_its_edges(self):
        """40 mm along x, turned by 60 degrees about y: 20 mm remain, over 34.6 mm of z."""
        lens, rays = lens_of(lambda x, y: 0.0 * x * y), np.zeros((1, 4, 3))
        tilted = Screen(500.0, (80.0, 120.0), (-30.0, 30.0), 8, (0.0, 60.0))
        figure = figure_jobs.side_view(lens, rays, [tilted])
        [drawn] = [patch for patch in figure.axes[1].patches if patch.get_gid() == "screen"]
        z, x = drawn.get_xy().T
        assert (z.min(), z.max()) == pytest.approx((500 - 10 * np.sqrt(3), 500 + 10 * np.sqrt(3)))
        assert (x.min(), x.max()) == pytest.approx((90.0, 110.0))
        assert "tilted by 60 degrees about y" in figure.get_supxlabel()
        level = figure_jobs.side_view(lens, rays, [replace(tilted, tilt=None)])
        assert not any(patch.get_gid() == "screen" for patch in level.axes[1].patches)


@pytest.mark.parametrize("view", [LENS, BEHIND], ids=lambda view: view.seen_from)
def test_transport_map_draws_each_line_both_ways(view):
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0), indexing="ij"), axis=-1)
    figure = figure_jobs.transport_map(grid, 10.0 * grid + 100.0, view)
    source, image = figure.axes
    assert len(source.lines) == len(image.lines) == 10
    assert image.dataLim.x1 == 140.0
    assert [axes.xaxis_inverted() for axes in figure.axes] == [view is LENS] * 2
    assert view.words in figure.get_supxlabel()


def test_convergence_has_its_points_stages_and_floor():
    history = [CurvePoint(2.0 + i, 0.5 * 0.8**i) for i in range(10)]
    stages = [StageRecord("transport", 1.5), StageRecord("stage 2", 10.0, 0.07)]
    axes = figure_jobs.convergence(history, stages, 0.01).axes[0]
    curve, *lines = (line.get_xydata() for line in axes.lines)
    assert curve[:, 1] == pytest.approx([point.rrmsd for point in history])
    assert [line[0, 0] for line in lines if line[0, 0] == line[1, 0]] == pytest.approx([1.5, 11.5])  # stages' ends
    assert [line[0, 1] for line in lines if line[0, 1] == line[1, 1]] == pytest.approx([0.01])
    assert png(figure_jobs.convergence(history[:1], [], 0.0)).startswith(b"\x89PNG")


def test_a_picture_of_noise_stays_light():
    target = np.random.default_rng(0).random((512, 512))
    picture = png(irradiance_triptych(target, target[::-1], LENS))
    assert len(picture) <= drawing.MAX_PNG_BYTES
    assert Image.open(io.BytesIO(picture)).width > 700


WAVELENGTHS = (450.0, 530.0, 630.0)  # nm: blue, green, red


@pytest.mark.parametrize("wavelengths", (WAVELENGTHS, (400.0, 900.0)))
def test_each_line_has_its_colour_and_where_all_are_alike_the_light_is_grey(wavelengths):
    assert [int(np.argmax(primary(wavelength))) for wavelength in WAVELENGTHS] == [2, 1, 0]
    picture = np.random.default_rng(0).random((6, 8))
    shares = np.full(len(wavelengths), 1 / len(wavelengths))
    colours = balanced([picture] * len(wavelengths), wavelengths, shares)
    assert np.abs(colours - picture[..., None]).max() < 1e-12


@pytest.mark.parametrize("count", (2, 7))
def test_the_figure_has_a_picture_of_all_lines_and_one_of_each(count):
    target = np.ones((10, 20))
    lines = [SpectralLine(450.0 + 30 * k, 1 / count, target * (1 + 0.1 * k)) for k in range(count)]
    figure = spectral_lines(target, 1.02 * target, lines, LENS)
    shown = [axes.get_title(loc="left") for axes in figure.axes if axes.get_visible()]
    assert len(shown) == count + 1 and shown[0] == "All lines" and "450 nm" in shown[1]


def test_the_error_by_cell_is_drawn_with_its_pixel_marked():
    """Pixels of 400 / 20 by 300 / 15 mm; the real source counts on half pixels alone."""
    found = [CellError(2.0, 0.02, 1e-4), CellError(1.0, 0.03, 1e-4), CellError(0.5, 0.2, 1e-3, blurred=0.05)]
    figure = light_figures.cell_error(found, (15, 20), BEHIND)
    [axes] = figure.axes
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    lines = {line.get_gid() or line.get_label(): line.get_xydata() for line in axes.lines}
    assert lines["pixel"] == pytest.approx(np.array([[20.0, 0.03]]))
    assert lines["with the size of the real source"] == pytest.approx(np.array([[10.0, 0.05]]))
    curve = next(line.get_xydata() for line in axes.lines if len(line.get_xydata()) == 3)
    assert curve == pytest.approx(np.array([[40.0, 0.02], [20.0, 0.03], [10.0, 0.2]]))
    assert png(figure)[:4] == b"\x89PNG"
