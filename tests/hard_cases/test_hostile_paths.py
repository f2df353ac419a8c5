"""14. Truncated, hostile or huge input.

Here what leads elsewhere: pipes, devices and links in a folder that somebody sent, and names that would lead out of the
one that is written.
"""

from __future__ import annotations

import io
import os
import shutil

import pytest
from PIL import Image

from bstcad import commands
from bstcad import folder as folders
from bstcad.scene.picture import Picture
from bstcad.scene.scene import SceneError, load
from tests.conftest import flat_pictures
from tests.hard_cases import fuzz

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
    path = tmp_path / "scene.toml"
    path.write_text(fuzz.SCENES[1])
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
