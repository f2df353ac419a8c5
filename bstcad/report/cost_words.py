"""The cost and the limits of a design, and a plan, in the words and tables of the page and the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bstcad.analysis.cost import WORTH
from bstcad.report.record import Contents, LeftOut, changes
from bstcad.report.units import about, duration, number, percent, quantity, two_digits
from bstcad.report.vocabulary import LEFT_OUT

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

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
FINEST = 5  # octaves that are told apart; the coarser ones are one row
PARTS = {  # name of a part of the target: in words
    "rim": "along the rim of the target",
    "edges": "at edges of the picture",
    "darkest": "in its darkest pixels",
    "brightest": "in its brightest pixels",
    "rest": "in all others",
}
LIMITS = {  # Limit.by: in words
    "evaluations": "the number of evaluations",
    "control points": "the number of control points",
    "tubes": "the number of ray tubes",
    "source size": "the size of the source",
    "precision": "the arithmetic's precision",
}


# --- a finished design, for the page ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Bar:
    """A row with a bar."""

    name: str
    text: str  # the figure
    share: float  # length of the bar, of 1
    detail: str = ""
    colour: str = ""


def stages(report: Contents) -> list[Bar]:
    """Each stage's share of the time of all, in their order."""
    whole = sum(stage.seconds for stage in report.stages) or 1.0
    return [
        Bar(stage.name, duration(stage.seconds), stage.seconds / whole, colour=_colour(stage.name))
        for stage in report.stages
    ]


def _colour(name: str) -> str:
    """Of a stage."""
    return next((colour for begins, colour in COLOURS.items() if name.startswith(begins)), OTHER)


def ending(convergence: Mapping[str, float | None] | None) -> str:
    """The cost of the last of the error, and of half of the rest, in two sentences."""
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
    """Parts of the target with their shares of the squared error and of the pixels."""
    return [
        Bar(PARTS[part["name"]], _share(part["error"]), part["error"], _share(part["pixels"]))
        for part in remaining["parts"]
        if part["pixels"] > 0
    ]


def octaves(remaining: Mapping[str, Any]) -> list[Bar]:
    """Waves of the error from coarse to fine with their shares of the squared error."""
    coarse, fine = remaining["octaves"][:-FINEST], remaining["octaves"][-FINEST:]
    rows = []
    for octave in fine:
        long, short = (quantity(two_digits(period), "mm") for period in octave["period"])
        cycles = " to ".join(map(number, octave["frequency"]))
        rows.append(Bar(f"{short} to {long}", _share(octave["error"]), octave["error"], cycles))
    if not coarse:
        return rows
    period, frequency = coarse[-1]["period"][1], coarse[-1]["frequency"][1]
    share = min(sum(octave["error"] for octave in coarse), 1.0)
    over = f"over {quantity(two_digits(period), 'mm')}"
    return [Bar(over, _share(share), share, f"below {number(frequency)}"), *rows]


def limit(limits: Sequence[Mapping[str, Any]]) -> str:
    """What limits a design now, and the change that helps, in a short sentence; none if nothing is known."""
    if not limits:
        return ""
    first = limits[0]
    if first["rrmsd"] > WORTH:
        return f"Nothing by itself would lower the RRMSD by more than {about(100 * (1 - WORTH))} %."
    return f"What limits it now is {LIMITS[first['by']]}: {first['because'].rpartition('; ')[2]}."


def remedies(limits: Sequence[Mapping[str, Any]]) -> list[Bar]:
    """One step of each thing, with the share of the RRMSD that it would leave."""
    return [
        Bar(LIMITS[entry["by"]], f"× {about(entry['rrmsd'])}", entry["rrmsd"], entry["because"]) for entry in limits
    ]


def _share(value: float) -> str:
    """To a tenth of a percent."""
    return percent(round(value, 3))


# --- a plan, for the terminal -----------------------------------------------------------------------------------------

