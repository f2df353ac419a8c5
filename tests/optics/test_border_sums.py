"""Sums within any border, by Green: against closed forms, and against the sums within an outline, found otherwise."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest

from bstcad.optics.border_sums import Border, border_sums
from bstcad.optics.face_sums import face_sums, gauss_points
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.quadrature import rim_breaks
from bstcad.optics.surfaces import Conic, Plane, Sphere
from tests.optics.test_face_sums import TILTED, A, B, C, rough, tilted


def round_(radius, x0=0.0, y0=0.0, breaks=None, turn=1):
    t, weight = gauss_points(np.linspace(0, 2 * np.pi, 129) if breaks is None else breaks, 5)
    c, s = radius * np.cos(turn * t), radius * np.sin(turn * t)
    return Border(x0 + c, y0 + s, -turn * weight * s, weight * radius)


def sharp(a, b, lines):
    """A rectangle, its sides divided at the places `lines`."""
    u, weight = gauss_points(np.union1d(lines[np.abs(lines) < a], [-a, a]), 5)
    v, across = gauss_points(np.union1d(lines[np.abs(lines) < b], [-b, b]), 5)
    x = np.concatenate([u, 0 * v + a, u, 0 * v - a])
    y = np.concatenate([0 * u - b, v, 0 * u + b, v])
    return Border(x, y, np.concatenate([weight, 0 * v, -weight, 0 * v]), np.concatenate([weight, across] * 2))


@pytest.mark.parametrize("m", [5, 9, 130])
def test_a_tilted_plane_over_a_disc_anywhere(m):
    """z = c + A x + B y over a disc of radius r about (p, q): all in closed form."""
    p, q, r = 3.0, -2.5, 4.0
    found = border_sums(tilted(m), round_(r, p, q), raised=0.5)
    area, moment, mean = np.pi * r**2, np.pi * r**4 / 4, C + 0.5 + A * p + B * q
    assert found.area == pytest.approx(area * TILTED, rel=1e-12)
    assert found.first == pytest.approx(area * mean, rel=1e-12)
    assert (found.in_x, found.in_y) == pytest.approx(
        (area * mean * p + A * moment, area * mean * q + B * moment), rel=1e-11
    )
    assert found.second == pytest.approx(area * mean**2 + (A * A + B * B) * moment, rel=1e-11)
    assert found.along_rim == pytest.approx(2 * np.pi * r * mean, rel=1e-12)


@pytest.mark.parametrize("face", [Plane(8.0), Sphere(8.0, 0.1), Conic(8.0, -0.05, -1.3)], ids=lambda face: face.kind)
@pytest.mark.parametrize("outline", [Circle(7.0), Rectangle(9.0, 10.0)], ids=lambda outline: outline.shape)
def test_a_smooth_face_within_its_outline(face, outline):
    border = round_(7.0) if outline.shape == "circle" else sharp(4.5, 5.0, np.linspace(-5, 5, 21))
    assert astuple(border_sums(face, border, 1.0)) == pytest.approx(
        astuple(face_sums(face, outline, 1.0)), rel=1e-11, abs=1e-9
    )


@pytest.mark.parametrize("m", [9, 40, 131])
def test_a_rough_net_within_its_outline(m):
    half = 8.0 * (m - 1) / (m - 5)
    face = rough(m, half)
    assert astuple(border_sums(face, round_(8.0, breaks=rim_breaks(face, 8.0)))) == pytest.approx(
        astuple(face_sums(face, Circle(8.0))), rel=1e-7, abs=1e-7
    )
    whole, lines = rough(m, 8.0), -8.0 + 16.0 / (m - 1) * (np.arange(1, m - 2) + 0.5)
    lines = np.union1d(lines, np.linspace(-8.0, 8.0, 65))
    assert astuple(border_sums(whole, sharp(8.0, 8.0, lines))) == pytest.approx(
        astuple(face_sums(whole, Rectangle(16.0, 16.0))),
        rel=1e-7,
        abs=1e-6,  # moments that cancel, of some 2000 mm⁴
    )


def test_a_hole_is_taken_away():
    face, hole = rough(40, 12.0), round_(1.5, 2.0, -3.0, turn=-1)
    both = [np.concatenate(each) for each in zip(astuple(round_(8.0)), astuple(hole), strict=True)]
    rest, whole, out = (border_sums(face, border) for border in (Border(*both), round_(8.0), round_(1.5, 2.0, -3.0)))
    for name in ("area", "first", "in_x", "in_y", "second"):
        assert getattr(rest, name) == pytest.approx(getattr(whole, name) - getattr(out, name), rel=1e-12)
    assert rest.along_rim == pytest.approx(whole.along_rim + out.along_rim, rel=1e-12)
