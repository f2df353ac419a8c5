"""A tiny scene to sweep, and a machine whose runs take no time: their seconds and errors follow formulas."""

import math
from functools import cache

import pytest

from bstcad.analysis.steepness import Steepness
from bstcad.planning import tradeoff
from bstcad.planning.cold_run import DONE, FAILED, ColdRun, run_and_judge
from bstcad.planning.prediction import Pilot, PilotLight, typical_seconds
from bstcad.planning.reduction import pilot_scene, with_quality
from bstcad.runs.cluster import THIS_MACHINE, Answer
from bstcad.scene.scene import load
from tests.scenes import DISK, TINY

REFUSED = ("target.pixels", 96)  # a setting that comes to no lens
KERNEL = 0.2  # seconds of the calibration kernel
FAR = "tcp://10.0.0.1:1"  # a worker


def typical_pilot(scene, tick=lambda: None):
    """Return the small scene of `run_pilot` and its typical time, without its design."""
    small, factor = pilot_scene(with_quality(scene, "standard"))
    return Pilot(
        small,
        typical_seconds(small),
        PilotLight(0.1, half_ratio=1.5),
        early=PilotLight(0.15, half_ratio=1.6),
        factor=factor,
        detail=0.0,
        blur=0.0,
        steep=Steepness(0.0, 0.0),
    )


class Synthetic:
    """Carries out orders by formula; ends with KeyboardInterrupt after `most` runs."""

    def __init__(self, base, most=math.inf, where=THIS_MACHINE, room=1):
        self.base, self.most, self.where, self.capacity = base, most, where, room
        self.ran, self.limits, self.orders = [], [], []

    def start(self, key, work, contents, point, limit, effort):
        assert work is run_and_judge and key == point
        self.limits.append(limit)
        self.orders.append(point)

    def next(self, tick):
        if len(self.ran) >= self.most:
            raise KeyboardInterrupt
        tick()
        self.ran.append(self.orders.pop(0))
        return Answer(self.ran[-1], self.where, record(self.base, self.ran[-1]))


SCENES = {}


def record(base, point):
    """Return the result of a run with these settings."""
    if REFUSED in point:
        return ColdRun(settings=point, status=FAILED, reason="ended by SIGKILL", seconds=7.0, cost_seconds=8.0)
    SCENES[base.toml()] = base
    work, knobs = _known(point, base.toml())
    seconds = 5.0 + work
    error = 0.01 + 1 / (10 + knobs.stage2_iterations) + 0.1 * (knobs.method == "adam")
    return ColdRun(
        settings=point, status=DONE, seconds=seconds, cpu_seconds=1.5 * seconds, peak_memory_gb=1.5, rrmsd=error,
        rrmsd_half=2 * error, rrmsd_noise=error / 9, rays=10**7, rrmsd_reported=error, rrmsd_noise_reported=error / 9,
        passed=True, net=f"{error}", cost_seconds=seconds + 2, kernel_seconds=KERNEL,
        units=seconds / KERNEL, version="1", stages=({"name": "stage 1", "seconds": 1.0, "rrmsd": 0.2},),
        history=({"seconds": 1.0, "rrmsd": 0.2}, {"seconds": 2.0, "rrmsd": 0.1}) if not point else (),
        machine={"processor": "none", "cores": 2}, versions={"python": "3"},
    )  # fmt: skip


@cache
def _known(point, text):
    changed = SCENES[text].changed(dict(point))
    return typical_seconds(changed).search, changed.tailoring.resolved(33)


@pytest.fixture(scope="session", autouse=True)
def counted_once():
    """The work of a run is counted once a session, not once a sweep."""
    count, known = tradeoff.predicted_work, {}

    def predicted_work(scene, point):
        key = scene.toml(), point
        if key not in known:
            known[key] = count(scene, point)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tradeoff, "predicted_work", predicted_work)
        yield


@pytest.fixture(scope="session")
def tiny():
    """templates/disk.toml, as small as makes a lens."""
    return load(DISK, TINY)


@pytest.fixture(scope="session")
def swept(tiny, tmp_path_factory):
    """(folder, results) of a sweep by formulas that had time for everything."""
    folder = tmp_path_factory.mktemp("tradeoff") / "swept"
    return folder, tradeoff.tradeoff(tiny, folder, budget=1e6, machines=Synthetic(tiny))
