"""How the cost of each stage grows, held to what its algorithm says, and kernels beside plain torch: `make bench`.

Exponents over a factor of 63 or more of what grows, the last step by itself (where constant parts hide least), and two
ratios; all of them from one run, none in seconds.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import replace
from functools import cache
from unittest import mock

import pytest
import torch

from bstcad.optics import bspline, ops, tubes
from bstcad.optics.irradiance import Screen, collect, collect_plain, landed_flux
from bstcad.optics.kernels import forward
from bstcad.optics.receivers import LevelPlane
from bstcad.optics.trace import from_first_net, to_first_net, trace, window
from bstcad.scene import scene
from tests.benchmarks.growth import SERIES, exponent, last_step, measured
from tests.tracing import from_first_net_plain, launch

pytestmark = pytest.mark.bench
NAMES = {f"{series.stage}, {series.driver}": series for series in SERIES}
MEMORY = 1.15  # of memory, over all that grows: nothing is held for pairs of anything


@cache
def costs(name):
    return measured(NAMES[name])


@pytest.mark.parametrize("name", NAMES)
def test_cpu_seconds_grow_as_the_algorithm_says(name):
    series, found = NAMES[name], costs(name)
    print(f"\n{name}: CPU ~ N^{exponent(found):.2f}, last step {last_step(found):.2f} times linear", end="")
    assert found[-1].number >= 63 * found[0].number
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
    """1025² control points instead of 257², 1024² tubes; from there on the transforms of the net are most of it."""
    few, _, many, _ = costs("evaluation of stage 2, control points")
    print(f"\n1025² over 257² control points: {many.cpu_seconds / few.cpu_seconds:.2f}", end="")
    assert many.cpu_seconds < 2 * few.cpu_seconds


# ---- kernels ---------------------------------------------------------------------------------------------------------


def plain_torch():
    """No fused kernel serves, not even the spline below a plain trace."""
    return mock.patch.object(ops, "ENABLED", False)


def lens_of(wanted, m, dtype=torch.float64):
    """A wavy lens of m x m control points."""
    lens = wanted.flat_lens(m, dtype=dtype)
    u = torch.linspace(-1, 1, m, dtype=torch.float64)
    waves = 0.3 * torch.cos(3 * u)[:, None] * torch.cos(2 * u)
    return replace(lens, back=replace(lens.back, heights=waves.to(dtype)))


def with_gradient(call, leaf):
    """Value and gradient of the sum of what `call` gives."""
    return lambda: torch.autograd.grad(sum(t.sum() for t in call() if t.requires_grad), leaf)


@pytest.mark.parametrize("name", ["thu", "portrait"])
def test_the_fused_kernels_are_faster_than_plain_torch(name):
    """Medians are printed; what is asserted are ratios."""
    wanted = scene.load(f"templates/{name}.toml")
    lens = lens_of(wanted, 257)
    rays = to_first_net(launch(wanted.source, lens, 1024, 0), lens)
    landed = from_first_net(rays, lens, LevelPlane(1000.0))
    screen = Screen(1000.0, wanted.target.x, wanted.target.y, 512)
    u, v = torch.rand((2, 1 << 20), dtype=torch.float64) * 256
    sheet = tubes.launch_tubes(wanted.source, lens, 256)
    landing = sheet.landing(lens, LevelPlane(1000.0)).position
    low, high = landing.amin((1, 2), keepdim=True), landing.amax((1, 2), keepdim=True)
    corners = 512 * (landing - low) / (high - low)  # all of them on the screen
    n = 1 << 20
    x, y = (p.reshape(-1).contiguous() for p in tubes.corners(window(wanted.source, lens), 1023))
    leaf = corners.clone().requires_grad_()
    pairs = {
        "evaluate": (
            lambda: bspline.evaluate(lens.back.heights, u, v),
            lambda: bspline.evaluate_plain(lens.back.heights, u, v),
            n,
        ),
        "from_first_net": (
            lambda: from_first_net(rays, lens, LevelPlane(1000.0)),
            lambda: from_first_net_plain(rays, lens, LevelPlane(1000.0)),
            rays.flux.numel(),
        ),
        "forward.land": (
            lambda: forward.land(wanted.source, lens, LevelPlane(1000.0), x, y),
            lambda: trace(wanted.source.rays(x, y, lens.front.z, 1.0), lens, LevelPlane(1000.0)), n,
        ),
        "collect (rays)": (
            lambda: collect(landed, screen), lambda: collect_plain(landed.position, landed_flux(landed), screen),
            rays.flux.numel(),
        ),
        "collect (tubes)": (
            lambda: tubes.collect(corners, sheet.flux, (512, 512)),
            lambda: tubes.collect_plain(corners, sheet.flux, (512, 512)), sheet.flux.numel(),
        ),
        "collect (tubes) with its adjoint": (
            with_gradient(lambda: tubes.collect(leaf, sheet.flux, (512, 512)), leaf),
            with_gradient(lambda: tubes.collect_plain(leaf, sheet.flux, (512, 512)), leaf), sheet.flux.numel(),
        ),
    }  # fmt: skip
    for kernel, (fused, plain, count) in pairs.items():
        quick = median_seconds(fused)
        with plain_torch():
            slow = median_seconds(plain)
        print(f"\n{name} {kernel}: {count / quick / 1e6:.0f} million/s, plain / fused = {slow / quick:.1f}", end="")
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
