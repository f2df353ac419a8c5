"""Tolerances of the letters and the portrait at full size: how long the command takes, and what its trials are worth.

Figures are printed.
"""

from __future__ import annotations

import time

import numpy as np
import pytest

from bstcad import commands
from bstcad.scene.scene import load
from bstcad.tolerance import study, tolerancing
from bstcad.tolerance.study import Model
from tests.benchmarks.cold import TEMPLATES

pytestmark = pytest.mark.bench
WANTED = 0.9


@pytest.fixture(scope="module", params=["thu", "portrait"])
def folder(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param) / request.param
    commands.generate(load(TEMPLATES / f"{request.param}.toml", {"tailoring.quality": "draft"}), folder, device="cpu")
    return folder


def test_a_study_at_full_size(folder, capsys, monkeypatch):
    seconds = []
    rrmsds = Model.rrmsds

    def timed(model: Model, amounts: np.ndarray) -> np.ndarray:
        began = time.perf_counter()
        found = rrmsds(model, amounts)
        if len(amounts) == study.LINEAR:
            seconds.append(time.perf_counter() - began)
        return found

    monkeypatch.setattr(Model, "rrmsds", timed)
    began, cpu = time.perf_counter(), time.process_time()
    facts = tolerancing.tolerance(folder, grade="precise", wanted=WANTED).facts()
    whole, cpu = time.perf_counter() - began, time.process_time() - cpu
    off, kept = facts["model_off"], facts["inverse"]["yield"]
    with capsys.disabled():
        print(
            f"\n{folder.name}: {len(facts['sensitivities'])} errors and {facts['full_trials']} full traces in "
            f"{whole:.0f} s, {cpu:.0f} s of CPU; {facts['trials']} trials in {seconds[0]:.2f} s; superposed pictures "
            f"off by {off['median']:.2%} (median), {off['95 %']:.2%} (95 of 100); a yield of {WANTED:.0%} wanted, "
            f"{kept[1]:.2%} kept"
        )
    assert len(facts["sensitivities"]) >= 20 and facts["full_trials"] == study.FULL
    assert off["median"] < 0.03 and off["95 %"] < 0.1
    assert kept[0] - 0.003 <= WANTED <= kept[2] + 0.003
