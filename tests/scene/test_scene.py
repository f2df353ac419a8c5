"""Scenes: what a file or a script says is what the engine gets, and a scene goes through its file unchanged."""

import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bstcad.cad.mounting import wire
from bstcad.optics.lens.losses import CoatingLayer, FresnelLoss
from bstcad.optics.lens.media import refractive_index
from bstcad.optics.receivers.receivers import LevelPlane, TiltedPlane
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Recess, Sphere
from bstcad.optics.trace.trace import ghost_light
from bstcad.planning.effect_estimates import simulated
from bstcad.scene.accept import Accept
from bstcad.scene.beam import Collimated
from bstcad.scene.blank import Back, LensBlank
from bstcad.scene.errors import SceneError, line_of, toml_positions
from bstcad.scene.fronts import PlaneFront, SphereFront
from bstcad.scene.lamp import Point
from bstcad.scene.mount import LENS_COLOUR, MIRROR_COLOUR, Box, CircleRim, Part
from bstcad.scene.picture import Picture
from bstcad.scene.quality import PRESETS, VERIFICATION_POINTS, Tailoring, coarse_to_fine
from bstcad.scene.scene import Scene, load
from bstcad.scene.target import Target

TEMPLATES = Path(__file__).parent.parent.parent / "templates"
ALL = sorted(TEMPLATES.glob("*.toml"))
THU, DISK, MIRROR = (TEMPLATES / f"{name}.toml" for name in ("thu", "disk", "mirror"))
RGB = "[[486.1, 1.0], [587.6, 2.0], [656.3, 1.0]]"


@pytest.fixture
def photo(tmp_path):
    """A scene file beside a picture of its own."""
    values = np.random.default_rng(0).integers(0, 256, (40, 30, 3), dtype=np.uint8)
    Image.fromarray(values).save(tmp_path / "My photo.png")
    scene = tmp_path / "scene.toml"
    scene.write_text(THU.read_text().replace('text = "THU"', 'image = "My photo.png"'))
    return scene


def through_its_file(scene, folder):
    """The scene as it loads from its own file, beside its picture."""
    folder.mkdir(exist_ok=True)
    for name, file in scene.files.items():
        (folder / name).write_bytes(file.copy)
    (folder / "scene.toml").write_text(scene.toml(), encoding="utf-8")
    return load(folder / "scene.toml")


# ---- files -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("template", ALL, ids=lambda path: path.stem)
def test_a_template_is_the_same_scene_once_resolved_and_changed_in_nothing(template, tmp_path):
    scene = load(template)
    assert through_its_file(scene, tmp_path) == scene == scene.changed({})
    assert scene.name == template.stem and scene.warnings() == ()
    assert scene.target.irradiance().sum() == pytest.approx(1.0, abs=1e-12) and scene.target.irradiance().min() >= 0


KEPT = [
    (THU, {"source.wavelength": RGB}, "source.wavelength", ((486.1, 1.0), (587.6, 2.0), (656.3, 1.0))),
    (THU, {"source.divergence": "0.53"}, "source.divergence", 0.53),
    (THU, {"source.divergence": "[0.5, 0.2]", "source.rotate": "30"}, "source.divergence", (0.5, 0.2)),
    (THU, {"source.tilt": "[3.0, -2.0]", "source.z": "-50"}, "source.tilt", (3.0, -2.0)),
    (THU, {"source.centre": "[1.0, 0.5]"}, "source.centre", (1.0, 0.5)),
    (DISK, {"source.width": "1", "source.height": "0"}, "source.height", 0.0),
    (DISK, {"source.real_diameter": "2"}, "source.real_diameter", 2.0),
    (THU, {"target.x": [0, 300], "target.y": [0, 150], "target.pixels": "[50, 40]"}, "target.pixels", (50, 40)),
    (DISK, {"part.number": "LE-017", "part.author": "Änne O'Hara", "part.date": "2031-05-06"}, "part.number", "LE-017"),
    (DISK, {"mount": {
        "rim": {"shape": "rectangle", "width": 15.0, "height": 14.0, "corner_radius": 2.0}, "draft": 1.5, "bevel": 0.1,
        "flange": {"outline": {"shape": "circle", "diameter": 40.0}, "z": 15.5, "thickness": 1.0,
                   "screws": {"count": 3, "diameter": 3.2, "circle": 34.0}},
    }}, "mount.draft", 1.5),
]  # fmt: skip


