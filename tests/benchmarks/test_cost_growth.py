"""How the cost of each stage grows, held to what its algorithm says: run by `make bench`, two minutes.

Exponents over a factor of 64 or more of what grows, the last step by itself (where constant parts hide least), and two
ratios; all of them from one run, none in seconds.
"""

from __future__ import annotations

from functools import cache

import pytest

from tests.benchmarks.growth import PARTS, SERIES, exponent, last_step, measured

pytestmark = pytest.mark.bench
NAMES = {f"{series.stage}, {series.driver}": series for series in (*SERIES, *PARTS)}
MEMORY = 1.15  # of memory, over all that grows: nothing is held for pairs of anything


@cache
def costs(name):
    return measured(NAMES[name])


@pytest.mark.parametrize("name", NAMES)
def test_cpu_seconds_grow_as_the_algorithm_says(name):
    series, found = NAMES[name], costs(name)
    print(f"\n{name}: CPU ~ N^{exponent(found):.2f}, last step {last_step(found):.2f} times linear", end="")
    assert found[-1].number >= 64 * found[0].number
    least, most = series.expected
    assert least <= exponent(found) <= most
    assert last_step(found) <= series.most


@pytest.mark.parametrize("name", NAMES)
def test_memory_grows_no_faster_than_what_grows(name):
    found = costs(name)
    grows = exponent(found[1:], "memory_mb")  # a first size may bring what all need
    if grows is None:
        pytest.skip("this system does not tell what a process holds")
    print(f"\n{name}: memory ~ N^{grows:.2f}", end="")
    assert grows <= MEMORY


def test_many_channels_cost_hardly_more_than_one_of_as_many_tubes():
    """64 sheets of 256² tubes and one of 2048²; the former has fewer tubes a pixel, and so cuts more of each."""
    many, one = (costs(f"evaluation of stage 2, {what}")[-1].cpu_seconds for what in ("channels", "ray tubes"))
    print(f"\n64 channels over one of as many tubes: {many / one:.2f}", end="")
    assert many < 3 * one


def test_an_evaluation_hardly_feels_the_net():
    """1025² control points instead of 65², 1024² tubes."""
    found = costs("evaluation of stage 2, control points")
    print(f"\n1025² over 65² control points: {found[-1].cpu_seconds / found[0].cpu_seconds:.2f}", end="")
    assert found[-1].cpu_seconds < 2 * found[0].cpu_seconds
