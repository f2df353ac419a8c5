"""The statements of a STEP file's DATA section (ISO 10303-21), cut apart into entities.

What is no token of Part 21, such as NAN or 1.5.2, is refused here with the number of its statement: other readers of
STEP take it for zero or never end over it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bstcad.runs.files import one_line

MAX_COORDINATE = 1e12  # largest coordinate of a point (mm); a target may be 1e8 mm away
MAX_DIGITS = 64  # characters of a number; 17 digits, a sign and an exponent are all that a double holds

NAME = r"[1-9]\d{0,17}"  # an entity's number: one of 64 bits
REAL = r"[-+]?\d+\.\d*(?:E[-+]?\d+)?"
COORDINATE = rf"[-+]?\d{{1,{MAX_DIGITS}}}+\.\d{{0,{MAX_DIGITS}}}+(?:E[-+]?\d{{1,4}}+)?"
BLANKS = bytes(code for code in range(256) if chr(code).isspace())
STRING = re.compile(  # a string or a comment, after all text and empty strings before it, which cost no call
    r"((?:[^'/]++|''(?!')|/(?!\*))*+)('[^']*(?:''[^']*)*'|/\*.*?(?:\*/|\Z)|'|\Z)", re.DOTALL
)
POINT = re.compile(rf"(?<=;)#({NAME})=CARTESIAN_POINT\('\d*',\(({COORDINATE},{COORDINATE},{COORDINATE})\)\);")
WRITTEN = re.compile(  # points in a row as OCC writes them, nine tenths of a file, which need no second look
    rf"(?<=;\n)((?:#[1-9]\d{{0,14}}+ = CARTESIAN_POINT\('',\({COORDINATE},\s*+{COORDINATE},\s*+{COORDINATE}\)\);\n)++)"
)
TAKEN = "\0"  # stands where points were taken out of the text
STATEMENT = re.compile(rf"#({NAME})=([A-Z][A-Z_0-9]*)?(\(.*\))", re.DOTALL)
TOKENS = re.compile(  # tokens without blanks: separators, references, numbers, strings, enumerations, keywords
    r"[(),;]++|(?:#\d{1,20}+,)++|#\d{1,20}+(?=[)=])=?|'\d*+'|\.[A-Z_0-9]++\.|[$*](?=[,)])|!?[A-Z_][A-Z_0-9]{0,99}+(?=\()"
    r"|[-+]?\d{1,99}+(?:\.\d{0,99}+(?:[Ee][-+]?\d{1,9}+)?)?(?=[,)])|\"[0-9A-F]*+\""
)  # each is bounded, or begins with a character that it does not hold: a time in proportion to the text
LONG = re.compile(rf"(?<=[(,])[-+.\d][-+.\dEe]{{{MAX_DIGITS},}}")
LARGE = re.compile(r"(?<=[(,])[-+]?\d++\.\d*+[Ee]\+?\d{3,}+")  # 1e100 or more


@dataclass(frozen=True)
class Entities:
    """The entities of a STEP file, by the digits of their numbers."""

    bodies: Mapping[str, tuple[str, str]]  # (kind, attributes without blanks); a complex entity's kind is COMPLEX
    strings: Sequence[str]  # 'k' in the attributes is string k, as the file has it
    point_numbers: np.ndarray  # (n,) ascending: nearly all entities are points in space, and not among the bodies
    xyz: np.ndarray  # (n, 3), in that order, the file's unit of length

    def of(self, kind: str) -> dict[str, str]:
        """The attributes of the entities of a kind."""
        return {number: body for number, (its, body) in self.bodies.items() if its == kind}

    def references(self, number: str) -> list[str]:
        """The entities that an entity refers to, in order."""
        return re.findall(r"#(\d+)", self.bodies[number][1])

    def string(self, number: str, place: int) -> str:
        """The first or second attribute of an entity as a string in one line; "" if it is none."""
        attributes = re.match(r"\((?:'(\d*)')?(?:,'(\d*)')?", self.bodies[number][1]).groups()
        return decoded(self.strings[int(attributes[place])]) if attributes[place] else ""

    def points(self, numbers: np.ndarray) -> np.ndarray:
        """The points of these entities; KeyError names an entity that is no point."""
        rows = np.searchsorted(self.point_numbers, numbers).clip(max=len(self.xyz) - 1)
        wrong = numbers[self.point_numbers[rows] != numbers] if len(self.xyz) else numbers.ravel()
        if len(wrong):
            raise KeyError(f"#{wrong[0]}")
        return self.xyz[rows]


def without_blanks(text: str) -> tuple[str, list[str]]:
    """(the text without comments and blanks, the strings): a string gives way to its place in the list, '' stays."""
    strings: list[str] = []

    def numbered(hit: re.Match[str]) -> str:
        before, token = hit.groups()
        if token.startswith("/*"):
            return before
        if len(token) < 3:  # an empty string, the end, or a quote that nothing closes
            return hit[0]
        strings.append(token[1:-1])
        return f"{before}'{len(strings) - 1}'"

    data = STRING.sub(numbered, text)
    return data.encode("latin-1", "replace").translate(None, BLANKS).decode("latin-1"), strings


def read_entities(text: str) -> tuple[str, Entities]:
    """Read a STEP file: (its text without blanks and points, the entities of its DATA section)."""
    parts = [text] if TAKEN in text else WRITTEN.split(text)
    data, strings = without_blanks(TAKEN.join(parts[::2]))
    start, end = data.find("DATA;"), data.rfind("ENDSEC;")
    if data.count(TAKEN, start, end) != len(parts) // 2:  # some stand in a string, a comment or another section
        parts = [text]
        data, strings = without_blanks(text)
        start, end = data.find("DATA;"), data.rfind("ENDSEC;")
    if not 0 <= start < end:
        raise damaged("it has no DATA section")
    written = "".join(parts[1::2])[1:-4].replace(" = CARTESIAN_POINT('',(", ",").replace("));\n#", ",")
    table = np.fromstring(written, dtype=np.float64, sep=",").reshape(-1, 4)  # numbers below 1e15 are exact
    section = data[start + len("DATA") : end]  # from its semicolon on
    parts = POINT.split(section.replace(TAKEN, "") if written else section)
    rest, names, values = "".join(parts[::3]), parts[1::3], parts[2::3]
    *texts, tail = rest[1:].split(";")
    hits = [STATEMENT.fullmatch(each) for each in texts]
    if tail or not hits or None in hits:
        raise damaged("a statement is no entity")
    _check_tokens(rest, hits)
    numbers = np.concatenate([table[:, 0].astype(np.int64), np.fromstring(",".join(names), dtype=np.int64, sep=",")])
    xyz = np.concatenate([table[:, 1:], np.fromstring(",".join(values), dtype=np.float64, sep=",").reshape(-1, 3)])
    known = np.sort(np.concatenate([numbers, np.array([hit[1] for hit in hits], dtype=np.int64)]))
    if not (np.diff(known) > 0).all():
        raise damaged("two entities share a number")
    named = np.fromstring(",".join(re.findall(r"#(\d+)", rest)), dtype=np.int64, sep=",")
    missing = named[known[np.searchsorted(known, named).clip(max=len(known) - 1)] != named]
    if len(missing):
        raise damaged(f"entity #{missing.min()} is missing")
    if not np.isfinite(xyz).all():
        raise ValueError("a CARTESIAN_POINT is not finite; write the file again")
    if np.abs(xyz).max(initial=0.0) > MAX_COORDINATE:
        raise ValueError(f"a CARTESIAN_POINT is over {MAX_COORDINATE:g} away; write the file again")
    order = np.argsort(numbers)
    bodies = {hit[1]: (hit[2] or "COMPLEX", hit[3]) for hit in hits}
    return data, Entities(bodies, strings, numbers[order], xyz[order])


def damaged(fault: str) -> ValueError:
    """Return the error of a file whose text is damaged."""
    return ValueError(f"the file is damaged ({fault}); write it again")


def decoded(string: str) -> str:
    """A string of Part 21, without its quotes, as it is meant: escapes resolved, in one line."""
    string = re.sub(r"[\r\n]", "", string).replace("''", "'")
    string = re.sub(
        r"\\X2\\((?:[0-9A-F]{4})*)\\X0\\",
        lambda hit: bytes.fromhex(hit.group(1)).decode("utf-16-be", "replace"),
        string,
    )
    return one_line(re.sub(r"\\X\\([0-9A-F]{2})", lambda hit: chr(int(hit.group(1), 16)), string))


def _check_tokens(rest: str, hits: Sequence[re.Match[str]]) -> None:
    """ValueError, with the statement, if a text holds what is no token of Part 21 or a number that no double holds."""
    if TOKENS.sub("", rest):
        number, kind, body = next(hit.groups() for hit in hits if TOKENS.sub("", hit[3]))
        atoms = (atom for atom in re.split(r"[(),]+", body) if TOKENS.sub("", f"({atom})"))
        atom = next(atoms, "its text")
        statement = f"statement #{number} = {kind or 'COMPLEX'}"
        raise damaged(f"{statement} is malformed: {_cut(atom)!r} is no number or word of STEP")
    for pattern, fault in ((LONG, f"has over {MAX_DIGITS} characters"), (LARGE, "is not finite")):
        for found in pattern.finditer(rest):
            if pattern is LONG or not math.isfinite(float(found[0])):
                number = rest[: found.start()].rpartition(";")[2].partition("(")[0].replace("=", " = ")
                raise damaged(f"statement {number} is malformed: the number {_cut(found[0])} {fault}")


def _cut(word: str) -> str:
    return one_line(word if len(word) <= 24 else f"{word[:20]}…")
