"""15. Truncated, hostile and huge files.

Here files that test_hostile_input.py does not change: gauges, rays, intensities, beams, designs, records, rounds,
sweeps, states and kernels; and requests to the workbench.  A reader returns, or raises the error that its caller turns
into one sentence.
"""

from __future__ import annotations

import functools
import hashlib
import io
import json
import shutil
import time
import tracemalloc
import zipfile
from pathlib import Path
from random import Random

import numba
import numpy as np
import pytest

from bstcad.app import server
from bstcad.app.design_runs import Run, State
from bstcad.cad import mesh
from bstcad.designs import folder as folders
from bstcad.designs.pipeline import DesignState, design
from bstcad.manufacture.measured import cloud
from bstcad.manufacture.shop import production, rounds
from bstcad.manufacture.tolerance import tolerances
from bstcad.optics.surfaces.outlines import Circle
from bstcad.photometry import eulumdat, ies, intensity_files, ray_files, tm25, zemax_rays
from bstcad.photometry.intensity import Intensity, Luminaire, PhotometricError
from bstcad.photometry.ray_set import RaySet
from bstcad.planning import batch, tradeoff
from bstcad.planning.tradeoff import predicted_work
from bstcad.report import record
from bstcad.runs import checkpoint, environment
from bstcad.runs.files import MachineError, SceneError
from bstcad.scene.beam import table
from bstcad.scene.scene import load
from bstcad.tailoring.driver import Hooks, no_progress
from tests import suite
from tests.app.asking import bench, made, png
from tests.app.conftest import SMALL
from tests.hard_cases import fuzz
from tests.manufacture.measured.gauge_files import BY_SURFACE_TOPOGRAPHY, WRITERS
from tests.planning.conftest import record as run_of
from tests.runs.test_kernel_cache import hits, kernel
from tests.scenes import DISK, TINY

SECONDS = 10.0  # largest CPU seconds of one file; machines differ by a factor of ten at most
MEGABYTES = 300.0  # largest memory of the files of a reader (MB), as Python and numpy count it
LONGEST = 700  # characters of a sentence with the path of the file
LAMP = Luminaire("lamp", "maker", laboratory="laboratory", date="2026-11-28")
TEXTS = (
    "csv", "xyz", "text.sdf", "beam.csv", "ies", "ldt", "table.csv", "report.json", "batch.json", "scene.toml",
    "tolerance.json", "compensation.json", "sweep.json",
)  # fmt: skip
ROUND = "compensated/round-1"
PLACES = {  # places in the folder of a design where readers look for a file, by the name of the case
    **{name: name for name in ("design.npz", "scene.toml", "report.json", "batch.json", "checkpoint", "lens.3mf")},
    "design.npz inside": "design.npz", "x3p inside": "file.x3p",
    "state": "checkpoint", "compensation.json": f"{ROUND}/compensation.json", "round.npz": f"{ROUND}/design.npz",
    "round.npz inside": f"{ROUND}/design.npz", "sweep.json": f"sweep/runs/{environment.version()}.json",
}  # fmt: skip
WITH_CHECKSUM = "checkpoint", "state"
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


SIZES = {"pv_mm": 1e-3, "rms_mm": 2e-4}
FIGURES = {  # compensation.json of a first round
    "round": 1, "parts": 1, "clouds": [{"file": "part.csv", "sha256": "0" * 64, "points": 9}], "gain": 1.0,
    "filter": rounds.FILTER, "cutoff_mm": 1.5, "deviation": SIZES, "correction": SIZES, "expected_deviation": SIZES,
    "by": "form", "volume_mm3": 0.5, "volume_by_form_mm3": 0.5, "may_stay": None, "standard_error_mm": 1e-5,
    "noise_mm": 2e-5, "rrmsd": {"design": 0.05, "measured": 0.2, "expected": 0.06},
}  # fmt: skip


@functools.cache
def tiny():
    return load(DISK, TINY)


def runs():
    """The runs of a sweep: presets, neighbours, and one that was stopped at its limit."""
    scene = tiny()
    points = tradeoff.run_order(tradeoff.knobs(scene))[:4]
    found = [run_of(scene, point).model_copy(update={"allowed_seconds": 30.0}) for point in points]
    return tradeoff.RunFile(runs=tuple(found)).model_dump_json(indent=1).encode()


@functools.cache
def work(point):
    return predicted_work(tiny(), point)


