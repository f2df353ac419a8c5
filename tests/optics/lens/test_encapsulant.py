"""A lamp in its encapsulant: Snell's law from another medium than air, with the losses and the ghost at the front."""

import math
from dataclasses import replace

import pytest
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.losses import FresnelLoss, Losses, reflectance
from bstcad.optics.lens.passes import LENS
from bstcad.optics.light.point import PointSource
from bstcad.optics.light.sphere_light import SphereLight
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.outlines import EVERYWHERE, Circle
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace import trace
from tests.lenses import bundle, lens_of, net, wavy

N = 1.49
BARE = Losses(FresnelLoss(550.0))
LAMP = PointSource((0.2, 0.0, 0.0), profile="lambertian", half_angle=60.0)
SCREEN = Screen(60.0, (-40.0, 40.0), (-40.0, 40.0), 24)


def immersed(index_before, front=None, back=None, **more):
    """Return a lens between a medium of this index and air."""
    lens = lens_of(back or wavy(depth=1.0, half=20.0), front or Plane(4.0), EVERYWHERE, N, **more)
    return replace(lens, passes=replace(LENS, index_before=index_before))


@pytest.mark.parametrize("degrees", [0.0, 10.0, 39.0])
def test_a_plate_sends_light_out_at_the_angle_of_its_first_medium(degrees):
    """n_e sin θ_e = n sin θ = sin θ': the plate moves the ray, and its index does not change the angle outside."""
    n_e, gap, thick, behind = 1.41, 4.0, 6.0, 30.0
    sin_e = math.sin(math.radians(degrees))
    tangents = [math.tan(math.asin(sin_e * n_e / n)) for n in (n_e, N, 1.0)]
    lens = immersed(n_e, Plane(gap), net(z=gap + thick, half=60.0))
    ray = bundle((0.0, 0.0, 0.0), (sin_e, 0.0, math.sqrt(1 - sin_e**2)))
    landed = trace.trace(ray, lens, LevelPlane(gap + thick + behind))
    expected = sum(t * d for t, d in zip(tangents, (gap, thick, behind), strict=True))
    assert float(landed.position[0]) == pytest.approx(expected, abs=1e-12)


def test_a_front_in_its_own_index_is_invisible():
    """Neither its form nor its place matters, and it reflects nothing."""
    images = [
        trace.simulate_plain([(1.0, LAMP, immersed(N, front, losses=BARE), 3)], [SCREEN], 40)[0]
        for front in (Plane(4.0), Plane(9.0), Sphere(8.0, -0.1))
    ]
    for other in images[1:]:  # one window for all, since each launches its rays through its own vertex
        assert other.flux["on target"] == pytest.approx(images[0].flux["on target"], abs=3e-3)
    front, _ = immersed(N, losses=BARE).interfaces
    cos = torch.linspace(0.05, 1, 20, dtype=torch.float64)
    assert torch.equal(front.losses[-1].share(cos, cos, cos), torch.ones_like(cos))
    rays = LAMP.rays_through(*(torch.linspace(-3, 3, 50, dtype=torch.float64) for _ in "xy"), 2.0, 1.0)
    landed = [trace.trace(rays, immersed(N, f), SCREEN.receiver).position for f in (Plane(4.0), Sphere(8.0, -0.1))]
    torch.testing.assert_close(landed[0], landed[1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("index_before", [1.33, N, 1.8])
def test_the_ghost_leaves_into_air_after_a_reflection_at_the_front(index_before):
    """The flux at normal incidence is T_1 R_2 R_1 T_2, R_1 between medium and glass, R_2 between glass and air."""
    r_1, r_2 = (((a - N) / (a + N)) ** 2 for a in (index_before, 1.0))
    lens = immersed(index_before, back=net(half=60.0), losses=BARE)
    out, _ = trace.trace_ghost(bundle((1.0, 2.0, 0.0), (0.0, 0.0, 1.0)), lens)
    assert float(out.flux) == pytest.approx((1 - r_1) * r_2 * r_1 * (1 - r_2), rel=1e-12)


@pytest.mark.parametrize("index_before", [1.33, N, 1.8])
@pytest.mark.parametrize("face", ["heights", "dome"])
def test_the_kernels_agree_with_plain_torch(index_before, face):
    """Light beyond 56 degrees in a medium of 1.8 is totally reflected at the front, which then has no other loss."""
    if face == "heights":
        lens, light = immersed(index_before, Sphere(4.0, 0.01), losses=BARE), LAMP
    else:
        back = RadialSurface.sphere(0.0, 15.0, (17.0, 17.0), (17, 17))
        rim = Circle(back.chart.length(math.radians(70.0)))
        passes = replace(LENS, index_before=index_before)
        lens = Lens.between(Plane(4.0), back, rim, N, losses=BARE, clear=(Circle(14.0), rim), passes=passes)
        light = SphereLight.of(LAMP, 0.0, back.chart, half_angle=math.radians(70.0))
    lights = [(1.0, light, lens, 3)]
    fused, plain = (simulate(lights, [SCREEN], 64)[0] for simulate in (trace.simulate, trace.simulate_plain))
    torch.testing.assert_close(fused.box, plain.box, rtol=0, atol=1e-6 * float(plain.box.max()))
    assert fused.flux == pytest.approx(plain.flux, abs=1e-6)
    if face == "dome":  # no light meets the back at a large angle
        assert (plain.flux[trace.TOTAL_REFLECTION] > 0.01) == (index_before == 1.8)


def test_fresnel_losses_are_those_between_medium_and_glass():
    front, back = immersed(1.41, losses=BARE).interfaces
    cos = torch.tensor([1.0, 0.7], dtype=torch.float64)
    refracted = torch.sqrt(1 - (1.41 / N) ** 2 * (1 - cos * cos))
    torch.testing.assert_close(front.losses[-1].share(cos, refracted, cos), 1 - reflectance(1.41, N, cos, refracted))
    assert (back.law.n_in, back.law.n_out) == (N, 1.0)
