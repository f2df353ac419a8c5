"""Scatter by roughness, against rays through random facets and against the diffraction integral of a random face."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from bstcad.analysis.scattering import Scatter
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import MIRROR, SECOND_SURFACE
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace.finish import Finish
from tests.lenses import net

N, LINE = 1.49, 550.0  # index; wavelength, nm
PER_RMS = math.sqrt(2 / math.pi)  # Ra / RMS of normally distributed heights


def lens(front=None, **more):
    return Lens.between(
        front or Plane(0.0), net(lambda x, y: 0.01 * x**2, 5.0, 17, 10.0), Rectangle(18.0, 18.0), N, **more
    )


def rough_face(rms, length, pitch, count):
    """Heights (count, count) with the covariance rms² exp(-(r / length)²) on points of this pitch; periodic."""
    noise = np.random.default_rng(5).standard_normal((count, count))
    field = gaussian_filter(noise, length / 2 / pitch, mode="wrap")
    return field * (rms / field.std())


def test_light_at_random_facets_has_the_angles_of_the_geometrical_limit():
    """Facets of a face of 3 µm RMS and 40 µm: Snell's law at each, and the distribution along x by quantiles."""
    rms, length, pitch = 3e-3, 0.04, 0.004
    heights = rough_face(rms, length, pitch, 1200)
    slope = [(np.roll(heights, -1, k) - np.roll(heights, 1, k)) / (2 * pitch) for k in (0, 1)]
    norm = np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    cos_in = 1 / norm
    cos_out = np.sqrt(1 - N**2 * (1 - cos_in**2))
    d_x = (cos_out - N * cos_in) * (-slope[0] / norm)
    d_z = N + (cos_out - N * cos_in) / norm
    angle = np.arctan2(d_x, d_z)
    finish = Finish(roughness=1e6 * rms * PER_RMS, roughness_length=length)
    scatter = Scatter.of(lens(), finish, LINE)
    assert scatter.fraction == pytest.approx(1.0)
    assert scatter.angle == pytest.approx(angle.std(), rel=0.05)  # of 1440 independent facets
    [(weight, variance)] = scatter.terms()
    assert (weight, variance) == pytest.approx((1.0, scatter.angle**2))
    picture = np.zeros((1, 201))
    picture[0, 100] = 1.0
    blurred = scatter.blurred(picture, (1000.0, 0.0))[0]  # pixels of 1 mrad
    counts = np.histogram(angle * 1000, np.arange(-100.5, 101))[0] / angle.size
    assert np.abs(np.cumsum(blurred) - np.cumsum(counts)).max() < 0.02


@pytest.mark.parametrize("rms", [30e-6, 120e-6, 400e-6])  # mm: g of 0.03, 0.45 and 5
def test_light_behind_a_random_face_is_the_sum_of_the_series(rms):
    """The Fourier transform of the wave exp(i k (n - 1) h): unscattered fraction, and second moment of the angles."""
    length, pitch, count = 0.02, 0.002, 1024
    heights = rough_face(rms, length, pitch, count)
    wave = np.exp(2j * np.pi * (N - 1) * heights / (LINE * 1e-6))
    light = np.abs(np.fft.fft2(wave)) ** 2 / count**4
    angle = np.fft.fftfreq(count, pitch) * LINE * 1e-6
    scatter = Scatter.of(lens(), Finish(roughness=1e6 * rms * PER_RMS, roughness_length=length), LINE)
    assert light[0, 0] == pytest.approx(1 - scatter.fraction, abs=0.01)
    assert (light.sum(1) * angle**2).sum() == pytest.approx(scatter.fraction * scatter.angle**2, rel=0.02)
    near = np.abs(angle) < 2 * scatter.first_angle
    from scipy.special import ndtr

    inside = sum(w * (2 * ndtr(2 * scatter.first_angle / math.sqrt(v)) - 1) for w, v in scatter.terms())
    assert light.sum(1)[near].sum() == pytest.approx(inside + 1 - scatter.fraction, abs=0.02)


def test_a_picture_keeps_its_light_and_its_even_parts():
    scatter = Scatter(0.7, 2e-3)
    dot = np.zeros((81, 61))
    dot[40, 30] = 1.0
    spread = scatter.blurred(dot, (1000.0, -1000.0))
    assert spread.sum() == pytest.approx(1.0, abs=1e-4) and spread[40, 30] > math.exp(-0.7)
    y, x = np.indices(dot.shape)
    second = [float((spread * (p - m) ** 2).sum()) for p, m in ((x, 30), (y, 40))]
    assert second == pytest.approx([0.7 * 4 + scatter.fraction / 12] * 2, rel=0.01)  # mrad²; a pixel's own width
    assert np.array_equal(Scatter(0.0, 1e-3).blurred(dot, (1000.0, 1000.0)), dot)


def test_faces_add_their_phases_and_a_mirror_doubles_them():
    finish = Finish(roughness=10.0)
    one = (2 * math.pi * 10.0 / PER_RMS / LINE) ** 2  # of an index difference of 1
    assert Scatter.of(lens(), finish, LINE).strength == pytest.approx(one * 0.49**2)  # the plane front has none
    assert Scatter.of(lens(Sphere(0.0, 0.01)), finish, LINE).strength == pytest.approx(2 * one * 0.49**2)
    assert Scatter.of(lens(passes=MIRROR), finish, LINE).strength == pytest.approx(one * 2**2)
    behind_glass = lens(Sphere(0.0, 0.01), passes=SECOND_SURFACE)
    expected = one * (2 * 0.49**2 + (2 * N) ** 2)
    assert Scatter.of(behind_glass, finish, LINE).strength == pytest.approx(expected)
