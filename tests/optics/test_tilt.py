"""Tilts: right-handed frames, and the tilt that leads to an axis."""

import numpy as np
import pytest

from bstcad.optics.tilt import axes, tilt_of

TILTS = [(0.0, 0.0), (30.0, 0.0), (0.0, 30.0), (-20.0, 50.0), (70.0, -80.0)]


@pytest.mark.parametrize("tilt", TILTS, ids=str)
def test_the_axes_are_those_of_space_turned_about_x_and_then_about_y(tilt):
    a, b = np.radians(tilt)
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    np.testing.assert_allclose(np.array(axes(tilt)).T, about_y @ about_x, atol=1e-15)


@pytest.mark.parametrize("tilt", TILTS, ids=str)
def test_the_tilt_of_an_axis_leads_to_it(tilt):
    assert tilt_of(axes(tilt)[2]) == pytest.approx(tilt, abs=1e-13)
