"""6. Points on a knot, one rounding beside it, in a corner and outside the net.

At a knot the formula changes, and a rounding decides which side is taken: scipy (#20888) gave the last knot to a span
that is not there, NURBS.jl (#9) read past the end of its net.  Here the three formulas of t(u) meet at the knots with
their derivatives, the span is clamped whatever u is, also if it is no number, and a place outside the net is moved to
its rim.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from bstcad.optics.kernels import forward, spline
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces import bspline
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.trace import to_first_net
from tests.hard_cases.lenses import DTYPES, NAMES, eps, largest, tracing
from tests.lenses import uniform

NETS = (5, 6, 7, 33, 513, 2049)
FORMS = [bspline.evaluate, bspline.evaluate_plain]
EVALUATE = pytest.mark.parametrize("evaluate", FORMS, ids=("fused", "plain"))
INF, NAN = math.inf, math.nan


def around_knots(m: int, dtype) -> torch.Tensor:
    """u of every knot and its two neighbours among the floats, (3, m - 1): below, at, above; not clamped."""
    knot = bspline.position(torch.arange(m - 1.0, dtype=torch.float64), m).to(dtype)
    return torch.stack([torch.nextafter(knot, torch.full_like(knot, -INF)), knot,
                        torch.nextafter(knot, torch.full_like(knot, INF))])  # fmt: skip


def net(m: int, dtype) -> torch.Tensor:
    return uniform((m, m), m, -1.0, 1.0).to(dtype)


@DTYPES
@pytest.mark.parametrize("m", NETS)
def test_the_basis_is_one_altogether(m, dtype, holds):
    u = around_knots(m, dtype).clamp(0, m - 1)
    k, weights, slopes = bspline.basis(u, m)
    assert bool(((k >= 0) & (k <= m - 3)).all())
    assert min(float(w.min()) for w in weights) >= 0.0
    # three numbers that are added: one unit; slopes of at most 2, so two
    holds(f"sum of the basis functions, minus 1, {NAMES[dtype]}", largest(sum(weights) - 1), eps(dtype))
    holds(f"sum of the basis functions' derivatives, {NAMES[dtype]}", largest(sum(slopes)), 2 * eps(dtype))
    abscissa = sum((k + i).to(dtype) * w for i, w in enumerate(weights))
    # t is known to the unit of m, and so is what is summed
    figure = f"x computed back from its knot parameter t(x), minus x, relative to the width of the net, {NAMES[dtype]}"
    holds(figure, largest(abscissa - u) / m, 2 * eps(dtype))


@EVALUATE
@DTYPES
@pytest.mark.parametrize("m", NETS)
def test_value_and_slope_go_on_across_every_knot(m, dtype, evaluate, holds):
    """C1: from one float to the next they change by what slope and curvature allow, and by rounding."""
    heights = net(m, dtype)
    u = around_knots(m, dtype).clamp(0, m - 1)
    v = torch.full_like(u, 1.7)
    for places in ((u, v), (v, u), (u, u)):
        h, h_u, h_v = (t.double() for t in evaluate(heights, *places))
        step = (u[1:] - u[:-1]).abs().double()
        # net within ±1: slopes up to 2, second derivatives up to 16 (in the end spans); 8 units of a sum of nine
        for value, rate in ((h, 4.0), (h_u, 32.0), (h_v, 32.0)):
            jump = (value[1:] - value[:-1]).abs() - rate * step
            figure = f"jump of height or slope across a knot, beyond what the curvature explains, {NAMES[dtype]}"
            holds(figure, float(jump.max()), 8 * eps(dtype))


def buried(m: int, dtype) -> torch.Tensor:
    """A net in the middle of a block of no numbers: whatever is read beside it shows."""
    block = torch.full((m * m + 2 * 64 * m,), NAN, dtype=dtype)
    heights = block[64 * m : 64 * m + m * m].view(m, m)
    heights.copy_(net(m, dtype))
    assert heights.is_contiguous()
    return heights


def edges(m: int, dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """Pairs (u, v) of ends, knots beside them, their neighbours, and far outside; (n,) each."""
    line = around_knots(m, dtype)
    line = torch.cat([line[:, :2].reshape(-1), line[:, -2:].reshape(-1)])
    line = torch.cat([line, torch.tensor([-1.0, m, 1e9, -1e9, INF, -INF], dtype=dtype)])
    u, v = torch.meshgrid(line, line, indexing="ij")
    return u.reshape(-1), v.reshape(-1)


@DTYPES
@pytest.mark.parametrize("engine", ["plain", "fused"])
@pytest.mark.parametrize("m", NETS[:-1])
def test_nothing_beside_the_net_is_read_or_written(m, engine, dtype):
    """Surface and adjoint at corners, rims, outside and at infinity: the neighbours in memory are not numbers."""
    heights = buried(m, dtype)
    back = BSplineSurface(20.0, heights, (0.0, m - 1.0), (0.0, m - 1.0))
    u, v = edges(m, dtype)
    rim = (u.clamp(0, m - 1), v.clamp(0, m - 1))
    with tracing(engine):
        values = back.relative_sag_and_slope(u, v)
        expected = bspline.evaluate_plain(net(m, dtype), *rim)
        for a, b in zip(values, expected, strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=16 * eps(dtype))
        leaf = heights.detach().clone().requires_grad_()
        h, h_u, h_v = bspline.evaluate(leaf, *rim)
        (g,) = torch.autograd.grad(h.sum(), leaf, retain_graph=True)
        (g_slopes,) = torch.autograd.grad((h_u + h_v).sum(), leaf)
    # each place adds 1 to the net, and nothing with its slopes; the sum of some hundred numbers in float32
    assert float(g.double().sum()) == pytest.approx(u.numel(), rel=64 * eps(dtype))
    assert abs(float(g_slopes.double().sum())) < 16 * eps(dtype) * u.numel()
    assert torch.isfinite(g).all()


@EVALUATE
@DTYPES
def test_no_number_is_no_number_and_nothing_worse(evaluate, dtype):
    """An index made from it must be in range: neighbours of the net are not touched, other places keep their value."""
    heights = buried(7, dtype)
    u = torch.tensor([0.3, NAN, 5.9, 2.0], dtype=dtype)
    v = torch.tensor([1.0, 2.0, NAN, 6.0], dtype=dtype)
    h, h_u, h_v = evaluate(heights, u, v)
    for t in (h, h_u, h_v):
        assert torch.isnan(t[1:3]).all() and torch.isfinite(t[[0, 3]]).all()
    k = bspline.basis(torch.tensor([NAN, INF, -INF, 1e30, -1e30], dtype=dtype), 7)[0]
    assert bool(((k >= 0) & (k <= 4)).all())


def test_the_forward_kernel_at_knots_and_corners():
    """The kernel's own spline, on a net in glass: fates and landings are the plain form's."""
    m, half = 9, 10.0
    heights = buried(m, torch.float64)
    heights *= 0.2
    lens = Lens.between(
        Plane(8.0), BSplineSurface(20.0, heights, (-half, half), (-half, half)), Rectangle(2 * half, 20.0), 1.5
    )
    at = (around_knots(m, torch.float64) * (2 * half / (m - 1)) - half).reshape(-1)
    line = torch.cat([at, torch.tensor([half + 1e-9, -1e6, 1e6], dtype=torch.float64)])
    x, y = (p.reshape(-1).contiguous() for p in torch.meshgrid(line, line, indexing="ij"))
    source = CollimatedSource(Rectangle(3 * half, 3 * half))
    found = forward.land(source, lens, LevelPlane(120.0), x, y)
    with tracing("plain") as through_back:
        plain = through_back(to_first_net(source.rays_through(x, y, 8.0, 1.0), lens), lens, 120.0)
    lit = plain.flux > 0
    assert torch.equal(found.status[lit], plain.status[lit]) and int(plain.alive.sum()) > 300
    both = plain.alive & lit
    torch.testing.assert_close(
        found.position[:, both], plain.position[:, both], rtol=0, atol=100 * 64 * eps(torch.float64)
    )
    k = [spline.basis(u, m) for u in (0.0, m - 1.0, 1.5, m - 2.5, np.nextafter(1.5, 0), np.nextafter(m - 2.5, m))]
    assert all(0 <= b[0] <= m - 3 for b in k)
