"""The fused crossing of a radial surface against the plain torch form: values, fates, gradients, and equal bits."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bstcad.optics.lens.interfaces import Interface, Law, Reflect, Refract, cross
from bstcad.optics.lens.losses import AbsorptionLoss, FresnelLoss, Losses
from bstcad.optics.receivers.directions import Directions
from bstcad.optics.receivers.receivers import LevelPlane, TiltedPlane
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.charts import SphereChart
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.rays import Rays, Status
from bstcad.optics.trace import trace
from tests.lenses import bundle, uniform

R, Z, INDEX = 15.0, 3.0, 1.5  # radius and z of the centre (mm), refractive index
RIM = SphereChart(R).length(math.radians(85.0))  # clear aperture in the chart (mm)
OUTLINE = Circle(0.95 * RIM)
OUT = Refract(INDEX, 1.0)
LEVEL, STEEP = LevelPlane(200.0), TiltedPlane((3.0, 2.0, 120.0), (75.0, -10.0))
TILTED = TiltedPlane((3.0, 2.0, 120.0), (20.0, -10.0), 5.0)
RECEIVERS = {
    "level": [LEVEL], "tilted": [TILTED], "C": [Directions("C")], "A": [Directions("A")], "B": [Directions("B")],
    "several": [STEEP, LEVEL, TILTED],
}  # fmt: skip
ALIVE, VIGNETTED, TOTAL, TURNED = Status.ALIVE, Status.VIGNETTED, Status.TOTAL_REFLECTION, Status.TURNED_BACK


def dome(m: int = 17, ripple: float = 0.2) -> RadialSurface:
    """A dome that is lower at its rim, with ripples; no mirror image of itself."""
    line = torch.linspace(-1, 1, m, dtype=torch.float64)
    x, y = line[:, None], line[None, :]
    h = -1.5 * (x**2 + 0.7 * y**2) + ripple * torch.sin(5 * x + 0.3) * torch.cos(4 * y)
    return replace(RadialSurface.sphere(Z, R, (RIM, RIM), (m, m)), heights=h)


def interface_of(surface: RadialSurface, losses: Losses | None = None, law: Law = OUT) -> Interface:
    face = Interface(surface, OUTLINE, law, VIGNETTED)
    return losses.on((replace(face, law=Refract(1.0, INDEX)), face))[1] if losses else face


def from_point(n: int, position=(0.0, 0.0, 0.0), sides: tuple[int, int] | None = None) -> Rays:
    """Rays from a point, given relative to the centre of the dome, to a grid on the sphere of radius R."""
    x, y = sampling.grid(Rectangle(2.05 * RIM, 2.05 * RIM), sides or n)
    start = torch.tensor(position, dtype=torch.float64).view(3, 1, 1)
    path = R * SphereChart(R).direction(x, y) - start
    rays = bundle(start.expand_as(path).reshape(3, -1).T, (0.0, 0.0, 1.0))
    direction = path / torch.sqrt((path * path).sum(0))
    return replace(
        rays, position=start.expand_as(path).contiguous(), direction=direction, axial=False, z=Z,
        flux=torch.ones_like(x), status=torch.zeros(x.shape, dtype=torch.uint8),
    )  # fmt: skip


def anywhere(n: int) -> Rays:
    """Rays in all directions from anywhere inside the dome."""
    numbers = torch.randn((3, n), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    direction = numbers / torch.sqrt((numbers * numbers).sum(0))
    rays = from_point(1, sides=(n, 1))
    return replace(rays, position=12.0 * (uniform((3, n, 1), 3) - 0.5), direction=direction[..., None])


RAYS = {  # rays, and the fates of some of them; near the rim light is totally reflected, and grazes the dome
    "centre": (from_point(40), {ALIVE, VIGNETTED}),
    "beside": (from_point(40, (11.0, -3.0, 2.0)), {ALIVE, VIGNETTED, TOTAL}),
    "anywhere": (anywhere(1600), {ALIVE, VIGNETTED, TOTAL}),
}


def gradients(rays, surface, planes, plain, losses=None):
    """Receivers' light, and the gradient of a merit in heights, positions and directions (their part across them)."""
    heights, position, direction = (
        t.detach().clone().requires_grad_() for t in (surface.heights, rays.position, rays.direction)
    )
    face = interface_of(replace(surface, heights=heights), losses)
    coming = replace(rays, position=position, direction=direction)
    landings = (
        tuple(p.land(cross(coming, face).rays) for p in planes) if plain else trace.through(coming, [face], planes)
    )
    weight = uniform((2, *rays.flux.shape), 1)
    merit = sum(
        # bounded, since rays that graze a plane land far away
        torch.where(each.alive, (torch.tanh(each.position / 300.0) * (weight + k)).sum(0) + each.flux, 0.0).sum()
        for k, each in enumerate(landings)
    )
    by_heights, by_position, by_direction = torch.autograd.grad(merit, (heights, position, direction))
    across = by_direction - (by_direction * rays.direction).sum(0) * rays.direction
    return landings, (by_heights, by_position, across)


