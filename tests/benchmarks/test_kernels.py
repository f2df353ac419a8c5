"""The kernels against their references in one run: run by `make bench`.

Medians are printed; what is asserted are ratios, never seconds.
"""

import statistics
import time
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import scipy.fft
import scipy.interpolate
import torch

from bstcad.optics import bspline, tubes
from bstcad.optics.irradiance import Screen, collect, collect_plain, landed_flux
from bstcad.optics.kernels import compiling, forward
from bstcad.optics.trace import from_first_net, to_first_net, trace, window
from bstcad.scene import scene
from bstcad.transport.bfm import Poisson
from bstcad.transport.density import threads, threads_for
from tests.tracing import from_first_net_plain, launch

pytestmark = pytest.mark.bench


def plain_torch():
    """No fused kernel serves, not even the spline below a plain trace."""
    return mock.patch.object(compiling, "ENABLED", False)


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
def test_the_fused_kernels_against_plain_torch(name):
    wanted = scene.load(f"templates/{name}.toml")
    lens = lens_of(wanted, 257)
    rays = to_first_net(launch(wanted.source, lens, 1024, 0), lens)
    landed = from_first_net(rays, lens, 1000.0)
    screen = Screen(1000.0, wanted.target.x, wanted.target.y, 512)
    u, v = torch.rand((2, 1 << 20), dtype=torch.float64) * 256
    sheet = tubes.launch_tubes(wanted.source, lens, 256)
    landing = sheet.landing(lens, 1000.0).position
    low, high = landing.amin((1, 2), keepdim=True), landing.amax((1, 2), keepdim=True)
    corners = 512 * (landing - low) / (high - low)  # all of them on the screen
    n = 1 << 20
    leaf = corners.clone().requires_grad_()
    pairs = {
        "evaluate": (
            lambda: bspline.evaluate(lens.back.heights, u, v),
            lambda: bspline.evaluate_plain(lens.back.heights, u, v),
            n,
        ),
        "from_first_net": (
            lambda: from_first_net(rays, lens, 1000.0),
            lambda: from_first_net_plain(rays, lens, 1000.0),
            rays.flux.numel(),
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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_spline_against_scipy(dtype):
    """Value and both slopes at a million points of a 513 net, and the same with the gradient in the net."""
    m, n = 513, 1 << 20
    heights = torch.rand((m, m), dtype=dtype)
    u, v = torch.rand((2, n), dtype=dtype).sort(dim=1).values * (m - 1)  # ordered, as rays are
    knots = bspline.knots(m)
    net = scipy.interpolate.NdBSpline((knots, knots), heights.double().numpy(), 2)
    t = np.stack([u.double().numpy(), v.double().numpy()], axis=1)[: n // 16].clip(0, m - 2.001)
    ours = median_seconds(lambda: bspline.evaluate(heights, u, v)) / n
    theirs = median_seconds(lambda: [net(t, nu=nu) for nu in ((0, 0), (1, 0), (0, 1))], 3) / len(t)
    leaf = heights.clone().requires_grad_()
    both = median_seconds(with_gradient(lambda: bspline.evaluate(leaf, u, v), leaf)) / n
    print(
        f"\n{dtype}: {1e-6 / ours:.0f} Mpoint/s, with the adjoint {1e-6 / both:.0f}; scipy {1e-6 / theirs:.2f}", end=""
    )
    assert theirs > 5 * ours


@pytest.mark.parametrize("name", ["thu", "portrait"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_forward_trace_of_a_513_net(name, dtype):
    wanted = scene.load(f"templates/{name}.toml")
    lens = lens_of(wanted, 513, dtype)
    area, n = window(wanted.source, lens), 2048
    x, y = (p.reshape(-1).contiguous() for p in tubes.corners(area, n - 1))
    fused = median_seconds(lambda: forward.land(wanted.source, lens, 1000.0, x, y))
    rays = wanted.source.rays(x[: 1 << 20].to(dtype), y[: 1 << 20].to(dtype), lens.front.z, 1.0)
    with plain_torch():
        eager = median_seconds(lambda: trace(rays, lens, 1000.0), 3) * n * n / (1 << 20)
    print(f"\n{name}, {dtype}: {n * n / fused / 1e6:.0f} Mray/s, {eager / fused:.1f} times plain torch", end="")
    assert eager > fused


def test_one_cosine_series_and_an_elimination_beat_two_series():
    """Poisson's equation on 1024 x 1024 cells."""
    n = 1024
    r, poisson, workers = np.random.default_rng(0).normal(size=(n, n)), Poisson(n), threads_for(n)

    def two_series():
        return scipy.fft.idctn(scipy.fft.dctn(r, workers=workers), workers=workers, overwrite_x=True)

    with threads(n):
        ratio = median_seconds(two_series) / median_seconds(lambda: poisson.solve(r))
    print(f"\nPoisson at {n}²: two cosine series / one with elimination = {ratio:.1f}", end="")
    assert ratio > 1.2


def median_seconds(call, runs=5):
    """Median over runs, after one that compiles and warms the caches."""
    call()
    spent = []
    for _ in range(runs):
        before = time.perf_counter()
        call()
        spent.append(time.perf_counter() - before)
    return statistics.median(spent)
