"""Ghosts: flux by Fresnel's closed form, landing by hand and by rays traced here with numpy, a ledger that closes."""

import math

import numpy as np
import pytest
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.losses import AbsorptionLoss, CoatingLayer, FresnelLoss, Losses, reflectance
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.outlines import EVERYWHERE, Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.measure import Effort, measure
from bstcad.optics.trace.trace import GHOST_OFF, GHOST_ON, ghost, ghost_light, trace_ghost
from tests.lenses import bundle, lens_of, tilted, wavy

EXACT = 1e-12
N = 1.5
WAVELENGTH = 587.6
BARE = Losses(FresnelLoss(WAVELENGTH))


def plate(losses=BARE, index=N, thickness=4.0, outline=EVERYWHERE):
    return Lens.between(Plane(10.0), tilted(0.0, 10.0 + thickness, half=60.0), outline, index, losses=losses)


# --- flux -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", [1.33, 1.5, 1.9])
def test_at_normal_incidence_a_plate_sends_t_r_r_t(index):
    r = ((index - 1) / (index + 1)) ** 2
    out, _ = trace_ghost(bundle((1.0, 2.0, 0.0), (0.0, 0.0, 1.0)), plate(index=index))
    assert float(out.flux) == pytest.approx((1 - r) ** 2 * r * r, rel=EXACT)
    assert bool(out.alive) and out.sense == 1
    # nor is it moved
    assert out.position[0, 0] == 1.0 and out.position[1, 0] == 2.0 and float(out.direction[2]) == 1.0


