"""4. One ray of 20 000 misses.

A loop that runs until all rays have converged waits for the one that never will: in optiland one miss made the sag of
a grid 20 times slower.  Here Newton's method goes on with the few that have not arrived, by themselves, and a ray that
has left the net ends at once.  The cost is held in points of the surface, which no busy machine changes.
"""

from __future__ import annotations

from dataclasses import replace
from unittest import mock

import pytest
import torch

from bstcad.optics import trace
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.outlines import Rectangle
from bstcad.optics.rays import Rays, Status
from bstcad.optics.sources import Point
from tests.hard_cases.lenses import DTYPES, ENGINES, landing_gradient, lens_of, tracing, wavy
from tests.tracing import stratified

MISS = 7000
Z = 1000.0
WAYS = {  # of the ray that misses, in the glass
    "level": (1.0, 0.3, 1e-4),
    "away": (0.1, 0.0, -1.0),
    "backwards and level": (0.0, -1.0, -1e-9),
    "through a side": (4.0, 0.0, 1.0),
    "no number": (float("nan"), 0.0, 1.0),
}


def twenty_thousand(lens, dtype=torch.float64) -> Rays:
    """In the glass: 142² rays, all of which get through."""
    x, y = (p.reshape(-1) for p in stratified(Rectangle(13.0, 13.0), 142, 0, dtype))
    return trace.to_first_net(Point().rays(x, y, 15.0, 1.0), lens)


def with_miss(rays: Rays, way) -> Rays:
    """The same with one ray's direction changed."""
    direction = rays.direction.clone()
    direction[:, MISS] = torch.nn.functional.normalize(torch.tensor(way, dtype=torch.float64), dim=0)
    return replace(rays, direction=direction)


@DTYPES
@ENGINES
@pytest.mark.parametrize("way", WAYS)
def test_the_answer_is_the_same(way, engine, dtype, holds):
    lens = lens_of(wavy(dtype))
    rays = twenty_thousand(lens, dtype)
    others = torch.arange(rays.flux.numel()) != MISS

    def of_others(landed):
        return landed.position.sum(0) * others

    whole, g_whole = landing_gradient(rays, lens, Z, engine, of_others)
    missing, g = landing_gradient(with_miss(rays, WAYS[way]), lens, Z, engine, of_others)
    assert whole.alive.all() and torch.equal(missing.alive, others)
    assert int(missing.status[MISS]) == Status.VIGNETTED
    assert torch.equal(missing.position[:, others], whole.position[:, others])
    assert torch.equal(g, g_whole)
    off = (missing.position - whole.position)[:, others].abs().max()
    holds("change of the 20 163 other landings", float(off.detach()), 0.0, "mm")


@DTYPES
@pytest.mark.parametrize("way", WAYS)
def test_the_surface_is_not_evaluated_for_all_because_of_one(way, dtype, holds):
    """Points at which sag and slopes are asked for: at most a hundredth more, however long the one ray takes."""
    lens = lens_of(wavy(dtype))
    rays = twenty_thousand(lens, dtype)
    asked = []
    evaluate = BSplineSurface.relative_sag_and_slope

    def counted(surface, x, y):
        asked[-1] += x.numel()
        return evaluate(surface, x, y)

    with mock.patch.object(BSplineSurface, "relative_sag_and_slope", counted), tracing("plain") as through_back:
        for bundle in (rays, with_miss(rays, WAYS[way])):
            asked.append(0)
            through_back(bundle, lens, Z)
    assert asked[0] >= 4 * rays.flux.numel()  # it is Newton's method that was counted
    holds("evaluations with one miss over those without", asked[1] / asked[0], 1.01)
