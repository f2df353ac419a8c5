"""The fused path from a lamp inside a dome to the receiver, and the search for rays, against plain torch."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bstcad.optics.lens.interfaces import Interface
from bstcad.optics.lens.losses import AbsorptionLoss, FresnelLoss, Losses
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.point import PointSource
from bstcad.optics.light.sphere_light import SphereLight
from bstcad.optics.numerics import kernel_choice
from bstcad.optics.receivers.directions import Directions
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.charts import SphereChart
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Conic, Plane, Sphere, Surface
from bstcad.optics.trace import trace, tubes
from bstcad.optics.trace.source_images import landing_pixels
from tests.lenses import lens_of
from tests.optics.kernels.test_dome import INDEX, OUTLINE, R, Z, dome

HALF_SPACE = math.pi / 2
LAMPS = {
    "lambertian": PointSource((0.0, 0.0, Z)),
    "beside the axis": PointSource((0.7, -0.4, Z + 0.5)),
    "cone": PointSource((0.2, 0.1, Z), profile="uniform", half_angle=60.0),
    "diode": PointSource((0.0, 0.0, Z), profile="gaussian", half_angle_1e2=(30.0, 12.0), rotate=20.0),
}
FRONTS: dict[str, Surface] = {
    "plane": Plane(Z + 1.5),
    "concentric": Sphere(Z + 8.0, -0.125),
    "sphere": Sphere(Z + 7.0, -0.1),
    "conic": Conic(Z + 9.0, -0.2, -0.4),
}
PAIRS = [("lambertian", front) for front in FRONTS] + [(lamp, "plane") for lamp in LAMPS if lamp != "lambertian"]
SCREENS = {"plane": Screen(200.0, (-300.0, 300.0), (-200.0, 200.0), (30, 20)), "angles": None}


def scene(lamp: str, front: str) -> tuple[SphereLight, trace.Lens]:
    """A lamp and a wavy dome about (0, 0, Z)."""
    light = SphereLight.of(LAMPS[lamp], Z, dome().chart, half_angle=HALF_SPACE)
    lens = lens_of(dome(m=33, ripple=0.1), FRONTS[front], OUTLINE, INDEX)
    first, last = lens.interfaces
    assert isinstance(first, Interface) and last.surface.kind == "radial"
    return light, lens


@pytest.mark.parametrize(("lamp", "front"), PAIRS)
def test_a_simulation_is_that_of_the_plain_form(lamp, front):
    light, lens = scene(lamp, front)
    losses = Losses(FresnelLoss(587.6), AbsorptionLoss(0.01))
    for each, share in ((lens, 1e-12), (replace(lens, losses=losses), 1e-7)):  # losses at faces come from a table
        screens = [SCREENS["plane"]]
        lights = [(0.25, light, each, 3), (0.75, light, each, 4)]
        [ours] = trace.simulate(lights, screens, 96)
        [plain] = trace.simulate_plain(lights, screens, 96)
        assert trace.whole_kernel("trace.simulate", light, each, screens[0].receiver) is not None
        assert ours.rays == pytest.approx(plain.rays, rel=1e-3)  # a flux of 1e-308 may be zero
        assert ours.flux["on target"] > 0.3
        for one, other in ((ours.box, plain.box), (ours.tent, plain.tent)):
            torch.testing.assert_close(one, other, rtol=0, atol=share * float(other.sum()))
        for line in ours.flux.keys() | plain.flux.keys():
            assert ours.flux.get(line, 0.0) == pytest.approx(plain.flux.get(line, 0.0), abs=10 * share)


@pytest.mark.parametrize(("lamp", "front"), PAIRS)
def test_single_rays_are_those_of_the_plain_form(lamp, front):
    light, lens = scene(lamp, front)
    x, y = (p.reshape(-1) for p in tubes.corners(Circle(2.0 * R), 24))
    for plane in (SCREENS["plane"].receiver, Directions("B")):
        land = trace.whole_kernel("trace.land", light, lens, plane)
        assert land is not None
        ours = land(light, lens, plane, x=x, y=y)
        plain = trace.trace(light.rays_through(x, y, lens.entrance.z, 1.0), lens, plane)
        lit = plain.flux > 0
        assert torch.equal(ours.status[lit], plain.status[lit]) and int((ours.alive & lit).sum()) > 100
        torch.testing.assert_close(ours.flux, plain.flux, rtol=1e-11, atol=1e-14)
        there = lit & plain.alive
        error = (ours.position - plain.position).abs()[:, there] / (1 + plain.position.abs())[:, there]
        assert float(error.max()) < 1e-9


@pytest.mark.parametrize(("lamp", "front"), PAIRS)
def test_the_search_finds_the_rays_that_meet_given_points(lamp, front):
    """Each ray is launched again and traced to the dome, where it meets its point."""
    light, lens = scene(lamp, front)
    x, y = tubes.corners(Circle(2 * R * math.tan(math.radians(50.0) / 2)), 60)
    p, q, rays = tubes.rays_to(light, lens, x, y)
    assert bool(rays.alive.all())
    coming = trace.to_first_net(light.rays_through(p, q, lens.entrance.z, 1.0), lens.unbounded())
    way = rays.position - torch.stack([*coming.position[:2], coming.above(Z)])
    torch.testing.assert_close(
        torch.linalg.cross(way, coming.direction, dim=0), torch.zeros_like(way), rtol=0, atol=1e-8
    )
    torch.testing.assert_close(rays.direction, coming.direction, rtol=0, atol=1e-8)


def test_the_search_is_that_of_the_plain_form(monkeypatch):
    """A dome that is read from a file has another R than the light, which is launched from the sphere of the scene."""
    light, lens = scene("beside the axis", "sphere")
    light = replace(light, chart=SphereChart(0.8 * R))
    x, y = tubes.corners(Circle(R), 20)
    ours = tubes.rays_to(light, lens, x, y)
    monkeypatch.setattr(kernel_choice, "front_kernel", lambda name, *given: None)
    plain = tubes.rays_to(light, lens, x, y)
    assert torch.equal(ours[2].status, plain[2].status) and torch.equal(ours[2].position, plain[2].position)
    for one, other in ((ours[0], plain[0]), (ours[1], plain[1]), (ours[2].direction, plain[2].direction)):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-8)


@pytest.mark.parametrize(("lamp", "front"), [("beside the axis", "plane"), ("lambertian", "concentric")])
def test_images_of_a_source_carry_the_light_that_leaves_the_dome(lamp, front):
    """Each cell of the back is traced from before the dome, inside the front's aperture as the rays cross it."""
    light, lens = scene(lamp, front)
    _, flux = landing_pixels([Channel(light, INDEX)], lens, SCREENS["plane"], 40)
    [whole] = trace.simulate([(1.0, light, lens, 1)], [SCREENS["plane"]], 128)
    assert float(flux.sum()) == pytest.approx(whole.flux["on target"] + whole.flux["off target"], abs=0.03)