def read_sweep(path):
    """The table of a sweep that goes on from a file, and the run that it would do next."""
    sweep = tradeoff._Sweep(tiny(), 600.0, path.parents[1], no_progress)
    sweep._work = work  # remembered from sweep to sweep
    return sweep.table(), sweep._choice()


def read_rounds(path):
    """The rounds of a design, as the next round and the production page read them."""
    folder = path.parents[2]
    return rounds._last(folder, folders.read_nominal(folder).lens), production.rounds_in(folder)


def round_in(path):
    """The first round of a design; the bytes of one of its files."""
    path.parent.mkdir(parents=True)
    shutil.copy(path.parents[2] / "design.npz", path.parent)
    (path.parent / "compensation.json").write_text(json.dumps(FIGURES, indent=2))
    return path.read_bytes()


@functools.cache
def state():
    """State of a design in its second stage."""
    states = []
    design(load(DISK, TINY), device="cpu", hooks=Hooks(save=states.append))
    return next(each for each in reversed(states) if each.second is not None)


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
    "state": lambda path: checkpoint.Keeper(path, {"version": "1"}, kind=DesignState).load(),
    "lens.3mf": mesh.unit_of_3mf,
    "x3p inside": lambda path: cloud.load(path, Circle(4.0)),
    "design.npz inside": lambda path: folders.read_nominal(path.parent),
    **dict.fromkeys(("compensation.json", "round.npz", "round.npz inside"), read_rounds),
    "tolerance.json": tolerances.read,
    "sweep.json": read_sweep,
}
WITH_FAULT = {  # seeds whose files or requests had ended a reader by another error, and one that is seldom refused
    "round.npz inside": (2,), "xyz": (452,), "report.json": (111,), "/api/scene/small/preview": (132,),
    "/api/design/made/export": (208,), "/api/design/made/edit": (146,),
}  # fmt: skip
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
    "state": lambda path: checkpoint.write(path, {"version": "1"}, state()) or path.read_bytes(),
    "x3p inside": lambda _: WRITERS["x3p"](heights(), 0.25),
    **dict.fromkeys(("compensation.json", "round.npz", "round.npz inside"), round_in),
    "tolerance.json": lambda _: (
        Path(record.__file__).parents[2].joinpath("tests/report/golden_tolerance.json").read_bytes()
    ),
    "sweep.json": lambda _: runs(),
}


def with_checksum(data):
    """A checkpoint whose checksum is right, so that its damaged body is read."""
    begin = len(checkpoint.MAGIC) + checkpoint.DIGEST_SIZE
    return data[: len(checkpoint.MAGIC)] + hashlib.sha256(data[begin:]).hexdigest().encode() + b"\n" + data[begin:]


