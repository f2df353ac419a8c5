"""The gallery: its scenes load, and a reader decodes the QR code from the light of its lens."""

import sys
from pathlib import Path

import numpy as np
import pytest
import zxingcpp

import bstcad

GALLERY = Path(__file__).parent.parent / "docs" / "gallery-scripts"
sys.path.append(str(GALLERY.parent / "_ext"))
from gallery_pictures import written  # noqa: E402

WORDS = "https://pypi.org/project/bstcad"


@pytest.mark.parametrize("script", sorted(GALLERY.glob("*.py")), ids=lambda path: path.stem)
def test_each_script_has_its_scene(script):
    scene = bstcad.load(script.with_suffix(".toml"))
    assert not [warning for warning in scene.warnings() if "real_" not in warning]
    assert f'"{script.stem}.toml"' in script.read_text(encoding="utf-8")


def test_a_page_shows_the_pictures_of_all_targets_and_of_the_wave(tmp_path):
    for name in ("wall", "wall_2", "figures/irradiance_2", "figures/irradiance", "figures/wavefront", "figures/lens",
                 "figures/cross_section"):  # fmt: skip
        path = tmp_path / f"{name}.png"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"")
    shown = [path.stem for path in written(tmp_path)]
    assert shown == ["wall", "wall_2", "irradiance", "irradiance_2", "wavefront", "lens"]


def test_each_template_of_two_faces_has_a_page():
    titles = {bstcad.load(path).name for path in GALLERY.glob("*.toml")}
    assert {"beam_shaper", "two_pictures", "collimated"} <= titles
    script = (GALLERY / "lens_15_two_pictures.py").read_text(encoding="utf-8")
    assert 'wall.png")' in script and 'wall_2.png", target=1)' in script


def test_a_reader_decodes_the_qr_code_from_the_light():
    """On half the pixels of the gallery's lens and half its control points, by a glance with few ray tubes."""
    code = zxingcpp.create_barcode(WORDS, zxingcpp.BarcodeFormat.QRCode)
    modules = np.maximum(np.array(code.to_image(scale=1)) / 255.0, 0.02)
    scene = bstcad.load(GALLERY / "lens_10_qr.toml").changed({
        "target.image": np.kron(modules, np.ones((4, 4))), "target.pixels": 132, "lens.back.control_points": 129,
        "tailoring.quality": "draft",
    })  # fmt: skip
    picture = bstcad.design(scene, progress=False).picture()
    read = zxingcpp.read_barcode(picture)
    assert read.text == WORDS and abs(read.orientation) < 10  # degrees: upright
