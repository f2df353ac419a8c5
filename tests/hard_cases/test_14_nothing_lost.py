"""14. Killed, interrupted, starved of disk, fed with values that are not finite.

Checkpoints that are written in place are lost with the process that writes them (Lightning #688), and a design that
goes on from one is often another design (the minimiser's memory is left out).  Here a checkpoint changes places in
one step with the one before, holds all that the next step depends on, and so does the output folder.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from bstcad.pipeline import Saved, design
from bstcad.runs import checkpoint
from bstcad.scene.scene import load
from bstcad.tailoring import stage2
from tests.conftest import DISK, SMALL
from tests.hard_cases import killed

CONTENTS = {
    "lens.step", "lens.stl", "lens.3mf", "design.npz", "scene.toml", "prescription.txt", "report.json", "report.html",
    "report.junit.xml", "figures", "datasheet.pdf",
}  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """(digest of the design, seconds) of a run that nobody disturbs."""
    folder = tmp_path_factory.mktemp("whole") / "lens"
    running, began = killed.start(folder), time.perf_counter()
    assert "done" in running.communicate()[0]
    return killed.design_of(folder), time.perf_counter() - began


@pytest.mark.bench
@pytest.mark.parametrize("kills", [50])
def test_kill_9_at_random_moments(kills, whole, tmp_path, holds):
    """Each time the next run goes on; a design that got finished in between begins anew beside its folder.

    The moments are those of the first, the second and the last third of a run in turn.
    """
    digest, seconds = whole
    moments, folder, clean = random.Random(kills), tmp_path / "lens", 0
    for kill in range(kills):
        running = killed.start(folder)
        time.sleep(seconds * (kill % 3 + moments.random()) / 3)
        running.kill()
        running.communicate()
        assert not folder.exists() or intact(folder, digest)
        kept = checkpoint.path_for(folder)
        if kept.exists():
            checkpoint.read(kept, Saved)  # raises if it is damaged
        clean += 1
    assert "done" in killed.finish(folder) and intact(folder, digest)
    assert list(tmp_path.iterdir()) == [folder]  # what the killed ones left has been cleared away
    holds(f"runs killed at random ({kills}) that left a damaged folder or checkpoint", kills - clean, 0)


def intact(folder, digest):
    """Every file of a design is there, the report whole, the design that of the undisturbed run to the bit."""
    report = json.loads((folder / "report.json").read_text())
    return {p.name for p in folder.iterdir()} == CONTENTS and killed.design_of(folder) == digest and "rrmsd" in report


def test_ctrl_c_writes_the_best_so_far_and_resume_ends_the_same(tmp_path, holds):
    """The command line itself, with its own checkpoints."""
    scene = tmp_path / "small.toml"
    scene.write_text(load(DISK, SMALL | {"tailoring.stage2_iterations": 100}).toml())
    code = (
        f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n{killed.FEW_RAYS}"
        "from bstcad.cli import main; main()"
    )
    command = [sys.executable, "-u", "-c", code, "generate", str(scene), "-o"]
    environment = os.environ | {"PYTHONPATH": str(killed.ROOT)}

    def run(*arguments):
        return subprocess.Popen(
            [*command, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
        )

    undisturbed = run(str(tmp_path / "whole"))
    stopped = run(str(tmp_path / "lens"))
    for line in stopped.stdout:
        if line.startswith("stage 2"):
            break
    time.sleep(0.3)
    stopped.send_signal(signal.SIGINT)
    said = stopped.stdout.read()
    assert stopped.wait() == 130, said
    assert "stopping with the best lens so far" in said
    assert said.splitlines()[-1].endswith("the same command with --resume goes on from there")
    report = json.loads((tmp_path / "lens" / "report.json").read_text())
    assert report["stopped"] == "interrupt" and report["stability"]["non_finite"] == 0
    assert {p.name for p in (tmp_path / "lens").iterdir()} == CONTENTS
    resumed = run(str(tmp_path / "lens"), "--resume")
    said = resumed.communicate()[0]
    assert resumed.returncode in (0, 1), said
    assert undisturbed.wait() in (0, 1)
    ours, theirs = (np.load(tmp_path / name / "design.npz") for name in ("lens", "whole"))
    off = float(np.abs(ours["control_points"] - theirs["control_points"]).max())
    holds("resumed after Ctrl-C against the undisturbed run, control points", off, 0.0, "mm")
    assert killed.design_of(tmp_path / "lens") == killed.design_of(tmp_path / "whole")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["lens", "small.toml", "whole"]


def test_an_unfinished_design_does_not_take_the_place_of_a_finished_one(small_design, tmp_path):
    from bstcad import commands

    assert commands.place_for(small_design.folder, "evaluations") == small_design.folder
    assert commands.place_for(small_design.folder, "interrupt").name == "small-unfinished"
    assert commands.place_for(tmp_path / "new", "interrupt") == tmp_path / "new"


def test_a_full_disk_is_a_sentence_and_loses_nothing(tmp_path):
    """A file that may not grow fails as a full disk does, but for the number (EFBIG).

    With 60 kB neither the checkpoint nor lens.step fits; with 0.5 MB these do, and report.html with its pictures does
    not.  Going on from a checkpoint is what the test above does.
    """
    folder = tmp_path / "lens"
    folder.mkdir()
    (folder / "report.json").write_text("{}")
    said = killed.finish(folder, "60000")
    assert "the design goes on without a checkpoint" in said
    assert "OSError: [Errno 27] File too large" in said  # which the command line says in a sentence: tests/test_cli.py
    assert sorted(p.name for p in tmp_path.iterdir()) == ["lens", "lens-unwritten"]  # which design.npz fits into
    said = killed.finish(folder, "500000")
    assert "File too large" in said and "the design so far is kept; the same command with --resume goes on" in said
    assert sorted(p.name for p in tmp_path.iterdir()) == [".lens.checkpoint", "lens", "lens-unwritten"]
    assert {p.name for p in (tmp_path / "lens-unwritten").iterdir()} == {"scene.toml", "design.npz"}
    assert checkpoint.read(tmp_path / ".lens.checkpoint", Saved)[1].stage == 3
    assert [p.name for p in folder.iterdir()] == ["report.json"] and (folder / "report.json").read_text() == "{}"


@pytest.mark.parametrize(("precision", "bad"), [("float32", float("nan")), ("float64", float("inf"))])
def test_a_gradient_that_is_not_finite_is_counted_and_left_out(precision, bad, monkeypatch, holds):
    scene = load(DISK, SMALL | {"tailoring.precision": precision})
    clean = design(scene, device="cpu")
    call, calls = stage2.Problem.__call__, []

    def sometimes(problem, heights):
        merit, [gradient], rrmsd = call(problem, heights)
        calls.append(1)
        if len(calls) in (20, 23):  # of the first round
            gradient = gradient.clone()
            gradient[5, 7] = bad
        return merit, [gradient], rrmsd

    monkeypatch.setattr(stage2.Problem, "__call__", sometimes)
    found = design(scene, device="cpu")
    assert found.skipped_steps == 2 and clean.skipped_steps == 0
    assert bool(torch.isfinite(found.lens.back.heights).all())
    ratio = found.history[-1][1] / clean.history[-1][1]
    holds(f"RRMSD with two gradients not finite, over that without, {precision}", ratio, 1.5)
