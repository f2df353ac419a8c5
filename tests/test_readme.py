"""Every command and code block of the README runs, on templates made small."""

import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from functools import partial
from pathlib import Path

import cadquery
import pytest
import skimage.data
import skimage.io

import bstcad
from bstcad import cli, commands
from bstcad.runs.processes import Ending
from bstcad.scene.scene import load
from bstcad.sweep import batch
from bstcad.sweep import tradeoff as sweeping
from bstcad.tolerance import tolerancing as tolerances
from tests.conftest import draws_nothing, quick_effort, verify_with
from tests.exact_volume import exact_volume
from tests.sweep.conftest import Synthetic

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", README, re.S | re.M)
COMMANDS = [line for kind, text in BLOCKS if kind == "sh" for line in text.splitlines() if line.strip()]


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with the templates, reduced to what a test has time for."""
    place = tmp_path_factory.mktemp("readme")
    (place / "templates").mkdir()
    for path in (ROOT / "templates").iterdir():
        if path.suffix in (".toml", ".py"):
            make_small(path, place / "templates" / path.name)
    skimage.io.imsave(place / "photo.jpg", skimage.data.astronaut()[::4, 32:480:4])  # upright: 112 x 128 pixels
    return place


def make_small(scene, path):
    """A scene file, or a script, with as few control points and pixels as make a lens."""
    text = scene.read_text(encoding="utf-8")
    text = re.sub(r"control_points = \d+", "control_points = 33", text)
    text = re.sub(r"pixels = \d+", "pixels = 48", text)
    few = "" if scene.name == "thu.toml" else "\nrays = 192"  # `bstcad plan` knows no scenes with knobs of their own
    text = re.sub(r'quality = "\w+"', f'quality = "draft"{few}', text)
    path.write_text(text, encoding="utf-8")


def test_each_table_of_a_scene_is_one():
    for text in (text for kind, text in BLOCKS if kind == "toml"):
        assert load(ROOT / "templates" / "disk.toml", tomllib.loads(text)) != load(ROOT / "templates" / "disk.toml")


def test_the_table_of_designs_says_what_is_on_record():
    """Made by `make accuracy`; a design of another kind of scene has no cell."""
    designs = json.loads((ROOT / "docs" / "accuracy.json").read_text(encoding="utf-8"))["designs"]
    rows = re.findall(r"^\|[^|]*`(\w+)\.toml`\)[^|]*\|(.*)$", README, re.M)
    assert {name for name, _ in rows} == set(designs)
    for name, cells in rows:
        for quality, cell in zip(("draft", "standard", "paper"), cells.split("|"), strict=False):
            record = designs[name].get(quality)
            said = re.match(r"\W*([\d.]+)\W* in (?:(\d+) min )?(\d+) s", cell)
            assert bool(said) is bool(record), f"{name}, {quality}"
            if record:
                seconds = 60 * int(said[2] or 0) + int(said[3])
                assert (said[1], seconds) == (f"{record['rrmsd']:.3f}", round(record["seconds"])), f"{name}, {quality}"


def test_blocks_are_of_kinds_that_are_run():
    assert {kind for kind, _ in BLOCKS} == {"sh", "python", "toml"} and len(COMMANDS) >= 6


def test_the_commands_run_one_after_the_other(workplace, monkeypatch, capsys):
    """With few tubes and rays, and without pictures; runs of a sweep by formulas, which take no time."""
    monkeypatch.chdir(workplace)
    draws_nothing(monkeypatch)
    monkeypatch.setattr("bstcad.report.rendering.draw", lambda path, picture: bool(picture.write_bytes(b"drawn")))
    verify_with(monkeypatch, quick_effort())
    monkeypatch.setattr(commands, "FULL", quick_effort())  # of a scene with a limit of time
    sweep = sweeping.tradeoff
    monkeypatch.setattr(
        sweeping,
        "tradeoff",
        lambda scene, *given, **more: sweep(scene, *given, **more | {"machines": Synthetic(scene)}),
    )
    few = partial(tolerances.tolerance, tubes=129, trials=200, full=4)
    monkeypatch.setattr(tolerances, "tolerance", few)
    monkeypatch.setattr(batch, "design", copied)
    for command in COMMANDS:
        program, *arguments = shlex.split(command)
        if program == "make":  # the targets exist; running them here would run this test again
            done = subprocess.run(["make", "-n", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
            assert ("generate_lens.py templates/thu.toml" if arguments == ["lens"] else "pytest") in done.stdout
        elif program == "bstcad":
            assert cli.run(arguments) == 0, command
            if arguments[0] == "new":
                path = Path(f"{arguments[1]}.toml")
                make_small(path, path)
        else:
            assert program == "python"
            monkeypatch.setattr(sys, "argv", arguments)
            runpy.run_path(arguments[0], run_name="__main__")
    assert (workplace / "outputs/thu-tradeoff/tradeoff.html").is_file()
    assert all((workplace / "outputs/drafts" / name / "report.html").is_file() for name in ("disk", "mirror"))
    assert (workplace / "light.png").read_bytes() == b"drawn"
    assert {"lens.step", "report.html"} <= {path.name for path in (workplace / "outputs/disk").iterdir()}
    assert "one solid, valid" in capsys.readouterr().out
    [part] = cadquery.importers.importStep("outputs/disk/flanged_lens.step").solids().vals()
    assert part.isValid() and part.Volume() > exact_volume(bstcad.open("outputs/disk").lens)
    assert len([face for face in part.Faces() if face.geomType() == "CYLINDER"]) >= 3 * 2 + 1  # holes, heads, wall


def copied(contents, folder, variables, tick):
    """A design of a batch, which has processes of its own otherwise."""
    shutil.copytree("outputs/disk", folder)
    return Ending(0, 1.0, 1.0, "")


PRINTED = (  # by the blocks of Python, which go on from one another
    r"True True True\n",
    r"by hand True\n",
    r"Design 'rings': .*\n  16 x 16 mm of PMMA .* on the axis, 33 x 33 control points\n  RRMSD .* not verified yet\n"
    r"Report 'rings': passed.*, RRMSD 0\.0\d+, .*\n(  given up: .*\n)*",
    r"\(33, 33, 3\)\nTrue\nTrue\n",
    r"plane Refract\(n_in=1.0, n_out=1.49\d+\)\nbspline Refract\(n_in=1.49\d+, n_out=1.0\)\nTrue True (1.0|0.999999)\d*"
    r"\n",
)


def test_the_python_runs(workplace, monkeypatch, capsys):
    monkeypatch.chdir(workplace)
    draws_nothing(monkeypatch)
    verify_with(monkeypatch, quick_effort())
    for code, printed in zip((text for kind, text in BLOCKS if kind == "python"), PRINTED, strict=True):
        exec(compile(code, "README.md", "exec"), {})
        out, err = capsys.readouterr()
        assert re.fullmatch(printed, out) and err == ""


def test_the_pictures_are_there_and_small():
    pictures = re.findall(r"(?:\]\(|src=\")(docs/[\w.-]+)", README)
    assert len(pictures) >= 3
    for name in pictures:
        assert (ROOT / name).stat().st_size < 300_000


def test_the_house_is_as_described():
    """Each room of the package is named in the README's plan."""
    plan = README[README.index("    bstcad/\n") :]
    rooms = [path.parent.name for path in (ROOT / "bstcad").glob("*/__init__.py")]
    assert [room for room in rooms if f"{room}/" not in plan] == []
