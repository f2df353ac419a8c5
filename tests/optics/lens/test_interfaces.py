"""Interfaces as data: any sequence of them is walked by one function, there and back."""

from dataclasses import replace

import pytest
import torch

from bstcad.optics.lens.interfaces import Interface, Reflect, Refract, cross
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.losses import AbsorptionLoss, FresnelLoss, Losses
from bstcad.optics.lens.passes import Pass, Passes
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane, TiltedPlane
from bstcad.optics.surfaces.outlines import EVERYWHERE, Circle, Rectangle
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.surfaces import Conic, Plane, Sphere
from bstcad.optics.trace.trace import across, through, to_first_net, trace
from bstcad.optics.trace.tubes import launch_tubes
from tests import lenses
from tests.lenses import SQUARE, bundle
from tests.tracing import simulated, stratified

N = 1.5


@pytest.mark.parametrize("surface", [Plane(3.0), Sphere(3.0, 0.0), Conic(3.0, 0.0, -2.0)])
def test_a_plane_is_a_surface_of_curvature_zero(surface):
    """Light along the axis passes it unbent, to the last bit, and stays light along the axis."""
    x = torch.linspace(-3, 3, 7, dtype=torch.float64)
    rays = replace(bundle(torch.stack([x, x, 0 * x]).T, (0.0, 0.0, 1.0)), axial=True)
    hit = cross(rays, Interface(surface, EVERYWHERE, Refract(1.0, N), Status.MISSED_FRONT))
    assert surface.level and hit.rays.axial and torch.equal(hit.rays.direction, rays.direction)
    assert torch.equal(hit.rays.above(0.0), torch.full_like(x, 3.0))


# Sequences with more than a lens


WINDOW = (  # 4 mm of glass of index 1.52 from z = -8 on
    Interface(Plane(-8.0), Circle(30.0), Refract(1.0, 1.52), Status.MISSED_FRONT),
    Interface(Plane(-4.0), Circle(30.0), Refract(1.52, 1.0), Status.VIGNETTED),
)
FOLD = (Interface(Plane(60.0), Circle(40.0), Reflect(), Status.VIGNETTED),)  # light goes on along -z
SOURCE = PointSource((1.0, -2.0, -60.0))


def net(z, size, seed=1):
    """A wavy net; of another shape for another seed."""
    return lenses.net(
        lambda x, y: size * (torch.cos(0.3 * x + seed) * torch.sin(0.38 * y + 2 * seed) + 5e-3 * seed * x**2),
        z, 21, (10.0, 10.5),
    )  # fmt: skip


def rays_of(source, lens, n=40, size=16.0):
    x, y = stratified(Rectangle(size, size), n, 0)
    return source.rays_through(x, y, lens.entrance.z, 1.0)


def test_a_window_before_a_lens_and_a_fold_mirror_behind_it_are_data():
    """The window moves the light as a plate does; the mirror sends it to the plane's mirror image."""
    lens = Lens.between(Sphere(0.0, 0.01), net(6.0, 0.3), SQUARE, N)
    rays = rays_of(SOURCE, lens)
    folded = trace(rays, replace(lens, behind=FOLD), LevelPlane(60.0 - 35.0))
    torch.testing.assert_close(folded.position, trace(rays, lens, LevelPlane(60.0 + 35.0)).position, rtol=0, atol=1e-12)
    assert replace(lens, behind=FOLD).tailored_numbers == (1,) and replace(
        lens, before=WINDOW, behind=FOLD
    ).tailored_numbers == (3,)

    seen = replace(lens, before=WINDOW)
    assert seen.entrance is WINDOW[0].surface and len(seen.interfaces) == 4
    light = rays_of(SOURCE, seen, size=10.0)
    before = across(light, seen.interfaces[:2])
    sine = light.direction[:2].norm(dim=0)
    shift = 4.0 * (sine / light.direction[2] - (sine / 1.52) / torch.sqrt(1 - (sine / 1.52) ** 2))
    straight = light.position + (-4.0 - light.above(0.0)) / light.direction[2] * light.direction
    torch.testing.assert_close((straight - before.position)[:2].norm(dim=0), shift, rtol=0, atol=1e-12)
    torch.testing.assert_close(before.direction, light.direction, rtol=0, atol=1e-15)


