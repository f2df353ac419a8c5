"""Two faces that are impossible are refused before the long stages: by figures of geometry, in one sentence."""

import math

import pytest

from bstcad.designs import pipeline
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import load
from bstcad.tailoring.feasibility import MAX_GENTLE_DEFLECTION, find_demand, is_infeasible
from tests.two_faces import DISK, SMALL

DISC, GAP = 3.5, 6.0  # mm: radius of the beam, thickness of the blank
PLANE = {"kind": "plane", "z": 40.0}


def disc(radius, z=40.0):
    """An even disc of light on a plane."""
    ends = [-1.25 * radius, 1.25 * radius]
    return {
        "z": z,
        "x": ends,
        "y": ends,
        "pixels": 64,
        "uniform": True,
        "outline": {"shape": "circle", "radius": radius},
    }


def letter(text, z):
    """A letter on black."""
    return {"z": z, "x": [-3.2, 3.2], "y": [-3.2, 3.2], "pixels": 64, "text": text}


def scene_of(width, targets, **more):
    outline = {"shape": "rectangle", "width": width, "height": width}
    return load(DISK, SMALL | {"lens.outline": outline, "target": targets} | more)


def demand_of(scene):
    task = pipeline.task_of(scene, scene.goals, scene.tailoring.resolved(scene.lens.back.net), None)
    return find_demand(task, task.heaviest.through(scene.flat_lens(33)))


@pytest.mark.parametrize("radius", [5.0, 10.0])
def test_light_runs_straight_through_the_glass_from_rim_to_rim(radius):
    """Parallel light in, parallel light out: from 3.5 mm off the axis to the disc's radius, over the thickness."""
    demand = demand_of(scene_of(24.0, [disc(radius)], wavefront=PLANE))
    assert demand.angle == pytest.approx(0.0, abs=1e-6) and demand.crossed < 1e-3 and demand.outside < 1e-3
    wanted = math.degrees(math.atan((radius - DISC) / GAP))
    assert demand.deflection == pytest.approx(wanted, abs=3.0)  # a pixel's diagonal and the dark around it
    assert (demand.deflection > demand.limit) is (radius == 10.0)
    said = tuple(demand.sentences(GAP))
    assert len(said) == (1 if radius == 5.0 else 2) and not is_infeasible(demand)


@pytest.mark.parametrize("pixels", [64, 256])  # the trial has at most 128
def test_light_that_would_leave_beside_the_lens_is_counted(pixels):
    demand = demand_of(scene_of(10.0, [disc(10.0) | {"pixels": pixels}], wavefront=PLANE))
    assert demand.outside == pytest.approx(1 - 100 / (math.pi * 100), abs=0.03) and is_infeasible(demand)


@pytest.mark.parametrize("z, lifted", [(150.0, True), (400.0, False)])
def test_a_dark_picture_that_turns_light_too_far_is_lifted_until_it_does_not(z, lifted):
    """Letters behind a disc: the nearer they are to it, the further aside their light has to leave the lens."""
    demand = demand_of(scene_of(14.0, [disc(3.2, 100.0), letter("AB", z)]))
    assert (demand.deflection > MAX_GENTLE_DEFLECTION) is lifted
    assert (demand.floor > 0) is lifted and demand.lifted_deflection <= MAX_GENTLE_DEFLECTION
    (sentence,) = [each for each in demand.sentences(GAP) if "stage 1 raises" in each] or [None]
    assert (sentence is not None) is lifted


REFUSED = {  # targets and other changes of a scene whose lens is 10 mm wide
    "would have to leave the back outside of lens.outline": ([disc(10.0)], {"wavefront": PLANE}),
    "would have to cross between the lens and": (
        [letter("O", 100.0), letter("X", 130.0)], {"tailoring": SMALL["tailoring"] | {"solution": "convex"}}
    ),
}  # fmt: skip


@pytest.mark.parametrize("words", REFUSED)
def test_too_much_of_it_is_refused_in_one_sentence(words):
    targets, more = REFUSED[words]
    with pytest.raises(SceneError, match=f"^target: .*{words}") as refusal:
        pipeline.design(scene_of(10.0, targets, **more), device="cpu")
    assert "\n" not in str(refusal.value) and "e+" not in str(refusal.value)
