"""No change of a scene is lost, none is made that nobody asked for, and no name leads out of the folders."""

import contextlib
import os
import threading
import time
import tomllib
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bstcad.app import workspace as module
from bstcad.app.design_runs import Run
from bstcad.app.scene_text import changed
from bstcad.app.workspace import OpenScene, Workspace
from bstcad.scene import new_scene, scene_file
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import load
from tests import suite
from tests.app.asking import made, png, tree
from tests.app.conftest import SMALL

TEMPLATES = Path(__file__).parents[2] / "templates"
BOM = b"\xef\xbb\xbf"
HAND = """\
# Mine, with comments.\t
   # indented, and "quoted"

name='small'   # single quotes
title = "Größe µ"

[source]          # the light
kind = "collimated"
aperture = { shape = "circle",   radius = 6.0 }
[lens]
index = 1.49
outline = { shape = "circle", diameter = 12.0 }
front = { kind = "plane", z = 0.0 }
back = { kind = "bspline", z = 4.0, control_points = 65 }


[target]
z = 1_00.0
x = [ -8.0,
      8.0 ]   # two lines
y = [-8.0, 8.0]
pixels = 0x30
uniform = true
# the end, without a line feed"""


@pytest.fixture
def own(tmp_path):
    folder = tmp_path / "lenses"
    folder.mkdir()
    (folder / "small.toml").write_text(SMALL, encoding="utf-8")
    return Workspace(folder, folder)


def anew(own):
    """Return the same folders for another server, after the first one was killed."""
    return Workspace(own.scenes, own.designs)


# ---- changes ---------------------------------------------------------------------------------------------------------


def test_changes_survive_a_killed_server_and_leave_the_file(own):
    text = SMALL.replace("100.0", "120.0")
    own.change("small", text)
    assert anew(own).opened("small") == OpenScene("small", text, saved=False)
    assert own.path("small").read_text() == SMALL
    anew(own).change("small", "this is [[ no TOML = ")  # right or wrong
    assert anew(own).opened("small").text == "this is [[ no TOML = "
    assert own.path("small").read_text() == SMALL
    anew(own).drop("small")
    assert own.opened("small") == OpenScene("small", SMALL, saved=True)
    assert tree(own.scenes) == {"small.toml": SMALL.encode()}


def test_a_saved_text_is_in_the_file_and_nowhere_else(own):
    text = SMALL.replace("# mm", "# Millimetre, µm")
    own.change("small", text)
    assert anew(own).save("small") == OpenScene("small", text, saved=True)
    assert tree(own.scenes) == {"small.toml": text.encode()}
    assert anew(own).save("small").text == text  # there is nothing to do


def test_revisions_tell_texts_apart(own):
    first = own.opened("small").revision
    assert own.change("small", SMALL + "#").revision != first
    assert own.change("small", SMALL).revision == first and own.opened("small").saved


ENDS = {"unix": (b"\n", b""), "windows": (b"\r\n", b""), "windows with a mark": (b"\r\n", BOM), "mark": (b"\n", BOM)}


@pytest.mark.parametrize("ends", ENDS)
def test_a_scene_written_by_hand_is_written_back_byte_for_byte(own, ends):
    end, mark = ENDS[ends]
    data = mark + HAND.encode().replace(b"\n", end)
    own.path("small").write_bytes(data)
    text = own.opened("small").text
    assert text == HAND and own.opened("small").saved
    own.change("small", text)
    own.save("small")
    assert own.path("small").read_bytes() == data
    own.change("small", changed(own.opened("small").text, "target.z", 120.0))
    own.save("small")
    assert own.path("small").read_bytes() == data.replace(b"1_00.0", b"120.0")
    own.change("small", HAND.replace("\n", "\r\n"))  # as a text field on Windows might have it
    own.save("small")
    assert own.path("small").read_bytes() == data


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(before=st.text(), after=st.text())
def test_any_text_comes_back_as_it_was_taken(own, before, after):
    """A file holds what was saved; only ends of lines that are all of Windows are those of the file."""
    own.drop("small")
    own.path("small").write_bytes(before.encode())
    if "\r" in before or "\r" in after:
        after = after.replace("\r", "")
    assert own.change("small", after).text == anew(own).opened("small").text == after
    own.save("small")
    windows = 0 < before.count("\r\n") == before.count("\n") == before.count("\r")
    mark = BOM if before.startswith("\ufeff") else b""
    assert own.path("small").read_bytes() == mark + (after.replace("\n", "\r\n") if windows else after).encode()


