"""The second process and child processes: a crash there is an answer here, and none outlives its parent."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import BrokenExecutor
from contextlib import nullcontext
from pathlib import Path

import psutil
import pytest

from bstcad.runs import processes

ROOT = Path(__file__).parent.parent.parent


@pytest.fixture
def fresh():
    """No second process before, none after."""
    processes.end()
    yield
    processes.end()


def test_another_process_always_the_same_does_one_work_after_the_other(fresh, tmp_path):
    first, second = (processes.submit(os.getpid).result() for _ in range(2))
    assert first == second != os.getpid() == processes.run_here(os.getpid).result()
    slow = processes.submit(time.sleep, 0.3)
    quick = processes.submit(os.path.exists, str(tmp_path))
    assert quick.result() and slow.done()


@pytest.mark.parametrize("awake", [False, True])
def test_the_second_process_lives_as_long_as_a_long_work_of_this_one(fresh, monkeypatch, awake):
    """Without work it ends, and loads its libraries again for the next one."""
    monkeypatch.setattr(processes, "IDLE_TIMEOUT", 0.3)
    before = processes.submit(os.getpid).result()
    with processes.kept_awake() if awake else nullcontext():
        until = time.monotonic() + (1.0 if awake else 20.0)
        while psutil.pid_exists(before) and time.monotonic() < until:
            time.sleep(0.05)
    assert (processes.submit(os.getpid).result() == before) == awake


def test_a_work_that_takes_too_long_is_ended_and_the_next_one_done(fresh):
    process = processes.submit(os.getpid).result()
    with pytest.raises(processes.Overdue, match=r"not ended after 0\.2 s"):
        processes.result(processes.submit(time.sleep, 600), 0.2)
    assert processes.command_of(process) == ()
    assert processes.result(processes.submit(os.getpid), 60.0) != process


def test_a_call_has_the_arguments_of_its_submission(fresh):
    """A lens caches properties while its calls wait: loky's thread then failed to pickle its changing dictionary."""
    waiting, argument = [processes.submit(time.sleep, 0.1) for _ in range(4)], {"face": 1}
    counted = processes.submit(len, argument)
    argument["cached"] = 2
    assert counted.result() == 1 and all(work.done() for work in waiting)


