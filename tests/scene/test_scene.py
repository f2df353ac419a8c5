"""Scenes: what a file says is what the engine gets; whatever is wrong is one sentence that names the place."""

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.rays import TiltedPlane
from bstcad.optics.sources import Collimated, Point
from bstcad.scene.blank import PlaneFront, SphereFront
from bstcad.scene.check import clearance
from bstcad.scene.quality import PRESETS, Tailoring, coarse_to_fine
from bstcad.scene.scene import SceneError, load
from bstcad.scene.target import Target

TEMPLATES = Path(__file__).parent.parent.parent / "templates"
THU = TEMPLATES / "thu.toml"


@pytest.fixture
def photo(tmp_path):
    """A scene file beside a picture of its own."""
    values = np.random.default_rng(0).integers(0, 256, (40, 30, 3), dtype=np.uint8)
    Image.fromarray(values).save(tmp_path / "My photo.png")
    scene = tmp_path / "scene.toml"
    scene.write_text(THU.read_text().replace('text = "THU"', 'image = "My photo.png"'))
    return scene


@pytest.mark.parametrize("template", sorted(TEMPLATES.glob("*.toml")), ids=lambda path: path.stem)
def test_a_resolved_template_is_the_same_scene(template, tmp_path):
    scene = load(template)
    resolved = tmp_path / "scene.toml"
    resolved.write_text(scene.toml())
    assert load(resolved) == scene
    assert scene.name == template.stem
    assert scene.warnings() == ()


def test_a_template_is_read_into_the_nouns_of_optics():
    thu, portrait, disk = (load(TEMPLATES / f"{name}.toml") for name in ("thu", "portrait", "disk"))
    assert thu.source == Collimated(Circle(12.0), 650.0, "uniform", real_divergence=0.01)
    assert (thu.lens.outline, thu.lens.front, thu.lens.back.control_points) == (
        Rectangle(24.0, 24.0),
        PlaneFront(8.0),
        513,
    )
    assert portrait.source == Point((0.0, 0.0, 0.0), 650.0, "gaussian", half_angle_1e2=30.0, real_diameter=0.01)
    assert portrait.lens.front == SphereFront(15.0, 0.0, optimise=True)
    assert portrait.index == 1.488
    assert thu.index == pytest.approx(1.488, abs=1e-3)  # PMMA at 650 nm, Wang et al. 2023
    assert disk.target.outline == Circle(180.0)


def test_a_picture_travels_with_its_scene(photo, tmp_path):
    scene = load(photo)
    assert scene.target.image.name == "My-photo.png"
    copy = tmp_path / "elsewhere"
    copy.mkdir()
    (copy / scene.target.image.name).write_bytes(scene.target.image.data)
    (copy / "scene.toml").write_text(scene.toml())
    assert load(copy / "scene.toml") == scene


def test_a_circle_may_be_given_by_its_diameter():
    for key in ("source.aperture", "lens.outline", "target.outline"):
        by_diameter = load(THU, {key: '{ shape = "circle", diameter = 20 }'})
        assert by_diameter == load(THU, {key: '{ shape = "circle", radius = 10 }'})


def test_irradiance_has_unit_flux():
    for name in ("thu", "portrait", "disk"):
        target = load(TEMPLATES / f"{name}.toml").target
        flux = target.irradiance()
        assert flux.shape == (target.pixels, target.pixels) and flux.dtype == np.float64
        assert flux.sum() == pytest.approx(1.0, abs=1e-12)
        assert flux.min() >= 0


def test_a_uniform_disc_has_the_irradiance_of_its_area():
    target = load(TEMPLATES / "disk.toml").target
    flux = target.irradiance()
    pixel = (400.0 / 128) ** 2
    assert flux[64, 64] == pytest.approx(pixel / (math.pi * 180.0**2), rel=1e-3)  # sub-pixels at the rim
    assert flux[0, 0] == 0.0


def test_gamma_darkens_the_middle_tones(photo):
    linear, coded = load(photo, {"target.gamma": "1"}).target, load(photo, {"target.gamma": "2.2"}).target
    assert coded.irradiance().max() > linear.irradiance().max()


def test_overrides_are_toml_values_or_text():
    scene = load(THU, {"target.pixels": "64", "title": "Two words", "lens.back.z": 21, "target.x": "[0, 300.0]"})
    assert (scene.target.pixels, scene.title, scene.lens.back.z) == (64, "Two words", 21.0)
    assert scene.target.x == (0.0, 300.0)


