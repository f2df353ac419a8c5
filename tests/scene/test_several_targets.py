"""Several targets in one scene: their keys, their sentences and their images; one target is written as ever."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from PIL import Image

from bstcad.designs.folder import scene_files
from bstcad.optics.surfaces.outlines import Circle
from bstcad.scene import schema
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import load

HERE = Path(__file__).parent
EVERY = sorted((HERE.parent.parent / "templates").glob("*.toml"))
TEMPLATES = [path for path in EVERY if "[[target]]" not in path.read_text(encoding="utf-8")]
THU, THREE = HERE.parent.parent / "templates" / "thu.toml", HERE / "three_targets.toml"
RAMP = np.linspace(0.0, 3.0, 32)[:, None] * np.ones((1, 32))


@pytest.fixture(scope="module")
def three():
    return load(THREE)


def through_its_files(scene, folder):
    """The scene as it loads from its own files."""
    folder.mkdir(exist_ok=True)
    for name, data in scene_files(scene).items():
        (folder / name).write_bytes(data)
    return load(folder / "scene.toml")


# ---- files -----------------------------------------------------------------------------------------------------------


def test_three_targets_go_through_their_file_unchanged(three, tmp_path):
    again = through_its_files(three, tmp_path)
    assert again == three == three.changed({}) and again.toml() == three.toml()
    assert [target.z for target in three.targets] == [100.0, 200.0, 400.0] and three.target is three.targets[0]
    assert [goal.weight for goal in three.goals] == [1.0, 2.5, 1.0]
    assert three.targets[1].outline == Circle(14.0)  # given by its diameter
    tables = tomllib.loads(three.toml())["target"]
    assert [table.get("weight") for table in tables] == [None, 2.5, None]
    assert all(target.irradiance().sum() == pytest.approx(1.0, abs=1e-12) for target in three.targets)


@pytest.mark.parametrize("template", TEMPLATES, ids=lambda path: path.stem)
def test_one_target_is_written_as_one_table_without_the_keys_that_came_with_several(template, tmp_path):
    scene = load(template)
    assert through_its_files(scene, tmp_path).toml() == scene.toml()
    tables = tomllib.loads(scene.toml())
    assert isinstance(tables["target"], dict) and "weight" not in tables["target"]
    assert ("profile" in tables["target"]) == (scene.target.profile is not None)
    assert "optimise" not in tables["lens"]["back"] and scene.target_keys == ("target",)
    assert scene.model_dump(mode="json")["target"]["z"] == scene.target.z and len(scene.targets) == 1


def test_a_list_of_one_is_one_target(tmp_path):
    listed = tmp_path / "scene.toml"
    listed.write_text(THU.read_text().replace("[target]", "[[target]]"))
    scene = load(THU)
    assert load(listed) == scene and load(listed).toml() == scene.toml()
    assert scene.changed({"target": [scene.target]}) == scene == scene.changed({"target": scene.targets})
    with pytest.raises(SceneError, match="^target.pixels: 3 is not between") as refused:
        listed.write_text(re.sub("pixels = [0-9]+", "pixels = 3", listed.read_text()))
        load(listed)
    line = listed.read_text().splitlines().index(next(x for x in listed.read_text().splitlines() if "pixels = 3" in x))
    assert refused.value.__notes__ == [f"line {line + 1} of {listed}"]


def test_an_editor_accepts_one_and_several():
    validator = jsonschema.Draft202012Validator(schema.schema())
    tables = tomllib.loads(THREE.read_text())
    assert not list(validator.iter_errors(tables))
    for wrong in ([], tables["target"] * 3, [{"z": 1.0}], 3):
        assert list(validator.iter_errors(tables | {"target": wrong}))


# ---- changes ---------------------------------------------------------------------------------------------------------


def test_one_of_several_is_changed_by_its_number(three):
    changes = {"target[1].text": "HI", "target[0].pixels": 16, "target[1].outline": None, "target[2].profile.order": 4}
    scene = three.changed(changes)
    assert (scene.targets[1].text, scene.targets[1].uniform, scene.targets[1].outline) == ("HI", None, None)
    assert scene.target.pixels == 16 and scene.targets[2].profile.order == 4.0
    texts = {"target[1].text": "HI", "target[0].pixels": "16", "target[2].profile.order": "4"}
    assert load(THREE, texts).changed({"target[1].outline": None}) == scene
    by_array = three.changed({"target[1].image": RAMP})
    assert by_array.targets[1].image.name == "array.tif" and by_array.targets[0] == three.target
    round_one = three.changed({"target[0].outline": {"shape": "circle", "diameter": 10.0}})
    assert round_one.target.outline == Circle(5.0) == three.changed({"target[0].outline": Circle(5.0)}).target.outline


def test_a_target_is_replaced_added_and_taken_out(three):
    other = three.targets[2].model_copy(update={"z": 800.0})
    assert three.changed({"target[3]": other}).targets == (*three.targets, other)
    assert three.changed({"target[1]": other}).targets == (three.targets[0], other, three.targets[2])
    assert three.changed({"target[1]": None}).targets == (three.targets[0], three.targets[2])
    alone = three.changed({"target[2]": None}).changed({"target[0]": None})
    assert alone.targets == (three.targets[1],) and "[[target]]" not in alone.toml()
    assert alone.changed({"target[0].z": 210.0}) == alone.changed({"target.z": 210.0})
    assert load(THU, {"target[1]": {**tomllib.loads(THU.read_text())["target"], "z": 2000.0}}).targets[1].z == 2000.0


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"target.pixels": 16}, r"target.pixels: there are 3 \[\[target\]\] tables; write the number"),
    ({"target[3].z": 16}, r"target\[3\].z: there is no target\[3\], as the last one is target\[2\]; count from 0"),
    ({"target[3]": None}, r"target\[3\]: there is no target\[3\], as the last"),
    ({"tolerance[0].limit": 1.0}, r"tolerance\[0\].limit: there is no tolerance\[0\], as the list is empty"),
    ({"target[x].z": 16}, r"target\[x\].z: is not a dotted key"),
    ({"target[1].z": 1e9}, r"target\[1\].z: 1e\+09 mm is not between"),
    ({"target[2].pixel": 16}, r"target\[2\].pixel: unknown key; did you mean 'pixels'"),
    ({"target[0].weight": 0.0}, r"target\[0\].weight: 0 is not between 1e-06 and 1000000"),
    ({"target[1].uniform": None}, r"target\[1\]: needs exactly one of text, image, sample, uniform, profile, and has"),
    ({"target[1].outline.radius": 50.0}, r"target\[1\].outline: is larger than the target along x"),
    ({"target[1].z": 20.0, "target[1].tilt": None}, r"target\[1\].z: the target at z = 20 is not behind the lens"),
    ({"target[1].tilt": [0.0, 88.0]}, r"target\[1\].tilt: an edge of the target|.*cuts the lens"),
    ({"target[2].z": 100.0}, r"target\[2\].z: the target is in the plane of target\[0\]; move one of them along z"),
    ({"target[2].z": 200.0, "target[2].tilt": [0.0, 20.0]}, r"target\[2\].z: .* in the plane of target\[1\]"),
    ({"target[1].image": np.zeros((4, 4))}, r"target\[1\].image: the array is zero"),
    ({"target": []}, "target: has 0 values"),
    ({"target": [3, 4]}, r"target\[0\]: 3 is not a table"),
], ids=str)  # fmt: skip
def test_a_fault_is_told_of_the_target_that_has_it(three, changes, sentence):
    with pytest.raises(SceneError, match=f"^(?:{sentence})") as refused:
        three.changed(changes)
    assert "\n" not in str(refused.value) and "table." not in str(refused.value)


def test_more_targets_than_are_served_are_refused(three):
    many = [three.target.model_copy(update={"z": 100.0 + 10 * k}) for k in range(9)]
    assert len(three.changed({"target": many[:8]}).targets) == 8
    with pytest.raises(SceneError, match="^target: has 9 values"):
        three.changed({"target": many})


def test_warnings_and_remarks_name_their_target(three):
    scene = three.changed({"target[1].sample": "camera"})
    assert [w for w in scene.warnings() if "fit" in w][0].startswith("target[1].fit: ")
    scene = three.changed({"target[0].x": [-0.1, 0.1], "target[0].y": [-0.1, 0.1]})
    assert any(w.startswith("target[0].x: 0.2 mm wide; are these metres?") for w in scene.warnings())
    [compromise] = three.warnings()
    assert compromise.startswith("target: two tailored faces cannot meet 3 goals exactly")


def test_a_picture_that_parallel_light_repeats_is_one_goal():
    scene = load(Path(__file__).parents[2] / "templates" / "beam_shaper.toml")
    assert len(scene.targets) == 2 and scene.warnings() == ()
    for change in ({"wavefront.direction": [0.1, 0.0, 1.0]}, {"target[1].profile.radius": 5.0}):
        [compromise] = scene.changed(change).warnings()
        assert compromise.startswith("target: two tailored faces cannot meet 3 goals")


@pytest.mark.parametrize(("more", "key"), [
    ({"tailoring.quality": "paper"}, "tailoring.quality: the paper's procedure"),
    ({"tailoring.method": "integration"}, "tailoring.method: point-by-point integration"),
])  # fmt: skip
def test_methods_for_one_picture_refuse_several_goals(three, more, key):
    one = load(THU)
    assert one.changed(more)
    wave = {"wavefront": {"kind": "plane", "z": 1200.0}}
    for goals, number in (({"target": three.targets}, 3), (wave, 2)):
        with pytest.raises(SceneError, match=f"^{key} works for one picture, and the scene has {number} goals; choos"):
            one.changed(goals | more)


# ---- images ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def photos(tmp_path):
    """A scene file of three images, two of them of one name and one that is the first again."""
    for k, folder in enumerate(("a", "b")):
        (tmp_path / folder).mkdir()
        values = np.random.default_rng(k).integers(0, 256, (40, 40), dtype=np.uint8)
        Image.fromarray(values).save(tmp_path / folder / "photo.png")
    text = THREE.read_text().replace('text = "THU"', 'image = "a/photo.png"')
    text = text.replace("uniform = true", 'image = "b/photo.png"')
    text = re.sub("profile = .*", 'image = "a/photo.png"', text)
    (tmp_path / "scene.toml").write_text(text)
    return tmp_path / "scene.toml"


def test_images_of_one_name_lie_beside_each_other(photos, tmp_path):
    scene = load(photos)
    assert [target.image.name for target in scene.targets] == ["photo.png", "photo-2.png", "photo.png"]
    assert scene_files(scene).keys() == {"scene.toml", "photo.png", "photo-2.png"}
    again = through_its_files(scene, tmp_path / "copy")
    assert again == scene == scene.changed({}) and again.toml() == scene.toml()
    for one, other in zip(scene.targets, again.targets, strict=True):
        np.testing.assert_array_equal(one.irradiance(), other.irradiance())
    arrays = scene.changed({"target[0].image": RAMP, "target[1].image": RAMP[::-1]})
    assert [target.image.name for target in arrays.targets] == ["array.tif", "array-2.tif", "photo.png"]
    assert through_its_files(arrays, tmp_path / "arrays") == arrays
