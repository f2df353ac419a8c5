"""Previews: they depend on the scene alone, stop when nobody waits, and are near the draft that is finished later."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from bstcad.analysis.shape import describe
from bstcad.app import preview_json
from bstcad.app.preview_desk import STAGES, PreviewDesk, PreviewRequest
from bstcad.app.preview_json import DARK_SHAPE_ERROR, MIN_LIT_FRACTION, SHAPE_ERROR, figures
from bstcad.designs import pipeline
from bstcad.optics.trace.measure import tubes_picture
from bstcad.planning.preview import Outdated, preview
from bstcad.planning.reduction import Reduction
from bstcad.report.units import quantity
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import load
from tests import suite
from tests.planning.conftest import typical_pilot

SMALL = {"tailoring.quality": "draft", "lens.back.control_points": 129, "target.pixels": 64}
NEAR = 0.05  # RRMSD between two pictures
FEW = Reduction(pixels=24, net=25, cells=48, tubes=64, rounds=1, evaluations=3, blurred=2)
MORE = replace(FEW, pixels=32, tubes=80)


def apart(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.sqrt(((one - other) ** 2).sum() / (other**2).sum()))


BENCH = pytest.mark.bench


@pytest.mark.parametrize(
    ("name", "lit"),
    [
        *suite.in_turns([("caustic_portrait", True), ("off_axis", False)], 2),
        pytest.param("mirror", True, marks=BENCH),
    ],
)
def test_a_preview_is_near_the_finished_draft(name, lit):
    """The light and the thickness are near; radius, slope and tool are not stated by so few points.

    Where light passes all of the back the two are nearer than where dark corners bend on.
    """
    scene = load(f"templates/{name}.toml", SMALL)
    found, made = preview(scene), pipeline.design(scene, options=pipeline.DesignOptions(compare_later=True))
    light = tubes_picture(made.lens, scene.channels(), scene.target.screen, 301).numpy()
    assert apart(found.pictures[0][1], light * (made.goals[0].picture.sum() / light.sum())) < NEAR
    assert found.flux["on target"] > 0.9
    shown, spread = dict(figures(found)), SHAPE_ERROR if lit else DARK_SHAPE_ERROR
    assert (found.lit_fraction >= MIN_LIT_FRACTION) is lit
    assert shown["Smallest radius, steepest slope"].startswith("known after") and not any(
        "tool" in name for name in shown
    )
    known = dict(figures(replace(found, scene=scene.changed({"source.lumens": 100.0}))))
    assert known["Luminous flux on the target"].endswith("of 100 lm") and "Luminous flux on the target" not in shown
    shape, finished = found.shape, describe(made.lens, 65)
    for key in ("thickness_min", "thickness_max", "sag_pv"):
        assert abs(shape[key] - finished[key]) < spread * shape["sag_pv"]
    assert shown["Sag of the back"].endswith(f"± {quantity(spread * shape['sag_pv'], 'mm')}")


def test_a_preview_depends_on_the_scene_alone():
    scene = load("templates/caustic_portrait.toml", SMALL)
    first = preview(scene, FEW)
    other = {"target.pixels": 96, "target.text": "A", "lens.outline": {"shape": "circle", "radius": 45.0}}
    assert np.isfinite(preview(scene.changed(other), FEW).rrmsds).all()
    assert np.array_equal(preview(scene, FEW).pictures[0][1], first.pictures[0][1])


@pytest.mark.parametrize(
    "name",
    [
        *suite.in_turns(["led", "two_pictures"], 2),
        *(pytest.param(name, marks=BENCH) for name in ("sun_caustic", "machinable_letters", "collimated_portrait")),
    ],
)  # fmt: skip
def test_every_kind_of_scene_has_a_preview(name):
    found = preview(load(f"templates/{name}.toml"))
    assert len(found.pictures) == len(found.scene.targets)
    assert max(found.rrmsds) < 0.3 and all(light.min() >= 0 for _, light in found.pictures)


def test_a_preview_that_nobody_waits_for_ends():
    looks = []
    with pytest.raises(Outdated):
        preview(load("templates/disk.toml"), outdated=lambda: looks.append(1) or len(looks) > 3)
    assert len(looks) == 4


def test_a_scene_that_a_design_would_refuse_is_refused():
    far = SMALL | {"target.x": [5000.0, 5100.0], "target.unreachable": "refuse"}
    scene = load("templates/caustic_portrait.toml", far)
    with pytest.raises(SceneError, match="no light reaches the target"):
        preview(scene)


@suite.in_turn(0, 4)
def test_the_desk_answers_the_newest_request_of_each_page_in_order(monkeypatch):
    """Previews are small, and predictions have no pilots."""
    monkeypatch.setattr("bstcad.planning.prediction.pace", lambda: 1.0)
    desk = PreviewDesk((FEW, MORE), typical_pilot)
    scene = load("templates/disk.toml", {"lens.back.control_points": 33, "target.pixels": 16})
    try:
        first = PreviewRequest("one", 1, scene)
        desk.ask(first)
        newer = PreviewRequest("one", 2, scene.changed({"target.z": 150.0}), grade="milled-sanded", light="led")
        other = PreviewRequest("two", 1, scene)
        desk.ask(newer)
        desk.ask(other)
        assert desk.answer(first, 0, 60.0) is None and first.replaced
        for request in (other, newer):
            stage, found = desk.answer(request, 0, 60.0)
            assert stage == "preview" and found.scene.target.z == request.scene.target.z
        late = PreviewRequest("one", 1, scene)  # which came after a newer one
        desk.ask(late)
        assert late.replaced and not newer.replaced
        assert [desk.answer(newer, k, 120.0)[0] for k in range(len(STAGES))] == list(STAGES)
        settled = newer.answers[1][1]
        assert np.array_equal(settled.pictures[0][1], preview(newer.scene, size=MORE).pictures[0][1])
        lens, made, lit = newer.answers[2][1]
        assert lens is settled and made.grade == "milled-sanded" and lit.name == "led"
        told = preview_json.of_made(lens, made, lit)
        assert len(told["targets"]) == 2 and len(told["sentences"]) == 3
        assert set(newer.answers[4][1]["predicted"]) == {"draft", "standard", "fine"}
        refused = PreviewRequest("three", 1, scene.changed({"target.x": [9e4, 9.1e4]}))
        desk.ask(refused)
        assert isinstance(desk.answer(refused, 0, 60.0)[1], SceneError) and refused.done
        desk.drop("two")
        assert other.replaced
    finally:
        desk.end()


def test_a_desk_that_closes_wakes_who_waits_for_an_answer(monkeypatch):
    """Ctrl-C would else wait for them, and cut them off."""
    monkeypatch.setattr(PreviewDesk, "_work", lambda self: None)
    desk, request = PreviewDesk(), PreviewRequest("a", 1, None)
    desk.ask(request)
    waiting = threading.Thread(target=desk.answer, args=(request, 3, 60.0))
    waiting.start()
    desk.close()
    waiting.join(30.0)
    assert not waiting.is_alive() and request.replaced
