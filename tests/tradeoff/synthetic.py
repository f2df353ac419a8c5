"""A machine whose runs take no time: seconds and errors by formulas, so that what a sweep makes of them is known."""

import math
from dataclasses import replace
from functools import cache

from bstcad.prediction.work import KINDS
from bstcad.tradeoff import prediction
from bstcad.tradeoff.runs import DONE, FAILED, HERE, Judged, Order, Record, Searched, scene_files

REFUSED = ("target.pixels", 96)  # a setting that comes to no lens
PACE = 0.1  # seconds of a price unit
SEARCHES = (
    Searched("Sobolev", 33, 66, None, 0.5, (0.5, 0.2, 0.1, 0.05)),
    Searched("control points", 33, 66, 1e-4, 0.5, (0.5, 0.5, 0.4, 0.3)),
    Searched("control points", 33, 66, 1e-5, 0.5, (0.5, 0.4, 0.3, 0.2)),
)


class Synthetic:
    """Carries out orders by formula; ends with KeyboardInterrupt after `most` runs."""

    room = 1

    def __init__(self, base, most=math.inf, where=HERE):
        self.base, self.most, self.where, self.ran, self.prepared = base, most, where, [], 0

    def prepare(self, scene_of, tick):
        assert scene_of == scene_files(self.base)
        self.prepared += 1

    def start(self, order):
        assert isinstance(order, Order)
        self.order = order

    def next(self, tick):
        if len(self.ran) >= self.most:
            raise KeyboardInterrupt
        tick()
        self.ran.append(self.order.settings)
        return record(self.base, self.order.settings, self.where)


def record(base, point, where=HERE):
    """What a run with these settings comes to."""
    return replace(_record(base, point), where=where)


@cache
def _known(point, text):
    base = SCENES[text]
    return prediction.work_of(base, point), base.changed(dict(point)).tailoring.resolved(33)


SCENES = {}


def _record(base, point):
    if REFUSED in point:
        return Record(point, FAILED, "ended by SIGKILL", seconds=7.0, cost_seconds=8.0)
    SCENES[base.toml()] = base
    amounts, knobs = _known(point, base.toml())
    work = dict(zip(KINDS, amounts.tolist(), strict=True))
    seconds = 5.0 + PACE * (work["evaluations"] + work["steps of Adam"] + work["net written"])
    adam, seed = work["steps of Adam"] > 0, dict(point).get("tailoring.seed", 0)
    error = 0.01 + 1 / (10 + knobs.stage2_iterations) + (0.1 + 0.01 * seed if adam else 0.0)
    return Record(
        point, DONE, seconds=seconds, cpu_seconds=1.5 * seconds, peak_memory_gb=1.5, rrmsd=error, rrmsd_noise=error / 9,
        rays=10**7, rrmsd_reported=error, rrmsd_noise_reported=error / 9, passed=True,
        net=f"{error} {seed * adam}", stages=(("stage 1", 1.0, 0.2), ("stage 2, 96² tubes", seconds - 1, error)),
        history=((1.0, 0.2), (2.0, 0.1)) if not point else (), kernel_seconds=0.2, cost_seconds=seconds + 2,
        judges=(Judged("tubes", 515, 0.1, 0.01), Judged("rays", 512, 0.05, 0.05)) if not point else (),
        searches=SEARCHES if not point else (),
        machine={"processor": "none", "cores": 2}, versions={"python": "3"}, version="1",
    )  # fmt: skip
