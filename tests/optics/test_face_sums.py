"""Integrals over faces against closed forms, and against Gauss points set another way."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.face_sums import face_sums
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.surfaces import Conic, Plane, Sphere

A, B, C = 0.3, -0.2, 1.7  # of a tilted plane
TILTED = (1 + A * A + B * B) ** 0.5


def tilted(m=9, half=12.0):
    """z = 5 + C + A x + B y as a net: control points of a plane lie on it."""
    x = torch.linspace(-half, half, m, dtype=torch.float64)
    return BSplineSurface(5.0, C + A * x[:, None] + B * x[None, :], (-half, half), (-half, half))


def rough(m, half, ripple=0.02):
    x = torch.linspace(-half, half, m, dtype=torch.float64)
    noise = torch.randn(m, m, generator=torch.Generator().manual_seed(m), dtype=torch.float64)
    heights = 1.0 + 0.3 * torch.sin(x / 3)[:, None] * torch.cos(x / 2 + 1) + ripple * noise
    return BSplineSurface(5.0, heights, (-half, half), (-half, half))


@pytest.mark.parametrize("m", [5, 9, 130])
def test_a_tilted_plane_over_a_rectangle(m):
    found = face_sums(tilted(m), Rectangle(24.0, 24.0), raised=0.5)
    c, area, moment = C + 0.5, 24.0**2, 24.0**4 / 12
    assert found.area == pytest.approx(area * TILTED, rel=1e-13)
    assert (found.first, found.in_x, found.in_y) == pytest.approx((c * area, A * moment, B * moment), rel=1e-12)
    assert found.second == pytest.approx(c * c * area + (A * A + B * B) * moment, rel=1e-13)
    assert found.along_rim == pytest.approx(c * 4 * 24.0, rel=1e-13)


@pytest.mark.parametrize("m", [9, 10, 130])
@pytest.mark.parametrize("radius", [2.0, 3.1, 6.0])
def test_a_tilted_plane_over_a_disc(m, radius):
    found = face_sums(tilted(m, half=10.0), Circle(radius), raised=0.5)
    c, area, moment = C + 0.5, np.pi * radius**2, np.pi * radius**4 / 4
    assert found.area == pytest.approx(area * TILTED, rel=1e-12)
    assert (found.first, found.in_x, found.in_y) == pytest.approx((c * area, A * moment, B * moment), rel=1e-11)
    assert found.second == pytest.approx(c * c * area + (A * A + B * B) * moment, rel=1e-12)
    assert found.along_rim == pytest.approx(c * 2 * np.pi * radius, rel=1e-13)


@pytest.mark.parametrize("curvature", [0.1, -0.1, 0.13])
def test_a_cap_has_the_area_of_its_height(curvature):
    """2 pi R s (Archimedes)."""
    radius, a = 1 / abs(curvature), 7.0
    s = radius - np.sqrt(radius**2 - a**2)
    found = face_sums(Sphere(8.0, curvature), Circle(a))
    assert found.area == pytest.approx(2 * np.pi * radius * s, rel=1e-12)
    assert found.along_rim == pytest.approx(np.sign(curvature) * s * 2 * np.pi * a, rel=1e-12)
    assert (found.in_x, found.in_y) == pytest.approx((0.0, 0.0), abs=1e-10)


@pytest.mark.parametrize("face", [Plane(8.0), Sphere(8.0, 0.04), Conic(8.0, 0.05, -1.3)])
@pytest.mark.parametrize("outline", [Rectangle(20.0, 14.0), Circle(8.0)], ids=lambda o: o.shape)
def test_the_first_moment_is_the_surface_s_own_integral(face, outline):
    assert face_sums(face, outline).first == pytest.approx(face.integral(outline), rel=1e-12, abs=1e-12)


def gauss(breaks, n):
    point, weight = np.polynomial.legendre.leggauss(n)
    half = np.diff(breaks)[:, None] / 2
    return (breaks[:-1, None] + half * (1 + point)).ravel(), (half * weight).ravel()


def lines(face):
    inner = face.x[0] + face.pitch[0] * (np.arange(1, face.m - 2) + 0.5)
    return np.concatenate([[face.x[0]], inner, [face.x[1]]])


def values(face, x, y):
    h, h_x, h_y = (v.numpy() for v in face.relative_sag_and_slope(*map(torch.from_numpy, np.broadcast_arrays(x, y))))
    return np.stack([np.sqrt(1 + h_x**2 + h_y**2), h, x * h, y * h, h * h])


def sums(found):
    return [found.area, found.first, found.in_x, found.in_y, found.second]


@pytest.mark.parametrize(("m", "ripple"), [(9, 0.02), (66, 0.004)])  # slopes change by 0.03 within a span
def test_a_rough_net_over_a_rectangle(m, ripple):
    """Twelve Gauss points a span, through the closed form t(x); h² and the area are what no shorter way has exactly."""
    face = rough(m, 10.0, ripple)
    x, w = gauss(lines(face), 12)
    grid = np.meshgrid(x, x, indexing="ij")
    wanted = (values(face, *grid) * (w[:, None] * w)).sum(axis=(1, 2))
    area, *others = sums(face_sums(face, Rectangle(20.0, 20.0)))
    assert area == pytest.approx(wanted[0], rel=1e-8)
    assert others == pytest.approx(wanted[1:].tolist(), rel=1e-11)


@pytest.mark.parametrize("radius", [1.0, 6.4])
def test_a_rough_net_over_a_disc(radius):
    """By chords all the way across, after x = r sin(phi), breaks where chord or rim meets a knot line."""
    face = rough(19, 10.0)
    inner = lines(face)
    inner = inner[np.abs(inner) < radius]
    rim = np.sqrt(radius**2 - inner**2)
    breaks = np.unique(np.round(np.concatenate([[-radius, 0.0, radius], inner, rim, -rim]), 12))
    phi, weight = gauss(np.arcsin(breaks / radius), 12)
    wanted = np.zeros(5)
    for angle, w in zip(phi, weight, strict=True):
        x, end = radius * np.sin(angle), radius * np.cos(angle)
        y, along = gauss(np.concatenate([[-end], inner[np.abs(inner) < end], [end]]), 8)
        wanted += w * end * (values(face, x, y) * along).sum(axis=1)
    found = face_sums(face, Circle(radius))
    assert sums(found) == pytest.approx(wanted.tolist(), rel=1e-9)
    assert found.first == pytest.approx(face.integral(Circle(radius)), rel=1e-12)
