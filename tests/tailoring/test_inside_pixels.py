"""Light that is right inside the pixels: what a merit on pixels alone cannot see, judged on cells it never saw.

Nets with many control points per pixel can ripple inside the pixels.  With the merit on pixels alone, which the tests
make once, the light on half pixels deviates several times as much as on pixels.
"""

from __future__ import annotations

import math
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from bstcad.optics.numerics import kernel_choice
from bstcad.optics.receivers.irradiance import CellTarget, picture_error
from bstcad.optics.trace.measure import Effort, measure_goals
from bstcad.scene.scene import Scene, load
from bstcad.tailoring import folds, stage2
from tests import suite
from tests.efforts import designed_quickly

EVEN = """
name = "even"
source = { kind = "point", position = [0.0, 0.0, 0.0], profile = "lambertian", wavelength = 550.0 }
[lens]
material = "PMMA"
outline = { shape = "circle", radius = 15.0 }
front = { kind = "plane", z = 10.0 }
back = { kind = "bspline", z = 18.0, control_points = 65 }
[tailoring]
quality = "draft"
rays = 192
transport_grid = 64
[target]
"""
RECEIVERS = {
    "wall": "z = 1000.0\nx = [-500.0, 500.0]\ny = [-400.0, 400.0]\npixels = 20\n"
    'profile = { shape = "rectangle", width = 700.0, height = 500.0, edge = 100.0 }',
    "directions": 'kind = "intensity"\nangles = "A"\nx = [-25.0, 35.0]\ny = [-25.0, 15.0]\npixels = 60\n'
    'profile = { shape = "rectangle", width = 40.0, height = 20.0, edge = 4.0 }',
}
LETTERS = {
    "lens.back.control_points": 129,
    "target.pixels": 48,
    "tailoring.rays": 384,
    "tailoring.stage2_iterations": 60,
    "tailoring.transport_grid": 128,
}
EFFORT = Effort(rays=512, accuracy=0.0, witness=False)


def even(receiver):
    """The scene of an even light with these lines of its target."""
    return Scene.model_validate(tomllib.loads(EVEN + receiver))


def lit(scene):
    """The light of a scene's design, with its errors by cell."""
    made = designed_quickly(scene)
    [light] = measure_goals(made.lens.plain(), scene.channels(), made.goals, EFFORT, ghost=None, sampler=None)
    return made.goals[0], light, {each.cell: each.rrmsd for each in light.by_cell}


@pytest.mark.parametrize("receiver", suite.in_turns(RECEIVERS, 2))
def test_an_even_rectangle_is_even_inside_its_pixels(receiver):
    _, _, by_cell = lit(even(RECEIVERS[receiver]))
    assert by_cell[0.5] < 0.06  # most of it at the soft edges; 0.26 by pixels alone
    assert by_cell[0.25] < 0.12  # 0.44 by pixels alone


@suite.in_turn(0, 3)
def test_letters_are_right_inside_their_pixels_and_would_not_be_by_pixels_alone(monkeypatch):
    scene = load("templates/thu.toml", LETTERS)
    _, _, by_cell = lit(scene)
    monkeypatch.setattr(stage2, "finest_cells", lambda task: 1)
    _, _, by_pixels = lit(scene)
    assert by_cell[1.0] < 1.5 * by_pixels[1.0]
    assert by_cell[0.5] < 0.6 * by_pixels[0.5]
    assert by_pixels[0.5] > 3 * by_pixels[1.0]  # what a figure on pixels does not show


PICTURES = {
    "text": 'text = "R"',
    "sample": 'sample = "camera"',
    "profile": 'profile = { shape = "super_gaussian", radius_1e2 = 300.0, order = 8.0 }',
    "uniform": "uniform = true",
}


@pytest.mark.parametrize("picture", PICTURES)
@pytest.mark.parametrize("rotate", [0, 90])
def test_the_cells_of_a_pixel_have_its_light(picture, rotate):
    """A picture means the same on pixels and on cells, and no cell is negative."""
    where = f"z = 1000.0\nx = [-500.0, 500.0]\ny = [-400.0, 400.0]\npixels = 24\nrotate = {rotate}\n"
    [goal] = even(where + PICTURES[picture]).goals
    rows, columns = goal.picture.shape
    for cells in (2, 3, 4):
        fine = goal.on_cells(cells)
        sums = fine.picture.reshape(rows, cells, columns, cells).sum((1, 3))
        assert np.abs(sums - goal.picture).max() < 1e-6 * goal.picture.max()  # quadrature of the super-Gaussian
        assert fine.picture.min() >= 0
        assert fine.screen.shape == fine.picture.shape


