"""The fused crossing of a net against the plain torch form: values, fates and gradients."""

from dataclasses import replace

import pytest
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.losses import AbsorptionLoss, FresnelLoss, Losses
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.receivers import LevelPlane, TiltedPlane
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import Circle, Rectangle, Rounded
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace import trace
from tests.lenses import lens_of, uniform, wavy
from tests.optics.kernels.arrays import DTYPES, close
from tests.optics.lens.test_mirror import LIGHTS, bumpy, mirror
from tests.tracing import from_first_net_plain, from_first_net_to_each_plain, stratified


def deep(dtype=torch.float64, depth=4.0, m=17):
    """A bowl steep enough at its rim that some rays are totally reflected."""
    return wavy(dtype, m, depth, 0.2, z=22.0, half=11.0)


SCENES = {  # a source, a front, an outline; every Status that rays through a window larger than the lens end with
    "point": (PointSource(), Sphere(15.0, -0.02), Rectangle(20.0, 20.0), {0, 1, 2, 3}),
    "point, plane front, round": (PointSource(position=(1.0, -2.0, 3.0)), Plane(15.0), Circle(10.0), {0, 1, 2, 3}),
    "collimated": (CollimatedSource(Circle(12.0)), Plane(15.0), Rectangle(20.0, 20.0), {0, 1, 3}),
    "point, round corners": (PointSource(), Sphere(15.0, -0.02), Rounded(20.0, 18.0, corner_radius=6.0), {0, 1, 2, 3}),
    "collimated, sphere": (CollimatedSource(Circle(12.0)), Sphere(15.0, -0.05), Circle(10.0), {0, 1, 2, 3}),
}


@pytest.mark.parametrize("scene", SCENES)
@DTYPES
def test_landings_and_their_gradient(scene, dtype):
    source, front, outline, fates = SCENES[scene]
    lens = Lens.between(front, deep(dtype=dtype), outline, 1.6)
    x, y = stratified(Rectangle(23.0, 23.0), 90, 0, dtype)
    in_glass = trace.to_first_net(source.rays_through(x, y, 15.0, 1.0), lens)
    z, weight = LevelPlane(400.0), uniform((2, *x.shape), 1)
    results = []
    for form, kind in ((trace.from_first_net, dtype), (from_first_net_plain, torch.float64)):
        heights = lens.back.heights.detach().to(kind).requires_grad_()
        bundle = replace(in_glass, position=in_glass.position.to(kind), direction=in_glass.direction.to(kind))
        landed = form(bundle, lens.with_back(replace(lens.back, heights=heights)), z)
        merit = torch.where(landed.alive, (landed.position * weight.to(kind)).sum(0), 0.0).sum()
        results.append((landed, torch.autograd.grad(merit, heights)[0]))
    (kernel, g), (plain, g_plain) = results
    assert set(plain.status.unique().tolist()) == fates
    assert torch.equal(kernel.status, plain.status)
    assert kernel.position.shape == (2, 90, 90) and kernel.position.dtype == g.dtype == dtype
    assert torch.isfinite(kernel.position).all() and torch.isfinite(g).all()
    there = plain.alive
    # rays next to total reflection run far off and hang on every digit: relative to where they land
    expected = plain.position.detach()[:, there]
    error = (kernel.position.detach()[:, there].double() - expected).abs() / (1 + expected.abs())
    assert float(error.max()) < {torch.float32: 5e-7, torch.float64: 1e-11}[dtype]  # float32: its own last digit
    close(g, g_plain, dtype, float(g_plain.abs().max()), roundings=1e4 if dtype == torch.float64 else 10)


@pytest.mark.parametrize("scene", ["point", "collimated"])
def test_a_grid_of_rays_is_traced_as_its_rays_are(scene):
    """The search for a ray of a grid begins beside the hits of two rows before; that of a listed ray, at the plane."""
    source, front, outline, fates = SCENES[scene]
    lens, z = Lens.between(front, deep(), outline, 1.6), LevelPlane(400.0)
    x, y = torch.meshgrid(*(torch.linspace(-11.5, 11.5, n, dtype=torch.float64) for n in (70, 300)), indexing="ij")
    grid = trace.to_first_net(source.rays_through(x, y, 15.0, 1.0), lens)
    listed = trace.to_first_net(source.rays_through(x.reshape(-1), y.reshape(-1), 15.0, 1.0), lens)
    one, other = trace.from_first_net(grid, lens, z), trace.from_first_net(listed, lens, z)
    assert torch.equal(one.status.reshape(-1), other.status) and set(other.status.unique().tolist()) == fates
    error = (one.position.reshape(2, -1) - other.position).abs() / (1 + other.position.abs())
    assert float(error.max()) < 1e-11


