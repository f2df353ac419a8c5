"""The hard cases say what they measured: each figure is held to its bound and, when asked for, put on a page.

pytest tests/hard_cases -q --stability docs/stability.md     (make stability)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from tests import markdown

# (case, figure): its largest value, the bound, the unit
FIGURES = pytest.StashKey[dict[tuple[str, str], tuple[float, float, str]]]()


def pytest_addoption(parser):
    parser.addoption("--stability", metavar="FILE", help="write what the hard cases measured to this page")


def pytest_configure(config):
    config.stash[FIGURES] = {}


@pytest.fixture
def holds(request) -> Callable[..., None]:
    """holds(what, value, bound, unit): the value is finite and at most the bound, and stands on the page."""

    def held(what: str, value: float, bound: float, unit: str = "") -> None:
        assert math.isfinite(value), f"{what}: not finite"
        assert value <= bound, f"{what}: {value:.3g} {unit}, more than {bound:.3g}"
        figures, key = request.config.stash[FIGURES], (request.module.__doc__.splitlines()[0], what)
        figures[key] = max(figures.get(key, (value, bound, unit)), (value, bound, unit))

    return held


def pytest_sessionfinish(session):
    page = session.config.getoption("--stability", default=None)
    if not page or not session.testscollected or session.testsfailed:
        return
    content = markdown.table(
        ("case", "figure", "measured", "bound"), by_case(session.config.stash[FIGURES]), words=("figure",)
    )
    markdown.write(Path(page), "<!-- figures: cases -->", content)


def by_case(figures: Mapping[tuple[str, str], tuple[float, float, str]]) -> list[list[str]]:
    """Return rows of case, figure, measured and bound, in the order of the cases: "7. A plane …".

    Figures of float32 and of float64 that have one name otherwise share a row.
    """
    rows, before = [], ""
    for (case, what), values in sorted(figures.items(), key=lambda entry: int(entry[0][0].partition(".")[0])):
        coarse, exact = (case, what.replace("float64", "float32")), (case, what.replace("float32", "float64"))
        name, found = what, [values]
        if coarse != exact and {coarse, exact} <= figures.keys():
            if (case, what) == exact:
                continue
            name, found = what.replace("float32", "float32; float64"), [values, figures[exact]]
        cells = ("; ".join(f"{each[k]:.2g}" for each in found) for k in range(2))
        rows.append(["" if case == before else case.rstrip("."), name, *(f"{c} {values[2]}".strip() for c in cells)])
        before = case
    return rows
