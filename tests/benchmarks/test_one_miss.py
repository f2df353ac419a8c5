"""One ray of 20 000 misses: what it costs in time, run by `make bench` (tests/hard_cases/test_04_one_miss.py)."""

import gc
import statistics
import time
from dataclasses import replace

import pytest
import torch

from tests.hard_cases.lenses import lens_of, tracing, wavy
from tests.hard_cases.test_04_one_miss import WAYS, Z, twenty_thousand, with_miss

pytestmark = pytest.mark.bench

RUNS = 61
MORE = 1.1  # the time with the miss over that without


def ratio(calls) -> float:
    """Median over runs of the second's time over the first's, taken in turn so that both see the same machine."""
    for call in calls:
        call()
    ratios = []
    gc.disable()
    try:
        for run in range(RUNS):
            spent = [0.0, 0.0]
            for which in (0, 1) if run % 2 else (1, 0):
                before = time.process_time()
                calls[which]()
                spent[which] = time.process_time() - before
            ratios.append(spent[1] / spent[0])
    finally:
        gc.enable()
    return statistics.median(ratios)


@pytest.mark.parametrize("way", ["level", "away", "through a side"])
@pytest.mark.parametrize("engine", ["plain", "mixed", "fused"])
@pytest.mark.parametrize("gradient", [False, True], ids=("forward", "with gradient"))
def test_one_miss_costs_a_tenth_at_most(gradient, engine, way):
    lens = lens_of(wavy(m=65))
    rays = twenty_thousand(lens)
    missing = with_miss(rays, WAYS[way])
    threads = torch.get_num_threads()
    with tracing(engine) as through_back:

        def call(bundle):
            heights = lens.back.heights.clone().requires_grad_(gradient)
            landed = through_back(bundle, replace(lens, back=replace(lens.back, heights=heights)), Z)
            if gradient:
                torch.autograd.grad(torch.where(landed.alive, landed.position.sum(0), 0.0).sum(), heights)

        try:
            torch.set_num_threads(1)
            found = ratio([lambda: call(rays), lambda: call(missing)])
        finally:
            torch.set_num_threads(threads)
    print(f"\n{engine}, {way}: {found:.3f} times", end="")
    assert found <= MORE
