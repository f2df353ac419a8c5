"""docs/stability.md: the tables between its markers are made from what the tests measured; the words stay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

BEGIN, END = "<!-- figures: {} -->", "<!-- end -->"


@dataclass(frozen=True)
class Figure:
    """One measured number of one hard case."""

    case: str  # first line of the test module's docstring: "7. A plane as a sphere …"
    what: str
    value: float
    bound: float
    unit: str


def table(figures: Sequence[Figure]) -> str:
    """A Markdown table, in the order of the cases, each figure once with its largest value."""
    worst: dict[tuple[str, str], Figure] = {}
    for figure in figures:
        key = figure.case, figure.what
        if key not in worst or figure.value > worst[key].value:
            worst[key] = figure
    lines = ["| case | figure | measured | bound |", "|---|---|--:|--:|"]
    before = None
    for figure in sorted(worst.values(), key=lambda f: _number(f.case)):
        case, before = ("" if figure.case == before else figure.case.rstrip(".")), figure.case
        unit = f" {figure.unit}" if figure.unit else ""
        lines.append(f"| {case} | {figure.what} | {figure.value:.2g}{unit} | {figure.bound:.2g}{unit} |")
    return "\n".join(lines)


def _number(case: str) -> float:
    first = case.partition(".")[0]
    return float(first) if first.isdigit() else float("inf")


def replaced(text: str, figures: Sequence[Figure]) -> str:
    """The page with a new table of the cases."""
    return between(text, "cases", table(figures))


def between(text: str, name: str, content: str) -> str:
    """The page with what stands between the markers of `name` replaced; ValueError if it has none."""
    begin = BEGIN.format(name)
    before, found, rest = text.partition(begin)
    _, ended, after = rest.partition(END)
    if not (found and ended):
        raise ValueError(f"the page has no '{begin}' … '{END}'")
    return f"{before}{begin}\n\n{content}\n\n{END}{after}"
