r"""The strings of a STEP file: the names of what it states, which the reader of its shapes leaves out.

An entity is looked up in the text as it stands, by its kind; nearly all entities of a lens are points, and no string of
theirs matters.
"""

from __future__ import annotations

import re

from bstcad.files import one_line
from bstcad.step_text.syntax import Statements

NUMBER = re.compile(r";\s*#(\d{1,18})\s*=\s*$")  # what stands before the kind of an entity
BEFORE, BEHIND = 60, 4000  # characters on either side of it that are looked at
FIRST_TWO = re.compile(r"\s*\(\s*'((?:[^']|'')*)'(?:\s*,\s*'((?:[^']|'')*)')?")


def of_kind(kind: str, text: str, statements: Statements) -> dict[str, tuple[str, str]]:
    """The first two strings of each simple entity of a kind, "" for none, by the entity's number."""
    found: dict[str, tuple[str, str]] = {}
    at = text.find(kind)
    while at >= 0:
        number = NUMBER.search(text, max(0, at - BEFORE), at)
        at += len(kind)
        strings = FIRST_TWO.match(text, at, at + BEHIND)
        if number and strings and statements.get(number[1], ("",))[0] == kind:
            said = decoded(strings[1]), decoded(strings[2] or "")
            if found.setdefault(number[1], said) != said:  # one of them stands in another string
                raise ValueError(f"the file is damaged (entity #{number[1]} stands there twice); write it again")
        at = text.find(kind, at)
    return found


def decoded(string: str) -> str:
    """A string of Part 21, without its quotes, as it is meant: escapes resolved, in one line."""
    string = re.sub(r"[\r\n]", "", string).replace("''", "'")
    string = re.sub(
        r"\\X2\\((?:[0-9A-F]{4})*)\\X0\\",
        lambda hit: bytes.fromhex(hit.group(1)).decode("utf-16-be", "replace"),
        string,
    )
    return one_line(re.sub(r"\\X\\([0-9A-F]{2})", lambda hit: chr(int(hit.group(1), 16)), string))