def test_another_programs_change_is_not_replaced_unasked(own):
    theirs, mine = SMALL + "# theirs\n", SMALL + "# mine\n"
    own.change("small", mine)
    own.path("small").write_text(theirs)
    own.change("small", mine + "# more\n")  # what editing began with still counts
    with pytest.raises(SceneError, match="small.toml: was changed by another program"):
        anew(own).save("small")
    assert own.path("small").read_text() == theirs and own.opened("small").text == mine + "# more\n"
    assert own.save("small", anyway=True).saved
    assert own.path("small").read_text() == mine + "# more\n"


def test_dropping_takes_the_other_programs_text_and_the_same_change_is_no_quarrel(own):
    own.change("small", SMALL + "# mine\n")
    own.path("small").write_text(SMALL + "# theirs\n")
    assert own.drop("small").text == SMALL + "# theirs\n"
    own.change("small", SMALL + "# both\n")
    own.path("small").write_text(SMALL + "# both\n")
    assert own.opened("small").saved and own.save("small").saved


def test_changes_outlive_their_file(own):
    own.change("small", SMALL + "# mine\n")
    own.path("small").unlink()
    assert anew(own).opened("small") == OpenScene("small", SMALL + "# mine\n", saved=False)
    with pytest.raises(SceneError, match="changed by another program"):
        own.save("small")
    own.save("small", anyway=True)
    assert own.path("small").read_text() == SMALL + "# mine\n"


def test_a_new_scene_has_no_changes_of_one_that_is_gone(own):
    name = own.add("laser")
    own.change(name, "# long ago")
    own.path(name).unlink()
    assert own.opened(again := own.add("laser")).saved and again != name


def test_a_save_that_fails_loses_nothing(own, monkeypatch):
    own.change("small", SMALL + "# mine\n")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.files.os, "replace", full)
    with pytest.raises(OSError):
        own.save("small")
    monkeypatch.undo()
    assert own.path("small").read_text() == SMALL
    assert anew(own).save("small").text == SMALL + "# mine\n"


