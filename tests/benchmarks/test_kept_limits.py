"""The limits that a scene sets itself, accuracy, time and memory, at full size, each in a cold process."""

import pytest

from tests.benchmarks.cold import generate
from tests.hard_cases.designs import as_toml

pytestmark = pytest.mark.bench


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
    """Tubes are fixed: 129 against 513 control points a side, of which the mesh and STEP file take their part."""
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
    """The peak includes writing and proof."""
    report, _ = designed(tmp_path, *(f"{key}={as_toml(value)}" for key, value in TWO_FACES.items()))
    stages = [stage["name"] for stage in report["stages"]]
    assert "stage 2, 2048² tubes" in stages
    assert 1.0 < report["machine"]["peak_memory_gb"] < 6.0