def test_a_system_is_simulated_as_its_rays_and_its_tubes_are_traced():
    """Plain rays, since no one kernel traces the whole system, and fused tubes: the same light on the same pixels."""
    lens = replace(Lens.between(Sphere(0.0, 0.01), net(6.0, 0.2), SQUARE, N), before=WINDOW, behind=FOLD)
    screen = Screen(10.0, (-40.0, 40.0), (-40.0, 40.0), 8)
    source = PointSource((1.0, -2.0, -60.0), profile="uniform", half_angle=7.0)
    rays, tubes = simulated(source, lens, screen, 300, 0), launch_tubes(source, lens, 120).picture(lens, screen)
    assert sum(rays.flux.values()) == pytest.approx(1, abs=1e-12) and rays.flux["on target"] > 0.9
    assert float(tubes.sum()) == pytest.approx(rays.flux["on target"], rel=1e-3)
    torch.testing.assert_close(tubes, rays.box, rtol=0.05, atol=1e-4)


# Two nets


MANGIN = Passes((Pass("front", Refract), Pass("back", Reflect), Pass("front", Refract)))
LOSSES = Losses(FresnelLoss(587.6), AbsorptionLoss(0.01))
TWO = Lens.between(net(0.0, 0.4, 2), net(6.0, 0.5), SQUARE, N, tailored=(0, 1))
MIRROR = replace(FOLD[0], surface=replace(net(60.0, 0.5, 3), x=(-40.0, 40.0), y=(-40.0, 40.0)))
SYSTEMS = {
    "lens": TWO,
    "lossy lens": replace(TWO, losses=LOSSES),
    "with a window": replace(TWO, before=WINDOW, tailored=(2, 3)),
    "with a fold mirror": replace(TWO, behind=FOLD),
    "freeform fold mirror": replace(TWO, behind=(MIRROR,), tailored=(0, 1, 2)),
    "lossy Mangin mirror": replace(TWO, passes=MANGIN, losses=Losses(absorption=AbsorptionLoss(0.01))),
    "a plate between them": replace(
        TWO, tailored=(0, 4),
        behind=(*(replace(i, surface=i.surface.moved(i.surface.z + 30.0)) for i in WINDOW), MIRROR),
    ),
}  # fmt: skip
PLANES = {"level": LevelPlane(15.0), "tilted": TiltedPlane((3.0, 2.0, 15.0), (20.0, -10.0), 5.0)}


def test_light_goes_through_a_mangin_mirror_as_snell_has_it():
    """Between flat faces t mm apart a ray of sine s is displaced by 2 t s / r, on a path of 2 t n / r, r² = n² - s²."""
    flat = [net(z, 0.0) for z in (0.0, 6.0)]
    lens = Lens.between(*flat, SQUARE, N, passes=MANGIN)
    assert lens.passes.sense == 1 and lens.passes.reversal == -1 and lens.number_of("back") == 1
    assert [interface.surface for interface in lens.interfaces] == [flat[0], flat[1], flat[0]]
    rays = rays_of(SOURCE, lens, size=10.0)
    landed = trace(rays, lens, LevelPlane(-20.0))
    sine = rays.direction[:2].norm(dim=0)
    way = (20.0 - rays.above(0.0)) / rays.direction[2] + 12.0 / torch.sqrt(N**2 - sine**2)  # times the direction
    wanted = rays.position[:2] + way * rays.direction[:2]
    torch.testing.assert_close(landed.position[:2], wanted, rtol=0, atol=1e-12)
    losses = replace(lens, losses=Losses(absorption=AbsorptionLoss(0.01)))
    path = 12.0 * N / torch.sqrt(N**2 - sine**2)  # through the glass twice
    torch.testing.assert_close(trace(rays, losses, LevelPlane(-20.0)).flux, rays.flux * torch.exp(-0.01 * path))


def test_a_mangin_mirror_is_simulated_as_its_tubes_are_traced():
    """Light that comes back to the front beside its rim is lost: a fifth of what enters."""
    lens = Lens.between(Sphere(0.0, 0.01), net(6.0, 0.2), SQUARE, N, passes=MANGIN)
    screen = Screen(-30.0, (-60.0, 60.0), (-60.0, 60.0), 8)
    source = PointSource((1.0, -2.0, -60.0), profile="uniform", half_angle=30.0)
    rays, tubes = simulated(source, lens, screen, 600, 0), launch_tubes(source, lens, 240).picture(lens, screen)
    assert rays.flux["lost through the sides"] > 0.15 * rays.flux["on target"]
    assert float(tubes.sum()) == pytest.approx(rays.flux["on target"], rel=3e-3)


