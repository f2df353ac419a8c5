"""Tolerances for the terminal: what each error does, and how many lenses come out good."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from bstcad.report.units import number

if TYPE_CHECKING:
    from rich.console import Group

LOOSE = 0.1, 0.03  # 95 % and median of the model against full traces, beyond which the full traces' yield counts


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
        cells = [_amount(item["limit"], item["unit"]), f"{item['rrmsd_change']:+.4f}", f"{100 * item['share']:.1f} %"]
        loose = [_amount(limits[item["name"]], item["unit"])] if limits else []
        table.add_row(Text(item["words"]), *cells, *loose)
    return Group(table, *(Text(line) for line in sentences(facts)))


def sentences(facts: Mapping[str, Any]) -> list[str]:
    """Yield, trials, and how well the model stands up to full traces."""
    spread, off, limit = facts["rrmsd_trials"], facts["model_off"], facts["limit"]
    trusted = off["95 %"] <= LOOSE[0] and off["median"] <= LOOSE[1]
    found = [
        f"RRMSD as designed: {facts['rrmsd']:.4f}; of {facts['trials']} trials: {spread['50 %']:.4f} "
        f"({spread['5 %']:.4f} to {spread['95 %']:.4f} in nine of ten)",
        f"Yield, RRMSD up to {limit:g}: {_yield(facts['yield'])} of {facts['trials']} trials by superposed pictures, "
        f"{_yield(facts['yield_full'])} of {facts['full_trials']} full traces",
        f"With the screen shifted, focused, tilted and turned to fit: {_yield(facts['yield_adjusted'])}",
        f"Superposed pictures against full traces: within {100 * off['median']:.1f} % (median), "
        f"{100 * off['95 %']:.0f} % (95 of 100)"
        + ("" if trusted else "; these errors are too large for them: trust the full traces"),
    ]
    if inverse := facts.get("inverse"):
        found.append(f"The loosest tolerances for a yield of {100 * inverse['wanted']:g} %: {_yield(inverse['yield'])}")
    return found


def _yield(interval: list[float]) -> str:
    low, likely, high = (100 * part for part in interval)
    return f"{likely:.1f} % ({low:.1f} to {high:.1f} %)"


def _amount(value: float, unit: str) -> str:
    if unit.startswith("mm") and value < 0.001:
        return f"{number(1e6 * value)} nm{unit[2:]}"
    if unit.startswith("mm") and value < 0.1:
        return f"{number(1e3 * value)} µm{unit[2:]}"
    return f"{number(value)} {unit}".strip()