@pytest.mark.parametrize(("path", "changes", "key", "value"), KEPT, ids=[str(list(c)) for _, c, *_ in KEPT])
def test_a_change_is_kept_in_the_file_and_may_be_taken_back(path, changes, key, value, tmp_path):
    scene, plain, (table, name) = load(path, changes), load(path), key.split(".")
    assert getattr(getattr(scene, table), name) == value
    assert through_its_file(scene, tmp_path) == scene
    assert scene.changed({table: getattr(plain, table)}) == plain


def test_a_template_is_read_into_the_nouns_of_optics():
    thu, portrait, disk = (load(TEMPLATES / f"{name}.toml") for name in ("thu", "portrait", "disk"))
    assert thu.source == Collimated(Circle(12.0), 650.0, "uniform", real_divergence=0.01)
    assert (thu.lens.outline, thu.lens.front) == (Rectangle(24.0, 24.0), PlaneFront(8.0))
    assert portrait.source == Point((0.0, 0.0, 0.0), 650.0, "gaussian", half_angle_1e2=30.0, real_diameter=0.01)
    assert portrait.lens.front == SphereFront(15.0, 0.0, optimise=True)
    assert portrait.index == 1.488
    assert thu.index == pytest.approx(1.488, abs=1e-3)  # PMMA at 650 nm, Wang et al. 2023
    assert disk.target.outline == Circle(180.0)
    with pytest.raises(ValueError, match="frozen"):
        thu.target.z = 3.0


def test_a_picture_travels_with_its_scene(photo, tmp_path):
    scene = load(photo)
    assert scene.target.image.name == "My-photo.png"
    assert through_its_file(scene, tmp_path / "elsewhere") == scene
    Image.new("RGB", (9, 9)).save(photo.parent / "My photo.png")
    with pytest.raises(SceneError, match="target.image: the picture is black"):
        load(photo)


def test_overrides_are_toml_values_or_text_and_replace_their_alternatives():
    scene = load(THU, {"target.pixels": "64", "title": "Two words", "lens.back.z": 21, "target.x": "[0, 300.0]"})
    assert (scene.target.pixels, scene.title, scene.lens.back.z) == (64, "Two words", 21.0)
    assert scene.target.x == (0.0, 300.0)
    scene = load(THU, {"target.sample": "camera", "lens.index": "1.5"})
    assert (scene.target.text, scene.target.sample) == (None, "camera")
    assert (scene.lens.material, scene.lens.index) == (None, 1.5)


@pytest.mark.parametrize("place", ["source.aperture", "lens.outline", "target.outline"])
def test_a_circle_is_given_by_radius_or_diameter(place):
    by_diameter, by_radius = '{ shape = "circle", diameter = 20 }', '{ shape = "circle", radius = 10 }'
    assert load(THU, {place: by_diameter}) == load(THU, {place: by_radius})
    wanted = load(THU, {place: '{ shape = "circle", radius = 12 }'})
    assert load(THU, {place: by_diameter, f"{place}.radius": "12"}) == wanted
    assert load(THU, {place: by_radius, f"{place}.diameter": "24"}) == wanted


@pytest.mark.parametrize("path", [r"C:\photos\me.png", r"C:\Users\me.png", r"..\me.png"])
def test_a_path_with_backslashes_is_told_how_to_be_written(photo, path):
    photo.write_text(THU.read_text().replace('text = "THU"', f'image = "{path}"'))
    with pytest.raises(SceneError, match=r"not valid TOML: .* \(at line \d+, .*; write paths with / or in"):
        load(photo)
    photo.write_text(THU.read_text().replace('text = "THU"', f"image = '{path}'"))
    with pytest.raises(SceneError, match=r"target\.image: .*me\.png' not found"):
        load(photo)
    photo.write_text(THU.read_text().replace('text = "THU"', r'image = "C:\new\ten.png"'))
    with pytest.raises(SceneError, match=r"target\.image: .* has an escape such as \\n; write paths with /"):
        load(photo)


