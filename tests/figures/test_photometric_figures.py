"""Diagrams of lighting engineers state the intensities and illuminances of their data, the right way round."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

import bstcad
from bstcad.figures import photometric_figures as figures
from bstcad.figures.light_figures import View
from bstcad.optics.receivers.directions import Directions
from bstcad.optics.trace.measure import Light
from bstcad.photometry.intensity import Intensity
from bstcad.verify.nominal import Nominal

AROUND, ALONG = np.arange(0.0, 360.0, 5.0), np.arange(0.0, 91.0, 1.0)
C, GAMMA = np.radians(AROUND)[:, None], np.radians(ALONG)[None]
PLANE = View((-200.0, 200.0), (-100.0, 100.0), "lens")
ANGLES = View((-30.0, 30.0), (-30.0, 30.0), "lens", receiver=Directions("C"))
EXPONENT = 8


def beam():
    """I = 900 cos^8 γ cd."""
    return Intensity("C", AROUND, ALONG, 900 * np.broadcast_to(np.cos(GAMMA), (72, 91)) ** EXPONENT)


def one_side():
    """A spot at C = 60°, γ = 20°."""
    x, y = GAMMA * np.cos(C), GAMMA * np.sin(C)
    at = math.radians(20)
    spot = (x - at * math.cos(math.pi / 3)) ** 2 + (y - at * math.sin(math.pi / 3)) ** 2
    return Intensity("C", AROUND, ALONG, 500 * np.exp(-spot / 0.1**2))


def test_the_polar_diagram_has_c0_on_the_right_and_the_plane_of_the_maximum():
    axes = figures.polar_diagram(one_side(), known=True).axes[0]
    lines = {line.get_label(): line.get_data() for line in axes.lines}
    assert list(lines) == ["C0-C180", "C90-C270", "C60-C240, of the maximum"]
    angle, values = lines["C60-C240, of the maximum"]
    assert math.degrees(angle[values.argmax()]) == pytest.approx(20.0, abs=0.2) and values.max() == pytest.approx(500)
    assert math.sin(axes.get_theta_offset()) == pytest.approx(-1.0) and axes.get_theta_direction() == 1  # 0° below
    for (angle, values), c in ((lines["C0-C180"], 0.0), (lines["C90-C270"], 90.0)):
        expected = one_side().between(np.full(3, c), np.array([5.0, 15.0, 20.0]))
        assert np.interp(np.radians([5.0, 15.0, 20.0]), angle, values) == pytest.approx(expected, rel=1e-3)


def test_the_sector_of_a_polar_diagram_has_all_light():
    for table, half in ((beam(), 60.0), (one_side(), 60.0)):
        axes = figures.polar_diagram(table, known=False).axes[0]
        assert axes.get_thetamax() == pytest.approx(half) and half >= figures.reach_of(table)


def test_isocandela_lines_are_where_the_intensity_is():
    """C = 60° is at x > 0 and y < 0, whose x is on the left as seen from the lens."""
    figure = figures.isocandela_diagram(one_side(), ANGLES, known=True)
    axes = figure.axes[0]
    values = np.asarray(axes.images[0].get_array())
    row, column = np.unravel_index(values.argmax(), values.shape)
    left, right, low, high = axes.images[0].get_extent()
    x = left + (column + 0.5) / values.shape[1] * (right - left)
    y = high - (row + 0.5) / values.shape[0] * (high - low)
    assert (x, y) == pytest.approx((10.0, -17.32), abs=0.6)
    assert left > right and axes.get_xlim() == (left, right)


def test_the_edges_of_a_beam_and_the_illuminance_on_its_axis():
    """cos^8 γ = p at γ = acos p^(1/8); E = I / h²."""
    for part in (0.5, 0.1):
        edge = math.degrees(math.acos(part ** (1 / EXPONENT)))
        assert figures.beam_edges(beam(), 0.0, part) == pytest.approx((edge, edge), abs=0.02)
    right, left = figures.beam_edges(one_side(), 60.0, 0.5)
    assert (right, left) == (0.0, 0.0)  # the axis is dark
    axes = figures.cone_diagram(beam()).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()][1] == "2 m: 225 lx"
    width = 2 * 2 * math.tan(math.acos(0.5 ** (1 / EXPONENT)))
    assert any(f"Ø {width:.3g} /" in text.get_text() for text in axes.texts)


def test_illuminance_has_the_flux_of_the_target():
    """Σ E dA = lumens times the fraction of the light on the target; the ghost's part is contained."""
    picture = np.zeros((40, 80))
    picture[3:9, 50:70] = 2.0
    flux = {"on target": 0.5, "ghost on target": 0.01, "off target": 0.3}
    light = Light(picture, 0.1, 0.01, rays=1, flux=flux, on_screen=0.51)
    lux = figures.illuminance(light, 1000.0, PLANE)
    assert lux.sum() * (0.4 / 80) * (0.2 / 40) == pytest.approx(510.0)
    image = np.asarray(figures.isolux_picture(lux, PLANE, peak=float(lux.max())).axes[0].images[0].get_array())
    assert image.max() == pytest.approx(lux.max())
    assert np.argwhere(image[:, ::-1] > 0).mean(0) == pytest.approx(np.argwhere(lux > 0).mean(0))  # seen from the lens
    assert list(figures.draw_isolux(light, 1000.0, PLANE)) == ["isolux"]
    assert figures.draw_isolux(light, 1000.0, ANGLES) == {}


@pytest.mark.parametrize("lumens, expected", [(None, ["polar", "isocandela"]), (9.0, ["polar", "isocandela", "cone"])])
def test_a_lamp_of_known_flux_has_a_cone_diagram(lumens, expected):
    far = SimpleNamespace(lumens=lumens, sampler=None, table=lambda lens, rays: beam())
    drawn = figures.draw_far_field(far, None, ANGLES)
    assert list(drawn) == expected and all(len(data) < 300_000 for data in drawn.values())
    far.table = lambda lens, rays: Intensity("C", AROUND, ALONG, np.zeros((72, 91)))
    assert figures.draw_far_field(far, None, ANGLES) == {}


def test_scenes_over_directions_or_with_lumens_have_a_far_field():
    disk = bstcad.load("templates/disk.toml")
    angular = {"target": {"kind": "intensity", "x": [-9.0, 9.0], "y": [-9.0, 9.0], "pixels": 16, "uniform": True}}
    scenes = [disk.changed(each) for each in ({}, {"source.lumens": 100.0}, angular)]
    assert [Nominal(scene, None, scene.goals).has_far_field for scene in scenes] == [False, True, True]
