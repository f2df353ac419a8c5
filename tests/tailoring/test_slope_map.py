"""Transport in slope coordinates: a picture made by a known lens gives that lens back."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen, efficiency
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace.reach import wanted_slopes
from bstcad.scene.errors import SceneError
from bstcad.tailoring.slope_fit import Fit
from bstcad.tailoring.slope_map import (
    bending,
    centroid,
    face_grid,
    fit_to_map,
    lit_corners,
    lit_window,
    pixel_corners,
    rays_at,
    slope_map,
    square_grid,
)
from bstcad.transport.mapping import Solver
from tests.lenses import SQUARE, N, net
from tests.tracing import simulated

CASES = {
    "off axis": (CollimatedSource(Rectangle(16.0, 16.0)), Plane(8.0), Screen(1000.0, (60.0, 300.0), (40.0, 280.0), 96)),
    "point and sphere": (
        PointSource(profile="gaussian", half_angle_1e2=30.0), Sphere(15.0, 0.02),
        Screen(1000.0, (-600.0, 600.0), (-600.0, 600.0), 96),
    ),
}  # fmt: skip


def known_lens(name):
    """A back face whose ray mapping does not fold."""
    sags = {
        "off axis": lambda x, y: (
            0.33 * x + 0.3 * y + 0.005 * (x**2 + y**2) + 0.02 * torch.sin(0.5 * x) * torch.cos(0.4 * y)
        ),
        "point and sphere": lambda x, y: 0.05 * torch.sin(0.4 * x) * torch.cos(0.3 * y),
    }
    return Lens.between(CASES[name][1], net(sags[name], m=33).from_vertex().moved(20.0), SQUARE, N)


def slope_error(name, cells):
    """RMS slope error of the lens found from the picture that the known lens makes.

    Over the inner 80 %: the light of the rim goes some way into the dark around the picture, which has to be lifted.
    """
    source, _, screen = CASES[name]
    screen, true = replace(screen, pixels=(cells, 3 * cells // 4)), known_lens(name)
    made = simulated(source, true, screen, 16 * cells, 0)
    assert efficiency(made.flux) > 0.999
    lens = true.with_back(replace(true.back, heights=torch.zeros_like(true.back.heights)))
    slopes, goal = None, Goal("target", screen, made.box.numpy())
    for _ in range(6):
        window = lit_window(source, lens)
        slopes = slope_map(lens, square_grid(source, lens, window, cells), goal, slopes, Solver(40))
        grid = face_grid(source, lens, window, 66)
        lens = fit_to_map(lens, slopes, grid, Fit())
    x, y, _ = grid.at_face.position
    inner = torch.maximum(x.abs(), y.abs()) < 0.4 * grid.window.width
    x, y = x[inner], y[inner]
    found, expected = (torch.stack(back.sag_and_slope(x, y)[1:]) for back in (lens.back, true.back))
    return float(((found - expected) ** 2).mean().sqrt())


@pytest.mark.parametrize("name", CASES)
def test_a_lens_comes_back_from_its_own_picture(name):
    """Off axis and behind a sphere, where no map of points to points is a gradient; the finer the better."""
    _, _, screen = CASES[name]
    cells = 48
    pixel = (screen.x[1] - screen.x[0]) / cells / 980 / 0.488  # change of slope that moves a ray by a pixel
    coarse, fine = slope_error(name, cells), slope_error(name, 2 * cells)
    assert coarse < 0.1 * pixel and fine < coarse


@pytest.mark.parametrize("name", CASES)
def test_the_grid_is_met_and_carries_the_flux(name):
    source, front, _ = CASES[name]
    lens = known_lens(name)
    window = lit_window(source, lens)
    grid = face_grid(source, lens, window, 200)
    x, y, _ = grid.at_face.position
    cell = window.width / 200
    assert float((x[1:, 0] - x[:-1, 0] - cell).abs().max()) < 1e-7  # mm
    assert float((grid.at_face.above(0.0) - lens.back.sag_and_slope(x, y)[0]).abs().max()) < 1e-8
    through = simulated(source, lens, Screen(21.0, (-1e4, 1e4), (-1e4, 1e4), 8), 500, 0).flux
    flux = float(grid.density.sum()) * window.area / 200**2
    assert flux == pytest.approx(through["on target"] + through["off target"], rel=1.5e-2)  # rim cells


def test_a_back_that_no_ray_is_found_to_is_one_sentence():
    """A point 0.05 mm from the front and far beside it: in 20 mm of glass its light gets no further than 18 mm."""
    lens = Lens.between(Plane(0.05), net(m=33, half=8.0), Rectangle(16.0, 16.0), 1.49)
    with pytest.raises(SceneError, match="^source: "):
        lit_window(PointSource(position=(100.0, 0.0, 0.0)), lens)


def test_thecorners_of_what_is_lit():
    """x first and y upwards, though a picture has its rows first and y max on top."""
    picture = np.zeros((4, 4))
    picture[0, 2] = 1.0
    assert np.argwhere(lit_corners(picture)).tolist() == [[2, 3], [2, 4], [3, 3], [3, 4]]


@pytest.mark.parametrize("name", CASES)
def test_the_bending_is_that_of_the_slopes_needed(name):
    """Second derivatives of g fit those of the slopes at the pairs of points, and its end spans are dark."""
    source, _, screen = CASES[name]
    lens = known_lens(name)
    grid = square_grid(source, lens, lit_window(source, lens), 16)
    corners, width = pixel_corners(screen), grid.window.width
    (left, right), (low, high) = screen.x, screen.y
    middle = (left + right) / 2, (low + high) / 2
    points = tuple((c - m) / (right - left) * width * 0.98 for c, m in zip(corners, middle, strict=True))
    lit = np.ones(corners[0].shape, bool)
    g = bending(grid, lens, screen.receiver, corners, points=points, lit=lit)
    span = (g.x[1] - g.x[0]) / (g.heights.shape[0] - 1)
    assert g.x[1] - 2 * span == pytest.approx(width / 2) and g.x[0] == -g.x[1] and g.y == g.x
    some = slice(4, -4, 8)
    x, y = (p[some, some].ravel() for p in points)
    aim, step, law = torch.from_numpy(np.stack([c[some, some].ravel() for c in corners])), 1e-3, lens.last_tailored.law

    def needed(dx, dy):
        return wanted_slopes(rays_at(grid, (x + dx, y + dy)), aim, screen.receiver, law)

    def found(dx, dy):
        return g.relative_sag_and_slope(*(torch.from_numpy(p) for p in (x + dx, y + dy)))[1:]

    def bent(slopes):
        ends = [(slopes(i, j), slopes(-i, -j)) for i, j in ((step, 0.0), (0.0, step))]
        (xx, yx), (xy, yy) = ([(a - b) / (2 * step) for a, b in zip(*pair, strict=True)] for pair in ends)
        return torch.stack([xx, (xy + yx) / 2, yy])

    error = (bent(found) - bent(needed)).norm() / bent(needed).norm()
    assert float(error) < 0.15  # the slopes for all pairs are not the gradient of one surface


def test_the_centroid_of_one_bright_pixel_is_its_middle():
    picture = np.zeros((4, 8))
    picture[1, 6] = 3.0
    screen = Screen(1000.0, (-40.0, 40.0), (-10.0, 30.0), (8, 4))
    assert centroid(picture, screen) == pytest.approx((25.0, 15.0), rel=1e-12)