def test_a_tilde_is_the_users_home_unless_a_file_has_that_name(photo, monkeypatch, tmp_path):
    (tmp_path / "home").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    scene = load(photo)
    (tmp_path / "My photo.png").rename(tmp_path / "home" / "me.png")
    assert load(photo, {"target.image": "~/me.png"}).target.image.data == scene.target.image.data
    Image.new("L", (9, 9), 7).save(tmp_path / "~.png")
    assert load(photo, {"target.image": "~.png"}).target.image.data != scene.target.image.data


@pytest.mark.parametrize(("content", "sentence"), [
    (None, "no such scene file"), ("a folder", "is a folder; give a scene file"),
    (b'name = "a"\n[source\n', "line 2, column 8"), (b'name = "a', "line 1, column 10"),
    (b"name = \xff", "not UTF-8"), (b"", "name: missing"),
    (b"x = " + b"[" * 50_000, "nested too deeply"), (b"x = " + b"9" * 50_000, "too many digits"),
    (b"#" * 1_000_001, "larger than 1 MB"),
    (b"\xef\xbb\xbfname = 3", "name: 3 is not text"),  # a byte order mark is no fault
    (THU.read_bytes().replace(b"[target]", b"[target]\nuniform = true"), "exactly one of text, image, sample, unif"),
], ids=lambda value: value if isinstance(value, str) else "")  # fmt: skip
def test_a_file_that_is_no_scene_gets_one_sentence(tmp_path, content, sentence):
    path = tmp_path / "scene.toml"
    if content == "a folder":
        path.mkdir()
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(SceneError, match=sentence) as caught:
        load(path)
    assert "\n" not in str(caught.value)


# ---- lines of a file -------------------------------------------------------------------------------------------------

TEXT = """# a comment = 1
name = "x"  # another = 2
[source]
kind = "point"
 'wavelength' = 650.0
lens.front = { kind = "plane", z = 8.0 }

[[effects]]
kind = "fresnel"
[[ "effects" ]]
kind = "absorption"
coefficient = 0.1
"""


@pytest.mark.parametrize(("key", "line"), [
    ("name", 2), ("source", 3), ("source.wavelength", 5), ("source.lens.front", 6), ("effects[0]", 8),
    ("effects[0].kind", 9), ("effects[1]", 10), ("effects[1].coefficient", 12),
    # keys that are not there are on the line of what holds them
    ("source.lens.front.kind", 6), ("source.diameter", 3), ("effects[1].coating.index", 10), ("target.tilt", None),
])  # fmt: skip
def test_a_key_is_on_its_line_or_on_that_of_the_table_around_it(key, line):
    assert line_of(key, toml_positions(TEXT)) == line


