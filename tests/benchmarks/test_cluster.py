"""Tolerances of the letters and designs on several worker processes, one of which is killed.

How long each takes is printed.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import threading
import time
from dataclasses import replace

import distributed
import psutil
import pytest

from bstcad import commands
from bstcad.manufacture.tolerance import tolerancing
from bstcad.manufacture.tolerance.study import StudySettings
from bstcad.planning import batch as batches
from bstcad.planning.batch import BatchScene
from bstcad.runs import cluster
from bstcad.scene.scene import load
from tests.benchmarks.cold import TEMPLATES

pytestmark = pytest.mark.bench
LETTERS = TEMPLATES / "thu.toml"
FULL = 40


@pytest.fixture(scope="module")
def letters(tmp_path_factory):
    folder = tmp_path_factory.mktemp("letters") / "thu"
    commands.generate(load(LETTERS, {"tailoring.quality": "draft"}), folder, device="cpu")
    return folder


def test_tolerances_are_the_same_on_any_number_of_workers(letters, tmp_path, capsys):
    lost = []

    def study(workers, kills=False):
        folder = shutil.copytree(letters, tmp_path / f"{workers} {kills}")
        with on(workers) as found, losing(kills, lambda: lose_one(found.address, lost)):
            settings = StudySettings("precise", wanted=0.9, full=FULL)
            tolerancing.tolerance(folder, settings if found is None else replace(settings, spread=found.spread))
        return (folder / "tolerance.json").read_bytes()

    runs = {"in this process": (0,), "1 worker": (1,), "2 workers": (2,), "4 workers": (4,), "2, 1 lost": (2, True)}
    assert len(set(timed(study, runs, capsys))) == 1 and lost


def test_designs_are_the_same_wherever_they_are_made(small_scene, tmp_path, capsys):
    scenes = [small_scene.changed({"name": f"z{z:.0f}", "target.z": z}) for z in (300.0, 350.0, 400.0)]
    wanted, lost = [BatchScene(f"{scene.name}.toml", scene) for scene in scenes], []

    def designs(at_a_time, workers, kills=False):
        with on(workers) as found:
            lose = (lambda: lose_one(found.address, lost)) if found else (lambda: kill_one(lost))
            with losing(kills, lose):
                folder = tmp_path / f"{at_a_time} {workers} {kills}"
                rows = batches.batch(wanted, folder, workers=at_a_time, cluster=found)
        assert all(row.finished and row.design for row in rows)
        return tuple((row.name, row.design, row.rrmsd) for row in rows)

    runs = {
        "1 here": (1, 0), "2 here": (2, 0), "2 here, 1 killed": (2, 0, True), "1 worker": (None, 1),
        "2 workers": (None, 2), "4 workers": (None, 4), "2 workers, 1 lost": (None, 2, True),
    }  # fmt: skip
    assert len(set(timed(designs, runs, capsys))) == 1 and len(lost) == 2


def timed(call, runs, capsys):
    """Run each job and return the results; their seconds are printed."""
    for name, arguments in runs.items():
        began = time.perf_counter()
        yield call(*arguments)
        with capsys.disabled():
            print(f"\n{name}: {time.perf_counter() - began:.0f} s", end="")


def on(workers):
    """A cluster of so many worker processes; of none: None."""
    return cluster.connect(None, workers or None)


@contextlib.contextmanager
def losing(kills, lose):
    """Something is lost while the block works, or not."""
    killer = threading.Thread(target=lose if kills else int)
    killer.start()
    yield
    killer.join()


def runs_under_way(parent):
    """The processes below a process that run the command line."""
    return [p for p in psutil.Process(parent).children(recursive=True) if "bstcad.cli" in p.cmdline()]


def wait_until(true, seconds):
    until = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < until
        time.sleep(0.05)


def lose_one(address, keep):
    """Kill the first worker process that is at work, in the middle of it, and say which."""
    with distributed.Client(address, set_as_default=False) as client:
        pids = client.run(os.getpid)
        wait_until(lambda: any(client.processing().values()), 60)
        busy = next(worker for worker, tasks in client.processing().items() if tasks)
        time.sleep(0.3)
        os.kill(pids[busy], signal.SIGKILL)
        keep.append(busy)


def kill_one(keep):
    """Kill a process that designs, in the middle of it, and say which."""
    wait_until(lambda: runs_under_way(os.getpid()), 60)
    time.sleep(2.0)
    [found, *_] = runs_under_way(os.getpid())
    found.kill()
    keep.append(found.pid)
