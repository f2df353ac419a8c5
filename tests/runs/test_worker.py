"""The second process: a crash there is an answer here, and it never outlives its parent."""

import os
import signal
import subprocess
import sys
from concurrent.futures import BrokenExecutor
from pathlib import Path

import pytest

from bstcad.runs import worker

ROOT = Path(__file__).parent.parent.parent


@pytest.fixture
def fresh():
    """No second process before, none after."""
    worker.end()
    yield
    worker.end()


def test_what_is_done_there_is_done_by_another_process_and_always_the_same(fresh):
    first, second = (worker.submit("os.getpid").result() for _ in range(2))
    assert first == second != os.getpid()


def test_what_is_submitted_first_is_done_first(fresh, tmp_path):
    slow = worker.submit("time.sleep", 0.3)
    quick = worker.submit("os.path.exists", str(tmp_path))
    assert quick.result() and slow.done()


def test_an_error_there_is_the_same_error_here(fresh):
    with pytest.raises(ValueError, match="invalid literal"):
        worker.submit("builtins.int", "lens").result()


def test_here_the_same_is_done_at_once():
    assert worker.here("os.getpid").result() == os.getpid()
    with pytest.raises(ValueError, match="invalid literal"):
        worker.here("builtins.int", "lens")


def test_a_crash_there_is_an_answer_here_and_the_next_call_has_a_new_process(fresh):
    with pytest.raises(BrokenExecutor):
        worker.submit("os.kill", worker.submit("os.getpid").result(), signal.SIGSEGV).result()
    assert worker.submit("os.getpid").result() != os.getpid()


def test_without_shared_memory_a_thread_does_it(fresh, monkeypatch):
    def none(*arguments, **options):
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr("loky.ProcessPoolExecutor", none)
    assert worker.submit("os.getpid").result() == os.getpid()


@pytest.mark.parametrize("how", ["it ends", "killed"])
def test_it_never_outlives_its_parent(how):
    """Both write to one pipe, which ends only when the last of them has."""
    code = "import sys, time\nfrom bstcad.runs import worker\nprint(worker.submit('os.getpid').result(), flush=True)\n"
    code += "time.sleep(60)" if how == "killed" else ""
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert int(parent.stdout.readline()) != parent.pid
    if how == "killed":
        parent.kill()
    parent.communicate(timeout=20)


def test_a_script_that_guards_nothing_is_not_run_twice(tmp_path):
    """Users' scripts begin with the design, not with `if __name__ == "__main__"`."""
    script = tmp_path / "script.py"
    script.write_text("print('begun')\nfrom bstcad.runs import worker\nprint(worker.submit('os.getcwd').result())\n")
    done = subprocess.run(
        [sys.executable, script],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    assert done.stdout.split() == ["begun", str(tmp_path)], done.stderr


def semaphores(process=""):
    """Names in the system's shared memory that a process made, or any."""
    return {path.name for path in Path("/dev/shm").glob(f"sem.loky-{process}*")}


@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="semaphores cannot be seen here")
@pytest.mark.parametrize("how", ["killed with all its group", "ended by SIGTERM to all its group"])
def test_no_semaphores_stay_in_shared_memory(how, fresh, tmp_path):
    """Of a group that is killed nobody is left to clear them; the next one to start does."""
    code = (
        "import sys, time\nfrom bstcad.runs import signals, worker\n"
        "try:\n  with signals.endings():\n"
        "    print(worker.submit('os.getpid').result(), flush=True)\n    time.sleep(60)\n"
        "except signals.Ended as ended: sys.exit(128 + ended.number)"
    )
    group = subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    group.stdout.readline()
    assert semaphores(group.pid)
    killed = how.startswith("killed")
    os.killpg(group.pid, signal.SIGKILL if killed else signal.SIGTERM)
    _, said = group.communicate(timeout=20)
    assert group.returncode == (-signal.SIGKILL if killed else 143) and said == ""
    assert bool(semaphores(group.pid)) == killed
    worker.submit("os.getpid").result()
    assert not semaphores(group.pid) and semaphores(os.getpid())


def test_only_the_semaphores_of_the_dead_are_cleared(tmp_path, monkeypatch):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    monkeypatch.setattr(worker, "SEMAPHORES", tmp_path)
    names = [f"sem.loky-{dead.pid}-abc", f"sem.loky-{os.getpid()}-abc", f"sem.other-{dead.pid}-abc", "sem.loky-x-abc"]
    for name in names:
        (tmp_path / name).touch()
    worker.clear_semaphores()
    assert {path.name for path in tmp_path.iterdir()} == set(names[1:])


def test_what_a_run_leaves_to_be_cleared_up_is_not_told():
    """Its end is abrupt: not one of its semaphores is given back by itself."""
    code = "import os; from bstcad.runs import worker; worker.begin(); worker.submit('os.getpid').result(); os._exit(0)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )  # until all are gone
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
