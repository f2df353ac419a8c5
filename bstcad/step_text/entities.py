"""Entities of a STEP file: the statements of its DATA section (ISO 10303-21).

Text that is not a token of Part 21, such as NAN or 1.5.2, is refused with the number of its statement.  Other STEP
readers read it as zero or hang.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bstcad.runs.files import one_line

MAX_COORDINATE = 1e12  # largest coordinate of a point, in the file's unit; coordinates of a scene are at most 1e8 mm
MAX_NUMBER_LENGTH = 64  # largest length of a number (characters); a double has 17 digits, a sign and an exponent

ENTITY = r"[1-9]\d{0,17}"  # pattern of an entity's number, which fits into 64 bits
REAL = r"[-+]?\d+\.\d*(?:E[-+]?\d+)?"
COORDINATE = rf"[-+]?\d{{1,{MAX_NUMBER_LENGTH}}}+\.\d{{0,{MAX_NUMBER_LENGTH}}}+(?:E[-+]?\d{{1,4}}+)?"
BLANKS = bytes(code for code in range(256) if chr(code).isspace())
STRING = re.compile(  # text, perhaps with empty strings, then a string or comment, so that `numbered` is called rarely
    r"((?:[^'/]++|''(?!')|/(?!\*))*+)('[^']*(?:''[^']*)*'|/\*.*?(?:\*/|\Z)|'|\Z)", re.DOTALL
)
POINT_TEXT = re.compile(rf"(?<=;)#({ENTITY})=CARTESIAN_POINT\('\d*',\(({COORDINATE},{COORDINATE},{COORDINATE})\)\);")
POINT_ROWS = re.compile(  # consecutive points as OCC writes them, nine tenths of a file; they need no other check
    rf"(?<=;\n)(?:#[1-9]\d{{0,14}}+ = CARTESIAN_POINT\('',\({COORDINATE},\s*+{COORDINATE},\s*+{COORDINATE}\)\);\n)"
    "{1,16384}+".encode()  # some 2 MB, so that the copies that the conversion to numbers makes stay small
)
POINTS_MARK = "\0"  # character that replaces consecutive points in the text
REFERENCE_LIST = re.compile(r"#\d++(?:,#\d++)*+")
STATEMENT = re.compile(rf"#({ENTITY})=([A-Z][A-Z_0-9]*)?(\(.*\))", re.DOTALL)
TOKENS = re.compile(  # tokens without blanks: separators, references, numbers, strings, enumerations, keywords
    r"[(),;]++|(?:#\d{1,20}+,)++|#\d{1,20}+(?=[)=])=?|'\d*+'|\.[A-Z_0-9]++\.|[$*](?=[,)])|!?[A-Z_][A-Z_0-9]{0,99}+(?=\()"
    r"|[-+]?\d{1,99}+(?:\.\d{0,99}+(?:[Ee][-+]?\d{1,9}+)?)?(?=[,)])|\"[0-9A-F]*+\""
)  # matching takes linear time: a failed match has a bounded length, or contains its first character only once
LONG_NUMBER = re.compile(rf"(?<=[(,])[-+.\d][-+.\dEe]{{{MAX_NUMBER_LENGTH},}}")
DIRECTIVE = re.compile(  # \X2\, \X4\, \X\ with hexadecimal digits, page of ISO 8859, character of this page, backslash
    r"\\X2\\((?:[0-9A-F]{4})*+)\\X0\\|\\X4\\((?:[0-9A-F]{8})*+)\\X0\\|\\X\\([0-9A-F]{2})|\\P([A-I])\\|\\S\\([ -~])|\\\\"
)
CHINESE = re.compile(r"[\u4e00-\u9fff]{2}")  # two letters of Windows-1252, such as öß, can be one Chinese character
HUGE_NUMBER = re.compile(r"(?<=[(,])[-+]?\d++\.\d*+[Ee]\+?\d{3,}+")  # number with an exponent of 100 or more


@dataclass(frozen=True)
class Entities:
    """Entities of a STEP file by their numbers, which are texts of digits."""

    bodies: Mapping[str, tuple[str, str]]  # number -> (kind, attributes without blanks); kind COMPLEX: several kinds
    strings: Sequence[str]  # strings as written; 'k' in the attributes stands for string k
    point_numbers: np.ndarray  # numbers of the points in space, (n,), ascending; points are not among the bodies
    xyz: np.ndarray  # coordinates of these points, (n, 3), in the file's unit of length

    def of(self, kind: str) -> dict[str, str]:
        """Return the attributes of all entities of a kind, by number."""
        return {number: body for number, (its, body) in self.bodies.items() if its == kind}

    def references(self, number: str) -> list[str]:
        """Return the numbers of the entities that an entity refers to, in order."""
        return re.findall(r"#(\d+)", self.bodies[number][1])

    def string(self, number: str, index: int) -> str:
        """Return the first (index 0) or second (1) attribute of an entity as a line of text; "" if it is no string."""
        attributes = required(re.match(r"\((?:'(\d*)')?(?:,'(\d*)')?", self.bodies[number][1])).groups()
        return decode(self.strings[int(attributes[index])]) if attributes[index] else ""

    def points(self, numbers: np.ndarray) -> np.ndarray:
        """Return the coordinates of point entities, (…, 3); KeyError, with the number, for any other entity."""
        rows = np.searchsorted(self.point_numbers, numbers).clip(max=len(self.xyz) - 1)
        wrong = numbers[self.point_numbers[rows] != numbers] if len(self.xyz) else numbers.ravel()
        if len(wrong):
            raise KeyError(f"#{wrong[0]}")
        return self.xyz[rows]


def without_blanks(text: str) -> tuple[str, list[str]]:
    """Return the text without comments and blanks, and its strings; 'k' replaces string k, and '' stays."""
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


def read_entities(contents: bytes) -> tuple[str, Entities]:
    """Return (header without blanks and strings, entities) of a STEP file; ValueError if it is damaged.

    The text of the points is converted to numbers block by block, and not kept.
    """
    header, rest, strings, numbers, xyz = _statements_and_points(contents)
    *texts, tail = rest[1:].split(";")
    hits = [hit for each in texts if (hit := STATEMENT.fullmatch(each))]
    if tail or not hits or len(hits) < len(texts):
        raise damaged("a statement is not an entity")
    _check_tokens(rest, hits)
    _check_references(rest, np.concatenate([numbers, np.array([hit[1] for hit in hits], dtype=np.int64)]))
    if not np.isfinite(xyz).all():
        raise ValueError("a CARTESIAN_POINT is not finite; export the file again")
    if max(xyz.max(initial=0.0), -xyz.min(initial=0.0)) > MAX_COORDINATE:
        raise ValueError(f"a CARTESIAN_POINT has a coordinate above {MAX_COORDINATE:g}; export the file again")
    if not (np.diff(numbers) > 0).all():
        order = np.argsort(numbers)
        numbers, xyz = numbers[order], xyz[order]
    return header, Entities({hit[1]: (hit[2] or "COMPLEX", hit[3]) for hit in hits}, strings, numbers, xyz)


def _statements_and_points(contents: bytes) -> tuple[str, str, list[str], np.ndarray, np.ndarray]:
    """Return (header, DATA section without points, strings; numbers (n,) and coordinates (n, 3) of the points)."""
    parts, tables = _without_point_rows(contents)
    data, strings = without_blanks(POINTS_MARK.join(parts))
    start, end = data.find("DATA;"), data.rfind("ENDSEC;")
    if data.count(POINTS_MARK, start, end) != len(tables):  # points in a string, a comment or another section
        tables = []
        data, strings = without_blanks(contents.decode("latin-1"))
        start, end = data.find("DATA;"), data.rfind("ENDSEC;")
    if not 0 <= start < end:
        raise damaged("it has no DATA section")
    section = data[start + len("DATA") : end]  # begins with the semicolon
    parts = POINT_TEXT.split(section.replace(POINTS_MARK, "") if tables else section)
    numbers = np.fromstring(",".join(parts[1::3]), dtype=np.int64, sep=",")
    xyz = np.fromstring(",".join(parts[2::3]), dtype=np.float64, sep=",").reshape(-1, 3)
    numbers = np.concatenate([*(table[:, 0].astype(np.int64) for table in tables), numbers])
    xyz = np.concatenate([*(table[:, 1:] for table in tables), xyz])
    return data[:start], "".join(parts[::3]), strings, numbers, xyz


def _without_point_rows(contents: bytes) -> tuple[list[str], list[np.ndarray]]:
    """Return (the text between POINT_ROWS, the numbers and coordinates of their points, each (n, 4))."""
    if POINTS_MARK.encode() in contents:
        return [contents.decode("latin-1")], []
    parts, tables, end = [], [], 0
    for rows in POINT_ROWS.finditer(contents):
        parts.append(contents[end : rows.start()].decode("latin-1"))  # Part 21 is ASCII; latin-1 never fails
        numbers = rows[0][1:-4].replace(b" = CARTESIAN_POINT('',(", b",").replace(b"));\n#", b",")
        tables.append(np.fromstring(numbers, dtype=np.float64, sep=",").reshape(-1, 4))  # numbers below 1e15 are exact
        end = rows.end()
    return [*parts, contents[end:].decode("latin-1")], tables


def required(hit: re.Match[str] | None) -> re.Match[str]:
    """Return the match of an entity's text; LookupError if it is None, because the text has another form."""
    if hit is None:
        raise LookupError
    return hit


