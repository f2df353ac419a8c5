"""Extended, tilted and many-coloured light by law: étendue, Snell's plate, the sun's image, the sum over points."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.optics.kernels.forward import land
from bstcad.optics.lens.interfaces import cross
from bstcad.optics.lens.passes import MIRROR
from bstcad.optics.light.channels import Channel, channels_of, drawn_channels
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.rays import Rays
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace.measure import Effort, measure, tubes_picture
from bstcad.optics.trace.source_images import images
from bstcad.optics.trace.trace import trace
from tests.lenses import lens_of, net


def curved(front=None, n=1.5):
    back = net(lambda x, y: -0.004 * (x**2 + y**2) + 0.05 * torch.cos(0.4 * x) * torch.sin(0.3 * y), z=6.0, m=25)
    return lens_of(back, front or Sphere(1.0, 0.005), index=n)


def plate(thickness=4.0):
    return lens_of(net(z=2.0 + thickness), Plane(2.0), index=1.5)


def transfer(lens, state, z, sense):
    """(x, y, p_x, p_y) (4, n) of rays on the plane z = 0, or 90 above a mirror, to the same on the plane z; n = 1."""
    x, y, p_x, p_y = state
    ahead = torch.sqrt(1 - p_x * p_x - p_y * p_y)
    rays = Rays(
        torch.stack([x, y, torch.zeros_like(x)]), torch.stack([p_x, p_y, sense * ahead]), torch.ones_like(x),
        torch.zeros(x.shape, dtype=torch.uint8), z=0.0 if sense > 0 else 90.0, sense=sense,
    )  # fmt: skip
    for interface in lens.interfaces:
        rays = cross(rays, interface).rays
    landed = LevelPlane(z).to(rays)
    return torch.cat([landed.position[:2], landed.direction[:2]]), landed.alive


@pytest.mark.parametrize(
    ("lens", "sense"),
    [
        (curved(), 1),
        (curved(Sphere(1.0, -0.04), 1.7), 1),
        (replace(curved(), passes=MIRROR).with_front(Plane(0.0)), -1),
    ],
    ids=("lens", "strong lens", "mirror"),
)
def test_etendue_is_conserved_ray_by_ray(lens, sense):
    """n² cos θ dA dω = dx dy dp_x dp_y, p = n d: the transfer from plane to plane keeps that volume, det = 1."""
    generator = torch.Generator().manual_seed(0)
    state = (torch.rand((4, 300), generator=generator, dtype=torch.float64) - 0.5) * 2
    state = state * torch.tensor([6.0, 6.0, 0.15, 0.15], dtype=torch.float64)[:, None]
    if sense < 0:
        state[:2] -= state[2:] * 60  # so that they meet the mirror
    state = state.requires_grad_()
    after, alive = transfer(lens, state, 150.0, sense)
    rows = [torch.autograd.grad(after[i].sum(), state, retain_graph=True)[0] for i in range(4)]
    jacobian = torch.stack(rows)[:, :, alive].permute(2, 0, 1).numpy()
    assert len(jacobian) > 250
    np.testing.assert_allclose(np.linalg.det(jacobian), 1, rtol=0, atol=1e-9)
    assert np.abs(np.linalg.det(jacobian[:, :2, :2]) - 1).max() > 0.1  # no part of it is conserved alone


@pytest.mark.parametrize("tilt", [(0.0, 20.0), (35.0, -10.0), (0.0, 60.0)], ids=str)
@pytest.mark.parametrize("z", [None, -7.0], ids=str)
def test_a_tilted_beam_passes_a_plate_as_snell_says(tilt, z):
    """Shifted by the thickness times tan θ' in the glass, and on its old way behind it."""
    lens, source, screen = plate(), CollimatedSource(Circle(30.0), tilt=tilt, z=z), LevelPlane(60.0)
    x, y = (p.reshape(-1) for p in torch.meshgrid(*[torch.linspace(-2, 2, 9, dtype=torch.float64)] * 2, indexing="ij"))
    n_x, n_y, n_z = source.axes[2]
    sin = math.hypot(n_x, n_y)
    inside = math.tan(math.asin(sin / 1.5)) / sin  # per component of the direction
    way = 4.0 * inside + (60.0 - 6.0) / n_z
    for landed in (trace(source.rays_through(x, y, 2.0, 1.0), lens, screen), land(source, lens, screen, x, y)):
        assert landed.alive.all()
        torch.testing.assert_close(landed.position[0], x + way * n_x, rtol=0, atol=1e-12 * 60.0 / n_z)
        torch.testing.assert_close(landed.position[1], y + way * n_y, rtol=0, atol=1e-12 * 60.0 / n_z)


def moments(channels, lens, screen):
    """Variance of the light on the screen along x and y (mm²), by tubes."""
    picture = tubes_picture(lens, channels, screen, 150).numpy()
    rows, columns = picture.shape
    x = screen.x[0] + (np.arange(columns) + 0.5) / columns * (screen.x[1] - screen.x[0])
    y = screen.y[1] - (np.arange(rows) + 0.5) / rows * (screen.y[1] - screen.y[0])
    weight = picture / picture.sum()
    return [float((weight.sum(axis) * (p - (weight.sum(axis) * p).sum()) ** 2).sum()) for p, axis in ((x, 0), (y, 1))]


