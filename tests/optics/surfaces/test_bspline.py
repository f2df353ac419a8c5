"""The B-spline net against scipy, against its own derivatives, and within its bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline, NdBSpline

from bstcad.optics.surfaces import bspline
from bstcad.optics.surfaces.bspline import Spans, curvature_bounds, principal, slope_bounds, span_points
from tests.lenses import net, rough

NETS = (5, 6, 7, 33, 513)
M = 9
NET = rough(1.0, z=1.0, m=M, half=(2.0, 3.0))
EIGHTHS = tuple(k / 8 for k in range(9))
EVALUATE = pytest.mark.parametrize("evaluate", [bspline.evaluate, bspline.evaluate_plain])


def points(m, n=200, seed=0):
    """u over the whole net: random, the ends, and the first and last knots."""
    t = torch.arange(m - 1.0, dtype=torch.float64)
    t = torch.cat([t[:4], t[-4:]])
    anywhere = torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * (m - 1)
    return torch.cat([anywhere, bspline.position(t, m)])


@pytest.mark.parametrize("m", NETS)
def test_parameter_and_position_are_inverses(m):
    u = torch.cat([points(m), torch.tensor([0.0, 1.5, m - 2.5, m - 1.0], dtype=torch.float64)])
    t = bspline.parameter(u, m)
    assert float(t.min()) >= 0 and float(t.max()) <= m - 2
    torch.testing.assert_close(bspline.position(t, m), u, rtol=0, atol=2e-15 * m)
    torch.testing.assert_close(bspline.parameter(bspline.position(t, m), m), t, rtol=0, atol=2e-15 * m)
    ends = bspline.parameter(torch.tensor([0.0, 1.5, m - 2.5, m - 1.0], dtype=torch.float64), m)
    assert ends.tolist() == [0.0, 1.0, m - 3.0, m - 2.0]


@EVALUATE
@pytest.mark.parametrize("m", NETS)
def test_values_and_slopes_are_scipys(m, evaluate):
    """scipy knows the knots and the net only: x(t) is its spline of the uniform abscissae, slopes by the chain rule."""
    u, v, heights = points(m), points(m).flip(0), rough(1.0, m=m).heights
    knots, t, s = bspline.knots(m), bspline.parameter(u, m).numpy(), bspline.parameter(v, m).numpy()
    abscissa = BSpline(knots, np.arange(float(m)), 2)
    assert np.abs(abscissa(t) - u.numpy()).max() < 1e-15 * m
    reference = NdBSpline((knots, knots), heights.numpy(), 2)
    at = np.stack([t, s], axis=1)
    h, h_u, h_v = (a.numpy() for a in evaluate(heights, u, v))
    # 1e-14 m: heights of order 1, t known to the ulp of m, two derivatives of order 1
    assert np.abs(h - reference(at)).max() < 1e-14 * m
    assert np.abs(h_u - reference(at, nu=(1, 0)) / abscissa(t, 1)).max() < 1e-14 * m
    assert np.abs(h_v - reference(at, nu=(0, 1)) / abscissa(s, 1)).max() < 1e-14 * m


@EVALUATE
def test_gradients_in_heights_and_position_are_finite_differences(evaluate):
    m = 6  # one point in the first, inner and last spans of either axis, none at a knot
    u = torch.tensor([0.2, 1.3, 2.1, 3.2, 3.9, 4.8], dtype=torch.float64, requires_grad=True)
    v = torch.tensor([4.7, 0.3, 2.9, 1.1, 3.8, 0.6], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(evaluate, (rough(1.0, m=m).heights.requires_grad_(), u, v))


@pytest.mark.parametrize("m", (5, 33))
def test_basis_matrix_rows_evaluate_the_net(m):
    u, v, heights = points(m, 20).numpy(), points(m, 15, seed=1).numpy(), rough(1.0, m=m).heights
    value_u, slope_u = bspline.basis_matrix(u, m), bspline.basis_matrix(u, m, 1)
    value_v, slope_v = bspline.basis_matrix(v, m), bspline.basis_matrix(v, m, 1)
    grid = [torch.as_tensor(a.ravel()) for a in np.meshgrid(u, v, indexing="ij")]
    h = heights.numpy()
    products = [value_u @ h @ value_v.T, slope_u @ h @ value_v.T, value_u @ h @ slope_v.T]
    for product, reference in zip(products, bspline.evaluate_plain(heights, *grid), strict=True):
        assert np.abs(product.ravel() - reference.numpy()).max() < 1e-14 * m
    assert value_u.nnz == 3 * len(u)


@pytest.mark.parametrize(("coarse", "fine"), [(5, 6), (9, 33), (33, 129), (7, 64)])
def test_a_finer_net_keeps_planes(coarse, fine):
    assert np.abs(bspline.resample(np.ones(coarse), fine) - 1).max() < 1e-12
    assert np.abs(bspline.resample(np.linspace(-1, 1, coarse), fine) - np.linspace(-1, 1, fine)).max() < 1e-12


def test_a_finer_net_changes_a_smooth_surface_little():
    """One wave over the lens on 33 control points, carried to 129: the knots are not nested, so the jumps of the second
    derivative cannot be kept, and what is left is of the order of the finer pitch."""
    coarse, fine = 33, 129
    line = np.linspace(0, 2 * np.pi, coarse)
    heights = torch.as_tensor(np.sin(line)[:, None] * np.cos(line)[None, :])
    fitted = torch.as_tensor(bspline.resample(bspline.resample(heights.numpy(), fine).T, fine).T)
    at = torch.rand((2, 4000), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    before = bspline.evaluate_plain(heights, *(at * (coarse - 1)))
    after = bspline.evaluate_plain(fitted.contiguous(), *(at * (fine - 1)))
    assert float((after[0] - before[0]).abs().max()) < 1e-4  # of amplitude 1; measured 5e-5, in the end spans
    slope_error = after[1] * (fine - 1) - before[1] * (coarse - 1)
    assert float(slope_error.abs().max()) < 2e-2  # of slopes up to 2 pi; measured 1e-2


def test_beyond_the_net_the_rim_goes_on():
    back = replace(NET, x=(-3.0, 5.0), y=(-10.0, -2.5))
    x = torch.tensor([-1e9, -3.5, 7.0, 1.0], dtype=torch.float64)
    y = torch.tensor([-5.0, -5.0, 1e9, -100.0], dtype=torch.float64)
    rim = back.sag_and_slope(x.clamp(*back.x), y.clamp(*back.y))
    for a, b in zip(back.sag_and_slope(x, y), rim, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_control_points_lie_on_the_stated_grid():
    points = NET.control_points()
    assert points.shape == (M, M, 3)
    assert points[0, 0, :2].tolist() == [-2.0, -3.0] and points[-1, -1, :2].tolist() == [2.0, 3.0]
    assert np.abs(points[..., 2] - 1.0 - NET.heights.numpy()).max() < 4e-15
    assert np.allclose(np.diff(points[:, 2, 0]), NET.pitch[0], rtol=0, atol=1e-14)  # x along the first axis


def all_spans(surface):
    i, j = torch.meshgrid(torch.arange(M - 2), torch.arange(M - 2), indexing="ij")
    return Spans.of(surface, i.flatten(), j.flatten())


def test_a_sphere_is_curved_alike_everywhere():
    r = 5.0
    x, y = torch.meshgrid(*[torch.linspace(-3, 3, 7, dtype=torch.float64)] * 2, indexing="ij")
    q = torch.sqrt(r * r - x * x - y * y)  # z = -q: a valley
    z_xx, z_xy, z_yy = (r * r - y * y) / q**3, x * y / q**3, (r * r - x * x) / q**3
    most, least = principal(x / q, y / q, z_xx, z_xy, z_yy)
    assert float((most - 1 / r).abs().max()) < 1e-7 and float((least - 1 / r).abs().max()) < 1e-7  # a root near zero


def test_the_derivatives_are_those_of_the_surface():
    """Up to the knots, where the second ones jump: a step of 1e-6 mm stays within the span."""
    s, e = (0.2, 0.5, 0.9), 1e-6
    spans = all_spans(NET)
    jet = spans.jet(s)
    x, y = torch.broadcast_tensors(*span_points(NET, spans.i, spans.j, s))
    flat = (x.flatten(), y.flatten())
    _, z_x, z_y = (t.view_as(x) for t in NET.sag_and_slope(*flat))
    assert float((jet.z_x - z_x).abs().max()) < 1e-13 and float((jet.z_y - z_y).abs().max()) < 1e-13
    (_, east, over), (_, west, under) = (NET.sag_and_slope(flat[0] + d, flat[1]) for d in (e, -e))
    (_, _, north), (_, _, south) = (NET.sag_and_slope(flat[0], flat[1] + d) for d in (e, -e))
    for found, wanted in ((jet.z_xx, east - west), (jet.z_xy, over - under), (jet.z_yy, north - south)):
        assert float((found.flatten() - wanted / (2 * e)).abs().max()) < 1e-7  # rounding over the step


def test_no_place_exceeds_the_bounds_of_its_span():
    jet = all_spans(NET).jet(EIGHTHS)
    most, least = (k.view(9, 9, M - 2, M - 2) for k in jet.curvatures)
    for worst, bound in (
        (most.amax((0, 1)), curvature_bounds(NET, 1.0)),
        (-least.amin((0, 1)), curvature_bounds(NET, -1.0)),
        (jet.slope.view(9, 9, M - 2, M - 2).amax((0, 1)), slope_bounds(NET)),
    ):
        assert bool(((worst <= bound + 1e-12) | (worst <= 0)).all())
    for sag in (lambda x, y: 0.05 * x**2, lambda x, y: 0.05 * y**2):
        inner = curvature_bounds(net(sag, half=(2.0, 3.0)), 1.0)[2:-2, 2:-2]
        torch.testing.assert_close(inner, torch.full_like(inner, 0.1), rtol=0, atol=1e-9)


def test_what_spans_add_to_the_net_is_the_transpose_of_what_they_take():
    spans = all_spans(NET)
    seeds = torch.randn(spans.heights.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert float((spans.heights * seeds).sum()) == pytest.approx(
        float((NET.heights * spans.scattered(seeds)).sum()), rel=1e-12
    )
