"""Where in a scene file a key stands, so that what is said of it can name the line."""

from __future__ import annotations

import re
from collections.abc import Mapping

PART = r"""[\w-]+|"[^"\n]*"|'[^'\n]*'"""
DOTTED = rf"(?:{PART})(?:\s*\.\s*(?:{PART}))*"
HEADER = re.compile(rf"\s*(\[\[?)\s*({DOTTED})\s*\]")
KEY = re.compile(rf"\s*({DOTTED})\s*=")


def lines(text: str) -> dict[str, int]:
    """The line, from 1, of each table and key of a TOML text: "source", "source.kind", "effects[0].kind".

    What stands inside a value, such as front = { kind = "plane" }, is on the line of that value (`line_of`).
    """
    found: dict[str, int] = {}
    counts: dict[str, int] = {}
    table = ""
    for number, line in enumerate(text.splitlines(), start=1):
        if header := HEADER.match(line):
            table = _plain(header[2])
            if header[1] == "[[":
                counts[table] = counts.get(table, -1) + 1
                table = f"{table}[{counts[table]}]"
            found.setdefault(table, number)
        elif key := KEY.match(line):
            found.setdefault(f"{table}.{_plain(key[1])}" if table else _plain(key[1]), number)
    return found


def line_of(key: str, found: Mapping[str, int]) -> int | None:
    """The line of a key, or of the innermost table or value that holds it; None if the file has none of them."""
    while key:
        if key in found:
            return found[key]
        key = key.rpartition(".")[0] if not key.endswith("]") else key.rpartition("[")[0]
    return None


def _plain(dotted: str) -> str:
    """A dotted key as it is read: without quotes and spaces."""
    return ".".join(part.strip("\"'") for part in re.findall(PART, dotted))
