"""What a scene will take and come to, for the terminal: a table, and what limits it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from bstcad.report.units import about

WORTH = 0.9  # times the RRMSD of the standard quality: what would leave more of it does not pay
NOTE = "In brackets what nine of ten designs keep to. Seconds: from the command to its end, with nothing else running."


def said(plan: Mapping[str, Any], table: Table) -> list[Table | Text]:
    """The part of a plan that is predicted; table: an empty one of four columns."""
    if plan["predicted"] is None:
        return [Text(f"Seconds, RRMSD and memory are not predicted: {plan['not_predicted']}.")]
    for name, entry in _rows(plan):
        table.add_row(Text(name), *(_interval(entry[key]) for key in ("seconds", "rrmsd", "memory_gb")))
    return [table, Text(" ".join((*limited(plan), *plan["notes"], NOTE)))]


def _rows(plan: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Sequence[float]]]]:
    yield from plan["predicted"].items()
    if plan["finer"] is not None:
        m = plan["finer"]["control_points"]
        yield f"standard, {m} control points", plan["finer"]["predicted"]["standard"]


def limited(plan: Mapping[str, Any]) -> Iterator[str]:
    """What limits the standard quality, in a sentence."""
    standard = plan["predicted"]["standard"]["rrmsd"][1]
    fine = plan["predicted"]["fine"]["rrmsd"][1] / standard
    finer = plan["finer"] and plan["finer"]["predicted"]["standard"]["rrmsd"][1] / standard
    if finer and finer <= min(fine, WORTH):
        m, seconds = plan["finer"]["control_points"], plan["finer"]["predicted"]["standard"]["seconds"][1]
        yield (
            f"Control points limit it: lens.back.control_points = {m} would leave {about(finer)} times the "
            f"RRMSD, in about {about(seconds)} s."
        )
    elif fine <= WORTH:
        seconds = plan["predicted"]["fine"]["seconds"][1]
        yield (
            f'Evaluations limit it: quality = "fine" would leave {about(fine)} times the RRMSD, '
            f"in about {about(seconds)} s."
        )
    else:
        yield "Neither more evaluations nor more control points would make the RRMSD of the standard much smaller."


def _interval(values: Sequence[float]) -> Text:
    low, likely, high = (about(value) for value in values)
    return Text.assemble(likely, (f" ({low} to {high})", "dim"))
