"""14. Truncated, hostile or huge input.

Readers get wrong input by the thousand in a process of its own (fuzz.py), and texts that drive patterns which backtrack
into hours.  An answer is a sane result or one sentence, at once, and nothing is written.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bstcad.scene.scene import SceneError, load
from bstcad.step_text import part21
from tests.hard_cases import fuzz

ROOT = Path(__file__).parent.parent.parent
SECONDS = 10.0  # of the processor for one input; machines differ by a factor of ten at most
MEGABYTES = 1000.0  # above the libraries: a picture of 64 million pixels in colour is 600
LEAST_PASSED = 0.05  # of the inputs: changes too coarse would be refused at the door and try nothing behind it


@pytest.mark.parametrize("examples", [700, pytest.param(20_000, marks=pytest.mark.bench)])
def test_wrong_input_is_one_sentence(examples, small_step, tmp_path, holds):
    """By the readers of STEP text, scenes and pictures."""
    shutil.copy(small_step, tmp_path / "good.step")
    command = [sys.executable, "-m", "tests.hard_cases.fuzz", str(examples), str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=3000)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stderr == ""  # no decoder or library said anything of its own
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert [of["reader"] for of in found] == ["part21", "scene", "picture"]
    for of in found:
        reader = of["reader"]
        assert of["tried"] >= examples and of["passed"] > LEAST_PASSED * of["tried"]
        assert of["sentences"] > 6  # ways to be refused
        holds(f"{reader}: inputs that ended in no sentence and no sane result, of {examples}", 0, 0)
        holds(f"{reader}: files written", len(of["written"]), 0)
        holds(f"{reader}: slowest input (an indication)", of["slowest"], SECONDS, "s")
        holds(f"{reader}: memory above the libraries'", of["megabytes"], MEGABYTES, "MB")


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
    ("#99000=(LENGTH_UNIT()", ");"),
)  # fmt: skip


def longest(text, size):
    """CPU seconds of the slowest of the texts with so many characters of one piece, in the data or in the header."""
    worst = 0.0
    for piece in PIECES:
        for before, behind in AROUND:
            content = before + piece * (size // len(piece)) + behind
            for place in ("ENDSEC;\nEND-ISO", "FILE_SCHEMA")[: 1 if before else 2]:
                began = time.process_time()
                try:
                    part21.parse(text.replace(place, content + place, 1))
                except ValueError as error:
                    assert str(error).isprintable() and len(str(error)) <= 600
                worst = max(worst, time.process_time() - began)
    return worst


@pytest.mark.parametrize("size", [MEGABYTE // 20, pytest.param(MEGABYTE, marks=pytest.mark.bench)])
def test_no_pattern_of_the_step_reader_takes_the_square_of_a_text(size, small_step, holds):
    """With a twentieth of a megabyte, where the square is 1/400 of it."""
    figure = f"part21: slowest repetitive text of {size / MEGABYTE:g} MB (an indication)"
    holds(figure, longest(small_step.read_text(), size), SECONDS * size / MEGABYTE, "s")


def test_a_wide_number_of_an_entity_costs_no_memory(small_step):
    """A table by number would take 8 EB."""
    text = small_step.read_text()
    point = re.search(r"B_SPLINE_SURFACE_WITH_KNOTS\('[^']*',\s*2,\s*2,\s*\(\s*\(\s*(#\d+)", text)[1]
    assert part21.parse(re.sub(rf"{point}\b", f"#{10**17}", text)).surface.control_points.shape == (5, 5, 3)


# ---- scenes that take long, or say more than a line ------------------------------------------------------------------


def load_with(folder, more="", overrides=None):
    """Write templates/disk.toml with something behind its first line, and load it."""
    path, [disk] = folder / "scene.toml", [good.text for good in fuzz.scenes() if 'name = "disk"' in good.text]
    path.write_bytes(disk.replace('name = "disk"', f'name = "disk"\n{more}').encode())
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
    began = time.process_time()
    with pytest.raises(SceneError, match=sentence) as caught:
        load_with(tmp_path, more)
    holds("scene: slowest file of up to 1 MB (an indication)", time.process_time() - began, SECONDS, "s")
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
