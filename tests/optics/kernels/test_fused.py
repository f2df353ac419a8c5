"""The fused kernels against the plain torch forms they stand for: values, fates and gradients."""

from dataclasses import replace

import pytest
import torch

from bstcad.optics import irradiance, sampling, spline_basis, trace
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.irradiance import Screen
from bstcad.optics.kernels import fused
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.rays import Landed
from bstcad.optics.sources import Collimated, Point
from bstcad.optics.surfaces import Plane, Sphere

DTYPES = pytest.mark.parametrize("dtype", (torch.float32, torch.float64))
LAYOUTS = {
    "one row": lambda t: t,
    "three axes": lambda t: t.view(5, 7, -1),
    "every other": lambda t: t[::2],
    "transposed": lambda t: t.view(35, -1).T,
    "one": lambda t: t[:1],
    "none": lambda t: t[:0],
}


def uniform(n, seed, dtype=torch.float64):
    return torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def close(a, b, dtype, scale=1.0, roundings=50):
    torch.testing.assert_close(a.double(), b.double(), rtol=0, atol=roundings * scale * torch.finfo(dtype).eps)


@DTYPES
def test_kernels_serve_matching_cpu_tensors_only(dtype):
    a = torch.zeros(3, dtype=dtype)
    assert fused.serves(a, a)
    assert not fused.serves(a, a.to(torch.float16))
    assert not fused.serves(a, torch.zeros(3, dtype=torch.float64 if dtype == torch.float32 else torch.float32))
    assert not fused.serves(a.to("meta"), a.to("meta"))


@DTYPES
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("m", (5, 33))
def test_evaluate_and_its_gradients(m, layout, dtype):
    """Also with a net that is not contiguous, and where autograd hands over expanded gradients."""
    n = 5 * 7 * 300  # several chunks
    u, v = (LAYOUTS[layout](uniform(n, s, dtype) * (m - 1)) for s in (0, 1))
    net = (uniform(m * m, 2).view(m, m) - 0.5).to(dtype).T
    weights = [LAYOUTS[layout](uniform(n, s, dtype)) for s in (3, 4, 5)]
    results = []
    for evaluate, kind in ((spline_basis.evaluate, dtype), (spline_basis.evaluate_plain, torch.float64)):
        inputs = [t.detach().to(kind).requires_grad_() for t in (net, u, v)]
        out = evaluate(*inputs)
        merit = sum((o * w.to(kind)).sum() for o, w in zip(out, weights, strict=True)) + out[0].sum()
        results.append((out, torch.autograd.grad(merit, inputs)))
    (out, grads), (plain, plain_grads) = results
    for a, b in zip(out, plain, strict=True):
        assert a.dtype == dtype and a.shape == u.shape
        close(a.detach(), b.detach(), dtype)
    for a, b, like in zip(grads, plain_grads, (net, u, v), strict=True):
        assert a.dtype == dtype and a.shape == like.shape
        close(a, b, dtype, max(1.0, float(b.abs().max()) if b.numel() else 1.0))


@DTYPES
@pytest.mark.parametrize("layout", LAYOUTS)
def test_collect_and_its_gradients(layout, dtype):
    n = 5 * 7 * 300
    screen = Screen(0.0, (0.0, 16.0), (0.0, 8.0), (16, 10))  # pixels of 1 x 0.8 mm
    x, y = (LAYOUTS[layout](uniform(n, s, dtype) * 20 - 2) for s in (0, 1))
    flux = LAYOUTS[layout](uniform(n, 2, dtype))
    status = (LAYOUTS[layout](uniform(n, 3)) < 0.1).to(torch.uint8)
    weight = uniform(160, 4).view(10, 16)
    results = []
    for kind in (dtype, torch.float64):  # the kernel, and the plain form in double
        position = torch.stack([x, y]).to(kind).requires_grad_()
        rays = Landed(position, flux.to(kind), status)
        plain = (position, irradiance.landed_flux(rays), screen)
        image, outside = irradiance.collect(rays, screen) if not results else irradiance.collect_plain(*plain)
        merit = (image * weight).sum() + 0.3 * outside
        results.append((image.detach(), outside.detach(), torch.autograd.grad(merit, position)[0]))
    (image, outside, g), (expected, outside_plain, g_plain) = results
    assert image.dtype == outside.dtype == torch.float64 and g.dtype == dtype
    close(image, expected, torch.float64, 100)  # double arithmetic in both, whatever the landing's precision
    torch.testing.assert_close(outside, outside_plain, rtol=1e-12, atol=0)
    close(g, g_plain, dtype, 10)
    assert not g[:, status != 0].any()


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
