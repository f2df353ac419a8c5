"""14. Truncated, hostile or huge input.

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

import numpy as np
import pytest
from PIL import Image

from bstcad import commands
from bstcad import folder as folders
from bstcad.cad import mesh
from bstcad.report import record
from bstcad.report.record import Making
from bstcad.scene.picture import Picture, read_picture
from bstcad.scene.scene import SceneError, load
from tests.conftest import DISK, SMALL, flat_pictures
from tests.hard_cases import fuzz

GIGABYTE = 2**30


def hole(path, size):
    """A file of so many bytes of nothing, which takes no room."""
    path.unlink(missing_ok=True)
    with path.open("wb") as file:
        file.truncate(size)


@contextlib.contextmanager
def spending(what, bound, holds):
    """What the block holds in memory at most is a figure; as Python and numpy count it, whatever came before."""
    tracemalloc.start()
    try:
        yield
        holds(f"{what}: memory", tracemalloc.get_traced_memory()[1] / 1e6, bound, "MB")
    finally:
        tracemalloc.stop()


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


@pytest.mark.parametrize(("name", "limit"), [("lens.step", 600), ("lens.stl", 1600), ("scene.toml", 1)])
def test_files_of_gigabytes_are_not_read(quick_folder, refused, name, limit):
    hole(quick_folder / name, 2 * GIGABYTE)
    refused(lambda: commands.verify(quick_folder), rf"{name}: .*over {limit} MB", "files of gigabytes")


def test_an_stl_that_claims_gigabytes_is_not_read(quick_folder, refused):
    path = quick_folder / "lens.stl"
    path.write_bytes(path.read_bytes()[:80] + np.uint32(2 * GIGABYTE // 50).tobytes() + path.read_bytes()[84:])
    refused(lambda: commands.verify(quick_folder), "no binary STL of 42949672", "an STL that claims 2 GB")
    path.write_bytes(bytes(84))
    refused(lambda: mesh.read_stl(path), r"lens\.stl: 84 bytes, no binary STL", "files of gigabytes")


def npy(kind, shape, data=b"", version=1):
    """An array file whose header says what it likes."""
    header = repr({"descr": kind, "fortran_order": False, "shape": shape}).encode()
    return b"\x93NUMPY" + bytes([version, 0]) + len(header).to_bytes(2 if version == 1 else 4, "little") + header + data


def packed(path, method=zipfile.ZIP_DEFLATED, **members):
    """design.npz with some members replaced."""
    with zipfile.ZipFile(path) as archive:
        kept = {name.removesuffix(".npy"): archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in (kept | members).items():
            archive.writestr(f"{name}.npy", data)


OBJECTS = io.BytesIO()
np.save(OBJECTS, np.array([{"a": 1}], dtype=object), allow_pickle=True)
SHAPE = r"design\.npz: cannot be read .*is not \(33, 33, 3\) numbers.*; generate"
UNREADABLE = r"design\.npz: cannot be read .*; generate"
ARRAYS = {  # control_points.npy: (its bytes, or how to make them; why it is refused)
    "a bomb of half a GB": (lambda: npy("<f8", (33, 33, 3), bytes(GIGABYTE // 2)), "holds 5368709"),
    "a claim of 8 TB": (lambda: npy("<f8", (10**12,)), SHAPE),
    "a claim of 8 EB": (lambda: npy("<f8", (10**18, 10**18)), SHAPE),
    "a number of 1 GB": (lambda: npy(f"|V{GIGABYTE}", (33, 33, 3)), SHAPE),
    "negative sides": (lambda: npy("<f8", (-33, -33, 3)), SHAPE),
    "objects": (OBJECTS.getvalue, SHAPE),
    "a header of brackets": (lambda: npy("<f8", (), b"").replace(b"()", b"(" * 900), UNREADABLE),
    "a header of 4 GB": (lambda: npy("<f8", (33, 33, 3), version=2), "no array of this program"),
    "nothing": (lambda: b"", UNREADABLE),
}
CLAIMS = "design.npz that claims or unfolds to gigabytes"


@pytest.mark.parametrize("array", ARRAYS)
def test_arrays_that_claim_or_unfold_to_gigabytes_are_refused(small_design, tmp_path, refused, array):
    make, reason = ARRAYS[array]
    folder = shutil.copytree(small_design.folder, tmp_path / "design")
    packed(folder / "design.npz", control_points=make())
    refused(lambda: folders.read_nominal(folder), reason, CLAIMS)


def test_an_archive_of_gigabytes_or_of_another_packing_is_refused(small_design, tmp_path, refused):
    folder = shutil.copytree(small_design.folder, tmp_path / "design")
    packed(folder / "design.npz", zipfile.ZIP_LZMA)  # whose reader takes no limit
    refused(lambda: folders.read_nominal(folder), "control_points holds", CLAIMS)
    hole(folder / "design.npz", 3 * GIGABYTE)
    refused(lambda: folders.read_nominal(folder), r"holds over 3\.\d+ MB", CLAIMS)


PIXELS = "pictures that claim millions of pixels"


@pytest.mark.parametrize("size", [(64_000_000, 1), (1, 64_000_000), (65_536, 8)])
def test_a_picture_too_long_for_its_averages_is_refused(tmp_path, size, refused):
    Image.new("1", size).save(tmp_path / "p.png")
    refused(lambda: read_picture(tmp_path / "p.png"), "along a side; shrink it", PIXELS)


@pytest.mark.parametrize("tile", [{322: 65_520, 323: 65_520}, {322: 64_000_000}, {323: 64_000_000}], ids=str)
def test_a_tiff_of_tiles_larger_than_itself_is_refused(tmp_path, tile, refused):
    tags = {256: 8, 257: 8, 258: 8, 259: 8, 262: 1, 273: 8, 277: 1, 278: 8, 279: 64} | tile  # deflated
    table = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in sorted(tags.items()))
    head = b"II*\0" + struct.pack("<I", 72) + bytes(64) + struct.pack("<H", len(tags))
    (tmp_path / "p.tif").write_bytes(head + table + bytes(4))
    refused(lambda: read_picture(tmp_path / "p.tif"), "tiles larger than any picture", PIXELS)


def claiming(form: str, side: int) -> bytes:
    """A small picture whose header says that it has side x side pixels."""
    if form == "BMP":
        return b"BM" + struct.pack("<IHHI", 54, 0, 0, 54) + struct.pack("<IiiHHIIiiII", 40, side, side, 1, 8, *[0] * 6)
    if form == "WEBP":
        moving = fuzz.good_picture("WEBP", "RGBA", 2)
        return moving[:24] + 2 * (side - 1).to_bytes(3, "little") + moving[30:]
    sizes, good = struct.pack(">II", side, side), fuzz.good_picture("HEIF", "RGB", side=16)
    return re.sub(rb"(ispe....)........", lambda hit: hit[1] + sizes, good, flags=re.DOTALL)


@pytest.mark.parametrize("side", [8001, 16_383])  # over our own limit; the most that WebP has
@pytest.mark.parametrize("form", ["BMP", "WEBP", "HEIF"])
def test_a_picture_that_claims_too_many_pixels_is_refused_before_it_is_decoded(tmp_path, form, side, refused):
    (tmp_path / "p").write_bytes(claiming(form, side))
    refused(lambda: read_picture(tmp_path / "p"), "million.*; shrink it", PIXELS)


# ---- report.json, which an earlier run may have left, or anybody -----------------------------------------------------

RECORD = '{"seconds": 1.0, "rrmsd": 0.1}'
REPORTS = {
    "huge": lambda: '{"history": [' + ",".join([RECORD] * 700_000) + "]}",
    "deep": lambda: "[" * 1_000_000,
    "deep inside": lambda: '{"stages": ' + '{"a":' * 300 + "1" + "}" * 301,
    "an endless number": lambda: '{"seconds_total": 1e999}',
    "a long number": lambda: '{"seconds_total": ' + "9" * 4000 + "}",
    "stages of other kinds": lambda: '{"stages": [1, {"name": [], "seconds": "x", "rrmsd": null}]}',
    "a history of words": lambda: '{"history": [{"seconds": "a", "rrmsd": "b"}]}',
    "a history that no axis holds": lambda: (
        '{"history": [{"seconds": 1e300, "rrmsd": 0.0}, {"seconds": -1, "rrmsd": 1e300}]}'
    ),
    "a machine of lists": lambda: '{"machine": {"memory_gb": "much", "x": [[1]]}, "versions": {"python": {}}}',
    "steps that are true": lambda: '{"skipped_steps": true, "stopped": "' + "a\\u001b[2J" * 99 + '"}',
    "passed": lambda: '{"passed": true, "checks": [], "rrmsd": 0.0, "rrmsd_noise": 0, "shape": {"volume": "x"}}',
}


def test_an_earlier_report_that_does_not_fit_is_not_believed(quick_folder, holds):
    for text in REPORTS.values():
        (quick_folder / "report.json").write_text(text())
        with spending("report.json of anything", 300.0, holds):
            assert record.making(quick_folder / "report.json") == Making()
            with pytest.raises(ValueError, match="report.json: cannot be read .*; bstcad verify writes it anew"):
                record.read(quick_folder / "report.json")
    for name in ("huge", "a history that no axis holds", "passed"):  # proved again: two seconds each
        (quick_folder / "report.json").write_text(REPORTS[name]())
        found = commands.verify(quick_folder).facts
        kept = {field.name for field in dataclasses.fields(Making) if found.get(field.name)}
        assert kept == {"machine", "versions"} and "python" in found["versions"] and found["machine"]["cores"]
        written = json.loads((quick_folder / "report.json").read_text())
        assert written["stages"] == [] and written["passed"] == found["passed"]
        assert written["checks"] and written["rrmsd"] > 0


NO_FILES = [
    *((kind, name) for kind in ("pipe", "device", "process") for name in ("lens.step", "design.npz", "scene.toml")),
    ("folder", "lens.stl"), ("pipe", "lens.stl"), ("pipe", "report.json"), ("device", "report.json"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "name"), NO_FILES)
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


@pytest.mark.parametrize(
    "image", ["/proc/self/mem", "/dev/zero", "/proc/kmsg", "a" * 300 + ".png", "a\0b", ".", "pipe"]
)
def test_an_image_that_is_no_file_is_one_sentence(tmp_path, image):
    os.mkfifo(tmp_path / "pipe")
    path = tmp_path / "scene.toml"  # in whose folder the image is looked for
    shutil.copy(DISK, path)
    with pytest.raises(SceneError, match=r"target\.image: .*; ") as caught:
        load(path, {"target.image": image})
    assert str(caught.value).isprintable()


def test_a_report_is_not_written_through_links(quick_folder, tmp_path, holds):
    """A folder that was sent: its report and figures lead to files of the reader."""
    victim, elsewhere = tmp_path / "precious", tmp_path / "elsewhere"
    victim.write_text("mine")
    elsewhere.mkdir()
    shutil.rmtree(quick_folder / "figures")
    for name in ("report.json", "report.html"):
        (quick_folder / name).unlink()
        (quick_folder / name).symlink_to(victim)
    (quick_folder / "figures").symlink_to(elsewhere, target_is_directory=True)
    (quick_folder / ".report.json.new").symlink_to(victim)
    commands.verify(quick_folder, drawing=flat_pictures())
    assert victim.read_text() == "mine" and not (quick_folder / "report.json").is_symlink()
    holds("a folder that was sent: files written outside it", len(list(elsewhere.iterdir())), 0)
    assert list((quick_folder / "figures").iterdir())


NAMES = (
    "../../x", "..\\..\\x", "/etc/passwd", "C:\\x", "C:x", "NUL", "com1.png", "a\0b", "a\nb", "\x1b[2J", "x" * 5000,
    "~root", "..%2f..%2fx", "．．／x", "‥/x", "\u202excod", "a/../../../b", "...", "-rf", "$(touch y)", "`id`", "a;b",
    "lens.step", ".git", "figures", "é" * 90, "名前", "a:stream", "x.", " x ",
)  # fmt: skip


def written(scene, place):
    """Every path that `write_geometry` makes for a scene, below the parent of its folder."""
    place.mkdir(parents=True)
    with folders.replacing(place / scene.name) as building:
        lens = scene.flat_lens(9)
        folders.write_geometry(folders.Made(scene, lens, None), building)
    return {path.relative_to(place) for path in place.rglob("*") if path.is_file()}


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
            assert "makes no folder name" in str(error)
            scene = load(DISK, changes)
        made = written(scene, tmp_path / f"out{number}")
        assert {path.parts[0] for path in made} == {scene.name} and all(len(path.parts) == 2 for path in made)
        copied = {path.name for path in made} - {"lens.step", "lens.stl", "lens.3mf", "scene.toml"}
        assert len(copied) == 1 and copied.pop().endswith(".png")
        assert load(tmp_path / f"out{number}" / scene.name / "scene.toml") == scene
    outside = {path.name for path in tmp_path.iterdir()} - {f"out{n}" for n in range(len(NAMES))} - {"home"}
    holds("hostile names: files written outside the folder", len(outside), 0)


@pytest.mark.parametrize("name", ["../x.png", "/x.png", "a\\b.png", "", ".x.png", "a\0.png", "x" * 200, "nul.png"])
def test_a_picture_made_in_python_has_a_plain_name_too(name):
    with pytest.raises(ValueError, match="is no plain file name"):
        Picture(name, b"")


def test_a_title_is_no_markup(quick_folder):
    text = (quick_folder / "scene.toml").read_text().replace("A <small> disc", "<script>alert(1)</script> & [red]")
    (quick_folder / "scene.toml").write_text(text)
    commands.verify(quick_folder)
    page = (quick_folder / "report.html").read_text()
    assert "<script>alert" not in page and "&lt;script&gt;alert" in page
