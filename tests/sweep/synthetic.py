"""A machine whose runs take no time: seconds and errors by formulas, so that the results of a sweep are known."""

import math
from functools import cache

from bstcad.runs.cluster import HERE, Answer
from bstcad.sweep import tradeoff
from bstcad.sweep.cold_run import DONE, FAILED, HistoryPoint, KeptRun, StageTime, carry_out
from bstcad.sweep.work import KINDS

REFUSED = ("target.pixels", 96)  # a setting that comes to no lens
PACE = 0.1  # seconds of a price unit
KERNEL = {"kernel_seconds": 0.2, "version": "1"}


class Synthetic:
    """Carries out orders by formula; ends with KeyboardInterrupt after `most` runs."""

    def __init__(self, base, most=math.inf, where=HERE, room=1):
        self.base, self.most, self.where, self.room = base, most, where, room
        self.ran, self.limits, self.orders = [], [], []

    def start(self, key, work, order):
        assert work is carry_out and key == order.settings
        self.limits.append(order.limit)
        self.orders.append(order)

    def next(self, tick):
        if len(self.ran) >= self.most:
            raise KeyboardInterrupt
        tick()
        self.ran.append(self.orders.pop(0).settings)
        return Answer(self.ran[-1], self.where, record(self.base, self.ran[-1]))


def record(base, point):
    """What a run with these settings comes to."""
    if REFUSED in point:
        return KeptRun(settings=point, status=FAILED, reason="ended by SIGKILL", seconds=7.0, cost_seconds=8.0)
    SCENES[base.toml()] = base
    amounts, knobs = _known(point, base.toml())
    work = dict(zip(KINDS, amounts.tolist(), strict=True))
    seconds = 5.0 + PACE * (work["evaluations"] + work["steps of Adam"] + work["net written"])
    adam, seed = work["steps of Adam"] > 0, dict(point).get("tailoring.seed", 0)
    error = 0.01 + 1 / (10 + knobs.stage2_iterations) + (0.1 + 0.01 * seed if adam else 0.0)
    stages = {"stage 1": (1.0, 0.2), "stage 2, 96² tubes": (seconds - 1, error)}
    return KeptRun(
        settings=point, status=DONE, seconds=seconds, cpu_seconds=1.5 * seconds, peak_memory_gb=1.5, rrmsd=error,
        rrmsd_noise=error / 9, rays=10**7, rrmsd_reported=error, rrmsd_noise_reported=error / 9, passed=True,
        net=f"{error} {seed * adam}", cost_seconds=seconds + 2,
        stages=tuple(StageTime(name=name, seconds=s, rrmsd=e) for name, (s, e) in stages.items()),
        history=tuple(HistoryPoint(seconds=t, rrmsd=e) for t, e in ((1.0, 0.2), (2.0, 0.1))) if not point else (),
        machine={"processor": "none", "cores": 2}, versions={"python": "3"}, **KERNEL,
    )  # fmt: skip


SCENES = {}


@cache
def _known(point, text):
    base = SCENES[text]
    return tradeoff.work_of(base, point), base.changed(dict(point)).tailoring.resolved(33)
