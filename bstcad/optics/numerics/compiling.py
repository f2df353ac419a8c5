"""Compilation of kernels with a cache that depends on all files of two folders, `numerics` and `kernels`.

A cache of numba depends on a kernel's own file only: a change of a function imported from another file would not
recompile the kernel.  So the caches lie in a folder named after the contents of all files of these folders.
"""

from __future__ import annotations

import inspect
import shutil
from collections.abc import Callable
from functools import cache, wraps
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba

from bstcad.runs.kernel_cache import compiled_kernel

FOLDER = Path(__file__).parent
SOURCES = FOLDER, FOLDER.with_name("kernels")  # folders whose compiled functions may use each other
PREFIX = "kernels-"  # prefix of the name of a folder of caches
MIN_PART = 1 << 14  # minimum number of rays or tubes in a part of a sum (see reductions.py)


def compiled(threads_by: str = "", **options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the decorator `compiled_kernel` for a kernel that Python calls.

    threads_by: name of the array of the kernel's loop over `prange`, by whose size the loop runs on several threads; ""
    for a kernel without such a loop.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        config: Any = numba.config  # its settings are attributes that numba makes
        before = config.CACHE_DIR
        config.CACHE_DIR = str(_caches(before))  # numba reads it only when the kernel is created
        try:
            if threads_by:
                return _threaded(compiled_kernel(parallel=True, **options)(function), function, threads_by)
            return compiled_kernel(**options)(function)
        finally:
            config.CACHE_DIR = before

    return decorate


def _threaded(kernel: Callable[..., Any], function: Callable[..., Any], threads_by: str) -> Callable[..., Any]:
    """Return a parallel kernel that runs on one thread unless the named array has two parts of MIN_PART elements.

    Two threads hardly speed up fewer elements.  On a machine with other work each loop waits until the system lets the
    second thread run: beside eight busy processes on two cores, the sum of 1000 products takes 24 ms on two threads and
    6 µs on one.
    """
    place = list(inspect.signature(function).parameters).index(threads_by)

    @wraps(function)
    def call(*arguments: Any) -> Any:
        threads = numba.get_num_threads()
        if threads == 1 or arguments[place].size >= 2 * MIN_PART:
            return kernel(*arguments)
        numba.set_num_threads(1)
        try:
            return kernel(*arguments)
        finally:
            numba.set_num_threads(threads)

    return call


@cache
def _caches(chosen: str) -> Path:
    """Return the folder of the caches, in `chosen` (NUMBA_CACHE_DIR) or in __pycache__, where old ones are deleted."""
    contents = sha256(b"".join(path.read_bytes() for folder in SOURCES for path in sorted(folder.glob("*.py"))))
    folder = Path(chosen or FOLDER / "__pycache__") / (PREFIX + contents.hexdigest()[:16])
    if not chosen and not folder.exists():
        for old in folder.parent.glob(PREFIX + "*"):
            shutil.rmtree(old, ignore_errors=True)
    return folder
