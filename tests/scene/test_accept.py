"""Limits of values of the light, and the effect that a stated flux brings with it."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from bstcad.app.form import form
from bstcad.app.scene_text import changed as text_changed
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import load

DISK = Path("templates/disk.toml")
TEXT = DISK.read_text(encoding="utf-8")
ANGLES = {"kind": "intensity", "x": [-4.0, 4.0], "y": [-4.0, 4.0], "pixels": 96, "uniform": True}


@pytest.fixture(scope="module")
def disk():
    return load(DISK, {"target.pixels": 32})


POINT = {"at": [0.0, 0.0], "least": 0.5}
WINDOW = {
    "kind": "window", "z": 60.0, "thickness": 3.0, "material": "N-BK7",
    "outline": {"shape": "circle", "diameter": 200.0},
}  # fmt: skip
WRONG = {
    "flux unknown": ({"accept.point": [POINT | {"unit": "lx"}]}, r"point\[0\]\.unit: lx needs the flux .*lumens"),
    "candela on a plane": ({"accept.point": [POINT | {"unit": "cd"}]}, r'unit: .* not measured in cd; .* "lx"'),
    "lux over directions": (
        {"target": ANGLES, "source.lumens": 9.0, "accept.point": [POINT | {"unit": "lx"}]}, r'in lx; .* or "cd"'
    ),
    "beside the target": ({"accept.point": [POINT, POINT | {"at": [0.0, 201.0]}]}, r"point\[1\]\.at: y = 201 is outs"),
    "no limit": ({"accept.point": [{"at": [0.0, 0.0]}]}, r"point\[0\]: has no limit; give least, most or both"),
    "crossed limits": ({"accept.point": [POINT | {"most": 0.4}]}, r"least: 0\.5 is larger than most = 0\.4"),
    "no such target": ({"accept.point": [POINT | {"target": 1}]}, r"point\[0\]\.target: the scene has no target\[1\]"),
    "less than a pixel": ({"accept.point": [POINT | {"radius": 2.0}]}, r"radius: 2 mm is less than 0\.5 pixels"),
    "uniformity without limit": ({"accept.uniformity": {"radius": 9.0}}, "accept.uniformity: has no limit"),
    "step below a pixel": (
        {"target": ANGLES | {"pixels": 40}, "accept.cut_off": {"at": 2.5, "least": 0.1}}, "step: a step of 0.1 degrees"
    ),
    "line beside": ({"accept.cut_off": {"at": -300.0, "least": 0.1}}, "cut_off.at: -300 is outside of the target"),
    "glare behind a window": ({"accept.glare": [1.0, 1.0, 1.0], "behind": [WINDOW]}, "accept.glare: .*behind"),
    "control characters": ({"accept.point": [POINT | {"name": "a\x1b[2J"}]}, "name: must be one line"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_a_limit_that_does_not_apply_is_refused(disk, case):
    changes, words = WRONG[case]
    with pytest.raises(SceneError, match=words):
        disk.changed(changes)


def test_points_go_through_the_file(disk, tmp_path):
    points = [POINT | {"name": "centre", "unit": "lx", "most": 2.0, "radius": 20.0}, POINT]
    made = disk.changed({"source.lumens": 100.0, "accept.point": points, "accept.uniformity.min_to_mean": 0.4})
    (tmp_path / "scene.toml").write_text(made.toml(), encoding="utf-8")
    again = load(tmp_path / "scene.toml")
    assert again == made and again.limits_light and again.effects == made.effects
    assert (
        "accept.point" not in disk.toml() and "point = []" not in disk.toml()
    )  # an earlier scene is written as before


def test_a_point_alone_limits_the_light(disk):
    bare = disk.changed({"accept.rrmsd": None})
    assert not bare.limits_light and bare.changed({"accept.point": [POINT]}).limits_light


# ---- the effect of a stated flux -------------------------------------------------------------------------------------


def test_a_stated_flux_brings_the_losses_of_a_lens(disk):
    known = disk.changed({"source.lumens": 100.0})
    assert disk.effects == () and [effect.kind for effect in known.effects] == ["fresnel"]
    assert known.changed({"source.lumens": None}).effects == ()
    assert known.changed({"lens.back.z": 21.0}).effects == known.effects
    without = disk.changed({"source.lumens": 100.0, "effects": []})
    assert without.effects == () and without.changed({"lens.back.z": 21.0}).effects == ()
    stated = disk.changed({"source.lumens": 100.0, "effects": [{"kind": "absorption"}]})
    assert [effect.kind for effect in stated.effects] == ["absorption"]


def test_a_mirror_has_no_losses_without_its_metal(disk):
    mirror = {"lens.back.reflect": True, "lens.material": None, "source.position": [0.0, 0.0, 60.0]}
    front = {"lens.front": {"kind": "plane", "z": 0.0}, "lens.back.z": 6.0}
    assert disk.changed({"source.lumens": 100.0, **mirror, **front}).effects == ()


# ---- the form --------------------------------------------------------------------------------------------------------


def test_the_page_adds_a_point(disk):
    """The button's table is one of a scene, and its fields have units and limits."""
    data = tomllib.loads(TEXT)
    [addition] = [
        each for group in form(data).groups() for each in group.additions if each.key.startswith("accept.point")
    ]
    assert addition.label == "Add a test point"
    data["accept"]["point"] = [dict(addition.value)]
    assert disk.changed({"accept.point": data["accept"]["point"]}).accept.point[0].at == (0.0, 0.0)
    known = {field.key: field for field in form(data).fields()}
    assert known["accept.point[0].least"].value == "0.5"
    assert {"accept.point[0].at", "accept.point[0].unit", "accept.uniformity.min_to_mean"} <= known.keys()
    written = tomllib.loads(text_changed(TEXT, "accept.point[0]", dict(addition.value)))
    assert written["accept"] == data["accept"]


def test_a_limit_on_half_pixels_is_a_limit_on_the_light_and_goes_through_the_file(disk, tmp_path):
    free = disk.changed({"accept": {}})
    made = free.changed({"accept.rrmsd_half": 0.1})
    (tmp_path / "scene.toml").write_text(made.toml(), encoding="utf-8")
    assert load(tmp_path / "scene.toml").accept.rrmsd_half == 0.1
    assert made.limits_light and not free.limits_light
    with pytest.raises(SceneError, match="accept.rrmsd_half"):
        disk.changed({"accept.rrmsd_half": -1.0})
