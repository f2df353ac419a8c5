"""The gallery: its scenes load, and a reader decodes the QR code from the light of its lens."""

import os
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import zxingcpp

import bstcad
from bstcad.api import Design
from tests import suite
from tests.efforts import designed_quickly

GALLERY = Path(__file__).parent.parent / "docs" / "gallery-scripts"
WORDS = "https://pypi.org/project/bstcad"


@pytest.mark.parametrize("script", sorted(GALLERY.glob("*.py")), ids=lambda path: path.stem)
def test_each_script_has_its_scene(script):
    scene = bstcad.load(script.with_suffix(".toml"))
    assert not [warning for warning in scene.warnings() if "real_" not in warning]
    assert f'"{script.stem}.toml"' in script.read_text(encoding="utf-8")


def chosen_script():
    """A script by the number of the commit, so that each is run by some commits; without git, by the version."""
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, cwd=GALLERY, check=False)
    scripts = sorted(GALLERY.glob("*.py"))
    return scripts[zlib.crc32((commit.stdout or bstcad.__version__).encode()) % len(scripts)]


@suite.in_turn(1, 3)
def test_a_script_of_the_gallery_runs_to_its_end(tmp_path):
    """One of the scripts, which another commit changes, in draft quality; `make docs` runs all."""
    script = chosen_script()
    for path in GALLERY.iterdir():
        if path.is_file():
            text = path.read_bytes()
            for quality in (b"standard", b"fine"):
                text = text.replace(b'quality = "%s"' % quality, b'quality = "draft"')
            (tmp_path / path.name).write_bytes(text)
    (tmp_path / "outputs").mkdir()
    source = str(GALLERY.parent.parent)
    ended = subprocess.run(
        [sys.executable, script.name], cwd=tmp_path, env=os.environ | {"PYTHONPATH": source, "MPLBACKEND": "agg"},
        capture_output=True, text=True, timeout=1200, check=False,
    )  # fmt: skip
    if ended.returncode and "cannot draw in three dimensions" in ended.stderr:
        pytest.skip("this machine cannot draw in 3-D")
    assert ended.returncode == 0, f"{script.name}: {ended.stderr[-2000:]}"
    assert any((tmp_path / "outputs").rglob("*.png"))


def test_a_reader_decodes_the_qr_code_from_the_light():
    """The lens has three eighths of the pixels and of the control points of the gallery's; few flux tubes judge it."""
    code = zxingcpp.create_barcode(WORDS, zxingcpp.BarcodeFormat.QRCode)
    modules = np.maximum(np.array(code.to_image(scale=1)) / 255.0, 0.02)
    scene = bstcad.load(GALLERY / "lens_10_qr.toml").changed({
        "target.image": np.kron(modules, np.ones((3, 3))), "target.pixels": 99, "lens.back.control_points": 97,
        "tailoring.quality": "draft",
    })  # fmt: skip
    picture = Design(designed_quickly(scene)).picture()
    read = zxingcpp.read_barcode(picture)
    assert read.text == WORDS and abs(read.orientation) < 10  # degrees: upright
