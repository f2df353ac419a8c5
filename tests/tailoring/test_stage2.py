"""Stage 3 lowers the sum over the points of a source of some size; float32 beside float64: a fault in one shows."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import pytest
import torch

from bstcad.designs import pipeline
from bstcad.designs.pipeline import design
from bstcad.optics.trace.measure import rrmsd_by_tubes
from bstcad.scene.quality import VERIFICATION_SET
from bstcad.scene.scene import load
from bstcad.tailoring import stage2
from bstcad.tailoring.effort import FULL
from bstcad.tailoring.source_image import ExtendedSource
from tests import suite, two_faces
from tests.efforts import designed_quickly
from tests.scenes import DISK, SMALL

TINY = SMALL | {
    "tailoring.rays": 64,
    "target.pixels": 32,
    "tailoring.transport_grid": 32,
    "tailoring.stage2_iterations": 24,
    "tailoring.source_points": 12,
}
# Changes of the scene for the comparison of float32 with float64, which comes before more evaluations.
TWINS = SMALL | {"tailoring.stage2_iterations": 1}
WIDE = TINY | {"source.diameter": 1.2}  # 80 mm before the back, 475 mm behind it: an image of 7 mm of 60


@pytest.mark.parametrize(
    ("changes", "shares", "level"),
    [
        ({"tailoring.rays": 96}, stage2.SHORT_ROUNDS, 8.0 * (64 * 48) / 33**2),  # three tubes per cell at last
        ({"tailoring.rays": 192}, None, 8.0 * (64 * 48) / 33**2),  # three tubes per cell from the first round on
        ({"tailoring.rays": 96, "target.pixels": 12}, stage2.SHORT_ROUNDS, 2.0),  # half pixels not finer than cells
        ({"tailoring.rays": 66}, None, math.inf),
        ({"tailoring.rays": 96, "lens.tool_radius": 50.0}, None, math.inf),
    ],
)
def test_only_rounds_that_resolve_the_net_are_short_and_move_its_short_waves(changes, shares, level):
    scene = load(DISK, SMALL | {"tailoring.stage2_iterations": 60} | changes)
    settings = scene.tailoring.resolved(scene.lens.back.net)
    task = pipeline.task_of(scene, scene.goals, settings, edge=None)
    assert stage2.round_shares(task) == shares
    first = stage2.TubeRound(task, 48, 30, resolved=stage2.resolves_net(task))
    assert first.level == pytest.approx(level, rel=1e-12)


@pytest.mark.parametrize(
    ("points", "tubes"),
    [(513, [640, 960, 1398]), (1025, [1025, 2050, 2733]), (2049, [2049, 3074, 4098])],
)
def test_the_last_round_of_a_large_net_has_more_tubes_unless_memory_forbids_it(points, tubes):
    scene = load("templates/portrait.toml", {"lens.back.control_points": points})
    settings = scene.tailoring.resolved(scene.lens.back.net)
    shares = stage2.round_shares(pipeline.task_of(scene, scene.goals, settings, edge=None))
    found = list(stage2.sheet_sizes(settings, shares))
    assert [each for each, _ in found] == tubes
    assert [count for _, count in found] == [round(part * 98) for part in ROUNDS_OF[points]]


ROUNDS_OF = {513: (0.43, 0.22, 0.12), 1025: (0.3, 0.2, 0.05), 2049: (0.4, 0.35, 0.25)}


@pytest.mark.parametrize(("ratio", "evaluations"), [(0.0, [72, 30, 6]), (math.inf, [25, 25, 6])])
def test_a_round_for_several_pictures_ends_once_it_fits_its_tubes_alone(monkeypatch, ratio, evaluations):
    """No RRMSD by tubes is below 0 times that by rays, and each is below ∞ times it, at the first comparison."""
    monkeypatch.setattr(stage2, "DISTORTION_RATIO", ratio)
    scene = load(DISK, two_faces.SMALL)
    settings = replace(scene.tailoring.resolved(scene.lens.back.net), stage2_iterations=60)
    task, lens = pipeline.task_of(scene, scene.goals, settings, edge=None), scene.flat_lens(scene.lens.back.net)
    counts = Counter(step.part for step in stage2.steps(task, scene.as_mounted(lens)) if step.rrmsd is not None)
    assert list(counts.values()) == evaluations


def judged(scene, lens):
    """RRMSD with the real source, by points that no tailoring knows."""
    return rrmsd_by_tubes(lens, scene.channels(64, VERIFICATION_SET), scene.goals[0], 34)


@pytest.fixture(scope="module")
def compensated():
    """(design, RRMSD as it is judged)."""
    found = designed_quickly(load(DISK, WIDE))
    return found, judged(found.scene, found.lens)


@suite.in_turn(0, 2)
def test_the_size_of_the_source_is_made_up_for(compensated):
    found, rrmsd = compensated
    point = designed_quickly(found.scene.with_source_scaled(0.0))
    assert rrmsd < 0.7 * judged(found.scene, point.lens)


@suite.in_turn(0, 2)
def test_it_tells_what_each_size_costs(compensated):
    """Stage 2 is replaced; the rays between the stages see the source's points, which no tailoring sees."""
    found, rrmsd = compensated
    stages = [stage for stage in found.course.stages if stage.name.startswith("stage ")]
    assert [stage.name for stage in stages] == [
        "stage 1", *["stage 3, 64² tubes"] * 5,
    ]  # fmt: skip
    *_, last = (stage.rrmsd for stage in stages)
    assert rrmsd == pytest.approx(last, rel=0.5)


