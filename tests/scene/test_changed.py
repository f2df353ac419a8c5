"""Scene.changed: what a script gives in Python's own values obeys the rules of the file; arrays as pictures."""

from pathlib import Path

import numpy as np
import pytest
import torch

from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.sources import Point
from bstcad.optics.surfaces import Plane, Sphere
from bstcad.scene.blank import Back, LensBlank
from bstcad.scene.picture import Picture
from bstcad.scene.scene import Scene, SceneError, load
from bstcad.scene.target import Target

TEMPLATES = Path(__file__).parent.parent.parent / "templates"
RAMP = np.linspace(0.0, 3.0, 32)[:, None] * np.ones((1, 32))  # dark at the top


@pytest.fixture(scope="module")
def thu():
    return load(TEMPLATES / "thu.toml", {"target.pixels": 16})


@pytest.mark.parametrize("name", ["thu", "portrait", "disk"])
def test_no_change_is_an_equal_scene(name):
    scene = load(TEMPLATES / f"{name}.toml")
    assert scene.changed({}) == scene and scene.changed({}) is not scene


@pytest.mark.parametrize(
    ("changes", "overrides"),
    [
        ({"lens.back.z": 21}, {"lens.back.z": "21"}),
        ({"target.text": "42"}, {"target.text": '"42"'}),  # a text stays one
        ({"target.sample": "camera"}, {"target.sample": "camera"}),  # of alternatives the other goes
        ({"lens.index": 1.5}, {"lens.index": "1.5"}),
        ({"lens.front": Sphere(8.0, -0.01)}, {"lens.front": '{ kind = "sphere", z = 8.0, curvature = -0.01 }'}),
        ({"lens.outline": {"shape": "circle", "diameter": 20}}, {"lens.outline": '{ shape = "circle", radius = 10 }'}),
        ({"target.x": (0, 100.0)}, {"target.x": "[0, 100.0]"}),
        ({"target.x": np.array([0.0, 100.0])}, {"target.x": "[0.0, 100.0]"}),
        ({"target.z": np.float64(900.0), "target.pixels": np.int64(24)}, {"target.z": "900.0", "target.pixels": "24"}),
        ({"target.z": torch.tensor(900.0)}, {"target.z": "900.0"}),
    ],
    ids=lambda value: ", ".join(value),
)
def test_a_change_is_what_the_command_line_would_set(thu, changes, overrides):
    assert thu.changed(changes) == load(TEMPLATES / "thu.toml", {"target.pixels": 16} | overrides)


def test_the_scene_itself_stays_as_it_is(thu):
    before = thu.toml()
    thu.changed({"target.x": [0.0, 10.0], "accept.rrmsd": None})
    assert thu.toml() == before


def test_none_takes_a_key_out(thu):
    assert thu.accept.rrmsd == 0.125 and thu.changed({"accept.rrmsd": None}).accept.rrmsd is None
    with pytest.raises(SceneError, match=r"^target\.z: missing"):
        thu.changed({"target.z": None})


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"lens.back.z": 3.0}, r"^lens\.back\.z: the lens is -5 mm thick .* move the back"),
        ({"lens.back.z": "21"}, r"^lens\.back\.z: '21' is not a number"),
        ({"lens.back.zz": 3.0}, r"^lens\.back\.zz: unknown key; the keys here are control_points"),
        ({"target.pixels": 8.5}, r"^target\.pixels: 8.5 is not a whole number"),
        ({"target.z": float("nan")}, r"^target\.z: nan is not a finite number"),
        ({"target.z": object()}, r"^target\.z: no scene holds a value of type object; give a number"),
        ({"target.x.y": 3}, r"^target\.x\.y: x is not a table"),
        ({"a..b": 3}, r"^a\.\.b: is no dotted key; write one such as lens\.back"),
        ({"target.image": "none.png"}, r"^target\.image: 'none.png' not found"),
        ({"target.image": [[0.0, 1.0]]}, r"^target\.image: .* is no file name"),
        ({"target.image": np.ones((4, 4, 3))}, r"shape \(4, 4, 3\) is no picture; give one of shape \(rows, columns\)"),
        ({"target.image": np.ones(4)}, r"shape \(4,\) is no picture"),
        ({"target.image": np.ones((0, 4))}, r"shape \(0, 4\) is no picture"),
        ({"target.image": np.ones((1, 70_000))}, "more than 64 million values or than 65535 along a side"),
        ({"target.image": np.array([[1.0, np.nan]])}, "the array has values that are not finite"),
        ({"target.image": np.array([[1.0, np.inf]])}, "the array has values that are not finite"),
        ({"target.image": np.array([[1.0, -1e-9]])}, "the array has negative values"),
        ({"target.image": np.zeros((4, 4))}, "the array is all zero"),
        ({"target.image": np.ones((4, 4), complex)}, "an array of complex128 is no picture"),
        ({"target.image": np.array([["a", "b"]])}, "an array of <U1 is no picture"),
    ],
)
def test_what_is_wrong_is_one_sentence(thu, changes, sentence):
    with pytest.raises(SceneError, match=sentence) as caught:
        thu.changed(changes)
    assert "\n" not in str(caught.value)