@pytest.mark.parametrize("shares", [(1.0,), (0.8, 0.2), (0.7, 0.2, 0.1)])
def test_the_error_on_all_scales_and_its_gradient(shares, monkeypatch):
    """The kernel and the plain form agree with each other and with difference quotients."""
    torch.manual_seed(0)
    cells = 1 << (len(shares) - 1)
    picture = torch.rand(6 * cells, 5 * cells, dtype=torch.float64)
    picture[: 2 * cells] = 0
    target = CellTarget.of(picture / picture.sum(), shares)
    image = (target.picture + 0.01 * torch.rand_like(picture) / picture.numel()).requires_grad_()
    flux = torch.tensor(1.3, dtype=torch.float64, requires_grad=True)
    found = []
    for enabled in (True, False):
        monkeypatch.setattr(kernel_choice, "ENABLED", enabled)
        error, rrmsd = picture_error(image, flux, target)
        found.append((error.detach(), rrmsd, *torch.autograd.grad(error, (image, flux))))
        assert torch.autograd.gradcheck(lambda i, f: picture_error(i, f, target)[0], (image, flux))
    for fast, plain in zip(*found, strict=True):
        torch.testing.assert_close(fast, plain, rtol=1e-9, atol=1e-15)


def folded(seed=1):
    """Corners of 9 x 7 tubes on a jittered grid, some of them overturned, and the tubes' flux."""
    torch.manual_seed(seed)
    grid = torch.stack(torch.meshgrid(torch.arange(10.0), torch.arange(8.0), indexing="ij")).double()
    flux = torch.rand(9, 7, dtype=torch.float64)
    flux[3] = 0
    return (grid + 1.2 * torch.rand_like(grid)).requires_grad_(), flux


def test_the_penalty_on_folds_and_its_gradient(monkeypatch):
    corner, flux = folded()
    found = []
    for enabled in (True, False):
        monkeypatch.setattr(kernel_choice, "ENABLED", enabled)
        value = folds.fold_penalty(corner, flux, float(flux.sum()), (0.0, 0.0, 1.0, -1.0), peak=1 / 63)
        found.append((value.detach(), *torch.autograd.grad(value, corner)))
        assert torch.autograd.gradcheck(
            lambda c: folds.fold_penalty(c, flux, 35.0, (0.0, 0.0, 1.0, -1.0), 1 / 63), corner
        )
    assert found[0][0] > 0
    for fast, plain in zip(*found, strict=True):
        torch.testing.assert_close(fast, plain, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("mirrored", [False, True])
def test_light_that_is_not_folded_has_no_penalty(mirrored):
    """Neither has its mirror image, as behind a real image of the source."""
    x, y = torch.meshgrid(torch.arange(10.0), torch.arange(8.0), indexing="ij")
    corner = torch.stack([-x if mirrored else x, y]).double()
    flux = torch.ones(9, 7, dtype=torch.float64)
    assert float(folds.fold_penalty(corner, flux, 63.0, (0.0, 0.0, 2.0, -2.0), peak=1 / 252)) == 0


def goal_of(name):
    """The goal of a picture of PICTURES on the wall of RECEIVERS."""
    return even(RECEIVERS["wall"].rpartition("\n")[0] + "\n" + PICTURES[name]).goals[0]


def test_only_convex_targets_without_detail_are_held_from_folding():
    assert {name for name in PICTURES if folds.needs_no_folds(goal_of(name))} == {"profile", "uniform"}


def test_light_may_fold_at_the_border():
    """A square of light with one overturned column of tubes, in the middle of the target or at its border."""
    goal = goal_of("uniform")
    (left, right), (below, above) = goal.screen.x, goal.screen.y
    y = torch.linspace(below, above, 41, dtype=torch.float64)
    found = {}
    for place, column in (("middle", 20), ("border", 1)):
        x = torch.linspace(left, right, 41, dtype=torch.float64)
        x[column] = 2 * x[column + 1] - x[column]
        corners = SimpleNamespace(position=torch.stack(torch.meshgrid(x, y, indexing="ij")))
        sheet = SimpleNamespace(flux=torch.full((40, 40), 1 / 1600, dtype=torch.float64))
        penalty = folds.Folds.of(goal, [sheet], [corners], 1.0)
        assert penalty is not None and math.isclose(penalty.peak, 1 / (20 * 16))
        found[place] = float(penalty([SimpleNamespace(weight=1.0)], [corners]))
    assert found["middle"] > 0 == found["border"]
