"""The hard cases say what they measured: each figure is held to its bound and, when asked for, put on a page.

pytest tests/hard_cases -q --stability docs/stability.md     (make stability)
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.hard_cases import page

FIGURES = pytest.StashKey[page.Figures]()


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
    file = session.config.getoption("--stability", default=None)
    if file and session.testscollected and not session.testsfailed:
        text = Path(file).read_text(encoding="utf-8")
        Path(file).write_text(page.between(text, "cases", page.table(session.config.stash[FIGURES])), "utf-8")


@pytest.fixture
def quick_folder(small_design, tmp_path, monkeypatch):
    """The small design in a folder of its own beside nothing else; verified by few rays and without pictures."""
    from bstcad import commands
    from bstcad.optics.measure import Effort
    from tests.conftest import draws_nothing, verify_with

    monkeypatch.setattr(commands.processes, "submit", commands.processes.here)
    draws_nothing(monkeypatch)
    verify_with(monkeypatch, Effort(64, places=65, points=512))
    return Path(shutil.copytree(small_design.folder, tmp_path / "design"))
