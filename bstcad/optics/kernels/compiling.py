"""When a fused kernel serves, and kernels whose cache knows of all files of this folder.

numba's own cache looks at a kernel's own file only: a function that a kernel takes from another file would stay as it
was when the kernel was compiled.  So the caches lie in a folder named after the contents of all these files.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba
import torch
from torch import Tensor

FOLDER = Path(__file__).parent
PREFIX = "kernels-"  # of a folder of caches


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


ENABLED = True  # tests of the plain forms turn all kernels off
# The kernel of forward.py knows the equations of these kinds of Surface, and of no others.
KINDS = {"bspline": "net", "plane": "revolved", "sphere": "revolved", "conic": "revolved"}
# The sequences that it traces from the source to the screen: (of KINDS, does it reflect?) each.
WHOLE = [("net", True)], [("revolved", False), ("net", False)]


def fused(*tensors: Tensor) -> bool:
    """Do the fused kernels take these tensors: on the CPU, of one dtype, float32 or float64?"""
    first = tensors[0]
    return ENABLED and all(
        t.device.type == "cpu" and t.dtype == first.dtype and t.dtype in (torch.float32, torch.float64) for t in tensors
    )


def fused_whole(interfaces: Sequence[Any]) -> bool:
    """Does one kernel (forward.py) trace rays across all of these Interfaces: a mirror, or a front and a net?"""
    given = [(KINDS.get(interface.surface.kind), interface.law.reverses) for interface in interfaces]
    known = all(loss.fused for interface in interfaces for loss in interface.losses)
    return given in WHOLE and known and fused(interfaces[-1].surface.heights)
