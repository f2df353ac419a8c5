"""Wrong input by its numbers into one reader, in a process of its own: what came out of it, as a line of JSON.

python -m tests.hard_cases.readers READER SEED FIRST END FOLDER

A reader may succeed with a sane result or raise its one error, whose text is one sentence.  The process may hold no
more memory than MEMORY, and the reader may open no file for writing and start nothing; the audit hook tells.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.hard_cases import fuzz, fuzz_pictures, fuzz_steps

MEMORY = 6 << 30  # bytes of address space: beyond it MemoryError, which is no sentence
LONGEST = 700  # characters of a sentence
CHANGES = (
    "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate", "os.chmod", "os.system",
    "os.exec", "os.fork", "os.posix_spawn", "subprocess.Popen", "socket.connect", "pickle.find_class", "shutil.rmtree",
)  # fmt: skip
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


class Watch:
    """Names what the process changes outside itself while it is told to look."""

    def __init__(self) -> None:
        self.looking, self.seen = False, set()
        sys.addaudithook(self._hear)

    def _hear(self, event: str, arguments: tuple) -> None:
        written = event == "open" and (arguments[2] or 0) & WRITING and arguments[0] != os.devnull
        if self.looking and (written or event in CHANGES):
            self.seen.add(f"{event} {arguments[0]!r}"[:200])

    @contextlib.contextmanager
    def on(self) -> Iterator[None]:
        self.looking = True
        try:
            yield
        finally:
            self.looking = False


# ---- the readers: each makes a function that feeds one input and raises what the reader raises -----------------------


def scenes(folder: Path, watch: Watch) -> Callable[[random.Random], None]:
    """Scene files beside a picture, some with overrides."""
    from bstcad.scene.scene import load

    path = folder / "scene.toml"
    (folder / "a.png").write_bytes(_good_picture())

    def feed(g: random.Random) -> None:
        data, overrides = fuzz.scene(g)
        _write(path, data)
        with watch.on():
            scene = load(path, overrides)
            if g.random() < 0.3:  # `load` has asked for it already
                _sane_light(scene.target.irradiance())
            assert math.isfinite(scene.index) and re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,79}", scene.name)
            assert scene.toml().isprintable() or "\n" in scene.toml()

    return feed


def pictures(folder: Path, watch: Watch) -> Callable[[random.Random], None]:
    """Picture files, through the target of a scene."""
    from bstcad.scene.picture import FORMATS, read_picture
    from bstcad.scene.target import Target

    path = folder / "picture.png"

    def feed(g: random.Random) -> None:
        data, gamma = fuzz_pictures.picture(g), g.choice((None, None, 1.0, 2.2, 10.0))
        _write(path, data)
        with watch.on():
            found = read_picture(path)
            seen = {"rotate": g.choice((0, 90)), "fit": g.choice(("crop", "pad", "stretch"))}
            seen |= {"gamma": gamma, "invert": g.random() < 0.2, "pixels": g.choice((8, 13, (8, 13)))}
            target = Target(z=1.0, x=(0.0, 1.0), y=(0.0, 1.0), image=found, **seen)
            _sane_light(target.irradiance())
            assert all(remark.isprintable() and len(remark) < 300 for remark in target.remarks())
            assert found.name in {f"picture{ending}" for ending in FORMATS.values()}

    return feed


def steps(folder: Path, watch: Watch) -> Callable[[random.Random], None]:
    """STEP texts: three short ones, and one as OCC writes it (lens.step in the folder); some by way of a file."""
    import numpy as np

    from bstcad.step_text import part21

    path, whole = folder / "damaged.step", (folder / "lens.step").read_text(encoding="latin-1")
    short = [fuzz_steps.lens_text(m, rational) for m, rational in ((5, False), (6, True), (9, False))]

    def feed(g: random.Random) -> None:
        by_file = g.random() < 0.05
        text = fuzz_steps.step(g, [whole] if g.random() < 0.15 else short)
        if by_file:
            _write(path, text.encode("latin-1", "replace"))
        with watch.on():
            found = part21.read(path) if by_file else part21.parse(text)
            surface = found.surface
            for full, n, degree in zip(surface.full_knots, surface.control_points.shape, surface.degrees, strict=False):
                assert len(full) == n + degree + 1 and np.isfinite(full).all() and (np.diff(full) >= 0).all()
            assert np.isfinite(surface.control_points).all() and surface.control_points.shape[2] == 3
            words = found.product, found.schema, found.unit, found.angle
            assert all(word.isprintable() and len(word) <= LONGEST for word in words), words

    return feed


READERS = {"scene": scenes, "picture": pictures, "part21": steps}


def _write(path: Path, data: bytes) -> None:
    path.unlink(missing_ok=True)  # some file systems flush a file that is cut to nothing and written again
    path.write_bytes(data)


def _good_picture() -> bytes:
    return fuzz_pictures.good("JPEG", "L")  # a JPEG called .png: the content decides


def _sane_light(flux) -> None:
    import numpy as np

    assert np.isfinite(flux).all() and flux.min() >= 0 and abs(flux.sum() - 1) < 1e-9


# ---- the run ---------------------------------------------------------------------------------------------------------


def complaint(error: Exception) -> str | None:
    """What is wrong with how an input was refused; None if it was one sentence."""
    if type(error).__name__ != "SceneError" and type(error) is not ValueError:
        return f"{type(error).__name__}: {error}"[:300]
    text = str(error)
    if not text.isprintable() or not 20 < len(text) <= LONGEST:
        return f"no sentence: {text[:300]!r}"
    if "; " not in text and "did you mean" not in text:
        return f"no remedy: {text}"
    return f"not ours: {text}" if re.search(r"Traceback|pydantic|Exceeds the limit|\bline \d+, in\b", text) else None


def _peak() -> float:
    """Megabytes that this process has held at most; getrusage would count what its parent held when it forked."""
    [line] = re.findall(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text(encoding="ascii"))
    return int(line) / 1024


def run(reader: str, seed: int, numbers: range, folder: Path) -> dict:
    """What came of these inputs."""
    import resource

    watch = Watch()
    feed = READERS[reader](folder, watch)
    for number in range(-30, 0):  # what loads late
        with contextlib.suppress(Exception):
            feed(fuzz.generator(reader, seed, number))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    watch.seen.clear()
    before = _peak()
    passed, sentences, faults, slowest = 0, set(), [], (0.0, -1)
    with warnings.catch_warnings(record=True) as noise:
        warnings.simplefilter("always")
        for number in numbers:
            g = fuzz.generator(reader, seed, number)
            began = time.perf_counter()
            try:
                feed(g)
                passed += 1
            except Exception as error:
                wrong = complaint(error)
                faults += [(number, wrong)] if wrong else []
                sentences.add(re.sub(r"'[^']*'|[\d.#]+", "_", str(error))[:60])
            slowest = max(slowest, (time.perf_counter() - began, number))
    after = _peak()
    return {
        "tried": len(numbers), "passed": passed, "sentences": len(sentences), "faults": faults[:20],
        "faulty": len(faults), "slowest": slowest, "written": sorted(watch.seen),
        "megabytes": after - before,
        "warnings": sorted({f"{w.category.__name__} {w.message}" for w in noise})[:9],
    }  # fmt: skip


if __name__ == "__main__":
    reader, seed, first, end, folder = sys.argv[1:]
    print(json.dumps(run(reader, int(seed), range(int(first), int(end)), Path(folder))))
