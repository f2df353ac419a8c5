"""A tiny scene to sweep, and the results of a synthetic sweep of it."""

import pytest

from bstcad.scene.scene import load
from tests.conftest import DISK
from tests.sweep.synthetic import Synthetic

TINY = {
    "lens.back.control_points": 33, "target.pixels": 48, "tailoring.quality": "draft", "tailoring.rays": 128,
    "tailoring.transport_grid": 64, "tailoring.rounds": 2,
}  # fmt: skip


@pytest.fixture(scope="session")
def tiny():
    """templates/disk.toml, as small as makes a lens."""
    return load(DISK, TINY)


@pytest.fixture(scope="session")
def swept(tiny, tmp_path_factory):
    """(folder, results) of a sweep by formulas that had time for everything."""
    from bstcad.sweep.tradeoff import tradeoff

    folder = tmp_path_factory.mktemp("tradeoff") / "swept"
    return folder, tradeoff(tiny, folder, budget=1e6, machines=Synthetic(tiny))
