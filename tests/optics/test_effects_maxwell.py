"""Fresnel's equations against Maxwell's boundary conditions, solved here as linear equations for the fields."""

import math

import numpy as np
import pytest
import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.interfaces import Interface, Refract, cross
from bstcad.optics.losses import Coating, Transmission, coated_reflectance, reflectance
from bstcad.optics.outlines import EVERYWHERE
from bstcad.optics.rays import Status
from tests.hard_cases.lenses import bundle

EXACT = 1e-12
N = 1.52
AIR_TO_GLASS, GLASS_TO_AIR = (1.0, N), (N, 1.0)
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


def cosines(n_in, n_out, angle):
    cos_in = math.cos(angle)
    cos_out = math.sqrt(1 - (n_in / n_out * math.sin(angle)) ** 2)
    return torch.tensor(cos_in, dtype=torch.float64), torch.tensor(cos_out, dtype=torch.float64)


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
        at, coating = cosines(*media, angle), Coating(index, thickness)
        wanted_r, wanted_t = by_maxwell((media[0], index, media[1]), angle, polarisation, thickness)
        assert wanted_r + wanted_t == pytest.approx(1, abs=EXACT)
        through = Transmission(*media, 587.6, polarisation, coating)
        found = coated_reflectance(*media, *at, coating, 587.6, polarisation)
        assert float(found) == pytest.approx(wanted_r, abs=EXACT)
        assert float(through.share(*at, NOWHERE)) == pytest.approx(wanted_t, abs=EXACT)


def tilted(slope):
    """A plane through the origin whose height grows by `slope` per mm along x."""
    x = torch.linspace(-60.0, 60.0, 9, dtype=torch.float64)
    return BSplineSurface(0.0, (slope * x)[:, None].expand(9, 9).contiguous(), (-60.0, 60.0), (-60.0, 60.0))


def test_towards_the_critical_angle_the_flux_falls_to_nothing_and_its_gradient_stays_finite():
    """A face turned up to the critical angle and beyond, met along the axis: T = O(sqrt(angle short of it))."""
    law, critical = Refract(N, 1.0), math.asin(1 / N)
    for off in (-1e-2, -1e-4, -1e-8, -1e-12, 0.0, 1e-12, 1e-3):
        face = tilted(math.tan(critical + off))
        heights = face.heights.requires_grad_(True)
        interface = Interface(face, EVERYWHERE, law, Status.VIGNETTED, (Transmission(N, 1.0, 587.6),))
        rays = cross(bundle((0.1, 0.2, -50.0), (0.0, 0.0, 1.0)), interface).rays
        flux = torch.where(rays.alive, rays.flux, torch.zeros_like(rays.flux)).sum()
        (gradient,) = torch.autograd.grad(flux, heights)
        assert bool(torch.isfinite(gradient).all())
        assert float(flux.detach()) <= 20 * math.sqrt(max(-off, 1e-12))
        assert bool(rays.alive) == (off < 0) or abs(off) <= 1e-12  # where rounding decides
