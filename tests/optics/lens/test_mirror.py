"""Mirrors: the law of reflection, foci, light that comes along -z; kernels against the plain form."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bstcad.optics.lens.interfaces import Interface, Reflect, Refract, cross
from bstcad.optics.lens.passes import MIRROR
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.outlines import EVERYWHERE, Circle
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.surfaces import Conic, Plane, Sphere
from bstcad.optics.trace.trace import from_first_net, to_first_net, trace
from bstcad.optics.trace.tubes import launch_tubes, picture, rays_to
from tests.by_slope import deflect
from tests.lenses import bundle, lens_of, net
from tests.tracing import from_first_net_plain, simulated

M, HALF, Z = 41, 10.0, 5.0
PITCH = 2 * HALF / (M - 1)
LIGHTS = {
    "parallel": CollimatedSource(Circle(8.0), z=90.0),
    "point": PointSource((3.0, -2.0, 70.0), profile="uniform", half_angle=6.0),
    "lambertian": PointSource((-4.0, 1.0, 40.0)),
    "parallel, tilted": CollimatedSource(Circle(8.0), z=90.0, tilt=(3.0, 10.0), centre=(15.0, -3.0)),
    "gaussian, tilted": PointSource((3.0, -2.0, 70.0), profile="gaussian", half_angle_1e2=10.0, tilt=(-5.0, 8.0)),
}


def mirror(back):
    return lens_of(back, Plane(0.0), passes=MIRROR)


def paraboloid(c):
    """z = c r² / 2 as a net: exact but in the end spans, since the blossom of u² at (i - 1/2, i + 1/2) is i² - 1/4."""
    i = torch.arange(M, dtype=torch.float64) - (M - 1) / 2
    along = (i * i - 0.25) * PITCH**2
    return net((c / 2) * (along[:, None] + along), Z)


def bumpy(sign=1.0, z=Z):
    return net(lambda x, y: sign * 0.4 * torch.cos(0.3 * x + 1) * torch.sin(0.4 * y + 2), z, M)


def beam(direction, sense):
    """Rays through places around the origin in one direction, on their way along sense · z."""
    x = torch.linspace(-3, 3, 7, dtype=torch.float64)
    rays = bundle(torch.stack([x, 0.3 * x, torch.zeros_like(x)]).T, direction)
    return replace(rays, position=rays.position - 20 * rays.direction, sense=sense)


def test_a_paraboloid_gathers_parallel_light_in_its_focus():
    """R = 1 / c, f = R / 2 above the vertex, for rays that meet the inner spans of the net."""
    c = 1 / 80.0
    x = torch.linspace(-8.5, 8.5, 35, dtype=torch.float64)
    x, y = (p.reshape(-1) for p in torch.meshgrid(x, x, indexing="ij"))
    rays = CollimatedSource(Circle(20.0), z=200.0).rays_through(x, y, Z, 1.0)
    for land in (from_first_net, from_first_net_plain):
        found = land(rays, mirror(paraboloid(c)), LevelPlane(Z + 1 / (2 * c)))
        assert found.alive.all() and float(found.position.abs().max()) < 1e-9


@pytest.mark.parametrize("conic_constant", [-0.4, 0.0])
def test_an_ellipsoid_takes_light_from_one_focus_to_the_other(conic_constant):
    """Foci of a conic of revolution lie R / (1 ± e) from the vertex, e² = -k; a sphere has both in its centre."""
    radius, e = 50.0, math.sqrt(-conic_constant)
    near, far = Z + radius / (1 + e), Z + radius / (1 - e)
    x = torch.linspace(-9, 9, 13, dtype=torch.float64)
    x, y = (p.reshape(-1) for p in torch.meshgrid(x, x, indexing="ij"))
    face = Interface(Conic(Z, 1 / radius, conic_constant), EVERYWHERE, Reflect(), Status.MISSED_FRONT)
    hit = cross(PointSource((0.0, 0.0, near)).rays_through(x, y, Z, 1.0), face)
    landed = LevelPlane(far).to(hit.rays)
    assert landed.alive.all() and float(landed.position[:2].abs().max()) < 1e-9


@pytest.mark.parametrize("sense", [1, -1])
def test_reflection_keeps_the_angle_and_the_plane_of_incidence(sense):
    slopes = torch.tensor(0.3, dtype=torch.float64), torch.tensor(-0.2, dtype=torch.float64)
    rays = beam((0.2, -0.4, 1.0 * sense), sense)
    hit = deflect(rays, *(s.expand(7) for s in slopes), Reflect())
    normal = torch.tensor([-0.3, 0.2, 1.0], dtype=torch.float64)
    normal = normal / normal.norm()
    before, after = rays.direction[:, 0], hit.rays.direction[:, 0]
    assert hit.rays.sense == -sense and torch.allclose(hit.cos_in, hit.cos_out)
    assert float(after @ normal) == pytest.approx(-float(before @ normal), abs=1e-15)
    torch.testing.assert_close(torch.linalg.cross(before, normal), torch.linalg.cross(after, normal))
    assert float(after.norm()) == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize("law", [Reflect(), Refract(1.5, 1.0), Refract(1.0, 1.5)])
@pytest.mark.parametrize("surface", [Plane(2.0), Sphere(2.0, 0.02), Conic(2.0, -0.03, -0.5), "net"])
def test_light_downwards_is_light_upwards_seen_in_a_mirror(law, surface):
    """Turn the scene over (z -> -z): every place and direction turns over with it."""
    if surface == "net":
        upright, over = (bumpy(sign, sign * 2.0) for sign in (1, -1))
    else:
        upright = surface
        over = surface.with_parameters(**{n: -v if n == "curvature" else v for n, v in surface.parameters().items()})
        over = over.moved(-surface.z)
    up, down = beam((0.1, 0.2, 1.0), 1), beam((0.1, 0.2, -1.0), -1)
    flip = torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)[:, None]
    above, below = (
        cross(rays, Interface(face, EVERYWHERE, law, Status.VIGNETTED)) for rays, face in ((up, upright), (down, over))
    )
    assert above.rays.alive.all() and torch.equal(above.rays.status, below.rays.status)
    torch.testing.assert_close(above.rays.position * flip, below.rays.position, rtol=0, atol=1e-12)
    torch.testing.assert_close(above.rays.direction * flip, below.rays.direction, rtol=0, atol=1e-14)
    torch.testing.assert_close(above.cos_out, below.cos_out)


@pytest.mark.parametrize("light", LIGHTS)
def test_tubes_hold_the_light_that_rays_carry(light):
    """The fused picture and the corners, traced one by one, agree; the screen takes all of the light."""
    scene = LIGHTS[light], mirror(bumpy()), Screen(120.0, (-900.0, 900.0), (-900.0, 900.0), 8)
    rays = simulated(*scene, 800, 1)
    for found in (picture(*scene, 160), launch_tubes(*scene[:2], 160).picture(*scene[1:])):
        assert float(found.sum()) == pytest.approx(rays.flux["on target"], rel=2e-3)


@pytest.mark.parametrize("light", LIGHTS)
def test_the_rays_to_points_of_the_mirror_meet_them(light):
    source, lens = LIGHTS[light], mirror(bumpy())
    x = torch.linspace(-6, 6, 21, dtype=torch.float64)
    x, y = torch.meshgrid(x, x, indexing="ij")
    p, q, coming = rays_to(source, lens, x, y)
    hit = cross(source.rays_through(p, q, Z, 1.0), lens.interfaces[0]).rays
    torch.testing.assert_close(hit.position[:2], torch.stack([x, y]), rtol=0, atol=1e-6)
    assert coming.sense == -1 and bool((coming.direction[2] < 0).all())


def test_light_from_below_does_not_pass_for_light_from_above():
    """The rear of the mirror is dark: a ray that comes up to the face meets it from behind."""
    rays = beam((0.0, 0.1, 1.0), 1)
    wrong = trace(replace(rays, sense=-1), mirror(bumpy()), LevelPlane(120.0))
    assert not wrong.alive.any()
    assert to_first_net(rays, mirror(bumpy())) is rays  # nothing stands before a mirror
