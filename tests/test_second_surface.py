"""A mirror behind glass, whose rear reflects: light crosses the tailored back before and behind the tailored rear."""

import json

import numpy as np
import pytest

import bstcad
from bstcad.optics.lens.interfaces import Reflect, Refract
from bstcad.scene.effects import Fresnel
from bstcad.verify.judges.comparison import JudgeEffort, compare
from tests import suite
from tests.conftest import quick_effort
from tests.efforts import LITTLE, designed_quickly
from tests.scenes import designed
from tests.test_seen import letter

EFFORT = quick_effort()
BEHIND_GLASS = {
    "source": {"kind": "collimated", "aperture": {"shape": "circle", "radius": 27.0}, "z": 100.0},
    "lens.material": "PMMA", "lens.front": {"kind": "bspline", "z": 0.0, "optimise": True, "reflect": True},
    "lens.back": {"kind": "bspline", "z": 12.0, "control_points": 33}, "lens.front.control_points": 41,
    "target.sample": None, "target.pixels": 48, "tailoring.quality": "draft", "tailoring.rays": 256,
    "tailoring.transport_grid": 64, "tailoring.stage2_iterations": 16, "accept": {"rrmsd": 0.25},
}  # fmt: skip


def scene_of(**changes):
    return bstcad.load("templates/mirror.toml").changed(BEHIND_GLASS | {"target.image": letter() / 255.0} | changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("glass") / "out"
    designed(scene_of(), EFFORT, place, tailoring=LITTLE)
    return place


@suite.in_turn(1, 3)
def test_its_proof_through_the_file_knows_all_passes(folder):
    report = json.loads((folder / "report.json").read_text())
    assert report["passed"] and report["optic"] == "mirror" and report["rrmsd"] < 0.25
    assert report["stability"]["tir_margin_deg"] > 0 and report["flux"]["on target"] > 0.95
    design = bstcad.open(folder)
    assert [type(interface.law) for interface in design.lens.interfaces] == [Refract, Reflect, Refract]
    assert [net.shape for net in design.lens.nets] == [(33, 33), (41, 41)]
    text = (folder / "prescription.txt").read_text(encoding="utf-8")
    assert "Mirror face: light meets it" in text and "Back: light enters and leaves" in text


@pytest.mark.bench  # batoid comes with the extra `judges`
def test_batoid_sees_the_same_picture(folder):
    design = bstcad.open(folder)
    scene = design.scene
    found = compare(
        "batoid", design.lens, scene.verification_channels(), *scene.goals, effort=JudgeEffort(100_000), seed=1
    )
    assert found.judge.agrees, found.judge


def test_stage_1_aims_through_the_flat_back():
    """The reflecting face alone is shaped: the wall shows the letter upright before stage 2."""
    scene = scene_of(**{"lens.back.optimise": False, "tailoring.levels": [17, 33], "tailoring.stage2_iterations": 1})
    design = designed_quickly(scene)
    assert not design.lens.back.heights.any() and design.lens.back.shape == (33, 33)
    light = bstcad.measure(design.lens, scene.channels(), scene.target.screen, scene.target.irradiance(), EFFORT)
    assert np.corrcoef(light.picture.ravel(), scene.target.irradiance().ravel())[0, 1] > 0.9


def test_its_metal_is_seen_from_the_glass():
    """Both crossings of the back and the metal between them take light."""
    scene = scene_of(effects=[{"kind": "fresnel", "metal": "Al"}])
    assert isinstance(scene.effects[0], Fresnel)
    [channel] = scene.channels()
    enter, mirror, leave = channel.through(scene.flat_lens(9)).interfaces
    assert [loss.line for face in (enter, mirror, leave) for loss in face.losses] == [
        "reflected at the faces", "absorbed by the mirror", "reflected at the faces",
    ]  # fmt: skip
