"""14. Truncated, hostile or huge input.

Readers get wrong input by the ten thousand in processes of their own (readers.py), and texts that drive patterns which
backtrack into hours.  An answer is a sane result or one sentence, at once, and nothing is written.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from bstcad.cad import step_writing
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.surfaces import Plane
from bstcad.scene.scene import SceneError, load
from bstcad.step_text import part21
from tests.hard_cases import fuzz, fuzz_steps

ROOT = Path(__file__).parent.parent.parent
SECONDS = 10.0  # for one input; what it takes depends on the machine, by a factor of ten at most
MEGABYTES = 1000.0  # above the libraries: a picture of 64 million pixels in colour is 600
LEAST_PASSED = 0.05  # of the inputs: changes too coarse would be refused at the door and try nothing behind it


def run(reader, numbers, folder):
    """What two processes say of the inputs, half of them each."""
    middle = (numbers.start + numbers.stop) // 2
    processes = []
    for half in (range(numbers.start, middle), range(middle, numbers.stop)):
        place = folder / str(half.start)
        place.mkdir()
        if reader == "part21":
            heights = torch.linspace(0, 1e-2, 25, dtype=torch.float64).reshape(5, 5)
            lens = Lens(Plane(8.0), BSplineSurface(20.0, heights, (-4.0, 4.0), (-4.0, 4.0)), Rectangle(8.0, 8.0), 1.5)
            step_writing.write_lens(lens, place / "lens.step", "lens")
        command = [sys.executable, "-m", "tests.hard_cases.readers", reader, "1"]
        command += map(str, (half.start, half.stop, place))
        environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        processes.append(subprocess.Popen(command, cwd=ROOT, env=environment, **pipes))
    ends = [process.communicate(timeout=3000) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], [err[-2000:] for _, err in ends]
    assert [err for _, err in ends] == ["", ""]  # no decoder or library said anything of its own
    return [json.loads(out) for out, _ in ends]


@pytest.mark.parametrize(
    "numbers", [range(2_000), pytest.param(range(10_000, 110_000), marks=pytest.mark.bench)], ids=len
)
@pytest.mark.parametrize("reader", ["scene", "picture", "part21"])
def test_wrong_input_is_one_sentence(reader, numbers, tmp_path, holds):
    """The figures of a run, held to their bounds."""
    found = run(reader, numbers, tmp_path)
    faults = [fault for part in found for fault in part["faults"]]
    assert faults == []
    assert [part["warnings"] for part in found] == [[], []]
    assert sum(part["passed"] for part in found) > LEAST_PASSED * len(numbers)
    assert min(part["sentences"] for part in found) > 12  # ways to be refused
    holds(f"{reader}: inputs that ended in no sentence and no sane result, of {len(numbers)}", len(faults), 0)
    holds(f"{reader}: files written", len({name for part in found for name in part["written"]}), 0)
    holds(f"{reader}: slowest input (an indication)", max(part["slowest"][0] for part in found), SECONDS, "s")
    holds(f"{reader}: memory above the libraries'", max(part["megabytes"] for part in found), MEGABYTES, "MB")


# ---- texts that drive patterns ---------------------------------------------------------------------------------------

MEGABYTE = 1_000_000
PIECES = (  # each was seen to take the square of its number, or is a neighbour of one that did
    "#1,", "'", "(", ")", "()", "1", "#", "#1=(", "#1=A(#2)", ")#3=(", ";", "=", "= ", " ", "=PRODUCT('", "=PRODUCT(",
    "FILE_SCHEMA((", "LENGTH_UNIT()", "GLOBAL_UNIT_ASSIGNED_CONTEXT((", "CONVERSION_BASED_UNIT(", "B_SPLINE_SURFACE(2,",
    "B_SPLINE_SURFACE(2.)", "B_SPLINE_CURVE_WITH_KNOTS('',2,(#1", "#7=CARTESIAN_POINT('',(", "DATA;", "ENDSEC;", ".T",
    "1.,", "1.E1,", "-", "SI_UNIT(", "RATIONAL_B_SPLINE_SURFACE((", "\\X2\\", "93E1", "A", "_", ".A.,",
    "DIRECTION('',(1.,",
)  # fmt: skip
AROUND = (
    ("", ""), ("#99000=(", ");"), ("#99000=A('',(", "));"), ("#99000=PRODUCT('", "','','',());"),
    ("#99000=(B_SPLINE_SURFACE(2,2,((", ")))B_SPLINE_SURFACE_WITH_KNOTS((3,3),(3,3),(0.,1.),(0.,1.),.U.));"),
    ("#901=(LENGTH_UNIT()", ");"),
)  # fmt: skip


def longest(size):
    """Seconds of the slowest of the texts with so many characters of one piece, in the data or in the header."""
    text, worst = fuzz_steps.lens_text(), 0.0
    for piece in PIECES:
        for before, behind in AROUND:
            content = before + piece * (size // len(piece)) + behind
            for old, new in (
                ("ENDSEC;\nEND-ISO", f"{content}ENDSEC;\nEND-ISO"),
                ("FILE_SCHEMA", f"{content}FILE_SCHEMA"),
            ):
                began = time.perf_counter()
                try:
                    part21.parse(text.replace(old, new, 1))
                except ValueError as error:
                    assert str(error).isprintable() and len(str(error)) <= 600
                worst = max(worst, time.perf_counter() - began)
    return worst


@pytest.mark.parametrize("size", [MEGABYTE // 10, pytest.param(MEGABYTE, marks=pytest.mark.bench)])
def test_no_pattern_of_the_step_reader_takes_the_square_of_a_text(size, holds):
    """With a tenth of a megabyte, where the square is a hundredth of it."""
    figure = f"part21: slowest repetitive text of {size / MEGABYTE:g} MB (an indication)"
    holds(figure, longest(size), SECONDS * size / MEGABYTE, "s")


def test_a_wide_number_of_an_entity_costs_no_memory():
    """A table by number would take 8 EB."""
    text = (
        fuzz_steps.lens_text()
        .replace("#1 =", f"#{10**17} =")
        .replace("#1,", f"#{10**17},")
        .replace("#1)", f"#{10**17})")
    )
    assert part21.parse(text).surface.control_points.shape == (5, 5, 3)


# ---- scenes that take long, or say more than a line ------------------------------------------------------------------


def load_with(folder, more="", overrides=None):
    """Write a scene file with something behind its first line, and load it."""
    path = folder / "scene.toml"
    path.write_bytes(fuzz.SCENES[0].replace('name = "a"', f'name = "a"\n{more}').encode())
    return load(path, overrides)


LONG = {
    "a dotted key": ("a." * 300_000 + "a = 1", "over 100 dots"),
    "a dotted table": ("[" + "a." * 300_000 + "a]", "over 100 dots"),
    "a dotted key in a table": ("b = { " + "a." * 300_000 + "a = 1 }", "over 100 dots"),
    "lists in lists": ("effects = " + "[" * 400 + "]" * 400, "nested too deeply"),
    "tables in tables": ("effects = " + "[{ a = " * 200 + "1" + " }]" * 200, "nested too deeply"),
    "many keys": ("\n".join(f"k{i} = {i}" for i in range(50_000)), "unknown key"),
    "many tables": ("\n".join(f"[k{i}]" for i in range(50_000)), "unknown key|missing"),
    "a long key": ("k" * 900_000 + " = 1", "unknown key"),
    "a long text": ('k = "' + "x" * 900_000 + '"', "k: unknown key"),
    "a long number": ("b = 0x" + "f" * 900_000, "a number of over 300 digits"),
    "brackets": ("b = " + "[" * 900_000, "nested too deeply|not valid TOML"),
    "quotes": ('b = "' + '\\"' * 400_000, "not valid TOML"),
    "a line and an escape in a key": ('"a\\nb\\u001b[2J" = 1', r"a\\nb\\x1b\[2J: unknown key"),
}


@pytest.mark.parametrize("text", LONG)
def test_a_long_scene_is_refused_at_once(tmp_path, holds, text):
    more, sentence = LONG[text]
    began = time.perf_counter()
    with pytest.raises(SceneError, match=sentence) as caught:
        load_with(tmp_path, more)
    holds("scene: slowest file of up to 1 MB (an indication)", time.perf_counter() - began, SECONDS, "s")
    assert str(caught.value).isprintable() and len(str(caught.value)) <= 600


STRANGE = [
    ({"target.text": "A\rB", "target.pixels": 4096}, "no letter"),
    ({"target.text": "A\u2029", "target.pixels": 4096}, "no letter"),
    ({"target.text": "\u200b", "target.pixels": 4096}, "leave no ink"),
    ({"target.text": " \u202e ", "target.pixels": 4096}, "no ink"),
    ({"title": "a\x1b[2Jb"}, "title: must be one line"),
    ({"title": "a\nb"}, "title: must be one line"),
    ({"title": "x" * 201}, "title: must be one line"),
    ({"target.x": [0.0, 1e-320], "target.text": "A"}, r"target\.x: is narrower than 0\.001 mm"),
]


@pytest.mark.parametrize(("overrides", "sentence"), STRANGE)
def test_words_that_cannot_be_drawn_or_would_steer_a_terminal_are_refused(tmp_path, overrides, sentence):
    with pytest.raises(SceneError, match=sentence):
        load_with(tmp_path, overrides=overrides)
