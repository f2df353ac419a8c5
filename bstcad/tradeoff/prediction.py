"""How long a run will take, from what is known of the work and from the runs that are done.

The cost is a sum of amounts of work, each with a price (bstcad/prediction/work.py).  The prices start from what `plan`
predicts with, and move to what the runs of this sweep took, as far as those tell them apart.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import nnls

from bstcad.prediction.forecast import fitted
from bstcad.prediction.work import KINDS, amounts
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.tradeoff.knobs import Settings
from bstcad.tradeoff.runs import Record

UNIT = 0.1  # seconds of the calibration kernel before it was measured, on two cores
SERIAL = 0.1  # of those, what the work of one processor takes, which a sweep does not measure
JUDGING = 20.0  # kernels that judging takes, on top of the start
ADAM = 1.0  # kernels a step of the paper's procedure, by 1024² rays
TRUST = 0.05  # weight of the prices as they start, beside that of a run that is done


def starting_prices() -> np.ndarray:
    """Of each of KINDS, in evaluations of the calibration kernel."""
    known = fitted()["prices"]
    prices = {name: known[name] * (1.0 if kind.unit == "tubes" else SERIAL) for name, kind in KINDS.items()}
    return np.array(list((prices | {"start": prices["start"] + JUDGING, "steps of Adam": ADAM}).values()))


def _steps(prices: np.ndarray) -> np.ndarray:
    """By how much each price may easily move: itself; of one that starts at 0, as much as its stage's others cost."""
    stages = np.array([kind.stage for kind in KINDS.values()])
    known = prices > 0
    found = prices.copy()
    for k in np.flatnonzero(~known):
        beside = known & (stages == stages[k])
        found[k] = np.median(prices[beside if beside.any() else known])
    return found


class Prediction:
    """Of the runs of one scene."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._known: dict[Settings, np.ndarray] = {}
        self._prices = starting_prices() * UNIT  # seconds, as far as is known

    def learn(self, done: Sequence[Record]) -> None:
        """Fit the prices to all runs so far."""
        runs = [record for record in done if record.done]
        if not runs:
            return
        unit = float(np.median([record.kernel_seconds or UNIT for record in runs]))
        prices = starting_prices()
        took = np.array([record.cost_seconds for record in runs])
        work = np.array([self._amounts(record.settings) for record in runs]) * unit / took[:, None]
        pace = float(np.median(1 / (work @ prices)))  # of this machine, or of a quicker program
        steps = _steps(prices)
        held = np.sqrt(TRUST) * np.eye(len(prices))
        wanted = np.concatenate([np.ones(len(runs)), held @ (prices / steps)])
        found, _ = nnls(np.vstack([work * pace * steps, held]), wanted)
        self._prices = unit * pace * steps * found

    def seconds(self, point: Settings) -> float:
        """Seconds of the budget that a run will take."""
        return float(self._amounts(point) @ self._prices)

    def _amounts(self, point: Settings) -> np.ndarray:
        if point not in self._known:
            self._known[point] = work_of(self._scene, point)
        return self._known[point]


def work_of(scene: Scene, point: Settings) -> np.ndarray:
    """How much of each of KINDS a run has to do; of one that is refused only the start."""
    try:
        found = amounts(scene.changed(dict(point)))
    except SceneError:
        found = {"start": 1.0}
    return np.array([found.get(name, 0.0) for name in KINDS])
