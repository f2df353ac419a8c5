"""Float32 beside float64: they agree as far as rounding lets them, and a fault in one of them shows."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from bstcad.pipeline import design
from bstcad.scene.scene import load
from bstcad.tailoring import stage2
from tests.conftest import DISK, SMALL


@pytest.fixture(scope="module")
def found():
    return design(load(DISK, SMALL), device="cpu").precision


def test_the_twins_agree_to_what_single_precision_keeps(found):
    assert found.control_points == 33 and found.evaluations == stage2.COMPARED
    assert 0 < found.merit < 1e-4  # sums of 2^16 tubes, each with some 1e-6 of the lens's size in its corners
    assert 0 < found.gradient < 1e-2
    assert found.rrmsd_float32 == pytest.approx(found.rrmsd_float64, rel=0.2)  # two line searches, equally good
    assert 0 < found.heights < 0.1


def test_a_coarser_arithmetic_shows(monkeypatch, found):
    """Heights rounded to 1e-4 of themselves, as half precision would, in the single one of the twins."""
    call = stage2.Problem.__call__

    def coarse(problem, heights):
        return call(problem, [h.half().float() if h.dtype == torch.float32 else h for h in heights])

    monkeypatch.setattr(stage2.Problem, "__call__", coarse)
    again = design(load(DISK, SMALL), device="cpu").precision
    assert again.gradient > 3 * found.gradient and dataclasses.is_dataclass(again)