def damaged(fault: str) -> ValueError:
    """Return the error of a damaged file; fault: for example "it has no DATA section"."""
    return ValueError(f"the file is damaged ({fault}); export it again")


def decode(string: str) -> str:
    """Decode a string of Part 21 (without its quotes; a character per byte) into one line of text."""
    page = "iso8859-1"

    def character(hit: re.Match[str]) -> str:
        nonlocal page
        two_bytes, four_bytes, byte, letter, shifted = hit.groups()
        if letter:
            page = f"iso8859-{ord(letter) - ord('A') + 1}"
            return ""
        if shifted:
            return bytes([ord(shifted) + 128]).decode(page, "replace")
        if byte:
            return chr(int(byte, 16))
        if two_bytes is None and four_bytes is None:
            return "\\"
        return bytes.fromhex(two_bytes or four_bytes or "").decode(f"utf-{32 if four_bytes else 16}-be", "replace")

    text = _text_of_bytes(re.sub(r"[\r\n]", "", string)).replace("''", "'")
    return one_line(DIRECTIVE.sub(character, text))


def _text_of_bytes(string: str) -> str:
    """Decode bytes above 127, which Part 21 does not allow and some programs write: UTF-8, GB18030 or Windows-1252."""
    data = string.encode("latin-1", "replace")
    for encoding in () if data.isascii() else ("utf-8", "gb18030", "cp1252"):
        with contextlib.suppress(UnicodeDecodeError):
            text = data.decode(encoding)
            if encoding != "gb18030" or CHINESE.search(text):
                return text
    return string


