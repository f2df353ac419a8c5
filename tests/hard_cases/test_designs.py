"""Designs that must come through.

Each in this process, in a rough draft: no exception, a valid solid, finite numbers, and a report that says in words
what was given up.  `python -m tests.hard_cases.designs` runs them larger, from the command line.
"""

from __future__ import annotations

import html
import json

import numpy as np
import pytest

from bstcad import commands
from bstcad.commands import ProofOptions
from bstcad.designs.pipeline import design
from bstcad.optics.trace.measure import Effort
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import load
from bstcad.verify.nominal import DEFAULT_RRMSD_LIMIT
from tests import suite
from tests.conftest import draws_nothing
from tests.hard_cases.designs import DESIGNS, overrides

ROUGH = {
    "lens.back.control_points": 33,
    "target.pixels": 32,
    "tailoring.quality": "draft",
    "tailoring.rays": 192,
    "tailoring.transport_grid": 64,
    "tailoring.stage2_iterations": 10,
}
LEFT_OUT = "Not simulated: "
INSIDE = "The light varies inside the pixels"  # near the limit of this remark on another machine


POSSIBLE = [name for name, hard in DESIGNS.items() if not hard.refused]
LONG = [pytest.param(name, marks=pytest.mark.bench) for name in POSSIBLE if DESIGNS[name].bench]


@pytest.mark.parametrize("name", [*suite.in_turns([name for name in POSSIBLE if not DESIGNS[name].bench], 4), *LONG])
def test_it_comes_through(name, tmp_path, monkeypatch):
    hard, pictures, folder = DESIGNS[name], tmp_path / "pictures", tmp_path / "lens"
    pictures.mkdir()
    scene = load(*overrides(name, pictures, {**ROUGH, **hard.rough}))
    draws_nothing(monkeypatch)
    effort = Effort(max(512, hard.sizes.get("target.pixels", 0)))  # enough rays to resolve the RRMSD of its pixels
    told = []

    def progress(stage, done, total, text):
        told.append((stage, text))

    report = commands.generate(scene, folder, ProofOptions(effort), commands.Hooks(progress), device="cpu").facts
    before = [text for stage, text in told if stage == "reach"]
    assert all(any(words in sentence for sentence in before) for words in hard.told), before
    assert not before or [stage for stage, _ in told].index("reach") < [stage for stage, _ in told].index("stage 1")
    said = report["given_up"]
    sure = [sentence for sentence in said if not any(words in sentence for words in (*hard.perhaps, LEFT_OUT, INSIDE))]
    changes = [entry["rrmsd_change"] or 0.0 for entry in report["estimates"]]
    outweighs = sum(change > min(report["rrmsd"], report["rrmsd_asked"] or DEFAULT_RRMSD_LIMIT) for change in changes)
    assert sum(LEFT_OUT in sentence for sentence in said) == outweighs
    failed = {check["id"] for check in report["checks"] if not check["passed"]}
    if "rrmsd" in failed:  # few evaluations leave ripple in an unsharp lens
        failed -= {"ripple"}
    assert failed <= {"rrmsd", "rrmsd-half"}
    assert report["passed"] is not bool(failed)
    assert report["rrmsd"] <= hard.rrmsd
    assert report["efficiency"] >= hard.efficiency
    assert report["shape"]["thickness_min"] >= scene.lens.min_thickness
    assert report["skipped_steps"] == 0
    assert len(sure) == len(hard.says), said
    assert all(words in sentence for words, sentence in zip(hard.says, sure, strict=True)), said
    with np.load(folder / "design.npz", allow_pickle=False) as arrays:
        numbers = [values for values in arrays.values() if values.dtype.kind == "f"]
        assert len(numbers) > 6 and all(np.isfinite(values).all() for values in numbers)
    assert json.loads((folder / "report.json").read_text())["given_up"] == said
    page = html.unescape((folder / "report.html").read_text())
    assert all(sentence in page for sentence in said) and ("<h2>Remarks</h2>" in page) is bool(said)


@pytest.mark.parametrize("name", suite.in_turns([name for name, hard in DESIGNS.items() if hard.refused], 2))
def test_it_is_refused_in_one_sentence(name, tmp_path):
    with pytest.raises(SceneError, match=DESIGNS[name].refused) as refusal:
        design(load(*overrides(name, tmp_path, ROUGH)), device="cpu")
    assert "\n" not in str(refusal.value)
