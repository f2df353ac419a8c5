"""What a figure shows is what it was given: right way up, in mm, with the stated numbers."""

import ast
import io
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from PIL import Image

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.surfaces import Plane, Sphere
from bstcad.verify import figures

X, Y = (0.0, 400.0), (-100.0, 200.0)


@pytest.fixture(autouse=True)
def coarse_maps(monkeypatch):
    """Maps of 101 x 101 samples: quick, and their laws hold at any number."""
    monkeypatch.setattr(figures, "MAP_POINTS", 101)


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
    return Lens(front or Plane(8.0), back, outline or Rectangle(20.0, 20.0), 1.5)


def pixel_at(figure, axes, x, y):
    """RGB in 0..1 that the drawn figure has at data coordinates (x, y) of axes."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    column, row = axes.transData.transform((x, y))
    image = np.asarray(canvas.buffer_rgba())
    return image[image.shape[0] - 1 - int(row), int(column), :3] / 255.0


class TestIrradianceTriptych:
    def test_row_0_is_y_max_and_column_0_is_x_min(self):
        figure = figures.irradiance_triptych(corner_picture(), corner_picture().T, X, Y)
        target = figure.axes[0]
        bright = pixel_at(figure, target, 10.0, 190.0)
        others = [pixel_at(figure, target, x, y) for x, y in ((390.0, 190.0), (10.0, -90.0), (390.0, -90.0))]
        assert bright.min() > 0.95
        assert np.max(others) < 0.3
        assert tuple(target.images[0].get_extent()) == (*X, *Y)

    def test_three_pictures_in_mm_and_two_scales(self):
        figure = figures.irradiance_triptych(corner_picture(), corner_picture(), X, Y)
        pictures = [axes for axes in figure.axes if axes.images]
        assert len(pictures) == 3
        assert len(figure.axes) == 5
        assert {axes.get_xlabel() for axes in pictures} == {"x (mm)"}

    def test_target_and_simulated_share_one_scale(self):
        figure = figures.irradiance_triptych(corner_picture(), 1.5 * corner_picture(), X, Y)
        assert figure.axes[0].images[0].get_clim() == figure.axes[1].images[0].get_clim()

    def test_difference_is_signed_percent_of_the_mean_lit_irradiance(self):
        target = np.zeros((8, 8))
        target[:, 4:] = 2.0  # half dark: the mean lit irradiance is 2
        irradiance = target.copy()
        irradiance[0, 4], irradiance[7, 7] = 2.2, 1.8
        shown = figures.irradiance_triptych(target, irradiance, X, Y).axes[2].images[0]
        difference = np.asarray(shown.get_array())
        assert difference[0, 4] == pytest.approx(10.0)
        assert difference[7, 7] == pytest.approx(-10.0)
        low, high = shown.get_clim()
        assert low == -high

    def test_title_states_the_rrmsd_of_the_arrays(self):
        target = 1.0 + np.arange(64.0).reshape(8, 8)
        assert figures.rrmsd(target, 1.03 * target) == pytest.approx(0.03)
        figure = figures.irradiance_triptych(target, 1.03 * target, X, Y)
        assert "0.03)" in figure.axes[2].get_title(loc="left")

    def test_a_floor_under_black_is_not_lit(self):
        target = np.full((10, 10), 0.005)
        target[:, :5] = 1.0
        assert figures.lit_mean(target) == 1.0


class TestCrossSection:
    def test_brightest_row_and_column_at_their_place(self):
        target = np.full((8, 8), 0.1)
        target[1, :] = 0.7  # row 1 of 8 over y in [0, 8]: its centre is y = 6.5
        target[:, 2] = 0.9  # column 2 of 8 over x in [0, 8]: x = 2.5
        target[7, 2] = 2.0  # at y = 0.5
        along_x, along_y = figures.cross_section(target, target, (0.0, 8.0), (0.0, 8.0)).axes[:2]
        assert "y = 6.5 mm" in along_x.get_title(loc="left")
        assert "x = 2.5 mm" in along_y.get_title(loc="left")
        y, values = along_y.lines[0].get_data()
        assert y[np.argmax(values)] == pytest.approx(0.5)
        assert along_x.lines[0].get_xdata() == pytest.approx(np.arange(8) + 0.5)


class TestSurfaceMaps:
    def test_a_tilt_is_taken_off_and_said(self):
        # the ripple of 0.04 mm PV stands on a tilt of 4 mm
        figure = figures.surface_maps(lens_of(lambda x, y: 0.2 * x + 0.02 * torch.sin(x) * torch.cos(y)))
        height = figure.axes[0].images[0].get_array()
        assert "best plane removed" in figure.axes[0].get_title(loc="left")
        assert 30.0 < np.nanmax(height) - np.nanmin(height) < 50.0  # µm

    def test_without_tilt_nothing_is_taken_off(self):
        figure = figures.surface_maps(lens_of(lambda x, y: -(x * x + y * y) / 100.0))
        assert "plane" not in figure.axes[0].get_title(loc="left")

    def test_slope_of_a_plane_is_its_angle(self):
        slope = figures.surface_maps(lens_of(lambda x, y: 0.3 * x + 0.4 * y)).axes[1].images[0].get_array()
        assert np.allclose(slope, np.degrees(np.arctan(0.5)), atol=1e-9)

    def test_curvature_of_a_parabola(self):
        # degree 2 reproduces z = x²/2R inside: curvature 1/R along x, 0 along y; mean 1/2R = 5 per metre
        bend = figures.surface_maps(lens_of(lambda x, y: x * x / 200.0)).axes[2].images[0].get_array()
        assert np.allclose(bend[25:75, 25:75], 5.0, rtol=1e-9)

    def test_y_max_is_at_the_top(self):
        def bump(x, y):
            return torch.exp(-((x + 6.0) ** 2 + (y - 6.0) ** 2) / 4.0)

        figure = figures.surface_maps(lens_of(bump))
        height = figure.axes[0]
        assert tuple(height.images[0].get_extent()) == (-10.0, 10.0, -10.0, 10.0)
        highest = pixel_at(figure, height, -6.3, 6.3)
        lowest = pixel_at(figure, height, 6.1, -6.1)
        assert np.allclose(highest, to_rgb("#fde737"), atol=0.1)  # the light end of cividis
        assert lowest.sum() < 0.6 * highest.sum()

    def test_nothing_is_shown_outside_a_round_lens(self):
        height = figures.surface_maps(lens_of(lambda x, y: -(x * x + y * y) / 100.0, Circle(9.0))).axes[0].images[0]
        shown = np.isfinite(np.ma.filled(height.get_array(), np.nan))
        assert shown.mean() == pytest.approx(np.pi / 4, abs=0.02)  # a sample is 1 % of the width

    def test_single_precision_and_flat(self):
        flat = lens_of(lambda x, y: 0.0 * x * y)
        figure = figures.surface_maps(Lens(flat.front, flat.back.to(torch.float32), flat.outline, flat.index))
        assert figures.png(figure).startswith(b"\x89PNG")


class TestSideView:
    def test_the_section_reaches_from_face_to_face(self):
        lens = lens_of(lambda x, y: 0.1 * x + 0.0 * y, front=Sphere(12.0, torch.tensor(-0.02)))
        rays = np.zeros((5, 4, 3)) + np.array([0.0, 12.0, 20.0, 1000.0])[None, :, None] * np.array([0.0, 0.0, 1.0])
        close, whole = figures.side_view(lens, rays).axes
        rim = close.patches[0].get_xy()
        assert rim[:, 0].max() == pytest.approx(21.0)  # 20 + 0.1 · 10
        assert rim[:, 0].min() == pytest.approx(12.0 - 0.02 * 100 / (1 + np.sqrt(1 - 0.04)))  # sag at the rim
        assert len(close.lines) == len(whole.lines) == 5


def test_transport_map_draws_each_line_both_ways():
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0), indexing="ij"), axis=-1)
    source, image = figures.transport_map(grid, 10.0 * grid + 100.0).axes
    assert len(source.lines) == len(image.lines) == 10
    assert image.dataLim.x1 == 140.0


def test_ledger_bars_are_percents():
    bars = figures.flux_ledger({"on target": 0.97, "off target": 0.01, "missed the lens": 0.02}).axes[0].patches
    assert [bar.get_width() for bar in bars] == pytest.approx([97.0, 1.0, 2.0])


class TestConvergence:
    HISTORY = [{"seconds": 2.0 + i, "rrmsd": 0.5 * 0.8**i} for i in range(10)]
    STAGES = [{"name": "transport", "seconds": 1.5, "rrmsd": None}, {"name": "stage 2", "seconds": 10.0, "rrmsd": 0.07}]

    def test_points_stages_and_floor(self):
        axes = figures.convergence(self.HISTORY, self.STAGES, 0.01).axes[0]
        curve, *lines = (line.get_xydata() for line in axes.lines)
        assert curve[:, 1] == pytest.approx([point["rrmsd"] for point in self.HISTORY])
        upright = [line[0, 0] for line in lines if line[0, 0] == line[1, 0]]
        level = [line[0, 1] for line in lines if line[0, 1] == line[1, 1]]
        assert upright == pytest.approx([1.5, 11.5])  # where the stages end
        assert level == pytest.approx([0.01])
        assert axes.get_yscale() == "log"

    def test_one_point_without_stages_or_noise(self):
        assert figures.png(figures.convergence(self.HISTORY[:1], [], 0.0)).startswith(b"\x89PNG")


def test_a_picture_of_noise_stays_light():
    target = np.random.default_rng(0).random((512, 512))
    picture = figures.png(figures.irradiance_triptych(target, target[::-1], X, Y))
    assert len(picture) <= figures.HEAVIEST
    assert Image.open(io.BytesIO(picture)).width > 700


def test_a_design_without_history_has_no_convergence():
    report = {"flux": {"on target": 1.0}, "history": [], "stages": [], "rrmsd_noise": 0.0}
    pictures = figures.draw_numbers(report)
    assert set(pictures) == {"flux"}
    assert all(picture.startswith(b"\x89PNG") for picture in pictures.values())


def imported(tree):
    """Full names of what the import statements among `tree`'s nodes bring in."""
    for node in tree:
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{name.name}" for name in node.names)


@pytest.mark.parametrize("file", ["figures.py", "rendering.py", "report.py"])
def test_heavy_libraries_load_where_used_and_pyplot_never(file):
    source = ast.parse(Path(figures.__file__).with_name(file).read_text(encoding="utf-8"))
    at_start = {name.split(".")[0] for name in imported(source.body)}
    assert not at_start & {"matplotlib", "pyvista", "vtk", "vtkmodules", "jinja2", "rich", "PIL"}
    assert not any("pyplot" in name for name in imported(ast.walk(source)))
