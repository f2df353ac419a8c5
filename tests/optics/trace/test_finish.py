"""Layers of a face: slopes of smoothed terraces, and pictures against rays through the stepped surface itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.finish import Finish, finished_pictures, slope_ratio
from tests.lenses import net

N, HALF, BACK, WALL = 1.49, 12.0, 5.0, 85.0  # index; half side of the plate, vertex of its back, z of the wall (mm)
PIXELS, STEP = 40, 0.015  # pixels per side of the picture; spacing of the stepped surface's points (mm)
SCREEN = Screen(WALL, (-20.0, 20.0), (-20.0, 20.0), PIXELS)


def sag(x, y):
    """Height of a plate (mm) that spreads light, with waves that make bright and dark patches."""
    cos = np.cos if isinstance(x, np.ndarray) else torch.cos
    return 0.006 * (x**2 + y**2) + 0.02 * cos(2 * np.pi * x / 8) * cos(2 * np.pi * y / 7)


@pytest.fixture(scope="module")
def plate():
    surface = net(sag, BACK, 129, 1.05 * HALF)
    return Lens.between(Plane(0.0), surface, Rectangle(2 * HALF, 2 * HALF), N), Channel(
        CollimatedSource(Rectangle(2 * HALF, 2 * HALF), z=0.0, wavelength=587.6), N
    )


def predicted(plate, finish):
    lens, channel = plate
    [[picture]] = finished_pictures(lens, [channel], [SCREEN], finish, tubes=120)
    return picture.numpy()


def traced(layer, length):
    """The picture by Snell's law at each point of the stepped and smoothed surface; layer None: of the design."""
    margin = 4 * length + 10 * STEP
    line = np.arange(-HALF - margin, HALF + margin, STEP)
    x, y = np.meshgrid(line, line, indexing="ij")
    z = sag(x, y)
    if layer is not None:
        z = gaussian_filter(layer * np.round(z / layer), length / STEP)
    normal = np.stack([-np.gradient(z, STEP, axis=0), -np.gradient(z, STEP, axis=1), np.ones_like(z)])
    normal /= np.sqrt((normal**2).sum(0))
    cos_out2 = 1 - N**2 * (1 - normal[2] ** 2)
    goes = (cos_out2 > 0) & (np.abs(x) < HALF) & (np.abs(y) < HALF)
    direction = (np.sqrt(np.maximum(cos_out2, 0)) - N * normal[2]) * normal
    direction[2] += N
    goes &= direction[2] > 0.05
    far = (WALL - BACK - z[goes]) / direction[2][goes]
    at = [p[goes] + far * d[goes] for p, d in zip((x, y), direction[:2], strict=True)]
    counts = np.histogram2d(-at[1], at[0], PIXELS, [[-20, 20], [-20, 20]])[0]
    return counts * STEP**2 / (2 * HALF) ** 2


def contrast(picture, design):
    """Regression of a picture on the design's inside the lit part: 1 for the design, 0 for even light."""
    lit = design > 0.3 * design.mean()
    wanted = design[lit] - design[lit].mean()
    return float(((picture[lit] - picture[lit].mean()) * wanted).sum() / (wanted**2).sum())


@pytest.fixture(scope="module")
def design():
    return traced(None, 0.0)


# Widths of terraces from 0.3 mm at the rim.  An unpolished print, one polished by hand, and one dipped in resin.
@pytest.mark.parametrize(("length", "low", "high"), [(0.04, 0.1, 0.35), (0.15, 0.7, 0.9), (0.5, 0.7, 0.9)])
def test_the_picture_of_steps_is_that_of_rays_through_the_stepped_surface(plate, design, length, low, high):
    """50 µm steps: contrast within 10 % (found: 3 %), the light on the screen, and the picture to a fifth."""
    made, truth = predicted(plate, Finish(layer_height=0.05, smoothing_length=length)), traced(0.05, length)
    assert contrast(made, design) == pytest.approx(contrast(truth, design), rel=0.1)
    assert low < contrast(truth, design) < high
    assert made.sum() == pytest.approx(truth.sum(), abs=0.02)
    assert np.sum((made - truth) ** 2) < 0.2**2 * np.sum(truth**2)  # the flat top of the middle lies where it lies


def test_a_finish_without_layers_and_marks_has_the_picture_of_the_design(plate, design):
    made = predicted(plate, Finish(smoothing_length=0.01))
    assert np.sqrt(np.sum((made - design) ** 2) / np.sum(design**2)) < 0.02  # points per pixel and tubes


@pytest.mark.parametrize("width", [0.3, 1.0, 2.4, 2.6, 8.0, 30.0])
def test_slopes_on_a_terrace_have_the_mean_of_the_design_and_are_those_of_a_smoothed_stair(width):
    phases = (np.arange(512) + 0.5) / 512
    found = np.array([float(slope_ratio(torch.tensor([width], dtype=torch.float64), p)) for p in phases])
    assert found.mean() == pytest.approx(1.0, abs=1e-5)
    u = np.arange(-40 / width, 40 / width + 1, 1e-3 / width)  # a stair of edges at the whole numbers
    edges = np.arange(math.floor(u[0]), math.ceil(u[-1]) + 1)
    stair = sum((1 + torch.erf(torch.tensor((u - k) * width / math.sqrt(2))).numpy()) / 2 for k in edges)
    slope = np.interp(phases, u, np.gradient(stair, u))
    assert found == pytest.approx(slope, abs=2e-3 * max(width, 1))


def test_tool_marks_scatter_light_along_x_by_their_slope(plate):
    """A plane face with sine marks: the deflection has the RMS (n - 1) 2π RMS / period along x, and none along y."""
    lens, channel = plate
    flat = lens.with_back(net(lambda x, y: 1e-9 * x**2, BACK, 33, 1.05 * HALF))
    screen = Screen(WALL, (-20.0, 20.0), (-20.0, 20.0), 400)
    before, after = (
        finished_pictures(flat, [channel], [screen], finish, tubes=60)[0][0].numpy()
        for finish in (Finish(), Finish(ripple=2e-3, period=1.0))
    )
    x = np.linspace(-20, 20, 401)[:-1] + 0.05

    def variance(picture, axis):
        return float((picture.sum(axis) * x**2).sum() / picture.sum())

    deflection = (N - 1) * 2 * np.pi * 2e-3 / 1.0 * (WALL - BACK)
    assert math.sqrt(variance(after, 0) - variance(before, 0)) == pytest.approx(deflection, rel=0.01)
    assert variance(after, 1) == pytest.approx(variance(before, 1), abs=1e-6)


def test_smoothing_attenuates_waves_of_a_face_as_a_gaussian_does():
    """A wave of period p keeps exp(-2 (π ℓ / p)²) of its height."""
    waves = net(lambda x, y: torch.cos(2 * math.pi * x / 5) + 0 * y, BACK, 201, 10.0)
    smooth = Finish(smoothing_length=0.8).smoothed(waves)
    assert float(smooth.heights[100, 100] / waves.heights[100, 100]) == pytest.approx(
        math.exp(-2 * (math.pi * 0.8 / 5) ** 2), rel=1e-3
    )
    inclined = net(lambda x, y: 0.1 * x + 0.2 * y, BACK, 41, 10.0)
    assert torch.allclose(Finish(smoothing_length=0.8).smoothed(inclined).heights, inclined.heights, atol=1e-12)
