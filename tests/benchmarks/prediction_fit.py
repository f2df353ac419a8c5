"""Fits the constants of predictions (bstcad/sweep/fitted.json) to the designs on record in prediction_fit.json.

make prediction     does the designs anew, fits, and holds the predictions to scenes kept out (prediction_figure.py)
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from scipy.optimize import minimize, nnls

from bstcad.scene.scene import Scene
from bstcad.sweep.cold_run import Units
from bstcad.sweep.estimates import coarse_lens
from bstcad.sweep.plan import (
    FITTED,
    KINDS,
    QUALITIES,
    Pilot,
    amounts,
    memory_amounts,
    memory_gb,
    of_quality,
    pilots,
    rrmsd,
    seconds,
)
from tests.benchmarks.prediction_scenes import CASES

Run = Mapping[str, Any]

NINE_OF_TEN = 0.9
REWEIGHTED, LEAST = 30, 0.005  # times, until errors count by their size; smaller ones, of the whole, count as this
POWER = 1.5  # of a deviation: single designs shall not bend the fit
STAGES = {"stage 1": "stage 1", "float32 beside float64": "stage 1", "write": "write", "verify": "verify",
          "report": "report"}  # fmt: skip


def fit(runs: Sequence[Run]) -> dict[str, Any]:
    """The constants, and the factors within which they have nine of ten of the designs that they were fitted to."""
    prices, memory, found_rrmsd = _prices(runs), _memory(runs), _rrmsd(runs)
    found = {
        "seconds": [_ratio(seconds(_amounts(run), prices, Units(**run["units"])), run["seconds"]) for run in runs],
        "rrmsd": [_ratio(_likely(run, found_rrmsd[run["quality"]]), run["rrmsd"]) for run in runs],
        "memory_gb": [_ratio(memory_gb(_scene(run), memory), run["memory_gb"]) for run in runs],
    }
    within = {key: float(np.quantile(values, NINE_OF_TEN)) for key, values in found.items()}
    return {"prices": prices, "memory": memory, "rrmsd": found_rrmsd, "within": within}


def write(constants: Mapping[str, Any]) -> None:
    """Into the package."""
    FITTED.write_text(json.dumps(_rounded(constants), indent=1) + "\n", encoding="utf-8")


def _prices(runs: Sequence[Run]) -> dict[str, float]:
    """Of each kind of work in its unit: stage by stage, none below zero, by the least error relative to the whole.

    Errors count by their size and not by its square, so that designs that end early on a plateau do not bend the fit.
    """
    found: dict[str, float] = {}
    for stage in dict.fromkeys(stage for stage, _ in KINDS.values()):
        kinds = [name for name, (its, _) in KINDS.items() if its == stage]
        rows = [[_amounts(run)[k] * run["units"][KINDS[k][1]] / run["seconds"] for k in kinds] for run in runs]
        took, weight = np.array([_seconds(run, stage) / run["seconds"] for run in runs]), np.ones(len(runs))
        for _ in range(REWEIGHTED):
            solved, _ = nnls(np.array(rows) * weight[:, None], took * weight)
            weight = np.maximum(np.abs(np.array(rows) @ solved - took), LEAST) ** -0.5
        found |= dict(zip(kinds, solved.tolist(), strict=True))
    return found


def _seconds(run: Run, stage: str) -> float:
    """What a stage of a run took; the start is all that is none of the others."""
    spent: dict[str, float] = {}
    for name, taken in run["stages"]:
        of = "stage 2" if name.startswith(("stage 2", "stage 3")) else STAGES.get(name, "start")
        spent[of] = spent.get(of, 0.0) + taken
    spent["start"] += run["seconds"] - sum(spent.values())
    return spent.get(stage, 0.0)


def _memory(runs: Sequence[Run]) -> dict[str, float]:
    """GB of each amount, none below zero."""
    rows = [memory_amounts(_scene(run)) for run in runs]
    held = np.array([run["memory_gb"] for run in runs])
    solved, _ = nnls(np.array([list(row.values()) for row in rows]) / held[:, None], np.ones(len(runs)))
    return dict(zip(rows[0], solved.tolist(), strict=True))


def _rrmsd(runs: Iterable[Run]) -> dict[str, dict[str, float]]:
    """By quality: the constants that leave the least deviations of logarithms.

    A pilot as large as its design is this design: its share is 1.  Fine designs are few, and have pilots of standard
    quality: all but their share is as in standard.
    """
    found: dict[str, dict[str, float]] = {}
    for quality in QUALITIES:
        of_it = [run for run in runs if run["quality"] == quality]
        like = found.get("standard", {"pilot": 1.0, "power": -0.3, "detail": 0.1})
        free = ("pilot",) if quality == "fine" else ("power", "detail")

        def named(tried: np.ndarray, like=like, free=free) -> dict[str, float]:
            return like | {name: abs(x) if name != "power" else x for name, x in zip(free, tried.tolist(), strict=True)}

        def deviation(tried: np.ndarray, of_it=of_it, named=named) -> float:
            return sum(abs(math.log(_likely(run, named(tried)) / run["rrmsd"])) ** POWER for run in of_it)

        start = [like[name] for name in free]
        found[quality] = named(minimize(deviation, start, method="Nelder-Mead", options={"maxiter": 4000}).x)
    return found


def _likely(run: Run, constants: Mapping[str, float]) -> float:
    return rrmsd(_pilots(run["name"])[run["quality"]], constants)


def _ratio(one: float, other: float) -> float:
    """By what factor they differ, 1 or more."""
    return max(one / other, other / one)


def _amounts(run: Run) -> dict[str, float]:
    return amounts(_scene(run), _pilots(run["name"])[run["quality"]].doubtful)


@cache
def _wanted(name: str, quality: str) -> Scene:
    [case] = (case for case in CASES["fit"] if case.name == name)
    return of_quality(case.scene(quality), quality)


def _scene(run: Run) -> Scene:
    return _wanted(run["name"], run["quality"])


@cache
def _pilots(name: str) -> dict[str, Pilot]:
    scene = _wanted(name, "standard")
    return pilots(scene, coarse_lens(scene))


def _rounded(value: Any) -> Any:
    return {k: _rounded(v) for k, v in value.items()} if isinstance(value, Mapping) else float(f"{value:.4g}")
