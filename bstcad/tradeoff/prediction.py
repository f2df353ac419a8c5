"""How long a run will take, from what is known of the work and from the runs that are done.

The cost is a sum of amounts of work, each with a price.  The prices start from what they were on one machine, in units
of the calibration kernel, and move to what the runs of this sweep took, as far as those tell them apart.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import nnls

from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.tailoring.stage2 import sheets
from bstcad.tradeoff.calibration import TUBES
from bstcad.tradeoff.knobs import Settings
from bstcad.tradeoff.runs import Record

PRICES = {  # in evaluations of the calibration kernel
    "start": 110.0,  # imports, picture, OCC, pictures of the report, judging
    "evaluations": 1.0,  # of stage 2, by 1024² tubes each
    "net": 110.0,  # 513² control points: slope fit, writing, proof
    "pixels": 40.0,  # 512²
    "transport": 20.0,  # 40 iterations on 256² cells
    "adam": 1.0,  # steps, by 1024² rays each
}
UNIT = 0.1  # seconds of the calibration kernel before it was measured, on two cores
TRUST = 0.05  # weight of the prices as they start, beside that of a run that is done


class Prediction:
    """Of the runs of one scene."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._known: dict[Settings, np.ndarray] = {}
        self._prices = np.array(list(PRICES.values())) * UNIT  # seconds, as far as is known

    def learn(self, done: Sequence[Record]) -> None:
        """Fit the prices to all runs so far."""
        runs = [record for record in done if record.done]
        if not runs:
            return
        unit = float(np.median([record.kernel_seconds or UNIT for record in runs]))
        start = np.array(list(PRICES.values())) * unit
        took = np.array([record.cost_seconds for record in runs])
        work = np.array([self._amounts(record.settings) for record in runs]) * start / took[:, None]
        pace = float(np.median(1 / work.sum(1)))  # of this machine, or of a quicker program
        held = np.sqrt(TRUST) * np.eye(len(start))
        factors, _ = nnls(np.vstack([work * pace, held]), np.concatenate([np.ones(len(runs)), held.sum(1)]))
        self._prices = start * pace * factors

    def seconds(self, point: Settings) -> float:
        """Seconds of the budget that a run will take."""
        return float(self._amounts(point) @ self._prices)

    def _amounts(self, point: Settings) -> np.ndarray:
        if point not in self._known:
            self._known[point] = amounts(self._scene, point)
        return self._known[point]


def amounts(scene: Scene, point: Settings) -> np.ndarray:
    """How much of each of PRICES a run has to do; of one that is refused only the start."""
    try:
        wanted = scene.changed(dict(point))
    except SceneError:
        return np.array([1.0, *[0.0] * (len(PRICES) - 1)])
    m, (columns, rows) = wanted.lens.back.control_points, wanted.target.columns_rows
    knobs = wanted.tailoring.resolved(m)
    spread = len(wanted.channels()) ** 0.5
    adam = knobs.method == "adam"
    steps = knobs.stage1_iterations * len(knobs.levels) + knobs.stage2_iterations
    return np.array(
        [
            1.0,
            0.0 if adam else spread * sum((tubes / TUBES) ** 2 * evaluations for tubes, evaluations in sheets(knobs)),
            (m / 513) ** 2,
            columns * rows / 512**2,
            (knobs.transport_grid / 256) ** 2 * knobs.transport_iterations / 40,
            steps * spread * (knobs.rays / TUBES) ** 2 if adam else 0.0,
        ]
    )
