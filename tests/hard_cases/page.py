"""docs/stability.md: the tables between its markers are made from what the tests measured; the words stay."""

from __future__ import annotations

import re
from collections.abc import Mapping

BEGIN, END = "<!-- figures: {} -->", "<!-- end -->"
Figures = dict[tuple[str, str], tuple[float, float, str]]  # (case, what): its largest value, the bound, the unit


def table(figures: Mapping[tuple[str, str], tuple[float, float, str]]) -> str:
    """A Markdown table, in the order of the cases, which are first lines of docstrings: "7. A plane …"."""
    lines, before = ["| case | figure | measured | bound |", "|---|---|--:|--:|"], None
    for (case, what), (value, bound, unit) in sorted(figures.items(), key=lambda entry: number(entry[0][0])):
        first, before, unit = ("" if case == before else case.rstrip(".")), case, f" {unit}" if unit else ""
        lines.append(f"| {first} | {what} | {value:.2g}{unit} | {bound:.2g}{unit} |")
    return "\n".join(lines)


def number(case: str) -> float:
    found = re.match(r"(\d+)\.", case)
    return float(found[1]) if found else float("inf")


def between(text: str, name: str, content: str) -> str:
    """The page with what stands between the markers of `name` replaced; ValueError if it has none."""
    before, found, rest = text.partition(BEGIN.format(name))
    _, ended, after = rest.partition(END)
    if not (found and ended):
        raise ValueError(f"the page has no '{BEGIN.format(name)}' … '{END}'")
    return f"{before}{found}\n\n{content}\n\n{END}{after}"