def test_a_beam_meets_a_front_that_reaches_beyond_where_it_begins():
    """12 mm before the front of a lens 20 mm wide: where a beam begins is a convention, to the closed form none."""
    front = replace(deep(depth=-30.0), z=15.0)
    lens = Lens.between(front, deep(), Rectangle(20.0, 20.0), 1.6, tailored=(0, 1))
    beam = CollimatedSource(Rectangle(17.0, 17.0))
    x, y = stratified(Rectangle(17.0, 17.0), 60, 0)
    rays, interface = beam.rays_through(x, y, 15.0, 1.0), lens.interfaces[0]
    assert float(front.sag_and_slope(x, y)[0].min()) < rays.z - 5.0
    fused, plain = trace.behind(rays, interface), trace.across(rays, (interface,))
    assert fused.alive.all() and torch.equal(fused.status, plain.status)
    for ours, wanted in ((fused.position, plain.position), (fused.direction, plain.direction)):
        torch.testing.assert_close(ours, wanted, rtol=1e-12, atol=1e-12)


TILTED = TiltedPlane((3.0, 2.0, 120.0), (20.0, -10.0), 5.0)
STEEP = TiltedPlane((3.0, 2.0, 120.0), (75.0, -10.0))  # some of the light goes away from it
PLANES = {
    "level": [LevelPlane(120.0)],
    "tilted": [TILTED],
    "level ones": [LevelPlane(120.0), LevelPlane(60.0)],
    "several": [STEEP, LevelPlane(60.0), TILTED],
}
LOSSES = Losses(FresnelLoss(587.6), AbsorptionLoss(0.01))
NETS = {  # a lens, and the rays on their way to its net
    "lens": (lens_of(deep(), index=1.6), PointSource()),
    "lossy": (lens_of(deep(), index=1.6, losses=LOSSES), PointSource()),
    "mirror": (mirror(bumpy(5.0)), LIGHTS["lambertian"]),
    "lossy mirror": (
        replace(mirror(bumpy(5.0)), losses=Losses(FresnelLoss(587.6, metal=1.2 + 7j))), LIGHTS["lambertian"]
    ),
}  # fmt: skip


@pytest.mark.parametrize("plane", PLANES)
@pytest.mark.parametrize("name", NETS)
def test_the_gradient_in_the_rays_is_that_of_the_plain_form(name, plane):
    """Positions and directions before the face, landings and flux behind it; lost rays have none."""
    lens, source = NETS[name]
    x, y = stratified(Rectangle(23.0, 23.0), 60, 0)
    coming = trace.to_first_net(source.rays_through(x, y, lens.entrance.z, 1.0), lens)
    weight, gradients, landings = uniform((2, *x.shape), 1), [], []
    for form in (trace.from_first_net_to_each, from_first_net_to_each_plain):
        leaves = [t.detach().clone().requires_grad_() for t in (lens.back.heights, coming.position, coming.direction)]
        moved = lens.with_back(replace(lens.back, heights=leaves[0]))
        found = form(replace(coming, position=leaves[1], direction=leaves[2]), moved, PLANES[plane])
        merit = sum(
            torch.where(landed.alive, (landed.position * (weight + k)).sum(0) + landed.flux, 0.0).sum()
            for k, landed in enumerate(found)
        )
        gradients.append(torch.autograd.grad(merit, leaves))
        landings.append(found)
    for ours, wanted in zip(*landings, strict=True):
        there = wanted.alive
        assert 0 < int(there.sum()) < x.numel() and torch.equal(ours.status, wanted.status)
        torch.testing.assert_close(ours.position[:, there], wanted.position[:, there], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(ours.flux[there], wanted.flux[there], rtol=1e-9, atol=0)
    lost = ~torch.stack([wanted.alive for wanted in landings[1]]).any(0)
    assert not gradients[0][1][:, lost].any()
    for fused, plain in zip(*gradients, strict=True):
        torch.testing.assert_close(fused, plain, rtol=1e-9, atol=1e-11 * float(plain.abs().max()))


def test_the_gradient_in_the_rays_is_finite_differences():
    """The kernel's adjoint against the kernel's values."""
    lens = lens_of(deep(m=7, depth=1.0))
    x, y = stratified(Rectangle(12.0, 12.0), 5, 0)
    coming = trace.to_first_net(PointSource().rays_through(x, y, 15.0, 1.0), lens)

    def landing(position, direction):
        return trace.from_first_net(
            replace(coming, position=position, direction=direction), lens, LevelPlane(60.0)
        ).position

    leaves = tuple(t.detach().clone().requires_grad_() for t in (coming.position, coming.direction))
    assert torch.autograd.gradcheck(landing, leaves, fast_mode=True)


@pytest.mark.parametrize("form", [trace.from_first_net, from_first_net_plain])
@pytest.mark.parametrize(
    ("source", "name"), [(PointSource(), "direction"), (CollimatedSource(Circle(12.0)), "position")]
)
def test_a_ray_of_no_number_is_lost_alone(form, source, name):
    """An index made from it must not be out of range: on a GPU that would end the whole process."""
    lens = Lens.between(Plane(15.0), deep(), Rectangle(20.0, 20.0), 1.5)
    x, y = sampling.grid(Rectangle(10.0, 10.0), 4)
    in_glass = trace.to_first_net(source.rays_through(x, y, 15.0, 1.0), lens)
    wrong = getattr(in_glass, name).clone()
    wrong[:, 2, 1] = torch.nan
    landed = form(replace(in_glass, **{name: wrong}), lens, LevelPlane(400.0))
    expected = torch.ones_like(landed.alive)
    expected[2, 1] = False
    assert torch.equal(landed.alive, expected) and torch.isfinite(landed.position[:, expected]).all()
