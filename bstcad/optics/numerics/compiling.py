"""Compilation of kernels with a cache that depends on all files of two folders, `numerics` and `kernels`.

A cache of numba depends on a kernel's own file only: a change of a function imported from another file would not
recompile the kernel.  So the caches lie in a folder named after the contents of all files of these folders.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba

from bstcad.runs.kernel_cache import compiled_kernel

FOLDER = Path(__file__).parent
SOURCES = FOLDER, FOLDER.with_name("kernels")  # folders whose compiled functions may use each other
PREFIX = "kernels-"  # prefix of the name of a folder of caches


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the decorator `compiled_kernel` for a kernel that Python calls."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        config: Any = numba.config  # its settings are attributes that numba makes
        before = config.CACHE_DIR
        config.CACHE_DIR = str(_caches(before))  # numba reads it only when the kernel is created
        try:
            return compiled_kernel(**options)(function)
        finally:
            config.CACHE_DIR = before

    return decorate


@cache
def _caches(chosen: str) -> Path:
    """Return the folder of the caches, in `chosen` (NUMBA_CACHE_DIR) or in __pycache__, where old ones are deleted."""
    contents = sha256(b"".join(path.read_bytes() for folder in SOURCES for path in sorted(folder.glob("*.py"))))
    folder = Path(chosen or FOLDER / "__pycache__") / (PREFIX + contents.hexdigest()[:16])
    if not chosen and not folder.exists():
        for old in folder.parent.glob(PREFIX + "*"):
            shutil.rmtree(old, ignore_errors=True)
    return folder
