"""The first bytes of a STEP file: whether it is one at all, told before any library loads."""

from __future__ import annotations

import re
import stat
from pathlib import Path

from bstcad.runs.files import SceneError

READ = 65_536  # bytes; comments before the first statement of a file are shorter
MARK = b"\xef\xbb\xbf"  # byte order mark of UTF-8
BEGIN = re.compile(rb"(?:\s|/\*(?:[^*]|\*(?!/))*+\*/)*+ISO-10303-21\s*;")
OTHERS = {  # remedies for files that are not STEP, by their first bytes
    b"\x1f\x8b": "it is packed by gzip; unpack it first", b"PK\x03\x04": "it is a zip archive; unpack it first",
    b"BZh": "it is packed by bzip2; unpack it first", b"\xfd7zXZ": "it is packed by xz; unpack it first",
    b"\xff\xfe": "it is text in UTF-16; export the lens as STEP again",
    b"\xfe\xff": "it is text in UTF-16; export the lens as STEP again",
}  # fmt: skip


def fault(data: bytes) -> str | None:
    """Why these first bytes are not those of a STEP file, with a remedy; None: they are."""
    if not data.strip():
        return "not a STEP file (it is empty); export the lens as STEP"
    for first, kind in OTHERS.items():
        if data.startswith(first):
            return f"not a STEP file ({kind.replace('; ', '); ')}"
    if BEGIN.match(data.removeprefix(MARK)[:READ]) is None:
        return "not a STEP file (it does not begin with ISO-10303-21); export the lens as STEP"
    return None


def check(path: Path) -> None:
    """SceneError in one sentence unless a file begins as STEP; what is no file or cannot be read, others refuse."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            return
        with path.open("rb") as file:
            found = fault(file.read(READ))
    except OSError:
        return
    if found is not None:
        raise SceneError(f"{path}: {found}")
