"""Kernels whose cache knows of all files of this folder.

numba's own cache looks at a kernel's own file only: a function that a kernel takes from another file would stay as it
was when the kernel was compiled.  So the caches lie in a folder named after the contents of all these files.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba

FOLDER = Path(__file__).parent
PREFIX = "kernels-"  # first part of the name of a folder of caches


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """The decorator numba.njit(cache=True, nogil=True, …) of a kernel that Python calls."""

    def of(function: Callable[..., Any]) -> Callable[..., Any]:
        before = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = str(_caches(before))  # read when the kernel is made, and not again
        try:
            return numba.njit(cache=True, nogil=True, **options)(function)
        finally:
            numba.config.CACHE_DIR = before

    return of


@cache
def _caches(chosen: str) -> Path:
    """The folder of the caches, in NUMBA_CACHE_DIR or beside the files; caches of other contents are removed."""
    contents = sha256(b"".join(path.read_bytes() for path in sorted(FOLDER.glob("*.py"))))
    here = Path(chosen or FOLDER / "__pycache__") / (PREFIX + contents.hexdigest()[:16])
    if not chosen and not here.exists():
        for old in here.parent.glob(PREFIX + "*"):
            shutil.rmtree(old, ignore_errors=True)
    return here
