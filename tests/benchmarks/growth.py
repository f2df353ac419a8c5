"""The growth of each stage's cost: CPU seconds and memory while one quantity grows and all others stay.

CPU seconds are of all threads.  What a design leaves to a second process, writing and reading STEP, is done in this
one.  Memory is the most that was held on the way over what was held before; where the system does not tell, there is
none.  Nets grow up to the largest that a scene may have.

One lens serves all: a small design of the peers' case, carried over to finer nets, so that its picture fills the
screen whatever grows.  What the algorithms say of each stage stands in accuracy.md.j2.
"""

from __future__ import annotations

import ctypes
import gc
import math
import re
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from skimage.data import astronaut

from bstcad.cad import mesh as meshes
from bstcad.cad import step_reading, step_writing
from bstcad.designs.designed_lens import DesignedLens
from bstcad.designs.folder import write_geometry
from bstcad.designs.pipeline import design
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel
from bstcad.optics.surfaces.sampling import grid
from bstcad.optics.trace.measure import Effort
from bstcad.optics.trace.tubes import launch_tubes
from bstcad.scene.scene import Scene, load
from bstcad.step_text import part21
from bstcad.tailoring.merit import Merit, SobolevVariable, local_weight
from bstcad.tailoring.slope_fit import Fit, fit_slopes
from bstcad.tailoring.stage2 import Problem
from bstcad.transport import Density, solve
from bstcad.verify import checks
from bstcad.verify.nominal import Nominal
from tests.benchmarks.cold import TEMPLATES

TEMPLATE = TEMPLATES / "caustic_portrait.toml"
EVALUATION = "evaluation of stage 2"
SMALL = {"lens.back.control_points": 65, "target.pixels": 256, "tailoring.quality": "draft"}
NET, TUBES, PIXELS = 257, 1024, 512  # a side, of what does not grow
A_CHANNEL = 256  # tubes a side, of each of many channels
PROOF = Effort(1024)  # effort of a proof while nets and pixels grow: always the same number of tubes
REPEATS, ENOUGH = 5, 1.0  # calls of which the least counts, or as many as take so many CPU seconds
# Files of Linux: memory of the process, and the reset of its peak.
STATUS, FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
Work = Callable[[], Any]


@dataclass(frozen=True)
class Series:
    """A stage while one thing grows."""

    stage: str
    driver: str  # name of the quantity that grows
    sizes: tuple[int, ...]
    work: Callable[[int], Work]  # sets up the work of a size
    expected: tuple[float, float]  # between which the exponent of CPU seconds over its range is to lie
    most: float  # largest ratio of CPU seconds of the last step, over the ratio of the quantity
    power: int = 2  # exponent by which the size gives the number: sizes to this power


@dataclass(frozen=True)
class Cost:
    """CPU seconds and memory of one size."""

    number: int  # number of the things that grow
    cpu_seconds: float
    memory_mb: float | None  # over what was held before; None: the system does not tell


def exponent(costs: Sequence[Cost], of: str = "cpu_seconds") -> float | None:
    """a of cost ~ number^a, by least squares through the logarithms; None where a cost is not known, or zero."""
    found = [getattr(cost, of) for cost in costs]
    if not all(value and value > 0 for value in found):
        return None
    return float(np.polyfit(np.log([cost.number for cost in costs]), np.log(found), 1)[0])


def last_step(costs: Sequence[Cost]) -> float:
    """Return the ratio of the last two sizes' costs, over the ratio of their numbers."""
    before, after = costs[-2:]
    return after.cpu_seconds / before.cpu_seconds / (after.number / before.number)


def measured(series: Series) -> tuple[Cost, ...]:
    """The cost of each size; the first calls of all are one whose cost does not count, since they compile."""
    series.work(series.sizes[0])()
    costs = []
    for size in series.sizes:
        work, spent = series.work(size), []
        memory = held(lambda work=work, spent=spent: spent.append(cpu(work)))
        while len(spent) < REPEATS and sum(spent) < ENOUGH:
            spent.append(cpu(work))
        costs.append(Cost(size**series.power, min(spent), memory))
        said = "" if memory is None else f", {memory:.0f} MB"
        print(f"{series.stage}, {series.driver} {size}: {1e3 * costs[-1].cpu_seconds:.0f} ms{said}", flush=True)
    return tuple(costs)


def cpu(work: Work) -> float:
    """CPU seconds of a call, those of all threads."""
    before = time.process_time()
    work()
    return time.process_time() - before


def held(work: Work) -> float | None:
    """The most memory (MB) that a call holds over what was held before; None: the system does not tell."""
    if not (sys.platform == "linux" and FORGET.exists()):
        work()
        return None
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    FORGET.write_text("5")
    before = _status("VmRSS")
    work()
    return _status("VmHWM") - before


def _status(entry: str) -> float:
    """An entry of this process's status, in MB."""
    return int(re.search(rf"{entry}:\s+(\d+) kB", STATUS.read_text())[1]) / 1e3


@cache
def _design() -> tuple[Scene, Lens]:
    scene = load(TEMPLATE, SMALL)
    return scene, design(scene).lens


def lens_of(m: int) -> Lens:
    """Return the same lens on m x m control points."""
    lens = _design()[1]
    return lens.with_back(lens.back.refined(m))


def _scene(m: int, pixels: int) -> Scene:
    return _design()[0].changed({"lens.back.control_points": m, "target.pixels": pixels})


def _transport(n: int) -> Work:
    disc = Density.from_function(lambda x, y: 1.0 * ((x - 0.5) ** 2 + (y - 0.5) ** 2 < 0.25), n)
    return partial(solve, disc, Density.from_picture(astronaut().mean(axis=2), n, floor=1e-2))


