"""A plan for the terminal: the effects that a scene has simulated or leaves out, and what a design of it will take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from bstcad.report import forecast_words
from bstcad.report.record import LeftOut, changes
from bstcad.report.vocabulary import LEFT_OUT

NOTE = (
    "Estimated on a coarse lens; most figures are good to a factor of two. RRMSD: what the effect alone gives a {} "
    "that is perfect without it; that of a real one changes by less. Blur: diameter of the spot that a point of the "
    "picture becomes."
)

PREDICTED = (("on this machine", "left"), ("seconds", "right"), ("RRMSD", "right"), ("memory (GB)", "right"))


def effects(plan: Mapping[str, Any], title: str, optic: str) -> Group:
    """Tables of both and what the figures mean, for `rich.print`, from the entries of `plan --json`."""
    left_out = [LeftOut(**entry) for entry in plan["left_out"]]
    known, unknown = ([e for e in left_out if (e.rrmsd_change is None) == none] for none in (False, True))
    said = [Text(title, "bold"), _simulated(plan["simulated"]), _estimates(known), Text(NOTE.format(optic))]
    if unknown:
        said += [Text(), Text("Left out too, by how much is not known:")]
        said += [Text(f"  {LEFT_OUT[entry.kind]} ({entry.detail})") for entry in unknown]
    if by := [entry for entry in left_out if entry.simulate_by]:
        said += [Text(), Text("To have it simulated, write in the scene:"), _remedies(by)]
    return Group(*said)


def predictions(plan: Mapping[str, Any]) -> Group:
    """Seconds, RRMSD and memory of each quality and what limits them, for `rich.print`."""
    return Group(Text(), *forecast_words.said(plan, _table(*PREDICTED)))


def _table(*headings: tuple[str, str]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading, side in headings:
        table.add_column(heading, justify=side)
    return table


def _simulated(items: Sequence[Mapping[str, Any]]) -> Table:
    table = _table(("simulated", "left"), ("asked for by", "left"))
    for item in items:
        table.add_row(Text(item["what"]), Text(item["asked_by"]))
    return table


def _estimates(entries: Sequence[LeftOut]) -> Table:
    table = _table(("left out", "left"), ("light on target", "right"), ("RRMSD", "right"), ("blur", "right"))
    for entry in entries:
        name = Text(LEFT_OUT[entry.kind])
        if entry.detail:
            name.append(f", {entry.detail}", "dim")
        table.add_row(name, *changes(entry))
    return table


def _remedies(entries: Sequence[LeftOut]) -> Table:
    table = Table.grid(padding=(0, 2))
    for entry in entries:
        table.add_row(Text(f"  {LEFT_OUT[entry.kind]}"), Text(entry.simulate_by))
    return table