class TestArrays:
    def test_an_array_is_linear_irradiance_with_row_0_at_the_top(self, thu):
        target = thu.changed({"target.image": RAMP}).target
        flux = target.irradiance()
        wanted = RAMP.reshape(16, 2, 16, 2).mean((1, 3))
        assert np.allclose(flux, wanted / wanted.sum(), rtol=1e-6, atol=0)  # float32 in the file
        assert flux[-1].sum() > 50 * flux[0].sum()
        assert target.text is None

    @pytest.mark.parametrize("scale", [1e-30, 1e30])
    def test_on_any_scale(self, thu, scale):
        one, other = (thu.changed({"target.image": k * RAMP}).target.irradiance() for k in (1.0, scale))
        assert np.allclose(one, other, rtol=1e-6, atol=0)

    @pytest.mark.parametrize("kind", [bool, np.uint8, np.int32, np.float32])
    def test_of_any_real_numbers(self, thu, kind):
        assert thu.changed({"target.image": (RAMP > 1).astype(kind)}) == thu.changed({"target.image": RAMP > 1})

    def test_it_travels_with_its_scene_and_reloads_equal(self, thu, tmp_path):
        scene = thu.changed({"target.image": RAMP})
        picture = scene.target.image
        (tmp_path / picture.name).write_bytes(picture.data)
        (tmp_path / "scene.toml").write_text(scene.toml())
        again = load(tmp_path / "scene.toml")
        assert again == scene and np.array_equal(again.target.irradiance(), scene.target.irradiance())
        assert scene.changed({}) == scene and scene.changed({"target.z": 900.0}).target.image == picture

    def test_a_file_of_the_same_name_is_another_picture(self, thu, tmp_path, monkeypatch):
        scene = thu.changed({"target.image": RAMP})
        monkeypatch.chdir(tmp_path)
        with pytest.raises(SceneError, match="not found"):
            scene.changed({"target.image": scene.target.image.name})

    def test_a_picture_may_be_given_in_every_way(self, thu):
        array = thu.changed({"target.image": RAMP})
        picture = array.target.image
        assert isinstance(picture, Picture)
        whole = {"z": 1000, "x": [0, 400], "y": [0, 400], "pixels": 16, "image": RAMP, "seen_from": "behind"}
        for change in ({"target.image": picture}, {"target.image": torch.from_numpy(RAMP)}, {"target": whole}):
            assert thu.changed(change) == array
        whole["image"] = picture
        assert thu.changed({"target": Target(**whole)}) == array
        assert thu.changed({"target": Target(**whole | {"image": RAMP})}) == array


def test_a_scene_may_be_made_of_its_nouns():
    made = Scene(
        name="lamp",
        source=Point((0.0, 0.0, 0.0), 650.0),
        lens=LensBlank(material="PMMA", outline=Circle(10.0), front=Plane(15.0), back=Back(z=20.0, control_points=65)),
        target=Target(z=500.0, x=(-50.0, 50.0), y=(-50.0, 50.0), pixels=32, uniform=True, outline=Rectangle(80, 40)),
    )
    assert made.changed({}) == made
    with pytest.raises(SceneError, match=r"lens\.front\.z: '15' is not a number"):
        made.model_copy(update={"lens": made.lens.model_copy(update={"front": Plane("15")})}).changed({})
