"""The table [moulding]: what a shrinkage means, and what parts that were made in the cavity say of it."""

import pytest

import bstcad
from bstcad.scene.errors import SceneError
from bstcad.scene.moulding import Moulding

SCENE = "templates/disk.toml"


def test_the_two_meanings_differ_by_7_5_micrometres_on_300_mm():
    of_cavity, of_part = (Moulding(shrinkage=0.005, relative_to=which) for which in ("cavity", "part"))
    assert Moulding(shrinkage=0.005) == of_cavity
    lengths = [300.0 * moulding.factors[0] for moulding in (of_cavity, of_part)]
    assert lengths == pytest.approx([300.0 / 0.995, 301.5], abs=1e-12)
    assert 1e3 * (lengths[0] - lengths[1]) == pytest.approx(7.5, abs=0.05)


@pytest.mark.parametrize("which", ["cavity", "part"])
def test_the_measured_part_gives_the_shrinkage_by_which_the_next_has_the_size_of_the_design(which):
    """A part shrinks by other fractions than were assumed; the cavity by the measured ones makes up for it."""
    assumed, true = Moulding(shrinkage=0.006, relative_to=which), (0.005, 0.0055, 0.0065)
    scales = [factor * (1 - s) for factor, s in zip(assumed.factors, true, strict=True)]
    found = Moulding(shrinkage=assumed.as_measured(scales), relative_to=which)
    assert [factor * (1 - s) for factor, s in zip(found.factors, true, strict=True)] == pytest.approx([1.0] * 3)
    if which == "cavity":
        assert found.per_axis == pytest.approx(true)


def test_the_words_state_the_meaning():
    assert Moulding(shrinkage=0.005).words() == (
        "s = 0.005 relative to the cavity: cavity = part / (1 - s), ISO 294-4; cavity / part = 1.0050251"
    )
    words = Moulding(shrinkage=(0.004, 0.005, 0.006), relative_to="part").words()
    assert "cavity = part (1 + s)" in words and "0.005 in y" in words and "1.006 in z" in words


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"moulding.shrinkage": 0.6}, "moulding.shrinkage: 0.6 is not between 0 and 0.2; give a fraction, such as"),
        ({"moulding.shrinkage": [0.005, 0.005]}, "moulding.shrinkage"),
        ({"moulding": {"shrinkage": 0.005, "relative_to": "mould"}}, "moulding.relative_to"),
        ({"output.export": ["cavity"]}, 'output.export: "cavity" needs the shrinkage of the moulding; add the table'),
    ],
)
def test_a_wrong_table_is_one_sentence(changes, words):
    with pytest.raises(SceneError) as error:
        bstcad.load(SCENE).changed(changes)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_a_scene_with_a_shrinkage_is_written_and_read_again(tmp_path):
    for shrinkage in (0.005, [0.005, 0.006, 0.004]):
        scene = bstcad.load(SCENE).changed({"moulding.shrinkage": shrinkage, "output.export": ["cavity"]})
        assert scene.moulding.per_axis == pytest.approx(shrinkage if isinstance(shrinkage, list) else [shrinkage] * 3)
        (tmp_path / "scene.toml").write_text(scene.toml())
        assert bstcad.load(tmp_path / "scene.toml").moulding == scene.moulding
