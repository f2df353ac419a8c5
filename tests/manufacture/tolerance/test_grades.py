"""Errors follow from a grade and from the tables of the scene."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from bstcad.cad import step_reading
from bstcad.designs.folder import read_nominal
from bstcad.manufacture.tolerance import tolerancing
from bstcad.manufacture.tolerance.grades import FORM_MODES, base_grade, graded_table, perturbations
from bstcad.manufacture.tolerance.perturbations import as_net, form_error, kinds
from bstcad.manufacture.tolerance.study import StudySettings
from bstcad.scene.errors import SceneError
from bstcad.scene.quality import Name, Tolerance
from bstcad.scene.scene import load

SAID = (
    Tolerance(grade="precise"),
    Tolerance(name="lens.tilt", limit=0.01, distribution="uniform", cost=3.0),
    Tolerance(name="lens.tilt_y", grade="moulded"),
    Tolerance(name="screen.tilt", grade="none"),
    Tolerance(name="front.form", limit=6e-5, correlation_length=2.5),
)


def by_name(setup, table, grade=None):
    return {p.kind.name: p for p in perturbations(setup, graded_table(table, grade), "PMMA")}


def test_a_table_changes_what_it_says_and_nothing_else(setup):
    plain, found = by_name(setup, (), "precise"), by_name(setup, SAID)
    tilted = found["lens.tilt_x"]
    assert (tilted.limit, tilted.distribution, tilted.cost) == (0.01, "uniform", 3.0)
    assert (found["lens.tilt_y"].limit, found["lens.tilt_y"].cost) == (0.1, 3.0)  # the later goes before, of the width
    assert plain.keys() - found.keys() == {"screen.tilt_x", "screen.tilt_y"}
    assert found.keys() - plain.keys() == {f"front.form_{k}" for k in range(FORM_MODES)}
    assert found["front.form_0"].limit == pytest.approx(6e-5 / FORM_MODES**0.5)
    same = plain.keys() & found.keys() - {"lens.tilt_x", "lens.tilt_y"}
    assert all(plain[name].limit == found[name].limit for name in same)


def test_a_grade_of_the_command_line_goes_before_the_one_of_the_table(setup):
    assert base_grade(graded_table(SAID)) == "precise" and base_grade(graded_table(())) == "diamond-turned"
    found = by_name(setup, SAID, "moulded")
    assert found["lens.thickness"].limit == 0.05 and found["lens.tilt_x"].limit == 0.01


def test_only_what_is_named_can_be_off_without_a_grade(setup):
    found = by_name(setup, (Tolerance(grade="none"), Tolerance(name="lens.scale", limit=1e-3)))
    assert list(found) == ["lens.scale"]


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ((Tolerance(name="source.size", limit=0.1),), r"tolerance\[0\].name: 'source.size' has no effect"),
        (
            (Tolerance(name="back.ripple", period=0.1),),
            "tolerance: back.ripple: a ripple's period of 0.1 mm is too fine",
        ),
        ((Tolerance(grade="none"),), "tolerance: all errors are zero"),
    ],
)
def test_what_cannot_be_is_a_sentence(setup, table, sentence):
    with pytest.raises(SceneError, match=sentence):
        by_name(setup, table)


def test_every_kind_of_error_has_a_name_in_scene_files(setup):
    names = get_args(Name)
    for kind in kinds(setup, "PMMA"):
        assert any(Tolerance(name=name, limit=1.0).covers(kind) for name in names), kind


def test_a_scene_keeps_its_tables(small_scene, tmp_path):
    scene = small_scene.changed({"tolerance": SAID})
    (tmp_path / "scene.toml").write_text(scene.toml())
    assert load(tmp_path / "scene.toml") == scene and scene.tolerance == SAID


def test_a_form_error_of_the_front_moves_light_and_is_made(small_design, setup, monkeypatch):
    """The front moves about as much light as the back does, as an interface of the same index."""
    front, back = (form_error(setup.lens, 2.5, 0, face) for face in ("front", "back"))
    nominal = setup.picture(129)
    moved = [np.linalg.norm(kind.apply(setup, 1e-4).picture(129) - nominal) for kind in (front, back)]
    assert 0.2 < moved[0] / moved[1] < 3
    read = read_nominal(small_design.folder)
    stated = replace(read, scene=read.scene.model_copy(update={"tolerance": SAID}))
    monkeypatch.setattr(tolerancing, "read_nominal", lambda folder: stated)
    path = small_design.folder / "trial.step"
    try:
        written = tolerancing.write_trial(small_design.folder, 1, path, StudySettings())
        amounts = {kind.name: amount for kind, amount in written}
        made = step_reading.lens(step_reading.read(path), 1.5)
    finally:
        path.unlink(missing_ok=True)
    wanted = as_net(read.lens.front, read.lens.outline)
    off = made.front.control_points()[..., 2] - wanted.control_points()[..., 2]
    assert amounts["front.form_0"] != 0 and 1e-6 < np.ptp(off) < 1e-2
