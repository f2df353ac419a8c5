"""What the effects that a scene names come to."""

from pathlib import Path

from bstcad.optics.ghosts import ghost_light
from bstcad.optics.losses import Coating, Fresnel
from bstcad.report.assemble import simulated
from bstcad.scene.scene import load

DISK = Path(__file__).parent.parent.parent / "templates" / "disk.toml"


def losses(*effects):
    (channel,) = load(DISK, {"effects": list(effects)}).channels()
    return channel.losses


def test_who_names_a_ghost_has_the_reflections_of_its_faces():
    assert load(DISK, {"effects": [{"kind": "ghost"}]}).ghost is ghost_light
    assert losses({"kind": "ghost"}) == losses({"kind": "fresnel"})
    assert losses({"kind": "ghost"}).fresnel == Fresnel(587.6)


def test_a_ghost_goes_by_the_coating_that_is_named():
    coated = {"kind": "fresnel", "coating": {"index": 1.38, "thickness": 100.0}, "polarisation": "s"}
    for effects in ((coated, {"kind": "ghost"}), ({"kind": "ghost"}, coated)):
        assert losses(*effects).fresnel == Fresnel(587.6, "s", Coating(1.38, 100.0))


def test_a_scene_without_a_ghost_has_no_way_to_follow_one():
    assert load(DISK).ghost is None and load(DISK, {"effects": [{"kind": "fresnel"}]}).ghost is None


def test_what_is_simulated_names_the_reflection_that_a_ghost_brings():
    """And once only, where the scene names it too."""
    for effects in ([{"kind": "ghost"}], [{"kind": "fresnel"}, {"kind": "ghost"}]):
        said = [words for words, _ in simulated(load(DISK, {"effects": effects}))]
        assert [what.startswith("Fresnel reflection") for what in said].count(True) == 1
        assert any(what.startswith("ghosts") for what in said)
