"""A lens in another light: a law on its own light, a plate for the sun under a lamp, and each refusal."""

import json

import numpy as np
import pytest

import bstcad
from bstcad import cli
from bstcad.api import Design
from bstcad.manufacture.tolerance.lit_by import LIGHTS, lit_by, scene_lit_by
from bstcad.optics.trace.measure import Effort, measure
from bstcad.scene.errors import SceneError
from bstcad.verify.nominal import Nominal
from tests import suite
from tests.efforts import designed_quickly

PLATE = {
    "name": "plate", "source": {
        "kind": "collimated", "wavelength": 550.0, "divergence": 0.53, "profile": "uniform",
        "aperture": {"shape": "rectangle", "width": 40.0, "height": 40.0},
    },
    "lens": {
        "material": "PMMA", "outline": {"shape": "rectangle", "width": 40.0, "height": 40.0},
        "front": {"kind": "plane", "z": 0.0}, "back": {"kind": "bspline", "z": 5.0, "control_points": 33},
    },
    "target": {"z": 205.0, "x": [-20.0, 20.0], "y": [-20.0, 20.0], "pixels": 32, "text": "O"},
    "tailoring": {"quality": "draft", "rays": 96},
}  # fmt: skip


@pytest.fixture(scope="module")
def plate():
    return Design(designed_quickly(bstcad.load("templates/disk.toml").changed(PLATE)))


def test_the_light_of_the_design_changes_nothing(plate):
    found = plate.lit_by("sun")
    [goal] = found.goals
    assert np.abs(goal.lit - goal.designed).max() < 1e-3 * goal.target.max()
    assert found.distance is None and found.facts()["goals"][0]["rrmsd"] == goal.rrmsds[1]


@pytest.mark.parametrize("distance", suite.in_turns([60.0, 500.0], 2))
def test_another_light_is_that_of_its_rays(plate, distance):
    """The picture of a phone's light by tubes and a blur, against rays from points of the light."""
    found = plate.lit_by("phone", distance=distance)
    scene, away = scene_lit_by(plate.scene, "phone", distance)
    assert away == distance and scene.source.position[2] == -distance
    light = measure(plate.lens, scene.channels(64), scene.target.screen, plate.target, Effort(1024, witness=False))
    picture = light.picture / light.picture.sum()
    [goal] = found.goals
    differs = np.sqrt(((goal.lit - picture) ** 2).sum() / (picture**2).sum())
    assert differs < 0.06 and goal.rrmsds[1] > 1.5 * goal.rrmsds[0]


def test_a_lamp_far_away_is_parallel_light(plate):
    near, far = (plate.lit_by("led", distance=distance).goals[0].rrmsds[1] for distance in (100.0, 1e5))
    assert far < near


def test_what_does_not_go_is_a_sentence(plate):
    with pytest.raises(SceneError, match="--lit-by sum: no such light; give one of sun"):
        plate.lit_by("sum")
    with pytest.raises(SceneError, match="the sun has no distance"):
        plate.lit_by("sun", distance=3.0)
    assert set(LIGHTS) == {"sun", "lamp", "led", "phone"}


def test_a_mirror_is_lit_from_above():
    mirror = {"lens.material": None, "lens.back.reflect": True, "source.z": 100.0, "source.aperture.width": 38.0}
    scene = bstcad.load("templates/disk.toml").changed(PLATE).changed(mirror)
    flat = Nominal(scene, scene.as_mounted(scene.flat_lens(33)), scene.goals)
    for name in LIGHTS:
        [goal] = lit_by(flat, name).goals
        assert goal.lit.any(), name


@suite.in_turn(0, 2)
def test_a_plan_tells_it_and_draws_it(tmp_path, capsys, monkeypatch):
    from tests.planning.conftest import typical_pilot

    monkeypatch.setattr("bstcad.planning.plan.run_pilot", typical_pilot)
    path, png = tmp_path / "plate.toml", tmp_path / "lit.png"
    path.write_text(bstcad.load("templates/disk.toml").changed(PLATE).toml(), encoding="utf-8")
    assert cli.run(["plan", str(path), "--json", "--lit-by", "phone", "--lit-png", str(png)]) == 0
    found = json.loads(capsys.readouterr().out)["lit"]
    assert found["light"] == "phone" and found["distance"] == 500.0 and png.exists()
    assert found["goals"][0]["rrmsd"] > found["goals"][0]["rrmsd_designed"]
    assert cli.run(["plan", str(path), "--lit-at", "3"]) == 2 and "--lit-by" in capsys.readouterr().err
