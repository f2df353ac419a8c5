"""The hard cases say what they measured: each figure is held to its bound and, when asked for, put on a page.

pytest tests/hard_cases -q --stability docs/stability.md     (make stability)
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

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


@pytest.fixture(scope="session")
def small_step(tmp_path_factory) -> Path:
    """The STEP file of a plate with 5 x 5 control points."""
    from bstcad.cad.step_writing import write_lens
    from bstcad.optics.bspline import BSplineSurface
    from bstcad.optics.lens import Lens
    from bstcad.optics.outlines import Rectangle
    from bstcad.optics.surfaces import Plane

    heights = torch.linspace(0, 1e-2, 25, dtype=torch.float64).reshape(5, 5)
    lens = Lens(Plane(8.0), BSplineSurface(20.0, heights, (-4.0, 4.0), (-4.0, 4.0)), Rectangle(8.0, 8.0), 1.5)
    path = tmp_path_factory.mktemp("plate") / "plate.step"
    write_lens(lens, path, "plate")
    return path