@pytest.mark.parametrize(
    ("name", "receivers"), [("centre", "level"), ("anywhere", "level"), *(("beside", r) for r in RECEIVERS)]
)
def test_landings_and_gradients_are_those_of_the_plain_form(name, receivers):
    rays, fates = RAYS[name]
    planes = RECEIVERS[receivers]
    ours, plain = (gradients(rays, dome(), planes, plain=form) for form in (False, True))
    for one, other in zip(ours[0], plain[0], strict=True):
        there, expected = other.alive, other.position.detach()
        assert torch.equal(one.status, other.status) and set(other.status.unique().tolist()) >= {int(f) for f in fates}
        error = (one.position.detach() - expected).abs()[:, there] / (1 + expected.abs())[:, there]
        assert float(error.max()) < 1e-10
    lost = ~torch.stack([other.alive for other in plain[0]]).any(0)
    assert not ours[1][1][:, lost].any() and not ours[1][2][:, lost].any()
    for one, other in zip(ours[1], plain[1], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-10 * float(other.abs().max()))


def test_losses_follow_path_and_angle():
    losses = Losses(FresnelLoss(587.6), AbsorptionLoss(0.01))
    rays = RAYS["beside"][0]
    (ours, g), (plain, g_plain) = (gradients(rays, dome(), [LEVEL], form, losses) for form in (False, True))
    flux, expected = (each[0].flux.detach()[plain[0].alive] for each in (ours, plain))
    assert float(expected.min()) < 0.5 < 0.9 < float(expected.max())  # Fresnel's reflection near the critical angle
    torch.testing.assert_close(flux, expected, rtol=1e-9, atol=0)
    assert ours[0].taken.keys() == plain[0].taken.keys()
    for one, other in zip(g, g_plain, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-10 * float(other.abs().max()))


@pytest.mark.parametrize("law", [OUT, Reflect()], ids=["refract", "reflect"])
def test_rays_behind_the_dome_are_those_of_the_plain_form(law):
    rays, face = RAYS["anywhere"][0], interface_of(dome(), law=law)
    ours, plain = trace.behind(rays, face), cross(rays, face).rays
    assert torch.equal(ours.status, plain.status) and 0 < int(plain.alive.sum()) < plain.alive.numel()
    assert (ours.z, ours.sense, ours.axial, ours.chart) == (plain.z, plain.sense, plain.axial, plain.chart)
    for one, other in ((ours.position, plain.position), (ours.direction, plain.direction)):
        torch.testing.assert_close(one[:, plain.alive], other[:, plain.alive], rtol=0, atol=1e-10)

    def gradient(behind):
        heights = dome().heights.clone().requires_grad_()
        found = behind(rays, interface_of(replace(dome(), heights=heights), law=law))
        weight = uniform((2, 3, *rays.flux.shape), 2)
        both = weight[0] * found.position / 15.0 + weight[1] * found.direction
        return torch.autograd.grad(torch.where(found.alive, both, 0.0).sum(), heights)[0]

    one, other = gradient(trace.behind), gradient(lambda rays, face: cross(rays, face).rays)
    torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-10 * float(other.abs().max()))


