"""Lenses for measured beams, diodes and intensities at full size: RRMSDs by rays through the STEP file."""

from __future__ import annotations

import numpy as np
import pytest

import bstcad
from bstcad.optics.directions import Directions
from bstcad.photometry import eulumdat
from bstcad.photometry.intensity import Luminaire, checked
from bstcad.scene.scene import load
from tests.benchmarks.cold import TEMPLATES

pytestmark = pytest.mark.bench


def designed(scene, folder):
    design = bstcad.design(scene, progress=False)
    report = design.write(folder, progress=False)
    print(f"\n{scene.name}: RRMSD {report.rrmsd:.4f}, {report.passed}")
    return design, report


def hot_beam():
    """A flat beam with a slope of 30 % across it and a hot spot of its own irradiance, 15 mm to each side."""
    x, y = np.meshgrid(np.linspace(-15, 15, 480), np.linspace(15, -15, 480))
    spot = np.exp(-2 * ((x - 4) ** 2 + (y + 3) ** 2) / 2.5**2)
    return (1 + 0.3 * x / 24 + spot) / (1 + np.exp((np.hypot(x, y) - 13.5) / 0.15))


def test_letters_from_a_beam_with_a_hot_spot(tmp_path):
    """RRMSD <= 0.03 judged with that beam; the lens for the ideal beam has more than 0.1 there."""
    profile = {"image": hot_beam(), "width": 30.0, "origin": "picture"}
    ideal = load(TEMPLATES / "thu.toml")
    real = ideal.changed({"source.profile": profile})
    _, report = designed(real, tmp_path / "real")
    assert report.rrmsd <= 0.03
    lens = bstcad.design(ideal, progress=False).lens
    light = bstcad.measure(lens, real.channels(), real.target.screen, real.target.irradiance())
    print(f"the lens for the ideal beam: RRMSD {light.rrmsd:.4f}")
    assert light.rrmsd > 0.1


def test_a_diode_to_an_even_line(tmp_path):
    """35 x 10 degrees to a line of 300 x 10 mm: RRMSD <= 0.05."""
    scene = load(TEMPLATES / "disk.toml").changed({
        "name": "line", "lens.back.control_points": 513,
        "source": {"kind": "point", "profile": "gaussian", "half_angle_1e2": [35.0, 10.0]},
        "target.x": [-160.0, 160.0], "target.y": [-20.0, 20.0], "target.pixels": [512, 64], "target.outline": None,
        "target.profile": {"shape": "rectangle", "width": 300.0, "height": 20.0},
    })  # fmt: skip
    _, report = designed(scene, tmp_path / "line")
    assert report.rrmsd <= 0.05


def wanted():
    """A bright field to one side, with an L as its rim's notch: asymmetric, in steps of 1 x 5 degrees."""
    planes, along = np.arange(0.0, 360.0, 5.0), np.arange(0.0, 90.5, 1.0)
    c, g = np.radians(planes)[:, None], along[None]
    x, y = g * np.cos(c), g * np.sin(c)
    field = 1 / (1 + np.exp((np.hypot(x / 25, (y - 3) / 16) - 1) / 0.08))
    return checked("C", planes, along, 800 * field * (1 + 0.4 * np.tanh(x / 10)))


def test_an_intensity_file_is_reached(tmp_path):
    """RRMSD <= 0.03 on the pixels of the target, for an asymmetric .ldt."""
    (tmp_path / "wanted.ldt").write_bytes(eulumdat.write(wanted(), Luminaire("wanted")))
    scene = load(TEMPLATES / "disk.toml").changed({
        "name": "intensity", "lens.back.control_points": 513,
        "target": {"kind": "intensity", "x": [-32.0, 32.0], "y": [-24.0, 24.0], "pixels": 256,
                   "intensity": str(tmp_path / "wanted.ldt")},
    })  # fmt: skip
    assert isinstance(scene.target.screen.plane, Directions)
    _, report = designed(scene, tmp_path / "intensity")
    assert report.rrmsd <= 0.03