@pytest.mark.parametrize("divergence", [0.53, 5.0])
def test_the_suns_image_through_a_plate_is_as_wide_as_its_angle_times_the_throw(divergence):
    """A small aperture is a pinhole: the image has the variance of a disc of radius sin α (L + t / n), and its own."""
    throw, thickness = 1000.0, 4.0
    lens, source = plate(thickness), CollimatedSource(Circle(1.0), divergence=divergence)
    half = 1.0 + math.sin(math.radians(divergence / 2)) * (throw + 5)
    screen = Screen(6.0 + throw, (-1.2 * half, 1.2 * half), (-1.2 * half, 1.2 * half), (200, 200))
    alone = moments([Channel(replace(source, divergence=None), 1.5)], lens, screen)
    found = moments(channels_of(source, lambda nm: 1.5, 64), lens, screen)
    wide = math.sin(math.radians(divergence / 2)) * (throw + thickness / 1.5)
    for one, other in zip(found, alone, strict=True):
        assert 2 * math.sqrt(one - other) == pytest.approx(wide, rel=2e-3)  # a disc of radius R has R² / 4


def test_the_image_of_two_divergences_has_both_widths():
    """The sun's image, stretched: along each axis the radius is that axis's sin α (L + t / n)."""
    lens, source = plate(), CollimatedSource(Circle(1.0), divergence=(4.0, 1.0))
    half = 1.2 * (1.0 + math.sin(math.radians(2.0)) * 305)
    screen = Screen(306.0, (-half, half), (-half, half), (200, 200))
    alone = moments([Channel(source.central, 1.5)], lens, screen)
    found = moments(channels_of(source, lambda nm: 1.5, 64), lens, screen)
    wide = [math.sin(math.radians(a)) * (300.0 + 4.0 / 1.5) for a in (2.0, 0.5)]
    assert [2 * math.sqrt(a - b) for a, b in zip(found, alone, strict=True)] == pytest.approx(wide, rel=2e-3)


@pytest.mark.parametrize("tilt", [None, (0.0, 40.0)], ids=str)
def test_a_disc_behind_a_pinhole_makes_its_own_image(tilt):
    """A camera obscura: the disc's image upside down, as large as the distances say.

    Tilted, it is foreshortened along x; what its points are nearer or farther does not change its middle by much.
    """
    source = PointSource((0.0, 0.0, -100.0), profile="uniform", half_angle=5.0, diameter=4.0, tilt=tilt)
    lens = replace(plate(0.02), outline=Circle(0.05))
    if tilt is not None:
        source = replace(source, half_angle=60.0)
    screen = Screen(302.0, (-8.0, 8.0), (-8.0, 8.0), (160, 160))
    found = moments(channels_of(source, lambda nm: 1.5, 64), lens, screen)
    magnified = 300.0 / 102.0  # of the plate 0.02 mm thick no hundredth of a mm is seen
    wide = [2 * magnified * (math.cos(math.radians(40)) if tilt else 1.0), 2 * magnified]
    assert [2 * math.sqrt(v) for v in found] == pytest.approx(wide, rel=0.02)


def test_a_flat_mirror_shows_a_chip_as_large_as_the_distances_say():
    """Each place of the mirror is a pinhole: the image of a rectangle w x h has the variances w²/12 and h²/12."""
    mirror = lens_of(net(z=0.0, half=11.0), Plane(-3.0), passes=MIRROR)
    chip = PointSource((0.0, 0.0, 50.0), profile="uniform", half_angle=40.0, width=4.0, height=2.0)
    found = images(channels_of(chip, lambda nm: 1.0, 64), mirror, Screen(150.0, (-60.0, 60.0), (-60.0, 60.0), 120))
    variances = (found.offset**2 * found.flux).sum((1, 2)) / found.flux.sum()  # pixels of 1 mm
    assert variances.tolist() == pytest.approx([12.0**2 / 12, 6.0**2 / 12], rel=0.02)


SCREEN = Screen(120.0, (-14.0, 12.0), (-12.0, 12.0), (13, 12))
LAMP = PointSource((2.0, 0.0, -60.0), profile="uniform", half_angle=7.0, diameter=8.0)


def test_the_number_of_points_leaves_no_bias():
    """Eight points a set, drawn anew for each: the figure is that of 1024 fixed points within its standard error."""
    target = np.random.default_rng(0).uniform(0.9, 1.1, SCREEN.shape)
    many = Effort(1024, accuracy=0.0, witness=False)
    exact = measure(curved(), channels_of(LAMP, lambda nm: 1.5, 1024), SCREEN, target, many)

    def draw(points, seed):
        return drawn_channels(LAMP, lambda nm: 1.5, 8, seed)

    efforts = [Effort(128, seed, accuracy=0.0, witness=False) for seed in range(8, 80, 8)]
    found = [measure(curved(), (), SCREEN, target, effort, sampler=draw) for effort in efforts]
    errors = np.array([light.standard_error for light in found])
    off = np.array([light.rrmsd for light in found]) - exact.rrmsd
    assert abs(off.mean()) < 3 * math.hypot(np.sqrt((errors**2).mean() / len(found)), exact.standard_error)
    assert errors.mean() < 0.05 * exact.rrmsd