def test_an_override_of_the_picture_replaces_it():
    scene = load(THU, {"target.sample": "camera", "lens.index": "1.5"})
    assert (scene.target.text, scene.target.sample) == (None, "camera")
    assert (scene.lens.material, scene.lens.index) == (None, 1.5)


@pytest.mark.parametrize("place", ["source.aperture", "lens.outline", "target.outline"])
def test_an_override_of_a_radius_replaces_a_diameter_and_the_other_way_round(place):
    by_diameter, by_radius = '{ shape = "circle", diameter = 20 }', '{ shape = "circle", radius = 10 }'
    wanted = load(THU, {place: '{ shape = "circle", radius = 12 }'})
    assert load(THU, {place: by_diameter, f"{place}.radius": "12"}) == wanted
    assert load(THU, {place: by_radius, f"{place}.diameter": "24"}) == wanted


@pytest.mark.parametrize("front", ['{kind="plane",z=0}', '{kind="plane",z=-50}', '{kind="sphere",z=8,curvature=-0.05}'])
def test_a_beam_whose_start_nobody_chose_starts_before_the_front(front, tmp_path):
    scene = load(THU, {"lens.front": front})
    front = scene.lens.front
    met = front.z + getattr(front, "curvature", 0) * 12.0**2  # or more: the beam's edge meets it nearer to its vertex
    assert scene.source.start(front.z) < met
    (tmp_path / "scene.toml").write_text(scene.toml())
    assert load(tmp_path / "scene.toml") == scene
    assert Collimated(Circle(12.0)).start(15.0) == 0.0 > Collimated(Circle(12.0)).start(11.0)


def test_the_file_itself_may_not_have_two_pictures(tmp_path):
    path = tmp_path / "two.toml"
    path.write_text(THU.read_text().replace('text = "THU"', 'text = "THU"\nuniform = true'))
    with pytest.raises(SceneError, match="needs exactly one of text, image, sample, uniform, but has text and uniform"):
        load(path)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"source.aperture.radius": "13"}, "source.aperture: the beam is wider than the lens"),
        (
            {"source.aperture.radius": "10.5"},
            "source.aperture: the beam is 21 mm wide along x and the lens 24 mm; "
            "the lens stays unlit beyond x = -10.5 and 10.5",
        ),
        (
            {"source.aperture": '{ shape = "rectangle", width = 24, height = 6 }'},
            "source.aperture: the beam is 6 mm wide along y",
        ),
        ({"source.aperture.radius": "11.5"}, None),
        ({"target.x": "[0.0, 0.4]", "target.y": "[0.0, 0.4]"}, "target.x: 0.4 mm wide; are these metres?"),
        ({"target.z": "25"}, None),
        ({"target.z": "25", "lens.front.z": "-12", "lens.back.z": "0"}, None),
        ({"target.z": "5", "lens.front.z": "-12", "lens.back.z": "0"}, "target.z: 5 mm; are these metres?"),
    ],
    ids=str,
)
def test_what_is_possible_but_perhaps_not_meant_is_a_warning(changes, sentence):
    warnings = load(THU, changes).warnings()
    assert len(warnings) == (sentence is not None)
    assert all(warning.startswith(sentence) for warning in warnings)


METRES = {
    "source.aperture": '{ shape = "circle", radius = 0.012 }',
    "lens.outline": '{ shape = "rectangle", width = 0.024, height = 0.024 }',
    "lens.front.z": "0.008",
    "lens.back.z": "0.020",
    "target.z": "1.0",
    "target.x": "[0.0, 0.4]",
    "target.y": "[0.0, 0.4]",
}


def test_a_scene_in_metres_is_asked_whether_it_is():
    question = "lens.outline.width: 0.024 mm; are these metres? lengths are in mm"
    assert load(THU, METRES | {"lens.min_thickness": "0.001"}).warnings() == (question,)
    with pytest.raises(SceneError, match="lens.back.z: the lens is 0.012 mm thick") as refused:
        load(THU, METRES)
    assert str(refused.value).endswith(f"; {question}")
    with pytest.raises(SceneError, match="target.z: .* is not behind the lens.*; target.z: 1 mm; are these metres?"):
        load(THU, {"target.z": "1.0"})


