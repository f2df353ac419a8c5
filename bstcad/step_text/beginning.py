"""Recognition of STEP files by their first bytes, before any library is loaded."""

from __future__ import annotations

import re
import stat
from pathlib import Path

from bstcad.runs.files import SceneError

BYTES_READ = 65_536  # number of bytes read from a file; comments before its first statement must be shorter
BYTE_ORDER_MARK = b"\xef\xbb\xbf"  # byte order mark of UTF-8
STEP_BEGINNING = re.compile(rb"(?:\s|/\*(?:[^*]|\*(?!/))*+\*/)*+ISO-10303-21\s*;")
OTHER_FORMATS = {  # fault and remedy of a file that is not STEP, by its first bytes
    b"\x1f\x8b": "it is compressed with gzip; unpack it first",
    b"PK\x03\x04": "it is a zip archive; unpack it first",
    b"BZh": "it is compressed with bzip2; unpack it first",
    b"\xfd7zXZ": "it is compressed with xz; unpack it first",
    b"\xff\xfe": "it is text in UTF-16; export the lens as STEP again",
    b"\xfe\xff": "it is text in UTF-16; export the lens as STEP again",
}


def fault(data: bytes) -> str | None:
    """Return the reason why a file with these first bytes is not a STEP file, with a remedy; None if it is one."""
    if not data.strip():
        return "not a STEP file (it is empty); export the lens as STEP"
    for first, kind in OTHER_FORMATS.items():
        if data.startswith(first):
            return f"not a STEP file ({kind.replace('; ', '); ')}"
    if STEP_BEGINNING.match(data.removeprefix(BYTE_ORDER_MARK)[:BYTES_READ]) is None:
        return "not a STEP file (it does not begin with ISO-10303-21); export the lens as STEP"
    return None


def check(path: Path) -> None:
    """Raise SceneError if a file can be read and does not begin as STEP; other faults are left to the STEP readers."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            return
        with path.open("rb") as file:
            found = fault(file.read(BYTES_READ))
    except OSError:
        return
    if found is not None:
        raise SceneError(f"{path}: {found}")
