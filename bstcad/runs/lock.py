"""One run at a time designs into a folder: a lock file beside it, held while the run works.

The lock is the system's and goes with its process, however that ends: a file that is left over locks nothing.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from bstcad.scene.errors import SceneError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


def path_for(folder: Path) -> Path:
    """The lock of an output folder: a hidden file beside it."""
    folder = folder.resolve()
    return folder.with_name(f".{folder.name}.lock")


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Let no other run design into `folder` meanwhile; SceneError if one does."""
    path = path_for(folder)
    lock = _locked(path)
    if lock is None:
        raise SceneError(
            f"{folder}: is being designed by another run ({_holder(path)}); wait for it or give another folder with -o"
        )
    try:
        yield
    finally:
        path.unlink(missing_ok=True)  # while it is held: whoever comes from now on makes a new one
        os.close(lock)


def busy(folder: Path) -> bool:
    """Is a run designing into `folder`?"""
    path = path_for(folder)
    if fcntl is None or not path.is_file():
        return False
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:  # a file system without locks
            return False
    return False


def _locked(path: Path) -> int | None:
    """The lock file at `path`, open, locked and with this process's number in it; None if another run has it."""
    while True:
        lock = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        try:
            if fcntl is not None:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            return None
        except OSError:  # a file system without locks
            return lock
        if _is_at(path, lock):
            with contextlib.suppress(OSError):  # on a full disk it holds nobody's number
                os.truncate(lock, 0)
                os.write(lock, str(os.getpid()).encode())
            return lock
        os.close(lock)  # its run ended just now and took the file with it


def _is_at(path: Path, file: int) -> bool:
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except FileNotFoundError:
        return False


def _holder(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return f"process {int(file.read(20))}"
    except (OSError, ValueError):
        return "of a process unknown"
