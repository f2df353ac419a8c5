"""The source of a scene: spectra, extended, tilted and decentred sources, their channels, and what is refused."""

import math
from pathlib import Path

import pytest

from bstcad.optics.media import refractive_index
from bstcad.optics.sources import Collimated, Point
from bstcad.scene.quality import JUDGE_POINTS
from bstcad.scene.scene import load

TEMPLATES = Path(__file__).parent.parent.parent / "templates"
BEAM, LAMP, MIRROR = (TEMPLATES / f"{name}.toml" for name in ("thu", "disk", "mirror"))
RGB = "[[486.1, 1.0], [587.6, 2.0], [656.3, 1.0]]"

SOURCES = [
    (BEAM, {"source.wavelength": RGB}, {"wavelength": ((486.1, 1.0), (587.6, 2.0), (656.3, 1.0))}),
    (BEAM, {"source.divergence": "0.53"}, {"divergence": 0.53}),
    (BEAM, {"source.tilt": "[3.0, -2.0]", "source.z": "-50"}, {"tilt": (3.0, -2.0), "z": -50.0}),
    (BEAM, {"source.centre": "[1.0, 0.5]"}, {"centre": (1.0, 0.5)}),
    (BEAM, {"source.real_divergence": "1"}, {"real_divergence": 1.0}),
    (LAMP, {"source.diameter": "1"}, {"diameter": 1.0}),
    (LAMP, {"source.width": "1", "source.height": "0"}, {"width": 1.0, "height": 0.0}),
    (LAMP, {"source.tilt": "[30, 0]"}, {"tilt": (30.0, 0.0)}),
    (LAMP, {"source.real_diameter": "2"}, {"real_diameter": 2.0}),
]


@pytest.mark.parametrize(("path", "changes", "fields"), SOURCES, ids=[str(list(c)) for _, c, _ in SOURCES])
def test_what_is_said_of_a_source_is_kept(path, changes, fields, tmp_path):
    scene = load(path, changes)
    for name, value in fields.items():
        assert getattr(scene.source, name) == value
    copy = tmp_path / "scene.toml"
    copy.write_text(scene.toml())
    assert load(copy) == scene
    plain = load(path)
    same = plain.changed({f"source.{name}": value for name, value in fields.items()})
    assert same == scene
    assert scene.changed({"source": plain.source}) == plain  # a record replaces all of it


def test_a_scene_without_these_says_nothing_of_them():
    for path in sorted(TEMPLATES.glob("*.toml")):
        scene = load(path)
        if scene.source.extent is None:
            assert "source_points" not in scene.toml()
        if isinstance(scene.source.wavelength, float) and scene.source == scene.source.central:
            assert scene.channels() == scene.judging_channels()
            assert [c.source for c in scene.channels()] == [scene.source]


def test_points_of_an_extended_source_are_a_knob():
    scene = load(LAMP, {"source.diameter": "1", "tailoring.quality": "draft"})
    points = scene.tailoring.resolved(65).source_points
    assert len(scene.channels()) == points and f"source_points {points}" in scene.toml()
    assert len(scene.changed({"tailoring.source_points": 12}).channels()) == 12
    assert len(scene.channels(20)) == 20


def test_a_judge_shares_no_point_with_tailoring():
    scene = load(LAMP, {"source.diameter": "1", "source.wavelength": RGB})
    both = scene.judging_channels(), scene.channels(JUDGE_POINTS)
    judges, known = ({c.source.position for c in found} for found in both)
    assert len(judges) == JUDGE_POINTS and not judges & known


def test_each_line_has_the_index_of_its_own():
    scene = load(BEAM, {"source.wavelength": RGB})
    assert {c.source.wavelength: c.index for c in scene.channels()} == {
        nm: refractive_index("PMMA", nm) for nm in (486.1, 587.6, 656.3)
    }
    assert scene.index == refractive_index("PMMA", 587.6) and scene.channels()[0].source.wavelength == 587.6
    assert math.fsum(c.weight for c in scene.channels()) == 1.0


def test_a_mirror_knows_no_colours():
    scene = load(MIRROR, {"source.wavelength": RGB})
    assert [(c.index, c.weight) for c in scene.channels()] == [(1.0, 1.0)]


def test_one_line_may_have_a_mere_index():
    one = {"source.wavelength": "[[587.6, 0.3]]", "lens.index": "1.5"}
    [channel] = load(BEAM, one).channels()
    assert channel.source.wavelength == 587.6 and channel.index == 1.5


@pytest.mark.parametrize(
    ("path", "changes", "kind"),
    [
        (BEAM, {"source.tilt": "[60, 0]"}, Collimated),
        (LAMP, {"source.tilt": "[100, 0]"}, Point),  # a Lambertian source lights half of all directions
        (LAMP, {"source.diameter": "15"}, Point),
        (MIRROR, {"source.tilt": "[0, 20]", "source.diameter": "2"}, Point),
    ],
)
def test_what_is_possible_is_not_refused(path, changes, kind):
    assert isinstance(load(path, changes).source, kind)
