"""Trials by superposed pictures stand up to full traces, and tolerances for a yield keep it."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import threading
from dataclasses import replace

import distributed
import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_limits

import bstcad
from bstcad import cli, commands
from bstcad.cad import step_reading
from bstcad.commands import ProofOptions
from bstcad.designs.folder import read_nominal
from bstcad.figures.figure_jobs import NoPictures
from bstcad.manufacture.tolerance import study, tolerances, tolerancing
from bstcad.manufacture.tolerance.grades import graded_table, perturbations
from bstcad.manufacture.tolerance.perturbations import trials
from bstcad.manufacture.tolerance.study import StudySettings, TargetPictures, gram, principal_axes, product, run_locally
from bstcad.report.record import of_json
from bstcad.report.report import BEGIN, END
from bstcad.runs.cluster import Cluster
from tests.conftest import quick_effort

TUBES, FEW_TUBES, FULL = 129, 65, 24


@pytest.fixture(scope="module")
def pictures(small_design, setup):
    nominal = read_nominal(small_design.folder)
    return TargetPictures(setup, perturbations(setup, graded_table(()), "PMMA"), nominal.goals[0].picture, TUBES)


@pytest.fixture(scope="module")
def found(pictures):
    nominal = study.traced_figure(pictures, np.zeros(len(pictures.perturbations)))
    return study.study(pictures, 1.02 * nominal, nominal, StudySettings(seed=3, full=FULL))


@pytest.mark.parametrize("layer", ["omp", "workqueue"])
def test_pictures_two_at_a_time_are_those_of_one(pictures, layer, monkeypatch):
    """Numba's own pool of threads (workqueue) must not be entered twice at a time: it would end the process."""
    monkeypatch.setattr("numba.threading_layer", lambda: layer)
    monkeypatch.setattr("torch.get_num_threads", lambda: 2)
    amounts = list(trials(pictures.perturbations, 3, range(8)))
    busy, most = [], []

    def of(pictures, z):
        busy.append(z)
        most.append(len(busy))
        try:
            return pictures.vector(z)
        finally:
            busy.pop()

    found = list(run_locally(of, pictures, amounts))
    assert max(most) == {"omp": 2, "workqueue": 1}[layer]
    assert all(np.array_equal(a, pictures.vector(z)) for a, z in zip(found, amounts, strict=True))


def test_after_an_interrupt_nobody_waits_for_a_picture_under_way():
    """One of a large net takes ten seconds, and Ctrl-C ends a study within three."""
    began, goes_on, ended = threading.Event(), threading.Event(), []

    def work(shared, item):
        if item == 2:
            began.set()
            goes_on.wait(10.0)
            ended.append(item)
        return item

    found = run_locally(work, None, [0, 1, 2, 3, 4])
    assert (next(found), next(found)) == (0, 1) and began.wait(10.0)
    with pytest.raises(KeyboardInterrupt):
        found.throw(KeyboardInterrupt())
    assert ended == []
    goes_on.set()


def test_amounts_are_as_wide_as_they_say(pictures):
    drawn = trials(pictures.perturbations, 1, range(4000))
    for p, amounts in zip(pictures.perturbations, drawn.T, strict=True):
        assert np.std(amounts) == pytest.approx(p.sigma, rel=0.05)
        assert p.distribution == "field" or np.abs(amounts).max() <= p.limit
    assert np.array_equal(trials(pictures.perturbations, 1, [77]), drawn[[77]])


def test_superposed_pictures_stand_up_to_full_traces(found):
    off = found.disagreement
    assert np.median(off) < 0.03 and np.percentile(off, 95) < 0.1
    assert np.std(found.full) > 5 * np.median(np.abs(found.linear[:FULL] - found.full))  # they tell good from bad


def test_derivatives_are_those_of_smaller_steps(pictures, found):
    """Differences by a fifth of the step agree, for each error that matters."""
    sizes = np.linalg.norm(found.model.first, axis=1)
    for k in np.flatnonzero(sizes > 0.1 * sizes.max()):
        step = np.zeros(len(sizes))
        step[k] = 0.1 * found.model.sigmas[k]
        near = (pictures.vector(step) - pictures.vector(-step)) / 0.2
        assert np.linalg.norm(near - found.model.first[k]) < 0.015 * sizes[k] + 1e-9, pictures.perturbations[
            k
        ].kind.name


