"""15. Truncated, hostile and huge files.

Readers get wrong input by the hundred (fuzz.py), and texts that drive patterns which backtrack into hours.  An answer
is a sane result or one sentence, at once and within bounds of memory; nothing is written or started.
"""

from __future__ import annotations

import math
import os
import re
import resource
import sys
import time
from collections import Counter
from pathlib import Path
from random import Random

import numpy as np
import pytest

from bstcad.cad import step_writing
from bstcad.scene.picture import FORMATS, read_picture
from bstcad.scene.scene import SceneError, load
from bstcad.scene.target import Target
from bstcad.step_text import part21
from tests import suite
from tests.hard_cases import fuzz

SECONDS = 10.0  # largest CPU seconds of one input; machines differ by a factor of ten at most
MEGABYTES = 2000.0  # largest address space of an input (MB): a picture of 64 million pixels in colour takes 600
# Smallest fraction of inputs that pass: coarse changes would be refused at the door and try nothing behind it.
LEAST_PASSED = 0.05
LONGEST = 700  # characters of a sentence


@pytest.fixture(scope="module")
def small_step(small_scene, tmp_path_factory):
    """The STEP text of a plate with 5 x 5 control points."""
    path = tmp_path_factory.mktemp("plate") / "plate.step"
    step_writing.write_lens(small_scene.flat_lens(5), path, "plate")
    return path.read_text(encoding="latin-1")


# ---- what reads: each raises what its reader raises ------------------------------------------------------------------


def scene_reader(path, random):
    overrides = {random.choice(fuzz.KEYS): random.choice(fuzz.VALUES)} if random.random() < 0.5 else {}
    scene = load(path, overrides)
    assert math.isfinite(scene.index) and re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,79}", scene.name)


def picture_reader(path, random):
    """Through the target of a scene."""
    found = read_picture(path)
    told = {
        "rotate": random.choice((0, 90)), "fit": random.choice(("crop", "pad", "stretch")),
        "invert": random.random() < 0.5, "gamma": random.choice((None, 1.0, 10.0)),
        "pixels": random.choice((8, 13, (8, 13))),
    }  # fmt: skip
    target = Target(z=1.0, x=(0.0, 1.0), y=(0.0, 1.0), image=found, **told)
    light = target.irradiance()
    assert np.isfinite(light).all() and light.min() >= 0 and abs(light.sum() - 1) < 1e-9
    assert all(remark.isprintable() and len(remark) < 300 for remark in target.remarks())
    assert found.name in {f"{path.stem}{ending}" for ending in FORMATS.values()}


def step_reader(path, _):
    found = part21.read(path)
    surface = found.surface
    for full, n, degree in zip(surface.full_knots, surface.control_points.shape, surface.degrees, strict=False):
        assert len(full) == n + degree + 1 and np.isfinite(full).all() and (np.diff(full) >= 0).all()
    assert np.isfinite(surface.control_points).all() and surface.control_points.shape[2] == 3
    words = found.product, found.schema, found.unit, found.angle
    assert all(word.isprintable() and len(word) <= LONGEST for word in words), words


READERS = {  # reader, seed file, good STEP text, and least number of sentences
    "part21": (step_reader, lambda random, step: fuzz.file_of(random, step, "latin-1"), 6),
    "scene": (scene_reader, lambda random, step: fuzz.file_of(random, random.choice(fuzz.scenes())), 25),
    "picture": (picture_reader, lambda random, step: fuzz.picture(random), 6),
}

OUTSIDE = (  # events by which a process changes something outside itself, beside files that it opens to write
    "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate", "os.chmod", "os.system",
    "os.exec", "os.fork", "os.posix_spawn", "subprocess.Popen", "socket.connect", "pickle.find_class", "shutil.rmtree",
)  # fmt: skip
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
looking = []  # names of the readers that look at present


@pytest.fixture(scope="module")
def seen():
    """The changes outside this process while it is looking; the audit hook stays until the process ends."""
    events = set()

    def hear(event, arguments):
        if looking:
            written = event == "open" and (arguments[2] or 0) & WRITING and arguments[0] != os.devnull
            if written or event in OUTSIDE:
                events.add(f"{event} {arguments[0]!r}"[:200])

    sys.addaudithook(hear)
    return events


def memory(entry):
    """An entry of this process's status, in MB."""
    return int(re.search(rf"{entry}:\s+(\d+) kB", Path("/proc/self/status").read_text(encoding="ascii"))[1]) / 1e3


@pytest.fixture
def bounded():
    """No more memory than MEGABYTES above what is held now: beyond it MemoryError, which is no sentence."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (int(1e6 * (memory("VmSize") + MEGABYTES)), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def is_one_sentence(error):
    """Return True if an error is one sentence with a remedy, of the reader's own."""
    text = str(error)
    alien = re.search(r"Traceback|pydantic|Exceeds the limit|\bline \d+, in\b", text)
    remedy = "; " in text or "did you mean" in text
    ours = type(error) in (SceneError, ValueError) and remedy and not alien
    return ours and text.isprintable() and 20 < len(text) <= LONGEST


