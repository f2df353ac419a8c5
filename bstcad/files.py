"""Files from elsewhere: what is read of one is bounded, and what is written does not follow its links.

A folder that somebody sent may hold a pipe, a device, a terabyte of nothing or a link to another file of the reader's.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path


def contents(path: Path, largest: int) -> bytes:
    """The bytes of a file; ValueError says why it cannot be read: it is none, or holds over `largest` bytes.

    Asked before it is opened: a pipe does not end, nor do some files of /proc that say they are empty.
    """
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            raise ValueError("it is a folder" if stat.S_ISDIR(found.st_mode) else "it is a pipe or a device")
        if found.st_size > largest:
            raise ValueError(f"it holds over {largest / 1e6:.3g} MB")
        if found.st_size == 0:
            return b""
        with path.open("rb") as file:
            return file.read(largest + 1)
    except OSError as error:
        raise ValueError(error.strerror or type(error).__name__) from error


def put(path: Path, data: bytes) -> None:
    """Write a file whole, in the place of what stands there: a link gives way, and what it leads to stays as it is."""
    new = path.with_name(f".{path.name}.new")
    new.unlink(missing_ok=True)
    with new.open("xb") as file:
        file.write(data)
    os.replace(new, path)


def folder_in_place(path: Path) -> Path:
    """The folder at `path`, made if there is none; a link gives way."""
    if path.is_symlink():
        path.unlink()
    path.mkdir(exist_ok=True)
    return path
