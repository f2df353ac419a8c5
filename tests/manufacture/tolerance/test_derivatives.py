"""Derivatives of the picture by central differences, against those of the adjoint trace: one backward pass for all.

There what moves is moved otherwise, too: rays and landings by rotations in torch, with the flux that each tube has.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bstcad.designs.folder import read_nominal
from bstcad.manufacture.tolerance.perturbations import THERMAL_COEFFICIENTS, Setup, kinds
from bstcad.optics.lens.interfaces import cross
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.media import refractive_index
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.rays import Rays
from bstcad.optics.trace import tubes
from bstcad.optics.trace.measure import tubes_picture
from bstcad.optics.trace.tubes import collect

TUBES, WEIGHTS = 257, 8
MATERIAL = "PMMA"
SMALL, TURNED = 1e-4, 5e-4  # mm and degrees
STEPS = {  # steps of the differences, in the unit of each kind: no light moves by more than a hundredth of a pixel
    **{f"{part}.{kind}": SMALL for part in ("lens", "source") for kind in ("decentre_x", "decentre_y", "axial")},
    **{f"screen.{kind}": 5 * SMALL for kind in ("decentre_x", "decentre_y", "axial")},
    **{f"{part}.tilt_{axis}": TURNED for part in ("lens", "source", "screen") for axis in "xy"},
    "screen.clocking": TURNED,
    "lens.thickness": 1e-3,
    "lens.index": 1e-5,
    "lens.front_power": 1e-5,
    "lens.scale": 1e-5,
    "wavelength": 0.1,
    "temperature": 0.1,
}
# Where the sheet of tubes moves with the light, so that it has no part in the differences: a beam, or a cone that is
# not tilted.
LIGHT = {
    "cone": [name for name in STEPS if not name.startswith(("lens.tilt", "source.tilt"))],
    "beam": [name for name in STEPS if "tilt" in name or name == "lens.index"],
}


@pytest.fixture(scope="module")
def setups(small_design):
    """Light that falls within the lens: none of its rim changes with what the lens cuts."""
    nominal = read_nominal(small_design.folder)
    (channel, *_), line = nominal.channels, nominal.channels[0].source.wavelength
    cone = PointSource((0.5, 0.0, -60.0), profile="uniform", half_angle=2.0, wavelength=line)
    beam = CollimatedSource(Circle(2.5), z=0.0, wavelength=line, centre=(0.31, 0.17))
    near = Screen(150.0, (-8.0, 6.0), (-7.0, 5.0), (32, 24))  # where the beam is still wide
    return {
        "cone": Setup(nominal.lens, (Channel(cone, channel.index),), nominal.goals[0].screen),
        "beam": Setup(nominal.lens, (Channel(beam, channel.index),), near),
    }


@pytest.fixture(scope="module")
def weights(setups):
    draw = torch.Generator().manual_seed(4)
    return {
        light: torch.randn((WEIGHTS, *setup.screen.shape), generator=draw, dtype=torch.float64)
        for light, setup in setups.items()
    }


@pytest.fixture(scope="module")
def by_adjoint(setups, weights):
    """Derivatives of Σ w E by the amounts of each kind, {light: {name: (WEIGHTS,)}}."""
    found = {}
    for light, setup in setups.items():
        amounts = {name: torch.zeros((), dtype=torch.float64, requires_grad=True) for name in STEPS}
        picture = traced(setup, amounts)
        rows = [
            torch.autograd.grad((w * picture).sum(), list(amounts.values()), retain_graph=True) for w in weights[light]
        ]
        found[light] = dict(zip(STEPS, torch.tensor(rows, dtype=torch.float64).T, strict=True))
    return found


@pytest.mark.parametrize(("light", "name"), [(light, name) for light, names in LIGHT.items() for name in names])
def test_differences_agree_with_the_adjoint(setups, weights, by_adjoint, light, name):
    """The RMS over random weights estimates the norm of the derivative picture, and of what it is off."""
    kind, step = kinds(setups[light], MATERIAL)[name], STEPS[name]
    off = (kind.apply(setups[light], by) for by in (step, -step))
    more, less = (tubes_picture(one.lens, one.channels, one.screen, TUBES) for one in off)
    found = (weights[light] * (more - less)).sum((1, 2)) / (2 * step)
    assert float(found.norm()) > 0
    assert float((found - by_adjoint[light][name]).norm()) < 0.01 * float(found.norm())


def traced(setup: Setup, amounts: dict[str, torch.Tensor]) -> torch.Tensor:
    """The picture with amounts that have gradients."""
    lens, screen, source = setup.lens, setup.screen, setup.channels[0].source
    flux = tubes.launch_tubes(source, lens, TUBES).flux
    corners = tubes._sheet(source, lens, TUBES).rows(tubes.ALL)
    rays = moved(source.rays_through(*corners, lens.entrance.z, 1.0), setup.pivot("source"), amounts, "source")
    rays = moved(rays, setup.pivot("lens"), amounts, "lens", back=True)
    lens = made(setup, amounts)
    for interface in lens.interfaces:
        rays = cross(rays, interface).rays
    rays = moved(rays, setup.pivot("lens"), amounts, "lens")
    rays = moved(rays, screen.middle, amounts, "screen", back=True)
    landed = screen.receiver.to(rays)
    return collect(screen.pixels_of(landed.position[:2]), flux, screen.shape)[0]


def moved(rays: Rays, about: tuple, amounts: dict[str, torch.Tensor], part: str, back: bool = False) -> Rays:
    """Rays after the motion of a part, or before it."""
    zero = torch.zeros((), dtype=torch.float64)
    shift = torch.stack([amounts.get(f"{part}.{k}", zero) for k in ("decentre_x", "decentre_y", "axial")])
    turn = torch.stack([amounts.get(f"{part}.{k}", zero) for k in ("tilt_x", "tilt_y", "clocking")]).deg2rad()
    cells = [[0 * turn[0], -turn[2], turn[1]], [turn[2], 0 * turn[0], -turn[0]], [-turn[1], turn[0], 0 * turn[0]]]
    rotation = torch.matrix_exp(torch.stack([torch.stack(row) for row in cells]))
    place = torch.tensor(about, dtype=torch.float64).view(3, 1, 1)
    shift = shift.view(3, 1, 1)
    whole = torch.stack([*rays.position[:2], rays.above(0.0)]) - place

    def turned(r: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        return torch.einsum("ij,jkl->ikl", r, v.expand(3, *rays.status.shape))

    here = turned(rotation.T, whole - shift) if back else turned(rotation, whole) + shift
    direction = turned(rotation.T if back else rotation, rays.direction)
    return replace(rays, position=here + place, direction=direction, z=0.0, axial=False)


def made(setup: Setup, amounts: dict[str, torch.Tensor]) -> Lens:
    """The lens by what is off of itself: thickness, front, size, index."""
    lens, (channel,) = setup.lens, setup.channels
    (_, _, middle), line = setup.pivot("lens"), channel.source.wavelength
    dispersion = (refractive_index(MATERIAL, line + 1) - refractive_index(MATERIAL, line - 1)) / 2
    expansion, of_index = THERMAL_COEFFICIENTS[MATERIAL]
    index = channel.index + amounts["lens.index"] + dispersion * amounts["wavelength"]
    index = index + of_index * amounts["temperature"]
    factor = 1 + amounts["lens.scale"] + expansion * amounts["temperature"]
    rim2 = sum(p * p for p in lens.outline.farthest)
    front = lens.front.moved(middle + factor * (lens.front.z - middle)).with_parameters(
        curvature=(lens.front.curvature + 2 * amounts["lens.front_power"] / rim2) / factor
    )
    back = replace(
        lens.back,
        z=middle + factor * (lens.back.z - middle) + amounts["lens.thickness"],
        heights=factor * lens.back.heights,
        x=tuple(factor * end for end in lens.back.x),
        y=tuple(factor * end for end in lens.back.y),
    )
    return replace(lens, index=index).with_front(front).with_back(back).unbounded()