def _slope_fit(m: int) -> Work:
    flat = _design()[1].back.refined(m)
    x, y = (p.reshape(-1) for p in grid(_design()[1].outline, 2 * m))
    _, z_x, z_y = flat.relative_sag_and_slope(x, y)
    start = replace(flat, heights=torch.zeros_like(flat.heights))
    return partial(fit_slopes, start, x, y, z_x, z_y, torch.ones_like(x), Fit(steps=10))


def _start(m: int) -> Work:
    """A round of stage 2 begins: two tubes launched a control point each way, and the local weight of its variable."""
    scene, lens = _scene(m, PIXELS), lens_of(m)
    (light,) = scene.channels()

    def begin() -> None:
        launch_tubes(light.source, light.through(lens), 2 * m)
        local_weight(light.source, light.through(lens), scene.goals)

    return begin


def _evaluation(m: int = NET, n: int = TUBES, pixels: int = PIXELS, lines: int = 1) -> Work:
    """An evaluation of stage 2: corners traced, tubes cut at pixel borders, the adjoint of both, and the variable."""
    scene, lens = _scene(m, pixels), lens_of(m)
    (light,) = scene.channels()
    spread = (light.index + 1e-4 * (k - (lines - 1) / 2) for k in range(lines))
    channels = tuple(Channel(light.source, index, 1 / lines) for index in spread)
    problem = Problem(lens, Merit.of(channels, lens, n, scene.goals, 0.03))
    variable = SobolevVariable.of(lens.back, torch.ones_like(lens.back.heights))
    c = torch.zeros_like(lens.back.heights)
    return lambda: variable.adjoint(problem([lens.back.heights + variable.heights(c)])[1][0])


def _made(m: int, pixels: int = PIXELS) -> DesignedLens:
    scene = _scene(m, pixels)
    return DesignedLens(scene, lens_of(m), scene.goals)


def _in_a_folder(work: Callable[[Path], Any]) -> None:
    with tempfile.TemporaryDirectory() as place:
        work(Path(place))


def _writing(m: int) -> Work:
    lens = lens_of(m)
    return partial(_in_a_folder, lambda place: step_writing.write_lens(lens, place / "lens.step", "lens"))


def _mesh(m: int) -> Work:
    made = _made(m)

    def write(place: Path) -> None:
        _, mesh = meshes.fit_mesh(made.lens, made.scene.mesh_tolerance)
        meshes.write_stl(mesh, place / "lens.stl")
        meshes.write_3mf(mesh, place / "lens.3mf")

    return partial(_in_a_folder, write)


@cache
def _written(m: int) -> tempfile.TemporaryDirectory:
    place = tempfile.TemporaryDirectory()
    write_geometry(_made(m), Path(place.name))
    return place


def _reading(read: Callable[[Path], Any], m: int) -> Work:
    return partial(read, Path(_written(m).name) / "lens.step")


def _proof(m: int = NET, pixels: int = PIXELS) -> Work:
    made = _made(m, pixels)
    place = _written(m)
    wanted = Nominal(made.scene, made.lens, made.goals)
    return partial(checks.verify, Path(place.name), wanted, effort=PROOF)


NETS, PICTURES = (257, 513, 1025, 2049), (64, 128, 256, 512, 1024)
SERIES = (
    Series("transport", "cells", PICTURES, _transport, (0.7, 1.15), 1.5),
    Series("slope fit", "control points", NETS, _slope_fit, (0.75, 1.3), 2.5),
    Series(EVALUATION, "flux tubes", (128, 256, 512, 1024, 2048), lambda n: _evaluation(n=n), (0.55, 1.1), 1.5),
    Series(EVALUATION, "control points", NETS, lambda m: _evaluation(m=m), (0.1, 0.6), 1.2),
    Series(EVALUATION, "pixels", PICTURES, lambda p: _evaluation(pixels=p), (0.0, 0.4), 0.8),
    Series(
        EVALUATION, "channels", (1, 2, 4, 8, 16, 32, 64), lambda k: _evaluation(n=A_CHANNEL, lines=k), (0.75, 1.1), 1.4,
        power=1,
    ),
    Series(EVALUATION, "control points and tubes", NETS, lambda m: _evaluation(m=m, n=2 * m), (0.7, 1.1), 1.4),
    Series("start of a round", "control points and tubes", NETS, _start, (0.7, 1.25), 1.4),
    Series("writing STEP", "control points", NETS, _writing, (0.5, 1.05), 1.2),
    Series("mesh", "control points", NETS, _mesh, (-0.1, 0.9), 1.2),
    Series("reading STEP by OCC", "control points", NETS, partial(_reading, step_reading.read), (0.6, 1.1), 1.3),
    Series("reading STEP as text", "control points", NETS, partial(_reading, part21.read_lens), (0.6, 1.2), 1.3),
    Series("proof", "control points", NETS, _proof, (0.1, 0.9), 1.2),
    Series("proof", "pixels", PICTURES, lambda p: _proof(pixels=p), (-0.05, 0.35), 0.8),
)  # fmt: skip


def facts(series: Series, costs: Sequence[Cost]) -> Mapping[str, Any]:
    """Return the facts of a series for a table of docs/accuracy.json."""
    return {
        "stage": series.stage, "driver": series.driver, "sizes": list(series.sizes), "power": series.power,
        "cpu_seconds": [cost.cpu_seconds for cost in costs], "memory_mb": [cost.memory_mb for cost in costs],
        "exponent": exponent(costs),
        "last_exponent": 1 + math.log(last_step(costs)) / math.log(costs[-1].number / costs[-2].number),
        "memory_exponent": exponent(costs, "memory_mb"),
    }  # fmt: skip