@pytest.mark.parametrize(("overrides", "notes"), [
    ({}, 1), ({"source.aperture.radius": "-2"}, 0), ({"source.aperture": '{ shape = "circle", radius = -2 }'}, 0),
])  # fmt: skip
def test_a_wrong_value_is_told_its_line_unless_it_comes_from_elsewhere(overrides, notes, tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(THU.read_text(encoding="utf-8").replace("radius = 12.0 }", "radius = -1 }"), encoding="utf-8")
    with pytest.raises(SceneError) as caught:
        load(path, overrides)
    assert getattr(caught.value, "__notes__", []) == [f"line 15 of {path}"][:notes]


# ---- scripts ---------------------------------------------------------------------------------------------------------

RAMP = np.linspace(0.0, 3.0, 32)[:, None] * np.ones((1, 32))  # dark at the top


@pytest.fixture(scope="module")
def thu():
    return load(THU, {"target.pixels": 16})


@pytest.mark.parametrize("key", Accept.model_fields)
def test_each_limit_but_those_of_form_and_place_is_one_of_the_light(thu, key):
    """A verdict knows by this whether the scene has a limit on the light."""
    free = {name: None for name in Accept.model_fields}
    asked = thu.model_copy(update={"accept": Accept.model_construct(**free | {key: 0.1})})
    assert asked.limits_light == (key not in ("form", "decentre"))


@pytest.mark.parametrize(("changes", "overrides"), [
    ({"lens.back.z": 21}, {"lens.back.z": "21"}),
    ({"target.text": "42"}, {"target.text": '"42"'}),  # a text stays one
    ({"target.sample": "camera"}, {"target.sample": "camera"}),  # of alternatives the other goes
    ({"lens.front": Sphere(8.0, -0.01)}, {"lens.front": '{ kind = "sphere", z = 8.0, curvature = -0.01 }'}),
    ({"lens.outline": {"shape": "circle", "diameter": 20}}, {"lens.outline": '{ shape = "circle", radius = 10 }'}),
    ({"target.x": np.array([0.0, 100.0])}, {"target.x": "[0.0, 100.0]"}),
    ({"target.z": np.float64(900.0), "target.pixels": np.int64(24)}, {"target.z": "900.0", "target.pixels": "24"}),
], ids=lambda value: ", ".join(value))  # fmt: skip
def test_a_change_is_what_the_command_line_would_set(thu, changes, overrides):
    before = thu.toml()
    assert thu.changed(changes) == load(THU, {"target.pixels": 16} | overrides)
    assert thu.toml() == before


def test_none_takes_a_key_out(thu):
    assert thu.accept.rrmsd == 0.125 and thu.changed({"accept.rrmsd": None}).accept.rrmsd is None
    with pytest.raises(SceneError, match=r"^target\.z: missing"):
        thu.changed({"target.z": None})


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"lens.back.z": "21"}, r"^lens\.back\.z: '21' is not a number"),
    ({"target.z": float("nan")}, r"^target\.z: nan is not a finite number"),
    ({"target.z": object()}, r"^target\.z: a value of type object is not possible"),
    ({"target.x.y": 3}, r"^target\.x\.y: x is not a table"),
    ({"a..b": 3}, r"^a\.\.b: is not a dotted key"),
    ({"target.image": [[0.0, 1.0]]}, r"^target\.image: .* is not a file name"),
    ({"target.image": np.ones((4, 4, 3))}, r"shape \(4, 4, 3\)"),
    ({"target.image": np.ones((1, 70_000))}, "more than 64 million values"),
    ({"target.image": np.array([[1.0, np.nan]])}, "the array has values that are not finite"),
    ({"target.image": np.array([[1.0, -1e-9]])}, "the array has negative values"),
    ({"target.image": np.zeros((4, 4))}, "the array is zero"),
    ({"target.image": np.array([["a", "b"]])}, "an array of <U1"),
])  # fmt: skip
def test_a_wrong_change_is_one_sentence(thu, changes, sentence):
    with pytest.raises(SceneError, match=sentence) as caught:
        thu.changed(changes)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("scale", [1.0, 1e-30, 1e30])
def test_an_array_is_linear_irradiance_on_any_scale_with_row_0_at_the_top(thu, scale):
    target = thu.changed({"target.image": scale * RAMP}).target
    wanted = RAMP.reshape(16, 2, 16, 2).mean((1, 3))
    assert np.allclose(target.irradiance(), wanted / wanted.sum(), rtol=1e-6, atol=0)  # float32 in the file
    assert target.text is None
    for kind in (np.uint8, np.float32):
        assert thu.changed({"target.image": (RAMP > 1).astype(kind)}) == thu.changed({"target.image": RAMP > 1})


def test_an_array_travels_with_its_scene_and_no_file_of_its_name_is_read(thu, tmp_path, monkeypatch):
    scene = thu.changed({"target.image": RAMP})
    again = through_its_file(scene, tmp_path / "copy")
    assert again == scene and np.array_equal(again.target.irradiance(), scene.target.irradiance())
    assert scene.changed({}) == scene and scene.changed({"target.z": 900.0}).target.image == scene.target.image
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SceneError, match="not found"):
        scene.changed({"target.image": scene.target.image.name})


