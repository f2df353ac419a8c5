"""What a sweep comes to: its front, its knobs, and two ways beside one another, in figures and in words."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from bstcad.prediction.calibration import TUBES
from bstcad.report.units import number
from bstcad.tradeoff import agenda, pareto
from bstcad.tradeoff.knobs import Settings
from bstcad.tradeoff.pareto import Turned
from bstcad.tradeoff.runs import NO_PICTURE, REFERENCE, Judged, Record
from bstcad.tradeoff.sweep import Sweep


@dataclass(frozen=True)
class Findings:
    """Of one sweep."""

    sweep: Sweep

    @cached_property
    def compared(self) -> dict[Settings, Record]:
        """The runs whose seconds compare."""
        return {record.settings: record for record in pareto.comparable(self.sweep.records.values())}

    @cached_property
    def lenses(self) -> dict[Settings, Record]:
        """The runs that came to a lens, wherever they took place: their errors compare."""
        return {record.settings: record for record in self.sweep.records.values() if record.done}

    @cached_property
    def errors_alone(self) -> bool:
        """Did every lens come about on another machine, so that no seconds compare?"""
        return bool(self.lenses) and not self.compared

    @cached_property
    def shown(self) -> dict[Settings, Record]:
        """The runs that figure and tables are of."""
        return self.lenses if self.errors_alone else self.compared

    @cached_property
    def failed(self) -> list[Record]:
        """The runs without a lens."""
        return [record for record in self.sweep.records.values() if not record.done]

    @cached_property
    def base(self) -> Record | None:
        """The run of the scene as it stands; None: it was not run, or failed."""
        return self.shown.get(())

    @cached_property
    def front(self) -> list[Record]:
        """The runs that none beats."""
        return pareto.front(self.sweep.records.values())

    @cached_property
    def front_halving(self) -> float | None:
        """What halving the error costs along the front."""
        return pareto.along(self.front)

    @cached_property
    def turned(self) -> list[Turned]:
        """Each knob."""
        look = pareto.by_error if self.errors_alone else pareto.turned
        return [look(knob, self.shown, agenda.seeds(self.sweep.scene)) for knob in self.sweep.knobs]

    @cached_property
    def presets(self) -> dict[str, Record]:
        """The presets that were run, by name."""
        quality = next(knob for knob in self.sweep.knobs if knob.key == "quality")
        found = {point.label: self.shown.get(point.settings) for point in quality.points}
        return {name: record for name, record in found.items() if record is not None}

    @cached_property
    def labels(self) -> dict[Settings, str]:
        """Each run's place in words: "Ray tubes a side 768"."""
        found: dict[Settings, str] = {(): f"{self.sweep.scene.tailoring.quality} (the scene as it stands)"}
        for knob in self.sweep.knobs:
            for point in knob.points:
                name = point.label if knob.key == "quality" else f"{knob.title}: {point.label}"
                found.setdefault(point.settings, name)
                for seed in agenda.seeds(self.sweep.scene):
                    found.setdefault(agenda.with_seed(point.settings, seed), f"{name}, seed {seed}")
        return found

    def knobs_of(self, point: Settings) -> list[str]:
        """Keys of the knobs that a run is a place of; of the base, which is one of all, just that."""
        without = tuple(entry for entry in point if entry[0] != "tailoring.seed")
        if not without:
            return ["base"]
        return [knob.key for knob in self.sweep.knobs if any(p.settings == without for p in knob.points)]

    @property
    def judges(self) -> tuple[Judged, ...]:
        """Tubes and rays as judges."""
        return self.base.judges if self.base and not self.errors_alone else ()

    @property
    def history(self) -> tuple[tuple[float, float], ...]:
        """Convergence of the base's run."""
        return self.base.history if self.base and not self.errors_alone else ()

    @cached_property
    def _any(self) -> Record | None:
        return self.base or next(iter(self.shown.values()), None)

    @property
    def version(self) -> str:
        """Of the program."""
        return next((record.version for record in self.sweep.records.values()), "")

    @property
    def machine(self) -> Mapping[str, Any]:
        """On which the runs took place; of several that of the base."""
        return self._any.machine if self._any else {}

    @property
    def versions(self) -> Mapping[str, str]:
        """Of Python and the libraries."""
        return self._any.versions if self._any else {}

    @property
    def reference_rays(self) -> list[int]:
        """That the judge took for each run, the least first."""
        return sorted({record.rays for record in self.sweep.records.values() if record.rays})

    @property
    def reference(self) -> str:
        """The judge, in words."""
        columns, rows = self.sweep.scene.target.columns_rows
        return (
            f"stratified rays that tailoring never saw, in independent sets, until the standard error is below "
            f"{REFERENCE.accuracy:.2%} of the RRMSD; {columns} x {rows} pixels; the lens as read back from its folder"
        )

    @cached_property
    def calibration(self) -> dict[str, Any]:
        """What the kernel took during the sweep."""
        seconds = [record.kernel_seconds for record in self.compared.values() if record.kernel_seconds]
        return {
            "seconds": statistics.median(seconds) if seconds else None,
            "lowest": min(seconds, default=None),
            "highest": max(seconds, default=None),
            "what": f"merit and gradient of {TUBES}² ray tubes through a fixed lens of 257² control points, 512² "
            "pixels; the least of three, in the process of the sweep, before each run",
        }

    @cached_property
    def comparisons(self) -> list[dict[str, Any]]:
        """Two ways each: name, what (in words), short (for the figure), factors; in seconds only if these compare."""
        if self.errors_alone:
            return [*self._variables()]
        return [*self._precision(), *self._variables(), *self._adam(), *self._judging()]

    def _precision(self) -> Iterator[dict[str, Any]]:
        turned = next((t for t in self.turned if t.knob.key == "precision"), None)
        if turned is None or len(turned.places) != 2:
            return
        single, double = turned.places
        time, error = double.seconds / single.seconds, double.rrmsd / single.rrmsd
        yield {
            "name": "float64 against float32",
            "time_factor": time,
            "rrmsd_factor": error,
            "short": f"float64 for float32: time × {time:.2f}, error × {error:.3g}",
            "what": f"float64 takes × {time:.2f} of float32's time and ends at × {error:.3g} of its RRMSD "
            f"({double.rrmsd:.4f} and {single.rrmsd:.4f})",
        }

    def _variables(self) -> Iterator[dict[str, Any]]:
        searches = [each for each in (self.base.searches if self.base else ()) if math.isfinite(each.rrmsd[-1])]
        ours = next((each for each in searches if each.rate is None), None)
        adam = min((each for each in searches if each.rate is not None), key=lambda s: s.rrmsd[-1], default=None)
        if ours is None or adam is None:
            return
        reached, count = adam.rrmsd[-1], len(adam.rrmsd)
        error = reached / ours.rrmsd[-1]
        entry = {"name": "Adam on control points against the Sobolev variable", "rrmsd_factor": error}
        said = (
            f"from the lens of stage 1 ({adam.start:.4f}), by the same {adam.tubes}² tubes on {adam.control_points}² "
            f"control points, Adam on these comes to {reached:.4f} in {count} evaluations (at the best of its rates, "
            f"{number(adam.rate)} mm), L-BFGS in the Sobolev variable to {ours.rrmsd[-1]:.4f}, {error:.2g} times less"
        )
        brief = f"error × {error:.2g}"
        early = next((k for k, rrmsd in enumerate(ours.rrmsd, 1) if rrmsd <= reached), None)
        if early is not None and reached < adam.start:
            entry["evaluations_factor"] = count / early
            said += f"; where Adam ends it is after {early}, {count / early:.2g} times fewer"
            brief += f" or evaluations × {count / early:.2g}"
        yield entry | {"short": f"Adam on control points for the Sobolev variable: {brief}", "what": said}

    def _adam(self) -> Iterator[dict[str, Any]]:
        turned = next((t for t in self.turned if t.knob.key == "adam"), None)
        if turned is None or not turned.places:
            return
        best = min(turned.places, key=lambda place: place.rrmsd)
        entry = {"name": "Sobolev variable and tubes against Adam on control points and rays"}
        said = f"Adam on control points, by rays, comes to {best.rrmsd:.4f} in {best.seconds:.0f} s"
        if best.rrmsd >= NO_PICTURE:
            short = f"Adam by rays, {best.label} steps: no better than no picture"
            none = f"{said} ({best.label} steps), no better than no picture at all: in this budget there is no factor"
            yield entry | {"short": short, "what": none}
            return
        ours = [r for r in self.front if agenda.method_of(self.sweep.scene, r.settings) != "adam"]
        brief = []
        quickest = pareto.time_for(ours, best.rrmsd)
        slower = [record for record in ours if record.seconds <= best.seconds]
        if quickest is not None:
            entry["time_factor"] = best.seconds / quickest
            brief.append(f"{'at least ' * (ours[0].rrmsd <= best.rrmsd)}time × {entry['time_factor']:.2g}")
            reached = "" if ours[0].rrmsd > best.rrmsd else " at most: its quickest run is better than that"
            said += f"; L-BFGS in the Sobolev variable, by tubes, is there in {quickest:.0f} s{reached}, "
            said += f"{best.seconds / quickest:.1f} times sooner"
        if slower:
            entry["rrmsd_factor"] = best.rrmsd / slower[-1].rrmsd
            brief.append(f"error × {entry['rrmsd_factor']:.2g}")
            said += f"; within Adam's time it comes to {slower[-1].rrmsd:.4f}, {entry['rrmsd_factor']:.1f} times less"
        yield entry | {"short": f"Adam by rays for L-BFGS by tubes: {' or '.join(brief)}", "what": said}

    def _judging(self) -> Iterator[dict[str, Any]]:
        tubes = [judge for judge in self.judges if judge.judge == "tubes"]
        rays = [judge for judge in self.judges if judge.judge == "rays"]
        if not tubes or not rays:
            return
        best, other = max(tubes, key=lambda j: j.a_side), max(rays, key=lambda j: j.a_side)
        entry = {"name": "rays against ray tubes, as judges"}
        said = (
            f"a picture by {other.a_side}² stratified rays is off by {other.error:.2g} and takes {other.seconds:.2f} s"
        )
        said += f", by {best.a_side}² ray tubes by {best.error:.2g} in {best.seconds:.2f} s"
        level = max(best.error, other.error)
        brief = f"error × {other.error / max(best.error, 1e-12):.2g}"
        times = [_at(level, judges) for judges in (rays, tubes)]
        if None not in times:
            entry["time_factor"] = times[0] / times[1]
            brief = f"time × {entry['time_factor']:.2g} at {level:.2g}"
            said += f"; for an error of {level:.2g} rays take × {entry['time_factor']:.2g} of the tubes' time"
        yield entry | {"short": f"rays for tubes as judges: {brief}", "what": said}


def _at(error: float, judges: list[Judged]) -> float | None:
    """Seconds in which a judge comes to that error, by the power law between its numbers; None: outside of them."""
    for coarse, fine in zip(judges, judges[1:], strict=False):
        if coarse.error >= error >= fine.error > 0 and coarse.error > fine.error:
            part = math.log(coarse.error / error) / math.log(coarse.error / fine.error)
            return coarse.seconds * (fine.seconds / coarse.seconds) ** part
    return None
