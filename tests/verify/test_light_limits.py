"""Values of the light become checks: absolute ones by the flux of the source, each limit by itself."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.analysis.far_field import FarField
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.trace.measure import Light
from bstcad.report.record import Contents, of_json, plain
from bstcad.scene.scene import load
from bstcad.verify.light_limits import LightValue, light_values

LUMENS, ON_TARGET = 500.0, 0.4


@pytest.fixture(scope="module")
def disk():
    return load("templates/disk.toml", {"target.pixels": 40})


def values(scene, noise=0.0, tilt=0.0):
    """Values of even light over the whole target, brighter to the right by `tilt` of the mean at its edge."""
    [goal], chance = scene.goals, np.random.default_rng(1)
    even = goal.screen.cell_sizes * (1 + tilt * np.linspace(-1, 1, goal.screen.columns))
    sets = tuple(torch.from_numpy(even * (1 + noise * chance.normal(size=even.shape))) for _ in range(8))
    light = Light(even, 0.1, 0.0, rays=1, flux={}, sets=sets, on_screen=ON_TARGET)
    goal = Goal("target", goal.screen, goal.screen.cell_sizes / goal.screen.cell_sizes.sum())
    far = FarField((), scene.source.luminous_flux)
    return light_values(scene.accept, [goal], [light], lens=None, far=far)


def with_point(disk, **point):
    return disk.changed({"source.lumens": LUMENS, "accept.point": [{"at": [0.0, 0.0], **point}]})


def test_lux_are_lumens_per_square_metre(disk):
    """200 lm on 0.4 x 0.4 m are 1250 lx."""
    [value] = values(with_point(disk, unit="lx", least=1000.0, most=1240.0, radius=30.0), noise=0.01)
    assert value.value == pytest.approx(1250.0, rel=0.002) and 0 < value.standard_error < 3
    assert value.margin == pytest.approx(-10.0, abs=2.5) and value.unit == "lx"
    least, most = value.checks()
    assert (least.passed, most.passed) == (True, False) and least.name != most.name
    assert {check.id for check in (least, most)} == {"point"} and most.value == value.value


def test_candela_are_lumens_per_steradian(disk):
    """200 lm within the cap of a square of ±10 degrees by angles A: 2 sin(10°) · 20° in sr."""
    angles = {"kind": "intensity", "x": [-10.0, 10.0], "y": [-10.0, 10.0], "angles": "A", "pixels": 40, "uniform": True}
    scene = disk.changed({"target": angles, "source.lumens": LUMENS, "accept.point": [
        {"at": [3.0, -5.0], "unit": "cd", "least": 1.0, "radius": 2.0}
    ]})  # fmt: skip
    solid_angle = 2 * np.sin(np.radians(10.0)) * np.radians(20.0)
    [value] = values(scene)
    assert value.value == pytest.approx(200.0 / solid_angle, rel=1e-6) and value.unit == "cd"


def test_a_relative_value_needs_no_flux(disk):
    scene = disk.changed({"accept.point": [{"at": [100.0, 0.0], "least": 1.2, "name": "right"}]})
    [value] = values(scene, tilt=0.5)
    assert value.value == pytest.approx(1.25, rel=0.03) and "right" in value.name


def test_a_miss_within_the_noise_is_said(disk):
    noisy = values(with_point(disk, unit="lx", least=1250.0, radius=10.0), noise=0.2)[0]
    [check] = replace(noisy, least=noisy.value + noisy.standard_error).checks()
    assert not check.passed and "standard errors" in check.where
    [check] = replace(noisy, least=noisy.value + 9 * noisy.standard_error).checks()
    assert not check.passed and not check.where


def test_uniformity_and_cut_off_have_their_limits(disk):
    scene = disk.changed({
        "accept.uniformity": {"min_to_mean": 0.8, "min_to_max": 0.2, "radius": 30.0},
        "accept.cut_off": {"at": 0.0, "most": 0.1},
    })  # fmt: skip
    to_mean, to_max, cut = values(scene, tilt=0.5)
    assert to_mean.value == pytest.approx(1 - 0.5 * 0.85, abs=0.02) and to_mean.margin < 0
    assert to_max.value == pytest.approx(0.575 / 1.425, abs=0.02) and to_max.margin > 0
    assert cut.value == pytest.approx(0.0, abs=1e-9) and cut.margin == pytest.approx(0.1)
    wide = disk.changed({"accept.uniformity": {"min_to_mean": 0.1, "radius": 300.0}})
    [none] = values(wide)
    [check] = none.checks()
    assert none.value is None and check.value is None and not check.passed  # no such disc fits


def test_values_are_read_back_as_written():
    value = LightValue("test point 1", "point", 1.0, 0.1, least=0.5, most=None, unit="lx", margin=0.5)
    assert of_json(json.dumps(plain(value)), LightValue) == value
    assert "values" in Contents.__dataclass_fields__
