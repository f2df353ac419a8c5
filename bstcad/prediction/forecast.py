"""What a scene will take on this machine, and come to: seconds, RRMSD and memory of each quality, as intervals.

Seconds and memory follow from the work that there is to do (work.py) and what this machine takes for a unit of it
(calibration.py); RRMSD from pilots at a half and a quarter of the size or so (pilot.py).  The constants were fitted on
whole designs by tests/benchmarks/prediction_fit.py; the intervals hold nine of ten of those.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from bstcad.analysis.bottleneck import limits
from bstcad.analysis.control_cells import ControlCells
from bstcad.optics.lens import Lens
from bstcad.prediction.bounds import CONTROL_POINTS, complaint
from bstcad.prediction.calibration import Units
from bstcad.prediction.pilot import QUALITIES, Found, Pilot, pilot
from bstcad.prediction.work import amounts, memory_gb, seconds
from bstcad.scene.errors import SceneError
from bstcad.scene.quality import PRESETS
from bstcad.scene.scene import Scene

FITTED = Path(__file__).with_name("fitted.json")
GAINED = 0.43  # times the RRMSD: what 1025 control points left of the portrait's with 513, the most that was seen
Interval = tuple[float, float, float]  # low, likely, high


@dataclass(frozen=True)
class Forecast:
    """Of one design."""

    seconds: Interval  # of the whole command, on the machine of the calibration
    rrmsd: Interval
    memory_gb: Interval  # of both its processes, as a sum


@dataclass(frozen=True)
class Outlook:
    """Of a scene in each quality, and with about twice the control points a side."""

    predicted: Mapping[str, Forecast] | None  # None: the scene is out of bounds
    refused: str = ""  # why, in a sentence
    finer_net: int | None = None  # control points a side; None: so many are out of bounds
    finer: Mapping[str, Forecast] | None = None
    notes: tuple[str, ...] = ()  # sentences on what ends a design early

    def facts(self) -> dict[str, Any]:
        """The entries of `plan --json`."""
        of_finer = self.finer and {"control_points": self.finer_net, "predicted": _facts(self.finer)}
        return {
            "predicted": self.predicted and _facts(self.predicted),
            "not_predicted": self.refused or None,
            "finer": of_finer,
            "notes": list(self.notes),
        }


def _facts(predicted: Mapping[str, Forecast]) -> dict[str, Any]:
    return {
        quality: {key: [float(f"{value:.3g}") for value in ends] for key, ends in asdict(forecast).items()}
        for quality, forecast in predicted.items()
    }


@cache
def fitted() -> Mapping[str, Any]:
    """The constants of the fit."""
    return json.loads(FITTED.read_text(encoding="utf-8"))


def outlook(scene: Scene, lens: Lens, units: Callable[[], Units]) -> Outlook:
    """Of a scene; lens: a coarse one for it, from which the pilots start."""
    if refused := complaint(scene):
        return Outlook(None, refused)
    try:
        small = pilot(scene, lens)
    except SceneError as refusal:
        return Outlook(None, f"a small design of this scene is refused: {refusal}")
    unit = units()
    found = rrmsds(small)
    predicted = {q: forecast(scene, q, found[q], unit, small.found[q].doubtful) for q in QUALITIES}
    notes = tuple(_ends_early(scene, predicted))
    m = 2 * scene.lens.back.control_points - 1
    if m > CONTROL_POINTS[1]:
        return Outlook(predicted, notes=notes)
    finer = scene.changed({"lens.back.control_points": m, "tailoring.levels": None})
    less = {quality: found[quality] * _finer(found[quality], small.cells) for quality in QUALITIES}
    of_finer = {q: forecast(finer, q, less[q], unit, small.found[q].doubtful) for q in QUALITIES}
    return Outlook(predicted, "", m, of_finer, notes)


def forecast(scene: Scene, quality: str, rrmsd: float, unit: Units, other_way: bool = False) -> Forecast:
    """Of one quality, for which this RRMSD is likely; does its stage 1 try the other way?"""
    known, wanted = fitted(), of_quality(scene, quality)
    within = known["within"]
    return Forecast(
        _interval(seconds(amounts(wanted, rrmsd, other_way), known["prices"], unit), within["seconds"]),
        _interval(rrmsd, within["rrmsd"]),
        _interval(memory_gb(wanted, known["memory"]), within["memory_gb"]),
    )


def of_quality(scene: Scene, quality: str) -> Scene:
    """The scene in a quality, every knob as that has it."""
    unset = {f"tailoring.{key}": None for key in (*PRESETS[quality], "levels")}
    return scene.changed(unset | {"tailoring.quality": quality})


def _interval(likely: float, factor: float) -> Interval:
    return likely / factor, likely, likely * factor


def rrmsds(small: Pilot) -> dict[str, float]:
    """RRMSD of each quality by its pilot; none is above that of the quality below it, which does less."""
    least, by_quality = math.inf, {}
    for quality in QUALITIES:
        least = by_quality[quality] = min(least, rrmsd(small.found[quality], fitted()["rrmsd"][quality]))
    return by_quality


def rrmsd(found: Found, constants: Mapping[str, float]) -> float:
    """A part of what the pilot comes to, less the smaller it is, and a part of the detail that it does not see."""
    seen = constants["pilot"] * found.factor ** constants["power"] * found.rrmsd
    return seen + constants["detail"] * found.detail


def _finer(rrmsd: float, cells: ControlCells) -> float:
    """By what the RRMSD is multiplied by twice the control points a side, as reports of designs estimate it."""
    estimate = next(limit.rrmsd for limit in limits(rrmsd, None, None, cells) if limit.by == "control points")
    return max(estimate, GAINED)


def _ends_early(scene: Scene, predicted: Mapping[str, Forecast]) -> Iterator[str]:
    """What the scene asks for that no prediction reckons with."""
    most, enough = scene.tailoring.max_time, scene.tailoring.accuracy
    if most is not None and (late := [q for q, each in predicted.items() if each.seconds[1] > most]):
        yield f"tailoring.max_time = {most:g} would end {' and '.join(late)} before that, with more error."
    if enough is not None and (early := [q for q, each in predicted.items() if each.rrmsd[1] < enough]):
        yield f"tailoring.accuracy = {enough:g} would end {' and '.join(early)} as soon as it is reached, in less time."
