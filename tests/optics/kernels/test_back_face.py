"""The fused kernels of the back face against the plain torch form: values, fates and gradients."""

from dataclasses import replace

import pytest
import torch

from bstcad.optics import sampling, trace
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle, Rounded
from bstcad.optics.sources import Collimated, Point
from bstcad.optics.surfaces import Plane, Sphere
from tests.optics.kernels.arrays import DTYPES, close, uniform


def deep(m=17, dtype=torch.float64, depth=4.0):
    """A bowl steep enough at its rim that some rays are totally reflected."""
    line = torch.linspace(-1, 1, m, dtype=torch.float64)
    x, y = line[:, None], line[None, :]
    h = depth * (x**2 + 0.8 * y**2) + 0.2 * torch.sin(5 * x) * torch.cos(4 * y)
    return BSplineSurface(22.0, h.to(dtype), (-11.0, 11.0), (-11.0, 11.0))


SCENES = {  # a source, a front, an outline; every Status that rays through a window larger than the lens end with
    "point": (Point(), Sphere(15.0, -0.02), Rectangle(20.0, 20.0), {0, 1, 2, 3}),
    "point, plane front, round": (Point(position=(1.0, -2.0, 3.0)), Plane(15.0), Circle(10.0), {0, 1, 2, 3}),
    "collimated": (Collimated(Circle(12.0)), Plane(15.0), Rectangle(20.0, 20.0), {0, 1, 3}),
    "point, round corners": (Point(), Sphere(15.0, -0.02), Rounded(20.0, 18.0, corner_radius=6.0), {0, 1, 2, 3}),
    "collimated, sphere": (Collimated(Circle(12.0)), Sphere(15.0, -0.05), Circle(10.0), {0, 1, 2, 3}),
}


@pytest.mark.parametrize("scene", SCENES)
@DTYPES
def test_through_back_and_its_gradient(scene, dtype):
    source, front, outline, fates = SCENES[scene]
    lens = Lens(front, deep(dtype=dtype), outline, 1.6)
    x, y = sampling.stratified(Rectangle(23.0, 23.0), 90, 0, dtype)
    in_glass = trace.towards_back(source.rays(x, y, 15.0, 1.0), lens)
    z, weight = 400.0, uniform(2 * x.numel(), 1).view(2, *x.shape)
    results = []
    for form, kind in ((trace.through_back, dtype), (trace.through_back_plain, torch.float64)):
        heights = lens.back.heights.detach().to(kind).requires_grad_()
        bundle = replace(in_glass, position=in_glass.position.to(kind), direction=in_glass.direction.to(kind))
        landed = form(bundle, replace(lens, back=replace(lens.back, heights=heights)), z)
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


def test_through_back_gradient_is_finite_differences():
    """Not through the plain form: the kernel's adjoint against the kernel's values."""
    back = deep(m=7, depth=1.0)
    x, y = sampling.stratified(Rectangle(12.0, 12.0), 5, 0)
    lens = Lens(Sphere(15.0, -0.02), back, Rectangle(20.0, 20.0), 1.5)
    in_glass = trace.towards_back(Point().rays(x, y, 15.0, 1.0), lens)

    def landing(heights):
        return trace.through_back(in_glass, replace(lens, back=replace(back, heights=heights)), 60.0).position

    assert trace.through_back(in_glass, lens, 60.0).alive.all()
    assert torch.autograd.gradcheck(landing, (back.heights.clone().requires_grad_(),), fast_mode=True)


def test_rays_that_need_a_gradient_themselves_take_the_plain_form():
    """The kernel has a gradient in the net only; a tailored front must not lose its own."""
    c = torch.tensor(-0.02, dtype=torch.float64, requires_grad=True)
    lens = Lens(Sphere(15.0, c), deep(), Rectangle(20.0, 20.0), 1.5)
    x, y = sampling.grid(Rectangle(10.0, 10.0), 4)
    landed = trace.trace(Point().rays(x, y, 15.0, 1.0), lens, 400.0)
    (g,) = torch.autograd.grad(landed.position.square().sum(), c)
    assert torch.isfinite(g) and float(g) != 0.0


@pytest.mark.parametrize("form", [trace.through_back, trace.through_back_plain])
def test_a_ray_of_no_number_is_lost_alone(form):
    """An index made from it must not be out of range: on a GPU that would end the whole process."""
    lens = Lens(Plane(15.0), deep(), Rectangle(20.0, 20.0), 1.5)
    x, y = sampling.grid(Rectangle(10.0, 10.0), 4)
    in_glass = trace.towards_back(Point().rays(x, y, 15.0, 1.0), lens)
    direction = in_glass.direction.clone()
    direction[:, 2, 1] = torch.nan
    landed = form(replace(in_glass, direction=direction), lens, 400.0)
    expected = torch.ones_like(landed.alive)
    expected[2, 1] = False
    assert torch.equal(landed.alive, expected) and torch.isfinite(landed.position[:, expected]).all()


def test_nothing_depends_on_how_the_rays_are_cut():
    """Chunks of 4096 and one of another size: bit-equal landings."""
    lens = Lens(Plane(15.0), deep(), Rectangle(20.0, 20.0), 1.5)
    x, y = (a.reshape(-1) for a in sampling.stratified(Rectangle(20.0, 20.0), 100, 0))
    whole = trace.trace(Point().rays(x, y, 15.0, 1.0), lens, 400.0)
    pieces = zip(x.split(777), y.split(777), strict=True)
    cut = [trace.trace(Point().rays(a, b, 15.0, 1.0), lens, 400.0) for a, b in pieces]
    assert torch.equal(torch.cat([c.position for c in cut], dim=1), whole.position)
    assert torch.equal(torch.cat([c.status for c in cut]), whole.status)