PAYS = 0.9  # times the RRMSD of the standard quality: a step that would leave more of it does not pay
ESTIMATED = (
    "Estimated on a coarse lens; most figures are good to a factor of two. RRMSD: what the effect alone gives a {} "
    "that is perfect without it; that of a real one changes by less. Blur: diameter of the spot that a point of the "
    "picture becomes."
)
INTERVALS = (
    "In brackets what nine of ten designs keep to. Seconds: from the command to its end, with nothing else running."
)


def effects(plan: Mapping[str, Any], title: str, optic: str) -> Group:
    """Tables of the effects that are simulated and left out, from the entries of `plan --json`."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    simulated, known, remedies = (
        _table(("simulated", "left"), ("asked for by", "left")),
        _table(("left out", "left"), ("light on target", "right"), ("RRMSD", "right"), ("blur", "right")),
        Table.grid(padding=(0, 2)),
    )
    for item in plan["simulated"]:
        simulated.add_row(Text(item["what"]), Text(item["asked_by"]))
    left_out = [LeftOut(**entry) for entry in plan["left_out"]]
    for entry in left_out:
        if entry.rrmsd_change is not None:
            detail = (f", {entry.detail}" if entry.detail else "", "dim")
            known.add_row(Text.assemble(LEFT_OUT[entry.kind], detail), *changes(entry))
        if entry.simulate_by:
            remedies.add_row(Text(f"  {LEFT_OUT[entry.kind]}"), Text(entry.simulate_by))
    lines = [Text(title, "bold"), simulated, known, Text(ESTIMATED.format(optic))]
    if unknown := [entry for entry in left_out if entry.rrmsd_change is None]:
        lines += [Text(), Text("Left out too, by how much is not known:")]
        lines += [Text(f"  {LEFT_OUT[entry.kind]} ({entry.detail})") for entry in unknown]
    if remedies.row_count:
        lines += [Text(), Text("To have it simulated, write in the scene:"), remedies]
    return Group(*lines)


def predictions(plan: Mapping[str, Any]) -> Group:
    """Seconds, RRMSD and memory of each quality and what limits them."""
    from rich.console import Group
    from rich.text import Text

    if plan["predicted"] is None:
        return Group(Text(), Text(f"Seconds, RRMSD and memory are not predicted: {plan['not_predicted']}."))
    rows = dict(plan["predicted"])
    if plan["finer"] is not None:
        rows[f"standard, {plan['finer']['control_points']} control points"] = plan["finer"]["predicted"]["standard"]
    table = _table(("on this machine", "left"), ("seconds", "right"), ("RRMSD", "right"), ("memory (GB)", "right"))
    for name, entry in rows.items():
        table.add_row(Text(name), *(_interval(entry[key]) for key in ("seconds", "rrmsd", "memory_gb")))
    return Group(Text(), table, Text(" ".join((*limited(plan), *plan["notes"], INTERVALS))))


def limited(plan: Mapping[str, Any]) -> Iterator[str]:
    """What limits the standard quality, in a sentence."""

    def likely(key: str, predicted: Mapping[str, Any], quality: str) -> float:
        return predicted[quality][key][1]

    standard, finer = likely("rrmsd", plan["predicted"], "standard"), plan["finer"]
    fine = likely("rrmsd", plan["predicted"], "fine") / standard
    fewer = finer and likely("rrmsd", finer["predicted"], "standard") / standard
    if fewer and fewer <= min(fine, PAYS):
        seconds = about(likely("seconds", finer["predicted"], "standard"))
        step = f"Control points limit it: lens.back.control_points = {finer['control_points']}"
        yield f"{step} would leave {about(fewer)} times the RRMSD, in about {seconds} s."
    elif fine <= PAYS:
        seconds = about(likely("seconds", plan["predicted"], "fine"))
        step = 'Evaluations limit it: quality = "fine"'
        yield f"{step} would leave {about(fine)} times the RRMSD, in about {seconds} s."
    else:
        yield "Neither more evaluations nor more control points would make the RRMSD of the standard much smaller."


def _table(*headings: tuple[str, str]) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading, side in headings:
        table.add_column(heading, justify=side)
    return table


def _interval(values: Sequence[float]) -> Text:
    from rich.text import Text

    low, likely, high = (about(value) for value in values)
    return Text.assemble(likely, (f" ({low} to {high})", "dim"))