@pytest.mark.parametrize("path", [r"C:\photos\me.png", r"C:\Users\me.png", r"..\me.png"])
def test_a_path_with_backslashes_is_told_how_to_be_written(photo, path):
    photo.write_text(THU.read_text().replace('text = "THU"', f'image = "{path}"'))
    with pytest.raises(SceneError, match=r"not valid TOML: .* \(at line \d+, .*; write paths with / or in"):
        load(photo)
    photo.write_text(THU.read_text().replace('text = "THU"', f"image = '{path}'"))
    with pytest.raises(SceneError, match=r"target\.image: .*me\.png' not found"):
        load(photo)


def test_a_path_whose_backslashes_were_escapes_is_told_so(photo):
    photo.write_text(THU.read_text().replace('text = "THU"', r'image = "C:\new\ten.png"'))
    with pytest.raises(SceneError, match=r"target\.image: .* holds an escape such as \\n; write paths with /"):
        load(photo)


def test_a_tilde_is_the_users_home_unless_a_file_has_that_name(photo, monkeypatch, tmp_path):
    (tmp_path / "home").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    scene = load(photo)
    (tmp_path / "My photo.png").rename(tmp_path / "home" / "me.png")
    assert load(photo, {"target.image": "~/me.png"}).target.image.data == scene.target.image.data
    Image.new("L", (9, 9), 7).save(tmp_path / "~.png")
    assert load(photo, {"target.image": "~.png"}).target.image.data != scene.target.image.data


@pytest.mark.parametrize("quality", PRESETS)
def test_every_knob_gets_a_value(quality):
    knobs = Tailoring(quality=quality).resolved(513)
    assert {key for key, value in knobs.model_dump().items() if value is None} == {"accuracy", "max_time"}  # no limits
    assert knobs.levels == (33, 129, 513)
    each_way = 2**0.5 if quality == "draft" else 2  # rays a control cell: at least two
    assert knobs.rays >= each_way * 513


@pytest.mark.parametrize(("quality", "m", "cells"), [
    ("standard", 513, 512), ("standard", 129, 256), ("draft", 129, 256), ("draft", 65, 128), ("fine", 9, 64),
    ("paper", 65, 1024),
])  # fmt: skip
def test_no_map_is_much_finer_than_the_net_that_follows_it(quality, m, cells):
    assert Tailoring(quality=quality).resolved(m).transport_grid == cells
    assert Tailoring(quality=quality, transport_grid=777).resolved(m).transport_grid == 777


@pytest.mark.parametrize("quality", ["draft", "standard", "fine", "paper"])
def test_no_stage_2_follows_integration(quality):
    assert Tailoring(quality=quality, method="integration").resolved(65).stage2_iterations == 0
    assert Tailoring(quality=quality).resolved(65).stage2_iterations > 0


def test_a_knob_of_the_scene_goes_before_the_quality():
    knobs = Tailoring(quality="paper", rays=300, levels=(9, 65), rounds=2).resolved(65)
    assert (knobs.method, knobs.rays, knobs.levels, knobs.rounds) == ("adam", 300, (9, 65), 2)


@pytest.mark.parametrize("m", [5, 33, 65, 129, 200, 257, 513, 1025, 2049])
def test_levels_grow_to_the_net_asked_for(m):
    levels = coarse_to_fine(m)
    assert levels[-1] == m
    assert all(coarse < fine for coarse, fine in zip(levels, levels[1:], strict=False))
    assert {257: (33, 129, 257), 513: (33, 129, 513)}.get(m, levels) == levels


def test_records_are_frozen():
    scene = load(THU)
    with pytest.raises(ValueError, match="frozen"):
        scene.target.z = 3.0


def test_a_target_of_one_s_own_in_python():
    flux = Target(z=1.0, x=(0, 2), y=(0, 1), pixels=8, uniform=True, outline=Rectangle(1.0, 1.0)).irradiance()
    np.testing.assert_allclose(flux[:, 2:6], 1 / 32)
    assert not flux[:, :2].any() and not flux[:, 6:].any()


COUNTED = [
    ((0, 300), (0, 150), 64, (64, 32)),
    ((0, 150), (-20, 280), 64, (32, 64)),
    ((0, 100), (0, 100), 64, (64, 64)),
    ((0, 100), (0, 33.3), 100, (100, 33)),
    ((0, 1e4), (0, 1), 512, (512, 8)),  # the limits' least
    ((0, 300), (0, 150), (50, 40), (50, 40)),
]


@pytest.mark.parametrize(("x", "y", "pixels", "counted"), COUNTED)
def test_pixels_are_square_unless_both_sides_are_counted(x, y, pixels, counted):
    target = Target(z=1.0, x=x, y=y, pixels=pixels, uniform=True)
    assert target.columns_rows == counted
    assert target.irradiance().shape == counted[::-1]


