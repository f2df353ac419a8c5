"""The exact volume against volumes known otherwise."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bstcad.cad.volume import exact_volume
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.quadrature import rim_breaks
from bstcad.optics.surfaces import Plane, Sphere

FLAT = Plane(8.0)


def slab(outline, front=FLAT, thickness_at_centre=12.0):
    back = BSplineSurface(8.0, torch.full((9, 9), thickness_at_centre), (-12.0, 12.0), (-12.0, 12.0))
    return Lens(front, back, outline, 1.5)


def test_a_slab_is_area_times_thickness():
    assert exact_volume(slab(Rectangle(24.0, 24.0))) == pytest.approx(24 * 24 * 12, rel=1e-14)
    assert exact_volume(slab(Circle(7.0))) == pytest.approx(np.pi * 49 * 12, rel=1e-14)


@pytest.mark.parametrize("curvature", [0.1, -0.1, 0.01])
def test_a_spherical_front_takes_away_a_cap(curvature):
    """A cap of height s on a sphere of radius R holds pi s² (3R - s) / 3."""
    radius, a = 1 / abs(curvature), 7.0
    s = radius - np.sqrt(radius**2 - a**2)
    cylinder, cap = np.pi * a * a * 12, np.pi * s * s * (3 * radius - s) / 3
    removed = np.pi * a * a * s - cap  # between the vertex plane and the sphere
    lens = slab(Circle(a), Sphere(8.0, curvature))
    assert exact_volume(lens) == pytest.approx(cylinder - np.sign(curvature) * removed, rel=1e-13)


def test_a_weak_sphere_over_a_rectangle_is_its_parabola():
    """∫∫ c r²/2 = c/2 · w h (w² + h²) / 12; the next term, c³ r⁴/8, is 1e-10 of that."""
    c, w, h = 1e-7, 24.0, 24.0
    lens = slab(Rectangle(w, h), Sphere(0.0, c), 0.0)
    taken = 8 * w * h - exact_volume(lens)
    assert taken == pytest.approx(c / 2 * w * h * (w * w + h * h) / 12, rel=1e-7)  # the digits that are left


def gauss(breaks: np.ndarray, n: int = 12) -> tuple[np.ndarray, np.ndarray]:
    point, weight = np.polynomial.legendre.leggauss(n)
    half = np.diff(breaks)[:, None] / 2
    return (breaks[:-1, None] + half * (1 + point)).ravel(), (half * weight).ravel()


def knot_lines(back: BSplineSurface) -> np.ndarray:
    """Where x(t) is an integer t: the ends, then half-way between control points."""
    inner = back.x[0] + back.pitch[0] * (np.arange(1, back.m - 2) + 0.5)
    return np.concatenate([[back.x[0]], inner, [back.x[1]]])


def test_a_rough_back_over_a_rectangle(make_lens):
    """Gauss in x and y between the knot lines, through the closed form t(x)."""
    lens = make_lens(outline=Rectangle(20.0, 20.0))
    x, w = gauss(knot_lines(lens.back))
    grid = torch.meshgrid(torch.from_numpy(x), torch.from_numpy(x), indexing="ij")
    z = lens.back.sag_and_slope(*grid)[0].numpy()
    assert exact_volume(lens) == pytest.approx(w @ z @ w - 8.0 * 400, rel=1e-13)


def test_a_rough_back_over_a_disc(make_lens):
    """Gauss along each chord between the knot lines it crosses, and across chords after x = r sin(phi)."""
    lens = make_lens(outline=Circle(10.0), m=11)
    lines = knot_lines(lens.back)
    lines = lines[np.abs(lines) < 10.0]
    heights = np.sqrt(100.0 - lines**2)
    breaks = np.unique(np.round(np.concatenate([[-10.0, 10.0], lines, heights, -heights]), 12))
    phi, weight = gauss(np.arcsin(breaks / 10.0))
    total = 0.0
    for angle, w in zip(phi, weight, strict=True):
        x, end = 10.0 * np.sin(angle), 10.0 * np.cos(angle)
        y, wy = gauss(np.concatenate([[-end], lines[np.abs(lines) < end], [end]]), 3)
        z = lens.back.sag_and_slope(torch.full((len(y),), x, dtype=torch.float64), torch.from_numpy(y))[0].numpy()
        total += w * 10.0 * np.cos(angle) * (wy @ z)
    assert exact_volume(lens) == pytest.approx(total - 8.0 * np.pi * 100, rel=1e-12)


def test_rim_breaks_go_once_around_and_hold_every_crossing(make_lens):
    back = make_lens(outline=Circle(10.0)).back
    theta = rim_breaks(back, 10.0)
    assert theta[0] == 0 and theta[-1] == 2 * np.pi and (np.diff(theta) > 0).all()
    middle = (theta[:-1] + theta[1:]) / 2
    line = knot_lines(back)
    for position in (np.cos, np.sin):
        cell = np.searchsorted(line, 10.0 * position(middle))
        for end in (theta[:-1] + 1e-7, theta[1:] - 1e-7):
            assert (np.searchsorted(line, 10.0 * position(end)) == cell).all()
