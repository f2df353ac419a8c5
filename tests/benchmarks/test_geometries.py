"""Recorded designs of pictures in geometries that no template has (geometry_scenes.py), held to bounds."""

import json
import statistics

import pytest

from tests.benchmarks.geometry_scenes import FIGURES, SCENES, SMOOTH, scene_of

KNOWN = json.loads(FIGURES.read_text())


@pytest.mark.bench
def test_every_scene_is_on_record():
    assert set(KNOWN) == set(SCENES)
    assert all(scene_of(name).tailoring.quality == "standard" for name in SCENES)


@pytest.mark.bench
def test_half_of_them_are_below_a_twentieth_and_none_above_an_eighth():
    figures = {name: found["rrmsd"] for name, found in KNOWN.items()}
    assert statistics.median(figures.values()) <= 0.05
    assert {name: value for name, value in figures.items() if value > 0.125} == {}


@pytest.mark.bench
@pytest.mark.parametrize("name", [name for name, (_, picture) in SCENES.items() if picture in SMOOTH])
def test_smooth_pictures(name):
    assert KNOWN[name]["rrmsd"] <= 0.012
