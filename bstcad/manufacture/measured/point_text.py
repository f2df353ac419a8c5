"""Read points from text: lines of x, y and z with any common separator, among other columns that a heading names.

Without a heading a file has three columns of numbers, in mm, and optionally names or numbers of the points.  A heading
states columns and units; if it names nominal and actual coordinates, the actual ones are read.  Lines without data, as
instruments write them ("Bad", "No Data", NaN, an empty height), are counted and left out.  If a line cannot be
interpreted, the error states the line's number.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

INPUT_HINT = "give x, y and z in mm, one point per line"
INCH = 25.4  # length of an inch (mm)
UNITS_IN_MM = {  # sizes (mm) of units as they are written in headings
    "mm": 1.0, "millimetre": 1.0, "millimeter": 1.0, "cm": 10.0, "m": 1e3, "metre": 1e3, "meter": 1e3, "um": 1e-3,
    "\u00b5m": 1e-3, "\u03bcm": 1e-3, "micron": 1e-3, "microns": 1e-3, "nm": 1e-6, "in": INCH, "inch": INCH,
    "inches": INCH, '"': INCH,
}  # fmt: skip
# Words that may accompany x, y or z in the heading of a coordinate, unlike those of "normal x" and "x deviation".
COORDINATE_WORDS = {"coord", "coordinate", "koordinate", "pos", "position", "point", "axis", "achse"}
ACTUAL_WORDS = {"act", "actual", "meas", "measured", "ist", "istwert", "messwert"}
NOMINAL_WORDS = {"nom", "nominal", "soll", "sollwert", "theo", "theoretical", "cad", "ref", "reference"}
HEADING_LINES = 50  # number of lines that are searched for a heading
SAMPLE_LINES = 200  # number of lines from which the columns are inferred if there is no heading
MAX_POSITION = 1e6  # largest accepted coordinate (mm); a larger one is an error of the file
COMPRESSED_SUR = b"DSCOMPRESSED"  # first bytes of a compressed file of MountainsMap
# Pattern of a field that marks missing data, as an empty field does.
NO_DATA = (
    r"[+-]?nan(?:\(\w*\))?|[+-]?1\.#(?:qnan|ind|snan)0*|no[ _]?data|bad|invalid|missing|masked|null|none|n/?a"
    r"|-{1,3}|\*+"
)
NON_NUMERIC = re.compile(r"[a-df-zA-DF-Z#*]|-(?![\d.])")  # character that no plain number contains
NO_DATA_FIELD = re.compile(rf"(?<![^\s,;\"])(?:{NO_DATA})(?![^\s,;\"])", re.IGNORECASE)
NUMBER_WITH_COMMA = r"[+-]?\d*,\d+(?:[eEdD][+-]?\d+)?"
EMPTY_FIELD = re.compile(r';[ ]*[;\n]|"[ ]*"|^[ ]*(?=;)', re.MULTILINE)  # empty field, or empty quotes
FORTRAN_EXPONENT = re.compile(r"(?<=[\d.])[dD](?=[+-]?\d)")  # exponent letter of 1.0D-03
QUOTED_COMMA = re.compile(r'"\s*([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)\s*"')


@dataclass(frozen=True)
class MeasuredPoints:
    """Measured points of a file."""

    positions: np.ndarray  # positions of the points (n, 3), mm, or in an unknown unit if the file states none
    without_data: int = 0  # number of points that lack a coordinate and were left out
    columns: str = ""  # names of the columns read, for a Zygo file or if other columns state x, y or z too; else ""
    duplicates: int = 0  # number of points that repeat an earlier one exactly and were left out


class NotAMap(ValueError):
    """Error, in a sentence, of a readable file that is not a usable height map."""


def make_points(positions: np.ndarray, where: Sequence[int] | None = None, columns: str = "") -> MeasuredPoints:
    """Return distinct points without NaN; ValueError for a coordinate above MAX_POSITION; where: line numbers."""
    missing = np.isnan(positions).any(axis=1)
    excessive = ~(np.abs(positions) <= MAX_POSITION) & ~np.isnan(positions)
    if excessive.any():
        row, axis = np.argwhere(excessive)[0]
        place = f"point {row + 1}" if where is None else f"line {where[row]}"
        raise ValueError(
            f"{place}: {'xyz'[axis]} = {positions[row, axis]:.4g} mm exceeds {MAX_POSITION:.0f} mm; state another "
            "unit in the heading, or leave out points that were not measured"
        )
    kept, count = distinct(positions[~missing]), int(missing.sum())
    return MeasuredPoints(kept, count, columns, duplicates=len(positions) - count - len(kept))


def distinct(positions: np.ndarray) -> np.ndarray:
    """Return the points (n, 3) without those that repeat an earlier one exactly: they are no independent data."""
    order = np.lexsort(positions.T)  # stable, so that the first of equal points comes first
    repeated = np.zeros(len(positions), dtype=bool)
    repeated[order[1:]] = (positions[order[1:]] == positions[order[:-1]]).all(axis=1)
    return positions[~repeated]


def read_text(data: bytes) -> MeasuredPoints:
    """Read points from text; raise ValueError, with a sentence that names the line, if it cannot be interpreted."""
    every = [(number, line.strip(" ")) for number, line in enumerate(decode_text(data).splitlines(), 1) if line.strip()]
    if every and re.match(r"zygo\b.*\bdata file", every[0][1], re.IGNORECASE):
        return _read_zygo(every)
    if every and (named := re.fullmatch(r"sep=(.)", every[0][1].strip())):  # Excel's line
        every = every[1:]
    forced = named[1] if every and named else ""
    heading = _heading([line for _, line in every[:HEADING_LINES]])
    after = every[heading.lines :]
    lines = [(number, line) for number, line in after if line[0] not in "#%" and not line.startswith("//")]
    if not heading.lines:
        lines = _without_title(lines)
    if not lines:
        raise ValueError(f"contains no points; {INPUT_HINT}")
    layout = _Layout.of(lines[0][1], forced)
    if not heading.lines:  # a tab at the beginning of a line is no empty column
        lines = [(number, line.lstrip("\t")) for number, line in lines]
    if heading.lines:
        columns = heading.columns
        _check_field_counts(heading, lines, layout)
    else:
        columns = _columns_without_heading(lines, layout)
    positions = _table(lines, layout, columns) * heading.units
    return make_points(positions, [number for number, _ in lines], heading.actual_columns)


def _read_zygo(every: list[tuple[int, str]]) -> MeasuredPoints:
    """Read points from the numbered lines of a Zygo XYZ file: pixel column, pixel row and height in µm.

    MetroPro Reference Guide, ASCII data file format: the seventh number of line 8 is the width of a pixel in metres,
    0 if the lateral scale was not calibrated.  Points are listed between two lines "#".  Zero is put in the middle of
    the listed pixels.  Rows are counted from the top; if an instrument counts them from the bottom, the alignment
    reports that y is reversed.
    """
    marks = [place for place, (_, line) in enumerate(every) if line == "#"]
    if "xyz" not in every[0][1].lower() or not marks:
        raise ValueError("is a Zygo data file that has no table of x, y and z; export it as a Zygo XYZ file")
    stated = [_number(field) for number, line in every[: marks[0]] if number == 8 for field in line.split()]
    pixel = stated[6] if len(stated) > 6 else None
    if pixel is None or not 0 < pixel < 1:
        raise ValueError(
            "is a Zygo XYZ file, whose x and y are in pixels, but its header states no width of a pixel (seventh "
            "number of line 8, in metres); calibrate the lateral scale of the instrument and export again, or give "
            "x and y in mm under a heading such as x [mm],y [mm],z [\u00b5m]"
        )
    lines = [(number, line) for number, line in every[marks[0] + 1 :] if line != "#"]
    if not lines:
        raise ValueError(f"contains no points; {INPUT_HINT}")
    width = 1e3 * pixel
    stated_points = _table(lines, _Layout(None, False), (0, 1, 2))
    misplaced = ~(np.abs(stated_points[:, :2]) <= MAX_POSITION / width).all(axis=1)
    if misplaced.any():
        number, line = lines[int(misplaced.argmax())]
        raise ValueError(
            f"line {number}: {line[:40]!r} has a pixel that is not finite, or over {MAX_POSITION:.0f} mm from the "
            "first one; export the file again"
        )
    positions = stated_points * [width, -width, 1e-3]
    positions[:, :2] -= (positions[:, :2].min(axis=0) + positions[:, :2].max(axis=0)) / 2
    columns = f"x (pixels of {width:.4g} mm), y (rows of pixels from the top) and z (\u00b5m)"
    return make_points(positions, [number for number, _ in lines], columns)


def decode_text(data: bytes) -> str:
    """Decode UTF-8, UTF-16 or Windows-1252; raise ValueError if the bytes are not text."""
    if data.startswith(COMPRESSED_SUR):
        raise ValueError("is a compressed SUR file; save it without compression, or as X3P")
    encoding, sample = "utf-8-sig", data[:400]
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        encoding = "utf-16"
    elif sample[1::2].count(0) > len(sample) / 4 or sample[::2].count(0) > len(sample) / 4:  # every second byte is 0
        encoding = "utf-16-le" if sample[1::2].count(0) > sample[::2].count(0) else "utf-16-be"
    elif re.search(rb"[\x00-\x08\x0e-\x19\x1b-\x1f]", data):
        raise ValueError(f"is not a text file; {INPUT_HINT}, or a file whose name ends in .ply or .stl")
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        if encoding == "utf-8-sig":
            return data.decode("cp1252", errors="replace")
        raise ValueError(f"is not text in UTF-16 ({error.reason} at byte {error.start}); save it as UTF-8") from None


# ---- separators and numbers ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Layout:
    separator: str | None  # separator of fields; None: blanks
    decimal_comma: bool

    @classmethod
    def of(cls, line: str, forced: str = "") -> _Layout:
        """Infer the layout of a line; forced: separator that the file states, or ""."""
        mark = forced or next((mark for mark in (";", "\t") if mark in line), None)
        if mark is not None:
            return cls(mark, mark != ",")
        blanks = NO_DATA_FIELD.sub("nan", line).split()
        with_comma = [word for word in blanks if re.fullmatch(NUMBER_WITH_COMMA, word)]
        if len(with_comma) >= 2 and len(blanks) >= 3:  # 1,5 2,25 3,0
            return cls(None, True)
        return cls("," if "," in line else None, False)

    def normalise(self, text: str) -> str:
        """Return text with numbers in Python's notation, and nan for each field without data."""
        words = NON_NUMERIC.search(text) is not None
        text = NO_DATA_FIELD.sub("nan", text) if words else text
        if self.decimal_comma:
            text = text.replace(",", ".")
        elif '"' in text:
            text = QUOTED_COMMA.sub(r'"\1.\2"', text)
        if self.separator is not None and EMPTY_FIELD.search(f"{text}\n".replace(self.separator, ";")):
            mark = re.escape(self.separator)
            text = re.sub(rf'(?:^|(?<={mark}))[ ]*(?:"[ ]*")?(?={mark}|$)', "nan", text, flags=re.MULTILINE)
        return FORTRAN_EXPONENT.sub("e", text) if words else text

    def fields(self, line: str) -> list[str]:
        """Return the fields of a line, without empty fields at its end, with numbers in Python's notation."""
        if self.separator is None:
            return self.normalise(line).split()
        line = line.rstrip(f"{self.separator} ")
        if '"' in line:
            line = self.normalise(line)
            return next(csv.reader([line], delimiter=self.separator, skipinitialspace=True))
        return [field.strip() for field in self.normalise(line).split(self.separator)]


