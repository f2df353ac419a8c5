"""14. Killed and interrupted runs, full disks, values that are not finite.

Checkpoints that are written in place are lost with the process that writes them (Lightning #688), and a design that
goes on from one is often another design (the minimiser's memory is left out).  Here a checkpoint changes places in
one step with the one before, holds all that the next step depends on, and so does the output folder.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from bstcad import cli, commands
from bstcad.commands import ProofOptions
from bstcad.designs.pipeline import DesignState, design
from bstcad.figures import rendering
from bstcad.optics.trace.measure import Effort
from bstcad.runs import checkpoint
from bstcad.scene.scene import load
from bstcad.tailoring import stage2
from tests import suite
from tests.conftest import draws_nothing, verify_with
from tests.scenes import DISK, SMALL

ROOT = Path(__file__).parent.parent.parent
CONTENTS = {
    "lens.step", "lens.stl", "lens.3mf", "design.npz", "scene.toml", "prescription.txt", "report.json", "report.html",
    "report.junit.xml", "figures", "datasheet.pdf",
}  # fmt: skip

DRAWN = {"figures", "datasheet.pdf"}


SCENES = {  # (scene, what makes it small)
    "one face": (DISK, SMALL | {"tailoring.stage2_iterations": 45}),
    "two faces": (
        ROOT / "templates" / "two_pictures.toml",
        {"lens.back.control_points": 65, "lens.front.control_points": 49, "target[0].pixels": 32,
         "target[1].pixels": 32, "tailoring.rays": 160, "tailoring.stage2_iterations": 20,
         "tailoring.transport_grid": 64},
    ),
}  # fmt: skip


def design_with_checkpoints(folder, name="one face"):
    """Make a small design in a process that is to be killed, with a checkpoint at every step and --resume."""
    commands.Keeper = functools.partial(commands.Keeper, interval=0.0)
    checkpoint.MAX_WRITING_FRACTION = 1e9  # no pause, however long the writing takes
    rendering.lens_picture = lambda mesh: None
    scene = load(*SCENES[name])
    print("ready", flush=True)
    commands.generate(scene, Path(folder), device="cpu", resume=True, options=ProofOptions(Effort(256)))
    print("done")


def started(folder, name):
    """Such a process, from when it is ready."""
    code = f"import {__name__} as m; m.design_with_checkpoints({str(folder)!r}, {name!r})"
    given = {"cwd": ROOT, "env": os.environ | {"PYTHONPATH": str(ROOT)}, "text": True}
    running = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **given)
    assert running.stdout.readline() == "ready\n", running.communicate()[0]
    return running


def digest_of(folder):
    return hashlib.sha256((folder / "design.npz").read_bytes()).hexdigest()


@pytest.mark.bench
@pytest.mark.parametrize(("name", "kills"), [("one face", 50), ("two faces", 20)])
def test_kill_9_at_random_moments(name, kills, tmp_path, holds):
    """Each time the next run goes on; a design that got finished in between begins anew beside its folder.

    The moments are those of the first, the second and the last third of an undisturbed run in turn.
    """
    whole, folder, moments = tmp_path / "whole", tmp_path / "lens", random.Random(kills)
    undisturbed, began = started(whole, name), time.perf_counter()
    assert "done" in undisturbed.communicate()[0]
    seconds, digest = time.perf_counter() - began, digest_of(whole)
    for kill in range(kills):
        running = started(folder, name)
        time.sleep(seconds * (kill % 3 + moments.random()) / 3)
        running.kill()
        running.communicate()
        assert not folder.exists() or intact(folder, digest)
        kept = tmp_path / ".lens.checkpoint"
        if kept.exists():
            checkpoint.read(kept, DesignState)  # raises if it is damaged
    assert "done" in started(folder, name).communicate(timeout=300)[0] and intact(folder, digest)
    assert sorted(tmp_path.iterdir()) == [folder, whole]  # what the killed ones left has been cleared away
    holds(f"{kills} designs of {name}, killed at random: damaged folders or checkpoints", 0, 0)


def intact(folder, digest):
    """Every file of a design is there, the report whole, the design that of the undisturbed run to the bit."""
    report = json.loads((folder / "report.json").read_text())
    return {p.name for p in folder.iterdir()} == CONTENTS and digest_of(folder) == digest and "rrmsd" in report


@suite.in_turn(1, 3)
def test_ctrl_c_writes_the_best_so_far_and_resume_ends_the_same(tmp_path, monkeypatch, capsys, holds, small_design):
    """The command line itself, with its own checkpoints, against the design that nobody disturbed."""
    monkeypatch.setattr(commands.processes, "submit", commands.processes.run_here)
    draws_nothing(monkeypatch)
    verify_with(monkeypatch, Effort(256))
    scene, folder = tmp_path / "small.toml", tmp_path / "lens"
    scene.write_text(load(DISK, SMALL).toml())
    call, calls = stage2.Problem.__call__, []

    def pressed_once(problem, heights):
        calls.append(1)
        if len(calls) == 20:
            signal.raise_signal(signal.SIGINT)
        return call(problem, heights)

    monkeypatch.setattr(stage2.Problem, "__call__", pressed_once)
    assert cli.run(["generate", str(scene), "-o", str(folder)]) == 130
    said = capsys.readouterr().err
    assert "stopping with the best lens so far" in said
    assert said.splitlines()[-1].endswith("run the same command with --resume to continue")
    report = json.loads((folder / "report.json").read_text())
    assert report["stopped"] == "interrupt" and report["stability"]["non_finite"] == 0
    assert CONTENTS - DRAWN <= {p.name for p in folder.iterdir()} <= CONTENTS
    assert cli.run(["generate", str(scene), "-o", str(folder), "--resume"]) in (0, 1)
    found, whole = (np.load(place / "design.npz")["control_points"] for place in (folder, small_design.folder))
    off = float(np.abs(found - whole).max())
    holds("difference of control points between a resumed and an undisturbed design", off, 0.0, "mm")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["lens", "small.toml"]


def test_an_unfinished_design_does_not_take_the_place_of_a_finished_one(small_design, tmp_path):
    assert commands.output_folder(small_design.folder, "evaluations") == small_design.folder
    assert commands.output_folder(small_design.folder, "interrupt").name == "small-unfinished"
    assert commands.output_folder(tmp_path / "new", "interrupt") == tmp_path / "new"


@contextlib.contextmanager
def full_disk(size):
    """A file that may not grow fails as a full disk does, but for the number (EFBIG)."""
    resource = pytest.importorskip("resource")
    before, deaf = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        with pytest.raises(OSError, match="File too large") as error:
            yield error
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, deaf)


@suite.in_turn(0, 3)
def test_a_full_disk_is_a_sentence_and_loses_nothing(small_scene, tmp_path, monkeypatch):
    """A disk of 60 kB holds neither the checkpoint nor lens.step; one of 0.5 MB holds these, but not lens.stl.

    How the command line says it: tests/test_cli.py.  Going on from a checkpoint is what the test above does.
    """
    monkeypatch.setattr(commands.processes, "submit", commands.processes.run_here)  # files of this process may not grow
    draws_nothing(monkeypatch)
    verify_with(monkeypatch, Effort(256))
    folder, said = tmp_path / "lens", []
    folder.mkdir()
    (folder / "report.json").write_text("{}")
    monkeypatch.setattr(commands, "Keeper", functools.partial(commands.Keeper, interval=0.0))  # at each step
    monkeypatch.setattr(checkpoint, "MAX_WRITING_FRACTION", 1e9)  # no pause, however long the writing takes
    generate = functools.partial(commands.generate, small_scene, folder, device="cpu")
    with full_disk(60_000):
        generate(hooks=commands.Hooks(lambda *words: said.append(" ".join(map(str, words)))))
    assert any("the design continues without a new checkpoint" in words for words in said)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["lens", "lens-unwritten"]  # which design.npz fits into
    with full_disk(500_000) as error:
        generate()
    kept = "the design so far is kept; run the same command with --resume to continue it"
    assert kept in " ".join(error.value.__notes__)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".lens.checkpoint", "lens", "lens-unwritten"]
    assert {p.name for p in (tmp_path / "lens-unwritten").iterdir()} == {"scene.toml", "design.npz"}
    assert checkpoint.read(tmp_path / ".lens.checkpoint", DesignState)[1].lens is not None
    assert [p.name for p in folder.iterdir()] == ["report.json"] and (folder / "report.json").read_text() == "{}"


@suite.in_turn(2, 3)
def test_a_gradient_that_is_not_finite_is_counted_and_left_out(small_scene, small_design, monkeypatch, holds):
    call, calls, bad = stage2.Problem.__call__, [], {20: float("nan"), 23: float("inf")}  # calls of the first round

    def sometimes(problem, heights):
        merit, [gradient], rrmsd = call(problem, heights)
        calls.append(1)
        if len(calls) in bad:
            gradient = gradient.clone()
            gradient[5, 7] = bad[len(calls)]
        return merit, [gradient], rrmsd

    monkeypatch.setattr(stage2.Problem, "__call__", sometimes)
    found = design(small_scene, device="cpu")
    assert found.course.skipped_steps == 2 and small_design.report["skipped_steps"] == 0
    assert bool(torch.isfinite(found.lens.back.heights).all())
    ratio = found.course.history[-1].rrmsd / small_design.report["history"][-1]["rrmsd"]
    holds("RRMSD with two gradients that are not finite, divided by the RRMSD without them", ratio, 1.5)