def test_the_gradient_is_finite_differences():
    """The kernel's adjoint against the kernel's values, from a source beside the centre."""
    rays, surface = from_point(6, (2.0, -3.0, 1.0)), dome(m=7)
    inside = cross(rays, interface_of(surface)).rays.alive
    assert int(inside.sum()) > 20

    def landing(heights, position, direction):
        direction = direction / torch.sqrt((direction * direction).sum(0))
        [found] = trace.through(
            replace(rays, position=position, direction=direction),
            [interface_of(replace(surface, heights=heights))],
            [LEVEL],
        )
        return torch.where(found.alive & inside, torch.tanh(found.position / 300.0), 0.0)

    leaves = [t.detach().clone().requires_grad_() for t in (surface.heights, rays.position, rays.direction)]
    assert torch.autograd.gradcheck(landing, leaves, eps=1e-5, atol=1e-7, rtol=1e-5, fast_mode=True)


def test_single_precision():
    rays, surface = RAYS["centre"][0], dome()
    [plain] = (p.land(cross(rays, interface_of(surface)).rays) for p in [LEVEL])
    heights = surface.heights.float().requires_grad_()
    coming = replace(rays, position=rays.position.float(), direction=rays.direction.float(), flux=rays.flux.float())
    [found] = trace.through(coming, [interface_of(replace(surface, heights=heights))], [LEVEL])
    (g,) = torch.autograd.grad(found.position.sum(), heights)
    both = found.alive & plain.alive
    assert found.position.dtype == g.dtype == torch.float32
    assert torch.isfinite(g).all() and int((found.alive != plain.alive).sum()) <= 2
    error = (found.position.detach().double() - plain.position).abs() / (1 + plain.position.abs())
    assert float(error[:, both].max()) < 1e-4


def test_a_grid_of_rays_is_traced_as_its_rays_are():
    """The search for a ray of a grid begins beside the hits of two rows before; that of a listed ray, at the sphere."""
    rays, face = from_point(0, (9.0, -3.0, 2.0), sides=(60, 300)), interface_of(dome(m=33, ripple=0.8))
    listed = replace(
        rays, position=rays.position.reshape(3, -1), direction=rays.direction.reshape(3, -1),
        flux=rays.flux.reshape(-1), status=rays.status.reshape(-1),
    )  # fmt: skip
    [one], [other] = (trace.through(each, [face], [LEVEL]) for each in (rays, listed))
    assert torch.equal(one.status.reshape(-1), other.status) and other.alive.any() and not other.alive.all()
    error = (one.position.reshape(2, -1) - other.position).abs() / (1 + other.position.abs())
    assert float(error.max()) < 1e-9  # near the critical angle the direction depends on every digit


def test_no_bit_depends_on_the_number_of_threads():
    rays, surface = from_point(260, (2.0, -3.0, 1.0)), dome(m=33)
    threads, found = torch.get_num_threads(), []
    try:
        for n in (1, 2, 4):
            torch.set_num_threads(n)
            [landed], slopes = gradients(rays, surface, [LEVEL], plain=False)
            found.append((landed.position, landed.status, *slopes))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(own, first) for each in found for own, first in zip(each, found[0], strict=True))


def test_a_ray_of_no_number_is_lost_alone():
    rays, face = from_point(6), interface_of(dome())
    [whole] = trace.through(rays, [face], [LEVEL])
    wrong = rays.direction.clone()
    wrong[:, 2, 3] = torch.nan
    [found] = trace.through(replace(rays, direction=wrong), [face], [LEVEL])
    expected = whole.alive.clone()
    assert expected[2, 3]
    expected[2, 3] = False
    assert torch.equal(found.alive, expected)
    assert torch.equal(found.position[:, expected], whole.position[:, expected])


def test_light_along_minus_z_takes_the_plain_form():
    rays, face = replace(from_point(6), sense=-1), interface_of(dome())
    assert torch.equal(trace.behind(rays, face).status, cross(rays, face).rays.status)
