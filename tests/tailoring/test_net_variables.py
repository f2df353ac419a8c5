"""The variables of two nets: the wavefront behind the lens stands still for one block, and adjoints are exact."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.analysis.shape import slope_octaves
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.trace.trace import behind
from bstcad.tailoring.merit import SobolevVariable
from bstcad.tailoring.net_variables import NetVariables, along_light
from tests.lenses import net

BEAM, POINT = CollimatedSource(aperture=Rectangle(16.0, 16.0)), PointSource((1.0, 0.0, -80.0), half_angle=5.0)
SCREENS = [Screen(30.0, (-9.0, 9.0), (-9.0, 9.0), 8), Screen(70.0, (-9.0, 9.0), (-9.0, 9.0), 8)]
GOALS = [Goal(f"target[{k}]", screen, np.full((8, 8), 1 / 64)) for k, screen in enumerate(SCREENS)]


def surface(z, sag, m):
    return net(sag, z, m, 12.0)


def lens_of(m=97, back=65):
    front = surface(0.0, lambda x, y: 0.004 * (x * x + y * y) + 0.05 * torch.cos(x / 4) * torch.cos(y / 3), m)
    last = surface(12.0, lambda x, y: -0.006 * (x * x + 2 * y * y) + 0.06 * torch.sin(x / 3) * torch.cos(y / 4), back)
    return Lens.between(front, last, Rectangle(22.0, 22.0), 1.5, tailored=(0, 1))


def traced(source, lens, q):
    rays = source.rays_through(q[0], q[1], lens.entrance.z, 1.0)
    for interface in lens.unbounded().interfaces:
        rays = behind(rays, interface)
    return [screen.receiver.land(rays).position for screen in SCREENS]


def jacobian(places, step):
    """(…, 2, 2) by differences along the grid."""
    return torch.stack([torch.stack(torch.gradient(p, spacing=(step, step)), -1) for p in places], -2)


@pytest.mark.parametrize("source", [BEAM, POINT], ids=["parallel", "point"])
def test_a_change_carried_along_the_light_leaves_the_light_behind_as_it_is(source):
    """Rays move on the near plane, and on the far one just as the unchanged light goes on from there."""
    lens = lens_of()
    along, _ = along_light(source, lens, GOALS)
    bump = surface(0.0, lambda x, y: 1e-5 * torch.cos(x / 1.6 + 0.3) * torch.sin(y / 2), 97).heights
    carried = torch.from_numpy(along @ bump.numpy().reshape(-1)).reshape(lens.back.shape)
    line = torch.linspace(-6.0, 6.0, 97, dtype=torch.float64)
    q = torch.stack(torch.meshgrid(line, line, indexing="ij"))
    near, far = traced(source, lens, q)
    straight = torch.linalg.solve(jacobian(near, 0.125), jacobian(far, 0.125), left=False)  # ∂far / ∂near
    off = {}
    for name, heights in (("alone", torch.zeros_like(carried)), ("carried", carried)):
        moved = lens.with_heights([lens.front.heights + bump, lens.back.heights + heights])
        there, beyond = traced(source, moved, q)
        goes_on = (straight @ (there - near).permute(1, 2, 0)[..., None])[..., 0].permute(2, 0, 1)
        off[name] = (beyond - far - goes_on)[:, 4:-4, 4:-4].square().mean().sqrt()
        assert (there - near).square().mean().sqrt() > 1e-6  # mm: the light did move
    assert off["carried"] < 0.02 * off["alone"]


@pytest.mark.parametrize("back", [97, 65])
def test_the_adjoint_is_the_transpose(back):
    lens, generator = lens_of(back=back), torch.Generator().manual_seed(1)
    blocks = tuple(SobolevVariable.of(net, torch.rand(net.shape, generator=generator) + 0.5) for net in lens.nets)
    variables = NetVariables(blocks, *along_light(BEAM, lens, GOALS))
    c, g = ([torch.randn(net.shape, dtype=torch.float64, generator=generator) for net in lens.nets] for _ in range(2))
    one, other = (
        sum(float((a * b).sum()) for a, b in zip(*pair, strict=True))
        for pair in ((variables.heights(c), g), (c, variables.adjoint(g)))
    )
    assert one == pytest.approx(other, rel=1e-12)


def test_where_rays_cross_in_the_glass_the_back_gets_no_ripple():
    """There q(b) is many-valued; the carried change is smooth all the same: it falls off towards the highest octave."""
    m = 97
    front = surface(0.0, lambda x, y: 0.004 * (x * x + y * y) + 0.25 * torch.cos(x / 0.8) * torch.cos(y / 0.8), m)
    lens = Lens.between(front, lens_of().back, Rectangle(22.0, 22.0), 1.5, tailored=(0, 1))
    places = torch.meshgrid(*[torch.linspace(-6, 6, 97).double()] * 2, indexing="ij")
    within = behind(BEAM.rays_through(*places, 0.0, 1.0), lens.unbounded().interfaces[0])
    there = within.position[:2] + (12.0 - within.above(0.0)) * within.direction[:2] / within.direction[2]
    assert bool((torch.linalg.det(jacobian(there, 0.125)) < 0).any())  # they do cross
    along, _ = along_light(BEAM, lens, GOALS)
    change = surface(0.0, lambda x, y: torch.cos(x / 3 + 0.3) * torch.sin(y / 2), m)
    carried = torch.from_numpy(along @ change.heights.numpy().reshape(-1)).reshape(lens.back.shape)
    below, top = slope_octaves(replace(lens.back, heights=carried))[-2:]
    assert top < below