def test_glass_absorbs_along_three_ways_through_it():
    rays, a, t = bundle((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), 0.02, 4.0
    plates = (plate(Losses(FresnelLoss(WAVELENGTH), glass)) for glass in (None, AbsorptionLoss(a)))
    clear, dim = (trace_ghost(rays, lens)[0] for lens in plates)
    assert float(dim.flux / clear.flux) == pytest.approx(math.exp(-3 * a * t), rel=EXACT)


def test_beyond_the_critical_angle_all_is_reflected():
    """A wedge of 45 degrees turns light by a right angle at its back: R = 1 there, and what leaves is none of it."""
    lens = Lens.between(Plane(0.0), tilted(1.0, 40.0, half=60.0), EVERYWHERE, N, losses=BARE)
    _, down, _, _ = ghost(lens)
    for degrees in (41.9, 45.0, 80.0):
        cos = torch.tensor(math.cos(math.radians(degrees)), dtype=torch.float64)
        assert float(down.losses[-1].share(cos, cos, torch.zeros(()))) == 1.0
    cos = torch.tensor(math.cos(math.radians(41.0)), dtype=torch.float64)  # short of 41.81
    assert 0 < float(down.losses[-1].share(cos, cos, torch.zeros(()))) < 1
    _, total = trace_ghost(bundle((0.0, 0.0, -10.0), (0.0, 0.0, 1.0)), lens)
    assert bool(total)


# --- places -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("front", [Plane(10.0), tilted(0.0, 10.0, half=60.0)], ids=("plane", "spline"))
def test_a_wedge_throws_its_ghost_where_geometry_has_it(front):
    """Angles to the axis in a wedge of angle A: 2 A after the back, 3 A to the back's normal at the exit."""
    wedge, thickness, x0, throw = math.radians(5.0), 4.0, 1.0, 500.0
    slope = -math.tan(wedge)  # the back falls along +x; its normal leans by A towards +x
    lens = Lens.between(front, tilted(slope, 10.0 + thickness, half=60.0), EVERYWHERE, N, losses=BARE)
    out, _ = trace_ghost(bundle((x0, 0.0, 0.0), (0.0, 0.0, 1.0)), lens)
    landed = LevelPlane(throw).to(out)

    z1 = thickness + slope * x0  # over the front
    x2 = x0 - z1 * math.tan(2 * wedge)  # on the front, after the back has turned light towards -x, down by 2 A
    # up again from (x2, 0) at -2 A to the axis: x = x2 - s sin 2A, z = s cos 2A = thickness + slope x
    s = (thickness + slope * x2) / (math.cos(2 * wedge) + slope * math.sin(2 * wedge))
    x3, z3 = x2 - s * math.sin(2 * wedge), s * math.cos(2 * wedge)
    leaves = wedge - math.asin(N * math.sin(3 * wedge))  # to the axis
    x4 = x3 + (throw - 10.0 - z3) * math.tan(leaves)
    assert float(landed.position[0]) == pytest.approx(x4, abs=1e-9)
    assert float(landed.position[1]) == pytest.approx(0.0, abs=1e-12)
    first, *inside = (_reflected(k * wedge) for k in range(4))  # from the glass, but for normal incidence
    assert float(out.flux) == pytest.approx((1 - first) * inside[0] * inside[1] * (1 - inside[2]), rel=1e-9)


def _reflected(angle):
    """R of a bare face that light meets from the glass."""
    cosines = math.cos(angle), math.sqrt(1 - (N * math.sin(angle)) ** 2)
    return float(reflectance(N, 1.0, *(torch.tensor(c, dtype=torch.float64) for c in cosines)))


# --- in a measurement -------------------------------------------------------------------------------------------------

SCREEN = Screen(300.0, (-40.0, 60.0), (-40.0, 40.0), (20, 16))
LOSSES = Losses(FresnelLoss(WAVELENGTH, coating=CoatingLayer(1.38, 60.0)), AbsorptionLoss(0.01))
EFFORT = Effort(160, accuracy=0.0)


def lens_and_channels():
    """Two wavelengths, some light beyond the critical angle."""
    lens = lens_of(wavy(depth=3.0), index=1.6)
    sources = PointSource(half_angle=40.0, profile="uniform"), PointSource(half_angle=35.0, profile="uniform")
    return lens, tuple(Channel(s, n, w, LOSSES) for s, n, w in zip(sources, (1.6, 1.65), (0.3, 0.7), strict=True))


def test_the_ledger_closes_with_the_ghost_in_it():
    lens, channels = lens_and_channels()
    target = np.ones(SCREEN.shape)
    without, within = (measure(lens, channels, SCREEN, target, EFFORT, way) for way in (None, ghost_light))
    assert sum(within.flux.values()) == pytest.approx(1, abs=EXACT)
    assert min(within.flux.values()) >= 0
    assert within.flux[GHOST_ON] > 0 and within.flux[GHOST_OFF] > 0
    moved = [line for line, value in without.flux.items() if within.flux[line] != value]
    assert moved == ["reflected at the faces"] or set(moved) == {"reflected at the faces", "total internal reflection"}
    assert within.ghost.sum() / within.picture.sum() == pytest.approx(
        within.flux[GHOST_ON] / (within.flux[GHOST_ON] + within.flux["on target"]), rel=0.02
    )
    assert within.picture.sum() == pytest.approx(target.sum(), rel=EXACT)


def test_a_plate_lays_its_ghost_over_the_beam():
    """All of a parallel beam comes back to where it fell: T R R T of the light on the target."""
    beam = CollimatedSource(Circle(5.0))
    lens = plate(outline=Rectangle(20.0, 20.0))
    found = ghost_light(lens, (Channel(beam, N, losses=BARE),), Screen(100.0, (-8.0, 8.0), (-8.0, 8.0), 8), 200, 0)
    r = ((N - 1) / (N + 1)) ** 2
    assert found.flux[GHOST_ON] == pytest.approx((1 - r) ** 2 * r * r, rel=1e-3)  # rim of the beam, by 200 rays a side
    assert found.flux[GHOST_OFF] == 0.0 and float(found.picture.sum()) == pytest.approx(found.flux[GHOST_ON], rel=EXACT)