def _number(field: str) -> float | None:
    try:
        return float(field)
    except ValueError:
        return None


def _table(lines: list[tuple[int, str]], layout: _Layout, columns: Sequence[int]) -> np.ndarray:
    body = layout.normalise("\n".join(line for _, line in lines))
    text, separator = io.StringIO(body), layout.separator
    try:
        return np.loadtxt(text, usecols=columns, delimiter=separator, comments=None, ndmin=2, quotechar='"')
    except ValueError:
        for number, line in lines:
            fields = layout.fields(line)
            if layout.separator is not None:
                fields += ["nan"] * (line.count(layout.separator) + 1 - len(fields))
            if len(fields) <= max(columns) or any(_number(fields[column]) is None for column in columns):
                raise ValueError(f"line {number} lacks a number for x, y or z ({line[:40]!r}); {INPUT_HINT}") from None
        raise ValueError(f"is not a table of numbers from line {lines[0][0]} on; {INPUT_HINT}") from None


# ---- columns ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Heading:
    lines: int = 0  # number of lines up to the heading's last line; 0: there is no heading
    columns: tuple[int, ...] = (0, 1, 2)  # indices of x, y and z in a line
    units: np.ndarray | float = 1.0  # size of the unit (mm), one for all columns or one for each
    fields: int = 3  # number of columns
    actual_columns: str = ""  # names of the columns that are read, if other columns state x, y or z too; else ""


