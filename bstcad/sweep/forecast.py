"""Seconds, RRMSD and memory of a design in each quality on this machine, predicted as intervals.

Seconds and memory follow from the amounts of work and the units of this machine (work.py); RRMSD from pilots, designs
of a half and a quarter of the size or so (pilot.py).  tests/benchmarks/prediction_fit.py fitted the constants on whole
designs; the intervals hold nine of ten of those.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from bstcad.analysis.cost import ControlCells, limits
from bstcad.optics.lens import Lens
from bstcad.scene.errors import SceneError
from bstcad.scene.quality import PRESETS, Tailoring
from bstcad.scene.scene import Scene
from bstcad.sweep.pilot import QUALITIES, Flight, Pilot, pilot
from bstcad.sweep.work import Units, amounts, memory_gb, seconds

FITTED = Path(__file__).with_name("fitted.json")
CONTROL_POINTS, PIXELS = (65, 1025), (128, 512)  # a side, of the fit; pixels: of the longer side
ASPECT = 2.0  # of the target, or its inverse
ENDS = {"quality", "seed", "accuracy", "max_time", "source_points"}  # keys of [tailoring] that set no amount of work
GAINED = 0.43  # times the RRMSD: with 1025 control points instead of 513, for the portrait, the largest gain of the fit
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

    predicted: Mapping[str, Forecast] | None  # None: the scene lies outside of the fit
    refused: str = ""  # why, in a sentence
    finer_net: int | None = None  # control points a side; None: so many lie outside of the fit
    finer: Mapping[str, Forecast] | None = None
    notes: tuple[str, ...] = ()  # sentences on limits that end a design early

    def facts(self) -> dict[str, Any]:
        """The entries of `plan --json`."""
        return {
            "predicted": self.predicted and _facts(self.predicted),
            "not_predicted": self.refused or None,
            "finer": self.finer and {"control_points": self.finer_net, "predicted": _facts(self.finer)},
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


def complaint(scene: Scene) -> str:
    """Why no figures are predicted for a scene, in a sentence; "" if they are."""
    reasons = (f"{sample}, and {here}" for outside, sample, here in _bounds(scene) if outside)
    return next((f"predictions were fitted on {reason}" for reason in reasons), "")


def _bounds(scene: Scene) -> Iterator[tuple[Any, str, str]]:
    """(does the scene lie outside of the fit?, the scenes of the fit, this scene)"""
    m, (columns, rows), front = scene.lens.back.control_points, scene.target.columns_rows, scene.lens.front.kind
    integrated = scene.tailoring.method == "integration"
    yield integrated, "tailored lenses", 'tailoring.method = "integration" tailors none'
    yield scene.lens.back.reflect, "lenses", "lens.back.reflect = true makes a mirror"
    yield scene.source.extent is not None, "points and parallel light", "the source has a size"
    yield len(scene.source.lines) > 1, "one wavelength", "source.wavelength has several"
    tilted = scene.source.tilt or scene.target.tilt
    yield tilted, "sources and targets that look along the axis", "here one is tilted"
    yield front not in ("plane", "sphere"), "plane and spherical fronts", f'lens.front.kind = "{front}"'
    keys = " and ".join(f"lens.{key}" for key in scene.lens.bounded_by)
    yield scene.lens.bounds is not None, "backs of any shape", f"the scene bounds it by {keys}"
    kinds = " and ".join(effect.kind for effect in scene.effects)
    yield kinds, "designs without effects", f"the scene asks for {kinds}"
    for key, value, (least, most) in (
        ("lens.back.control_points", m, CONTROL_POINTS),
        ("target.pixels", max(columns, rows), PIXELS),
    ):
        yield not least <= value <= most, f"{key} from {least} to {most}", f"here there are {value}"
    oblong = not 1 / ASPECT <= columns / rows <= ASPECT
    yield oblong, "targets of nearly equal sides", f"this one has {columns} x {rows} pixels"
    preset = Tailoring(quality=scene.tailoring.quality).resolved(m)
    for key, value in sorted(scene.tailoring.model_dump(exclude=ENDS, exclude_none=True).items()):
        yield value != getattr(preset, key), "the qualities as they are", f"tailoring.{key} is set"


def outlook(scene: Scene, lens: Lens, units: Callable[[], Units]) -> Outlook:
    """Of a scene; lens: a coarse one for it, from which the pilots start."""
    if refused := complaint(scene):
        return Outlook(None, refused)
    try:
        small = pilot(scene, lens)
    except SceneError as refusal:
        return Outlook(None, f"a small design of this scene is refused: {refusal}")
    unit, likely = units(), rrmsds(small)

    def each(scene: Scene, times: Callable[[float], float] = lambda rrmsd: 1.0) -> dict[str, Forecast]:
        values = {quality: times(likely[quality]) * likely[quality] for quality in QUALITIES}
        return {q: forecast(scene, q, values[q], unit, small.flights[q].doubtful) for q in QUALITIES}

    predicted = each(scene)
    notes = tuple(_ends_early(scene, predicted))
    m = 2 * scene.lens.back.control_points - 1
    if m > CONTROL_POINTS[1]:
        return Outlook(predicted, notes=notes)
    finer = scene.changed({"lens.back.control_points": m, "tailoring.levels": None})
    of_finer = each(finer, lambda rrmsd: _with_finer_net(rrmsd, small.cells))
    return Outlook(predicted, finer_net=m, finer=of_finer, notes=notes)


def forecast(scene: Scene, quality: str, rrmsd: float, unit: Units, other_way: bool = False) -> Forecast:
    """Of a quality whose RRMSD is likely to be this; other_way: does its stage 1 try the other way?"""
    known, wanted = fitted(), of_quality(scene, quality)
    likely = {
        "seconds": seconds(amounts(wanted, rrmsd, other_way), known["prices"], unit),
        "rrmsd": rrmsd,
        "memory_gb": memory_gb(wanted, known["memory"]),
    }
    within = known["within"]
    return Forecast(**{key: (value / within[key], value, value * within[key]) for key, value in likely.items()})


def of_quality(scene: Scene, quality: str) -> Scene:
    """The scene in a quality, every knob as the preset has it."""
    unset = {f"tailoring.{key}": None for key in (*PRESETS[quality], "levels")}
    return scene.changed(unset | {"tailoring.quality": quality})


def rrmsds(small: Pilot) -> dict[str, float]:
    """RRMSD of each quality by its pilot; none is above that of the quality below it, which does less."""
    least, by_quality = math.inf, {}
    for quality in QUALITIES:
        least = by_quality[quality] = min(least, rrmsd(small.flights[quality], fitted()["rrmsd"][quality]))
    return by_quality


def rrmsd(flight: Flight, constants: Mapping[str, float]) -> float:
    """A share of the pilot's RRMSD, less the smaller the pilot, and a share of the detail that it does not see."""
    seen = constants["pilot"] * flight.factor ** constants["power"] * flight.rrmsd
    return seen + constants["detail"] * flight.detail


def _with_finer_net(rrmsd: float, cells: ControlCells) -> float:
    """RRMSD with twice the control points a side over this RRMSD, as reports of designs estimate it."""
    estimate = next(limit.rrmsd for limit in limits(rrmsd, cells) if limit.by == "control points")
    return max(estimate, GAINED)


def _ends_early(scene: Scene, predicted: Mapping[str, Forecast]) -> Iterator[str]:
    """Limits of the scene that no prediction reckons with."""
    most, enough = scene.tailoring.max_time, scene.tailoring.accuracy
    if most is not None and (late := [q for q, each in predicted.items() if each.seconds[1] > most]):
        yield f"tailoring.max_time = {most:g} would end {' and '.join(late)} before that, with more error."
    if enough is not None and (early := [q for q, each in predicted.items() if each.rrmsd[1] < enough]):
        yield f"tailoring.accuracy = {enough:g} would end {' and '.join(early)} as soon as it is reached, in less time."
