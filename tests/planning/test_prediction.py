"""Predictions by a pilot: what it is made of, what it takes over to the whole design, and which scenes have one."""

from dataclasses import replace

import numpy as np
import pytest
from numba.core.event import Event, EventStatus, broadcast

from bstcad.optics.surfaces.sides import as_pair
from bstcad.planning import prediction
from bstcad.planning.prediction import (
    Pilot,
    PilotLight,
    Seconds,
    detail,
    memory_gb,
    predict,
    predicted_seconds,
    run_pilot,
    typical_seconds,
)
from bstcad.planning.reduction import Reduction, pilot_scene
from bstcad.scene.scene import load
from bstcad.scene.target import MIN_PIXELS
from tests import suite
from tests.efforts import LITTLE

NET, PIXELS = "lens.back.control_points", "target.pixels"
THU = load("templates/thu.toml")
TINY = Reduction(pixels=32, net=33, cells=32, tubes=64, evaluations=16, fewest_points=17, effort=LITTLE)


@pytest.fixture
def same_pace(monkeypatch):
    """This machine has the pace of the one to which the constants apply."""
    monkeypatch.setattr(prediction, "pace", lambda: 1.0)


def pilot(scene, *, slower=1.0, factor=4.0):
    """A pilot that took so many times as long as usual."""
    small, _ = pilot_scene(scene)
    took = typical_seconds(small)
    took = Seconds(slower * took.first, slower * took.search, 0.0)
    return Pilot(small, took, PilotLight(0.04, 1.5), PilotLight(0.05, 1.6), factor, 0.0, 0.0, None)


def test_a_pilot_has_a_quarter_of_the_net_the_pixels_and_the_tubes():
    small, factor = pilot_scene(THU)
    assert factor == 4 and as_pair(small.lens.back.net) == (129, 129) and small.target.columns_rows == (128, 128)
    assert small.tailoring.rays == THU.tailoring.resolved(513).rays / 4
    assert small.tailoring.rounds == prediction.PILOT.rounds


def test_both_nets_of_two_faces_shrink_alike():
    beam = load("templates/beam_shaper.toml", {"lens.back.control_points": 385, "lens.front.control_points": 193})
    assert pilot_scene(beam)[0].lens.nets() == (193, 97)


def test_the_pilot_of_a_narrow_target_has_pixels_enough():
    small, factor = pilot_scene(THU.changed({PIXELS: [128, 64], NET: 1025}))  # SceneError for pixels too few
    assert factor > 1 and min(small.target.columns_rows) >= MIN_PIXELS


def test_a_pilot_as_large_as_its_scene_predicts_its_times_and_a_fixed_share_of_its_error(same_pace):
    disk = load("templates/disk.toml", {"tailoring.rays": 256})
    both = predict(disk, pilot(disk, slower=3.0, factor=1.0))
    ratio = prediction.PILOT_RATIO
    assert both["draft"]["rrmsd"][1] == pytest.approx(ratio * 0.05)
    assert both["draft"]["rrmsd_half"][1] == pytest.approx(ratio * 0.08)
    found = both["standard"]
    assert found["rrmsd"][1] == pytest.approx(ratio * 0.04) and found["rrmsd_half"][1] == pytest.approx(ratio * 0.06)
    assert found["seconds"][1] == pytest.approx(
        3 * (typical_seconds(disk).first + typical_seconds(disk).search) + typical_seconds(disk).rest
    )
    assert all(low < likely < high for low, likely, high in found.values())


def test_tailoring_takes_as_many_times_longer_as_the_pilot_took_longer(same_pace):
    """A machine of half the pace, or a scene of twice the work: the rest goes by the machine alone."""
    once, twice = (predicted_seconds(THU, pilot(THU, slower=times)) for times in (1.0, 2.0))
    assert twice - once == pytest.approx(typical_seconds(THU).first + typical_seconds(THU).search)


def test_a_smaller_pilot_leaves_more_error_and_what_it_does_not_see_adds_to_it():
    near, far = (prediction.predicted_rrmsd(pilot(THU, factor=factor), "standard") for factor in (1.0, 4.0))
    assert far == pytest.approx(near * 4**prediction.PILOT_EXPONENT)
    blind = replace(pilot(THU), detail=0.1, blur=0.2)
    assert prediction.predicted_rrmsd(blind, "standard") == pytest.approx(
        far + 0.1 * prediction.DETAIL_FACTORS["standard"] + 0.1
    )


def test_detail_is_what_is_finer_than_the_cells():
    x = (np.arange(64) + 0.5) / 64
    wave = 1 + 0.5 * np.cos(np.pi * 20 * x) + np.zeros((64, 64))  # 20 half waves
    assert detail(wave, 19.5) == pytest.approx(np.sqrt(0.125 / 1.125)) and detail(wave, 20.5) < 1e-12


def test_more_tubes_goals_and_nets_take_more_memory():
    one, wave = THU, load("templates/beam_shaper.toml")
    assert memory_gb(one.changed({"tailoring.rays": 3000})) > memory_gb(one)
    alone = wave.changed({"wavefront": None, "accept.wavefront": None})
    assert memory_gb(wave) > memory_gb(alone) > prediction.LIBRARIES_GB


SCENES = {
    "two pictures": ("two_pictures", {}),
    "a mirror": ("mirror", {}),
    "a source of some size, and losses": ("led", {}),
    "bounds": ("machinable_letters", {"target.tilt": [10.0, 0.0], "tailoring.rays": 600}),
    "integration": ("thu", {"tailoring.method": "integration"}),
}


def test_a_pilot_that_waited_for_the_compiler_is_designed_again(same_pace, monkeypatch):
    """The first design after an installation waits for the compiler: 52 s were predicted where 17 s were found."""
    calls, waits, designed = [], [True, False, False], []

    def compiling(scene, **how):
        calls.append(scene)
        if waits[len(calls) - 1]:
            broadcast(Event("numba:compile", EventStatus.START))
        designed.extend([] if designed else [design(scene, **how)])  # the same pilot each time
        return designed[0]

    design = prediction.pipeline.design
    monkeypatch.setattr(prediction.pipeline, "design", compiling)
    run_pilot(THU, size=TINY)
    assert len(calls) == 2
    run_pilot(THU, size=TINY)
    assert len(calls) == 3


@pytest.mark.parametrize("name", suite.in_turns(SCENES, 3))
def test_every_scene_is_predicted(name, same_pace):
    template, changes = SCENES[name]
    scene = load(f"templates/{template}.toml", changes)
    flown = run_pilot(scene, size=TINY)
    assert flown.seconds.first > 0 and 0 < flown.light.rrmsd < 1.5
    assert (flown.early is None) == (scene.source.extent is not None or scene.tailoring.method == "integration")
    found = predict(scene, flown)
    assert all(0 < low < likely < high < np.inf for each in found.values() for low, likely, high in each.values())