def test_the_source_grows_to_its_size():
    scene = load(DISK, WIDE)
    sizes = [share for share, _ in stage2.SOURCE_SIZES]
    assert sizes == sorted(sizes) and sizes[-1] == 1
    assert sum(share for _, share in stage2.SOURCE_SIZES) == pytest.approx(1)
    whole, middle = scene.channels(), scene.source.position
    for share in sizes:
        for channel, other in zip(scene.with_source_scaled(share).channels(), whole, strict=True):
            ways = [p - m for p, m in zip(channel.source.position, middle, strict=True)]
            full = [p - m for p, m in zip(other.source.position, middle, strict=True)]
            assert ways == pytest.approx([share * way for way in full])
    assert scene.with_source_scaled(1.0).channels() == whole


def task_of(scene):
    """The task of a scene as `pipeline.design` has it."""
    settings = scene.tailoring.resolved(33)
    light = scene.with_source_scaled(0.0).channels()
    scaled = [scene.with_source_scaled(share) for share, _ in stage2.SOURCE_SIZES]
    return pipeline.Task(
        light, scene.goals, settings, sampled_sources=tuple(each.channels() for each in scaled),
        extended_sources=tuple(ExtendedSource(each.source, light, each.sampler) for each in scaled),
    )  # fmt: skip


def test_no_more_tubes_than_the_net_and_the_pixels_ask_for():
    scene = load(DISK, WIDE | {"tailoring.rays": 1000})
    [number] = {each.tubes for each in stage2.stage3_rounds(task_of(scene), scene.flat_lens(33))}
    assert number == 66  # 33 control points, 32 pixels
    few = load(DISK, WIDE | {"tailoring.rays": 40})
    assert {each.tubes for each in stage2.stage3_rounds(task_of(few), few.flat_lens(33))} == {40}


@pytest.fixture(scope="module")
def found():
    return design(load(DISK, TWINS), device="cpu").course.twins


@suite.in_turn(1, 2)
def test_the_twins_agree_to_what_single_precision_keeps(found):
    assert found["control_points"] == 33 and found["evaluations"] == FULL.compared_evaluations
    assert 0 < found["merit"] < 1e-4  # sums of 2^16 tubes, each with some 1e-6 of the lens's size in its corners
    assert 0 < found["gradient"] < 1e-2
    assert found["rrmsd_float32"] == pytest.approx(found["rrmsd_float64"], rel=0.01)
    assert 0 < found["heights"] < 1e-5  # mm


@pytest.mark.parametrize(("merit", "exact", "difference"), [(0.0, 0.0, 0.0), (0.0, 2.0, 1.0), (2.0, 1.0, 0.5)])
def test_a_stationary_start_has_differences_that_are_finite(monkeypatch, merit, exact, difference):
    """A picture that the start makes, such as one white pixel, has no gradient, and may have a merit of zero."""
    scene = load(DISK, TWINS)
    task, start = task_of(scene), scene.flat_lens(33)
    ends = iter([(merit, torch.full((4,), merit), start), (exact, torch.full((4,), exact), start)])
    monkeypatch.setattr(stage2, "_tailor_briefly", lambda task, lens, variables: next(ends))
    found = stage2.compare_precisions(task, start)
    assert (found.merit, found.gradient) == (difference, difference)


@suite.in_turn(1, 2)
def test_a_coarser_arithmetic_shows(monkeypatch, found):
    """Heights rounded to 1e-4 of themselves, as half precision would, in the single one of the twins."""
    call = stage2.Problem.__call__

    def coarse(problem, heights):
        return call(problem, [h.half().float() if h.dtype == torch.float32 else h for h in heights])

    monkeypatch.setattr(stage2.Problem, "__call__", coarse)
    again = design(load(DISK, TWINS), device="cpu").course.twins
    assert again["gradient"] > 3 * found["gradient"]
