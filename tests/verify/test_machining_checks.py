"""The checks of bounds on the back, on faces of known radii and slopes; each fails for a bound a hair tighter."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from bstcad.analysis.shape import describe, survey
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.verify.checks import bound_checks
from tests.lenses import net

A, B, M = 0.05, -0.02, 65  # z = (A x² + B y²) / 2 (1/mm): curved by A and B on the axis, where it is level
KEYS = ("tool_radius", "max_slope", "min_thickness", "max_thickness", "edge_thickness")
NONE = dict.fromkeys(KEYS) | {"mould": False}


def saddle(outline):
    lower = (A + B) * (8.0 / (M - 1)) ** 2 / 8  # mm: control points of a quadratic lie below it
    return Lens.between(Plane(0.0), net(lambda x, y: (A * x**2 + B * y**2) / 2 - lower, 3.0, M, 4.0), outline, 1.5)


def judged(**asked):
    lens = saddle(Circle(3.0))
    checks, at = bound_checks(lens, SimpleNamespace(**NONE | asked), describe(lens))
    [check] = checks
    return check, at


@pytest.mark.parametrize("outline", [Circle(3.0), Rectangle(6.0, 6.0)], ids=("round", "square"))
def test_radii_and_slope_of_a_saddle(outline):
    lens = saddle(outline)
    found = survey(lens)
    assert found.concave.largest == pytest.approx(1 / A, rel=1e-6)
    assert found.convex.largest == pytest.approx(-1 / B, rel=1e-6)
    x, y = (3.0, 0.0) if outline.shape == "circle" else (3.0, 3.0)
    assert found.slope.largest == pytest.approx(math.degrees(math.atan(math.hypot(A * x, B * y))), rel=1e-3)


@pytest.mark.parametrize(
    ("key", "value", "sign"),
    [("tool_radius", 20.0, -1), ("max_slope", 8.53, 1), ("edge_thickness", 2.91, -1), ("min_thickness", 2.91, -1),
     ("max_thickness", 3.225, 1)],
)  # fmt: skip
def test_each_passes_and_fails(key, value, sign):
    assert judged(**{key: value * (1 + 1e-3 * sign)})[0].passed
    check, _ = judged(**{key: value * (1 - 2e-3 * sign)})
    assert not check.passed and (check.where.startswith("at (") or "thickness" in key)


def test_of_a_mould_the_ridges_are_judged():
    assert judged(tool_radius=49.9, mould=True)[0].passed and not judged(tool_radius=50.1, mould=True)[0].passed


def test_where_it_is_at_its_bound_is_a_part_of_the_area():
    assert judged(tool_radius=20.0)[1]["tool_radius"].share > 0.05  # about the axis, where it is level
    assert judged(tool_radius=10.0)[1]["tool_radius"].share == 0.0


def test_nothing_is_asked_of_a_lens_without_bounds():
    assert bound_checks(saddle(Circle(3.0)), SimpleNamespace(**NONE), {}) == ([], {})
