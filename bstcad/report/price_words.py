"""What a design cost and what limits it, in the words and shares that the page and the terminal show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bstcad.analysis.bottleneck import WORTH
from bstcad.report.record import Contents
from bstcad.report.units import about, duration, number, percent, quantity, two_digits

COLOURS = {  # how the name of a stage begins: its colour, of Okabe and Ito's and two besides
    "loading": "#0072b2",
    "transport": "#b8a600",
    "stage 1": "#e69f00",
    "integration": "#e69f00",  # in its place
    "float32": "#009e73",
    "stage 2": "#cc79a7",
    "stage 3": "#7a5195",
    "bounds": "#a6761d",
    "write": "#56b4e9",
    "verify": "#d55e00",
    "report": "#8c8c8c",
}
OTHER = "#5a646e"
FINEST = 5  # octaves that are told apart; what is coarser is one row
PARTS = {  # name of a part of the target: what it is
    "rim": "along the rim of the target",
    "edges": "at edges of the picture",
    "darkest": "in its darkest pixels",
    "brightest": "in its brightest pixels",
    "rest": "in all others",
}
LIMITS = {  # what limits a design: in words
    "evaluations": "the number of evaluations",
    "control points": "the number of control points",
    "tubes": "the number of ray tubes",
    "source size": "the size of the source",
    "precision": "the arithmetic's precision",
}


@dataclass(frozen=True)
class Bar:
    """A row with a bar."""

    name: str
    text: str  # the figure
    share: float  # length of the bar, of 1
    detail: str = ""
    colour: str = ""


def stages(report: Contents) -> list[Bar]:
    """Each stage's part of the time of all, in their order."""
    whole = sum(stage.seconds for stage in report.stages) or 1.0
    return [
        Bar(stage.name, duration(stage.seconds), stage.seconds / whole, colour=_colour(stage.name))
        for stage in report.stages
    ]


def _colour(name: str) -> str:
    """Of a stage."""
    return next((colour for begins, colour in COLOURS.items() if name.startswith(begins)), OTHER)


def ending(convergence: Mapping[str, float | None] | None) -> str:
    """What the last of the error cost, and what half of it would, in two sentences."""
    if convergence is None:
        return "The irradiance itself was not tailored, so there is no curve whose end could be looked at."
    took, share, halving = (convergence[key] for key in ("last_tenth_seconds", "last_tenth", "halving"))
    last = f"The last 10 % of the error took {about(100 * share)} % of the time up to there ({duration(took)})."
    if halving is not None:
        return (
            f"{last} To halve the error once more would take about {about(halving)} times the evaluations' time so far."
        )
    if convergence["power"] is None:
        return f"{last} The curve has too few points to say what half of the error would cost."
    return f"{last} To go on has stopped paying: half of the error is not to be had by time alone."


def parts(remaining: Mapping[str, Any]) -> list[Bar]:
    """Parts of the target with their parts of the squared error and of the pixels."""
    return [
        Bar(PARTS[part["name"]], percent(_share(part["error"])), part["error"], percent(_share(part["pixels"])))
        for part in remaining["parts"]
        if part["pixels"] > 0
    ]


def octaves(remaining: Mapping[str, Any]) -> list[Bar]:
    """Waves of the error from coarse to fine with their parts of the squared error."""
    found = list(remaining["octaves"])
    coarse, fine = found[:-FINEST], found[-FINEST:]
    rows = [
        Bar(
            f"{quantity(two_digits(octave['period'][1]), 'mm')} to {quantity(two_digits(octave['period'][0]), 'mm')}",
            percent(_share(octave["error"])),
            octave["error"],
            f"{number(octave['frequency'][0])} to {number(octave['frequency'][1])}",
        )
        for octave in fine
    ]
    if not coarse:
        return rows
    period, frequency = coarse[-1]["period"][1], coarse[-1]["frequency"][1]
    share = min(sum(octave["error"] for octave in coarse), 1.0)
    over = f"over {quantity(two_digits(period), 'mm')}"
    return [Bar(over, percent(_share(share)), share, f"below {number(frequency)}"), *rows]


def limit(limits: Sequence[Mapping[str, Any]]) -> str:
    """What limits a design now, and what to change, in a short sentence; none if nothing is known."""
    if not limits:
        return ""
    first = limits[0]
    if first["rrmsd"] > WORTH:
        return f"Nothing by itself would lower the RRMSD by more than {about(100 * (1 - WORTH))} %."
    return f"What limits it now is {LIMITS[first['by']]}: {first['because'].rpartition('; ')[2]}."


def remedies(limits: Sequence[Mapping[str, Any]]) -> list[Bar]:
    """One step of each thing, with what it would leave of the RRMSD."""
    return [
        Bar(LIMITS[entry["by"]], f"× {about(entry['rrmsd'])}", entry["rrmsd"], entry["because"]) for entry in limits
    ]


def _share(value: float) -> float:
    """A part of 1 to a tenth of a percent."""
    return round(value, 3)