def test_tolerances_for_a_yield_keep_it(found):
    loose, kept = study.loosest_limits(found, 0.8)
    low, _, high = kept
    assert low - 0.005 <= 0.8 <= high + 0.005
    assert len({round(new.limit / old.limit, 6) for new, old in zip(loose, found.perturbations, strict=True)}) > 3


def test_adjusting_the_screen_never_makes_it_worse(found):
    assert (found.adjusted <= found.linear[:FULL] + 1e-12).all()
    assert found.fraction_within(found.adjusted)[1] >= found.fraction_within(found.linear[:FULL])[1]


def test_the_screen_can_be_adjusted_where_it_is_no_error(pictures):
    """A lens off its axis shifts the picture, and the screen follows it; the errors' own figures have no part of it."""
    decentres = tuple(p for p in pictures.perturbations if p.kind.name.startswith("lens.decentre"))
    few = replace(pictures, perturbations=tuple(replace(p, limit=0.05) for p in decentres), tubes=FEW_TUBES)
    nominal = study.traced_figure(few, np.zeros(2))
    found = study.study(few, 1.02 * nominal, nominal, StudySettings(seed=3, trials=100, full=10))
    raised = found.linear[:10] > 1.05 * nominal
    assert raised.sum() > 3
    assert (found.adjusted[raised] - nominal < 0.5 * (found.linear[:10][raised] - nominal)).all()
    assert {s.name for s in found.sensitivities} == {"lens.decentre_x", "lens.decentre_y"}
    assert sum(s.share for s in found.sensitivities) == pytest.approx(1.0)
    loose, _ = study.loosest_limits(found, 0.8)
    assert len(loose) == 2


def rows(n=7, length=50_001):
    found = np.random.default_rng(5).standard_normal((n, length))
    found[3] = found[2] + 1e-6 * found[3]  # nearly alike: one axis of hardly any strength
    return found


def test_products_and_main_axes_are_those_of_matrices():
    a, known = rows(), gram(rows())
    np.testing.assert_allclose(known, a @ a.T, rtol=0, atol=1e-9)
    np.testing.assert_allclose(product(a.T[:9], known), a.T[:9] @ (a @ a.T), rtol=0, atol=1e-8)
    values, axes = principal_axes(known)
    assert (np.diff(values) <= 0).all()
    np.testing.assert_allclose(axes.T @ axes, np.eye(7), rtol=0, atol=1e-14)
    np.testing.assert_allclose((axes * values) @ axes.T, known, rtol=0, atol=1e-10 * values[0])


def test_no_bit_depends_on_the_number_of_threads():
    before, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 4):
            torch.set_num_threads(count)
            with threadpool_limits(count):
                known = gram(rows(60, 2_001))
                values, axes = principal_axes(known)
                found.append((known, values, axes, product(rows(60, 60), axes)))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(np.array_equal(one, two) for one, two in zip(found[0], other, strict=True))


@pytest.fixture(scope="module")
def studied(small_design, tmp_path_factory):
    """(a copy of the small design that `bstcad tolerance` was run on, what it said)."""
    folder = shutil.copytree(small_design.folder, tmp_path_factory.mktemp("studied") / "small")
    said, quick = io.StringIO(), tolerancing.tolerance
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said):
        few = {"tubes": FEW_TUBES, "full": 10, "trials": 200}
        patch.setattr(tolerancing, "tolerance", lambda folder, settings: quick(folder, replace(settings, **few)))
        assert cli.run(["tolerance", str(folder), "--yield", "90", "--grade", "moulded"]) == 0
    return folder, said.getvalue()


