"""What a design cost and what limits it, of real small designs however they were made and wherever they ended."""

import json
import math
import re

import pytest

from bstcad import pipeline
from bstcad.optics.measure import Effort, measure
from bstcad.report import report as reports
from bstcad.runs import commands
from bstcad.scene.scene import load
from bstcad.sweep.diagnosis import diagnosis
from tests.conftest import DISK, SMALL

TINY = SMALL | {
    "tailoring.rays": 64, "target.pixels": 32, "tailoring.transport_grid": 32, "tailoring.rounds": 3,
    "lens.back.control_points": 17,
}  # fmt: skip
SCENES = {
    "least squares": {},
    "draft": {"tailoring.stage2_iterations": 5},
    "spectrum": {"source.wavelength": [[500.0, 1.0], [600.0, 2.0]], "lens.material": "PMMA"},
    "extended source": {"source.diameter": 1.0, "tailoring.source_points": 4, "tailoring.stage2_iterations": 12},
    "float32": {"tailoring.precision": "float32"},
    "paper": {
        "tailoring.quality": "paper", "tailoring.levels": [17], "tailoring.stage1_iterations": 8,
        "tailoring.stage2_iterations": 12,
    },
}  # fmt: skip


def of(found):
    scene, target = found.scene, found.scene.target
    light = measure(found.lens, scene.channels(), target.screen, found.target, Effort(96))
    making = commands.made(found, 0.0).making
    return diagnosis(
        scene, making, found.lens, picture=light.picture, target=found.target, rrmsd=light.rrmsd, efficiency=0.9
    ), making


@pytest.mark.parametrize("name", SCENES)
def test_every_kind_of_design_has_one(name):
    change = dict(SCENES[name])
    if name == "spectrum":
        change |= {"lens.index": None}
    found, making = of(pipeline.design(load(DISK, TINY | change)))
    assert sum(part["error"] for part in found.remaining_error["parts"]) == pytest.approx(1)
    assert sum(octave["error"] for octave in found.remaining_error["octaves"]) == pytest.approx(1)
    assert found.remaining_error["outside"] == pytest.approx(0.1)
    known = {limit["by"] for limit in found.limits}
    assert "control points" in known and ("tubes" in known) == (name != "paper")
    assert ("source size" in known) == (name == "extended source") and ("precision" in known) == (
        name in ("float32", "paper")
    )
    gains = [limit["rrmsd"] for limit in found.limits]
    assert gains == sorted(gains) and all(0 <= gain <= 1 for gain in gains)
    assert 0 <= found.convergence["last_tenth"] <= 1 and found.convergence["rrmsd"] > 0
    json.dumps([found.convergence, found.remaining_error, found.limits], allow_nan=False)
    assert making.stages[0].cpu_seconds is None
    assert all(0 <= stage.cpu_seconds < math.inf for stage in making.stages[1:])


def test_no_knob_is_said_to_limit_a_surface_by_integration():
    """Its map does."""
    change = {"tailoring.stage2_iterations": 0, "tailoring.method": "integration"}
    found, _ = of(pipeline.design(load(DISK, TINY | change)))
    assert found.limits == () and found.remaining_error["outside"] == pytest.approx(0.1)
    assert reports.limit(found.limits) == ""


def test_more_source_points_are_not_offered_where_the_blur_forbids():
    found = pipeline.design(load(DISK, TINY | SCENES["extended source"]))
    scene, making = found.scene, commands.made(found, 0.0).making
    light = measure(found.lens, scene.channels(), scene.target.screen, found.target, Effort(96))
    given = {"picture": light.picture, "target": found.target, "rrmsd": 0.5, "efficiency": 0.9}  # as if all saw 0.5
    sharp, blurred = (diagnosis(scene, making, found.lens, **given, blurred=rrmsd) for rrmsd in (0.0, 0.48))
    seen = sharp.convergence["rrmsd"]  # by the points that tailored it
    tubes = {0.0: _by(sharp.limits, "tubes"), 0.48: _by(blurred.limits, "tubes")}
    assert tubes[0.0]["rrmsd"] == pytest.approx(seen / 0.5) and tubes[0.48]["rrmsd"] == pytest.approx(0.96)
    assert "blurs the target to an RRMSD of 0.48; tailoring.source_points = 8 would" in tubes[0.48]["because"]
    assert "blur" not in tubes[0.0]["because"]


def _by(limits, name):
    [limit] = [limit for limit in limits if limit["by"] == name]
    return limit


def test_a_design_that_was_stopped_before_there_was_a_curve():
    asked = iter([False, False, False])
    found, _ = of(pipeline.design(load(DISK, TINY), interrupted=lambda: next(asked, True)))
    assert found.convergence is None and {limit["by"] for limit in found.limits} == {"control points"}


def test_the_processors_time_goes_on_where_a_design_was_left():
    states = []
    whole = pipeline.design(load(DISK, TINY), save=states.append)
    again = pipeline.design(load(DISK, TINY), start=states[len(states) // 2])
    assert [stage.name for stage in again.stages] == [stage.name for stage in whole.stages]
    assert all(stage.cpu_seconds >= 0 for stage in again.stages[1:])
    assert of(again)[0].remaining_error == of(whole)[0].remaining_error


def test_the_report_of_a_design_shows_it(small_design):
    page = (small_design.folder / "report.html").read_text()
    told = json.loads((small_design.folder / "report.json").read_text())
    assert {"convergence", "remaining_error", "limits"} <= set(told)
    assert "The last 10 % of the error took" in page and 'class="stack"' in page
    assert page.count("flex-grow: ") == len(told["stages"])
    rows = sum(part["pixels"] > 0 for part in told["remaining_error"]["parts"])
    assert len(re.findall(r"<tr><th scope=.row.>(?:along the rim|at edges|in its|in all others)", page)) == rows
    assert told["limits"][0]["by"] in {"evaluations", "control points", "tubes", "source size", "precision"}


def test_words():
    entry = {"by": "tubes", "rrmsd": 0.8, "because": "they see little; more of them would leave half", "figures": {}}
    assert reports.limit([entry]) == "What limits it now is the number of ray tubes: more of them would leave half."
    assert reports.limit([entry | {"rrmsd": 0.99}]).startswith("Nothing by itself") and not reports.limit([])
