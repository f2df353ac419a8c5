"""A street light: an LED in a dome lights a road evenly, judged by five million rays of the independent judge."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.cold import generate
from tests.benchmarks.independent import SETS, judge

pytestmark = pytest.mark.bench

TEMPLATE = Path(__file__).parents[2] / "templates" / "street_light.toml"
RAYS = 5_242_880
SIDE = 4  # pixels of 250 mm in a square of 1 m
AT_LEAST = 0.82  # fraction of the light of the LED on the road, with the losses by reflection
UNIFORM = 0.5  # smallest / mean illuminance over squares of 1 m


def test_the_road_is_even_and_receives_most_of_the_light(tmp_path):
    run = generate(TEMPLATE, tmp_path / "design")
    report, judged = run.report(), judge(run.folder, points=RAYS // SETS, most=RAYS // SETS)
    rows, columns = judged.picture.shape
    means = judged.picture.reshape(rows // SIDE, SIDE, columns // SIDE, SIDE).mean((1, 3))
    found, uniformity = judged.flux["on target"], means.min() / judged.picture.mean()
    print(
        f"\nlight on the road {found:.4f}, smallest / mean {uniformity:.3f}, RRMSD {judged.rrmsd:.4f} "
        f"(stated {report['rrmsd']:.4f}), {judged.rays} rays, {run.seconds:.0f} s",
        end="",
    )
    assert judged.rays >= 5_000_000
    assert found >= AT_LEAST and uniformity >= UNIFORM
    assert judged.rrmsd == pytest.approx(report["rrmsd"], rel=0.01)
    assert [check["name"] for check in report["checks"] if not check["passed"]] == []
