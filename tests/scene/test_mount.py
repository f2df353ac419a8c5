"""[mount]: what cannot be built is one sentence before any work."""

import numpy as np
import pytest

from bstcad.cad.mounted_part import wire
from bstcad.scene.errors import SceneError
from bstcad.scene.mount import Box, Round
from bstcad.scene.scene import load
from tests.conftest import DISK

BOX = {"shape": "rectangle", "width": 40.0, "height": 40.0}
FLANGE = {"outline": {"shape": "circle", "diameter": 40.0}, "z": 15.5, "thickness": 1.0}


def with_flange(changed):
    return {"flange": FLANGE | changed}


def test_it_comes_back_from_the_file_that_a_design_keeps(tmp_path):
    flange = FLANGE | {"screws": {"count": 3, "diameter": 3.2, "circle": 34.0}, "draft": 1.0, "bevel": 0.2}
    rim = {"shape": "rectangle", "width": 15.0, "height": 14.0, "corner_radius": 2.0}
    mount = {"datum": "flange", "rim": rim, "draft": 1.5, "bevel": 0.1, "flange": flange}
    scene = load(DISK).changed({"mount": mount})
    (tmp_path / "scene.toml").write_text(scene.toml(), encoding="utf-8")
    assert load(tmp_path / "scene.toml") == scene
    assert load(DISK).mount is None


@pytest.mark.parametrize("outline", [
    Round(shape="circle", diameter=7.0),
    Box(shape="rectangle", width=8.0, height=6.0),
    Box(shape="rectangle", width=8.0, height=6.0, corner_radius=1.5),
])  # fmt: skip
def test_what_is_held_against_an_outline_is_the_wire_that_is_built(outline):
    """Along the wire the depth is 0, and it is so along the places that stand for it, half as long inside."""
    edges, outline = wire(outline).Edges(), outline.outline
    found = [edge.positionAt(t) for edge in edges for t in np.linspace(0, 1, 9)]
    assert np.abs(outline.depth(np.array([p.x for p in found]), np.array([p.y for p in found]))).max() < 1e-12
    x, y = outline.places()
    assert np.abs(outline.depth(x, y)).max() < 1e-12 and (outline.depth(x / 2, y / 2) > 0).all()
    assert (outline.depth(1.1 * x, 1.1 * y) < 0).all()


@pytest.mark.parametrize(
    "mount, words",
    [
        ({"datum": "flange"}, 'mount.datum: "flange", but there is no'),
        ({"rim": {"shape": "circle", "diameter": 17.0}}, "mount.rim: reaches beyond lens.outline"),
        ({"rim": {"shape": "rectangle", "width": 8.0, "height": 6.0, "corner_radius": 3.0}},
         "mount.rim.corner_radius: 3 mm is not between 0 and 3 mm"),
        (with_flange({"thickness": 0.0}), "mount.flange.thickness: 0 mm is not between"),
        (with_flange({"thickness": -1.0}), "mount.flange.thickness: -1 mm is not between"),
        (with_flange({"outline": {"shape": "circle", "diameter": 22.0}}), "mount.flange.outline: does not reach"),
        (with_flange({"z": 30.0}), "mount.flange.z: the flange lies from z = 30 to 31 mm"),
        (with_flange({"bevel": 0.3, "outline": BOX | {"corner_radius": 0.3}}),
         "mount.flange.outline.corner_radius: 0.3 mm, of which bevel and draft take 0.3 mm"),
        (with_flange({"bevel": 0.5}), "mount.flange.bevel: 0.5 mm off 1 mm, twice"),
        (with_flange({"holes": [[19.0, 0.0, 2.0]]}), "hole 1, of 2 mm at .19, 0. mm, leaves .* to the flange"),
        (with_flange({"holes": [[9.0, 0.0, 2.0]]}), "hole 1, of 2 mm at .9, 0. mm, leaves .* to the lens"),
        (with_flange({"holes": [[14.0, 0.0, 2.0], [14.0, 1.0, 2.0]]}), "hole 2, .* to hole 1; move one"),
        (with_flange({"holes": [[14.0, 0.0, 0.0]]}), "hole 1, .* has no width"),
        (with_flange({"screws": {"count": 40, "diameter": 3.2, "circle": 34.0}}), "to hole 1; move one"),
        (with_flange({"screws": {"count": 0, "diameter": 3.2, "circle": 34.0}}), "screws.count: 0 is not"),
        ({"draft": 31.0}, "mount.draft: 31 degrees is not between 0 and 30"),
        ({"draft": -1.0}, "mount.draft: -1 degrees is not between"),
        ({"bevel": -0.1}, "mount.bevel: -0.1 mm is not between"),
        ({"bevel": 5.0}, "mount.bevel: 5 mm off a wall of 5 mm leaves none"),
        (with_flange({}) | {"bevel": 0.5}, "mount.bevel: 0.5 mm off a wall of 0.5 mm leaves none"),
        (with_flange({"z": 14.9}) | {"draft": 1.0}, "mount.draft: it is of the lens's own walls, below its flange"),
        ({"rim": {"shape": "rectangle", "width": 8.0, "height": 6.0, "corner_radius": 0.5}, "draft": 5.0, "bevel": 0.1},
         "mount.rim.corner_radius: 0.5 mm, of which draft and bevel take 0.537 mm"),
        ({"rim": {"shape": "circle", "diameter": 5.0}, "draft": 29.0}, "mount.draft: draft and bevel take 2.77 mm off"),
        (with_flange({"draft": 50.0}), "mount.flange.draft: 50 degrees is not between"),
        (with_flange({"width": 3.0}), "mount.flange.width: unknown key"),
        ({"rim": {"shape": "ellipse"}}, "mount.rim.shape: 'ellipse' is not possible; choose one of circle, rectangle"),
        ({"rim": {"diameter": 8.0}}, "mount.rim: shape is missing; give one of 'circle', 'rectangle'"),
        ({"rim": {"shape": "circle", "width": 8.0}}, "rim.width: unknown key; the keys here are diameter, shape"),
    ],
)  # fmt: skip
def test_what_cannot_be_built_is_one_sentence(mount, words):
    with pytest.raises(SceneError, match=words) as found:
        load(DISK).changed({"mount": mount})
    assert "\n" not in str(found.value)


@pytest.mark.parametrize("curvature, mount, words", [
    (0.02, with_flange({"z": 15.3}), "mount.flange.z: the flange's lower face, z = 15.3 mm, cuts the rim of the front"),
    (0.14, with_flange({"z": 15.1}), "the flange lies from z = 15.1 to 16.1 mm and the lens from 16.5957 to 20 mm"),
    (0.14, {"bevel": 0.2}, "mount.bevel: inwards from the rim the front falls by 0.811 mm a mm, too steeply"),
    (0.02, with_flange({"z": 15.1, "thickness": 3.0}), ""),
    (0.14, {"draft": 5.0}, ""),
])  # fmt: skip
def test_what_the_front_has_no_room_for_is_one_sentence(curvature, mount, words):
    """By the front's rim, before the lens is tailored; of a square lens that is not level."""
    shape = (
        {"shape": "circle", "radius": 4.5} if curvature > 0.1 else {"shape": "rectangle", "width": 9.0, "height": 9.0}
    )
    lens = {"lens.outline": shape, "lens.front": {"kind": "sphere", "z": 15.0, "curvature": curvature}, "mount": mount}
    if words:
        with pytest.raises(SceneError) as found:
            load(DISK).changed(lens)
        assert words in str(found.value) and "\n" not in str(found.value)
    else:
        load(DISK).changed(lens)
