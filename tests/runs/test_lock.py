"""One run at a time designs into a folder, and a dead one keeps nobody out."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from bstcad.runs import commands, lock
from bstcad.scene.errors import SceneError

ROOT = Path(__file__).parent.parent.parent
HOLD = """
import sys, time
from pathlib import Path
from bstcad.runs import lock
with lock.held(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def other(tmp_path):
    """Another process that holds the lock of tmp_path / "lens"."""
    command = [sys.executable, "-c", HOLD, str(tmp_path / "lens")]
    running = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert running.stdout.readline() == "held\n"
    yield running
    running.kill()
    running.communicate()


def test_a_second_run_is_one_sentence_and_harms_nothing_of_the_first(tmp_path, other, small_scene):
    kept = tmp_path / ".lens.checkpoint"
    kept.write_bytes(b"the first run's")
    assert lock.busy(tmp_path / "lens") and not lock.busy(tmp_path / "another")
    with pytest.raises(SceneError, match=rf"lens: is being designed by another run \(process {other.pid}\); .* -o"):
        commands.generate(small_scene, tmp_path / "lens", device="cpu")
    assert kept.read_bytes() == b"the first run's" and not (tmp_path / "lens").exists()
    with lock.held(tmp_path / "another"):
        pass


def test_the_lock_of_a_killed_run_locks_nothing(tmp_path, other):
    other.kill()
    other.wait()
    assert lock.path_for(tmp_path / "lens").exists() and not lock.busy(tmp_path / "lens")
    with lock.held(tmp_path / "lens"):
        assert lock.path_for(tmp_path / "lens").read_text() == str(os.getpid())
    assert list(tmp_path.iterdir()) == []


def test_a_link_leads_to_the_lock_of_the_folder_itself(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    with lock.held(tmp_path / "real"):
        assert lock.busy(tmp_path / "link")


def test_a_full_disk_does_not_keep_a_run_from_working(tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with lock.held(tmp_path / "lens"), pytest.raises(SceneError, match="of a process unknown"):  # noqa: SIM117
        with lock.held(tmp_path / "lens"):
            pass