def _heading(lines: list[str]) -> _Heading:
    for row, line in enumerate(lines):
        fields = _Layout.of(line).fields(line)
        if len(fields) > 1 and all(_number(field) is not None for field in fields):
            break
        plain = re.sub(r"\s+([\[(])", r"\1", line.lstrip("#%/ "))  # "x [mm]" is one word
        words = _words(plain)
        named = [(place, *found) for place, word in enumerate(words) if (found := _coordinate(word))]
        actual = [column for column in named if column[1] == "actual"]
        others = [column for column in named if column[1] == ""]
        nominal = {axis for _, role, axis, _ in named if role == "nominal"}
        chosen = actual if {axis for _, _, axis, _ in actual} == set("xyz") else actual + others
        if {axis for _, _, axis, _ in chosen} != set("xyz"):
            if nominal == set("xyz"):
                raise ValueError(
                    f"line {row + 1}: its heading, {line[:60]!r}, names nominal coordinates only; give the measured "
                    "ones, named x, y and z or x act, y act and z act"
                )
            continue
        if len(chosen) > 3:
            raise ValueError(f"its heading, {line[:60]!r}, names x, y or z twice; name each in one column only")
        columns, _, _, units = zip(*sorted(chosen, key=lambda column: column[2]), strict=True)
        actual_columns = ", ".join(words[column].strip().strip("'\"") for column in columns)
        beside = nominal or len(chosen) < len(actual + others)
        return _Heading(
            row + 1, columns, np.array(units), fields=len(words), actual_columns=actual_columns if beside else ""
        )
    return _Heading()


