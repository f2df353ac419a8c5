"""Tolerances for the terminal: what each error does, and how many lenses come out good."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from bstcad.report.tolerance_words import amount, sentences

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
    for item in facts["sensitivities"]:
        cells = [amount(item["limit"], item["unit"]), f"{item['rrmsd_change']:+.4f}", f"{100 * item['share']:.1f} %"]
        loose = [amount(limits[item["name"]], item["unit"])] if limits else []
        table.add_row(Text(item["words"]), *cells, *loose)
    return Group(table, *(Text(line) for line in sentences(facts)))
