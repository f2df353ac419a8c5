"""The gallery: its scenes load, and a reader decodes the QR code from the light of its lens."""

import re
import runpy
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import zxingcpp

import bstcad
from bstcad.api import Design
from bstcad.designs import pipeline
from bstcad.scene.errors import MachineError
from tests import suite
from tests.conftest import draws_nothing, quick_effort, verify_with
from tests.efforts import LITTLE, designed_quickly

GALLERY = Path(__file__).parent.parent / "docs" / "gallery-scripts"
WORDS = "https://pypi.org/project/bstcad"


@pytest.mark.parametrize("script", sorted(GALLERY.glob("*.py")), ids=lambda path: path.stem)
def test_each_script_has_its_scene(script):
    scene = bstcad.load(script.with_suffix(".toml"))
    assert not [warning for warning in scene.warnings() if "real_" not in warning]
    assert f'"{script.stem}.toml"' in script.read_text(encoding="utf-8")


def halved(text):
    """Return the text of a scene in draft quality with half of the pixels and of the control points, or 33 of these."""
    text = re.sub(r'quality = "\w+"', 'quality = "draft"', text)
    text = _with_counts(text, "pixels", lambda count: count // 2)
    return _with_counts(text, "control_points", lambda count: min(count, max(count // 2 + 1, 33)))


def _with_counts(text, key, changed):
    """Change each whole number that a scene states for a key."""
    return re.sub(
        rf"(?<={key} = )[\d, []+", lambda found: re.sub(r"\d+", lambda n: str(changed(int(n[0]))), found[0]), text
    )


@suite.in_turn(1, 3)
def test_a_script_of_the_gallery_runs_to_its_end(tmp_path, monkeypatch):
    """One of the scripts, which another commit changes, on a smaller scene; `make docs` runs all as they are."""
    scripts = sorted(GALLERY.glob("*.py"))
    script = scripts[suite.turn(len(scripts))]
    for path in GALLERY.iterdir():
        if path.suffix == ".toml":
            (tmp_path / path.name).write_text(halved(path.read_text(encoding="utf-8")), encoding="utf-8")
        elif path.is_file():
            shutil.copy(path, tmp_path)
    (tmp_path / "outputs").mkdir()
    monkeypatch.chdir(tmp_path)
    draws_nothing(monkeypatch)  # pictures of reports; those of the script are drawn
    verify_with(monkeypatch, quick_effort())
    monkeypatch.setattr(pipeline, "DesignOptions", partial(pipeline.DesignOptions, effort=LITTLE))
    try:
        runpy.run_path(script.name, run_name="__main__")
    except MachineError as refusal:
        if "cannot draw in three dimensions" in str(refusal):
            pytest.skip("this machine cannot draw in 3-D")
        raise
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
