"""tradeoff.html: the figure, the tables and what they say, in one file that fetches nothing."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path
from typing import Any

from bstcad import files
from bstcad.report import report
from bstcad.report.report import machine
from bstcad.report.units import duration, number
from bstcad.tradeoff import pareto
from bstcad.tradeoff.findings import Findings
from bstcad.tradeoff.knobs import words
from bstcad.tradeoff.pareto import FEWEST, MUCH, PAYS, SAME_ERROR, SAME_TIME, Step, times
from bstcad.tradeoff.runs import HERE, Record

STEADY = 1.25  # factor by which the calibration kernel may vary on a machine that is left alone
ALT = (
    "RRMSD against seconds, both logarithmic: a curve for each knob, the Pareto front, the presets, the standard "
    "error; beside it the error of pictures by ray tubes and by rays."
)
ALT_ERRORS = "RRMSD of each place of each knob, logarithmic, a line a knob; that of the scene as it stands is marked."
HEADINGS = {True: "What each knob does to the error", False: "What accuracy costs in time"}  # with errors alone, or not


def write(found: Findings, path: Path, picture: bytes | None) -> None:
    """Write the page; picture: the figure as PNG, None if no run came to a lens."""
    import jinja2

    house = jinja2.Environment(
        loader=jinja2.FileSystemLoader([Path(__file__).parent, Path(report.__file__).parent]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    house.filters |= {"number": number, "duration": duration, "words": words, "price": _price}
    page = house.get_template("tradeoff.html.j2").render(
        found=found,
        sweep=found.sweep,
        scene=found.sweep.scene,
        verdict=verdict(found),
        tiles=tiles(found),
        notes=list(notes(found)),
        picture=picture and base64.b64encode(picture).decode(),
        alone=found.errors_alone,
        heading=HEADINGS[found.errors_alone],
        alt=ALT_ERRORS if found.errors_alone else ALT,
        front=list(front(found)),
        knobs=[row for row in map(knob, found.turned) if row],
        failed=found.failed,
        labels=found.labels,
        stages=[] if found.errors_alone else stages(found),
        runs=sorted(found.shown.values(), key=lambda r: r.rrmsd if found.errors_alone else r.seconds),
        remote=[record for point, record in found.lenses.items() if point not in found.shown],
        machine=machine(found.machine),
        pays=PAYS,
        same=(SAME_TIME, SAME_ERROR),
    )
    files.put(path, page.encode())


def verdict(found: Findings) -> tuple[str, str, str]:
    """(style, headline, explanation): what the sweep says first."""
    if not found.lenses:
        return "fail", "NO LENS", "No run came to a lens; why stands below."
    count, failed = len(found.shown), len(found.failed)
    went = f"{count} run{'s' * (count != 1)}" + (f", {failed} more without a lens" if failed else "")
    together = ", all machines together" if elsewhere(found) else ""
    went += f"; {duration(found.sweep.spent)} of a budget of {duration(found.sweep.budget)}{together}."
    if found.errors_alone:
        best = _best(found)
        said = f"is the least, by {found.labels[best.settings]}; errors alone were found, no times. {went}"
        return "remarks" if failed else "pass", f"RRMSD {number(best.rrmsd)}", said
    style, price = "remarks" if failed or unsteady(found) else "pass", found.front_halving
    first, last = (
        f"{number(record.rrmsd)} in {duration(record.seconds)}" for record in (found.front[0], found.front[-1])
    )
    if len(found.front) == 1:
        return style, f"RRMSD {first}", f"is the one run that none beats. {went}"
    if price is None:
        few = f"{len(found.front)} runs that none beats are too few for a price of halving the error; a larger budget"
        return style, f"RRMSD {first}, {last}", f"{few} has more of them. {went}"
    said = f"in time, along the Pareto front from {first} to {last}. {went}"
    return style, f"HALVING THE ERROR COSTS {times(price)}", said


def elsewhere(found: Findings) -> bool:
    """Did a run take place on another machine?"""
    return any(record.where != HERE for record in found.sweep.records.values())


def _best(found: Findings) -> Record:
    return min(found.shown.values(), key=lambda record: record.rrmsd)


def unsteady(found: Findings) -> bool:
    """Was the machine busy with something else at times?"""
    low, high = found.calibration["lowest"], found.calibration["highest"]
    return bool(low) and high > STEADY * low


def tiles(found: Findings) -> Iterator[tuple[str, str, str]]:
    """The figures a reader looks for first: (what, value, remark)."""
    if found.errors_alone:
        best = _best(found)
        yield "Least RRMSD", number(best.rrmsd), found.labels[best.settings]
    elif found.front:
        best, quick = found.front[-1], found.front[0]
        yield "Best RRMSD", number(best.rrmsd), f"in {duration(best.seconds)}: {found.labels[best.settings]}"
        yield "Quickest", duration(quick.seconds), f"RRMSD {number(quick.rrmsd)}: {found.labels[quick.settings]}"
    base = found.base
    if base:
        took = "" if found.errors_alone else f"in {duration(base.seconds)}; {beside_front(found, base)}"
        yield "The scene as it stands", number(base.rrmsd), took
        if not found.errors_alone:
            yield "Halving its error", *halving_at(found)
        floor = base.rrmsd_noise
        if floor and math.isfinite(floor):
            yield (
                "Standard error there",
                number(floor),
                f"of the reference, by {base.rays / 1e6:.0f} million rays",
            )
    if unit := found.calibration["seconds"]:
        low, high = (f"{1000 * found.calibration[key]:.0f}" for key in ("lowest", "highest"))
        yield "Calibration kernel", f"{1000 * unit:.0f} ms", f"{low} to {high} ms over the sweep"


def halving_at(found: Findings) -> tuple[str, str]:
    """What the next halving costs from the base on, by the cheapest knob that goes a good part of it: (value, remark).

    A step that hardly lowers the error may seem cheap, and has nothing behind it.
    """
    up = [(turned, step) for turned in found.turned for step in pareto.onward(turned)]
    if not up:
        return "not measured", "no knob could be turned up within the budget"
    tried = [(turned, step) for turned, step in up if len(turned.places) >= FEWEST]
    if not tried:
        return "not measured", "no knob has three places, and two runs give no price; a larger budget has more of them"
    falls = [(turned, step) for turned, step in tried if step.halving is not None]
    if not falls:
        return "no way found", "none of the knobs, turned up, makes the error fall"
    far = [(turned, step) for turned, step in falls if step.gain >= MUCH]
    if not far:
        turned, step = max(falls, key=lambda pair: pair[1].gain)
        way = f"{turned.knob.title} to {step.after.label}"
        return "no way found", f"the most that a knob, turned up, divides the error by is {step.gain:.2g}: {way}"
    turned, step = min(far, key=lambda pair: pair[1].halving)
    way = f"{turned.knob.title} to {step.after.label}, which divides the error by {step.gain:.2g}"
    return f"{times(step.halving)}", f"the cheapest way tried: {way}"


def beside_front(found: Findings, record: Record) -> str:
    """How far a run is from the front, in words."""
    if record in found.front:
        return "on the Pareto front"
    quicker = pareto.time_for(found.front, record.rrmsd)
    by = record.seconds / quicker if quicker else 1.0
    return f"the Pareto front is there in {duration(quicker)}, {by:.2f} times sooner" if quicker else "beside the front"


def notes(found: Findings) -> Iterator[str]:
    """What a reader must know of the figures."""
    if unsteady(found):
        low, high = found.calibration["lowest"], found.calibration["highest"]
        yield (
            f"The machine had other work: the calibration kernel took {1000 * low:.0f} to {1000 * high:.0f} ms. "
            "Seconds are rough by that much, and so is every factor on them; the errors are exact all the same."
        )
    for method, matters in found.sweep.seed_matters.items():
        name = {"least-squares": "L-BFGS by ray tubes", "adam": "Adam by random rays"}[method]
        if matters is None:
            yield f"Whether the seed matters to {name} was not measured: there was no time for a second seed."
        elif matters:
            bars = "" if found.errors_alone else "bars show the range, "
            yield f"The seed matters to {name}: another gives another lens; {bars}points the median."
        else:
            yield f"The seed does not matter to {name}: another seed gave the same lens to the last bit, so one is run."
    missing = [t.knob.title for t in found.turned if len(t.places) < 2]
    if missing:
        yield f"Of these too few places fitted into the budget: {', '.join(missing)}."
    if found.errors_alone:
        yield (
            "All runs took place on other machines, beside one another, so that their seconds do not compare: there is "
            "no axis of time, no Pareto front and no price of halving. Without --scheduler, into another folder, a "
            "sweep finds these."
        )
    elif elsewhere(found):
        yield (
            "Some runs took place on other machines: their seconds do not compare, so that they stand among all runs "
            "alone, with their errors."
        )


def front(found: Findings) -> Iterator[tuple[Record, str, str]]:
    """The runs of the front: (record, what it is, price of halving on the way to the next)."""
    for record, after in zip_longest(found.front, found.front[1:]):
        k = pareto.halving(record.seconds, record.rrmsd, after.seconds, after.rrmsd) if after else None
        price = "" if after is None or len(found.front) < FEWEST else "no gain" if k is None else f"{times(k)}"
        yield record, found.labels.get(record.settings, words(record.settings)), price


def knob(turned: pareto.Turned) -> dict[str, Any] | None:
    """A row of the table of knobs; None if nothing of it was run beside the base."""
    if len(turned.places) < 2:
        return None
    first, last = turned.places[0], turned.places[-1]
    enough = len(turned.places) >= FEWEST
    whole = None if first.seconds is None else pareto.halving(first.seconds, first.rrmsd, last.seconds, last.rrmsd)
    return {
        "title": turned.knob.title,
        "tried": ", ".join(place.label for place in turned.places),
        "errors": ", ".join(f"{place.label}: {number(place.rrmsd)}" for place in turned.places),
        "to": turned.to_base if enough else None,
        "on": turned.from_base if enough else None,
        "whole": None if whole is None else times(whole) if enough else "—",
        "says": turned.says,
    }


def _price(step: Step | None) -> str:
    """What halving costs on a step; a dash where there is none."""
    if step is None:
        return "—"
    if step.halving is None:
        return "no gain"
    return "for nothing" if step.free else f"{times(step.halving)}"


def stages(found: Findings) -> list[tuple[str, list[float | None]]]:
    """Seconds of the stages of the presets: rows (name, a value a preset)."""
    names: dict[str, None] = {}
    for record in found.presets.values():
        names |= dict.fromkeys(_plain(name) for name, _, _ in record.stages)
    rows = []
    for name in names:
        row = []
        for record in found.presets.values():
            parts = [seconds for stage, seconds, _ in record.stages if _plain(stage) == name]
            row.append(sum(parts) if parts else None)
        rows.append((name, row))
    sums = [sum(seconds for _, seconds, _ in record.stages) for record in found.presets.values()]
    rest = [max(record.seconds - s, 0.0) for record, s in zip(found.presets.values(), sums, strict=True)]
    return [*rows, ("before and after: process, pictures", rest)] if rows else []


def _plain(stage: str) -> str:
    """The stage that a part belongs to: "stage 2" of "stage 2, 1024² tubes"."""
    return stage.partition(",")[0]
