"""Runs in processes of their own: who states how a run stands, from its first moment on."""

from __future__ import annotations

import os
import sys
import time

import pytest

from bstcad.app import design_runs
from bstcad.app.design_process import State
from bstcad.app.design_runs import Run

UNKNOWN = "nothing"  # a kind of run that no process knows: it ends at once


def ended(run):
    until = time.monotonic() + 60.0
    while run.state.state == "running":
        assert time.monotonic() < until
        time.sleep(0.02)
    return run.state


def test_a_run_that_has_begun_is_stated_by_its_own_process(tmp_path):
    run = Run(tmp_path / "made", UNKNOWN)
    for _ in range(5):
        run.begin()
        assert run.state.state != "none"
        assert ended(run).state == "failed" and "KeyError" in run.state.sentence


def test_server_and_process_never_write_the_state_at_once(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(State, "put", lambda self, run: written.append((os.getpid(), self)))
    run = Run(tmp_path / "made", UNKNOWN)
    run.begin()
    assert not written and ended(run).state == "failed"


def test_a_process_that_cannot_start_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    run = Run(tmp_path / "made", UNKNOWN)
    run.begin()
    assert run.state.state == "failed" and "process.log" in run.state.sentence


def test_a_run_whose_process_was_killed_is_stopped_and_can_be_gone_on_with(tmp_path):
    run = Run(tmp_path / "made", UNKNOWN)
    run.folder.mkdir(parents=True)
    State("running", process=2**22 + 1).put(run.folder)
    assert run.state.state == "stopped" and run.state.sentence == design_runs.PROCESS_LOST
    with pytest.raises(ValueError, match="start a new run"):
        run.go_on()


def test_a_run_that_ends_with_the_server_is_said_as_it_is(tmp_path, monkeypatch):
    """The server waits a moment for its runs; what they keep, they keep without it."""
    monkeypatch.setattr(design_runs, "ENDING_TIMEOUT", 0.0)
    run = Run(tmp_path / "small")
    run.folder.mkdir()
    State("stopped", sentence="nothing is kept").put(run.folder)
    assert "the design run is stopped; nothing is kept" in run.final_sentence
    State("running", process=os.getpid()).put(run.folder)
    monkeypatch.setattr(Run, "_is_own_process", lambda self, process: True)
    [said] = design_runs.endings([run])
    assert "is stopping" in said and "nothing" not in said
