"""Every module of hard cases catches the fault it is there for."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.hard_cases.mutations import MUTATIONS, Mutation

ROOT = Path(__file__).parent.parent.parent
HERE = Path(__file__).parent


def name(mutation: Mutation) -> str:
    return f"{mutation.module}-{Path(mutation.file).stem}"


@pytest.mark.parametrize("mutation", MUTATIONS, ids=name)
def test_the_guard_stands_once_in_its_file(mutation):
    assert (ROOT / mutation.file).read_text(encoding="utf-8").count(mutation.guard) == 1
    assert (HERE / f"{mutation.module}.py").is_file()


def test_each_numbered_module_has_one():
    numbered = {path.stem for path in HERE.glob("test_[0-9]*.py")}
    assert numbered == {m.module for m in MUTATIONS if m.module[5].isdigit()}


@pytest.mark.bench
@pytest.mark.parametrize("mutation", MUTATIONS, ids=name)
def test_the_fault_is_seen(mutation, tmp_path):
    """In a copy of the program; compiled kernels come along, so that only the changed file is compiled anew."""
    for part in ("bstcad", "tests", "templates"):
        shutil.copytree(ROOT / part, tmp_path / part)  # keeps the times that numba's index asks for
    for part in ("pyproject.toml", "generate_lens.py"):
        shutil.copy2(ROOT / part, tmp_path)
    file = tmp_path / mutation.file
    file.write_text(file.read_text(encoding="utf-8").replace(mutation.guard, mutation.fault), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-x", f"tests/hard_cases/{mutation.module}.py"]
    command += ["-k", mutation.select] if mutation.select else []
    done = subprocess.run(
        command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True
    )
    assert done.returncode == 1, done.stdout[-2000:]  # failed, not broken
