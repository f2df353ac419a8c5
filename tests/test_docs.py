"""Every command and code block of README, tutorials, guides and the page on files runs, on templates made small."""

import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import skimage.data
import skimage.io
import tomli_w
import typer

import bstcad
from bstcad import cli
from bstcad.designs import pipeline
from bstcad.manufacture.tolerance import tolerancing
from bstcad.optics.surfaces.surfaces import sag
from bstcad.planning import batch
from bstcad.planning import tradeoff as sweeping
from bstcad.runs.processes import ExitStatus
from bstcad.scene.scene import load
from tests import suite
from tests.conftest import draws_nothing, quick_effort, quickly, verify_with
from tests.efforts import LITTLE
from tests.planning.conftest import Synthetic, typical_pilot
from tests.scenes import designed

ROOT = Path(__file__).parent.parent
sys.path.append(str(ROOT / "docs" / "_ext"))
from code_blocks import blocks  # noqa: E402

PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("tutorials/*.md")),
    *sorted((ROOT / "docs").glob("how-to/*.md")),
    *sorted((ROOT / "docs").glob("explanation/*.md")),
    ROOT / "docs" / "reference" / "files.md",
]
RUN = [page for page in PAGES if any(block.kind != "toml" for block in blocks(page))]
LONG = {  # make bench runs the blocks of these pages, and tutorials at full size, as make docs does (test_tutorials.py)
    "measured-part", "time-and-accuracy", "tolerances", "two-faces", "part-with-flange", "led", "your-photo", "effects",
    "first-lens", "reading-the-report", "machinable", "mirror", "failed-picture", "white-light", "cadquery",
    "street-light", "from-python",
}  # fmt: skip
FENCES = re.compile(r"^```(\S+)", re.M)


def name_of(page):
    """A page as tests name it."""
    return str(page.relative_to(ROOT))


def make_small(scene, path):
    """A scene file, or a script, with as few control points and pixels as make a lens."""
    text = scene.read_text(encoding="utf-8")
    text = re.sub(r"control_points = \d+", "control_points = 33", text)
    text = re.sub(r"pixels = \d+", "pixels = 48", text)
    text = re.sub(r"source_points = \d+", "source_points = 4", text)
    text = re.sub(r"rrmsd = [\d.]+", "rrmsd = 0.4", text)
    text = re.sub(r"light_on_target = [\d.]+", "light_on_target = 0.7", text)
    text = re.sub(r"wavefront = [\d.]+", "wavefront = 1.0", text)
    few = (
        "" if scene.name == "thu.toml" else "\nrays = 192\ntransport_grid = 64"
    )  # `bstcad plan` knows no scenes with knobs of their own
    if "quality = " in text:
        text = re.sub(r'quality = "\w+"(.*\nrays = \d+)?', f'quality = "draft"{few}', text)
    elif path.suffix == ".toml":
        text += f'\n[tailoring]\nquality = "draft"{few}\n'
    path.write_text(text, encoding="utf-8")


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """A folder with small templates, a photograph, a finished design and measured points of it."""
    place = tmp_path_factory.mktemp("pages")
    (place / "templates").mkdir()
    for path in (ROOT / "templates").iterdir():
        if path.suffix in (".toml", ".py"):
            make_small(path, place / "templates" / path.name)
    skimage.io.imsave(place / "photo.jpg", skimage.data.astronaut()[::4, 32:480:4])  # upright: 112 x 128 pixels
    make_design(place, "disk")
    back = bstcad.open(place / "outputs/disk").lens.back
    x, y = np.meshgrid(np.linspace(-7.9, 7.9, 120), np.linspace(-7.9, 7.9, 120))
    cloud = np.stack([x, y, sag(back, x, y)], axis=-1).reshape(-1, 3)
    np.savetxt(place / "cloud.csv", cloud, delimiter=",")
    return place


def make_design(place, name):
    """Design a small template into the outputs of a folder, without pictures."""
    designed(load(place / "templates" / f"{name}.toml"), quick_effort(), place / "outputs" / name, tailoring=LITTLE)


@pytest.fixture(scope="module")
def second_design(prepared):
    """The design of templates/thu.toml, which only pages of LONG need."""
    make_design(prepared, "thu")


