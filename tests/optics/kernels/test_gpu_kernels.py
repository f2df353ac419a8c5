"""Kernels for a GPU, compiled by Warp for the CPU: each equals its plain form, and sums depend on no order."""

from dataclasses import replace

import pytest
import torch

from bstcad.optics.lens.interfaces import cross
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.trace import tubes
from bstcad.scene.scene import load
from tests.optics.kernels.test_clip import SHAPE, crowded, even, in_one_pixel, light, same, shaken, without_area

pytest.importorskip("warp", reason="pip install 'bstcad[gpu]'")

from bstcad.optics.kernels import gpu_clip, gpu_crossing

LIMITS = tubes.MIN_TRIANGLE_AREA, tubes.EVEN_TUBE, tubes.UNEVEN_TUBE
SCALE = (0.5, -0.25, 1.1, 0.9)
NET = 33


def collect(corner, flux, shape, scale=tubes.PIXELS):
    return gpu_clip.Clip.apply(corner, flux, (shape, scale), LIMITS)


def altered(change):
    corner, flux = crowded(12, 14, 3)
    change(corner)
    return corner, flux


SHEETS = {
    "some tubes a pixel": lambda: crowded(12, 14, 3),
    "pixels smaller than tubes": lambda: shaken(4, 5, 1, 0.3),
    "even tubes": lambda: (even(20, 24), torch.full((20, 24), 1 / 480, dtype=torch.float64)),
    "folded tubes": lambda: shaken(12, 14, 2, 0.7),
    "beside the picture": lambda: shaken(12, 14, 5, 0.1, low=-6.0, high=17.0),
    "tubes in one pixel": lambda: altered(in_one_pixel),
    "tubes without area": lambda: altered(without_area),
}


@pytest.mark.parametrize("name", SHEETS)
def test_tubes_are_collected_as_in_the_plain_form(name):
    corner, flux = SHEETS[name]()
    flux[2, 3] = 0.0
    wanted = light(tubes.collect_plain, corner, flux, scale=SCALE)
    same(light(collect, corner, flux, scale=SCALE), wanted, image=1e-11)


def test_a_tube_without_a_place_gives_no_light():
    corner, flux = crowded(12, 14, 3)
    flux[4, 4] = 0.0
    wanted = collect(corner, flux, SHAPE)[0]
    corner[:, 4, 4], flux[3:5, 3:5] = torch.nan, 0.0
    found, outside = collect(corner, flux, SHAPE)
    assert torch.isfinite(found).all() and torch.isfinite(outside) and found.sum() < wanted.sum()


def lit_face(template, steep=0.0):
    """Rays before the back of a wavy lens, its interface, and the height of a screen behind it."""
    scene = load(f"templates/{template}.toml", {"lens.back.control_points": NET, "target.pixels": 64})
    [channel] = scene.channels()
    lens = scene.flat_lens(NET)
    x, y = lens.back_net.places
    waves = (0.03 + steep) * torch.cos(0.6 * x) * torch.cos(0.5 * y)
    lens = channel.through(lens.with_back(replace(lens.back, heights=lens.back_net.heights + waves)))
    rays = tubes.launch_tubes(channel.source, lens, 37).rays  # none hits a knot, where second derivatives jump
    return rays, lens.unbounded().interfaces[lens.tailored_numbers[0]], scene.goals[0].screen.receiver


def landing(form, rays, interface, planes):
    """(statuses, places of the rays that land, gradient in the heights)."""
    heights = interface.surface.heights.detach().clone().requires_grad_()
    found = form(rays, replace(interface, surface=replace(interface.surface, heights=heights)), planes)
    seeds = torch.Generator().manual_seed(7)
    total, places = torch.zeros((), dtype=torch.float64), []
    for landed in found:
        alive = landed.status == int(Status.ALIVE)
        at = torch.where(alive, landed.position, torch.zeros_like(landed.position))
        total = total + (at * torch.randn(at.shape, generator=seeds, dtype=torch.float64)).sum()
        places.append(at.detach())
    [gradient] = torch.autograd.grad(total, heights)
    return torch.stack([landed.status for landed in found]), torch.stack(places), gradient


def plain(rays, interface, planes):
    behind = cross(rays, interface).rays
    return tuple(plane.land(behind) for plane in planes)


@pytest.mark.parametrize(
    ("template", "steep"), [("caustic_portrait", 0.0), ("portrait", 0.0), ("mirror", 0.0), ("portrait", 1.0)]
)
def test_rays_land_as_in_the_plain_form(template, steep):
    """Light along the axis, from a point, on a mirror, and at a face so steep that some is totally reflected."""
    rays, interface, receiver = lit_face(template, steep)
    planes = (receiver, LevelPlane(receiver.middle[2] / 2))
    status, places, gradient = landing(gpu_crossing.landed, rays, interface, planes)
    wanted = landing(plain, rays, interface, planes)
    assert torch.equal(status, wanted[0]) and (status == int(Status.ALIVE)).any()
    assert bool((status == int(Status.TOTAL_REFLECTION)).any()) == (steep > 0)
    torch.testing.assert_close(places, wanted[1], rtol=1e-10, atol=1e-9)
    torch.testing.assert_close(gradient, wanted[2], rtol=0, atol=1e-9 * float(wanted[2].abs().max()))


def test_sums_repeat_to_the_last_bit_in_any_order():
    rays, interface, receiver = lit_face("portrait")
    order = torch.randperm(rays.status.shape[0], generator=torch.Generator().manual_seed(1))
    mixed = replace(
        rays, position=rays.position[:, order], direction=rays.direction[:, order], flux=rays.flux[order],
        status=rays.status[order],
    )  # fmt: skip
    gradients = []
    for each, rows in ((rays, torch.arange(len(order))), (mixed, order)):
        heights = interface.surface.heights.detach().clone().requires_grad_()
        [landed] = gpu_crossing.landed(
            each, replace(interface, surface=replace(interface.surface, heights=heights)), [receiver]
        )
        weights = torch.randn(landed.position.shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
        gradients += torch.autograd.grad((landed.position * weights[:, rows]).sum(), heights)
    assert torch.equal(*gradients)


def test_what_the_kernel_does_not_trace_is_left_to_plain_torch():
    rays, interface, receiver = lit_face("portrait")
    moving = replace(rays, position=rays.position.clone().requires_grad_())
    assert gpu_crossing.landed(moving, interface, [receiver]) is None
