"""15. Truncated, hostile and huge files.

Here files that test_hostile_input.py does not change: gauges, rays, intensities, beams, designs and records.  A reader
returns, or raises the error that its caller turns into one sentence.
"""

from __future__ import annotations

import hashlib
import shutil
import time
import tracemalloc
from random import Random

import numpy as np
import pytest

from bstcad import folder as folders
from bstcad.measured import cloud
from bstcad.optics.outlines import Circle
from bstcad.photometry import eulumdat, ies, intensity_files, ray_files, tm25, zemax_rays
from bstcad.photometry.intensity import Intensity, Luminaire, PhotometricError
from bstcad.photometry.ray_set import RaySet
from bstcad.report import record
from bstcad.runs import checkpoint
from bstcad.runs.files import MachineError, SceneError
from bstcad.scene.beam import table
from bstcad.sweep import batch
from tests.hard_cases import fuzz
from tests.measured.gauge_files import BY_SURFACE_TOPOGRAPHY, WRITERS

SECONDS = 10.0  # largest CPU seconds of one file; machines differ by a factor of ten at most
MEGABYTES = 300.0  # largest memory of the files of a reader (MB), as Python and numpy count it
LONGEST = 700  # characters of a sentence with the path of the file
LAMP = Luminaire("lamp", "maker", laboratory="laboratory", date="2026-11-28")
TEXTS = "csv", "xyz", "text.sdf", "beam.csv", "ies", "ldt", "table.csv", "report.json", "batch.json", "scene.toml"
WITH_ITS_FOLDER = "design.npz", "scene.toml", "report.json", "batch.json"  # names that readers look for
STATE = {"name": "stage 2", "numbers": (1, 0.1, None), "single": np.linspace(0, 1, 7)}  # state of a checkpoint


def heights():
    """Heights (mm) of a small map; maps of few points are refused."""
    x, y = np.meshgrid(np.linspace(-3, 3, 25), np.linspace(-3, 3, 21))
    return 0.02 * (x**2 + y**2) + 0.001 * x


def rays():
    """Twenty parallel rays in one colour."""
    position = np.random.default_rng(1).random((20, 3)).astype(np.float32)
    direction = np.tile(np.array([0.0, 0.6, 0.8], np.float32), (20, 1))
    return RaySet(position, direction, np.ones(20, np.float32), "lm", 550.0)


def intensity():
    around, along = np.arange(0.0, 360.0, 30.0), np.arange(0.0, 95.0, 5.0)
    return Intensity("C", around, along, np.outer(2 + np.cos(np.radians(around)), 1 + np.cos(np.radians(along))))


def beam():
    return "\n".join(",".join(f"{value:.4g}" for value in row) for row in heights()).encode()


def entries():
    rows = tuple(batch.BatchEntry(scene=f"{name}.toml", name=name) for name in ("one", "two"))
    return batch.Batch(version="1", designs=rows).model_dump_json(indent=1).encode()


READERS = {  # reader of a path, by the (last part of the) name of the file
    **{ending: lambda path: cloud.load(path, Circle(4.0)) for ending in WRITERS},
    **{ending: lambda path: intensity_files.read(path.name, path.read_bytes()) for ending in ("ies", "ldt")},
    "table.csv": lambda path: intensity_files.read(path.name, path.read_bytes()),
    **{ending: lambda path: ray_files.read(path.name, path) for ending in ("tm25ray", "dat")},
    "beam.csv": lambda path: table(path.read_bytes(), path.name),
    "design.npz": lambda path: folders.read_nominal(path.parent),
    "scene.toml": lambda path: folders.read_nominal(path.parent),
    "report.json": record.read,
    "batch.json": lambda path: batch.read(path.parent),
    "checkpoint": lambda path: checkpoint.read(path, dict),
}
WITH_FAULT = {"xyz": (452,), "report.json": (111,)}  # seeds whose files had ended a reader by another error
GOOD = {  # bytes that each reader reads
    **{ending: lambda _, write=write: write(heights(), 0.25) for ending, write in WRITERS.items()},
    "ies": lambda _: ies.write(intensity(), LAMP),
    "ldt": lambda _: eulumdat.write(intensity(), LAMP),
    "table.csv": lambda _: intensity_files.csv_text(intensity()).replace(intensity_files.CORNER, "0").encode(),
    "tm25ray": lambda _: tm25.write(rays(), LAMP),
    "dat": lambda _: zemax_rays.write(rays(), LAMP),
    "beam.csv": lambda _: beam(),
    "batch.json": lambda _: entries(),
    "checkpoint": lambda path: checkpoint.write(path, {"version": "1"}, STATE) or path.read_bytes(),
}


def with_checksum(data):
    """A checkpoint whose checksum is right, so that its damaged body is read."""
    begin = len(checkpoint.MAGIC) + checkpoint.DIGEST_SIZE
    return data[: len(checkpoint.MAGIC)] + hashlib.sha256(data[begin:]).hexdigest().encode() + b"\n" + data[begin:]


def mutated(random, name, data, text):
    """The bytes of a file with one to three changes; text: its tokens, or None of a binary file."""
    if text:
        return fuzz.file_of(random, text)
    for _ in range(random.randint(1, 3)):
        data = (fuzz.lying if random.random() < 0.6 else fuzz.damaged)(random, data)
    return with_checksum(data) if name == "checkpoint" else data


@pytest.mark.parametrize("count", [20, pytest.param(500, marks=pytest.mark.bench)])
@pytest.mark.parametrize("name", READERS)
def test_a_mutated_file_is_read_or_refused_in_a_sentence(name, count, small_design, tmp_path, holds):
    if name in BY_SURFACE_TOPOGRAPHY:
        pytest.importorskip("SurfaceTopography")
    folder = shutil.copytree(small_design.folder, tmp_path / "design")
    path = folder / (name if name in (*WITH_ITS_FOLDER, "checkpoint") else f"file.{name}")
    good = path.read_bytes() if path.exists() else GOOD[name](path)
    path.write_bytes(good)
    READERS[name](path)
    text = fuzz.Good(good.decode(), "\n") if name in TEXTS else None
    slowest, refused = 0.0, 0
    tracemalloc.start()
    for seed in {*range(count), *WITH_FAULT.get(name, ())}:
        random = Random(seed)
        path.write_bytes(mutated(random, name, good, text))
        began = time.process_time()
        try:
            READERS[name](path)
        except Exception as error:
            refused += 1
            ours = type(error) in (SceneError, MachineError, PhotometricError, ValueError)
            if not (ours and str(error).isprintable() and len(str(error)) <= LONGEST):
                raise AssertionError(f"input of seed {seed}") from error
        slowest = max(slowest, time.process_time() - began)
    most = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    assert refused, "no change was noticed"
    print(f"{name}: {count} files, {refused} refused, {slowest:.2f} s, {most:.0f} MB")
    holds("mutated file: slowest (an indication)", slowest, SECONDS, "s")
    holds("mutated files of a reader: memory", most, MEGABYTES, "MB")