def test_a_picture_may_be_given_in_every_way(thu):
    array = thu.changed({"target.image": RAMP})
    picture = array.target.image
    assert isinstance(picture, Picture)
    whole = {"z": 1000, "x": [0, 400], "y": [0, 400], "pixels": 16, "image": RAMP, "seen_from": "behind"}
    for change in ({"target.image": picture}, {"target.image": torch.from_numpy(RAMP)}, {"target": whole}):
        assert thu.changed(change) == array
    for image in (picture, RAMP):
        assert thu.changed({"target": Target(**whole | {"image": image})}) == array


def test_a_scene_may_be_made_of_its_nouns():
    def made(outline):
        return Scene(
            name="lamp",
            source=Point((0.0, 0.0, 0.0), 650.0),
            lens=LensBlank(material="PMMA", outline=outline, front=Plane(15.0), back=Back(z=20.0, control_points=65)),
            target=Target(
                z=500.0, x=(-50.0, 50.0), y=(-50.0, 50.0), pixels=32, uniform=True, outline=Rectangle(80, 40)
            ),
        )

    scene = made(Circle(10.0))
    assert scene.changed({}) == scene
    with pytest.raises(ValueError, match="-1 mm is not between"):
        made(Circle(-1.0))
    with pytest.raises(SceneError, match=r"lens\.front\.z: '15' is not a number"):
        scene.model_copy(update={"lens": scene.lens.model_copy(update={"front": Plane("15")})}).changed({})


# ---- doubts ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"source.aperture.radius": "13"}, "source.aperture: the beam is wider than the lens"),
    ({"source.aperture.radius": "10.5"}, "source.aperture: the beam is 21 mm wide along x and the lens 24 mm; the "
     "lens is dark outside x = -10.5 to 10.5"),
    ({"source.aperture.radius": "11.5"}, None),
    ({"target.x": "[0.0, 0.4]", "target.y": "[0.0, 0.4]"}, "target.x: 0.4 mm wide; are these metres?"),
    ({"target.z": "25", "lens.front.z": "-12", "lens.back.z": "0"}, None),
    ({"target.z": "5", "lens.front.z": "-12", "lens.back.z": "0"}, "target.z: 5 mm; are these metres?"),
], ids=str)  # fmt: skip
def test_what_is_possible_but_perhaps_not_meant_is_a_warning(changes, sentence):
    warnings = load(THU, changes).warnings()
    assert len(warnings) == (sentence is not None)
    assert all(warning.startswith(sentence) for warning in warnings)


METRES = {
    "source.aperture": '{ shape = "circle", radius = 0.012 }', "lens.front.z": "0.008", "lens.back.z": "0.020",
    "lens.outline": '{ shape = "rectangle", width = 0.024, height = 0.024 }',
    "target.z": "1.0", "target.x": "[0.0, 0.4]", "target.y": "[0.0, 0.4]",
}  # fmt: skip


def test_a_scene_in_metres_is_asked_whether_it_is():
    question = "lens.outline.width: 0.024 mm; are these metres? lengths are in mm"
    assert load(THU, METRES | {"lens.min_thickness": "0.001"}).warnings() == (question,)
    with pytest.raises(SceneError, match="lens.back.z: the lens is 0.012 mm thick") as refused:
        load(THU, METRES)
    assert str(refused.value).endswith(f"; {question}")
    with pytest.raises(SceneError, match="target.z: .* is not behind the lens.*; target.z: 1 mm; are these metres?"):
        load(THU, {"target.z": "1.0"})


# ---- light, work, part -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("front", ['{kind="plane",z=0}', '{kind="plane",z=-50}', '{kind="sphere",z=8,curvature=-0.05}'])
def test_a_beam_whose_start_nobody_chose_starts_before_the_front(front, tmp_path):
    scene = load(THU, {"lens.front": front})
    front = scene.lens.front
    met = front.z + getattr(front, "curvature", 0) * 12.0**2  # or more: the beam's edge meets it nearer to its vertex
    assert scene.source.start(front.z) < met
    assert through_its_file(scene, tmp_path) == scene
    assert Collimated(Circle(12.0)).start(15.0) == 0.0 > Collimated(Circle(12.0)).start(11.0)


