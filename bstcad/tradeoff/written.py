"""tradeoff.json and tradeoff.csv: all that a sweep found, for programs.

tradeoff.csv has a line a run; its columns are those entries of `runs` that are numbers or words, by the same names.
tradeoff.json:

- name, title: of the scene; base: its quality, knobs (tailoring as resolved), control_points, pixels
- budget_seconds, spent_seconds: of all runs together; version: of bstcad; sources: the same with a hash of the
  modules that decide what a run comes to; machine, versions: as in report.json
- errors_alone: true where every lens came about on another machine, so that there is no front, no factor on time, and
  no seconds of places and presets
- reference: rays (in all, of each run), and what it is in words
- calibration: seconds (median over the runs), lowest, highest, what (in words)
- runs: each with knobs (keys of those that it is a place of; "base": of all), settings (dotted keys), status ("done",
  "failed", "not run: budget"), reason, where ("here", or a machine's address), seconds, cpu_seconds, kernel_seconds,
  units (seconds / kernel_seconds), cost_seconds (what it took of the budget), predicted_seconds (of these, before it
  began), peak_memory_gb, rrmsd, rrmsd_noise (its standard error), rays, rrmsd_reported, rrmsd_noise_reported (by the
  run's own proof, on its own pixels), passed, net (SHA-256 of the control net), stages, on_front
- knobs: each with key, title, places [{label, settings, seconds, rrmsd, lowest, highest, seeds}] from little work to
  much, steps [{before, after, halving}] (halving: the factor on the time that halves the error; null: the error does
  not fall), stops_after (label) and says (that in words)
- front: settings of the runs that none beats in both, the quickest first; front_halving: its factor, by least squares
- presets: name, seconds, rrmsd; comparisons: of two ways each, in words with factors
- seeds: for each method whether another seed gave another lens (null: not measured)
- searches: from the lens of stage 1 by the same tubes: variable ("Sobolev": by L-BFGS, "control points": by Adam at a
  rate in mm a step), control_points and tubes a side, start (RRMSD there), rrmsd (the best so far, each evaluation)
- judges: ray tubes and rays against the reference's picture: judge, a_side, seconds (warm), error
- history: of the base's run, seconds and rrmsd by its own tubes (warm, before writing and proof)
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import bstcad
from bstcad import files
from bstcad.tradeoff.findings import Findings
from bstcad.tradeoff.knobs import as_text
from bstcad.tradeoff.runs import Record

DIGITS = 6
NOT_RUN = "not run: budget"
COLUMNS = (
    "knobs", "settings", "status", "seconds", "cpu_seconds", "kernel_seconds", "units", "rrmsd", "rrmsd_noise",
    "rrmsd_reported", "peak_memory_gb", "on_front", "predicted_seconds", "cost_seconds", "where", "reason",
)  # fmt: skip


def write(found: Findings, folder: Path) -> None:
    """Write both files."""
    files.put(folder / "tradeoff.json", (json.dumps(facts(found), ensure_ascii=False, indent=1) + "\n").encode())
    files.put(folder / "tradeoff.csv", table(found).encode())


def facts(found: Findings) -> dict[str, Any]:
    """The entries of tradeoff.json."""
    sweep = found.sweep
    scene, knobs = sweep.scene, sweep.scene.tailoring.resolved(sweep.scene.lens.back.control_points)
    return plain(
        {
            "name": scene.name,
            "title": scene.title,
            "base": {
                "quality": scene.tailoring.quality,
                "control_points": scene.lens.back.control_points,
                "pixels": list(scene.target.columns_rows),
                "knobs": knobs.model_dump(exclude_none=True),
            },
            "budget_seconds": sweep.budget,
            "spent_seconds": sweep.spent,
            "errors_alone": found.errors_alone,
            "version": bstcad.__version__,
            "sources": found.version,
            "machine": found.machine,
            "versions": found.versions,
            "reference": {"rays": found.reference_rays, "what": found.reference},
            "calibration": found.calibration,
            "runs": [*_runs(found)],
            "knobs": [_knob(turned) for turned in found.turned],
            "front": [dict(record.settings) for record in found.front],
            "front_halving": found.front_halving,
            "presets": [*_presets(found)],
            "comparisons": found.comparisons,
            "seeds": dict(sweep.seed_matters),
            "judges": [asdict(judge) for judge in found.judges],
            "searches": [asdict(each) for each in (found.base.searches if found.base else ())],
            "history": [{"seconds": seconds, "rrmsd": rrmsd} for seconds, rrmsd in found.history],
        }
    )


def table(found: Findings) -> str:
    """tradeoff.csv: a line a run, units in the names of the columns."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    for run in plain([*_runs(found)]):
        listed = {
            "knobs": "; ".join(run["knobs"]),
            "settings": "; ".join(f"{key} = {as_text(_listed(value))}" for key, value in run["settings"].items()),
        }
        line = run | listed
        rows.writerow("" if line[column] is None else line[column] for column in COLUMNS)
    return text.getvalue()


def _presets(found: Findings) -> Iterator[dict[str, Any]]:
    for name, record in found.presets.items():
        yield {"name": name, "seconds": None if found.errors_alone else record.seconds, "rrmsd": record.rrmsd}


def _runs(found: Findings) -> Iterator[dict[str, Any]]:
    on_front = {record.settings for record in found.front}
    for record in found.sweep.records.values():
        yield _run(found, record, record.settings in on_front)
    for planned in found.sweep.not_run:
        empty = _run(found, Record(planned.settings, NOT_RUN, where=""), False)
        unknown = dict.fromkeys(("seconds", "cpu_seconds", "kernel_seconds", "cost_seconds"))
        yield empty | unknown | {"predicted_seconds": planned.predicted_seconds}


def _run(found: Findings, record: Record, on_front: bool) -> dict[str, Any]:
    units = record.seconds / record.kernel_seconds if record.kernel_seconds else None
    kept = (
        "status", "reason", "where", "seconds", "cpu_seconds", "kernel_seconds", "peak_memory_gb", "rrmsd",
        "rrmsd_noise", "rays", "rrmsd_reported", "rrmsd_noise_reported", "passed", "net", "cost_seconds",
        "predicted_seconds",
    )  # fmt: skip
    return {
        "settings": dict(record.settings),
        "knobs": found.knobs_of(record.settings),
        **{name: getattr(record, name) for name in kept},
        "units": units,
        "stages": [{"name": name, "seconds": s, "rrmsd": rrmsd} for name, s, rrmsd in record.stages],
        "on_front": on_front,
    }


def _knob(turned: Any) -> dict[str, Any]:
    return {
        "key": turned.knob.key,
        "title": turned.knob.title,
        "places": [asdict(place) | {"settings": dict(place.settings)} for place in turned.places],
        "steps": [
            {"before": step.before.label, "after": step.after.label, "halving": step.halving} for step in turned.steps
        ],
        "stops_after": turned.stops_after,
        "says": turned.says,
    }


def _listed(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def plain(value: Any, digits: int = DIGITS) -> Any:
    """What JSON holds: numbers to so many digits, tuples as lists."""
    if isinstance(value, Mapping):
        return {key: plain(part, digits) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part, digits) for part in value]
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value
