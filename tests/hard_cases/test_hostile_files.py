"""14. Truncated, hostile or huge input.

Here files: claims, bombs, holes of gigabytes, pipes, devices and links in a folder that somebody sent, and names that
would lead out of the one that is written.
"""

from __future__ import annotations

import io
import json
import os
import resource
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bstcad import commands, pipeline
from bstcad import folder as folders
from bstcad.cad import mesh, part21
from bstcad.picture import Picture, read_picture
from bstcad.scene import SceneError, load
from bstcad.verify import checks, shape
from bstcad.verify import solid as step_checks
from tests.hard_cases import fuzz, fuzz_pictures

GIGABYTE = 2**30


@pytest.fixture
def folder(small_design, tmp_path, monkeypatch):
    """The small design in a folder of its own beside nothing else; verified by few rays and without pictures."""
    monkeypatch.setattr(commands.beside, "submit", commands.beside.here)
    monkeypatch.setattr(commands.rendering, "lens_picture", lambda mesh: None)
    for draw in ("draw_light", "draw_lens"):
        monkeypatch.setattr(commands.figures, draw, lambda *given: {})
    for module, name, few in ((checks, "TUBES", (32, 48)), (checks, "RAYS", 64), (step_checks, "SAMPLES", 512)):
        monkeypatch.setattr(module, name, few)
    monkeypatch.setattr(shape, "PLACES", 65)
    return Path(shutil.copytree(small_design.folder, tmp_path / "design"))


def hole(path, size):
    """A file of so many bytes of nothing, which takes no room."""
    path.unlink(missing_ok=True)
    with path.open("wb") as file:
        file.truncate(size)


