"""The workbench under blows, by make bench: a design ends the same after kills, a pause and a Ctrl-C."""

from __future__ import annotations

import contextlib
import os
import signal
import time

import numpy as np
import pytest

from bstcad import commands
from bstcad.app.design_runs import Run
from bstcad.designs import folder as folders
from bstcad.scene.scene import load
from tests.app.conftest import SEEN, SMALL, begin

pytestmark = pytest.mark.bench

PATIENCE = 600_000  # milliseconds
LARGER = (
    SMALL.replace("control_points = 65", "control_points = 257")
    .replace("pixels = 48", "pixels = 256")
    .replace('quality = "draft"\nrays = 160', 'quality = "standard"\nstage2_iterations = 60')
)  # a run of some half a minute


def control_points(folder):
    return folders.read_nominal(folder).lens.back.control_points()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The control points of the design without the workbench."""
    folder = tmp_path_factory.mktemp("undisturbed")
    (folder / "small.toml").write_text(LARGER, encoding="utf-8")
    commands.generate(load(folder / "small.toml"), folder / "small")
    return control_points(folder / "small")


def wait_for(ready, seconds=300.0):
    until = time.monotonic() + seconds
    while not (found := ready()):
        assert time.monotonic() < until, "nothing came"
        time.sleep(0.05)
    return found


@pytest.mark.parametrize("blow", ["server killed", "Ctrl-C", "design killed", "paused"])
def test_the_design_ends_the_same_to_the_last_bit(open_page, tmp_path, undisturbed, blow):
    (tmp_path / "small.toml").write_text(LARGER, encoding="utf-8")
    own, run = begin(tmp_path), Run(tmp_path / "small")
    try:
        page = open_page(own.address)
        page.click("text=small.toml")
        page.wait_for_selector(SEEN, timeout=PATIENCE)
        page.click("#make")
        page.wait_for_url("**/design/small")
        checkpoint = tmp_path / ".small.checkpoint"
        wait_for(checkpoint.exists)
        if blow == "server killed":
            own.end(signal.SIGKILL)
            assert run.state.state == "running"  # the run belongs to its folder
            page.wait_for_selector("#offline:visible")
        elif blow == "Ctrl-C":
            said = own.end(signal.SIGINT)
            assert "the design run is stopped; the work so far is kept" in said or "is stopping;" in said
            wait_for(lambda: run.state.state == "stopped")
        elif blow == "design killed":
            os.kill(run.state.process, signal.SIGKILL)
            page.wait_for_selector("#go-on:visible", timeout=PATIENCE)
        else:
            page.click("#pause")
            page.wait_for_selector("#go-on:visible", timeout=PATIENCE)
        if own.process.poll() is not None:
            own = begin(tmp_path)  # started again
            page = open_page(own.address)
            page.goto(f"{own.root}/design/small")
        if blow != "server killed":
            page.click("#go-on")
        page.wait_for_selector("#step", timeout=PATIENCE)
        assert np.array_equal(control_points(tmp_path / "small"), undisturbed)
    finally:
        with contextlib.suppress(Exception):
            own.end()