def _check_tokens(rest: str, hits: Sequence[re.Match[str]]) -> None:
    """Raise ValueError if the text `rest` of statements `hits` has an unknown token, or too long or large a number."""
    if TOKENS.sub("", rest):
        number, kind, body = next(hit.groups() for hit in hits if TOKENS.sub("", hit[3]))
        atoms = (atom for atom in re.split(r"[(),]+", body) if TOKENS.sub("", f"({atom})"))
        atom = next(atoms, "its text")
        statement = f"statement #{number} = {kind or 'COMPLEX'}"
        raise damaged(f"{statement} is malformed: {_shorten(atom)!r} is not a number or word of STEP")
    for pattern, fault in ((LONG_NUMBER, f"exceeds {MAX_NUMBER_LENGTH} characters"), (HUGE_NUMBER, "is not finite")):
        for found in pattern.finditer(rest):
            if pattern is LONG_NUMBER or not math.isfinite(float(found[0])):
                number = rest[: found.start()].rpartition(";")[2].partition("(")[0].replace("=", " = ")
                raise damaged(f"statement {number} is malformed: the number {_shorten(found[0])} {fault}")


def _check_references(rest: str, known: np.ndarray) -> None:
    """Raise ValueError if the text `rest` refers to an entity that is not one of `known`, or if two share a number."""
    known = np.sort(known)
    if not (np.diff(known) > 0).all():
        raise damaged("two entities share a number")
    lists = (np.fromstring(hit[0].replace("#", ""), dtype=np.int64, sep=",") for hit in REFERENCE_LIST.finditer(rest))
    named = np.concatenate([np.empty(0, dtype=np.int64), *lists])
    missing = named[known[np.searchsorted(known, named).clip(max=len(known) - 1)] != named]
    if len(missing):
        raise damaged(f"entity #{missing.min()} is missing")


def _shorten(word: str) -> str:
    return one_line(word if len(word) <= 24 else f"{word[:20]}…")
