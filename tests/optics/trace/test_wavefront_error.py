"""The measured wavefront against lenses that are free of error by construction, closed forms, and its own slopes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import MIRROR
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.light.wavefront import PlaneWave, SphericalWave, ZernikeWave, path_from_sphere
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Conic, Plane, Sphere
from bstcad.optics.trace.wavefront_error import exit_pupil, wavefront_error
from tests.lenses import net

N, NM, F = 1.49, 632.8, 120.0
WAVE = NM * 1e-6  # mm
NIL = 1e-6  # waves; a millionth of what a good lens has
BEAM = CollimatedSource(Circle(10.0), wavelength=NM)
ROUND = Circle(12.0)


FLAT = net(half=14.0)


def bumps(size, phase, z, m):
    """A bowl with ripples of this height (mm), which no symmetry maps onto itself."""
    return net(
        lambda x, y: size * torch.sin(0.35 * x + phase) * torch.cos(0.27 * y - phase) - 1e-3 * (x * x + 0.7 * y * y),
        z,
        m,
        14.0,
    )


def plano_hyperbolic():
    """Collimated to a focus F behind the back: a hyperboloid of constant -n² (Hecht, Optics, 5.2.1)."""
    return Lens.between(Plane(10.0), Conic(20.0, -1 / (F * (N - 1)), -(N**2)), ROUND, N)


def collimating():
    """A point F before the front, whose light is parallel in the glass: the same hyperboloid, turned round."""
    return Lens.between(Conic(10.0, 1 / (F * (N - 1)), -(N**2)), FLAT, ROUND, N)


def focusing():
    """Parallel light to a focus F behind the front: an ellipsoid of constant -1/n², then a sphere about that."""
    return Lens.between(Conic(10.0, N / (F * (N - 1)), -1 / N**2), Sphere(20.0, 1 / (F - 10.0)), ROUND, N)


LAMP = PointSource((0.0, 0.0, 10.0 - F), wavelength=NM, profile="uniform", half_angle=4.5)
STIGMATIC = {
    "a hyperbolic back": (plano_hyperbolic(), BEAM, SphericalWave((0.0, 0.0, 20.0 + F), 30.0)),
    "a hyperbolic front": (collimating(), LAMP, PlaneWave(30.0)),
    "an elliptic front": (focusing(), BEAM, SphericalWave((0.0, 0.0, 10.0 + F), 30.0)),
    "behind the focus": (plano_hyperbolic(), BEAM, SphericalWave((0.0, 0.0, 20.0 + F), 300.0)),
    "a parabolic mirror": (
        Lens.between(Plane(0.0), Conic(10.0, 1 / (2 * F), -1.0), ROUND, 1.0, passes=MIRROR),
        replace(LAMP, position=(0.0, 0.0, 10.0 + F)),
        PlaneWave(200.0),
    ),
    "a beam across a plate": (
        Lens.between(Plane(10.0), FLAT, ROUND, N),
        replace(BEAM, tilt=(3.0, -5.0)),
        PlaneWave(30.0, replace(BEAM, tilt=(3.0, -5.0)).axes[2]),
    ),
}


@pytest.mark.parametrize("case", STIGMATIC)
def test_a_stigmatic_lens_has_no_error(case):
    lens, source, wave = STIGMATIC[case]
    found = wavefront_error(source, lens, wave, 128)
    assert found.without_piston.pv < NIL and found.without_tilt.pv < NIL
    assert found.angle_max < 1e-6  # µrad
    assert found.without_piston.rms < found.floor < NIL  # what rounding may add is stated
    assert found.flux == pytest.approx(1.0, abs=0.02) and found.wavelength == NM


def test_a_shift_of_the_focus_is_the_difference_of_two_distances():
    """OPD = -|p - f| + |p - f'|, f = f' + dz; for small angles dz NA² / (4 sqrt(3)) RMS of a disc lit evenly."""
    lens, source, wave = STIGMATIC["a hyperbolic back"]
    dz = 0.05
    found = wavefront_error(source, lens, replace(wave, focus=(0.0, 0.0, 20.0 + F + dz)), 256)
    x, y = torch.from_numpy(found.x)[None, :], torch.from_numpy(found.y)[:, None]
    place = torch.stack([*torch.broadcast_tensors(x, y), torch.zeros(y.shape[0], x.shape[1], dtype=torch.float64)])
    near, far = (path_from_sphere(place, (0.0, 0.0, z - 30.0)) for z in (20.0 + F, 20.0 + F + dz))
    exact = ((far - near) / WAVE).numpy()
    lit = ~np.isnan(found.opd)
    off = (found.opd - exact)[lit]
    assert np.ptp(off) < 2e-4  # of 0.27 waves: the map's cells
    na = 10.0 / F
    assert found.without_tilt.rms == pytest.approx(dz * na**2 / (4 * np.sqrt(3)) / WAVE, rel=0.03)
    assert found.angle_max == pytest.approx(1e6 * dz * na / (F - 10.0), rel=0.03)


@pytest.mark.parametrize("moved", [(0.02, 0.0), (-0.01, 0.03)])
def test_a_focus_moved_sideways_is_a_tilt(moved):
    lens, source, wave = STIGMATIC["a hyperbolic back"]
    found = wavefront_error(source, lens, replace(wave, focus=(*moved, 20.0 + F)), 128)
    wanted = [-1e6 * m / (F - 10.0) for m in moved]  # µrad: light that misses the focus on the other side
    assert found.tilt == pytest.approx(wanted, rel=0.02, abs=0.1)
    assert found.without_piston.rms > 100 * found.without_tilt.rms
    assert found.angle_rms == pytest.approx(np.hypot(*wanted), rel=0.02)


def test_a_beam_that_leans_is_late_on_the_side_it_leans_to():
    lens = Lens.between(Plane(10.0), FLAT, ROUND, N)
    source = replace(BEAM, tilt=(0.0, 0.01))  # degrees, towards +x
    found = wavefront_error(source, lens, PlaneWave(30.0), 256)
    sin = source.axes[2][0]
    assert found.tilt == pytest.approx((1e6 * sin, 0.0), rel=1e-9, abs=1e-6)
    assert found.without_piston.rms == pytest.approx(sin * 10.0 / 2 / WAVE, rel=2e-3)  # of x over a disc: r / 2
    assert found.without_piston.pv == pytest.approx(sin * 20.0 / WAVE, rel=0.02)
    assert found.without_tilt.pv < NIL
    assert found.angle_rms == pytest.approx(found.angle_max) == pytest.approx(1e6 * sin)


def test_a_stated_wave_is_missed_by_itself_on_its_circle_alone():
    """A plane wave where c_4 = 0.25 waves RMS is wanted."""
    lens = Lens.between(Plane(10.0), FLAT, ROUND, N)
    wave = ZernikeWave((0.0, 0.0, 0.0, 0.25), 8.0, 30.0)
    found = wavefront_error(BEAM, lens, wave, 512)
    assert found.without_tilt.rms == pytest.approx(0.25, rel=5e-3)
    assert found.flux == pytest.approx(0.64, rel=5e-3) and np.abs(found.x).max() == pytest.approx(8.0, abs=0.05)


BUMPY = Lens.between(bumps(0.02, 0.3, 10.0, 17), bumps(-0.03, 1.1, 20.0, 23), ROUND, N)


@pytest.mark.parametrize("source", [
    BEAM, replace(BEAM, tilt=(4.0, -6.0), profile="gaussian", radius_1e2=6.0),
    PointSource((1.0, -0.5, -80.0), wavelength=NM, profile="uniform", half_angle=4.0),
], ids=["beam", "tilted gaussian", "point"])  # fmt: skip
@pytest.mark.parametrize("wave", [
    PlaneWave(30.0, (0.05, -0.1, 1.0)), SphericalWave((4.0, 0.0, 230.0), 30.0),
    ZernikeWave((0, 3, 1, -40, 5), 13.0, 30.0),
], ids=lambda wave: wave.kind)  # fmt: skip
def test_slopes_of_the_opd_are_the_angles_to_the_wanted_rays(source, wave):
    """Malus and Dupin: from neighbour to neighbour OPD changes by (d - w) · way; paths against directions."""
    pupil = exit_pupil(source, BUMPY, wave.z, 400)
    opd = pupil.path - wave.path(pupil.x, pupil.y, NM)
    off = (pupil.direction - wave.directions(pupil.x, pupil.y, NM))[:2]
    whole = pupil.alive[:, 2:] & pupil.alive[:, 1:-1] & pupil.alive[:, :-2]
    change = (opd[:, 2:] - opd[:, :-2])[whole]
    way = torch.stack([p[:, 2:] - p[:, :-2] for p in (pupil.x, pupil.y)])
    predicted = (off[:, :, 1:-1] * way).sum(0)[whole]
    assert float(change.std()) > 1e-6  # mm: much more than rounding
    assert float((change - predicted).square().mean().sqrt()) < 1e-3 * float(change.square().mean().sqrt())


def test_the_map_has_the_slopes_of_the_rays():
    found = wavefront_error(BEAM, BUMPY, PlaneWave(30.0), 512)
    g_y, g_x = np.gradient(found.opd * WAVE, found.y, found.x)
    x, y = np.meshgrid(found.x, found.y)
    inner = np.hypot(x, y) < 9.0
    pupil = exit_pupil(BEAM, BUMPY, 30.0, 512)
    seen = pupil.alive & (torch.hypot(pupil.x, pupil.y) < 9.0)
    d = pupil.direction[:2, seen] - 1e-6 * torch.tensor(found.tilt, dtype=torch.float64)[:, None]
    by_rays = float(d.square().sum(0).mean().sqrt())
    assert float(np.sqrt(np.mean((g_x**2 + g_y**2)[inner]))) == pytest.approx(by_rays, rel=5e-3)
    assert np.isnan(found.opd[0, 0]) and found.opd.shape == (256, 256)
    pv = np.nanmax(found.opd) - np.nanmin(found.opd)
    assert pv == pytest.approx(found.without_tilt.pv, rel=0.02)  # the map goes on to a cell beyond the rim


def test_figures_do_not_depend_on_where_the_scene_stands():
    away = 1e5
    lens = BUMPY.with_front(BUMPY.front.moved(10.0 + away)).with_back(BUMPY.back.moved(20.0 + away))
    here = wavefront_error(BEAM, BUMPY, PlaneWave(30.0), 64)
    there = wavefront_error(BEAM, lens, PlaneWave(30.0 + away), 64)
    assert there.without_tilt.rms == pytest.approx(here.without_tilt.rms, rel=1e-6)


def test_losses_and_lost_rays_count_in_the_flux():
    narrow = BUMPY.with_clear((ROUND, Circle(5.0)))
    found = wavefront_error(BEAM, narrow, PlaneWave(30.0), 128)
    assert found.flux == pytest.approx(0.25, rel=0.02) and np.abs(found.x).max() < 5.5


def test_it_says_what_cannot_be_measured():
    with pytest.raises(ValueError, match="no single wavefront"):
        wavefront_error(replace(BEAM, divergence=0.5), BUMPY, PlaneWave(30.0))
    far = ZernikeWave((0.0,), 1.0, 30.0, centre=(500.0, 0.0))
    with pytest.raises(ValueError, match="too few rays"):
        wavefront_error(replace(BEAM, aperture=Rectangle(4.0, 4.0)), BUMPY, far)
