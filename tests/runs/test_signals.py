"""Signals from outside: the run ends in a sentence, what was found is kept, and no half folder stays."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bstcad import cli
from bstcad.designs.pipeline import DesignState
from bstcad.runs import checkpoint, signals
from bstcad.scene.scene import load
from tests import conftest, suite
from tests.scenes import DISK, SMALL

ROOT = Path(__file__).parent.parent.parent
# First in a process that runs the command line: it designs by little effort, verifies by as many tubes and rays as
# resolve the small design, and draws nothing.
FEW_RAYS = """
from bstcad import commands
from bstcad.figures.figure_jobs import NoPictures
from functools import partial
from tests.efforts import FEWEST_RAYS, LITTLE
few = commands.ProofOptions(FEWEST_RAYS, NoPictures, tailoring=LITTLE)
commands.generate = partial(commands.generate, options=few)
"""
BOTH = pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name)


def generate(scene, folder, *more, first=""):
    """`bstcad generate` in a group of its own, its output in one pipe; the suite may be deaf.  `first`: code."""
    code = (
        f"{first}import signal\n"
        "for n in (signal.SIGTERM, signal.SIGHUP): signal.signal(n, signal.SIG_DFL)\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from bstcad.cli import main; print('begun', flush=True); main()"
    )
    command = [sys.executable, "-u", "-c", code, "generate", str(scene), "-o", str(folder), *more]
    running = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT, start_new_session=True
    )
    assert running.stdout.readline() == "begun\n"
    return running


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(load(DISK, SMALL | {"tailoring.stage2_iterations": 200}).toml())
    return path


@pytest.fixture(autouse=True)
def _heard():
    """The suite itself may be deaf to the end of its terminal, as under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.bench
@pytest.mark.parametrize("number", suite.in_turns([signal.SIGTERM, signal.SIGHUP], 2))
def test_in_the_middle_it_flushes_a_checkpoint_and_resume_goes_on(number, scene, tmp_path):
    """The signal comes from `kill`, a supervisor or a closed terminal, the last to every process of the group."""
    stopped = generate(scene, tmp_path / "lens")
    for line in stopped.stdout:
        if line.startswith("stage 2"):
            break
    time.sleep(0.3)
    os.killpg(stopped.pid, number) if number == signal.SIGHUP else stopped.send_signal(number)
    said = stopped.communicate(timeout=60)[0].splitlines()
    assert stopped.returncode == 128 + number
    assert said[-1] == (
        f"bstcad: ended by {number.name}; the design so far is kept; run the same command with --resume to continue it"
    )
    assert not any("Traceback" in line or "warn" in line for line in said)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".lens.checkpoint", "small.toml"]
    assert checkpoint.read(tmp_path / ".lens.checkpoint", DesignState)[1].followed is not None  # stage 1
    resumed = generate(scene, tmp_path / "lens", "--resume", first=FEW_RAYS)
    assert "from the beginning" not in resumed.communicate(timeout=120)[0] and resumed.returncode in (0, 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lens", "small.toml"]


@pytest.mark.parametrize("seconds", [0.3, pytest.param(2.0, marks=pytest.mark.bench)])
def test_at_the_beginning_it_leaves_nothing(seconds, scene, tmp_path):
    running = generate(scene, tmp_path / "lens", "--set", "lens.back.control_points=513")
    time.sleep(seconds)
    running.terminate()
    said = running.communicate(timeout=60)[0]
    assert running.returncode == 143 and "Traceback" not in said
    assert said.splitlines()[-1] in (
        "bstcad: ended by SIGTERM at its start; nothing was written",  # while its libraries load
        "bstcad: ended by SIGTERM; nothing is kept",
    )
    assert [path.name for path in tmp_path.iterdir()] == ["small.toml"]


@BOTH
def test_it_is_raised_once(number):
    with pytest.raises(signals.Terminated) as ended, signals.raise_terminated():
        try:
            signal.raise_signal(number)
        finally:
            signal.raise_signal(number)  # what is kept now is not to be cut short
    assert ended.value.name == number.name and signals.termination().number == number


def test_one_that_got_lost_is_raised_when_the_wish_is_asked_for():
    with pytest.raises(signals.Terminated), signals.raise_terminated(), signals.stop_on_interrupt() as wished:
        with contextlib.suppress(signals.Terminated):  # as a destructor does
            signal.raise_signal(signal.SIGTERM)
        wished()


def test_what_is_ignored_stays_ignored():
    """nohup bstcad ..."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with signals.raise_terminated(), signals.exit_on_signal():
            signal.raise_signal(signal.SIGHUP)
        assert signals.termination() is None
    finally:
        signal.signal(signal.SIGHUP, before)


def test_ctrl_c_is_a_wish_first():
    with pytest.raises(KeyboardInterrupt), signals.raise_terminated(), signals.stop_on_interrupt() as wished:
        assert not wished()
        signal.raise_signal(signal.SIGINT)
        assert wished()
        signal.raise_signal(signal.SIGINT)


@suite.in_turn(0, 2)
def test_the_first_ctrl_c_ends_what_only_has_to_be_written_and_verified(tmp_path, monkeypatch, capsys):
    """There is no better lens to wait for; the design is kept, and --resume has only these two left to do."""
    path = tmp_path / "small.toml"
    hasty = {"tailoring.rays": 64, "tailoring.rounds": 1, "tailoring.stage2_iterations": 1, "target.pixels": 32}
    path.write_text(load(DISK, SMALL | hasty).toml())
    stopped = generate(path, tmp_path / "lens", first=FEW_RAYS)
    for line in stopped.stdout:
        if line.startswith(("write", "verify")):
            break
    stopped.send_signal(signal.SIGINT)
    said = stopped.communicate(timeout=60)[0].splitlines()
    assert stopped.returncode == 130, said
    assert said[-1].endswith("the design so far is kept; run the same command with --resume to continue it")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".lens.checkpoint", "small.toml"]
    conftest.quickly(monkeypatch)
    assert cli.run(["generate", str(path), "-o", str(tmp_path / "lens"), "--resume"]) in (0, 1)
    said = "".join(capsys.readouterr()).splitlines()
    assert any(line.startswith("verify") for line in said) and not any(line.startswith("stage") for line in said)