@pytest.mark.parametrize("count", [120, pytest.param(5_000, marks=pytest.mark.bench)])
@pytest.mark.parametrize("reader", READERS)
@pytest.mark.filterwarnings("error")
def test_wrong_input_is_one_sentence(reader, count, small_step, tmp_path, seen, bounded, capfd, holds):
    read, made, ways = READERS[reader]
    path, ends, slowest, good = tmp_path / "input.toml", Counter(), 0.0, fuzz.Good(small_step, ";")
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before = memory("VmRSS")
    for seed in range(count):
        random = Random(seed)
        path.write_bytes(made(random, good))
        began, end = time.process_time(), "passed"
        looking.append(reader)
        try:
            read(path, random)
        except Exception as error:
            if isinstance(error, AssertionError) or not is_one_sentence(error):
                raise AssertionError(f"input of seed {seed}") from error
            end = re.sub(r"'[^']*'|[\d.#]+", "_", str(error))[:60]
        finally:
            looking.clear()
        ends[end] += 1
        slowest = max(slowest, time.process_time() - began)
    assert ends["passed"] > LEAST_PASSED * count and len(ends) > ways, ends
    assert capfd.readouterr() == ("", "")  # no decoder or library said anything of its own
    holds(f"{reader}: files written", len(seen), 0)
    holds(f"{reader}: slowest of {count} damaged inputs (an indication)", slowest, SECONDS, "s")
    holds(f"{reader}: memory besides that of the libraries", memory("VmHWM") - before, MEGABYTES / 2, "MB")


# ---- texts that drive patterns ---------------------------------------------------------------------------------------

MEGABYTE = 1_000_000
PIECES = (  # each was seen to take the square of its number, or is a neighbour of one that did
    "#1,", "'", "(", "()", "#", "#1=(", "#1=A(#2)", ")#3=(", ";", "= ", " ", "=PRODUCT('", "FILE_SCHEMA((",
    "LENGTH_UNIT()", "GLOBAL_UNIT_ASSIGNED_CONTEXT((", "B_SPLINE_SURFACE(2,", "B_SPLINE_CURVE_WITH_KNOTS('',2,(#1",
    "#7=CARTESIAN_POINT('',(", "DATA;", "ENDSEC;", ".T", "1.E1,", "SI_UNIT(", "\\X2\\", "A", ".A.,",
    "1", "#1", "1.", "-", "NAN,", "/*",
)  # fmt: skip
AROUND = (
    ("", ""), ("#99000=(", ");"), ("#99000=PRODUCT('", "','','',());"),
    ("#99000=(B_SPLINE_SURFACE(2,2,((", ")))B_SPLINE_SURFACE_WITH_KNOTS((3,3),(3,3),(0.,1.),(0.,1.),.U.));"),
)  # fmt: skip


@suite.in_turn(1, 2)
@pytest.mark.parametrize("size", [MEGABYTE // 20, pytest.param(MEGABYTE, marks=pytest.mark.bench)])
def test_no_pattern_of_the_step_reader_takes_the_square_of_a_text(size, small_step, holds):
    """Repetitive texts of 0.05 MB, where a square law takes 1/400 of the time; in one piece, in data or header."""
    worst = 0.0
    for piece in PIECES:
        for before, behind in AROUND:
            content = before + piece * (size // len(piece)) + behind
            for place in ("ENDSEC;\nEND-ISO", "FILE_SCHEMA")[: 1 if before else 2]:
                began = time.process_time()
                try:
                    part21.parse(small_step.replace(place, content + place, 1))
                except ValueError as error:
                    assert str(error).isprintable() and len(str(error)) <= 600
                worst = max(worst, time.process_time() - began)
    figure = f"part21: slowest repetitive text of {size / MEGABYTE:g} MB (an indication)"
    holds(figure, worst, SECONDS * size / MEGABYTE, "s")


def test_a_wide_number_of_an_entity_costs_no_memory(small_step):
    """A table by number would take 8 EB."""
    point = re.search(r"B_SPLINE_SURFACE_WITH_KNOTS\('[^']*',\s*2,\s*2,\s*\(\s*\(\s*(#\d+)", small_step)[1]
    wide = re.sub(rf"{point}\b", f"#{10**17}", small_step)
    assert part21.parse(wide).surface.control_points.shape == (5, 5, 3)


# ---- scenes that take long, or say more than a line ------------------------------------------------------------------

LONG = {
    "a dotted key": ("a." * 300_000 + "a = 1", "more than 100 dots"),
    "lists in lists": ("effects = " + "[" * 400 + "]" * 400, "nested too deeply"),
    "many keys": ("\n".join(f"k{i} = {i}" for i in range(20_000)), "unknown key"),
    "a long number": ("b = 0x" + "f" * 900_000, "a number of more than 300 digits"),
    "quotes": ('b = "' + '\\"' * 400_000, "not valid TOML"),
    "a line and an escape in a key": ('"a\\nb\\u001b[2J" = 1', r"a\\nb\\x1b\[2J: unknown key"),
}
STRANGE = [  # words that cannot be drawn or would steer a terminal
    ({"target.text": "A\rB", "target.pixels": 4096}, "no letter"),
    ({"target.text": "\u200b", "target.pixels": 4096}, "no visible characters"),
    ({"title": "a\x1b[2Jb"}, "title: must be one line"),
    ({"target.x": [0.0, 1e-320], "target.text": "A"}, r"target\.x: is narrower than 0\.001 mm"),
]
CASES = [(more, {}, sentence) for more, sentence in LONG.values()] + [("", *case) for case in STRANGE]


@pytest.mark.parametrize(("more", "overrides", "sentence"), CASES, ids=[*LONG, *range(len(STRANGE))])
def test_a_long_or_strange_scene_is_refused_at_once(tmp_path, holds, more, overrides, sentence):
    """templates/disk.toml with something behind its first line."""
    path, disk = tmp_path / "scene.toml", "".join(fuzz.scenes()[0].tokens)
    path.write_bytes(disk.replace('name = "disk"', f'name = "disk"\n{more}').encode())
    began = time.process_time()
    with pytest.raises(SceneError, match=sentence) as caught:
        load(path, overrides)
    holds("scene: slowest file of up to 1 MB (an indication)", time.process_time() - began, SECONDS, "s")
    assert str(caught.value).isprintable() and len(str(caught.value)) <= 600
