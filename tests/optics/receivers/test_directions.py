"""Directions: coordinates and their inverses, solid angles by closed forms, and the kernels against the plain form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.optics.kernels.forward import angle_by_sine, land
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.receivers.directions import Directions
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.rays import Rays
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.optics.trace.trace import from_first_net, to_first_net
from tests import suite
from tests.lenses import SQUARE, lens_of, wavy
from tests.optics.lens.test_mirror import LIGHTS, bumpy, mirror
from tests.tracing import from_first_net_plain, stratified

KINDS = ["C", "A", "B"]


def even(kind):
    limits = {"C": (100.0, 100.0), "A": (170.0, 85.0), "B": (85.0, 170.0)}[kind]
    x, y = (torch.linspace(-limit, limit, 41, dtype=torch.float64) for limit in limits)
    return torch.meshgrid(x, y, indexing="ij")


@pytest.mark.parametrize("kind", KINDS)
def test_coordinates_are_those_of_their_direction(kind):
    """Unit vectors of coordinates and their coordinates, by torch and numpy, and for the axis itself."""
    receiver, (x, y) = Directions(kind), even(kind)
    d = torch.stack(receiver.direction(x, y))
    torch.testing.assert_close((d * d).sum(0), torch.ones_like(x))
    assert np.allclose(receiver.direction(x.numpy(), y.numpy()), d.numpy(), atol=1e-15)
    rays = Rays(torch.zeros_like(d), d, torch.ones_like(x), torch.zeros(x.shape, dtype=torch.uint8), z=3.0)
    landed = receiver.land(rays)
    torch.testing.assert_close(landed.position, torch.stack([x, y]), atol=1e-9, rtol=0)
    assert receiver.point(0.0, 0.0) == pytest.approx((0.0, 0.0, 1e9))
    along = receiver.vector_to(rays, torch.stack([x, y]))
    torch.testing.assert_close(along / along.norm(dim=0), d)


@pytest.mark.parametrize("kind", KINDS)
def test_the_solid_angle_of_a_cell_is_the_area_of_its_directions(kind):
    """Relative to their mean; of the corners' spherical quadrangle by its cross product, in small cells."""
    receiver, x, y, shape = Directions(kind), (-50.0, 70.0), (-30.0, 60.0), (90, 120)
    at = np.meshgrid(np.linspace(*x, 121), np.linspace(*y[::-1], 91))
    d = np.stack(receiver.direction(*at), axis=-1)
    one, other = d[1:, 1:] - d[:-1, :-1], d[1:, :-1] - d[:-1, 1:]
    area = np.linalg.norm(np.cross(one, other), axis=-1) / 2
    assert receiver.areas(x, y, shape) == pytest.approx(area / area.mean(), rel=2e-4)


@pytest.mark.parametrize("kind, shape", [("C", (45, 45)), ("A", (60, 40)), ("B", (30, 90))])
def test_the_solid_angles_of_fine_cells_sum_to_those_of_coarse_ones(kind, shape):
    """Fine cells have fewer nodes; sr."""
    receiver, x, y = Directions(kind), (-60.0, 30.0), (-10.0, 80.0)
    rows, columns = shape
    fine = receiver.cell_sizes(x, y, (4 * rows, 4 * columns)).reshape(rows, 4, columns, 4).sum((1, 3))
    np.testing.assert_allclose(fine, receiver.cell_sizes(x, y, shape), rtol=1e-9)


def test_the_angle_follows_from_its_sine_and_cosine_to_rounding():
    """θ = sin θ · (θ / sin θ) from the axis, also close to it, to 90°; four units of the last place."""
    for angle in (*np.linspace(0.0, math.pi / 2, 1001), 1e-9, 1e-5):
        assert math.sin(angle) * angle_by_sine(math.cos(angle)) == pytest.approx(angle, rel=9e-16, abs=0.0)


LENS = lens_of(wavy(m=17, depth=2.0, ripple=0.2, z=22.0, half=11.0), Sphere(15.0, -0.02), SQUARE, 1.5)
SCENES = {
    "lens": (CollimatedSource(Circle(9.0), tilt=(5.0, 10.0)), LENS),
    "mirror": (LIGHTS["gaussian, tilted"], mirror(bumpy())),
}


@pytest.mark.parametrize("name", suite.in_turns(SCENES, 2))
@pytest.mark.parametrize("kind", KINDS)
def test_the_kernels_collect_directions_as_the_plain_form_does(name, kind):
    source, lens = SCENES[name]
    x, y = (p.reshape(-1) for p in stratified(Rectangle(18.0, 18.0), 60, 0))
    coming = to_first_net(source.rays_through(x, y, lens.entrance.z, 1.0), lens)
    plain = from_first_net_plain(coming, lens, Directions(kind))
    for found in (land(source, lens, Directions(kind), x, y), from_first_net(coming, lens, Directions(kind))):
        alive = plain.alive & (plain.flux > 0)
        assert alive.sum() > 1000 and torch.equal(found.status[alive], plain.status[alive])
        torch.testing.assert_close(found.position[:, alive], plain.position[:, alive], atol=1e-9, rtol=0)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_of_directions_is_the_plain_one(name, kind):
    """Gradient in the heights of the net, for seeds of any sign."""
    source, lens = SCENES[name]
    x, y = sampling.grid(Rectangle(15.0, 15.0), 40)
    coming = to_first_net(source.rays_through(x, y, lens.entrance.z, 1.0), lens)
    seeds = torch.randn((2, 1600), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gradients = []
    for trace in (from_first_net_plain, from_first_net):
        heights = lens.back_net.heights.clone().requires_grad_()
        moved = lens.with_last_net(replace(lens.nets[-1], heights=heights))
        landed = trace(coming, moved, Directions(kind))
        value = (landed.position.reshape(2, -1) * seeds * landed.alive.reshape(-1)).sum()
        gradients.append(torch.autograd.grad(value, heights)[0])
    torch.testing.assert_close(*gradients, rtol=1e-9, atol=1e-9 * float(gradients[0].abs().max()))
    assert math.isfinite(float(gradients[1].sum()))
