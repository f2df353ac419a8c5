"""The [part] table: what lens.step says of the lens besides its shape."""

from pathlib import Path

import pytest

from bstcad.scene.part import GLASS, METAL, Part
from bstcad.scene.scene import load

TEMPLATES = Path(__file__).parent.parent.parent / "templates"
DISK = TEMPLATES / "disk.toml"
FULL = {
    "number": "LE-017", "author": "Änne O'Hara", "organisation": "Optics & Co", "material": "PMMA, cast",
    "density": 1.185, "colour": "#10a0ff40", "surface_profile": 0.005,
    "front_profile": 0.01, "roughness": 5.0, "coating": "AR 450 to 650 nm, both faces", "thickness_tolerance": 0.05,
    "date": "2031-05-06",
}  # fmt: skip


def test_a_scene_without_the_table_says_what_is_known():
    scene = load(DISK)
    assert scene.part == Part()
    assert scene.part.of(scene.lens) == Part(material="PMMA", density=1.19, colour=GLASS)


@pytest.mark.parametrize(("material", "name", "density"), [
    ("N-BK7", "N-BK7", pytest.approx(2.51, abs=0.01)),  # its page says it
    ("acrylic", "PMMA", 1.19),
    ("other/Optorez1330/Sultanova", "other/Optorez1330/Sultanova", None),  # nobody has said it
])  # fmt: skip
def test_a_density_is_the_material_s_or_absent(material, name, density):
    scene = load(DISK, {"lens.material": material})
    assert scene.part.of(scene.lens) == Part(material=name, density=density, colour=GLASS)


def test_an_index_is_no_material_and_words_of_one_s_own_have_no_density():
    scene = load(DISK, {"lens.index": 1.5})
    assert scene.part.of(scene.lens) == Part(colour=GLASS)
    scene = load(DISK, {"part.material": "PMMA, cast"})
    assert scene.part.of(scene.lens) == Part(material="PMMA, cast", colour=GLASS)


def test_a_mirror_is_grey():
    scene = load(TEMPLATES / "mirror.toml", {"part.material": "Al 6061", "part.density": 2.7})
    assert scene.part.of(scene.lens) == Part(material="Al 6061", density=2.7, colour=METAL)


@pytest.mark.parametrize("table", [FULL, {"schema": "AP214"}, {}])
def test_it_survives_a_file(table, tmp_path):
    scene = load(DISK, {f"part.{key}": value for key, value in table.items()})
    (tmp_path / "scene.toml").write_text(scene.toml(), encoding="utf-8")
    again = load(tmp_path / "scene.toml")
    assert again == scene and again.part == Part(**table)
    assert scene.changed({"part.number": "8"}).part.number == "8"
