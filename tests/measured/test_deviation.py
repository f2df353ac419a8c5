"""The minimum zone against a linear program of all points at once."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from bstcad.measured.zone import minimum_zone
from scipy.optimize import linprog

from bstcad.measured.alignment import Face, aligned, unmoved
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle
from bstcad.optics.surfaces import Plane
from tests.measured.synthetic import points, with_form_error


@pytest.fixture(scope="module")
def lens():
    x = torch.linspace(-6, 6, 33, dtype=torch.float64)
    heights = 0.02 * x[:, None] ** 2 + 0.01 * x[None, :] ** 2 + 0.003 * x[:, None] ** 3 / 6
    return Lens(Plane(0.0), BSplineSurface(5.0, heights, (-6.0, 6.0), (-6.0, 6.0)), Circle(5.0), 1.5)


def test_it_is_that_of_all_points(lens):
    face = Face.of(lens)
    found = aligned(face, points(with_form_error(lens, 5e-4, 2.0), 3000), unmoved(face))
    zone = minimum_zone(face, found)
    columns, one = face.columns(found.points, found.normals), np.ones((len(found.points), 1))
    exact = linprog(
        [0.0] * 6 + [1.0],
        A_ub=np.vstack([np.hstack([columns, -one]), np.hstack([-columns, -one])]),
        b_ub=1e3 * np.concatenate([-found.distances, found.distances]),
        bounds=[(None, None)] * 6 + [(0, None)],
    )
    assert zone.width == pytest.approx(2e-3 * exact.fun, rel=0.01) and zone.width <= np.ptp(found.distances) * 1.001


def test_a_known_error_has_a_known_zone(lens):
    """cos(k φ) at the rim: no motion makes its largest distance smaller."""
    ripple = 1e-3
    given = points(lens, 20_000)
    angle, radius = np.arctan2(given[:, 1], given[:, 0]), np.hypot(given[:, 0], given[:, 1]) / 5
    given[:, 2] += ripple * radius**6 * np.cos(6 * angle)
    face = Face.of(lens)
    normal_z = 1 / np.sqrt(1 + 0.2**2)
    width = minimum_zone(face, aligned(face, given, unmoved(face))).width
    assert 2 * ripple * normal_z * 0.93 < width < 2 * ripple


def test_nothing_is_mirrored(lens):
    mirrored = replace(lens, back=replace(lens.back, heights=lens.back.heights.flip(0)))
    face = Face.of(lens)
    found = aligned(face, points(mirrored, 3000), unmoved(face))
    assert np.linalg.det(found.pose.rotation) == pytest.approx(1.0) and found.rms > 0.01
