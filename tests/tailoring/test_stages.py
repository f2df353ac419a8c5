"""Stage 2 and the paper's procedure on small problems: right gradients, and a merit that falls."""

from dataclasses import replace

import pytest
import torch

from bstcad import pipeline, scene
from bstcad.optics.irradiance import Screen
from bstcad.optics.simulation import simulate
from bstcad.tailoring import paper, stage1, stage2
from bstcad.tailoring.merit import IrradianceMerit
from bstcad.tailoring.minimise import BestSoFar
from bstcad.tailoring.slope_fit import refine
from bstcad.tailoring.task import Log, Task

SMALL = {
    "lens.back.control_points": "17",
    "target.pixels": "32",
    "tailoring.rays": "200",
    "tailoring.transport_grid": "64",
}


def small(name, **more):
    """(task, blank lens) of a template at toy size: laws only, no figures."""
    wanted = scene.load(f"templates/{name}.toml", SMALL | more)
    knobs = wanted.tailoring.resolved(17)
    t = wanted.target
    task = Task(wanted.source, Screen(t.z, t.x, t.y, t.pixels), t.irradiance(), knobs, Log(pipeline.silent))
    return task, pipeline.blank(wanted, knobs.levels[0], torch.float64, "cpu")


@pytest.mark.parametrize("name", ["thu", "portrait"])
def test_the_gradient_of_stage_2_is_that_of_finite_differences(name):
    task, lens = small(name)
    lens, _ = stage1.tailor(task, lens)
    merit = IrradianceMerit.of(task.screen, torch.from_numpy(task.target), 0.03, 4)
    problem = stage2.Problem(lens, stage2.bundle(task, lens, 200, 0), merit)
    _, gradient, _ = problem(lens.back.heights)
    way = torch.randn(gradient.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    step = 1e-8  # mm: few rays cross a kink of the tents
    up, down = (problem(lens.back.heights + sign * step * way)[0] for sign in (1, -1))
    assert (up - down) / (2 * step) == pytest.approx(float((gradient * way).sum()), rel=1e-3)


def test_stage_2_improves_what_stage_1_left():
    task, lens = small("disk", **{"tailoring.stage2_iterations": "30"})
    lens, _ = stage1.tailor(task, lens)
    before = task.rrmsd(lens)
    assert task.rrmsd(stage2.tailor(task, lens)) < 0.9 * before


def test_stage_1_finds_the_front_curvature_and_the_back_together():
    task, lens = small("portrait")
    tailored, mapping = stage1.tailor(task, lens)
    assert tailored.front.curvature != 0.0
    assert mapping.transport.mass_error[-1] < 0.02
    found = simulate(task.source, tailored, task.screen, 300, 0)
    assert found.efficiency > 0.98
    assert task.rrmsd(tailored) < 0.5 * task.rrmsd(replace(lens, back=refine(lens.back, 17)))


def test_the_paper_lowers_both_of_its_merits():
    task, lens = small("portrait", **{
        "tailoring.quality": "paper", "tailoring.stage1_iterations": "150", "tailoring.stage2_iterations": "60",
        "tailoring.precision": "float64",
    })  # fmt: skip
    blank = task.rrmsd(lens)
    lens, mapping = paper.stage1(task, lens)
    assert float(lens.front.curvature) != 0.0  # optimised together with the net
    first = task.rrmsd(lens)
    second = task.rrmsd(paper.stage2(task, lens))
    assert second < first < blank
    assert [point for point in task.log.history if point[1] > 0]


@pytest.mark.parametrize(
    ("m", "rate"), [(33, 0.02), (65, 0.02), (129, 0.004), (257, 0.004), (513, 0.008), (1025, 0.008)]
)
def test_the_papers_learning_rates(m, rate):
    assert paper.rate(m) == rate


def test_skipped_steps_are_counted():
    best = BestSoFar(lambda p: (float("nan"), [torch.zeros(1)], 0.0), lambda _: None)
    best([torch.zeros(1)])
    assert best.skipped == 1