def test_points_of_an_extended_source_are_a_knob_and_a_judge_takes_others():
    scene = load(DISK, {"source.diameter": "1", "tailoring.quality": "draft"})
    points = scene.tailoring.resolved(65).source_points
    assert len(scene.channels()) == points and f"source_points {points}" in scene.toml()
    assert len(scene.changed({"tailoring.source_points": 12}).channels()) == 12
    scene = scene.changed({"source.wavelength": ((486.1, 1.0), (587.6, 2.0), (656.3, 1.0))})
    both = scene.verification_channels(), scene.channels(VERIFICATION_POINTS)
    judges, known = ({c.source.position for c in found} for found in both)
    assert len(judges) == VERIFICATION_POINTS and not judges & known
    point = load(DISK)
    assert "source_points" not in point.toml() and point.channels() == point.verification_channels()


def test_each_line_has_the_index_of_its_own():
    scene = load(THU, {"source.wavelength": RGB})
    assert {c.source.wavelength: c.index for c in scene.channels()} == {
        nm: refractive_index("PMMA", nm) for nm in (486.1, 587.6, 656.3)
    }
    assert scene.index == refractive_index("PMMA", 587.6) and scene.channels()[0].source.wavelength == 587.6
    assert math.fsum(c.weight for c in scene.channels()) == 1.0
    assert [(c.index, c.weight) for c in load(MIRROR, {"source.wavelength": RGB}).channels()] == [(1.0, 1.0)]
    [channel] = load(THU, {"source.wavelength": "[[587.6, 0.3]]", "lens.index": "1.5"}).channels()
    assert channel.source.wavelength == 587.6 and channel.index == 1.5


def test_a_ghost_brings_the_reflections_of_its_faces_by_the_coating_that_is_named():
    def light(*effects):
        scene = load(DISK, {"effects": list(effects)})
        [channel] = scene.channels()
        told = [words for words, _ in simulated(scene)]
        assert any(what.startswith("ghosts") for what in told) == (scene.ghost is ghost_light)
        assert sum(what.startswith("Fresnel reflection") for what in told) == (channel.losses is not None)
        return channel.losses and channel.losses.fresnel, scene.ghost

    coated = {"kind": "fresnel", "coating": {"index": 1.38, "thickness": 100.0}, "polarisation": "s"}
    assert light() == (None, None)
    assert light({"kind": "ghost"}) == (FresnelLoss(587.6), ghost_light)
    assert light({"kind": "ghost"}, coated) == (FresnelLoss(587.6, "s", CoatingLayer(1.38, 100.0)), ghost_light)


@pytest.mark.parametrize("quality", PRESETS)
def test_every_knob_gets_a_value(quality):
    settings = Tailoring(quality=quality).resolved(513)
    assert {key for key, value in asdict(settings).items() if value is None} == {"accuracy", "max_time", "solution"}
    assert settings.levels == (33, 129, 513)
    each_way = 2**0.5 if quality == "draft" else 2  # rays a control cell: at least two
    assert settings.rays >= each_way * 513 and settings.stage2_iterations > 0
    assert Tailoring(quality=quality, method="integration").resolved(65).stage2_iterations == 0
    settings = Tailoring(quality=quality, rays=300, levels=(9, 65), rounds=2).resolved(65)  # the scene goes before
    assert (settings.rays, settings.levels, settings.rounds) == (300, (9, 65), 2)


@pytest.mark.parametrize(("quality", "m", "cells"), [
    ("standard", 513, 512), ("draft", 65, 128), ("fine", 9, 64), ("paper", 65, 1024),
])  # fmt: skip
def test_no_map_is_much_finer_than_the_net_that_follows_it(quality, m, cells):
    assert Tailoring(quality=quality).resolved(m).transport_grid == cells
    assert Tailoring(quality=quality, transport_grid=777).resolved(m).transport_grid == 777


def test_levels_grow_to_the_net_asked_for():
    levels = [coarse_to_fine(m) for m in (5, 33, 65, 200, 257, 513)]
    assert levels == [(5,), (33,), (33, 65), (33, 129, 200), (33, 129, 257), (33, 129, 513)]