def spent():
    """Megabytes that this process has held at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def refused(read, sentence, holds, what):
    """One sentence, found before memory is spent."""
    before = spent()
    with pytest.raises((SceneError, ValueError), match=sentence) as caught:
        read()
    assert str(caught.value).isprintable() and ";" in str(caught.value)
    holds(f"{what}: memory", spent() - before, 100.0, "MB")


# ---- sizes -----------------------------------------------------------------------------------------------------------


def test_a_step_file_of_gigabytes_is_not_read(folder, holds):
    hole(folder / "lens.step", 2 * GIGABYTE)
    refused(lambda: part21.read(folder / "lens.step"), r"lens\.step: .*over 600 MB", holds, "a STEP file of 2 GB")
    refused(lambda: commands.verify(folder), r"lens\.step: .*over 600 MB", holds, "a STEP file of 2 GB")


def test_an_stl_of_gigabytes_is_not_read(folder, holds):
    path = folder / "lens.stl"
    path.write_bytes(path.read_bytes()[:80] + np.uint32(2 * GIGABYTE // 50).tobytes() + path.read_bytes()[84:])
    refused(
        lambda: commands.verify(folder), r"lens\.stl: .*no binary STL of 42949672", holds, "an STL that claims 2 GB"
    )
    hole(path, 4 * GIGABYTE)
    refused(lambda: mesh.read_stl(path), r"lens\.stl: .*holds over 840 MB", holds, "an STL of 4 GB")
    path.write_bytes(bytes(84))
    refused(lambda: mesh.read_stl(path), r"lens\.stl: 84 bytes, no binary STL", holds, "an STL of no triangle")


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
ARRAYS = {  # what control_points.npy is: (its bytes, or how to make them; why it is refused)
    "a bomb of half a GB": (lambda: npy("<f8", (33, 33, 3), bytes(GIGABYTE // 2)), "holds 5368709"),
    "a claim of 8 TB": (lambda: npy("<f8", (10**12,)), r"is not \(33, 33, 3\) numbers"),
    "a claim of 8 EB": (lambda: npy("<f8", (10**18, 10**18)), r"is not \(33, 33, 3\) numbers"),
    "a number of 1 GB": (lambda: npy(f"|V{GIGABYTE}", (33, 33, 3)), r"is not \(33, 33, 3\) numbers"),
    "negative sides": (lambda: npy("<f8", (-33, -33, 3)), r"is not \(33, 33, 3\) numbers"),
    "objects": (OBJECTS.getvalue, r"is not \(33, 33, 3\) numbers"),
    "a header of brackets": (lambda: npy("<f8", (), b"").replace(b"()", b"(" * 900), "cannot be read"),
    "a header of 4 GB": (lambda: npy("<f8", (33, 33, 3), version=2), "no array of this program"),
    "nothing": (lambda: b"", "cannot be read"),
}


@pytest.mark.parametrize("what", ARRAYS)
def test_arrays_that_claim_or_unfold_to_gigabytes_are_refused(folder, holds, what):
    make, reason = ARRAYS[what]
    packed(folder / "design.npz", control_points=make())
    sentence = rf"design\.npz: cannot be read .*{reason}.*; generate the design again"
    if reason == "cannot be read":
        sentence = r"design\.npz: cannot be read .*; generate the design again"
    refused(lambda: folders.read_nominal(folder), sentence, holds, f"design.npz, {what}")


def test_an_archive_of_gigabytes_or_of_another_packing_is_refused(folder, holds):
    packed(folder / "design.npz", zipfile.ZIP_LZMA)  # whose reader takes no limit
    refused(lambda: folders.read_nominal(folder), "control_points holds", holds, "design.npz, packed by LZMA")
    hole(folder / "design.npz", 3 * GIGABYTE)
    refused(lambda: folders.read_nominal(folder), "holds over 2.1 MB", holds, "design.npz of 3 GB")


def test_a_scene_of_gigabytes_is_not_read(folder, holds):
    hole(folder / "scene.toml", 2 * GIGABYTE)
    refused(lambda: commands.verify(folder), r"scene\.toml: .*over 1 MB", holds, "scene.toml of 2 GB")


@pytest.mark.parametrize("size", [(64_000_000, 1), (1, 64_000_000), (65_536, 8)])
def test_a_picture_too_long_for_its_averages_is_refused(tmp_path, size, holds):
    Image.new("1", size).save(tmp_path / "p.png")
    refused(lambda: read_picture(tmp_path / "p.png"), "along a side; shrink it", holds, "a picture of 64 million x 1")


def test_a_tiff_of_tiles_larger_than_itself_is_refused(tmp_path, holds):
    tags = {256: 8, 257: 8, 258: 8, 259: 1, 262: 1, 277: 1, 322: 65_520, 323: 65_520, 324: 8, 325: 64}
    entries = [(tag, 4, [value]) for tag, value in tags.items()]
    (tmp_path / "p.tif").write_bytes(fuzz_pictures.tiff_of(entries, bytes(64)))
    refused(lambda: read_picture(tmp_path / "p.tif"), "tiles larger than any picture", holds, "a TIFF tile of 4 GB")


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


@pytest.mark.parametrize("what", REPORTS)
def test_an_earlier_report_is_believed_as_far_as_it_fits(folder, what, holds):
    (folder / "report.json").write_text(REPORTS[what]())
    before = spent()
    found = commands.verify(folder)
    holds(f"report.json, {what}: memory", spent() - before, 400.0, "MB")
    kept = {key for key in commands.KEPT if found.get(key)}
    assert kept == {"machine", "versions"} and "python" in found["versions"] and found["machine"]["cores"]
    written = json.loads((folder / "report.json").read_text())
    assert written["stages"] == [] and written["passed"] == found["passed"]
    assert written["checks"] and written["rrmsd"] > 0


# ---- what is no file, and what leads elsewhere -----------------------------------------------------------------------


FILES = ("lens.step", "lens.stl", "design.npz", "report.json", "scene.toml")
NO_FILES = [(kind, name) for kind in ("pipe", "device", "process", "folder") for name in FILES]
NO_FILES.remove(("folder", "report.json"))  # in the way of the new one: the system says so


@pytest.mark.parametrize(("kind", "name"), NO_FILES)
def test_what_is_no_file_is_one_sentence_or_left_out(folder, kind, name):
    """A pipe does not end; /dev/zero neither; some of /proc cannot be read, though they say they are files."""
    path = folder / name
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to({"device": "/dev/zero", "process": "/proc/self/mem"}[kind])
    if name == "report.json":
        commands.verify(folder)
        assert path.is_file() and not path.is_symlink()
        return
    sentence = "name: missing" if (kind, name) == ("process", "scene.toml") else name  # an empty one, as it says itself
    with pytest.raises(SceneError, match=sentence) as caught:
        commands.verify(folder)
    assert str(caught.value).isprintable() and ";" in str(caught.value)


@pytest.mark.parametrize(
    "image", ["/proc/self/mem", "/dev/zero", "/proc/kmsg", "a" * 300 + ".png", "a\0b", ".", "pipe"]
)
def test_an_image_that_is_no_file_is_one_sentence(tmp_path, image):
    os.mkfifo(tmp_path / "pipe")
    path = tmp_path / "scene.toml"
    path.write_text(fuzz.SCENES[1])
    with pytest.raises(SceneError, match=r"target\.image: .*; ") as caught:
        load(path, {"target.image": image})
    assert str(caught.value).isprintable()


def test_a_report_is_not_written_through_links(folder, tmp_path, holds):
    """A folder that was sent: its report and figures lead to files of the reader."""
    victim, elsewhere = tmp_path / "precious", tmp_path / "elsewhere"
    victim.write_text("mine")
    elsewhere.mkdir()
    shutil.rmtree(folder / "figures")
    for name in ("report.json", "report.html"):
        (folder / name).unlink()
        (folder / name).symlink_to(victim)
    (folder / "figures").symlink_to(elsewhere, target_is_directory=True)
    (folder / ".report.json.new").symlink_to(victim)
    commands.verify(folder)
    assert victim.read_text() == "mine" and not (folder / "report.json").is_symlink()
    holds("verify: files outside the folder", len(list(elsewhere.iterdir())), 0)
    assert list((folder / "figures").iterdir())


NAMES = (
    "../../x", "..\\..\\x", "/etc/passwd", "C:\\x", "C:x", "NUL", "com1.png", "a\0b", "a\nb", "\x1b[2J", "x" * 5000,
    "~root", "..%2f..%2fx", "．．／x", "‥/x", "\u202excod", "a/../../../b", "...", "-rf", "$(touch y)", "`id`", "a;b",
    "lens.step", ".git", "figures", "é" * 90, "名前", "a:stream", "x.", " x ",
)  # fmt: skip


def written(scene, place):
    """Every path that `write_geometry` makes for a scene, below the parent of its folder."""
    place.mkdir(parents=True)
    with folders.replacing(place / scene.name) as building:
        lens = pipeline.blank(scene, 9, torch.float64, "cpu")
        folders.write_geometry(folders.Design(scene, lens, None, None, (), (), 0, "", "cpu"), building)
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
        (home / "scene.toml").write_text(fuzz.SCENES[1], encoding="utf-8")
        changes = {"target.image": str(image), "lens.outline": '{shape="rectangle",width=9,height=9}'}
        try:
            scene = load(home / "scene.toml", changes | {"name": name})
        except SceneError as error:
            assert "makes no folder name" in str(error)
            scene = load(home / "scene.toml", changes)
        made = written(scene, tmp_path / f"out{number}")
        assert {path.parts[0] for path in made} == {scene.name} and all(len(path.parts) == 2 for path in made)
        copied = {path.name for path in made} - {"lens.step", "lens.stl", "lens.3mf", "scene.toml"}
        assert len(copied) == 1 and copied.pop().endswith(".png")
        assert load(tmp_path / f"out{number}" / scene.name / "scene.toml") == scene
    outside = {path.name for path in tmp_path.iterdir()} - {f"out{n}" for n in range(len(NAMES))} - {"home"}
    holds("names: files outside the folder", len(outside), 0)


@pytest.mark.parametrize("name", ["../x.png", "/x.png", "a\\b.png", "", ".x.png", "a\0.png", "x" * 200, "nul.png"])
def test_a_picture_made_in_python_has_a_plain_name_too(name):
    with pytest.raises(ValueError, match="is no plain file name"):
        Picture(name, b"")


def test_a_title_is_no_markup(folder):
    text = (folder / "scene.toml").read_text().replace("A <small> disc", "<script>alert(1)</script> & [red]")
    (folder / "scene.toml").write_text(text)
    commands.verify(folder)
    page = (folder / "report.html").read_text()
    assert "<script" not in page and "&lt;script&gt;" in page
