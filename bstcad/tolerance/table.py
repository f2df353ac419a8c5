"""Tolerances for the terminal: what each error does, and how many lenses come out good."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from bstcad.report.tolerance_words import amount, capped, changed, part_of, sentences

if TYPE_CHECKING:
    from rich.console import Group


def summary(facts: Mapping[str, Any]) -> Group:
    """The table and the verdict, for `rich.print`, from the entries of tolerance.json."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    grade, limits = facts["grade"], facts.get("inverse", {}).get("limits", {})
    table = Table(title=Text(f"Tolerances of {facts['name']}: {grade['words']}"), title_justify="left")
    for heading, side in (("error", "left"), ("±", "right"), ("RRMSD by 1 σ", "right"), ("share", "right")):
        table.add_column(heading, justify=side)
    if limits:
        table.add_column("loosest ±", justify="right")
    widest = capped(facts)
    for item in facts["sensitivities"]:
        cells = [amount(item["limit"], item["unit"]), changed(item["rrmsd_change"]), part_of(item["share"])]
        at_least = "≥ " if item["name"] in widest else ""
        loose = [f"{at_least}{amount(limits[item['name']], item['unit'])}"] if limits else []
        table.add_row(Text(item["words"]), *cells, *loose)
    return Group(table, *(Text(line) for line in sentences(facts)))
