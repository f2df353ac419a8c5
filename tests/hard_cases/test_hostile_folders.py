"""15. Truncated, hostile and huge files.

Here a folder that somebody sent: claims, bombs and holes of gigabytes, each found before memory is spent; an earlier
report that says anything; pipes, devices and links, and names that would lead out of the folder that is written.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import re
import shutil
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bstcad import commands
from bstcad.commands import ProofOptions
from bstcad.designs import folder as folders
from bstcad.designs.course import DesignCourse
from bstcad.optics.trace.measure import Effort
from bstcad.report import record
from bstcad.scene.picture import Picture, read_picture
from bstcad.scene.scene import SceneError, load
from tests import suite
from tests.conftest import draws_nothing, flat_pictures, verify_with
from tests.hard_cases import fuzz
from tests.scenes import DISK, SMALL

GIGABYTE = 2**30


def hole(path, size):
    """A file of so many bytes of nothing, which takes no room."""
    path.unlink(missing_ok=True)
    with path.open("wb") as file:
        file.truncate(size)


@contextlib.contextmanager
def spending(what, bound, holds):
    """Record the memory that the block holds at most, as Python and numpy count it."""
    tracemalloc.start()
    try:
        yield
        holds(f"{what}: memory", tracemalloc.get_traced_memory()[1] / 1e6, bound, "MB")
    finally:
        tracemalloc.stop()


@pytest.fixture
def quick_folder(small_design, tmp_path, monkeypatch):
    """The small design in a folder of its own beside nothing else; verified by few rays and without pictures."""
    monkeypatch.setattr(commands.processes, "submit", commands.processes.run_here)
    draws_nothing(monkeypatch)
    verify_with(monkeypatch, Effort(64, places=65, points=512))
    return Path(shutil.copytree(small_design.folder, tmp_path / "design"))


@pytest.fixture
def refused(holds):
    """refused(read, sentence, name of the figure): one sentence, found before memory is spent.

    Once before, so that libraries that load on their first use do.
    """

    def refused(read, sentence, figure):
        with pytest.raises((SceneError, ValueError)):
            read()
        with spending(figure, 30.0, holds), pytest.raises((SceneError, ValueError), match=sentence) as caught:
            read()
        assert str(caught.value).isprintable() and ";" in str(caught.value)

    return refused


# ---- sizes -----------------------------------------------------------------------------------------------------------


def npy(kind, shape, data=b"", version=1):
    """An array file whose header says what it likes."""
    header = repr({"descr": kind, "fortran_order": False, "shape": shape}).encode()
    return b"\x93NUMPY" + bytes([version, 0]) + len(header).to_bytes(2 if version == 1 else 4, "little") + header + data


def altered(path, start, data):
    """A file with other bytes from a place on."""
    path.write_bytes(path.read_bytes()[:start] + data + path.read_bytes()[start + len(data) :])


def net(folder, data, method=zipfile.ZIP_DEFLATED):
    """design.npz with these bytes as its control points."""
    with zipfile.ZipFile(folder / "design.npz") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(folder / "design.npz", "w", method) as archive:
        for name, kept in members.items():
            archive.writestr(name, data if data and name == "control_points.npy" else kept)


SHAPE = r"design\.npz: cannot be read .*is not a \(33, 33, 3\) array.*; generate"
FILES = {  # changes of a file of the folder, and the sentence of the refusal
    "a STEP file of gigabytes": (lambda f: hole(f / "lens.step", 2 * GIGABYTE), r"lens\.step: .*larger than 600 MB"),
    "an archive of gigabytes": (lambda f: hole(f / "design.npz", 3 * GIGABYTE), r"is larger than 3\.\d+ MB"),
    "an STL that claims 2 GB": (
        lambda f: altered(f / "lens.stl", 80, np.uint32(2 * GIGABYTE // 50).tobytes()), "binary STL: it states 4294967",
    ),
    "a bomb of half a GB": (lambda f: net(f, npy("<f8", (33, 33, 3), bytes(GIGABYTE // 2))), "is larger than"),
    "a claim of 8 TB": (lambda f: net(f, npy("<f8", (10**12,))), SHAPE),
    "a number of 1 GB": (lambda f: net(f, npy(f"|V{GIGABYTE}", (33, 33, 3))), SHAPE),
    "a header of brackets": (lambda f: net(f, npy("<f8", ()).replace(b"()", b"(" * 900)), "be read .*; generate"),
    "a header of 4 GB": (lambda f: net(f, npy("<f8", (33, 33, 3), version=2)), "not an array written by bstcad"),
    "another packing": (lambda f: net(f, b"", zipfile.ZIP_LZMA), "unknown method"),  # whose reader takes no limit
}  # fmt: skip


@pytest.mark.parametrize("file", suite.in_turns(FILES, 2))
def test_a_file_that_is_or_claims_or_unfolds_to_gigabytes_is_not_read(quick_folder, refused, file):
    change, sentence = FILES[file]
    change(quick_folder)
    refused(lambda: commands.verify(quick_folder), sentence, "a file of gigabytes, or whose header claims gigabytes")


def tiff(tile):
    """Eight pixels in tiles that are larger."""
    tags = {256: 8, 257: 8, 258: 8, 259: 8, 262: 1, 273: 8, 277: 1, 278: 8, 279: 64} | tile  # deflated
    table = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in sorted(tags.items()))
    return b"II*\0" + struct.pack("<I", 72) + bytes(64) + struct.pack("<H", len(tags)) + table + bytes(4)


def claiming(form, side):
    """A small picture whose header says that it has side x side pixels."""
    if form == "BMP":
        return b"BM" + struct.pack("<IHHI", 54, 0, 0, 54) + struct.pack("<IiiHHIIiiII", 40, side, side, 1, 8, *[0] * 6)
    if form == "WEBP":
        moving = fuzz.good_picture("WEBP", "RGBA", {"save_all": True})
        return moving[:24] + 2 * (side - 1).to_bytes(3, "little") + moving[30:]
    sizes, good = struct.pack(">II", side, side), fuzz.good_picture("HEIF", "RGB", {}, side=16)
    return re.sub(rb"(ispe....)........", lambda hit: hit[1] + sizes, good, flags=re.DOTALL)


def long_png(*size):
    out = io.BytesIO()
    Image.new("1", size).save(out, "PNG")
    return out.getvalue()


MANY, TILES = "million.*; shrink it", "tiles of more than"
PICTURES = {
    "long": (lambda: long_png(64_000_000, 1), "along a side; shrink it"),
    "tiles": (lambda: tiff({322: 65_520, 323: 65_520}), TILES),
    "BMP over our limit": (lambda: claiming("BMP", 8001), MANY),
    "the largest WebP": (lambda: claiming("WEBP", 16_383), MANY),
    "HEIF over our limit": (lambda: claiming("HEIF", 8001), MANY),
}


@pytest.mark.parametrize("picture", suite.in_turns(PICTURES, 2))
def test_a_picture_that_claims_too_many_pixels_is_refused_before_it_is_decoded(tmp_path, picture, refused):
    make, sentence = PICTURES[picture]
    (tmp_path / "p").write_bytes(make())
    refused(lambda: read_picture(tmp_path / "p"), sentence, "pictures whose headers claim millions of pixels")


# ---- report.json, which an earlier run may have left, or anybody -----------------------------------------------------

REPORTS = {
    "huge": lambda: '{"history": [' + ",".join(['{"seconds": 1.0, "rrmsd": 0.1}'] * 700_000) + "]}",
    "deep": lambda: "[" * 1_000_000,
    "a long number": lambda: '{"seconds_total": ' + "9" * 4000 + "}",
    "stages of other kinds": lambda: '{"stages": [1, {"name": [], "seconds": "x", "rrmsd": null}]}',
    "a history that no axis holds": lambda: '{"history": [{"seconds": 1e300, "rrmsd": 0.0}]}',
    "passed": lambda: '{"passed": true, "checks": [], "rrmsd": 0.0, "rrmsd_noise": 0, "shape": {"volume": "x"}}',
}


def test_an_earlier_report_that_does_not_fit_is_not_believed(quick_folder, holds):
    path = quick_folder / "report.json"
    for text in REPORTS.values():
        path.write_text(text())
        assert record.read_course(path) == DesignCourse()
        with pytest.raises(ValueError, match="report.json: cannot be read .*; run bstcad verify"):
            record.read(path)
    path.write_text(REPORTS["huge"]())
    with spending("a huge report.json", 300.0, holds):
        record.read_course(path)
    path.write_text(REPORTS["passed"]())
    found, kept = commands.verify(quick_folder).facts, [field.name for field in dataclasses.fields(DesignCourse)]
    assert {name for name in kept if found.get(name)} == {"machine", "versions"}
    assert "python" in found["versions"] and found["machine"]["cores"]
    written = json.loads(path.read_text())
    assert written["stages"] == [] and written["passed"] == found["passed"]
    assert written["checks"] and written["rrmsd"] > 0


NO_FILES = [
    ("pipe", "lens.step"), ("pipe", "design.npz"), ("pipe", "report.json"), ("device", "scene.toml"),
    ("process", "scene.toml"), ("folder", "lens.stl"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "name"), suite.in_turns(NO_FILES, 2))
def test_what_is_no_file_is_one_sentence_or_left_out(quick_folder, kind, name):
    """A pipe does not end; /dev/zero neither; some of /proc cannot be read, though they say they are files."""
    path = quick_folder / name
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to({"device": "/dev/zero", "process": "/proc/self/mem"}[kind])
    if name == "report.json":
        commands.verify(quick_folder)
        assert path.is_file() and not path.is_symlink()
        return
    sentence = "name: missing" if (kind, name) == ("process", "scene.toml") else name  # an empty one, as it says itself
    with pytest.raises(SceneError, match=sentence) as caught:
        commands.verify(quick_folder)
    assert str(caught.value).isprintable() and ";" in str(caught.value)


@pytest.mark.parametrize("image", ["/proc/self/mem", "/dev/zero", "a" * 300 + ".png", "a\0b", ".", "pipe"])
def test_an_image_that_is_no_file_is_one_sentence(tmp_path, image):
    os.mkfifo(tmp_path / "pipe")
    path = tmp_path / "scene.toml"  # in whose folder the image is looked for
    shutil.copy(DISK, path)
    with pytest.raises(SceneError, match=r"target\.image: .*; ") as caught:
        load(path, {"target.image": image})
    assert str(caught.value).isprintable()


def test_a_report_is_not_written_through_links_and_a_title_is_no_markup(quick_folder, tmp_path, holds):
    """A folder that was sent: its report and figures lead to files of the reader, its title to a script."""
    text = (quick_folder / "scene.toml").read_text().replace("A <small> disc", "<script>alert(1)</script> & [red]")
    (quick_folder / "scene.toml").write_text(text)
    victim, elsewhere = tmp_path / "precious", tmp_path / "elsewhere"
    victim.write_text("mine")
    elsewhere.mkdir()
    shutil.rmtree(quick_folder / "figures")
    for name in ("report.json", "report.html"):
        (quick_folder / name).unlink()
        (quick_folder / name).symlink_to(victim)
    (quick_folder / "figures").symlink_to(elsewhere, target_is_directory=True)
    (quick_folder / ".report.json.new").symlink_to(victim)
    commands.verify(quick_folder, options=ProofOptions(drawing=flat_pictures()))
    assert victim.read_text() == "mine" and not (quick_folder / "report.json").is_symlink()
    holds("a folder of a stranger: files written outside it", len(list(elsewhere.iterdir())), 0)
    assert list((quick_folder / "figures").iterdir())
    page = (quick_folder / "report.html").read_text()
    assert "<script>alert" not in page and "&lt;script&gt;alert" in page


NAMES = (
    "../../x", "..\\..\\x", "/etc/passwd", "C:\\x", "NUL", "a\0b", "\x1b[2J", "x" * 5000, "．．／x", "\u202excod",
    "...", "-rf", "`id`", "lens.step", "figures", "名前", " x ",
)  # fmt: skip


def test_no_name_leads_out_of_the_folder(tmp_path, monkeypatch, holds):
    """The scene's name names the folder, the picture's the copy within: end to end, on a file of that very name."""
    monkeypatch.setattr(folders, "_flush", lambda path: None)  # which takes the time of a disk
    home = tmp_path / "home" / "of" / "scenes"
    home.mkdir(parents=True)
    grey = io.BytesIO()
    Image.new("L", (8, 8), 200).save(grey, "PNG")
    for number, name in enumerate(NAMES):
        image = home / name.replace("/", "∕").replace("\0", "")[:60]  # what a file system takes
        image.write_bytes(grey.getvalue())
        changes = SMALL | {"target.image": str(image), "target.pixels": 12}
        try:
            scene = load(DISK, changes | {"name": name})
        except SceneError as error:
            assert str(error).startswith("name: ")
            scene = load(DISK, changes)
        place = tmp_path / f"out{number}"
        with folders.replacing(place / scene.name) as building:
            folders.write_geometry(folders.DesignedLens(scene, scene.flat_lens(9), scene.goals), building)()
        made = {path.relative_to(place) for path in place.rglob("*") if path.is_file()}
        assert {path.parts[0] for path in made} == {scene.name} and all(len(path.parts) == 2 for path in made)
        copied = {path.name for path in made} - {"lens.step", "lens.stl", "lens.3mf", "scene.toml"}
        assert len(copied) == 1 and copied.pop().endswith(".png")
        assert load(place / scene.name / "scene.toml") == scene
    outside = {path.name for path in tmp_path.iterdir()} - {f"out{n}" for n in range(len(NAMES))} - {"home"}
    holds("hostile names: files written outside the folder", len(outside), 0)


@pytest.mark.parametrize("name", ["../x.png", "a\\b.png", "", "a\0.png", "nul.png"])
def test_a_picture_made_in_python_has_a_plain_name_too(name):
    with pytest.raises(ValueError, match="is not a safe file name"):
        Picture(name, b"")
