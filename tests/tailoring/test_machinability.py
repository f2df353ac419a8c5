"""Bounds on the back hold on a grid four times finer than the net; the back keeps clear of the front."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest
import torch

from bstcad import commands
from bstcad.analysis.shape import describe
from bstcad.commands import ProofOptions
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace.measure import Effort
from bstcad.report import record
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import load
from bstcad.tailoring.effort import FULL
from bstcad.tailoring.machinability import RELIEF_RESERVE, enforce_bounds, excess, place_back
from bstcad.tailoring.settings import Bounds
from tests import lenses, suite
from tests.conftest import quick_effort
from tests.efforts import designed_quickly
from tests.scenes import DISK, SMALL

PLACE = r"at \([-\d.e]+, [-\d.e]+\) mm"
TINY = SMALL | {
    "tailoring.rays": 128,
    "target.pixels": 32,
    "tailoring.transport_grid": 32,
    "tailoring.stage2_iterations": 36,
}
RATED_BY_FEW_RAYS = replace(FULL, fine=Effort(512, accuracy=0.0, witness=False))
WHOLE = Rectangle(4.0, 6.0)


@pytest.fixture(scope="module")
def free():
    """The small design that may have any shape: radius 20 mm, slope 3.6 degrees, 9.82 to 10.01 mm thick."""
    return designed_quickly(load(DISK, TINY), RATED_BY_FEW_RAYS)


@pytest.fixture(scope="module")
def bound():
    """Return a design whose back is bounded by a tool of 50 mm."""
    return designed_quickly(load(DISK, TINY | {"lens.tool_radius": 50.0}), RATED_BY_FEW_RAYS)


def steepest(lens):
    """Largest slope, and largest curvature of a valley and a ridge (1/mm), by slopes of places a little apart.

    On the rectangle of glass, some four places a knot span; nothing here is what tailoring reckons with.
    """
    back, e = lens.back, 1e-6
    lines = (torch.linspace(e - half, half, 4 * back.m, dtype=torch.float64) for half in lens.outline.half_extent)
    x, y = (p.flatten() for p in torch.meshgrid(*lines, indexing="ij"))
    _, p, q = back.sag_and_slope(x, y)
    (_, p_x, q_x), (_, p_y, q_y) = back.sag_and_slope(x - e, y), back.sag_and_slope(x, y - e)
    r, s, t = (p - p_x) / e, ((q - q_x) + (p - p_y)) / (2 * e), (q - q_y) / e
    first = torch.stack([1 + p * p, p * q, p * q, 1 + q * q], -1).view(-1, 2, 2)
    second = torch.stack([r, s, s, t], -1).view(-1, 2, 2) / torch.sqrt(1 + p * p + q * q)[:, None, None]
    k = torch.linalg.eigvals(torch.linalg.solve(first, second)).real
    return float(torch.hypot(p, q).max()), float(k.max()), -float(k.min())


def rough(outline=WHOLE):
    return Lens.between(Plane(0.0), lenses.rough(1.0, z=3.0, m=9, half=(2.0, 3.0)), outline, 1.5)


def test_the_gradient_for_a_back_alone_is_that_of_finite_differences():
    """All bounds act at once; test_clearance.py has each of them, for both faces and for a front."""
    lens, bounds, step = rough(Circle(1.5)), Bounds(0.3, 0.4, 0.5, 2.0, 3.5, 2.5), 1e-6
    found = excess(lens, bounds)
    way = torch.randn(9, 9, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    up, down = (
        excess(lens.with_back(replace(lens.back, heights=lens.back.heights + d * way)), bounds).mean_square
        for d in (step, -step)
    )
    along = float((found.gradients[0] * way).sum())
    assert found.worst > 0 and (up - down) / (2 * step) == pytest.approx(along, rel=1e-5)


@suite.in_turn(0, 2)
def test_a_tool_of_50_mm_fits_and_the_picture_stays(free, bound):
    lens = bound.lens
    assert steepest(free.lens)[1] > 1.2 / 50 and steepest(lens)[1] <= 1 / 50
    judged = {stage.name: stage.rrmsd for stage in bound.course.stages}
    without = free.course.stages[-1].rrmsd
    assert max(judged["bounds on the back"], without) < 0.0115  # 0.0103, and 0.0078; stage 1 leaves 0.046


@suite.in_turn(0, 2)
def test_the_report_says_so_from_the_file(bound):
    contents = commands.prove(bound, ProofOptions(quick_effort()))
    [check] = [c for c in contents.checks if c.name.startswith("smallest concave radius")]
    assert check.passed and check.limit == 50 and check.value == pytest.approx(50, rel=0.02)
    assert contents.bounds["at"]["tool_radius"] > 0 and re.fullmatch(PLACE, contents.bounds["tightest"]["tool_radius"])
    assert not {"rrmsd", "rrmsd_freed"} & contents.bounds.keys()  # one run cannot tell what a bound costs
    said = re.sub(PLACE, "(there)", record.bounds(contents.bounds))
    assert re.fullmatch(
        r"The back was tailored within bounds \(lens.tool_radius = 50 mm\); [\d.]+ % of its area is within 3 % of "
        r"lens.tool_radius, closest \(there\)\.",
        said,
    )
    assert contents.shape["radius_min_concave"] >= 50


@pytest.mark.parametrize(
    ("asked", "kept_to"),
    [
        ({"lens.max_slope": 3.3}, lambda lens: steepest(lens)[0] <= math.tan(math.radians(3.3))),
        ({"lens.tool_radius": 60.0, "lens.mould": True}, lambda lens: steepest(lens)[2] <= 1 / 60),
        ({"lens.max_thickness": 9.5}, lambda lens: describe(lens)["thickness_max"] <= 9.5),
        ({"lens.edge_thickness": 9.9}, lambda lens: 9.9 <= describe(lens)["edge_thickness_min"] < 9.91),
    ],
    ids=("slope", "mould", "thickest", "edge"),
)
def test_each_bound_is_kept_to_where_the_free_lens_does_not(asked, kept_to, free):
    assert not kept_to(free.lens) and kept_to(enforce_bounds(free.lens, load(DISK, TINY | asked).lens.bounds))


@pytest.mark.thorough
def test_a_design_keeps_to_a_range_of_thickness():
    coarse = {"lens.back.control_points": 17, "tailoring.rays": 64, "tailoring.rounds": 1}
    asked = {"tailoring.stage2_iterations": 3, "lens.min_thickness": 9.9, "lens.max_thickness": 10.0}
    found = describe(designed_quickly(load(DISK, TINY | coarse | asked)).lens)
    assert 9.9 <= found["thickness_min"] <= found["thickness_max"] <= 10.0


@suite.in_turn(0, 2)
def test_a_bound_that_no_lens_meets_with_its_light_on_the_target_is_refused():
    aside = {"target.x": [60.0, 100.0], "target.y": [-20.0, 20.0], "target.outline": None, "lens.max_slope": 0.001}
    scene = load(DISK, TINY | {"tailoring.rounds": 2}).changed(aside)
    with pytest.raises(SceneError, match=r"^lens\.max_slope = 0\.001: "):
        designed_quickly(scene)


def test_where_bending_does_not_help_the_back_gets_flatter():
    """A random net for a tool as large as a house: what is left is nearly flat, and keeps to it."""
    bounds = Bounds(concave=1e-4, convex=1e-4)
    lens = enforce_bounds(rough(), bounds)
    assert excess(lens, bounds).worst < 0 and float(lens.back.heights.std()) < 0.01


@suite.in_turn(1, 2)
def test_a_front_that_no_flat_back_clears_is_refused():
    lens = rough().with_front(Sphere(0.0, 0.2))
    with pytest.raises(SceneError, match=r"^lens\.max_thickness: "):
        enforce_bounds(lens, Bounds(thinnest=1.0, thickest=1.5))


def lens(front, outline=lenses.SQUARE, slope=0.3):
    return Lens.between(front, lenses.tilted(slope, half=10.0), outline, 1.5)


@pytest.mark.parametrize(
    ("front", "outline"), [(Plane(18.0), lenses.SQUARE), (Sphere(18.0, 0.02), Circle(7.0))], ids=("plane", "sphere")
)
def test_it_keeps_the_least_thickness(front, outline):
    moved = place_back(lens(front, outline), 20.0, 0.5)
    relief = 2 * 0.3 * outline.half_extent[0]
    spare = describe(moved)["thickness_min"] - 0.5 - RELIEF_RESERVE * relief
    assert moved.back.z > 20.0 and abs(spare) < 2e-3  # mm; the round rim lies between the points looked at


def test_a_lens_with_room_stays_where_it_was():
    roomy = lens(Plane(10.0))
    stays = place_back(roomy, 20.0, 0.5)
    assert stays.back.z == 20.0 and torch.equal(stays.back.heights, roomy.back.heights)


def test_it_comes_back_when_it_needs_less():
    flat = lens(Plane(18.0), slope=0.0)
    far = flat.with_back(replace(flat.back, z=30.0))
    assert place_back(far, 20.0, 0.5).back.z == 20.0
