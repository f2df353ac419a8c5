"""The gallery: its scenes load, and a reader decodes the QR code from the light of its lens."""

from pathlib import Path

import numpy as np
import pytest
import zxingcpp

import bstcad

GALLERY = Path(__file__).parent.parent / "docs" / "gallery-scripts"
WORDS = "https://pypi.org/project/bstcad"


@pytest.mark.parametrize("script", sorted(GALLERY.glob("*.py")), ids=lambda path: path.stem)
def test_each_script_has_its_scene(script):
    scene = bstcad.load(script.with_suffix(".toml"))
    assert not [warning for warning in scene.warnings() if "real_" not in warning]
    assert f'"{script.stem}.toml"' in script.read_text(encoding="utf-8")


def test_a_reader_decodes_the_qr_code_from_the_light():
    """The lens has half the pixels and half the control points of the gallery's, and few flux tubes judge it."""
    code = zxingcpp.create_barcode(WORDS, zxingcpp.BarcodeFormat.QRCode)
    modules = np.maximum(np.array(code.to_image(scale=1)) / 255.0, 0.02)
    scene = bstcad.load(GALLERY / "lens_10_qr.toml").changed({
        "target.image": np.kron(modules, np.ones((4, 4))), "target.pixels": 132, "lens.back.control_points": 129,
        "tailoring.quality": "draft",
    })  # fmt: skip
    picture = bstcad.design(scene, progress=False).picture()
    read = zxingcpp.read_barcode(picture)
    assert read.text == WORDS and abs(read.orientation) < 10  # degrees: upright
