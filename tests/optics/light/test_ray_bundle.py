"""Rays of a file: their parts, where they start, and their light beside that of their model and of its source."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import MIRROR
from bstcad.optics.light.channels import Channel, SourceSampler, drawn_channels, given_channels
from bstcad.optics.light.measured_rays import PARTS, MeasuredRays, RayOrder
from bstcad.optics.light.point import PointSource
from bstcad.optics.light.ray_bundle import RayBundle, fates
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.measure import Effort, measure
from bstcad.optics.trace.trace import launch_strips, simulate
from bstcad.photometry.ray_model import model_of
from bstcad.photometry.ray_set import RaySet
from tests.lenses import wavy

UPRIGHT = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
SLAB = Lens.between(Plane(5.0), Plane(9.0), Circle(10.0), 1.5)


class Given(MeasuredRays):
    """Rays of a test with their model."""

    def __init__(self, rays, model=None):
        self.rays, self.model = rays, model or model_of(rays)
        self.order = RayOrder.of(rays)

    facts = property(lambda self: self.model.facts)
    words = "rays of a test"

    def scaled(self, share):
        return self if share == 1 else self.model.scaled(share)

    def rays_of(self, line):
        return self.order


def ray_set(position, direction, power=None):
    position, direction = (np.asarray(part, dtype=np.float32) for part in (position, direction))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    power = np.ones(len(position)) if power is None else power
    return RaySet(position, direction, np.asarray(power, dtype=np.float32), "lm")


def lambertian_disc(n, diameter, seed=1):
    chance = np.random.default_rng(seed)
    r, s = diameter / 2 * np.sqrt(chance.random(n)), np.sqrt(chance.random(n))
    a, b = 2 * np.pi * chance.random((2, n))
    place = np.stack([r * np.cos(a), r * np.sin(a), 0 * r], 1)
    return ray_set(place, np.stack([s * np.cos(b), s * np.sin(b), np.sqrt(1 - s * s)], 1))


def bundle(rays, part=0):
    return RayBundle(RayOrder.of(rays), (0.0, 0.0, 0.0), (UPRIGHT, UPRIGHT), 550.0, part)


def test_each_ray_is_in_one_part_and_a_sorted_file_gives_no_sorted_sample():
    n = 100_003
    order = RayOrder.of(SimpleNamespace(power=np.arange(n)))
    parts = [order.sample(part, n, seed=0) for part in range(PARTS)]
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(n))
    few = np.concatenate([order.sample(3, 50, seed) for seed in range(40)]).astype(float)
    assert set(few.astype(int)) <= set(parts[3].tolist())
    assert few.mean() / n == pytest.approx(0.5, abs=4 * 0.29 / np.sqrt(2000))


def test_rays_are_counted_by_where_they_start():
    """Before the lens, inside it, behind it, beside it, past its outline but before it, and led away from it."""
    up, down = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
    starts = [(0, 0, 0), (1, 0, 6), (1, 0, 9.5), (12, 0, 6), (12, 0, 0), (0, 0, 0), (0, 0, 6)]
    source = bundle(ray_set(starts, [up] * 5 + [down] * 2))
    source.order.order[:] = np.arange(len(starts))
    rays = RayBundle._oriented(source, *(
        torch.from_numpy(part.T.astype(float)) for part in (source.order.rays.position, source.order.rays.direction)
    ), torch.full((len(starts),), 1 / len(starts)).double(), SLAB)  # fmt: skip
    found = [Status(int(each)) for each in fates(rays, SLAB)]
    beside, inside, away = Status.STARTED_BESIDE, Status.STARTED_INSIDE, Status.LEADS_AWAY
    assert found == [Status.ALIVE, inside, beside, beside, Status.ALIVE, away, inside]


def test_the_ledger_of_given_rays_closes_with_their_own_lines():
    up, down = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
    starts = [(0, 0, 0), (1, 0, 6), (12, 0, 6), (12, 0, 0), (0, 0, 0)]
    rays = ray_set(np.repeat(starts, PARTS * 100, axis=0), np.repeat([up, up, up, up, down], PARTS * 100, axis=0))
    screen = Screen(50.0, (-5.0, 5.0), (-5.0, 5.0), 5)
    lights = [(1 / PARTS, bundle(rays, part), SLAB, 0) for part in range(PARTS)]
    [light] = simulate(lights, [screen], 1000)
    lines = light.flux
    assert sum(lines.values()) == pytest.approx(1.0, abs=1e-12) and light.rays == len(rays)
    own = ("on target", "starts inside the lens", "starts beside or behind the lens", "missed the lens",
           "leads away from the lens")  # fmt: skip
    assert [lines[line] for line in own] == pytest.approx([0.2] * 5, abs=0.01)


@pytest.mark.parametrize("sense", [1, -1])
def test_rays_and_their_model_light_a_tilted_plane_alike(sense):
    """An intensity without symmetry, from a centre off the file's origin, tilted and rotated, onto a lens or a mirror.

    Both are compared by the moments of their light in a square of the plane z = 20 sense.
    """
    chance, n = np.random.default_rng(4), 400_000
    flat = np.stack([0.25 + 0.1 * chance.standard_normal(n), 0.1 + 0.05 * chance.standard_normal(n)], 1)
    flat += 0.5 * flat[:, :1] * [0.0, 1.0]
    direction = np.hstack([flat, np.ones((n, 1))])
    start = np.tile([0.4, -0.7, 0.3], (n, 1)) - direction * chance.random((n, 1))
    lamp = Given(ray_set(start, direction))
    point = PointSource((1.0, 2.0, 0.0), 550.0, rays=lamp, tilt=(8.0, -5.0), rotate=35.0)
    assert np.allclose(lamp.facts.origin, (0.4, -0.7, 0.3), atol=1e-4) and lamp.facts.extent is None
    z = 20.0 * sense
    lens = Lens.between(Plane(z), Plane(z + 3.0), Circle(100.0), 1.5)
    if sense < 0:
        lens = Lens.between(Plane(z - 3.0), Plane(z), Circle(100.0), 1.0, passes=MIRROR)
    [strip] = [*launch_strips(point.bundle(0), lens, 200, seed=1)][:1]
    axes = torch.tensor(point.file_axes(sense), dtype=torch.float64)
    own = axes @ (torch.stack([*strip.position[:2], strip.above(0.0)]) - torch.tensor([[1.0], [2.0], [0.0]]))
    ahead = axes @ strip.direction
    nearest = own + (0.3 - own[2]) / ahead[2] * ahead  # in the coordinates of the file, whose origin is at `position`
    assert nearest.mean(1).tolist() == pytest.approx([0.4, -0.7, 0.3], abs=1e-4)
    path = (z - strip.z - strip.position[2]) / strip.direction[2]
    x, y = (strip.position + path * strip.direction)[:2]
    grid = torch.linspace(-40.0, 40.0, 801, dtype=torch.float64)
    u, v = torch.meshgrid(grid, grid, indexing="ij")
    light = point.central.irradiance(u, v, z)
    weight = light / light.sum()

    def moments(a, b, w):
        mean = [(w * p).sum() for p in (a, b)]
        p, q = a - mean[0], b - mean[1]
        return [float(each) for each in (*mean, (w * p * p).sum().sqrt(), (w * q * q).sum().sqrt(), (w * p * q).sum())]

    found, wanted = moments(x, y, strip.flux / strip.flux.sum()), moments(u, v, weight)
    assert found == pytest.approx(wanted, abs=0.06), (found, wanted)


def test_a_lens_judged_by_rays_is_the_lens_judged_by_their_source():
    """A Lambertian disc of 1 mm, and a file of its rays: RRMSD and ledger agree within their noise."""
    lens = Lens.between(Plane(14.0), wavy(), Circle(10.0), 1.5)
    screen = Screen(300.0, (-60.0, 60.0), (-60.0, 60.0), 12)
    target = np.ones((12, 12))
    disc = PointSource((0.0, 0.0, 0.0), 550.0, diameter=1.0)
    given = given_channels(
        PointSource((0.0, 0.0, 0.0), 550.0, rays=Given(lambertian_disc(400_000, 1.0))), lambda nm: 1.5
    )
    effort, channel = Effort(rays=300, accuracy=0.0), Channel(disc.central, 1.5)
    by_disc = SourceSampler(lambda points, seed: drawn_channels(disc, lambda nm: 1.5, points, seed))
    by_rays = SourceSampler(lambda points, seed: given(seed), given.largest_side)
    light, own = (measure(lens, [channel], screen, target, effort, sampler=each) for each in (by_disc, by_rays))
    assert own.rays < 410_000 and sum(own.flux.values()) == pytest.approx(1.0, abs=1e-12)
    assert own.rrmsd == pytest.approx(light.rrmsd, abs=4 * (own.standard_error + light.standard_error))
    for line in ("on target", "missed the lens"):
        assert own.flux[line] == pytest.approx(light.flux[line], abs=0.003)
