"""A bstcad command in a child process: how it ends, and that it ends with whoever wanted it."""

import signal

import pytest

from bstcad.runs import child_process
from bstcad.runs.child_process import Ending


@pytest.mark.parametrize(
    ("code", "stderr", "reason"),
    [
        (2, "bstcad: warning: doubtful\nbstcad: no solid; move the back\n", "no solid; move the back"),
        (70, "Traceback\n", "exit code 70"),
        (-15, "", "ended by SIGTERM"),
        (-9, "", "ended by SIGKILL; the memory of this machine may be too little for it"),
    ],
)
def test_why_there_is_no_result_is_a_sentence(code, stderr, reason):
    assert Ending(code, 1.0, 1.0, stderr).reason == reason


def test_a_command_tells_its_code_its_time_and_its_words():
    ended = child_process.run(["plan", "none.toml"])
    assert ended.code == 2 and ended.reason.startswith("none.toml: no such scene file")
    assert ended.seconds > 0 and ended.cpu_seconds > 0


def test_a_command_ends_after_its_limit():
    ended = child_process.run(["plan", "templates/thu.toml"], limit=0.1)
    assert ended.code == -signal.SIGKILL and ended.seconds < 5


def test_an_exception_of_the_parent_ends_it(monkeypatch):
    ended = []
    end = child_process._end
    monkeypatch.setattr(child_process, "_end", lambda child: (end(child), ended.append(child.returncode)))

    def stop():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        child_process.run(["plan", "templates/thu.toml"], tick=stop)
    assert ended == [-signal.SIGTERM]
