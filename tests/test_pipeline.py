"""Each template end to end at small size: a lens that does what it should, the same twice."""

import functools
import time

import pytest
import torch

from bstcad.cad.solid import lens_solid
from bstcad.designs import pipeline
from bstcad.optics.receivers.irradiance import Screen, efficiency, rrmsd
from bstcad.scene import scene
from bstcad.scene.errors import SceneError
from bstcad.tailoring.driver import Hooks
from tests import suite
from tests.efforts import designed_quickly
from tests.tracing import simulated

SMALL = {
    "target.pixels": "48", "lens.back.control_points": "33", "tailoring.rays": "256", "tailoring.transport_grid": "64",
    "tailoring.stage2_iterations": "40",
}  # fmt: skip
FINER = {"portrait": {"lens.back.control_points": "37"}}  # 32 spans under the lens, besides four past its rim
RECORDED = {"thu": 0.30, "portrait": 0.18}  # RRMSD that the small designs reach, with some to spare


def small(name, **more):
    return scene.load(f"templates/{name}.toml", SMALL | more)


@functools.cache
def designed(name):
    """The design of a small template, and its steps."""
    steps = []
    hooks = Hooks(progress=lambda *step: steps.append(step))
    return pipeline.design(small(name, **FINER.get(name, {})), hooks=hooks), steps


def judged(design):
    """(RRMSD by box pixels, efficiency) by rays of another seed."""
    target = design.scene.target
    screen = Screen(target.z, target.x, target.y, target.columns_rows)
    found = simulated(design.scene.source, design.lens, screen, 500, 77)
    return float(rrmsd(found.box, torch.from_numpy(design.goals[0].picture))), efficiency(found.flux)


@pytest.mark.parametrize("name", suite.in_turns(RECORDED, 2))
def test_a_template_becomes_a_lens(name):
    found, steps = designed(name)
    value, efficiency = judged(found)
    assert value < RECORDED[name]
    assert efficiency > 0.97
    rounds = tuple(f"stage 2, {tubes}² tubes" for tubes in (128, 171, 256))
    assert tuple(stage.name for stage in found.course.stages) == (
        "loading",
        "stage 1",
        "float32 beside float64",
        *rounds,
    )
    assert found.course.stages[3].rrmsd < found.course.stages[1].rrmsd
    assert {stage for stage, *_ in steps} == {"stage 1", "stage 2"}
    assert all(done <= total for _, done, total, _ in steps)
    assert found.lens.back.heights.dtype == torch.float64 and found.course.skipped_steps == 0
    assert lens_solid(found.lens).isValid()


def test_float32_is_compared_when_a_report_asks_for_it():
    """The lens is the same, and what the report tells in the end, too."""
    few = {"tailoring.rays": "64", "tailoring.rounds": "2", "tailoring.stage2_iterations": "3"}
    both = (pipeline.DesignOptions(compare_later=later) for later in (False, True))
    now, later = (pipeline.design(small("disk", **few), options=options) for options in both)
    assert torch.equal(later.lens.back.heights, now.lens.back.heights)
    assert later.course.twins is None and pipeline.COMPARISON_STAGE not in [stage.name for stage in later.course.stages]
    told = later.with_report_data()
    assert told.course.twins == now.course.twins
    assert [stage.name for stage in told.course.stages] == [stage.name for stage in now.course.stages]
    assert told.with_report_data() is told and now.with_report_data() is now


@suite.in_turn(1, 2)
def test_float32_comes_close_to_float64():
    value, _ = judged(pipeline.design(small("thu", **{"tailoring.precision": "float32"})))
    assert value == pytest.approx(judged(designed("thu")[0])[0], rel=0.3)


def test_max_time_that_is_over_gives_the_best_so_far():
    few = small("disk", **{"tailoring.max_time": "1.0", "tailoring.stage2_iterations": "100000"})
    found = pipeline.design(few, began=time.perf_counter() - 1e6)  # long over
    assert found.course.stopped == "time" and [s.name for s in found.course.stages] == ["loading", "stage 1"]
    assert judged(found)[0] < 0.2


def test_max_time_leaves_time_to_write_and_to_prove(monkeypatch):
    asked = {}
    monkeypatch.setattr(pipeline, "Driver", lambda *given, **more: asked.update(more) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        pipeline.design(small("disk", **{"tailoring.max_time": "60.0"}))
    assert asked["limit"] == 60.0 and asked["reserve"] > pipeline.BASE_SECONDS


@pytest.mark.parametrize(("device", "sentence"), [("gpu", "'gpu' is not possible; give one of"), ("cuda", "no CUDA")])
def test_a_device_that_is_not_there_is_refused(device, sentence, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SceneError, match=f"^device: .*{sentence}"):
        pipeline.design(small("disk"), device=device)


def test_a_back_that_would_reach_the_front_or_the_target_is_refused():
    near = small("thu", **{"target.z": "24.0"})
    lens = near.flat_lens(near.lens.back.net)
    with pytest.raises(SceneError, match=r"^lens\.front\.z: .* 0\.5 mm"):
        pipeline.check_thickness(lens.with_back(lens.back.moved(lens.front.z - 0.5)), near, 257)
    with pytest.raises(SceneError, match=r"^target\.z: .* z = 24\.5"):
        pipeline.check_thickness(lens.with_back(lens.back.moved(24.5)), near, 257)
    pipeline.check_thickness(lens.with_back(lens.back.moved(23.5)), near, 257)


@suite.in_turn(0, 2)
def test_a_target_that_is_not_square_gets_its_picture():
    """A round spot on 300 x 150 mm, on pixels of equal sides: as round and bright as asked."""
    wide = {"target.x": "[-150.0, 150.0]", "target.y": "[-75.0, 75.0]", "target.pixels": "64"}
    found = designed_quickly(small("disk", **wide, **{"target.outline": '{ shape = "circle", radius = 70.0 }'}))
    assert found.goals[0].picture.shape == (32, 64)
    value, efficiency = judged(found)
    assert value < 0.16  # on 150 x 150 mm and 32 x 32 pixels: 0.11
    assert efficiency > 0.95
