"""What a report says limits a design, against designs that take one step of each thing: the one named helps most.

Small designs of three templates, and drafts of two at full size, in which evaluations are scarce.  The estimate of each
step is printed beside what it brought.  Then the limits that a scene sets itself: accuracy, time and memory.
"""

import pytest

from bstcad import pipeline
from bstcad.analysis.cost import HELD
from bstcad.optics.measure import Effort, measure
from bstcad.scene.scene import load
from bstcad.sweep.estimates import diagnosis
from tests.benchmarks.cold import TEMPLATES, generate
from tests.hard_cases.designs import as_toml

pytestmark = pytest.mark.bench
SMALL = {"lens.back.control_points": 129, "target.pixels": 256, "tailoring.rays": 520}
DRAFT = {"tailoring.quality": "draft"}
CASES = {
    "letters off axis": ("thu", SMALL),
    "portrait": ("portrait", SMALL),
    "letters on axis": ("caustic_letters", SMALL),
    "letters off axis, a draft at full size": ("thu", DRAFT),
    "portrait on axis, a draft at full size": ("caustic_portrait", DRAFT),
    "few points": ("thu", {"lens.back.control_points": 65, "target.pixels": 128, "tailoring.rays": 260}),
}
NAMED = 0.7, 1.5  # of the gain that is named, what the step brings
EFFORT = Effort(witness=False)


def judged(scene):
    """(a design, RRMSD and picture by tubes that nobody tailored with)"""
    found, target = pipeline.design(scene), scene.target
    return found, measure(found.lens, scene.channels(), target.screen, found.target, EFFORT)


def steps(scene):
    """One step of each thing, as a change of the scene; as many tubes to a control cell as its quality says."""
    knobs = scene.tailoring.resolved(scene.lens.back.control_points)
    return {
        "evaluations": {"tailoring.stage2_iterations": 2 * knobs.stage2_iterations},
        "tubes": {"tailoring.rays": round(2**0.5 * knobs.rays)},
        "control points": {"lens.back.control_points": 2 * scene.lens.back.control_points - 1},
    }


@pytest.mark.parametrize("case", CASES)
def test_what_is_named_helps_most(case):
    name, small = CASES[case]
    scene = load(TEMPLATES / f"{name}.toml", small)
    found, light = judged(scene)
    making = found.making
    given = {"picture": light.picture, "target": found.target, "rrmsd": light.rrmsd}
    said = diagnosis(scene, making, found.lens, **given, efficiency=1.0)["limits"]
    brought = {by: judged(scene.changed(change))[1].rrmsd / light.rrmsd for by, change in steps(scene).items()}
    print(f"\n{case}: RRMSD {light.rrmsd:.4f}; {said[0]['because']}")
    for limit in said:
        print(f"  {limit['by']}: estimated {limit['rrmsd']:.2f}, found {brought[limit['by']]:.2f} times the RRMSD")
    assert brought[said[0]["by"]] == min(brought.values())
    if said[0]["by"] in HELD and not said[0].get("unsure"):  # else no gain is named
        least, most = NAMED
        assert least < (1 - brought[said[0]["by"]]) / (1 - said[0]["rrmsd"]) < most


# ---- what a scene asks for, at full size, each in a cold process -----------------------------------------------------


def designed(folder, *settings):
    """(report, seconds) of a cold run of the letters."""
    run = generate("thu", folder / "thu", *settings)
    return run.report(), run.seconds


def test_the_accuracy_asked_for_is_reached_and_no_more_is_done(tmp_path):
    report, _ = designed(tmp_path, "tailoring.accuracy=0.05")
    assert report["stopped"] == "accuracy" and 0.04 < report["rrmsd"] <= 0.0505


def test_the_time_given_is_kept(tmp_path):
    """The one place where seconds are looked at: max_time is a promise, with a quarter of slack for a busy machine."""
    report, seconds = designed(tmp_path, "tailoring.quality=fine", "tailoring.max_time=45")
    assert report["stopped"] == "time" and seconds <= 1.25 * 45


def test_memory_does_not_grow_with_the_control_points(tmp_path):
    """At fixed tubes: 129 against 513 control points a side, of which the mesh and STEP file take their part."""
    rough = "tailoring.quality=draft", "tailoring.rays=1026"
    few, many = (designed(tmp_path / str(m), *rough, f"lens.back.control_points={m}")[0] for m in (129, 513))
    assert many["rrmsd"] <= 0.15
    assert many["machine"]["peak_memory_gb"] < 2 * few["machine"]["peak_memory_gb"]


# 513 control points each; fewer evaluations than standard quality takes, by the same tubes: 1024², 1536² and 2048²
TWO_FACES = {
    "source.aperture": {"shape": "rectangle", "width": 20.0, "height": 20.0},
    "lens.front": {"kind": "bspline", "z": 8.0, "optimise": True, "control_points": 513},
    "target": [
        {"z": 100.0, "x": [-11.0, 11.0], "y": [-11.0, 11.0], "pixels": 512, "uniform": True},
        {"z": 300.0, "x": [-14.0, 14.0], "y": [-14.0, 14.0], "pixels": 512, "sample": "astronaut"},
    ],
    "tailoring.stage2_iterations": 40,
}


def test_two_nets_for_two_pictures_take_less_than_6_gb(tmp_path):
    """At its peak, with writing and proof."""
    report, _ = designed(tmp_path, *(f"{key}={as_toml(value)}" for key, value in TWO_FACES.items()))
    stages = [stage["name"] for stage in report["stages"]]
    assert "stage 2, 2048² tubes" in stages
    assert 1.0 < report["machine"]["peak_memory_gb"] < 6.0