@pytest.mark.parametrize(
    "text", ["#" * (scene_file.MAX_SCENE_SIZE + 1), "µ" * (scene_file.MAX_SCENE_SIZE // 2 + 1), "title = '\ud800'"]
)
def test_what_no_scene_file_can_hold_is_not_taken(own, text):
    with pytest.raises(SceneError, match="^small: "):
        own.change("small", text)
    assert tree(own.scenes) == {"small.toml": SMALL.encode()}


def test_threads_that_change_a_scene_at_once_lose_nothing(own):
    """Each appends its own lines, reading what is there first."""
    ready = threading.Barrier(4)

    def work(k):
        ready.wait()
        for n in range(25):
            own.edit("small", lambda text, n=n: text + f"# {k}: {n}\n")

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    lines = own.opened("small").text.removeprefix(SMALL).splitlines()
    assert sorted(lines) == sorted(f"# {k}: {n}" for k in range(4) for n in range(25))
    for k in range(4):
        mine = [int(line.rpartition(" ")[2]) for line in lines if line.startswith(f"# {k}:")]
        assert all(a < b for a, b in pairwise(mine))


def test_a_change_that_cannot_be_made_leaves_the_text(own):
    with pytest.raises(SceneError):
        own.edit("small", lambda text: changed(text, "target[7].z", 1.0))
    assert own.opened("small") == OpenScene("small", SMALL, saved=True)


# ---- names -----------------------------------------------------------------------------------------------------------


def test_lists_have_no_hidden_files_and_no_names_that_are_none(own):
    own.change("small", SMALL + "#")
    for name in (".hidden.toml", "two words.toml", "-x.toml", "notes.txt", "small.toml.bak"):
        (own.scenes / name).write_text(SMALL)
    (own.scenes / "folder.toml").mkdir()
    os.symlink(own.scenes / "nowhere", own.scenes / "dangling.toml")
    for name in ("made", ".made.design-run", "two words"):
        made(own.designs / name)
    (own.designs / "empty").mkdir()
    assert own.scene_names() == ["small"]
    assert own.design_names() == ["made"]


def test_the_latest_is_the_first(own):
    for k, name in enumerate(("old", "new", "middle")):
        own.path(name).write_text(SMALL)
        os.utime(own.path(name), (0, {"old": 10, "middle": 20, "new": 30}[name]))
        made(own.designs / f"d-{name}")
        os.utime(own.designs / f"d-{name}", (k, {"old": 10, "middle": 20, "new": 30}[name]))
    assert own.scene_names()[1:] == ["new", "middle", "old"]
    assert own.design_names() == ["d-new", "d-middle", "d-old"]


def test_a_designs_files_are_those_in_its_folder(own, tmp_path):
    files = made(own.designs / "made")
    folder = own.designs / "made"
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret/key.txt").write_text("secret")
    (folder / ".hidden").write_text("x")
    (folder / ".folder").mkdir()
    (folder / ".folder/x.txt").write_text("x")
    os.symlink(tmp_path / "secret/key.txt", folder / "key.txt")
    os.symlink(tmp_path / "secret", folder / "linked")
    os.symlink("loop", folder / "loop")
    os.symlink(".hidden", folder / "shown")
    os.mkfifo(folder / "pipe")
    assert sorted(own.file_names("made")) == sorted(files)
    for name, data in files.items():
        assert own.file("made", name).read_bytes() == data
    for name in (
        "key.txt", "linked/key.txt", "linked", "loop/x", "pipe", ".hidden", ".folder/x.txt", "shown", "", "figures",
        "figures/../../small.toml", str(folder / ".hidden"), "lens.step\0", "x" * 5000, "lens.step/x", "\\etc",
    ):  # fmt: skip
        with pytest.raises(SceneError, match="is not a file of the design made"):
            own.file("made", name)


# ---- sentences -------------------------------------------------------------------------------------------------------


def test_sentences_have_no_folders_of_this_machine(tmp_path, monkeypatch):
    home, real = tmp_path / "home/me", tmp_path / "disk/me"
    real.mkdir(parents=True)
    home.parent.mkdir()
    home.symlink_to(real)
    monkeypatch.setenv("HOME", str(home))
    own = Workspace(home / "lenses", home / "designs.d")
    for sentence, told in {
        f"{real}/lenses/a.toml: no": "a.toml: no",
        f"target.image: '{real}/lenses/../b.png' not found": "target.image: '../b.png' not found",
        f"{real}/designs.d/x/y.npz and {home}/c": "x/y.npz and c",
        f"in {real}/lenses.": "in this folder.",
        f"({home})": "(this folder)",
        f"{Path.cwd()}/x": "x",
        "1/e² of 4 mm/s, pictures/a.png": "1/e² of 4 mm/s, pictures/a.png",
        f"{real}2/x": f"{real}2/x",  # somebody else's
    }.items():
        assert own.without_paths(sentence) == told


@pytest.mark.parametrize("home", ["/", "", "relative"])
def test_a_home_at_the_root_takes_no_slash_from_a_sentence(own, monkeypatch, home):
    """Containers may have a user without a home folder."""
    monkeypatch.setenv("HOME", home)
    sentence = "PNG/JPEG, ~ relative/x, /tmp/x, one / the other"
    assert anew(own).without_paths(sentence) == sentence
    assert anew(own).without_paths(f"{own.scenes}/x") == "x"


# ---- pictures and new scenes -----------------------------------------------------------------------------------------


def test_pictures_that_are_read_at_once_leave_the_error_stream_where_it_was(own, monkeypatch):
    """Decoders' complaints are kept from it meanwhile; it is that of the whole process."""
    before, plain, both = os.fstat(2), module.picture.photo, threading.Barrier(2)

    def photo(given):
        with contextlib.suppress(threading.BrokenBarrierError):
            both.wait(0.3)  # until the other reads, too, if it can
        if given.data == png(9, 9):
            time.sleep(0.1)  # the first to come goes first
        return plain(given)

    monkeypatch.setattr(module.picture, "photo", photo)
    threads = [threading.Thread(target=own.keep, args=(png(9, n),)) for n in (8, 9)]
    kept = os.dup(2)
    try:
        for thread in threads:
            thread.start()
            time.sleep(0.05)
        for thread in threads:
            thread.join()
        assert os.path.samestat(os.fstat(2), before)
    finally:
        os.dup2(kept, 2)
        os.close(kept)


@pytest.mark.parametrize("name", ["", "..", "none.png", "../small.toml"])
def test_only_uploads_are_pictures_of_new_scenes(own, name):
    own.keep(png(9, 9))
    before = tree(own.scenes)
    with pytest.raises(SceneError, match="no such picture was uploaded"):
        own.add("laser", image=name)
    assert tree(own.scenes) == before


GIVEN = {"image": png(30, 20), "sample": "camera", "text": 'A "b" \\ é\nC'}


def shown(own, what):
    """Return the argument of `add` for one of GIVEN."""
    return {what: own.keep(GIVEN[what]) if what == "image" else GIVEN[what]}


def is_shown(target, what):
    """Does a target show this, and nothing else?"""
    given = {name: getattr(target, name) for name in ("image", "sample", "text", "uniform", "profile")}
    value = given.pop(what)
    return (value.data if what == "image" else value) == GIVEN[what] and not any(given.values())


@pytest.mark.parametrize("light", suite.in_turns(new_scene.LIGHTS, 2))
@pytest.mark.parametrize("what", GIVEN)
def test_a_new_scene_of_each_light_shows_what_is_given(own, light, what):
    name = own.add(light, **shown(own, what))
    assert name == f"my-{light}" and own.opened(name).saved
    scene = load(own.path(name))
    assert scene.name == name and is_shown(scene.target, what)
    other = load(new_scene.new_scene("hand", own.scenes, light=light).path)
    assert (scene.source, scene.lens, scene.target.x) == (other.source, other.lens, other.target.x)
    assert "# the wall with the picture" in own.opened(name).text  # its comments stay
    blurred = new_scene.Plate.of(light).blur_rrmsd(scene)
    if blurred is not None:  # what the source's size leaves of this very picture
        assert blurred < scene.accept.rrmsd or scene.accept.rrmsd == new_scene.MAX_RRMSD
        assert "picture blurred by the source" in own.opened(name).text


@pytest.mark.parametrize("template", ["thu", "disk", "two_pictures", "beam_shaper", "caustic_portrait"])
def test_a_template_shows_what_is_given(own, template):
    """The first of several targets shows it; everything else stays as it is."""
    plain = load(own.path(own.add("laser", template=template)))
    assert plain.name == f"my-{template}"
    for n, what in enumerate(GIVEN, start=2):
        name = own.add("laser", template=template, **shown(own, what))
        assert name == f"my-{template}-{n}"
        scene = load(own.path(name))
        assert is_shown(scene.targets[0], what), own.opened(name).text
        assert scene.targets[1:] == plain.targets[1:]
        assert (scene.source, scene.lens, scene.tailoring) == (plain.source, plain.lens, plain.tailoring)
        assert scene.targets[0].x == plain.targets[0].x
        comments = [line for line in own.opened(name).text.splitlines() if line.startswith("#")]
        assert comments == [
            line.replace(f"my-{template}", name) for line in own.opened(f"my-{template}").text.splitlines()
            if line.startswith("#")
        ]  # fmt: skip


def test_a_new_scene_takes_no_name_that_is_taken(own):
    own.path("my-sun").write_text("mine")
    made(own.designs / "my-sun-2")
    (own.designs / "my-sun-3").mkdir()
    assert own.add("sun") == "my-sun-4"
    assert own.path("my-sun").read_text() == "mine"
    assert load(own.path("my-sun-4")).name == "my-sun-4"


@pytest.mark.parametrize(
    "wrong",
    [
        {"light": "../../x"}, {"light": ""}, {"light": "laser", "template": "../../etc/passwd"},
        {"light": "laser", "template": "none"}, {"light": "laser", "text": "\ud800"},
        {"light": "sun", "text": "\u0378"},
    ],
)  # fmt: skip
def test_a_scene_that_cannot_be_made_leaves_no_file(own, tmp_path, wrong):
    before = tree(tmp_path)
    with pytest.raises(SceneError):
        own.add(**wrong)
    assert tree(tmp_path) == before


def test_a_workspace_that_is_not_there_yet_is_made_by_its_first_scene(tmp_path):
    own = Workspace(tmp_path / "new/outputs", tmp_path / "new/outputs")
    assert own.scene_names() == own.design_names() == []
    name = own.add("laser", image=own.keep(png(9, 9)))
    assert load(own.path(name)).target.image.data == png(9, 9)


# ---- the scene of a design -------------------------------------------------------------------------------------------

TWO = f"""\
{SMALL.partition("[target]")[0]}[[target]]  # the first
z = 100.0
x = [-8.0, 8.0]
y = [-8.0, 8.0]
pixels = 48
image = "a.png"  # of its folder

[[target]]
z = 150.0
x = [-8.0, 8.0]
y = [-8.0, 8.0]
pixels = 48
image = "b.png"

[tailoring]
quality = "draft"
"""


def test_the_scene_of_a_design_is_a_new_scene_with_its_pictures(own, tmp_path):
    folder = own.designs / "two"
    made(folder)
    (folder / "scene.toml").write_text(TWO)
    pictures = {"a.png": png(20, 20), "b.png": png(20, 21)}
    for name, data in pictures.items():
        (folder / name).write_bytes(data)
    before = tree(folder)
    name = own.adopt("two", folder)
    assert name == "my-two" and own.opened(name).saved and tree(folder) == before
    scene, text = load(own.path(name)), own.opened(name).text
    assert scene.name == name
    assert [target.image.data for target in scene.targets] == list(pictures.values())
    assert "# the first" in text and "# of its folder" in text and "# of the folder" in text
    assert all(
        line["image"].startswith("pictures/") and (own.scenes / line["image"]).is_file()
        for line in tomllib.loads(text)["target"]
    )
    assert own.adopt("my-two", folder) == "my-two-2"
    assert own.adopt("x" * 80, folder).startswith("my-xxx")


def test_comments_survive_the_way_through_a_design(own):
    """The text of the design's run keeps them, or its scene file where that is the same scene still."""
    name = own.add("sun", text="HI")
    text = own.opened(name).text
    folder = own.designs / name
    made(folder)
    (folder / "scene.toml").write_text(load(own.path(name)).changed({"lens.back.control_points": 129}).toml())
    again = own.opened(own.adopt(name, folder)).text
    assert "# the wall with the picture" in again and again.count(" # ") == text.count(" # ")
    assert again.split() == text.replace(name, f"{name}-2").replace(f'"{name}-2, for', f'"{name}, for').split()
    own.path(name).write_text(text.replace("divergence = 0.53", "divergence = 0.4"))  # another scene meanwhile
    assert "# the wall" not in own.opened(own.adopt(name, folder)).text
    run = Run(folder).folder
    run.mkdir()
    (run / "written.toml").write_text(text)
    assert "# the wall with the picture" in own.opened(own.adopt(name, folder, run / "written.toml")).text


def test_a_damaged_scene_of_a_design_makes_no_scene(own):
    made(own.designs / "made")
    before = tree(own.scenes)
    for text in ("no [[ TOML", SMALL + "x = 1\n", TWO):  # of the last the pictures are missing
        (own.designs / "made/scene.toml").write_text(text)
        with pytest.raises(SceneError):
            own.adopt("made", own.designs / "made")
    (own.designs / "made/scene.toml").unlink()
    with pytest.raises(SceneError):
        own.adopt("made", own.designs / "made")
    assert set(tree(own.scenes)) == set(before) - {"made/scene.toml"}


# ---- what the command is given ---------------------------------------------------------------------------------------


def test_the_argument_of_the_command_says_where_and_what(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("scenes", "designs/made", "designs/half", "empty"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "scenes/a.toml").write_text(SMALL)
    (tmp_path / "designs/made/report.json").write_text("{}")
    (tmp_path / "designs/half/design.npz").write_bytes(b"")
    os.symlink("designs/made", "link")

    def found(given):
        own, page = Workspace.of(None if given is None else Path(given))
        return own.scenes.relative_to(tmp_path).as_posix(), own.designs.relative_to(tmp_path).as_posix(), page

    assert found(None) == ("outputs", "outputs", "/")
    assert found("scenes/a.toml") == ("scenes", "outputs", "/scene/a")
    assert found(tmp_path / "scenes/a.toml") == ("scenes", "outputs", "/scene/a")
    assert found("designs/made") == found("designs/made/") == found("link") == ("designs", "designs", "/design/made")
    assert found("designs/half") == ("designs", "designs", "/design/half")
    assert found("scenes") == ("scenes", "scenes", "/")
    assert found("empty") == ("empty", "empty", "/")
    assert found(".") == (".", ".", "/")
    monkeypatch.chdir(tmp_path / "designs/made")
    assert found(".") == ("designs", "designs", "/design/made")
    assert not (tmp_path / "outputs").exists()  # looking makes nothing


def test_what_is_neither_scene_nor_folder_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "two words.toml").write_text(SMALL)
    (tmp_path / ".hidden.toml").write_text(SMALL)
    (tmp_path / "two words").mkdir()
    (tmp_path / "two words/report.json").write_text("{}")
    os.mkfifo(tmp_path / "pipe.toml")
    for name in ("notes.txt", "two words.toml", ".hidden.toml", "two words", "none.toml", "none", "pipe.toml"):
        with pytest.raises(SceneError, match="; (give|use)"):
            Workspace.of(tmp_path / name)
