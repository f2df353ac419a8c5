"""A Gaussian beam to an even disc between plane waves: the referee by itself, and both its faces as bstcad traces them.

Fused silica, 633 nm, 1/e² radius 5 mm, cut at 7.5 mm: 1.1 % of the whole beam is lost there.  Behind it the rays crowd
at the rim of the disc, where light of the last 0.5 mm of the front lands on 0.03 mm.  There the back bends by 4 /mm,
which no net of 513 x 513 points resolves.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.channels import Channel
from bstcad.optics.collimated import Collimated
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.measure import tubes_picture
from bstcad.optics.outlines import Circle
from bstcad.optics.receivers import LevelPlane
from bstcad.optics.surfaces import Surface
from bstcad.optics.trace import across, trace
from tests.optics.beam_shaper import BeamShaper

WAVELENGTH = 633e-6  # mm
SILICA = BeamShaper(5.0, 7.5, 6.0, 1.457, 20.0)
SHAPERS = {"fused silica": SILICA, "PMMA": replace(SILICA, index=1.4887), "smaller": replace(SILICA, disc=3.5)}
BEAM = Collimated(Circle(SILICA.aperture), 633.0, profile="gaussian", radius_1e2=SILICA.radius_1e2)
BEHIND = (100.0, 300.0)  # mm, of the screens
MARGIN = 0.1  # mm, of the faces beyond the light
PIXELS, HALF, RIM = 256, 6.5, 0.3  # of a screen, its half width (mm), how near to the disc's rim no pixel counts (mm)


@pytest.mark.parametrize("name", SHAPERS)
def test_the_referee_keeps_its_laws(name):
    assert max(SHAPERS[name].errors(np.linspace(1e-3, SILICA.aperture, 2000))) < 1e-12


@pytest.mark.parametrize("name", SHAPERS)
def test_both_of_its_faces_are_the_integrals_of_their_slopes(name):
    """Of the back, which is found by the path, this says that its normal is that of Snell's law."""
    shaper = SHAPERS[name]
    for face, radii in ((shaper.front, (1.0, 5.0, 7.5)), (shaper.back, (0.2, 0.9, 1.0))):
        for r in np.array(radii) * (shaper.disc if face == shaper.back else 1.0):
            rise, _ = quad(lambda p, face=face: face(p)[1], 0, r, epsabs=1e-13, epsrel=1e-13, limit=500)
            assert float(face(r)[0] - face(0.0)[0]) == pytest.approx(rise, abs=1e-12)


@pytest.mark.parametrize("name", SHAPERS)
def test_the_disc_is_lit_evenly(name):
    """E r dr = const · R dR, and all of the light gets there."""
    shaper, r, step = SHAPERS[name], np.linspace(0.5, 7.0, 50), 1e-5
    even = np.exp(-2 * (r / 5) ** 2) * r / shaper.lands_at(r)
    even *= 2 * step / (shaper.lands_at(r + step) - shaper.lands_at(r - step))
    np.testing.assert_allclose(even, even[0], rtol=1e-6)  # central differences over 1e-5
    assert shaper.lands_at(shaper.aperture) == pytest.approx(shaper.disc, abs=1e-14)
    np.testing.assert_allclose(shaper.comes_from(shaper.lands_at(r)), r, atol=1e-12)
    assert shaper.lost == pytest.approx(0.0111, abs=1e-4)


def test_a_lens_too_thin_is_refused():
    with pytest.raises(ValueError, match="take a thicker lens"):
        replace(SILICA, thickness=3.0)


# ---- as bstcad traces it ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Revolved(Surface):
    """z(r) of a profile: r (mm) -> (z, dz/dr), arrays of one shape."""

    z: float
    profile: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    kind: str = "revolved"

    def relative_sag_and_slope(self, x, y):
        r = torch.hypot(x, y).numpy()
        few, at = np.unique(r.round(13), return_inverse=True)  # a square grid has each radius eight times
        sag, slope = (torch.from_numpy(p[at].reshape(r.shape)) for p in self.profile(few))
        over_r = slope / torch.from_numpy(r).clamp_min(1e-9)
        return sag - self.z, over_r * x, over_r * y

    def crossing(self, x, y, direction, sense=1):
        """(s in mm, met): by Newton's method from the plane z0; faces here are gentle, and all rays meet them."""
        (dx, dy, dz), s = direction, torch.zeros_like(x)
        for _ in range(8):
            h, z_x, z_y = self.relative_sag_and_slope(x + s * dx, y + s * dy)
            s = s - (s * dz - h) / (dz - z_x * dx - z_y * dy)
        return s, torch.ones_like(x, dtype=torch.bool)

    def sags(self, outline):
        z = self.profile(np.linspace(0, np.hypot(*outline.farthest), 1000))[0] - self.z
        return min(z.min(), 0.0), max(z.max(), 0.0)


def back(r):
    """The back of SILICA, and around it a collar on which its curvature fades over a tenth of a millimetre."""
    rim, step, width = SILICA.disc, 1e-4, 0.1
    beyond = np.maximum(r - rim, 0.0)
    z, slope = SILICA.back(np.minimum(r, rim))
    bend = (SILICA.back(rim)[1] - SILICA.back(rim - step)[1]) / step
    fading = -np.expm1(-beyond / width)
    return z + slope * beyond + bend * width * (beyond - width * fading), slope + bend * width * fading


