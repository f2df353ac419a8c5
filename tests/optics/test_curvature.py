"""Slope and curvature of a net: against those of known surfaces, and no place exceeds what bounds its span."""

from __future__ import annotations

import pytest
import torch

from bstcad.optics.bspline import BSplineSurface, Spans, curvature_bounds, principal, slope_bounds, span_places

M = 9
EIGHTHS = tuple(k / 8 for k in range(9))


@pytest.fixture
def rough():
    heights = torch.randn(M, M, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return BSplineSurface(1.0, heights, (-2.0, 2.0), (-3.0, 3.0))


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


def test_the_derivatives_are_those_of_the_surface(rough):
    """Up to the knots, where the second ones jump: a step of 1e-6 mm stays within the span."""
    s, e = (0.2, 0.5, 0.9), 1e-6
    spans = all_spans(rough)
    jet = spans.jet(s)
    x, y = torch.broadcast_tensors(*span_places(rough, spans.i, spans.j, s))
    flat = (x.flatten(), y.flatten())
    _, z_x, z_y = (t.view_as(x) for t in rough.sag_and_slope(*flat))
    assert float((jet.z_x - z_x).abs().max()) < 1e-13 and float((jet.z_y - z_y).abs().max()) < 1e-13
    (_, east, over), (_, west, under) = (rough.sag_and_slope(flat[0] + d, flat[1]) for d in (e, -e))
    (_, _, north), (_, _, south) = (rough.sag_and_slope(flat[0], flat[1] + d) for d in (e, -e))
    for found, wanted in ((jet.z_xx, east - west), (jet.z_xy, over - under), (jet.z_yy, north - south)):
        assert float((found.flatten() - wanted / (2 * e)).abs().max()) < 1e-7  # rounding over the step


def test_no_place_exceeds_the_bounds_of_its_span(rough):
    jet = all_spans(rough).jet(EIGHTHS)
    most, least = (k.view(9, 9, M - 2, M - 2) for k in jet.curvatures)
    for worst, bound in (
        (most.amax((0, 1)), curvature_bounds(rough, 1.0)),
        (-least.amin((0, 1)), curvature_bounds(rough, -1.0)),
        (jet.slope.view(9, 9, M - 2, M - 2).amax((0, 1)), slope_bounds(rough)),
    ):
        assert bool(((worst <= bound + 1e-12) | (worst <= 0)).all())


def test_what_spans_add_to_the_net_is_the_transpose_of_what_they_take(rough):
    spans = all_spans(rough)
    seeds = torch.randn(spans.heights.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert float((spans.heights * seeds).sum()) == pytest.approx(
        float((rough.heights * spans.scattered(seeds)).sum()), rel=1e-12
    )
