"""Integrals over faces against closed forms, against Gauss points set another way, and each way against the other."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bstcad.optics.lens.face_integrals import Border, divided, gauss_points, of_face, of_wall, outline_border
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Conic, Plane, Sphere
from tests import lenses
from tests.exact_volume import integral
from tests.lenses import half_over, net

A, B, C = 0.3, -0.2, 1.7  # slopes and height (mm) of a tilted plane
OUTLINES = [Rectangle(16.0, 14.0), Circle(6.5)]


def tilted(m):
    """z = C + A x + B y as a net: control points of a plane lie on it."""
    return net(lambda x, y: C + A * x + B * y, 5.0, m, 12.0)


def rough(m, half=(8.0, 7.0)):
    noise = lenses.rough(0.3 / m, m, m=m).heights
    return net(lambda x, y: 1.0 + 0.3 * torch.sin(x / 3) * torch.cos(y / 2 + 1) + noise, 5.0, m, half)


SMOOTH = [Plane(8.0), Sphere(8.0, 0.04), Conic(8.0, 0.05, -1.3)]
CASES = [(outline, face) for outline in OUTLINES for face in SMOOTH]
CASES += [(outline, rough(m, half_over(outline, m))) for outline in OUTLINES for m in (9, 131)]


def disc(radius, x=0.0, y=0.0, turn=1):
    t, weight = gauss_points(np.linspace(0, 2 * np.pi, 129), 5)
    c, s = radius * np.cos(turn * t), radius * np.sin(turn * t)
    return Border(x + c, y + s, -turn * weight * s, turn * weight * c)


@pytest.mark.parametrize(("breaks", "parts"), [([0.0, 1.0, 3.0], 5), ([-1.0, 0.5], 4), ([0.0, 1.0, 2.0, 4.0], 3)])
def test_parts_are_enough_and_keep_the_breaks(breaks, parts):
    found = divided(np.array(breaks), parts)
    assert len(found) > parts and set(breaks) <= set(found)
    assert len(set(np.diff(found).round(12))) <= len(breaks) - 1  # equal parts within an interval


@pytest.mark.parametrize("m", [5, 9, 130])
def test_a_tilted_plane_over_a_disc_anywhere(m):
    """n dA = (-A, -B, 1) dx dy, so that r·n is the plane's height over the origin everywhere."""
    p, q, r = 3.0, -2.5, 4.0
    found, area, height = of_face(tilted(m), disc(r, p, q), raised=0.5), np.pi * r * r, C + 0.5
    assert found.area == pytest.approx(area * (1 + A * A + B * B) ** 0.5, rel=1e-12)
    assert found.volume == pytest.approx(height * area / 3, rel=1e-12)
    assert found.moment == pytest.approx(height * area / 4 * np.array([p, q, height + A * p + B * q]), rel=1e-11)
    border = disc(r, p, q)
    assert of_wall(tilted(m), border, 0.5).area == pytest.approx(2 * np.pi * r * (height + A * p + B * q), rel=1e-12)


@pytest.mark.parametrize("curvature", [0.1, -0.1, 0.13])
def test_a_cap_has_the_area_of_its_height(curvature):
    """2 pi R s (Archimedes)."""
    radius, a = 1 / abs(curvature), 7.0
    found = of_face(Sphere(8.0, curvature), disc(a))
    assert found.area == pytest.approx(2 * np.pi * radius * (radius - np.sqrt(radius**2 - a**2)), rel=1e-12)
    assert found.moment[:2] == pytest.approx((0.0, 0.0), abs=1e-10)


@pytest.mark.parametrize(
    ("outline", "face"), CASES, ids=lambda each: getattr(each, "shape", "") or f"{each.kind} {getattr(each, 'm', '')}"
)
def test_face_and_wall_hold_the_exact_volume(outline, face):
    """The divergence theorem, and the integral of the control points as the other method, which share no point."""
    border = outline_border(outline, face)
    both = of_face(face, border, 2.0) + of_wall(face, border, 2.0)
    assert both.volume == pytest.approx(integral(face, outline) + 2.0 * outline.area, rel=1e-9)


@pytest.mark.parametrize("m", [9, 66])
def test_area_and_moments_of_a_rough_net(m):
    """Twelve Gauss points a span and axis between the knot lines: V c = ∫∫ (x h, y h, h² / 2)."""
    face, outline, sides = rough(m), OUTLINES[0], []
    for (first, last), pitch in zip((face.x, face.y), face.pitch, strict=True):
        lines = np.concatenate([[first], first + pitch * (np.arange(1, m - 2) + 0.5), [last]])
        sides.append(gauss_points(lines, 12))
    (x, along), (y, across) = sides
    x, y, weight = np.repeat(x, len(y)), np.tile(y, len(x)), np.outer(along, across).ravel()
    h, h_x, h_y = (each.numpy() for each in face.relative_sag_and_slope(torch.from_numpy(x), torch.from_numpy(y)))
    border = outline_border(outline, face)
    cap, wall = of_face(face, border), of_wall(face, border)
    assert cap.area == pytest.approx((weight * np.sqrt(1 + h_x**2 + h_y**2)).sum(), rel=1e-8)
    wanted = [(weight * h * each).sum() for each in (x, y, h / 2)]
    assert cap.moment + wall.moment == pytest.approx(wanted, rel=1e-8, abs=1e-6)  # mm⁴, of some 2000
