"""The model of a file of rays: emitting area, intensity and lines of known sources."""

import math

import numpy as np
import pytest
import torch

from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.photometry.ray_model import MAX_LINES, line_numbers, lines_of, model_of, rays_of_lines
from bstcad.photometry.ray_set import RaySet

N = 200_000


def rays(place, direction, **more):
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    power = np.full(len(place), 2.0, np.float32)
    return RaySet(place.astype(np.float32), direction.astype(np.float32), power, "lm", **more)


def lambertian(chance, n=N):
    s, turn = np.sqrt(chance.random(n)), 2 * np.pi * chance.random(n)
    return np.stack([s * np.cos(turn), s * np.sin(turn), np.sqrt(1 - s * s)], 1)


def at(model, theta, phi):
    """Intensity (1/sr) for a flux of 1."""
    t = torch.tensor(math.tan(theta / 2), dtype=torch.float64)
    return float(model.law.density(t * math.cos(phi), t * math.sin(phi))) / model.law.whole


@pytest.mark.parametrize("shape", ["disc", "rectangle", "point"])
def test_the_emitting_area_is_found_though_rays_start_elsewhere_on_their_lines(shape):
    """The rays start on a sphere of 20 mm, as in many files, and the area is at (0.3, -0.2, 0.5) mm."""
    chance = np.random.default_rng(2)
    r, turn = np.sqrt(chance.random(N)), 2 * np.pi * chance.random(N)
    place = {
        "disc": np.stack([0.8 * r * np.cos(turn), 0.8 * r * np.sin(turn)], 1),
        "rectangle": (chance.random((N, 2)) - 0.5) * [1.0, 0.4],
        "point": np.zeros((N, 2)),
    }[shape]
    direction = lambertian(chance)
    start = np.hstack([place, np.zeros((N, 1))]) + [0.3, -0.2, 0.5]
    model = model_of(rays(start + 20.0 * direction, direction))
    assert model.facts.origin == pytest.approx((0.3, -0.2, 0.5), abs=0.01)
    if shape == "disc":
        assert isinstance(model.facts.extent, Circle) and model.facts.extent.radius == pytest.approx(0.8, rel=0.01)
    elif shape == "rectangle":
        assert isinstance(model.facts.extent, Rectangle)
        assert (model.facts.extent.width, model.facts.extent.height) == pytest.approx((1.0, 0.4), rel=0.02)
    else:
        assert model.facts.extent is None or max(model.facts.extent.half_extent) < 1e-4  # float32 at 20 mm


def test_a_lambertian_intensity_is_taken_round_and_is_the_cosine_within_a_per_cent():
    chance = np.random.default_rng(3)
    model = model_of(rays(np.zeros((N, 3)), lambertian(chance)))
    assert at(model, 0.7, 0.3) == pytest.approx(at(model, 0.7, 2.1), rel=1e-3)
    for theta in (0.0, 0.3, 0.6, 0.9, 1.2):
        assert at(model, theta, 1.0) == pytest.approx(math.cos(theta) / math.pi, abs=0.02 / math.pi)
    assert model.half_angle == pytest.approx(90.0, abs=1.5) and model.lumens == pytest.approx(2.0 * N)


def test_an_elliptical_intensity_keeps_its_two_widths():
    chance, spread = np.random.default_rng(4), np.array([0.3, 0.1])
    slope = spread * chance.standard_normal((N, 2))
    model = model_of(rays(np.zeros((N, 3)), np.hstack([slope, np.ones((N, 1))])))
    for theta, phi in ((0.0, 0.0), (0.2, 0.0), (0.1, math.pi / 2), (0.15, 1.0)):
        x, y = math.tan(theta) * math.cos(phi) / 0.3, math.tan(theta) * math.sin(phi) / 0.1
        wanted = math.exp(-(x * x + y * y) / 2) / (2 * math.pi * 0.03) / math.cos(theta) ** 3
        assert at(model, theta, phi) == pytest.approx(wanted, rel=0.06)


def test_light_that_leads_away_counts_in_the_flux_but_lights_nothing():
    chance = np.random.default_rng(5)
    direction = lambertian(chance)
    direction[: N // 4, 2] *= -1
    model = model_of(rays(np.zeros((N, 3)), direction))
    assert at(model, 0.6, 0.0) == pytest.approx(0.75 * math.cos(0.6) / math.pi, rel=0.02)
    with pytest.raises(ValueError, match="no ray along"):
        model_of(rays(np.zeros((9, 3)), -np.abs(direction[:9])))


def test_wavelengths_of_rays_become_a_few_lines_with_their_fluxes():
    chance = np.random.default_rng(6)
    place, direction = np.zeros((N, 3)), lambertian(chance)
    two = rays(place, direction, wavelength=np.where(chance.random(N) < 0.3, 450.0, 600.0).astype(np.float32))
    (first, share), (second, other) = lines_of(two)
    assert (first, second) == (600.0, 450.0) and share == pytest.approx(0.7, abs=0.01) and share + other == 1.0
    assert set(two.wavelength[rays_of_lines(two)[1]]) == {450.0}
    many = rays(place, direction, wavelength=(500 + 100 * chance.random(N)).astype(np.float32))
    assert len(lines_of(many)) == MAX_LINES and max(fraction for _, fraction in lines_of(many)) < 1.1 / MAX_LINES
    assert sorted(np.concatenate(rays_of_lines(many)).tolist()) == [*range(N)]
    few = rays(place, direction, wavelength=np.where(np.arange(N) < 5, 450.0, 600.0).astype(np.float32))
    assert len(lines_of(few)) == 1  # five rays are no line
    one = rays(place, direction, wavelength=550.0)
    assert (lines_of(one), rays_of_lines(one)) == (((550.0, 1.0),), (None,))
    assert line_numbers(rays(place, direction))[0] == ()
