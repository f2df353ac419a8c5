"""Nets of m x n control points: the kernels, the fit and the files know both sides; square nets are a case of them."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

import bstcad
from bstcad import commands
from bstcad.analysis.shape import _grid, survey
from bstcad.commands import ProofOptions
from bstcad.optics.kernels import spline
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.bspline import (
    QUARTERS,
    BSplineSurface,
    Spans,
    evaluate,
    evaluate_plain,
    knots,
    net_gradient,
)
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.sides import coarser, scaled, side, simplified, spread
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.optics.trace import trace
from bstcad.optics.trace.tubes import launch_tubes
from bstcad.scene.errors import SceneError
from bstcad.scene.quality import Tailoring
from bstcad.step_text import part21
from bstcad.tailoring.merit import SobolevVariable, Spectrum
from tests import lenses
from tests.conftest import draws_nothing, quick_effort
from tests.tracing import from_first_net_plain, stratified

M, N = 33, 9
PLATE = {
    "name": "plate", "source.kind": "collimated", "source.profile": "uniform",
    "source.aperture": {"shape": "rectangle", "width": 40.0, "height": 10.0},
    "lens.outline": {"shape": "rectangle", "width": 40.0, "height": 10.0}, "lens.front": {"kind": "plane", "z": 10.0},
    "lens.back": {"kind": "bspline", "z": 20.0, "control_points": [65, 17]}, "target.z": 220.0,
    "target.x": [-24.0, 24.0], "target.y": [-6.0, 6.0], "target.pixels": [64, 16], "target.sample": "astronaut",
    "tailoring.quality": "draft", "tailoring.rays": 128, "tailoring.transport_grid": 64,
    "tailoring.stage2_iterations": 12,
}  # fmt: skip


def bowl(m=M, n=N, depth=2.0):
    """Twice as wide as deep, steep at its rim, with waves of its own along x and along y."""

    def sag(x, y):
        x, y = x / 12, y / 6
        return depth * (x**2 + 0.4 * y**2) + 0.1 * torch.sin(5 * x) * torch.cos(3 * y)

    return lenses.net(sag, 22.0, (m, n), (12.0, 6.0))


def places(net, count=400, seed=0):
    """(u, v) all over a net, its end spans and corners among them."""
    random = torch.Generator().manual_seed(seed)
    return tuple(torch.rand(count, generator=random, dtype=torch.float64) * (points - 1) for points in net.shape)


def test_the_kernel_and_its_adjoints_are_those_of_the_plain_form():
    net = bowl()
    u, v = places(net)
    seeds = tuple(torch.randn(3, u.numel(), generator=torch.Generator().manual_seed(1), dtype=torch.float64))
    found = []
    for form in (evaluate, evaluate_plain):
        leaves = [t.clone().requires_grad_() for t in (net.heights, u, v)]
        values = form(*leaves)
        found.append((*(t.detach() for t in values), *torch.autograd.grad(values, leaves, seeds)))
    for fused, expected in zip(*found, strict=True):
        torch.testing.assert_close(fused, expected, rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(net_gradient(net.heights, u, v, seeds), found[1][3], rtol=1e-11, atol=1e-11)


def test_sags_along_the_longer_side_are_those_along_the_shorter_one_of_the_net_turned():
    net = bowl()
    turned = BSplineSurface(net.z, net.heights.T.contiguous(), net.y, net.x)
    x, y = (torch.linspace(*ends, 50, dtype=torch.float64) for ends in (net.x, net.y))
    (z, z_x, z_y), (t, t_x, t_y) = net.sag_and_slope(x, y), turned.sag_and_slope(y, x)
    for one, other in ((z, t), (z_x, t_y), (z_y, t_x)):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


def test_landings_and_their_gradient_are_those_of_the_plain_form_and_of_differences():
    lens = Lens.between(Sphere(15.0, -0.02), bowl(), Rectangle(22.0, 11.0), 1.6)
    x, y = stratified(Rectangle(20.0, 10.0), 40, 0, torch.float64)
    in_glass = trace.to_first_net(PointSource().rays_through(x, y, 15.0, 1.0), lens)

    def merit(form, heights):
        landed = form(in_glass, lens.with_back(replace(lens.back, heights=heights)), LevelPlane(200.0))
        return torch.where(landed.alive, (landed.position**2).sum(0), 0.0).sum(), landed

    gradients = []
    for form in (trace.from_first_net, from_first_net_plain):
        heights = lens.back.heights.clone().requires_grad_()
        value, landed = merit(form, heights)
        gradients.append((torch.autograd.grad(value, heights)[0], landed.position.detach(), landed.alive))
    (g, at, alive), (g_plain, at_plain, alive_plain) = gradients
    assert torch.equal(alive, alive_plain) and bool(alive.any())
    torch.testing.assert_close(at[:, alive], at_plain[:, alive], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(g, g_plain, rtol=1e-8, atol=1e-8 * float(g_plain.abs().max()))
    way, step = torch.randn(M, N, generator=torch.Generator().manual_seed(2), dtype=torch.float64), 1e-6
    ahead, behind = (merit(trace.from_first_net, lens.back.heights + s * step * way)[0] for s in (1, -1))
    assert float((g * way).sum()) == pytest.approx(float(ahead - behind) / (2 * step), rel=1e-5)


def test_the_survey_of_curvatures_is_that_of_the_plain_form():
    lens = Lens.between(Sphere(15.0, 0.0), bowl(), Rectangle(24.0, 12.0), 1.5)
    i, j = (p.reshape(-1) for p in torch.meshgrid(torch.arange(M - 2), torch.arange(N - 2), indexing="ij"))
    jet = Spans.of(lens.back, i, j).jet(QUARTERS)
    found = survey(lens)
    assert found.concave.largest == pytest.approx(1 / float(jet.curvatures[0].max()), rel=1e-9)
    x, y, along_x, along_y = _grid(lens.back)
    largest, _, _ = spline.largest_bending(
        lens.back.heights.numpy(), (along_x, along_y), (x, y), limits=lens.outline.limits, bounds=(9.0, 9.0, 9.0)
    )
    assert largest[2] == pytest.approx(float(jet.slope.max()), rel=1e-9)


def test_variables_are_linear_and_their_adjoint_is_their_transpose():
    net = bowl()
    random = torch.Generator().manual_seed(3)
    c, g = torch.randn(2, M, N, generator=random, dtype=torch.float64)
    for variable in (SobolevVariable.of(net, 1 + torch.rand(M, N, generator=random)), Spectrum.of(net)):
        there, back = (variable.heights(c) * g).sum(), (c * variable.adjoint(g)).sum()
        assert float(there) == pytest.approx(float(back), rel=1e-11)
    c[0, 0] = 0.0  # the piston, which has no slope
    h, (p_x, p_y) = Spectrum.of(net).heights(c), net.pitch
    square = ((h.diff(dim=0) / p_x) ** 2).sum() + ((h.diff(dim=1) / p_y) ** 2).sum()
    assert float(square) / (M * N) == pytest.approx(float((c**2).sum()), rel=1e-9)  # the mean of squared slopes


def test_a_net_of_more_points_is_the_same_surface():
    net = bowl(depth=1.0)
    finer = net.refined((4 * M - 3, 2 * N - 1))
    x, y = torch.meshgrid(*(torch.linspace(0.9 * a, 0.9 * b, 60).double() for a, b in (net.x, net.y)), indexing="ij")
    assert finer.shape == (4 * M - 3, 2 * N - 1) and net.refined((M, N)) is net
    assert float((finer.sag_and_slope(x, y)[0] - net.sag_and_slope(x, y)[0]).abs().max()) < 2e-3  # mm; not nested


def test_sides():
    assert simplified((7, 7)) == 7 and simplified((7, 5)) == (7, 5) and side((512, 128)) == 256
    assert coarser(257, 33) == 33 and coarser(257, 999) == 257 and coarser((513, 129), 33) == (33, 9)
    assert coarser((33, 513), 129) == (9, 129) and coarser((65, 9), 33) == (33, 5)  # no fewer than a spline has
    assert scaled((65, 17), 2) == (129, 33) and spread(256, 4.0, 1.0) == (512, 128) and spread(256, 1.0, 1.0) == 256


def test_levels_have_cells_of_one_shape():
    assert Tailoring().resolved((513, 129)).levels == ((33, 9), (129, 33), (513, 129))
    assert Tailoring(levels=(65, 513)).resolved((513, 129)).levels == ((65, 17), (513, 129))
    assert Tailoring(levels=((40, 20), (513, 129))).resolved((513, 129)).levels == ((40, 20), (513, 129))
    assert Tailoring().resolved((513, 129)).rays == Tailoring().resolved(257).rays == 1536


def test_tubes_lie_in_the_proportion_of_the_cells_under_the_light():
    lens = Lens.between(Sphere(15.0, 0.0), bowl(65, 33, depth=0.2), Rectangle(24.0, 12.0), 1.5)
    assert launch_tubes(PointSource(position=(0.0, 0.0, -60.0)), lens, 100).flux.shape == (141, 71)
    square = lens.with_back(bowl(33, 33, depth=0.2))
    assert launch_tubes(PointSource(position=(0.0, 0.0, -60.0)), square, 100).flux.shape == (100, 100)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """(folder, the design) of a plate of 40 x 10 mm with square cells."""
    folder = tmp_path_factory.mktemp("oblong") / "plate"
    scene = bstcad.load("templates/caustic_portrait.toml").changed(PLATE)
    with pytest.MonkeyPatch.context() as patch:
        draws_nothing(patch)
        design = bstcad.design(scene, progress=False)
        commands.write(design._made, folder, ProofOptions(quick_effort()))
    return folder, design


def test_the_written_lens_passes_and_is_the_designed_one(made):
    folder, design = made
    report = json.loads((folder / "report.json").read_text())
    assert [check["name"] for check in report["checks"] if not check["passed"]] == []
    assert report["efficiency"] > 0.99 and report["rrmsd"] < 0.2
    again = bstcad.open(folder)
    assert again.lens.back.shape == (65, 17) and again.scene.lens.back.control_points == (65, 17)
    assert np.array_equal(again.lens.back.control_points(), design.lens.back.control_points())  # to the last bit
    text = part21.read(folder / "lens.step").surface
    assert np.array_equal(text.full_knots[0], knots(65)) and np.array_equal(text.full_knots[1], knots(17))
    assert np.abs(text.control_points - design.lens.back.control_points()).max() < 1e-11  # mm; sixteen digits of text


def test_it_can_be_a_front_and_a_shop_gets_its_grid(made):
    folder, _ = made
    design = bstcad.open(folder)
    behind = design.scene.changed(
        {"lens.front": {"kind": "bspline", "file": str(folder), "z": 10.0}, "lens.back.z": 30.0}
    )
    assert behind.lens.front.surface.shape == (65, 17)
    grid, note = design.export("zemax")
    assert grid.read_text().splitlines()[0].split()[:2] == ["121", "25"]  # its knots and the middles between them
    assert "121 x 25 points" in note.read_text()


def test_what_is_wrong_and_what_is_doubted():
    scene = bstcad.load("templates/caustic_portrait.toml").changed(PLATE)
    [_] = scene.warnings()  # of a cropped picture
    _, doubt = sorted(scene.changed({"lens.back.control_points": 33}).warnings(), reverse=True)
    assert doubt.startswith("lens.back.control_points: the net's cells are 1.43 x 0.357 mm; [65, 17] makes")
    disc = {"lens.outline": {"shape": "circle", "radius": 5.0}, "source.aperture": {"shape": "circle", "radius": 5.0}}
    with pytest.raises(SceneError, match=r"a round lens \(lens.outline\) needs a square net, not 65 x 17"):
        scene.changed(disc)
    with pytest.raises(SceneError, match="tailoring.levels: must end with"):
        scene.changed({"tailoring.levels": [17, 33]})