def test_a_target_that_is_tilted_by_nothing_is_level():
    level, tilted = load(THU), load(THU, {"target.tilt": "[0, 0]"})
    assert level == tilted and level.toml() == tilted.toml() and "tilt" not in level.toml()
    assert level.target.screen.receiver == LevelPlane(1000.0)
    plane = load(THU, {"target.tilt": "[0, 40.5]"}).target.screen.receiver
    assert plane == TiltedPlane((200.0, 200.0, 1000.0), (0.0, 40.5))


@pytest.mark.parametrize("outline", [Circle(12.0), Rectangle(24.0, 20.0)])
@pytest.mark.parametrize("tilt", [60.0, -60.0])
def test_a_tilted_plane_passes_the_lens_by_so_much(outline, tilt):
    """Against the highest of many points of the lens; one on the axis, so that both signs are possible."""
    scene = load(THU, {"target.x": [-9.0, 9.0], "target.y": [-9.0, 9.0], "target.z": 60.0, "target.tilt": [20.0, tilt]})
    scene = scene.changed({"lens.outline": outline})
    turns = np.linspace(0.0, 2 * np.pi, 3601)
    rim = (12.0 * np.cos(turns), 12.0 * np.sin(turns)) if outline.is_round else outline.rim_points()
    highest = max(scene.target.screen.receiver.height((x, y, 25.0)) for x, y in zip(*rim, strict=True))
    room, key = scene.clearance(25.0)
    assert room == pytest.approx(-highest, rel=1e-5) and key == "target.z"


@pytest.mark.parametrize(("path", "changes", "part"), [
    (DISK, {}, Part(material="PMMA", density=1.19, colour=LENS_COLOUR)),
    (DISK, {"lens.material": "acrylic"}, Part(material="PMMA", density=1.19, colour=LENS_COLOUR)),
    (DISK, {"lens.material": "other/Optorez1330/Sultanova"},  # nobody has said its density
     Part(material="other/Optorez1330/Sultanova", colour=LENS_COLOUR)),
    (DISK, {"lens.index": 1.5}, Part(colour=LENS_COLOUR)),
    (DISK, {"part.material": "PMMA, cast"}, Part(material="PMMA, cast", density=1.19, colour=LENS_COLOUR)),
    (MIRROR, {"part.material": "Al 6061", "part.density": 2.7},
     Part(material="Al 6061", density=2.7, colour=MIRROR_COLOUR)),
])  # fmt: skip
def test_a_part_is_of_the_lens_s_material_unless_the_scene_says_another(path, changes, part):
    scene = load(path, changes)
    assert scene.part.of(scene.lens) == part


@pytest.mark.parametrize("outline", [
    CircleRim(shape="circle", diameter=7.0),
    Box(shape="rectangle", width=8.0, height=6.0),
    Box(shape="rectangle", width=8.0, height=6.0, corner_radius=1.5),
])  # fmt: skip
def test_what_is_held_against_an_outline_is_the_wire_that_is_built(outline):
    """Along the wire the depth is 0, and it is so along the places that stand for it, half as long inside."""
    edges, outline = wire(outline).Edges(), outline.outline
    found = [edge.positionAt(t) for edge in edges for t in np.linspace(0, 1, 9)]
    assert np.abs(outline.depth(np.array([p.x for p in found]), np.array([p.y for p in found]))).max() < 1e-12
    x, y = outline.rim_points()
    assert np.abs(outline.depth(x, y)).max() < 1e-12 and (outline.depth(x / 2, y / 2) > 0).all()
    assert (outline.depth(1.1 * x, 1.1 * y) < 0).all()


def test_a_front_with_an_outline_is_the_same_from_a_file_and_from_python(tmp_path):
    front = {"kind": "sphere", "z": 8.0, "curvature": -0.1, "outline": {"diameter": 14.0}}
    scene = load(DISK, {"lens.front": front, "source.half_angle": "35"})
    assert through_its_file(scene, tmp_path) == scene
    surface = scene.lens.front.surface
    assert surface == Recess(Sphere(8.0, -0.1), Circle(7.0)) and surface.around.z == pytest.approx(8 - 10 + 51**0.5)
    assert scene.changed({"lens.front": surface}) == scene
    assert scene.flat_lens(9).apertures == (Circle(7.0), scene.lens.outline)