def with_changed_member(random, data):
    """A zip archive with a change in one of its members, whose checksum is right."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    name = random.choice([*members])
    members[name] = changed(random, members[name])
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for each, content in members.items():
            archive.writestr(each, content)
    return out.getvalue()


def changed(random, data):
    """Bytes with one to three changes."""
    for _ in range(random.randint(1, 3)):
        data = (fuzz.lying if random.random() < 0.6 else fuzz.damaged)(random, data)
    return data


def mutated(random, name, data, text):
    """The bytes of a file with one to three changes; text: its tokens, or None of a binary file."""
    if text:
        return fuzz.file_of(random, text)
    if name.endswith(" inside"):
        return with_changed_member(random, data)
    data = changed(random, data)
    return with_checksum(data) if name in WITH_CHECKSUM else data


@pytest.mark.parametrize("seeds", suite.samples(20, 3, 500))
@pytest.mark.parametrize("name", READERS)
def test_a_mutated_file_is_read_or_refused_in_a_sentence(name, seeds, small_design, tmp_path, holds):
    if name.removesuffix(" inside") in BY_SURFACE_TOPOGRAPHY:
        pytest.importorskip("SurfaceTopography")
    folder = shutil.copytree(small_design.folder, tmp_path / "design")
    path = folder / PLACES.get(name, f"file.{name}")
    good = path.read_bytes() if path.exists() else GOOD[name](path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(good)
    READERS[name](path)
    text = fuzz.Good(good.decode(), "\n") if name in TEXTS else None

    def read(random):
        path.write_bytes(mutated(random, name, good, text))
        READERS[name](path)

    refused = tried(name, seeds, read, holds)
    assert refused, "no change was noticed"


def tried(name, seeds, attempt, holds):
    """Call `attempt` with the random numbers of each seed; return how many inputs it refused, each in a sentence."""
    slowest, refused, seeds = 0.0, 0, {*seeds, *WITH_FAULT.get(name, ())}
    tracemalloc.start()
    for seed in seeds:
        began = time.process_time()
        try:
            attempt(Random(seed))
        except Exception as error:
            refused += 1
            ours = type(error) in (SceneError, MachineError, PhotometricError, ValueError)
            if not (ours and str(error).isprintable() and len(str(error)) <= LONGEST):
                raise AssertionError(f"input of seed {seed}") from error
        slowest = max(slowest, time.process_time() - began)
    most = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    print(f"{name}: {len(seeds)} files, {refused} refused, {slowest:.2f} s, {most:.0f} MB")
    holds("mutated file: slowest (an indication)", slowest, SECONDS, "s")
    holds("mutated files of a reader: memory", most, MEGABYTES, "MB")
    return refused


# ---- requests to the workbench ---------------------------------------------------------------------------------------

SCENE, DESIGN = "/api/scene/small", "/api/design/made"
VALUES = [value for value in fuzz.VALUES if not isinstance(value, bytes)]  # values that JSON has
REQUESTS = [  # address, body that is accepted
    ("/api/scenes", {"light": "lamp", "size": "40 cm", "text": "Hello"}),
    (f"{SCENE}/change", {"key": "target.z", "words": "120"}),
    (f"{SCENE}/change", {"key": "target.x", "value": [-8.5, 8.5], "locked": True}),
    (f"{SCENE}/change", {"text": SMALL}),
    (f"{SCENE}/proportions", {"key": "target"}),
    (f"{SCENE}/save", {"anyway": True}),
    (f"{SCENE}/preview", {"page": "p", "number": 1, "made": "diamond-turned", "lit": "sun"}),
    (f"{SCENE}/make", {"page": "p"}),
    (f"{DESIGN}/tolerance", {"grade": "diamond-turned", "yield": 90}),
    (f"{DESIGN}/tradeoff", {"budget": 600}),
    (f"{DESIGN}/retailor", {"thickness": 4.01, "index": 1.4912}),
    (f"{DESIGN}/export", {"kind": "raster", "tool_radius": 1.5, "tiles": "2x3"}),
    (f"{DESIGN}/edit", {"title": "A copy"}),
    ("/api/picture", png(12, 8)),
    (f"{DESIGN}/measured", WRITERS["csv"](heights(), 0.25)),
    (f"{DESIGN}/compensate", WRITERS["x3p"](heights(), 0.25)),
]


@pytest.mark.parametrize("seeds", suite.samples(20, 3, 500))
@pytest.mark.parametrize(("address", "body"), REQUESTS, ids=lambda part: part if isinstance(part, str) else "")
def test_a_mutated_request_is_answered_or_refused_in_a_sentence(address, body, seeds, tmp_path, monkeypatch, holds):
    """No process is started, and the answer of a preview is not waited for; afterwards the pages open."""
    monkeypatch.setattr(Run, "_start", lambda self, *options: State("finished").put(self.folder))
    monkeypatch.setattr(server, "ANSWER_TIMEOUT", 0.01)
    own = bench(tmp_path / "lenses", monkeypatch)
    made(own.folder / "made")
    text = fuzz.Good(json.dumps(body, indent=0), "\n") if isinstance(body, dict) else None

    def ask(data):
        answer = own.ask(address, data, method="POST")
        assert answer.error is None and answer.status in (200, 400), (answer.status, answer.text, answer.error)
        if answer.status == 400:
            raise SceneError(answer.json["sentence"])

    def wrong(random):
        if text and random.random() < 0.5:
            return json.dumps(body | {random.choice([*body]): random.choice(VALUES)}).encode()
        return mutated(random, address, body, text)

    if "proportions" not in address:  # its target has no photo
        ask(json.dumps(body) if text else body)
    tried(address, seeds, lambda random: ask(wrong(random)), holds)
    for page in ("/", "/scene/small", "/design/made"):
        assert own.ask(page).status == 200


# ---- the cache of kernels --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seeds", suite.samples(6, 3, 500))
@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_a_mutated_cache_of_a_kernel_is_a_miss(ending, seeds, tmp_path, monkeypatch, holds):
    """The kernel is compiled again, which its right result shows (`kernel`), and its cache is whole again."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    kernel()
    [path] = tmp_path.rglob(f"*.{ending}")
    good = path.read_bytes()

    def compiled(random):
        data = changed(random, good)
        path.write_bytes(data)
        assert hits(kernel()) == (data == good)

    assert tried(ending, seeds, compiled, holds) == 0
    assert hits(kernel()) == 1
