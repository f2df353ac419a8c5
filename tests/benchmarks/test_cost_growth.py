"""Growth of each stage's cost, held to its algorithm, and kernels beside plain torch: `make bench`.

Exponents over a factor of 63 or more of what grows, the last step by itself (where constant parts hide least), and two
ratios; all of them from one run, none in seconds.
"""

from __future__ import annotations

import statistics
import time
from functools import cache
from unittest import mock

import pytest
import torch

from bstcad.optics.numerics import kernel_choice
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces import bspline
from bstcad.optics.trace import tubes
from bstcad.optics.trace.trace import from_first_net, to_first_net
from bstcad.scene import scene
from tests.benchmarks.growth import SERIES, exponent, last_step, measured
from tests.lenses import net
from tests.tracing import from_first_net_plain, launch

pytestmark = pytest.mark.bench
NAMES = {f"{series.stage}, {series.driver}": series for series in SERIES}
MEMORY = 1.15  # largest exponent of memory, over all that grows: nothing is held for pairs of anything


@cache
def costs(name):
    return measured(NAMES[name])


@pytest.mark.parametrize("name", NAMES)
def test_seconds_grow_as_the_algorithm_says_and_memory_no_faster_than_what_grows(name):
    series, found = NAMES[name], costs(name)
    grows = exponent(found[1:], "memory_mb")  # a first size may bring what all need; None where no system tells it
    print(
        f"\n{name}: CPU ~ N^{exponent(found):.2f}, last step {last_step(found):.2f} times linear, memory ~ N^{grows}",
        end="",
    )
    assert found[-1].number >= 63 * found[0].number
    least, most = series.expected
    assert least <= exponent(found) <= most
    assert last_step(found) <= series.most and (grows is None or grows <= MEMORY)


def test_many_channels_cost_hardly_more_than_one_of_as_many_tubes():
    """64 sheets of 256² tubes and one of 2048²; the former has fewer tubes a pixel, and so cuts more of each."""
    many, one = (costs(f"evaluation of stage 2, {what}")[-1].cpu_seconds for what in ("channels", "flux tubes"))
    print(f"\n64 channels over one of as many tubes: {many / one:.2f}", end="")
    assert many < 3 * one


# ---- kernels ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["thu", "portrait"])
def test_the_fused_kernels_are_faster_than_plain_torch(name):
    """Medians are printed; what is asserted are ratios."""
    wanted, plane = scene.load(f"templates/{name}.toml"), LevelPlane(1000.0)
    lens = wanted.flat_lens(257).with_heights(
        [net(lambda x, y: 0.3 * torch.cos(x / 4) * torch.cos(y / 5), m=257).heights]
    )
    rays = to_first_net(launch(wanted.source, lens, 1024, 0), lens)
    u, v = torch.rand((2, 1 << 20), dtype=torch.float64) * 256
    sheet = tubes.launch_tubes(wanted.source, lens, 256)
    landing = sheet.landing(lens, plane).position
    low, high = landing.amin((1, 2), keepdim=True), landing.amax((1, 2), keepdim=True)
    leaf = (512 * (landing - low) / (high - low)).requires_grad_()  # all of them on the screen

    def collected(form):
        return torch.autograd.grad(sum(t.sum() for t in form(leaf, sheet.flux, (512, 512))), leaf)

    pairs = {
        "evaluate": (
            lambda: bspline.evaluate(lens.back.heights, u, v), lambda: bspline.evaluate_plain(lens.back.heights, u, v)
        ),
        "from_first_net": (
            lambda: from_first_net(rays, lens, plane), lambda: from_first_net_plain(rays, lens, plane)
        ),
        "collect with its adjoint": (lambda: collected(tubes.collect), lambda: collected(tubes.collect_plain)),
    }  # fmt: skip
    for kernel, (fused, plain) in pairs.items():
        quick = median_seconds(fused)
        with mock.patch.object(kernel_choice, "ENABLED", False):  # no fused kernel, not even the spline
            slow = median_seconds(plain)
        print(f"\n{name} {kernel}: plain / fused = {slow / quick:.1f}", end="")
        assert slow > 1.5 * quick


def median_seconds(call, runs=5):
    """Median over runs, after one that compiles and warms the caches."""
    call()
    spent = []
    for _ in range(runs):
        before = time.perf_counter()
        call()
        spent.append(time.perf_counter() - before)
    return statistics.median(spent)
