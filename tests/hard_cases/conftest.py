"""The hard cases say what they measured: each figure is held to its bound and, when asked for, put on a page.

pytest tests/hard_cases -q --stability docs/stability.md     (make stability)
"""

from __future__ import annotations

import math
from collections.abc import Callable
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
    rows, before = [], ""  # in the order of the cases, which are first lines of docstrings: "7. A plane …"
    figures = session.config.stash[FIGURES].items()
    for (case, what), values in sorted(figures, key=lambda entry: int(entry[0][0].partition(".")[0])):
        value, bound, unit = values
        rows.append(
            ["" if case == before else case.rstrip("."), what, *(f"{v:.2g} {unit}".strip() for v in (value, bound))]
        )
        before = case
    content = markdown.table(("case", "figure", "measured", "bound"), rows, words=("figure",))
    markdown.write(Path(page), "<!-- figures: cases -->", content)