def _words(line: str) -> list[str]:
    mark = next((mark for mark in (";", "\t", ",") if mark in line), None)
    if '"' in line and mark is not None:
        return next(csv.reader([line], delimiter=mark, skipinitialspace=True))
    return line.split(mark)


def _coordinate(word: str) -> tuple[str, str, float] | None:
    """Return role ("actual", "nominal" or ""), axis ("x", "y" or "z") and unit (mm) of a heading such as "X [mm]".

    Returns None if the column is not a coordinate.  Raises ValueError for a unit that UNITS_IN_MM does not contain.
    """
    parts = re.findall(r"[a-z\u00b5\u03bc]+|\"", word.strip().strip("'\"").lower())
    words = [piece for part in parts for piece in _split_role(part)]
    axis = [part for part in words if part in ("x", "y", "z")]
    roles = {"actual": ACTUAL_WORDS.intersection(words), "nominal": NOMINAL_WORDS.intersection(words)}
    rest = [part for part in words if part not in COORDINATE_WORDS | ACTUAL_WORDS | NOMINAL_WORDS and part not in axis]
    if len(axis) != 1 or len(rest) > 1 or all(roles.values()):
        return None
    if rest and rest[0] not in UNITS_IN_MM:
        if re.search(r"[\[(/]", word):
            raise ValueError(f"its heading, {word.strip()[:60]!r}, has an unknown unit; give mm")
        return None
    return next((role for role, found in roles.items() if found), ""), axis[0], UNITS_IN_MM[rest[0]] if rest else 1.0


