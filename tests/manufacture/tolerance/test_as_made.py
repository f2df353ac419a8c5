"""The picture as made: which effects a grade has, what they do, and the command that predicts it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import bstcad
from bstcad import cli, commands
from bstcad.manufacture.tolerance.as_made import FORM_ERROR, LAYERS, MARKS, ROUGHNESS, as_made, contrast
from bstcad.manufacture.tolerance.grades import GRADES, finish_of, graded_table, perturbations
from bstcad.optics.trace.finish import Finish
from bstcad.planning.preview import preview
from bstcad.planning.reduction import Reduction
from bstcad.scene.quality import GRADE_NAMES, Tolerance, tolerance_complaints
from bstcad.scene.scene import load
from tests import suite
from tests.planning.conftest import typical_pilot

FEW = Reduction(pixels=40, net=65, cells=48, tubes=96, rounds=1, evaluations=4, blurred=4)
SUN = "templates/sun_caustic.toml"


@pytest.fixture(scope="module")
def plate():
    """The plate in the sun, made small."""
    return preview(load(SUN), FEW)


def test_every_grade_has_limits_and_a_finish():
    assert set(GRADES) == set(GRADE_NAMES)
    for name, grade in GRADES.items():
        finish = finish_of(graded_table((), name))
        assert (finish.ripple, finish.period) == (grade.ripple, grade.period) and finish.roughness > 0
        assert (finish.layer_height is not None) == name.startswith("resin")
        assert finish.layer_height is None or 0.025 <= finish.layer_height <= 0.1  # mm


@pytest.mark.parametrize("name", GRADE_NAMES)
def test_every_grade_is_one_of_a_study(setup, name):
    errors = {error.kind.name: error for error in perturbations(setup, graded_table((), name), "PMMA")}
    assert errors["lens.thickness"].limit == GRADES[name].thickness and errors["lens.tilt_x"].limit == GRADES[name].tilt


def test_tables_change_the_finish():
    own = (
        Tolerance(grade="resin-printed", layer_height=0.1, roughness=50.0),
        Tolerance(smoothing_length=0.3, roughness_length=0.01),
        Tolerance(name="back.ripple", limit=3e-3, period=2.0),
    )
    expected = Finish(50.0, 0.01, layer_height=0.1, smoothing_length=0.3, ripple=3e-3, period=2.0)
    assert finish_of(graded_table(own)) == expected
    assert finish_of(graded_table(own, "milled-sanded")) == expected
    plain = finish_of(graded_table((Tolerance(grade="none"),)))
    assert (plain.layer_height, plain.ripple, plain.roughness) == (None, 0.0, 0.0)
    assert finish_of(graded_table((Tolerance(name="back.ripple", grade="none"),), "moulded")).ripple == 0.0
    [fault] = tolerance_complaints((Tolerance(name="back.form", limit=1e-3, layer_height=0.1),))
    assert fault.startswith("tolerance[0].layer_height: ")


def test_the_contrast_is_one_of_the_target_and_none_of_even_light():
    target = np.array([[0.0, 1.0], [2.0, 1.0]])
    assert contrast(target, target) == 1.0
    assert contrast(target, np.ones((2, 2))) == 0.0
    assert contrast(target, (target + 1) / 2) == 0.5
    assert contrast(np.ones((2, 2)), target) is None


@suite.in_turn(1, 2)
def test_a_part_as_designed_has_the_picture_of_the_preview(plate):
    """Without any error, finish and form, both ways to trace a lens and to blur it by the sun are one."""
    [goal] = as_made(replace(plate, scene=plate.scene.changed({"tolerance": [{"grade": "none"}]}))).goals
    assert goal.made == pytest.approx(goal.designed) and max(goal.changes.values()) == 0.0
    seen = plate.pictures[0][1]
    assert np.abs(goal.designed - seen).max() < 0.02 * seen.max()
    assert goal.rrmsds[0] == pytest.approx(plate.rrmsds[0], rel=0.05)


@suite.in_turn(1, 2)
def test_each_grade_loses_contrast_to_what_it_is_known_for(plate):
    """Layers of a print, roughness of a sanded face; a coat and polishing restore the picture."""
    found = {name: plate.as_made(name) for name in GRADE_NAMES}
    goals = {name: made.goals[0] for name, made in found.items()}
    lost = {name: goal.contrasts[0] - goal.contrasts[1] for name, goal in goals.items()}
    assert lost["resin-printed"] > 0.4 and next(iter(goals["resin-printed"].changes)) == LAYERS
    assert lost["milled-sanded"] > 0.1 and next(iter(goals["milled-sanded"].changes)) == ROUGHNESS
    assert max(lost[name] for name in GRADE_NAMES if name not in ("resin-printed", "milled-sanded")) < 0.1
    assert set(goals["milled-polished"].changes) == {MARKS, ROUGHNESS, FORM_ERROR}
    assert found["milled-sanded"].scattered > 0.7 > 0.1 > found["milled-polished"].scattered
    for goal in goals.values():
        assert goal.light <= goal.light_designed + 1e-6 and goal.made.sum() == pytest.approx(goal.target.sum())


@suite.in_turn(1, 2)
def test_finer_layers_make_a_better_picture(plate):
    """50 µm lose more than 25 µm, which lose more than 5 µm; the widths of terraces are proportional to the height."""
    kept = [plate.as_made("resin-printed", layer).goals[0].contrasts[1] for layer in (0.05, 0.025, 0.005)]
    assert kept == sorted(kept) and kept[2] - kept[0] > 0.4


@suite.in_turn(0, 2)
def test_plan_predicts_the_part_as_made(tmp_path, capsys, monkeypatch):
    predict, known = commands.predict_as_made, []

    def once(*given, **more):
        known.extend([] if known else [predict(*given, **more, size=FEW)])
        return known[0]

    monkeypatch.setattr(commands, "predict_as_made", once)
    monkeypatch.setattr("bstcad.planning.plan.run_pilot", typical_pilot)
    png = tmp_path / "made.png"
    given = ["plan", SUN, "--made", "resin-printed", "--layer", "0.1", "--made-png", str(png)]
    assert cli.run(given) == 0
    out = capsys.readouterr().out
    assert "printed in resin" in out and "layers" in out and png.read_bytes().startswith(b"\x89PNG")
    assert cli.run([*given[:6], "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["made"]
    assert told["grade"] == "resin-printed" and told["finish"]["layer_height"] == 0.1
    assert 0 < told["goals"][0]["contrast"] < told["goals"][0]["contrast_designed"]


@pytest.mark.parametrize("given", [["--made", "shiny"], ["--layer", "0.1"], ["--made-png", "made.png"]])
def test_plan_refuses_what_has_no_grade(given, capsys):
    assert cli.run(["plan", SUN, *given]) == 2
    assert "--made" in capsys.readouterr().err


@suite.in_turn(1, 2)
def test_a_finished_design_is_predicted_in_python(small_design):
    design = bstcad.open(small_design.folder)
    made = design.as_made("resin-printed", layer_height=0.1)
    assert made.finish.layer_height == 0.1 and isinstance(made.goals[0].made, np.ndarray)
    assert made.goals[0].rrmsds[1] > made.goals[0].rrmsds[0]
    assert design.as_made().grade == "diamond-turned"