@pytest.fixture
def workplace(prepared, tmp_path, monkeypatch, request):
    """A copy of it to work in: few tubes and rays, no pictures, and runs of a sweep by formulas, which take no time.

    Predictions have no pilots, which tests/sweep designs.
    """
    if request.node.callspec.params["page"].stem in LONG:
        request.getfixturevalue("second_design")
    monkeypatch.setattr("bstcad.planning.plan.run_pilot", typical_pilot)
    monkeypatch.setattr("bstcad.planning.prediction.pace", lambda: 1.0)
    place = shutil.copytree(prepared, tmp_path / "work")
    monkeypatch.chdir(place)
    draws_nothing(monkeypatch)
    monkeypatch.setattr(pipeline, "DesignOptions", partial(pipeline.DesignOptions, effort=LITTLE))
    monkeypatch.setattr("bstcad.figures.rendering.draw", lambda path, picture: bool(picture.write_bytes(b"drawn")))
    quickly(monkeypatch)
    verify_with(monkeypatch, quick_effort())
    sweep = sweeping.tradeoff
    monkeypatch.setattr(
        sweeping, "tradeoff",
        lambda scene, *given, **more: sweep(scene, *given, **more | {"machines": Synthetic(scene)}),
    )  # fmt: skip
    study, few = tolerancing.tolerance, {"tubes": 129, "trials": 200, "full": 4}
    monkeypatch.setattr(tolerancing, "tolerance", lambda folder, settings: study(folder, replace(settings, **few)))
    monkeypatch.setattr(batch, "design", copied)
    return place


def copied(contents, folder, variables, tick):
    """A design of a batch, which has processes of its own otherwise."""
    shutil.copytree("outputs/disk", folder)
    return ExitStatus(0, 1.0, 1.0, "")


def run_command(words):
    """A command of a page, in this process; `make` would run this test again."""
    program, *arguments = words
    if program == "bstcad":
        assert cli.run(arguments) == 0, shlex.join(words)
        if arguments[0] == "new":
            path = Path(f"{arguments[1]}.toml")
            make_small(path, path)
    elif program == "python":
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", arguments)
            runpy.run_path(arguments[0], run_name="__main__")


def params(pages, **options):
    return [pytest.param(page, id=name_of(page), **options) for page in pages]


LONG_PAGES = [page for page in RUN if page.stem in LONG]
SHORT_PAGES = [page for page in RUN[1:] if page.stem not in LONG]  # pages after the README, which runs at each commit


@pytest.mark.parametrize(
    "page",
    [*params(RUN[:1]), *suite.in_turns(params(SHORT_PAGES), 4), *params(LONG_PAGES, marks=pytest.mark.bench)],
)
def test_its_blocks_run_one_after_the_other(page, workplace):
    for block in blocks(page):
        if block.kind == "sh":
            for words in block.commands:
                run_command(words)
        elif block.kind == "python":
            exec(compile(block.text, f"{page.name}:{block.line}", "exec"), {"__name__": "page"})


@pytest.mark.parametrize("page", RUN, ids=name_of)
def test_its_commands_and_scripts_are_there(page):
    """Each command takes the options that it is given; targets of make and scripts are there; Python compiles."""
    known = typer.main.get_command(cli.app).commands
    for block in blocks(page):
        if block.kind == "python":
            compile(block.text, f"{page.name}:{block.line}", "exec")
        for program, first, *rest in block.commands if block.kind == "sh" else ():
            if program == "bstcad":
                command = known[first]
                command.make_parser(command.context_class(command)).parse_args(rest)
            elif program == "make":
                assert subprocess.run(["make", "-n", first, *rest], cwd=ROOT, stdout=subprocess.DEVNULL).returncode == 0
            else:
                assert program == "python" and (ROOT / first).is_file()


def merged(base, given):
    """The tables of a scene with those of a page in them; a table of another kind or shape takes the place of one."""
    if not (isinstance(base, dict) and isinstance(given, dict)) or any(
        key in given and given[key] != base.get(key) for key in ("kind", "shape")
    ):
        return given
    return base | {key: merged(base.get(key), value) for key, value in given.items()}