def _split_role(word: str) -> tuple[str, ...]:
    """Split "xact" or "actx" into axis and role."""
    for axis, role in ((word[:1], word[1:]), (word[-1:], word[:-1])):
        if axis in ("x", "y", "z") and role in ACTUAL_WORDS | NOMINAL_WORDS:
            return axis, role
    return (word,)


def _check_field_counts(heading: _Heading, lines: list[tuple[int, str]], layout: _Layout) -> None:
    """Raise ValueError for a line with more fields than the heading (or the first lines) has columns."""
    mark = layout.separator
    for number, line in lines:
        count_bound = len(line.split()) if mark is None else line.count(mark) + 1
        if count_bound <= heading.fields:  # usual case; the fields need not be parsed
            continue
        if (count := len(layout.fields(line))) > heading.fields:
            raise ValueError(
                f"line {number} has {count} fields, but its heading or first lines have {heading.fields} columns; "
                "write decimals with points, and names as one word or in quotes"
            )


def _without_title(lines: list[tuple[int, str]]) -> list[tuple[int, str]]:
    """Return the lines from the first one with numbers; raise ValueError if a heading without x, y, z precedes it."""
    for row, (number, line) in enumerate(lines[:HEADING_LINES]):
        layout = _Layout.of(line)
        count = sum(_number(field) is not None for field in layout.fields(line))
        if count >= 2:
            if row and len(layout.fields(line)) == len(_words(lines[row - 1][1])) and lines[row - 1][0] == number - 1:
                title = lines[row - 1][1]
                raise ValueError(f"its heading, {title[:60]!r}, names no x, y and z; name three columns x, y and z")
            return lines[row:]
    return lines


def _columns_without_heading(lines: list[tuple[int, str]], layout: _Layout) -> tuple[int, ...]:
    """Return the column indices of x, y and z; other columns may contain names or consecutive numbers of points."""
    sample = [layout.fields(line) for _, line in lines[:SAMPLE_LINES]]
    count, first = max(map(len, sample)), lines[0][0]
    numbers = [
        column
        for column in range(count)
        if 2 * sum(column < len(row) and _number(row[column]) is not None for row in sample) > len(sample)
    ]
    if len(numbers) == 4 and _is_numbering([row[numbers[0]] for row in sample if len(row) > numbers[0]]):
        numbers = numbers[1:]
    if len(numbers) > 3:
        raise ValueError(
            f"the table from line {first} on has {count} columns, but no heading names x, y and z; add one, such as "
            "x,y,z,nx,ny,nz, or give only the columns x, y and z"
        )
    if len(numbers) < 3:
        raise ValueError(f"line {first} has {len(numbers)} number{'s' * (len(numbers) != 1)}; {INPUT_HINT}")
    if len(lines) > SAMPLE_LINES:
        _check_field_counts(_Heading(fields=count), lines, layout)
    return tuple(numbers)


def _is_numbering(fields: list[str]) -> bool:
    """Return True if a column numbers the points: 0, 1, 2 … or 1, 2, 3 …"""
    values = [int(field) for field in fields if re.fullmatch(r"\d+", field)]
    return len(values) == len(fields) > 2 and values[0] in (0, 1) and all(b - a == 1 for a, b in pairwise(values))
