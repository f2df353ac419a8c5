"""A prism, from two interfaces: least deviation, and what that measures of a glass."""

import math

import pytest
import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.interfaces import cross
from bstcad.optics.lens import Lens
from bstcad.optics.media import refractive_index
from bstcad.optics.outlines import EVERYWHERE
from tests.hard_cases.lenses import bundle

APEX = math.radians(40.0)
LINES = {"F": 486.1327, "d": 587.5618, "C": 656.2725}  # nm
GOLDEN = (math.sqrt(5) - 1) / 2


def face(z, slope, half=90.0):
    """A plane through (0, 0, z) whose height grows by `slope` per mm along x."""
    x = torch.linspace(-half, half, 9, dtype=torch.float64)
    return BSplineSurface(z, (slope * x)[:, None].expand(9, 9).contiguous(), (-half, half), (-half, half))


def deviation(index, angle):
    """Angle (rad) by which a prism whose edge points along +x turns light that meets it `angle` below its normal."""
    prism = Lens(face(0.0, math.tan(APEX / 2)), face(60.0, -math.tan(APEX / 2)), EVERYWHERE, index)
    turn = angle - APEX / 2  # the first face's normal leans by APEX / 2 towards -x
    direction = (math.sin(turn), 0.0, math.cos(turn))
    rays = bundle((-30.0 * math.tan(turn), 0.0, -30.0), direction)
    for interface in prism.interfaces:
        rays = cross(rays, interface).rays
    assert bool(rays.alive)
    x, _, z = (float(p) for p in rays.direction)
    return abs(math.atan2(x, z) - turn)


def least(index):
    """(least deviation over the angle of incidence, that angle), rad, by golden section."""
    even = math.asin(index * math.sin(APEX / 2))
    low, high = even - 0.3, even + 0.4  # on either side of what is to be found
    while high - low > 1e-7:
        a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        low, high = (low, b) if deviation(index, a) < deviation(index, b) else (a, high)
    return deviation(index, (low + high) / 2), (low + high) / 2


def measured(glass, line):
    """n = sin((A + D) / 2) / sin(A / 2), Fraunhofer's way."""
    found, _ = least(refractive_index(glass, LINES[line]))
    return math.sin((APEX + found) / 2) / math.sin(APEX / 2)


@pytest.mark.parametrize("line", LINES)
def test_a_prism_deviates_least_where_light_passes_it_evenly(line):
    index = refractive_index("N-BK7", LINES[line])
    found, angle = least(index)
    assert measured("N-BK7", line) == pytest.approx(index, abs=1e-11)
    assert angle == pytest.approx((APEX + found) / 2, abs=1e-6)  # rad; a minimum is flat
    for other in (angle - 0.1, angle + 0.1):
        assert deviation(index, other) > found + 1e-4


@pytest.mark.parametrize(("glass", "abbe"), [("N-BK7", 64.17), ("N-SF11", 25.68)])
def test_three_prisms_measure_the_abbe_number(glass, abbe):
    """V = (n_d - 1) / (n_F - n_C), as in Schott's data sheets."""
    n = {line: measured(glass, line) for line in LINES}
    assert (n["d"] - 1) / (n["F"] - n["C"]) == pytest.approx(abbe, abs=0.01)
