"""Trials by superposed pictures stand up to full traces, and tolerances for a yield keep it."""

from __future__ import annotations

import json
import re
import shutil

import numpy as np
import pytest

from bstcad import cli
from bstcad.cad import step_reading
from bstcad.runs.folder import read_nominal
from bstcad.tolerance import command, study
from bstcad.tolerance.model import Pictures
from bstcad.tolerance.perturbation import trial, trials
from bstcad.tolerance.setup import Setup
from bstcad.tolerance.stated import perturbations, whole_table

TUBES, FULL = 257, 40


@pytest.fixture(scope="module")
def pictures(small_design):
    _, nominal = read_nominal(small_design.folder)
    setup = Setup(nominal.lens, nominal.channels, nominal.screen)
    return Pictures(setup, perturbations(setup, whole_table(()), "PMMA"), nominal.target, TUBES)


@pytest.fixture(scope="module")
def found(pictures):
    nominal = pictures.rrmsd(np.zeros(len(pictures.perturbations)))
    return study.study(pictures, 1.02 * nominal, 3, nominal, full=FULL)


def test_amounts_are_as_wide_as_they_say(pictures):
    drawn = trials(pictures.perturbations, 1, 4000)
    for p, amounts in zip(pictures.perturbations, drawn.T, strict=True):
        assert np.std(amounts) == pytest.approx(p.sigma, rel=0.05)
        assert p.distribution == "field" or np.abs(amounts).max() <= p.limit
    assert np.array_equal(trial(pictures.perturbations, 1, 77), drawn[77])


def test_superposed_pictures_stand_up_to_full_traces(found):
    off = found.disagreement
    assert np.median(off) < 0.03 and np.percentile(off, 95) < 0.1
    assert np.std(found.full) > 5 * np.median(np.abs(found.linear[:FULL] - found.full))  # they tell good from bad


def test_derivatives_are_those_of_smaller_steps(pictures, found):
    """By differences a fifth as far, for each error that matters."""
    sizes = np.linalg.norm(found.model.first, axis=1)
    for k in np.flatnonzero(sizes > 0.1 * sizes.max()):
        step = np.zeros(len(sizes))
        step[k] = 0.1 * found.model.sigmas[k]
        near = (pictures.of(step) - pictures.of(-step)) / 0.2
        assert np.linalg.norm(near - found.model.first[k]) < 0.01 * sizes[k] + 1e-9, pictures.perturbations[k].kind.name


def test_tolerances_for_a_yield_keep_it(found):
    loose, kept = study.loosest(found, 0.8)
    assert kept.low - 0.005 <= 0.8 <= kept.high + 0.005
    assert len({round(new.limit / old.limit, 6) for new, old in zip(loose, found.perturbations, strict=True)}) > 3


def test_adjusting_the_screen_never_makes_it_worse(found):
    assert (found.adjusted <= found.linear[:FULL] + 1e-12).all()
    assert found.passed_adjusted.likely >= study.yield_of(found.linear[:FULL], found.limit).likely


def test_the_command_writes_what_it_found_and_a_trial_as_a_part(small_design, monkeypatch, capsys):
    monkeypatch.setattr(command, "TUBES", TUBES)
    monkeypatch.setattr(command.studies, "FULL", 10)
    folder = str(small_design.folder)
    quick = command.tolerance
    monkeypatch.setattr(command, "tolerance", lambda *a, **k: quick(*a, **k, tubes=TUBES, full=10, trials=500))
    try:
        assert cli.run(["tolerance", folder, "--yield", "90", "--grade", "precise"]) == 0
        said = capsys.readouterr().out
        assert "Yield, RRMSD up to" in said and "of 10 full traces" in said and "loosest" in said
        facts = json.loads((small_design.folder / "tolerance.json").read_text())
        assert {"yield", "limit", "trials", "sensitivities", "worst"} <= set(facts)
        assert facts["yield"][0] <= facts["yield"][1] <= facts["yield"][2]
        changes = [item["rrmsd_change"] for item in facts["sensitivities"]]
        assert changes == sorted(changes, reverse=True)
        assert cli.run(["tolerance", folder, "--trial", "4", "--grade", "moulded"]) == 0
        made = step_reading.read(small_design.folder / "trial-4.step")
        _, nominal = read_nominal(small_design.folder)
        assert 0 < np.abs(made.control_points - nominal.lens.back.control_points()).max() < 1.0
    finally:
        for name in ("tolerance.json", "trial-4.step"):
            (small_design.folder / name).unlink(missing_ok=True)


def test_a_design_that_is_too_poor_itself_is_told_before_the_work(small_design, tmp_path, capsys):
    folder = shutil.copytree(small_design.folder, tmp_path / "strict")
    text = (folder / "scene.toml").read_text()
    (folder / "scene.toml").write_text(re.sub(r"^rrmsd = .*$", "rrmsd = 0.001", text, flags=re.M))
    assert cli.run(["tolerance", str(folder), "--yield", "90"]) == 2
    assert "tolerances.rrmsd: the design itself is at 0.0" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--grade", "fine"], "--grade fine: there is no such grade; give one of moulded, diamond-turned, precise"),
        (["--yield", "120"], "--yield 120: give the percent of lenses that are to pass, such as 90"),
        (["--trial", "-1"], "--seed and --trial count from 0"),
    ],
)
def test_wrong_input_is_one_sentence(small_design, capsys, arguments, sentence):
    assert cli.run(["tolerance", str(small_design.folder), *arguments]) == 2
    assert sentence in capsys.readouterr().err
