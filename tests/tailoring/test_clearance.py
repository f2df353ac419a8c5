"""Two tailored faces keep to bounds on curvature, slope and thickness, each as its tool sees it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.analysis.shape import thickness_range
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import MIRROR
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.bspline import QUARTERS, BSplineSurface
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.tailoring.clearance import PENALTY_MARGIN, CellGrid, clearance, unit
from bstcad.tailoring.machinability import active_bounds, enforce_bounds, excess
from bstcad.tailoring.merit import Merit
from bstcad.tailoring.settings import Bounds
from bstcad.tailoring.stage2 import Problem
from tests.lenses import half_over, net

WHOLE, DISC = Rectangle(4.0, 6.0), Circle(1.5)
OUTLINES = pytest.mark.parametrize("outline", [WHOLE, DISC], ids=("rectangle", "circle"))
BOUNDS = {
    "concave": Bounds(concave=0.3, thinnest=0.01),
    "convex": Bounds(convex=0.4, thinnest=0.01),
    "slope": Bounds(slope=0.5, thinnest=0.01),
    "least": Bounds(thinnest=2.0),
    "edge": Bounds(thinnest=0.01, edge=2.5),
    "thickness": Bounds(thinnest=2.0, thickest=3.5, edge=2.5),
    "all": Bounds(0.3, 0.4, 0.5, 2.0, 3.5, 2.5),
}


def random(shape, seed):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def rough(outline=WHOLE, tailored=(0, 1)):
    """Two random nets of different sizes, 3 mm apart."""
    front = BSplineSurface(0.0, 0.7 * random((7, 12), 1), (-2.0, 2.0), (-3.0, 3.0))
    back = BSplineSurface(3.0, 0.7 * random((9, 8), 0), (-2.2, 2.1), (-3.0, 3.0))
    return Lens.between(front, back, outline, 1.5, tailored=tailored)


def thickness(lens, x, y):
    return lens.back.sag_and_slope(x, y)[0] - lens.front.sag_and_slope(x, y)[0]


@OUTLINES
@pytest.mark.parametrize("name", BOUNDS)
@pytest.mark.parametrize("tailored", [(0, 1), (0,)], ids=("both", "front"))
def test_the_gradients_are_those_of_finite_differences(tailored, name, outline):
    lens, bounds, step = rough(outline, tailored), BOUNDS[name], 1e-6
    found = excess(lens, bounds)
    assert found.worst > 0 and len(found.gradients) == len(tailored)
    for k, gradient in enumerate(found.gradients):  # of each net by itself
        way = random(gradient.shape, 2)
        up, down = (
            excess(lens.with_heights(n.heights + (d * way if i == k else 0) for i, n in enumerate(lens.nets)), bounds)
            for d in (step, -step)
        )
        expected = (up.mean_square - down.mean_square) / (2 * step)
        assert float((gradient * way).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-9)


@OUTLINES
def test_no_place_is_overlooked(outline):
    """The mean over all places of the grid, none of them ruled out."""
    lens, bounds = rough(outline), BOUNDS["thickness"]
    grid, length, edge = CellGrid.over(lens), unit(lens, bounds), replace(bounds, edge=None)
    places = torch.tensor(QUARTERS, dtype=torch.float64)
    x, y = (
        ((torch.arange(n)[:, None] + places) * size - half).flatten()
        for n, size, half in zip(grid.count, grid.size, grid.half, strict=True)
    )
    x, y = (p.flatten() for p in torch.meshgrid(x, y, indexing="ij"))
    beyond = outline.depth(x.numpy(), y.numpy()) >= -math.hypot(*grid.size) / 2
    glass = thickness(lens, x, y)[torch.from_numpy(beyond)]
    relative = torch.maximum(bounds.thinnest - glass, glass - bounds.thickest) / length
    square, _, worst = clearance(lens, edge)
    assert square == pytest.approx(float((torch.relu(relative + PENALTY_MARGIN) ** 2).sum() / len(x)), rel=1e-12)
    assert worst == pytest.approx(float(relative.max()), rel=1e-12)


def test_no_bit_of_it_depends_on_the_threads():
    lens, threads, found = rough(), torch.get_num_threads(), []
    try:
        for n in (1, 3):
            torch.set_num_threads(n)
            found.append(excess(lens, BOUNDS["all"]))
    finally:
        torch.set_num_threads(threads)
    one, three = found
    assert one.mean_square == three.mean_square and all(map(torch.equal, one.gradients, three.gradients))


@pytest.mark.parametrize("curvature", [0.04, -0.04], ids=("centre to -z", "centre to +z"))
def test_a_tool_sees_the_valleys_of_a_sphere_from_its_own_side(curvature):
    """z = κ r² / 2 + …, κ = ±1 / 25 mm: on the back a valley if κ > 0, on the front, which bulges out then, a ridge."""
    ball = BSplineSurface.fitted(Sphere(0.0, curvature), (-8.0, 8.0), (-8.0, 8.0), 65)  # the fit waves at its ends
    flat = replace(ball, heights=torch.zeros_like(ball.heights))
    front, back = (
        Lens.between(ball, flat.moved(9.0), WHOLE, 1.5, tailored=(0, 1)),
        Lens.between(flat, ball.moved(9.0), WHOLE, 1.5),
    )
    for lens, valley in ((front, curvature < 0), (replace(back, tailored=(0, 1)), curvature > 0)):
        for bounds, met in ((Bounds(concave=0.039), not valley), (Bounds(convex=0.039), valley)):
            worst = excess(lens, bounds).worst
            # a step from span to span
            assert worst == (-PENALTY_MARGIN if met else pytest.approx(0.04 / 0.039 - 1, abs=5e-3))
        assert excess(lens, Bounds(0.041, 0.041)).worst == -PENALTY_MARGIN


def test_only_a_tailored_front_needs_a_bound_where_none_is_asked():
    asked = Bounds(slope=0.5, thinnest=0.3)
    both, front, back = (rough(tailored=tailored) for tailored in ((0, 1), (0,), None))
    assert [lens.is_tailored("front") for lens in (both, front, back)] == [True, True, False]
    assert active_bounds(both, None, 0.5) == active_bounds(front, None, 0.5) == Bounds(thinnest=0.5)
    assert active_bounds(back, None, 0.5) is None
    assert active_bounds(back, asked, 0.5) == active_bounds(both, asked, 0.5) == asked
    assert not replace(both, passes=MIRROR, tailored=None).is_tailored("front")


def crossing(outline, z=3.0, sides=(33, 21), tailored=(0, 1)):
    """Both faces bulge into the glass and would cross on the axis, where they stand 3.6 mm towards each other."""
    nets = [
        net(lambda x, y, sag=sag: sag * torch.exp(-(x**2) - y**2), plane, m, half_over(outline, m))
        for m, plane, sag in ((sides[0], 0.0, 1.8), (sides[1], z, -1.8))
    ]
    return Lens.between(*nets, outline, 1.5, tailored=tailored)


@pytest.mark.parametrize("outline", [Rectangle(8.0, 8.0), Circle(4.0)], ids=("square", "round"))
@pytest.mark.parametrize("tailored", [(0, 1), (0,)], ids=("both", "front"))
def test_faces_that_would_cross_make_way_for_each_other(tailored, outline):
    lens, bounds = crossing(outline, tailored=tailored), Bounds(thinnest=0.5)
    assert thickness_range(lens)[0] < 0
    found = enforce_bounds(lens, bounds)
    assert 0.5 <= thickness_range(found)[0] < 0.52  # bent no further than it takes
    assert found.back.z == lens.back.z  # no move
    for k, (after, before) in enumerate(zip((found.front, found.back), (lens.front, lens.back), strict=True)):
        assert torch.equal(after.heights, before.heights) == (k not in tailored)


def test_a_lens_with_room_stays_as_it_is():
    lens = crossing(WHOLE, z=9.0)
    assert enforce_bounds(lens, Bounds(thinnest=0.5)) is lens


def test_the_back_is_moved_as_the_last_resort():
    """The back moves if bending does not suffice: the bending has hardly begun in this test."""
    lens = crossing(Rectangle(8.0, 8.0))
    found = enforce_bounds(lens, Bounds(thinnest=0.5), evaluations=1)
    assert found.back.z > lens.back.z and thickness_range(found)[0] >= 0.5


def test_both_faces_are_bent_to_all_bounds():
    bounds = Bounds(concave=0.4, convex=0.5, slope=0.45, thinnest=0.6, thickest=4.5, edge=1.0)
    found = enforce_bounds(crossing(Rectangle(8.0, 8.0)), bounds)
    assert excess(found, bounds).worst < 0
    assert 0.6 <= thickness_range(found)[0] <= thickness_range(found)[1] <= 4.5


def test_the_merit_of_two_faces_has_the_penalty_in_both():
    lens = crossing(Rectangle(8.0, 8.0), z=3.7)
    screen = Screen(120.0, (-12.1, 12.0), (-12.2, 12.1), 16)
    beam = Channel(CollimatedSource(Rectangle(7.0, 7.0)), 1.5)
    merit = Merit.of((beam,), lens, 40, [Goal("target", screen, np.ones(screen.shape))], 0.03)
    bounds = active_bounds(lens, None, 0.5)
    free, bound = Problem(lens, merit), Problem(lens, merit, bounds, 100.0)
    start, over = [n.heights for n in lens.nets], excess(lens, bounds)
    (value, gradients, rrmsd), (more, own, same) = free(start), bound(start)
    assert over.mean_square > 0 and rrmsd == same and more == value + 100.0 * over.mean_square
    for g, with_penalty, penalty in zip(gradients, own, over.gradients, strict=True):
        torch.testing.assert_close(with_penalty, g + 100.0 * penalty, rtol=1e-12, atol=0)


def test_faces_may_cross_outside_of_the_outline():
    """Nets reach beyond a round lens, most of all in its corners."""
    lens = crossing(DISC, z=9.0)
    x, y = (torch.linspace(*side, m, dtype=torch.float64) for side, m in ((lens.back.x, 21), (lens.back.y, 21)))
    beyond = torch.hypot(x[:, None], y) > 1.5 + 3 * lens.back.pitch[0]
    lens = lens.with_back(replace(lens.back, heights=lens.back.heights - 20.0 * beyond))
    assert excess(lens, Bounds(thinnest=0.5)).worst == -PENALTY_MARGIN


def test_the_unit_of_the_excess_is_never_zero():
    """A blank whose faces have one height, without a bound, is measured in millimetres."""
    lens = rough(Rectangle(20.0, 20.0))
    assert unit(lens, Bounds(thinnest=0.2)) == max(0.2, PENALTY_MARGIN * (lens.back.z - lens.front.z))
    assert unit(lens.with_back(lens.back.moved(lens.front.z)), Bounds(thinnest=0.0)) == 1.0
