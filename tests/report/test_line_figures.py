"""The light of a spectrum: its colours, and the figure that sets its lines apart."""

import numpy as np
import pytest

from bstcad.optics.measure import Line
from bstcad.report.colours import balanced, primary
from bstcad.report.light_figures import View
from bstcad.report.line_figures import lines_apart

LINES = (450.0, 530.0, 630.0)
VIEW = View((-10.0, 10.0), (-5.0, 5.0), "lens")


@pytest.mark.parametrize(("wavelength", "channel"), [(450.0, 2), (530.0, 1), (630.0, 0)])
def test_blue_green_and_red_are_what_they_are_called(wavelength, channel):
    assert int(np.argmax(primary(wavelength))) == channel


@pytest.mark.parametrize("wavelengths", (LINES, (486.1, 587.6, 656.3), (400.0, 900.0)))
def test_where_all_lines_are_alike_the_light_is_grey(wavelengths):
    picture = np.random.default_rng(0).random((6, 8))
    shares = np.full(len(wavelengths), 1 / len(wavelengths))
    colours = balanced([picture] * len(wavelengths), wavelengths, shares)
    assert np.abs(colours - picture[..., None]).max() < 1e-12


def test_light_of_one_line_alone_has_its_colour():
    one, none = np.ones((2, 2)), np.zeros((2, 2))
    red = balanced([none, none, one], LINES, [1 / 3] * 3)[0, 0]
    assert red[0] > 0.9 and red[2] < 0.1


@pytest.mark.parametrize("count", (2, 3, 7))
def test_the_figure_has_a_picture_of_all_lines_and_one_of_each(count):
    target = np.ones((10, 20))
    lines = [Line(450.0 + 30 * k, 1 / count, target * (1 + 0.1 * k)) for k in range(count)]
    figure = lines_apart(target, 1.02 * target, lines, VIEW)
    shown = [axes.get_title(loc="left") for axes in figure.axes if axes.get_visible()]
    assert len(shown) == count + 1 and shown[0] == "All lines" and "450 nm" in shown[1]