def test_the_metal_of_a_mangin_mirror_is_met_from_the_glass():
    """The face reflects |(m - n) / (m + n)|² at normal incidence, and light crosses a bare front before and after."""
    metal, flat = 1.2 + 6.0j, [net(z, 0.0) for z in (0.0, 6.0)]
    lens = Lens.between(*flat, SQUARE, N, passes=MANGIN, losses=Losses(FresnelLoss(587.6, metal=metal)))
    rays = CollimatedSource(Rectangle(4.0, 4.0)).rays_through(*stratified(Rectangle(4.0, 4.0), 4, 0), 0.0, 1.0)
    left = trace(rays, lens, LevelPlane(-20.0)).flux / rays.flux
    wanted = (1 - ((N - 1) / (N + 1)) ** 2) ** 2 * abs((metal - N) / (metal + N)) ** 2
    torch.testing.assert_close(left, torch.full_like(left, wanted), rtol=1e-12, atol=0)


def plainly(rays, interfaces, planes):
    behind = across(rays, interfaces)
    return tuple(plane.land(behind) for plane in planes)


@pytest.mark.parametrize("plane", PLANES)
@pytest.mark.parametrize("name", SYSTEMS)
def test_the_gradient_through_several_nets_is_that_of_plain_torch(name, plane):
    lens, found = SYSTEMS[name], []
    goal = PLANES[plane]
    if lens.passes.reflects:  # the plane is ahead of the light
        goal = LevelPlane(-60.0) if plane == "level" else replace(goal, centre=(3.0, 2.0, -60.0))
    elif lens.interfaces[-1].law.reverses is False:
        goal = LevelPlane(120.0) if plane == "level" else replace(goal, centre=(3.0, 2.0, 120.0))
    rays = rays_of(SOURCE, lens, size=23.0)
    weight = torch.randn((2, 40, 40), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    for form in (through, plainly):
        heights = [surface.heights.clone().requires_grad_() for surface in lens.nets]
        moved = lens.with_heights(heights)
        [landed] = form(to_first_net(rays, moved), moved.interfaces[moved.tailored_numbers[0] :], [goal])
        value = torch.where(landed.alive, (landed.position * weight).sum(0) + landed.flux, 0.0).sum()
        found.append((landed, torch.autograd.grad(value, heights)))
    (fused, ours), (plain, wanted) = found
    assert torch.equal(fused.status, plain.status) and 100 < int(plain.alive.sum()) < 1600
    torch.testing.assert_close(fused.position[:, plain.alive], plain.position[:, plain.alive], rtol=0, atol=1e-9)
    for g, other in zip(ours, wanted, strict=True):
        assert float((g - other).norm() / other.norm()) < 1e-10


def test_the_gradient_through_two_nets_is_finite_differences():
    rays, change = rays_of(SOURCE, TWO, size=14.0), [torch.cos(torch.arange(21.0) + k).double() for k in (0, 1)]
    change = [c[:, None] * c for c in change]

    def value(share):
        moved = TWO.with_heights(s.heights + share * c for s, c in zip(TWO.nets, change, strict=True))
        return (trace(rays, moved, LevelPlane(120.0)).position ** 2).mean()

    at, step = torch.zeros((), dtype=torch.float64, requires_grad=True), 1e-5
    (slope,) = torch.autograd.grad(value(at), at)
    assert float(slope) == pytest.approx(float((value(step) - value(-step)) / (2 * step)), rel=1e-7)


def test_beyond_a_net_the_gradient_is_that_of_its_rim():
    """The front sends light past the back's net: sag and slopes do not change across the rim."""
    lens = TWO.with_back(replace(TWO.back, x=(-5.0, 5.0), y=(-5.25, 5.25))).unbounded()
    rays, way = rays_of(SOURCE, lens, size=18.0), torch.cos(torch.arange(21.0)).double()

    def value(share, form):
        moved = lens.with_heights((lens.front.heights + share * way[:, None] * way, lens.back.heights))
        [landed] = form(to_first_net(rays, moved), moved.interfaces, [LevelPlane(120.0)])
        return (landed.position**2).mean()

    for form in (through, plainly):
        at, step = torch.zeros((), dtype=torch.float64, requires_grad=True), 1e-5
        (slope,) = torch.autograd.grad(value(at, form), at)
        assert float(slope) == pytest.approx(float((value(step, form) - value(-step, form)) / (2 * step)), rel=1e-6)


def test_tubes_wait_before_the_first_free_interface():
    """Whichever that is, they throw the same picture."""
    lens, screen = SYSTEMS["freeform fold mirror"], Screen(15.0, (-60.0, 60.0), (-60.0, 60.0), 12)
    pictures = []
    for free in ((0, 1, 2), (1,), (2,)):
        seen = replace(lens, tailored=free)
        pictures.append(launch_tubes(SOURCE, seen, 40).picture(seen, screen))
    assert float(pictures[0].sum()) > 0.01
    for picture in pictures[1:]:
        torch.testing.assert_close(picture, pictures[0], rtol=1e-9, atol=1e-12)