@pytest.mark.parametrize("page", [page for page in PAGES if "```toml" in page.read_text("utf-8")], ids=name_of)
def test_its_tables_are_those_of_a_scene(page, tmp_path):
    for block in (block for block in blocks(page) if block.kind == "toml"):
        base, path = ROOT / "templates" / block.onto, tmp_path / "scene.toml"
        tables = merged(tomllib.loads(base.read_text(encoding="utf-8")), tomllib.loads(block.text))
        path.write_text(tomli_w.dumps(tables), encoding="utf-8")
        skimage.io.imsave(tmp_path / "photo.jpg", skimage.data.astronaut()[::4, 32:480:4])
        assert load(path) != load(base), f"{page.name}:{block.line}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_its_blocks_are_of_kinds_that_are_run_or_output(page):
    kinds = set(FENCES.findall(page.read_text(encoding="utf-8")))
    assert {kind for kind in kinds if not kind.startswith("{")} <= {"sh", "python", "toml", "text"}


def test_every_key_of_a_scene_has_an_example():
    """The page of keys has examples from the templates, from the pages, or from the key's own record."""
    from reference_pages import examples_of_keys

    from bstcad.scene.schema import rows

    known = {key for key, _ in examples_of_keys()}
    assert [
        row.key for row in rows() if not row.range.startswith("table") and row.key.replace("[]", "") not in known
    ] == []


def test_every_field_of_a_json_file_has_a_meaning():
    from reference_pages import json_files

    rows = re.findall(r"^\| `(\w+)` \| .*? \| (.*) \|$", json_files(), re.M)
    assert len(rows) > 100 and [name for name, meaning in rows if not meaning] == []


def test_the_tables_of_the_house_name_each_part_and_the_kinds_of_each_noun():
    from reference_pages import NOUNS, kinds, libraries, rooms

    from tests.test_architecture import MAY_IMPORT, ONLY

    parts = re.findall(r"^\| `([\w.]+)` \| [^|]{20,} \| [`n][^|]+ \|$", rooms(), re.M)
    assert parts == [part for part in MAY_IMPORT if part != "bstcad"]
    assert re.findall(r"^\| (\w+) \| `", libraries(), re.M) == list(ONLY)
    found = dict(re.findall(r"^\| `(\w+)` \| `(\w+)` \| `[\w/.]+` \| [^|]{4,} \|$", kinds(), re.M))
    assert found.keys() == set(NOUNS) and "`Point`" in kinds() and "`_" not in kinds()


def test_the_site_is_complete_without_a_network():
    """Pages name no address from which a browser would fetch; those of links are no fetch."""
    for path in (*(ROOT / "docs").rglob("*.md"), ROOT / "docs" / "conf.py", *(ROOT / "docs" / "_static").iterdir()):
        if "_build" not in path.parts and "_made" not in path.parts:
            text = path.read_text(encoding="utf-8")
            assert not re.search(r"!\[[^\]]*\]\(https?:|src=.https?:|@import|url\(.?https?:", text), path


def test_the_table_of_arrays_has_those_of_a_design(small_design):
    from reference_pages import arrays

    with np.load(small_design.folder / "design.npz") as stored:
        shapes = {name: stored[name].ndim for name in stored.files}
    listed = dict(re.findall(r"^\| `(\w+)` \| (\(.*?\)) \| .+ \|$", arrays(), re.M))
    dimensions = {name: len([size for size in shape.strip("()").split(",") if size]) for name, shape in listed.items()}
    assert len(shapes) >= 10 and shapes.items() <= dimensions.items()


def test_the_table_of_grades_bounds_every_error_once_and_has_all_their_limits():
    from reference_pages import grades

    from bstcad.manufacture.tolerance.grades import GRADES
    from bstcad.scene.quality import FINISH_KEYS, Name

    families = {name.removesuffix("_x").removesuffix("_y") for name in get_args(Name)}
    rows = [row.split(" | ") for row in grades().splitlines()[2:]]
    named = [name for row in rows for name in re.findall(r"`([\w.]+)`", row[1])]
    assert sorted(named) == sorted({*families, *FINISH_KEYS})
    [tilt] = [row for row in rows if "`lens.tilt`" in row[1]]
    assert [float(value.rstrip(" |")) for value in tilt[2:]] == [grade.tilt for grade in GRADES.values()]


def test_the_guide_to_checks_names_all_that_a_proof_tells_of_the_shape():
    from bstcad.analysis.shape import describe

    text = (ROOT / "docs" / "how-to" / "extend.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`(\w+)`", text))
    lens = load(ROOT / "templates" / "disk.toml").flat_lens(9)
    assert {"volume", *describe(lens, grid=33)} - named == set()
