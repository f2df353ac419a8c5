"""A run locks its output folder: a lock file beside the folder, held while the run works.

The lock is the operating system's and ends with its process: a file that a killed run leaves behind locks nothing.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from bstcad.scene.errors import SceneError


def path_for(folder: Path) -> Path:
    """The lock file of an output folder: a hidden file beside it."""
    folder = folder.resolve()
    return folder.with_name(f".{folder.name}.lock")


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keep other runs out of `folder` within the block; SceneError if another run works there."""
    path = path_for(folder)
    lock = FileLock(path)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise SceneError(
            f"{folder}: is being designed by another run ({_holder(path)}); wait for it or give another folder with -o"
        ) from None
    with contextlib.suppress(OSError):  # on a full disk the file names no process
        path.write_text(str(os.getpid()))
    try:
        yield
    finally:
        path.unlink(missing_ok=True)  # before the release: the next run makes a new file
        lock.release()


def busy(folder: Path) -> bool:
    """Does a run work in `folder`?"""
    path = path_for(folder)
    try:
        if path.is_file():
            with FileLock(path).acquire(blocking=False):
                return False
    except Timeout:
        return True
    except OSError:  # a file system without locks
        return False
    return False


def _holder(path: Path) -> str:
    try:
        return f"process {int(path.read_text()[:20])}"
    except (OSError, ValueError):
        return "of a process unknown"
