"""Choice of the tests that the daily suite runs, their order, and the processes that run them.

Tests that are marked `thorough` are left to `make test-all`: their law is held by a shorter test every day, or each
commit runs a share of their samples (`in_turns`).  `--in-turn 4` leaves one test of four, by the commit's hash.
"""

from __future__ import annotations

import functools
import json
import math
import os
import subprocess
import zlib
from collections import Counter
from collections.abc import Container, Iterable
from pathlib import Path

import pytest

import bstcad

DURATIONS = Path(__file__).with_name("durations.json")  # file: seconds of its daily and of its thorough tests
MIN_SECONDS = 1.0  # time (s) from which a file has an entry
MAX_SECONDS = 40.0  # time (s) up to which one process runs a whole file; the tests of longer files are dealt out
COMMIT = "BSTCAD_TESTED_COMMIT"  # environment variable that takes the place of git's HEAD
SPENT = pytest.StashKey[dict[str, Counter]]()


# --- shares by the commit ---------------------------------------------------------------------------------------------


@functools.cache
def commit() -> str:
    """Return the hash of the commit under test; without git the version of the package.

    Worker processes take it from the environment, so that a commit during the run does not change their tests.
    """
    if COMMIT not in os.environ:
        command = ["git", "rev-parse", "HEAD"]
        try:
            said = subprocess.run(command, capture_output=True, text=True, cwd=DURATIONS.parent, check=False).stdout
        except OSError:
            said = ""
        os.environ[COMMIT] = said.strip() or bstcad.__version__
    return os.environ[COMMIT]


def turn(parts: int) -> int:
    """Return the number of the part, of so many, that this commit runs."""
    return zlib.crc32(commit().encode()) % parts


def daily(values: Iterable, numbers: Container[int]) -> list:
    """Return values for pytest.mark.parametrize, of which all but those with these numbers are `thorough`.

    A tuple has the values of several arguments.
    """
    params = [
        value if hasattr(value, "marks") else pytest.param(*(value if isinstance(value, tuple) else (value,)))
        for value in values
    ]
    rest = pytest.mark.thorough
    return [each if k in numbers else each._replace(marks=(*each.marks, rest)) for k, each in enumerate(params)]


def in_turns(values: Iterable, parts: int) -> list:
    """Return values for pytest.mark.parametrize: one of `parts` is daily, by the commit; the others are `thorough`."""
    values = list(values)
    assert len(values) >= parts, "each part has a value"
    return daily(values, range(turn(parts), len(values), parts))


def in_turn(number: int, parts: int):
    """Return a decorator of tests: daily if this part, of so many, is the commit's, else `thorough`."""
    return (lambda test: test) if number % parts == turn(parts) else pytest.mark.thorough


def samples(count: int, parts: int, bench: int) -> list:
    """Return ranges of seeds for pytest.mark.parametrize: the shares of `count` in turns, and that of `make bench`."""
    shares = [pytest.param(range(k, count, parts), id=f"{k + 1} of {parts}") for k in range(parts)]
    return [*in_turns(shares, parts), pytest.param(range(bench), id=f"{bench}", marks=pytest.mark.bench)]


def pytest_sessionstart(session):
    """Print the shares; pytest leaves out its header with -q."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is not None and not hasattr(session.config, "workerinput"):
        shares = ", ".join(f"{turn(parts) + 1} of {parts}" for parts in range(2, 7))
        reporter.write_line(f"Shares of the tests that take turns, by commit {commit()[:12]} ({COMMIT}): {shares}")


# --- the choice and the order -----------------------------------------------------------------------------------------


def pytest_addoption(parser):
    parser.addoption("--record-durations", action="store_true", help="keep the seconds of each file for the scheduler")
    parser.addoption(
        "--in-turn", type=int, metavar="N", help="run one test of N, chosen by the commit's hash (see -m thorough)"
    )


def pytest_ignore_collect(collection_path, config):
    """Modules that are for `make bench` alone are not imported by the other suites: two seconds of each process."""
    if collection_path.suffix == ".py" and "not bench" in config.getoption("markexpr"):
        return "\npytestmark = pytest.mark.bench\n" in collection_path.read_text(encoding="utf-8") or None
    return None


@pytest.hookimpl(trylast=True)  # after -m and -k
def pytest_collection_modifyitems(config, items):
    """Several processes take the longest files first (xdist keeps this order with --no-loadscope-reorder)."""
    if parts := config.getoption("in_turn"):
        taken = {item: zlib.crc32(item.nodeid.encode()) % parts == turn(parts) for item in items}
        config.hook.pytest_deselected(items=[item for item in items if not taken[item]])
        items[:] = [item for item in items if taken[item]]
    if hasattr(config, "workerinput"):
        seconds = expected_seconds(items)
        items.sort(key=lambda item: -seconds[file_of(item.nodeid)])


def file_of(nodeid: str) -> str:
    return nodeid.partition("::")[0]


def kind_of(marks) -> str:
    """Return "thorough" or "daily", by the names of the marks of a test."""
    return "thorough" if "thorough" in marks else "daily"


def expected_seconds(items) -> Counter:
    """Return the recorded seconds of each file, as far as its tests are among these."""
    known, found = json.loads(DURATIONS.read_text()), Counter()
    for file, kind in {(file_of(item.nodeid), kind_of(item.keywords)) for item in items}:
        found[file] += known.get(file, {}).get(kind, 0.0)
    return found


def pytest_configure(config):
    commit()
    config.stash[SPENT] = {}
    config.pluginmanager.register(Spent(config.stash[SPENT]))


@pytest.hookimpl(optionalhook=True)  # without xdist
def pytest_xdist_make_scheduler(config, log):
    """Return the scheduler that deals out long files; --dist loadfile is the one that it replaces."""
    from xdist.scheduler import LoadFileScheduling

    left_out = {"thorough"} if "not thorough" in config.getoption("markexpr") else set()
    known = {
        file: sum(seconds for kind, seconds in kinds.items() if kind not in left_out)
        for file, kinds in json.loads(DURATIONS.read_text()).items()
    }

    class PartsOfFiles(LoadFileScheduling):
        """Scheduler whose unit is a file, or a part of a file that takes longer than MAX_SECONDS."""

        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            parts = math.ceil(known.get(file, 0.0) / MAX_SECONDS)
            return f"{file} {zlib.crc32(nodeid.encode()) % parts}" if parts > 1 else file

    return PartsOfFiles(config, log) if config.getoption("dist") == "loadfile" else None


# --- durations --------------------------------------------------------------------------------------------------------


class Spent:
    """Adds up the seconds of each file: of its daily and of its thorough tests."""

    def __init__(self, spent):
        self.spent = spent

    def pytest_runtest_logreport(self, report):
        self.spent.setdefault(file_of(report.nodeid), Counter())[kind_of(report.keywords)] += report.duration


def pytest_sessionfinish(session):
    if session.config.getoption("--record-durations") and not hasattr(session.config, "workerinput"):
        known = json.loads(DURATIONS.read_text())
        for file, kinds in session.config.stash[SPENT].items():
            known[file] = known.get(file, {}) | {kind: round(seconds, 1) for kind, seconds in kinds.items()}
        there = {file for file in known if Path(session.config.rootpath, file).exists()}
        known = {file: known[file] for file in sorted(there) if sum(known[file].values()) > MIN_SECONDS}
        DURATIONS.write_text(json.dumps(known, indent=1) + "\n")
