"""Losses of flux along rays: Fresnel against Maxwell's boundary conditions, energy that adds up, gradients."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.optics.lens import losses as effects
from bstcad.optics.lens.interfaces import Interface, Refract, cross
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.losses import (
    AbsorptionLoss,
    CoatingLayer,
    FresnelLoss,
    Losses,
    Transmission,
    coated_reflectance,
    reflectance,
)
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.outlines import EVERYWHERE, Circle, Rectangle
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace import trace
from bstcad.tailoring.merit import Merit
from bstcad.tailoring.stage2 import Problem
from tests.lenses import bundle, rough, tilted
from tests.tracing import simulated

N = 1.5168
WAVELENGTH = 587.6
BARE = Losses(FresnelLoss(WAVELENGTH), None)
ALL = Losses(FresnelLoss(WAVELENGTH, coating=CoatingLayer(1.38, 100.0)), AbsorptionLoss(0.02))
SCREEN = Screen(120.0, (-6.0, 6.0), (-6.0, 6.0), 16)


def cosines(n_in, n_out, angle):
    """(cos θ, cos θ') of an angle of incidence (rad)."""
    theta = torch.tensor(angle, dtype=torch.float64)
    return torch.cos(theta), torch.sqrt(1 - (n_in / n_out * torch.sin(theta)) ** 2)


@pytest.mark.parametrize("kind", ("s", "p"))
def test_a_metal_reflects_what_complex_amplitudes_say(kind):
    index = 0.96 + 6.69j  # aluminium at 550 nm, roughly
    for degrees in (0.0, 30.0, 60.0, 85.0, 89.99):
        theta = math.radians(degrees)
        c, q = math.cos(theta), np.sqrt(index**2 - math.sin(theta) ** 2)
        r = (c - q) / (c + q) if kind == "s" else (index**2 * c - q) / (index**2 * c + q)
        found = effects.metal_reflectance(index, torch.tensor(c, dtype=torch.float64), kind)
        assert float(found) == pytest.approx(abs(r) ** 2, rel=1e-12)


def rough_lens(m=13, heights=0.15, losses=ALL, front=None):
    back = rough(heights, z=14.0, m=m, half=5.5)
    return Lens.between(front or Sphere(8.0, -0.02), back, Rectangle(9.0, 9.0), N, losses=losses)


SOURCES = (CollimatedSource(Circle(4.0)), PointSource((0.2, -0.1, 0.0), profile="lambertian"))


@pytest.mark.parametrize("source", SOURCES, ids=("collimated", "point"))
def test_the_ledger_closes_over_reflected_absorbed_and_transmitted_light(source):
    found = simulated(source, rough_lens(), SCREEN, 200, 0)
    assert sum(found.flux.values()) == pytest.approx(1.0, abs=1e-12)
    assert found.flux[effects.REFLECTED] > 0 and found.flux[effects.ABSORBED] > 0


@pytest.mark.parametrize("degrees", (0.0, 25.0, 50.0))
def test_a_plate_takes_by_beer_lambert_and_by_fresnel(degrees):
    """One ray through a plate of 6 mm: T² exp(-a 6 / cos θ')."""
    distance = 8.0 / math.cos(math.radians(degrees))
    source = PointSource((0.0, -math.sin(math.radians(degrees)) * distance, 0.0))
    flat = rough_lens(heights=0.0, front=Plane(8.0), losses=Losses(FresnelLoss(WAVELENGTH), AbsorptionLoss(0.02)))
    origin = torch.zeros(1, dtype=torch.float64)
    rays = source.rays_through(origin, origin, 8.0, 1.0)
    landed = trace.trace(rays, replace(flat, outline=Circle(100.0)), LevelPlane(SCREEN.z))
    cos_in, cos_out = cosines(1.0, N, math.radians(degrees))
    t = 1 - effects.reflectance(1.0, N, cos_in, cos_out)
    expected = t * t * torch.exp(-0.02 * 6.0 / cos_out)
    assert float(landed.flux / rays.flux) == pytest.approx(float(expected), rel=1e-12)
    total = landed.flux + landed.taken[effects.REFLECTED] + landed.taken[effects.ABSORBED]
    assert float(total / rays.flux) == pytest.approx(1.0, rel=1e-14)


@pytest.mark.parametrize("source", SOURCES, ids=("collimated", "point"))
@pytest.mark.parametrize("losses", (BARE, ALL, Losses(None, AbsorptionLoss(0.02))), ids=("bare", "all", "absorption"))
def test_the_gradient_of_the_merit_is_that_of_differences_losses_and_all(source, losses):
    """A small net, in a random direction: no part of an effect's own gradient is left out."""
    lens = rough_lens(m=9, heights=0.05, losses=None)
    channel = Channel(source, N, losses=losses)
    goal = Goal("target", SCREEN, np.random.default_rng(1).random(SCREEN.shape) + 0.5)
    merit = Merit.of((channel,), lens, 60, [goal], 0.03)
    problem = Problem(lens, merit)
    heights = lens.back.heights
    way = torch.randn(heights.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    _, (gradient,), _ = problem([heights])
    step = 1e-6
    up, down = (problem([heights + sign * step * way])[0] for sign in (1, -1))
    assert float((gradient * way).sum()) == pytest.approx((up - down) / (2 * step), rel=1e-5)


def test_what_is_lost_on_the_way_is_counted_whole_and_without_gradient():
    """A ray that misses keeps its flux, and the others' gradients stay finite."""
    lens = rough_lens()
    lens = lens.with_back(replace(lens.back, heights=lens.back.heights.clone().requires_grad_()))
    x = torch.tensor([0.0, 40.0], dtype=torch.float64)
    rays = SOURCES[1].rays_through(x, torch.zeros(2, dtype=torch.float64), 8.0, 1.0)
    landed = trace.trace(rays, lens, LevelPlane(SCREEN.z))
    assert not bool(landed.alive[1]) and float(landed.flux[1].detach()) == float(rays.flux[1])
    (gradient,) = torch.autograd.grad(landed.flux.sum() + landed.position.sum(), lens.back.heights)
    assert bool(torch.isfinite(gradient).all()) and float(gradient.abs().max()) > 0
    assert float(landed.flux[1].detach()) == pytest.approx(float(rays.flux[1]))


EXACT = 1e-12
N_TOO = 1.52
AIR_TO_GLASS, GLASS_TO_AIR = (1.0, N_TOO), (N_TOO, 1.0)
BOTH_WAYS = pytest.mark.parametrize("media", [AIR_TO_GLASS, GLASS_TO_AIR], ids=("into glass", "out of glass"))
ANGLES = np.radians([0.0, 10.0, 30.0, 41.0, 56.0, 75.0, 88.0])
NOWHERE = torch.zeros(())  # the path does not matter


def by_maxwell(indices, angle, polarisation, thickness=0.0, wavelength=587.6):
    """(R, T) of a stack of two or three media met at `angle` (rad) in the first, a single layer `thickness` nm thick.

    Fields a e^{ikz} + b e^{-ikz} in each medium, their tangential E and H continuous at each boundary: for s
    E = a + b and H = n cos θ (a - b), for p E = cos θ (a + b) and H = n (a - b).  Nothing comes from behind.
    """
    n = np.asarray(indices, dtype=complex)
    cos = np.sqrt(1 - (n[0] * np.sin(angle) / n) ** 2)
    e, h = (np.ones_like(n), n * cos) if polarisation == "s" else (cos, n)
    k = 2 * np.pi * n * cos / wavelength
    boundaries = [0.0] if len(n) == 2 else [0.0, thickness]
    unknowns = 2 * len(n) - 2  # b of the first, both of those between, a of the last
    matrix, right = np.zeros((unknowns, unknowns), complex), np.zeros(unknowns, complex)
    for i, z in enumerate(boundaries):
        for medium, sign in ((i, 1), (i + 1, -1)):
            forth, back = (np.exp(s * 1j * k[medium] * (z - boundaries[max(medium - 1, 0)])) for s in (1, -1))
            column_forth, column_back = 2 * medium - 1, 2 * medium
            for row, (plus, minus) in ((2 * i, (e, e)), (2 * i + 1, (h, -h))):
                if medium == 0:
                    right[row] -= sign * plus[0] * forth
                else:
                    matrix[row, column_forth] += sign * plus[medium] * forth
                if medium < len(n) - 1:
                    matrix[row, column_back] += sign * minus[medium] * back
    found = np.linalg.solve(matrix, right)
    flux = (e * np.conj(h)).real
    return abs(found[0]) ** 2, float(flux[-1] / flux[0]) * abs(found[-1]) ** 2


def passing(n_in, n_out):
    """The angles at which light goes through."""
    return [angle for angle in ANGLES if n_in * math.sin(angle) < n_out]


@pytest.mark.parametrize("polarisation", ["s", "p"])
@BOTH_WAYS
def test_a_bare_face_reflects_and_transmits_what_maxwell_says(media, polarisation):
    """R and T each by the fields: that they sum to 1 is a law then, and no matter of definition."""
    for angle in passing(*media):
        at = cosines(*media, angle)
        wanted_r, wanted_t = by_maxwell(media, angle, polarisation)
        assert wanted_r + wanted_t == pytest.approx(1, abs=EXACT)
        assert float(reflectance(*media, *at, polarisation)) == pytest.approx(wanted_r, abs=EXACT)
        assert float(Transmission(*media, 587.6, polarisation).share(*at, NOWHERE)) == pytest.approx(
            wanted_t, abs=EXACT
        )


@pytest.mark.parametrize("polarisation", ["s", "p"])
@BOTH_WAYS
@pytest.mark.parametrize("thickness", [0.0, 30.0, 106.0, 250.0, 1000.0])
@pytest.mark.parametrize("index", [1.05, 1.38, 2.3])
def test_a_coated_face_reflects_and_transmits_what_maxwell_says(media, polarisation, thickness, index):
    for angle in passing(*media):
        at, coating = cosines(*media, angle), CoatingLayer(index, thickness)
        wanted_r, wanted_t = by_maxwell((media[0], index, media[1]), angle, polarisation, thickness)
        assert wanted_r + wanted_t == pytest.approx(1, abs=EXACT)
        through = Transmission(*media, 587.6, polarisation, coating)
        assert float(coated_reflectance(through, coating, *at)) == pytest.approx(wanted_r, abs=EXACT)
        assert float(through.share(*at, NOWHERE)) == pytest.approx(wanted_t, abs=EXACT)


def test_towards_the_critical_angle_the_flux_falls_to_nothing_and_its_gradient_stays_finite():
    """A face turned up to the critical angle and beyond, met along the axis: T = O(sqrt(angle short of it))."""
    law, critical = Refract(N_TOO, 1.0), math.asin(1 / N_TOO)
    for off in (-1e-2, -1e-4, -1e-8, -1e-12, 0.0, 1e-12, 1e-3):
        face = tilted(math.tan(critical + off), z=0.0)
        heights = face.heights.requires_grad_(True)
        interface = Interface(face, EVERYWHERE, law, Status.VIGNETTED, (Transmission(N_TOO, 1.0, 587.6),))
        rays = cross(bundle((0.1, 0.2, -50.0), (0.0, 0.0, 1.0)), interface).rays
        flux = torch.where(rays.alive, rays.flux, torch.zeros_like(rays.flux)).sum()
        (gradient,) = torch.autograd.grad(flux, heights)
        assert bool(torch.isfinite(gradient).all())
        assert float(flux.detach()) <= 20 * math.sqrt(max(-off, 1e-12))
        assert bool(rays.alive) == (off < 0) or abs(off) <= 1e-12  # where rounding decides