FRONT, BACK = Revolved(0.0, SILICA.front), Revolved(SILICA.thickness, back)
EXACT = Lens(
    FRONT, BACK, Circle(SILICA.aperture + MARGIN), SILICA.index,
    clear=(Circle(SILICA.aperture + MARGIN), Circle(SILICA.disc + MARGIN)),
)  # fmt: skip


@functools.cache
def fitted(m):
    """The lens of two nets of m x m control points."""
    nets = []
    for surface, clear in zip((FRONT, BACK), EXACT.clear, strict=True):
        half = clear.radius + MARGIN
        nets.append(BSplineSurface.fitted(surface, (-half, half), (-half, half), m))
    return replace(EXACT, front=nets[0], back=nets[1], shaped=(0, 1))


def beam(n=257):
    """(rays at n x n points that lie in the aperture, their radii, their flux)."""
    x = torch.linspace(-1, 1, n, dtype=torch.float64) * SILICA.aperture
    x, y = torch.meshgrid(x, x, indexing="ij")
    r = torch.hypot(x, y)
    inside = (r > 0) & (r < SILICA.aperture - 1e-9)
    return BEAM.rays(x[inside], y[inside], 0.0, 1.0), r[inside]


def paths(rays, lens, plane):
    """(optical path (mm) of each ray from z = 0 to the plane, sin of its angle to the axis there)."""
    between = across(rays, lens.interfaces[:1])
    behind = across(between, lens.interfaces[1:])
    places = [torch.stack([*each.position[:2], each.above(0.0)]) for each in (between, behind)]
    assert bool(behind.alive.all())
    glass = torch.linalg.norm(places[1] - places[0], dim=0)
    air = (plane - places[1][2]) / behind.direction[2]
    return places[0][2] + lens.index * glass + air, torch.hypot(*behind.direction[:2])


def off(landed, r):
    """How far rays from radius r land from where the flux law has them (mm)."""
    assert bool(landed.alive.all())
    return (torch.hypot(*landed.position) - torch.from_numpy(SILICA.lands_at(r.numpy()))).abs()


def test_the_exact_faces_send_light_where_the_quadrature_says():
    """Parallel, and with one optical path: bstcad's laws are the referee's."""
    rays, r = beam(129)
    for behind in BEHIND:
        plane = SILICA.thickness + behind
        path, sine = paths(rays, EXACT, plane)
        landed = off(trace(rays, replace(EXACT, shaped=(0, 1)), LevelPlane(plane)), r)
        assert float(landed.max()) < 1e-9 and float(sine.max()) < 1e-11  # the back bends by 4 / mm at the rim
        assert float((path - SILICA.path(plane)).abs().max()) < 1e-11


WITHIN = {3.0: 3e-6, 5.0: 2e-5, 6.0: 1e-4, 7.0: 1.5e-3}  # a radius on the front (mm): the angles there (rad)
PLACED = 5e-5  # mm, by which nets displace rays in the glass


def test_two_fitted_nets_send_light_there_as_far_as_they_resolve_the_faces():
    """Slopes of quadratic splines err by about h² / 24 times the third derivative, which on the back grows outwards."""
    rays, r = beam()
    _, sine = paths(rays, fitted(513), SILICA.thickness)
    for radius, most in WITHIN.items():
        assert float(sine[r < radius].max()) < most
        for behind in BEHIND:
            landed = off(trace(rays, fitted(513), LevelPlane(SILICA.thickness + behind)), r)
            assert float(landed[r < radius].max()) < behind * most + PLACED


def test_twice_the_points_a_side_leave_a_quarter_of_the_angles():
    rays, r = beam()
    coarse, fine = (paths(rays, fitted(m), SILICA.thickness)[1][r < 5.0] for m in (257, 513))
    assert 3 < float(coarse.norm() / fine.norm()) < 5


def test_the_wavefront_behind_two_fitted_nets_is_plane():
    """A fiftieth of a wave RMS over the light, piston removed and no tilt, which a lens of revolution has not."""
    rays, _ = beam()
    path, _ = paths(rays, fitted(513), SILICA.thickness)
    share = rays.flux / rays.flux.sum()
    opd = path - (share * path).sum()
    assert float((share * opd**2).sum().sqrt()) < WAVELENGTH / 50
    assert float((share * path).sum()) == pytest.approx(SILICA.path(SILICA.thickness), abs=WAVELENGTH / 50)


@pytest.mark.parametrize("behind", BEHIND)
def test_two_fitted_nets_light_the_disc_evenly(behind):
    """By ray tubes, but for pixels near the rim of the disc, where angles of a milliradian blur the edge."""
    screen = Screen(SILICA.thickness + behind, (-HALF, HALF), (-HALF, HALF), PIXELS)
    seen = tubes_picture(fitted(513), [Channel(BEAM, SILICA.index)], screen, 513)
    assert float(seen.sum()) == pytest.approx(1, abs=1e-4)
    pixel = 2 * HALF / PIXELS
    at = (torch.arange(PIXELS, dtype=torch.float64) + 0.5) * pixel - HALF
    r = torch.hypot(at[:, None], at)
    even = pixel**2 / (np.pi * SILICA.disc**2) * (r < SILICA.disc)
    counts = (r - SILICA.disc).abs() > RIM
    assert float(((seen - even)[counts] ** 2).sum() / (even[counts] ** 2).sum()) ** 0.5 < 0.01
