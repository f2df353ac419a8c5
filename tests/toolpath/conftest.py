"""Paths whose check against the face takes little time, for tests of all that is written besides its figures."""

import pytest

from bstcad.toolpath import swept_volume


@pytest.fixture
def few_samples(monkeypatch):
    """Let the check of a path have few points of the face; test_gouges.py and test_simulated_shop.py hold to it."""
    monkeypatch.setattr(swept_volume, "SAMPLES", (1000, 2000))
    monkeypatch.setattr(swept_volume, "SEARCH_STARTS", 20)