def test_the_command_writes_what_it_found_and_a_trial_as_a_part(small_design, studied, capsys):
    folder, said = studied
    assert "Yield for an RRMSD up to" in said and "of 10 full traces" in said and "loosest" in said
    facts = json.loads((folder / "tolerance.json").read_text())
    assert {"yield", "limit", "trials", "sensitivities", "worst"} <= set(facts)
    assert facts["version"] == bstcad.__version__
    assert facts["yield"][0] <= facts["yield"][1] <= facts["yield"][2]
    changes = [item["rrmsd_change"] for item in facts["sensitivities"]]
    assert changes == sorted(changes, reverse=True)
    assert cli.run(["tolerance", str(folder), "--trial", "4", "--grade", "moulded"]) == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert lines["lens.tilt_x"].endswith(" deg") and lines["lens.thickness"].endswith(" mm")
    made = step_reading.read(folder / "trial-4.step")
    nominal = read_nominal(folder)
    assert 0 < np.abs(made.control_points - nominal.lens.back.control_points()).max() < 1.0


def test_the_report_has_a_section_on_it_which_a_new_proof_keeps(small_design, studied):
    folder, _ = studied
    before, page = ((place / "report.html").read_text() for place in (small_design.folder, folder))
    assert "<h2>Tolerances</h2>" in page and "<h2>Tolerances</h2>" not in before
    assert page.count("data:image/png") == before.count("data:image/png") + 2
    assert all(f'<th scope="row">{worst["number"]}</th>' in page for worst in facts_of(folder)["worst"])
    section = page.partition(f"{BEGIN}\n")[2].partition(END)[0]
    assert page.replace(section, "") == before  # and nothing else has changed
    commands.verify(folder, ProofOptions(quick_effort(), NoPictures))
    assert section in (folder / "report.html").read_text()
    assert tolerances.put_into(folder / "report.html", section) == (folder / "report.html").read_bytes()


@pytest.mark.parametrize("change", [{"limit": "<b>"}, {"more": 1}], ids=lambda change: next(iter(change)))
def test_a_study_that_is_not_ours_has_no_section(studied, tmp_path, change):
    folder, _ = studied
    (tmp_path / "tolerance.json").write_text(json.dumps(facts_of(folder)))
    assert "<h2>Tolerances" in tolerances.of_folder(tmp_path, "lens")
    (tmp_path / "tolerance.json").write_text(json.dumps(facts_of(folder) | change))
    assert tolerances.of_folder(tmp_path, "lens") == ""


def test_a_section_escapes_what_it_is_told(studied, tmp_path):
    facts = facts_of(studied[0])
    facts["sensitivities"][0]["words"] = "<script>alert(1)</script>"
    assert "<script>" not in tolerances.section(of_json(json.dumps(facts), tolerances.Tolerances), {}, "lens")


def facts_of(folder):
    return json.loads((folder / "tolerance.json").read_text())


@pytest.mark.thorough
def test_no_bit_depends_on_how_many_workers_trace(pictures):
    """Threads of this process here; processes of their own, one of them killed, in the benchmark."""
    few = replace(pictures, perturbations=pictures.perturbations[::5], tubes=FEW_TUBES)
    threads = {"n_workers": 3, "threads_per_worker": 1, "processes": False, "dashboard_address": "127.0.0.1:0"}
    with distributed.LocalCluster(**threads) as local, Cluster(local.scheduler_address) as cluster:
        there = study.study(few, 1.0, 0.0, StudySettings(seed=3, trials=50, full=6, spread=cluster.spread))
    here = study.study(few, 1.0, 0.0, StudySettings(seed=3, trials=50, full=6))
    assert np.array_equal(there.model.gram, here.model.gram) and np.array_equal(there.full, here.full)
    assert np.array_equal(there.linear, here.linear) and np.array_equal(there.adjusted, here.adjusted)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--grade", "fine"], "--grade fine: unknown grade; give one of moulded, diamond-turned, precise"),
        (["--yield", "120"], "--yield 120: is not between 0 and 100"),
        (["--workers", "2", "--scheduler", "tcp://127.0.0.1:9"], "give one of the two"),
    ],
)
def test_wrong_input_is_one_sentence(small_design, capsys, arguments, sentence):
    assert cli.run(["tolerance", str(small_design.folder), *arguments]) == 2
    assert sentence in capsys.readouterr().err
