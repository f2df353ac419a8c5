"""1. One missed, totally reflected or outside ray in a batch.

A mask after a root or a division hides a value, not its derivative: 0 times infinity is not a number, and one lost ray
makes the whole gradient so (pytorch #187297, optiland #304, Ciela-Institute/caustics #83).  Here what a lost ray is
computed from is replaced *before* each root, division and table, and only then masked; nothing is summed over rays but
what they add to control points and pixels, and a lost ray adds exact zeros there.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bstcad.optics import sampling, trace
from bstcad.optics.irradiance import Screen, collect
from bstcad.optics.outlines import Rectangle
from bstcad.optics.rays import Rays, Status
from bstcad.optics.sources import Point
from bstcad.optics.surfaces import Sphere
from tests.hard_cases.lenses import DTYPES, ENGINES, bundle, lens_of, tracing, wavy

NAN, INF = float("nan"), float("inf")
BAD = {  # a ray before the lens, and what becomes of it
    "misses the front": ((0.0, 0.0, 0.0), (3.0, 0.0, 1.0), Status.MISSED_FRONT),
    "misses the sphere": ((60.0, 0.0, 0.0), (0.05, 0.0, 1.0), Status.MISSED_FRONT),
    "starts behind the front": ((0.0, 0.0, 40.0), (0.0, 0.1, 1.0), Status.MISSED_FRONT),
    "goes away": ((0.0, 0.0, 5.0), (0.1, 0.2, -1.0), Status.MISSED_FRONT),
    "runs parallel to the front": ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), Status.MISSED_FRONT),
    "leaves through a side": ((0.0, 0.0, 10.0), (1.95, 0.0, 1.0), Status.VIGNETTED),
    "is totally reflected": ((2.0, 0.0, 14.0), (2.2, 0.0, 1.0), Status.TOTAL_REFLECTION),
    "has no direction": ((0.0, 0.0, 0.0), (NAN, 0.0, 1.0), Status.MISSED_FRONT),
    "comes from nowhere": ((INF, 0.0, 0.0), (0.0, 0.1, 1.0), Status.MISSED_FRONT),
}
Z = 200.0


def good(dtype) -> Rays:
    """143 rays: an odd number, so that one more leaves each of two threads what it had."""
    x, y = (p.reshape(-1)[:143] for p in sampling.stratified(Rectangle(12.0, 12.0), 12, 0, dtype))
    return Point().rays(x, y, 15.0, 1.0)


def with_ray(rays: Rays, other: Rays, place: int) -> Rays:
    """The bundle with one more ray at a place; both count from z = 0."""

    def put(name: str) -> torch.Tensor:
        a, b = getattr(rays, name), getattr(other, name)
        return torch.cat([a[..., :place], b, a[..., place:]], dim=-1)

    return replace(rays, **{name: put(name) for name in ("position", "direction", "flux", "status")})


def traced(rays: Rays, engine: str):
    """(landed, gradients in the heights, in the front's curvature, in positions and directions)."""
    dtype = rays.flux.dtype
    heights = wavy(dtype, depth=2.0).heights.requires_grad_()
    lens = lens_of(replace(wavy(dtype), heights=heights))
    if engine == "fused":  # its gradient is that of the net
        with tracing(engine) as through_back:
            landed = through_back(trace.to_first_free(rays, lens), lens, Z)
        merit = torch.where(landed.alive, landed.position.square().sum(0), 0.0).sum()
        return landed, torch.autograd.grad(merit, heights)[0], None, ()
    curvature = torch.tensor(-0.02, dtype=dtype, requires_grad=True)
    lens = replace(lens, front=Sphere(15.0, curvature))
    place, way = (t.detach().clone().requires_grad_() for t in (rays.position, rays.direction))
    with tracing(engine) as through_back:
        landed = through_back(trace.to_first_free(replace(rays, position=place, direction=way), lens), lens, Z)
        merit = torch.where(landed.alive, landed.position.square().sum(0), 0.0).sum()
        g_heights, g_curvature, *g_rays = torch.autograd.grad(merit, (heights, curvature, place, way))
    return landed, g_heights, g_curvature, g_rays


def changed(pairs) -> float:
    """Largest difference of two results that should be the same to the bit."""
    return max(float((a - b).detach().abs().max()) for a, b in pairs)


@DTYPES
@ENGINES
@pytest.mark.parametrize("bad", BAD)
def test_all_others_land_and_pull_as_without_it(bad, engine, dtype, holds):
    """Landings and each ray's own gradient, wherever the lost ray stands; the net's gradient with it at the end."""
    start, way, reason = BAD[bad]
    rays, lost = good(dtype), bundle(start, way, dtype)
    without, g_net, _, g_own = traced(rays, engine)
    assert without.alive.all() and torch.isfinite(g_net).all()
    for place in (143, 0, 70):
        landed, h_net, h_curvature, h_own = traced(with_ray(rays, lost, place), engine)
        others = torch.arange(144) != place
        assert int(landed.status[place]) == reason and landed.alive[others].all()
        pairs = [(landed.position[:, others], without.position)]
        pairs += [(h[:, others], g) for h, g in zip(h_own, g_own, strict=True)]
        assert all(torch.equal(a, b) for a, b in pairs)
        assert torch.isfinite(h_net).all() and (h_curvature is None or bool(torch.isfinite(h_curvature)))
        if place == 143:  # elsewhere the sums run in another order
            pairs.append((h_net, g_net))
            assert torch.equal(h_net, g_net)
        for h in h_own:
            assert bad in ("has no direction", "comes from nowhere") or not h[:, place].any()
        holds("change of any other ray's landing or gradient", changed(pairs), 0.0)


@DTYPES
def test_a_lost_ray_lights_no_pixel(dtype):
    """Its landing may be anything: neither picture nor gradient of the others knows of it."""
    screen = Screen(Z, (-100.0, 100.0), (-100.0, 100.0), 12)
    lens = lens_of(wavy(dtype))
    landed = trace.trace(good(dtype), lens, Z)
    results = []
    for value in (0.0, INF, NAN, 1e30):
        status, position = landed.status.clone(), landed.position.detach().clone()
        status[40], position[:, 40] = int(Status.TOTAL_REFLECTION), value
        position.requires_grad_()
        picture, outside = collect(replace(landed, position=position, status=status), screen)
        (g,) = torch.autograd.grad((picture**2).sum() + outside, position)
        results.append((picture.detach(), outside.detach(), g))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
