"""Interfaces as data: any sequence of them is walked by one function, there and back."""

import math

import pytest
import torch

from bstcad.optics.interfaces import Interface, Reflect, Refract, cross
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import EVERYWHERE, Rectangle
from bstcad.optics.rays import Rays, Status
from bstcad.optics.surfaces import Conic, Plane, Sphere
from bstcad.optics.trace import towards_back, trace
from tests.optics.test_mirror import bumpy, mirror

N, THICK = 1.5, 6.0


def along(degrees, count=5):
    """Parallel rays in the plane y = 0, at so many degrees to +z."""
    angle = math.radians(degrees)
    way = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)[:, None].expand(3, count)
    start = torch.zeros((3, count), dtype=torch.float64)
    start[1] = torch.linspace(-2, 2, count, dtype=torch.float64)
    return Rays(start - 10 * way, way.contiguous(), torch.ones(count, dtype=torch.float64),
                torch.zeros(count, dtype=torch.uint8))  # fmt: skip


def test_light_that_is_reflected_twice_inside_a_plate_leaves_parallel():
    """As a ghost goes: refracted, reflected at the back, at the front, refracted; three times t tan θ' to the side."""
    front, back = Plane(0.0), Plane(THICK)

    def at(surface, law):
        return Interface(surface, EVERYWHERE, law, Status.VIGNETTED)

    rays = along(20.0)
    before = rays.direction
    senses, angles = [], []
    for interface in (at(front, Refract(1.0, N)), at(back, Reflect()), at(front, Reflect()), at(back, Refract(N, 1.0))):
        hit = cross(rays, interface)
        rays = hit.rays
        senses.append(rays.sense)
        angles.append((float(hit.cos_in[0]), float(hit.cos_out[0])))
    inside = math.asin(math.sin(math.radians(20.0)) / N)
    assert senses == [1, -1, 1, 1] and rays.alive.all()
    torch.testing.assert_close(rays.direction, before, rtol=0, atol=1e-15)
    assert rays.position[0].tolist() == pytest.approx([3 * THICK * math.tan(inside)] * 5, abs=1e-13)
    outside, within = math.cos(math.radians(20.0)), math.cos(inside)
    wanted = [(outside, within), (within, within), (within, within), (within, outside)]
    assert angles == [pytest.approx(pair, abs=1e-15) for pair in wanted]


def test_a_lens_is_the_sequence_of_its_interfaces():
    lens = Lens(Sphere(0.0, 0.01), mirror(bumpy()).back, Rectangle(20.0, 20.0), N)
    front, back = lens.interfaces
    assert (front.law, back.law) == (Refract(1.0, N), Refract(N, 1.0))
    assert (front.missed, back.missed) == (Status.MISSED_FRONT, Status.VIGNETTED)
    rays = along(5.0)
    walked = cross(cross(rays, front).rays, back).rays
    assert torch.equal(towards_back(rays, lens).direction, cross(rays, front).rays.direction)
    path = (80.0 - walked.above(0.0)) / walked.direction[2]
    torch.testing.assert_close(trace(rays, lens, 80.0).position, (walked.position + path * walked.direction)[:2])


@pytest.mark.parametrize("surface", [Plane(3.0), Sphere(3.0, 0.0), Conic(3.0, 0.0, -2.0)])
def test_a_plane_is_a_surface_of_curvature_zero(surface):
    """Light along the axis passes it unbent, to the last bit, and stays light along the axis."""
    x = torch.linspace(-3, 3, 7, dtype=torch.float64)
    direction = torch.tensor([[0.0], [0.0], [1.0]], dtype=torch.float64).expand(3, 7)
    position = torch.stack([x, x, torch.zeros_like(x)])
    rays = Rays(position, direction, torch.ones_like(x), torch.zeros(7, dtype=torch.uint8), axial=True)
    hit = cross(rays, Interface(surface, EVERYWHERE, Refract(1.0, N), Status.MISSED_FRONT))
    assert surface.level and hit.rays.axial and torch.equal(hit.rays.direction, direction)
    assert torch.equal(hit.rays.above(0.0), torch.full_like(x, 3.0))