@pytest.mark.skipif(sys.platform != "linux", reason="tells of memory in another way")
def test_memory_that_is_freed_goes_back_when_asked_and_the_peak_is_that_of_the_process_itself():
    held = bytearray(400_000_000)  # here: getrusage in a process that is started now counts it, too
    work = """
from bstcad.runs.processes import keep_freed, peak_memory, return_freed
import numpy as np, psutil
keep_freed()
large, small = np.ones(12_500_000), np.ones(10)
peak = peak_memory()
del large
memory = [psutil.Process().memory_info().rss]
for allowed in (150_000_000, 50_000_000):
    return_freed(allowed)
    memory.append(psutil.Process().memory_info().rss)
print(peak, *(-np.diff(memory) / 1e9))
"""
    told = subprocess.run([sys.executable, "-c", work], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    peak, returned_of_less, returned = map(float, told.split())
    assert 0.1 < peak < len(held) / 1e9
    assert returned_of_less == pytest.approx(0.0, abs=0.01) and returned == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("submit", [processes.submit, processes.run_here])
def test_an_error_there_is_the_same_error_here(submit):
    with pytest.raises(ValueError, match="invalid literal"):
        submit(int, "lens").result()


def test_a_crash_there_is_an_answer_here_and_the_next_call_has_a_new_process(fresh):
    with pytest.raises(BrokenExecutor):
        processes.submit(os.kill, processes.submit(os.getpid).result(), signal.SIGSEGV).result()
    assert processes.submit(os.getpid).result() != os.getpid()


def test_without_shared_memory_a_thread_does_it(fresh, monkeypatch):
    def none(*arguments, **options):
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr("loky.ProcessPoolExecutor", none)
    assert processes.submit(os.getpid).result() == os.getpid()


@pytest.mark.parametrize("copied", [False, True])
@pytest.mark.parametrize("how", ["it ends", "killed"])
def test_it_never_outlives_its_parent(how, copied):
    """Both write to one pipe, which ends only when the last of them has."""
    code = f"import os, time\nfrom bstcad.runs.processes import begin, submit\nbegin(copied={copied})\n"
    code += "print(submit(os.getpid).result(), flush=True)\n"
    code += "time.sleep(60)" if how == "killed" else ""
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert int(parent.stdout.readline()) != parent.pid
    if how == "killed":
        parent.kill()
    parent.communicate(timeout=20)


COPIED = """
import os, sched, signal, threading, time
import torch
from bstcad.runs import processes
seen = "'sched' in __import__('sys').modules"
if {busy}:
    threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
processes.begin(copied=True)
first = processes.submit(os.getpid).result()
kept = processes.submit(eval, seen).result()
total = processes.submit(torch.sum, torch.ones(1 << 22)).result()  # in threads of torch
try:
    processes.submit(os.kill, first, signal.SIGKILL).result()
except processes.BrokenExecutor:
    print(kept, processes.submit(os.getpid).result() != first, processes.submit(eval, seen).result())
print(int(total))
"""


@pytest.mark.parametrize("busy", [False, True])
def test_a_copy_keeps_what_is_loaded_unless_a_thread_runs(busy):
    """A thread might hold a lock that the copy could never get.  The process after a crash is no copy in any case."""
    code = COPIED.format(busy=busy)
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    copies = not busy and sys.platform == "linux"
    assert (done.stdout.split(), done.stderr) == ([str(copies), "True", "False", str(1 << 22)], "")


@pytest.mark.parametrize("used", [False, True])
def test_a_command_copies_its_process_only_before_torch_has_run_in_threads(used):
    """A command may be called in a process that has computed, as a test does; in its copy, sums would be wrong."""
    code = "import os, sched\nfrom bstcad import cli\nfrom bstcad.runs import processes\n"
    code += "import torch; torch.ones(1 << 22).sum()\n" if used else ""
    code += "cli.begin_commands()\nprint(processes.submit(eval, \"'sched' in __import__('sys').modules\").result())\n"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (done.stdout.split(), done.stderr) == ([str(not used and sys.platform == "linux")], "")


def test_a_script_that_guards_nothing_is_not_run_twice(tmp_path):
    """Users' scripts begin with the design, not with `if __name__ == "__main__"`."""
    script = tmp_path / "script.py"
    work = "from bstcad.runs.processes import submit\nprint(submit(os.getcwd).result())\n"
    script.write_text(f"import os\nprint('begun')\n{work}")
    where = {"cwd": tmp_path, "env": os.environ | {"PYTHONPATH": str(ROOT)}}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, **where)
    assert done.stdout.split() == ["begun", str(tmp_path)], done.stderr


def test_what_a_run_leaves_to_be_cleared_up_is_not_told():
    """The run ends abruptly: not one of its semaphores is given back by itself."""
    code = "import os; from bstcad.runs.processes import submit; submit(os.getpid).result(); os._exit(0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)  # until all are gone
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


# --- a bstcad command in a child process ---


@pytest.mark.parametrize(("code", "stderr", "reason"), [
    (2, "bstcad: warning: doubtful\nbstcad: no solid; move the back\n", "no solid; move the back"),
    (70, "Traceback\n", "exit code 70"),
    (-15, "", "ended by SIGTERM"),
    (-9, "", "ended by SIGKILL; this machine may have too little memory for it"),
])  # fmt: skip
def test_why_there_is_no_result_is_a_sentence(code, stderr, reason):
    assert processes.ExitStatus(code, 1.0, 1.0, stderr).reason == reason


def test_a_command_tells_its_code_its_time_and_its_words():
    ended = processes.run(["plan", "none.toml"])
    assert ended.code == 2 and ended.reason.startswith("none.toml: no such scene file")
    assert ended.seconds > 0 and ended.cpu_seconds > 0


def test_a_command_ends_after_its_limit():
    ended = processes.run(["plan", "templates/thu.toml"], limit=0.1)
    assert ended.code == -signal.SIGKILL and ended.seconds < 5


def test_an_exception_of_the_parent_ends_it(monkeypatch):
    ended = []
    end = processes._end
    monkeypatch.setattr(processes, "_end", lambda child: (end(child), ended.append(child.returncode)))

    def stop():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        processes.run(["plan", "templates/thu.toml"], tick=stop)
    assert ended == [-signal.SIGTERM]