def test_pixels_of_both_sides_travel_with_the_scene(tmp_path):
    scene = load(THU, {"target.x": [0, 300], "target.y": [0, 150], "target.pixels": "[50, 40]"})
    path = tmp_path / "again.toml"
    path.write_text(scene.toml())
    assert load(path) == scene and load(path).target.pixels == (50, 40)


def test_a_picture_on_a_wide_target_is_that_of_its_pixels():
    """A disc of light has its area and its place, whatever the counts: rows run down, columns to the right."""
    disc = {"uniform": True, "outline": Circle(40.0)}
    target = Target(z=1.0, x=(10, 310), y=(-50, 100), pixels=(50, 40), **disc)
    flux, (columns, rows) = target.irradiance(), target.columns_rows
    x, y = 10 + (np.arange(columns) + 0.5) * 6.0, 100 - (np.arange(rows) + 0.5) * 3.75
    assert flux.sum(0) @ x == pytest.approx(160.0) and flux.sum(1) @ y == pytest.approx(25.0)
    assert flux.max() == pytest.approx(6.0 * 3.75 / (math.pi * 40.0**2), rel=1e-3)


def test_a_target_that_is_tilted_by_nothing_is_level():
    level, tilted = load(THU), load(THU, {"target.tilt": "[0, 0]"})
    assert level == tilted and level.toml() == tilted.toml() and "tilt" not in level.toml()
    assert level.target.screen.plane == 1000.0


def test_a_tilted_target_goes_through_its_file(tmp_path):
    scene = load(THU, {"target.tilt": "[0, 40.5]"})
    (tmp_path / "scene.toml").write_text(scene.toml(), encoding="utf-8")
    assert load(tmp_path / "scene.toml") == scene
    assert scene.target.screen.plane == TiltedPlane((200.0, 200.0, 1000.0), (0.0, 40.5))
    assert scene.changed({"target.tilt": None}) == load(THU)


@pytest.mark.parametrize(("outline", "tilt"), [("square", 60.0), ("round", 60.0), ("square", -60.0)])
def test_a_tilted_plane_passes_the_lens_by_so_much(outline, tilt):
    """Against the highest of many points of the lens; one on the axis, so that both signs are possible."""
    shape = (
        {"shape": "circle", "radius": 12.0}
        if outline == "round"
        else {"shape": "rectangle", "width": 24.0, "height": 20.0}
    )
    scene = load(THU, {"target.x": [-9.0, 9.0], "target.y": [-9.0, 9.0], "target.z": 60.0, "target.tilt": [20.0, tilt]}
                 | {"lens.outline": shape})  # fmt: skip
    plane, (a, b) = scene.target.screen.plane, scene.lens.outline.half_extent
    turns = [2 * math.pi * k / 3600 for k in range(3600)]
    rim = [(a * math.cos(t), b * math.sin(t)) for t in turns]
    if outline == "square":
        rim = [(s * a, t * b) for s in (-1, 1) for t in (-1, 1)]
    highest = max(plane.height((x, y, 25.0)) for x, y in rim)
    assert clearance(scene, 25.0) == pytest.approx(-highest, rel=1e-5)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b'name = "a"\n[source\n', "line 2, column 8"),
        (b'name = "a', "line 1, column 10"),
        (b"name = \xff", "not UTF-8"),
        (b"x = " + b"[" * 50_000, "nested too deeply"),
        (b"x = " + b"9" * 50_000, "too many digits"),
        (b"#" * 1_000_001, "over 1 MB"),
        (b"", "name: missing"),
        (b"\xef\xbb\xbfname = 3", "name: 3 is not text"),  # a byte order mark is no fault
    ],
)
def test_a_file_that_is_no_scene_gets_one_sentence(tmp_path, content, sentence):
    path = tmp_path / "scene.toml"
    path.write_bytes(content)
    with pytest.raises(SceneError, match=sentence) as caught:
        load(path)
    assert "\n" not in str(caught.value)


def test_a_path_that_is_no_file_gets_one_sentence(tmp_path):
    with pytest.raises(SceneError, match="no such scene file"):
        load(tmp_path / "none.toml")
    with pytest.raises(SceneError, match="is a folder; give a scene file"):
        load(tmp_path)


def test_a_black_picture_is_refused(photo):
    Image.new("RGB", (9, 9)).save(photo.parent / "My photo.png")
    with pytest.raises(SceneError, match="target.image: the picture is all black"):
        load(photo)
