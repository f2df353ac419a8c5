"""The slope that wide light needs, against Snell's law for a point in the middle of a dome."""

from __future__ import annotations

import numpy as np
import pytest

from bstcad.analysis.steepness import MAX_SLOPE_DEG, needed_steepness
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Recess, Sphere
from tests.lenses import net

N, HEIGHT, FAR, PIXELS = 1.5, 15.0, 1e7, 40
HALF = 18.0  # mm, of the points on the flat back: up to 50 degrees along x, 60 in the corners
LENS = Lens.between(
    Recess(Sphere(12.0, -1 / 12), Circle(11.0)),
    net(z=HEIGHT, half=60.0), Circle(28.0), N,
)  # fmt: skip
EVEN = np.ones((PIXELS, PIXELS))


def found(half, at_back=True):
    """All light to a target of that half width (mm), far off, each place to one of the same share of the width."""
    screen = Screen(FAR, (-half, half), (-half, half), PIXELS)
    ends = np.linspace(-1, 1, PIXELS + 1)
    share = np.stack(np.meshgrid(ends, ends, indexing="ij"), axis=-1)
    origins = HALF * share * (1.0 if at_back else 12.0 / HEIGHT)  # the same rays on the plane of the dome's vertex
    x = y = half * ends
    goal = Goal("target", screen, EVEN)
    return share, needed_steepness(PointSource(), LENS, goal, x=x, y=y, origins=origins, at_back=at_back)


@pytest.mark.parametrize("at_back", [True, False])
def test_light_that_is_made_parallel_needs_a_wall(at_back):
    """Light at the angle θ in the glass needs the normal n d - d', which stands at atan2(n sin θ, n cos θ - 1)."""
    share, steep = found(1e-3, at_back)
    inner = share[1:-1, 1:-1]  # on the rim of the light it is not asked
    theta = np.arctan(HALF * np.hypot(*inner.T) / HEIGHT)
    angle = np.degrees(np.arctan2(N * np.sin(theta), N * np.cos(theta) - 1))
    turned = np.cos(theta) > 1 / N  # else it lies beyond what a face turns
    assert steep.steepest == pytest.approx(angle[turned].max(), abs=1e-3) and steep.steepest > 89
    assert steep.share == pytest.approx((angle[turned] > MAX_SLOPE_DEG).mean(), abs=1e-6) and 0.1 < steep.share < 0.9


def test_light_that_goes_straight_on_needs_no_more_than_its_own_angle():
    share, steep = found(FAR * HALF / HEIGHT)
    theta = np.degrees(np.arctan(HALF / HEIGHT * np.hypot(*share[1:-1, 1:-1].T)))
    assert steep.share == 0.0 and steep.steepest == pytest.approx(theta.max(), abs=1e-3)


def test_a_dark_target_needs_nothing():
    screen = Screen(FAR, (-1.0, 1.0), (-1.0, 1.0), PIXELS)
    ends = np.linspace(-1, 1, PIXELS + 1)
    origins = np.zeros((PIXELS + 1, PIXELS + 1, 2))
    none = needed_steepness(PointSource(), LENS, Goal("target", screen, 0 * EVEN), x=ends, y=ends, origins=origins)
    assert none.share == none.steepest == 0.0
