"""Points of text: lines of x, y and z with any usual separator, among other columns that a heading names.

Without a heading there are three columns of numbers, in mm, and perhaps names of the points.  A heading tells columns
and units; of nominal and actual coordinates it takes the actual ones.  Lines without data, as instruments write them
("Bad", "No Data", NaN, an empty height), are counted and left out.  Whatever is not understood is refused by its line.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

ASKED = "give x, y and z in mm, one point a line"
INCH = 25.4  # mm
# Units as headings write them, in mm.
WRITTEN = {
    "mm": 1.0, "millimetre": 1.0, "millimeter": 1.0, "cm": 10.0, "m": 1e3, "metre": 1e3, "meter": 1e3, "um": 1e-3,
    "\u00b5m": 1e-3, "\u03bcm": 1e-3, "micron": 1e-3, "microns": 1e-3, "nm": 1e-6, "in": INCH, "inch": INCH,
    "inches": INCH, '"': INCH,
}  # fmt: skip
# Words beside x, y or z in the heading of a coordinate; "nx", "normal x" or "x deviation" is no coordinate.
BESIDE = {"coord", "coordinate", "koordinate", "pos", "position", "point", "axis", "achse"}
ACTUAL = {"act", "actual", "meas", "measured", "ist", "istwert", "messwert"}
NOMINAL = {"nom", "nominal", "soll", "sollwert", "theo", "theoretical", "cad", "ref", "reference"}
HEADING = 50  # lines among which a heading is looked for
SAMPLED = 200  # lines by which columns without a heading are told
LARGEST = 1e6  # mm; a coordinate beyond it is a mistake
FORMATS = {  # first bytes of files that hold no points as text
    b"PK\x03\x04": "a zip archive, such as X3P", b"aISO-": "an SDF file (ISO 25178-71)", b"bISO-": "an SDF file (ISO "
    "25178-71)", b"VCA DATA": "an OPD file of an interferometer", b"\x89HDF": "an HDF5 file, such as DATX",
}  # fmt: skip
# A field that says that there is no data; it may be empty, too.
NO_DATA = (
    r"[+-]?nan(?:\(\w*\))?|[+-]?1\.#(?:qnan|ind|snan)0*|no[ _]?data|bad|invalid|missing|masked|null|none|n/?a"
    r"|-{1,3}|\*+"
)
OTHER_THAN_NUMBERS = re.compile(r"[a-df-zA-DF-Z#*]|-(?![\d.])")
NO_DATA_FIELD = re.compile(rf"(?<![^\s,;\"])(?:{NO_DATA})(?![^\s,;\"])", re.IGNORECASE)
NUMBER_WITH_COMMA = r"[+-]?\d*,\d+(?:[eEdD][+-]?\d+)?"
EMPTY = re.compile(r';[ ]*[;\n]|"[ ]*"|^[ ]*(?=;)', re.MULTILINE)  # a field between semicolons
FORTRAN = re.compile(r"(?<=[\d.])[dD](?=[+-]?\d)")  # the exponent of 1.0D-03
QUOTED_COMMA = re.compile(r'"\s*([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)\s*"')


@dataclass(frozen=True)
class Points:
    """Points of a file."""

    places: np.ndarray  # (n, 3) mm, or in the unit of the file where nothing names it
    without_data: int = 0  # points that were left out, since a coordinate is missing
    columns: str = ""  # which columns were taken, where a heading names nominal and actual ones


def measured(places: np.ndarray, where: Sequence[int] | None = None, columns: str = "") -> Points:
    """The points with data; ValueError for a coordinate beyond LARGEST, by its line (or number, where: None)."""
    missing = np.isnan(places).any(axis=1)
    beyond = ~(np.abs(places) <= LARGEST) & ~np.isnan(places)
    if beyond.any():
        row, axis = np.argwhere(beyond)[0]
        place = f"point {row + 1}" if where is None else f"line {where[row]}"
        raise ValueError(
            f"{place}: {'xyz'[axis]} = {places[row, axis]:.4g} mm is beyond {LARGEST:.0f} mm; state another unit in "
            "the heading, or leave out what was not measured"
        )
    return Points(places[~missing], int(missing.sum()), columns)


def read_text(data: bytes) -> Points:
    """The points of text; ValueError says in a sentence what is wrong with it, and in which line."""
    every = [(number, line.strip(" ")) for number, line in enumerate(decoded(data).splitlines(), 1) if line.strip()]
    if every and re.match(r"zygo\b.*\bdata file", every[0][1], re.IGNORECASE):
        return _read_zygo(every)
    if every and (named := re.fullmatch(r"sep=(.)", every[0][1].strip())):  # Excel's statement of its separator
        every = every[1:]
    forced = named[1] if every and named else ""
    heading = _heading([line for _, line in every[:HEADING]])
    after = every[heading.lines :]
    lines = [(number, line) for number, line in after if line[0] not in "#%" and not line.startswith("//")]
    if not heading.lines:
        lines = _without_title(lines)
    if not lines:
        raise ValueError(f"holds no points; {ASKED}")
    layout = _Layout.of(lines[0][1], forced)
    if not heading.lines:  # then a tab before a line is no empty column
        lines = [(number, line.lstrip("\t")) for number, line in lines]
    if heading.lines:
        columns = heading.columns
        _hold_to(heading, lines, layout)
    else:
        columns = _columns_without_heading(lines, layout)
    places = _table(lines, layout, columns) * heading.units
    return measured(places, [number for number, _ in lines], heading.taken)


def _read_zygo(every: list[tuple[int, str]]) -> Points:
    """The points of a Zygo XYZ file by its numbered lines: pixel column, pixel row and height in µm.

    MetroPro Reference Guide, ASCII data file format: the seventh number of line 8 is the width of a pixel in metres,
    0 if the lateral scale was not calibrated.  Points stand between two lines #.  Rows are counted from the top; where
    an instrument counts them from below, the alignment finds y mirrored.
    """
    marks = [place for place, (_, line) in enumerate(every) if line == "#"]
    if "xyz" not in every[0][1].lower() or not marks:
        raise ValueError("is a Zygo data file without a table of x, y and z; export it as a Zygo XYZ file")
    stated = [_number(field) for number, line in every[: marks[0]] if number == 8 for field in line.split()]
    pixel = stated[6] if len(stated) > 6 else None
    if pixel is None or not 0 < pixel < 1:
        raise ValueError(
            "is a Zygo XYZ file, whose x and y count pixels, and its header states no width of a pixel (seventh number "
            "of line 8, in metres); calibrate the lateral scale of the instrument and export again, or give x and y "
            "in mm under a heading such as x [mm],y [mm],z [\u00b5m]"
        )
    lines = [(number, line) for number, line in every[marks[0] + 1 :] if line != "#"]
    if not lines:
        raise ValueError(f"holds no points; {ASKED}")
    width = 1e3 * pixel
    places = _table(lines, _Layout(None, False), (0, 1, 2)) * [width, -width, 1e-3]
    columns = f"x (pixels of {width:.4g} mm), y (rows of pixels from the top) and z (\u00b5m)"
    return measured(places, [number for number, _ in lines], columns)


def decoded(data: bytes) -> str:
    """Text of bytes: UTF-8, UTF-16, or Windows-1252; ValueError if it is none."""
    for start, what in FORMATS.items():
        if data.startswith(start):
            raise ValueError(f"is {what}; {ASKED}, as text, PLY or STL")
    encoding, sample = "utf-8-sig", data[:400]
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        encoding = "utf-16"
    elif sample[1::2].count(0) > len(sample) / 4 or sample[::2].count(0) > len(sample) / 4:  # each second byte is 0
        encoding = "utf-16-le" if sample[1::2].count(0) > sample[::2].count(0) else "utf-16-be"
    elif re.search(rb"[\x00-\x08\x0e-\x19\x1b-\x1f]", data):
        raise ValueError(f"is no text; {ASKED}, or a PLY or STL file under its own ending")
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        if encoding == "utf-8-sig":
            return data.decode("cp1252", errors="replace")
        raise ValueError(f"is no text in UTF-16 ({error.reason} at byte {error.start}); save it as UTF-8") from None


# ---- separators and numbers ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Layout:
    """How the numbers of a line are written."""

    separator: str | None  # None: blanks
    decimal_comma: bool

    @classmethod
    def of(cls, line: str, forced: str = "") -> _Layout:
        """The layout of a line; forced: its separator, where the file states it."""
        mark = forced or next((mark for mark in (";", "\t") if mark in line), None)
        if mark is not None:
            return cls(mark, mark != ",")
        blanks = NO_DATA_FIELD.sub("nan", line).split()
        with_comma = [word for word in blanks if re.fullmatch(NUMBER_WITH_COMMA, word)]
        if len(with_comma) >= 2 and len(blanks) >= 3:  # 1,5 2,25 3,0
            return cls(None, True)
        return cls("," if "," in line else None, False)

    def plain(self, text: str) -> str:
        """Text whose numbers are those of Python, and whose fields without data are nan."""
        words = OTHER_THAN_NUMBERS.search(text) is not None
        text = NO_DATA_FIELD.sub("nan", text) if words else text
        if self.decimal_comma:
            text = text.replace(",", ".")
        elif '"' in text:
            text = QUOTED_COMMA.sub(r'"\1.\2"', text)
        if self.separator is not None and EMPTY.search(f"{text}\n".replace(self.separator, ";")):
            mark = re.escape(self.separator)
            text = re.sub(rf'(?:^|(?<={mark}))[ ]*(?:"[ ]*")?(?={mark}|$)', "nan", text, flags=re.MULTILINE)
        return FORTRAN.sub("e", text) if words else text

    def fields(self, line: str) -> list[str]:
        """The fields of a line without the empty ones at its end, numbers as Python has them."""
        if self.separator is None:
            return self.plain(line).split()
        line = line.rstrip(f"{self.separator} ")
        if '"' in line:
            line = self.plain(line)
            return next(csv.reader([line], delimiter=self.separator, skipinitialspace=True))
        return [field.strip() for field in self.plain(line).split(self.separator)]


def _number(field: str) -> float | None:
    """The number of a field; None if it is none."""
    try:
        return float(field)
    except ValueError:
        return None


def _table(lines: list[tuple[int, str]], layout: _Layout, columns: Sequence[int]) -> np.ndarray:
    """(n, 3) of three columns."""
    body = layout.plain("\n".join(line for _, line in lines))
    how = {"delimiter": layout.separator, "comments": None, "ndmin": 2, "quotechar": '"'}
    try:
        return np.loadtxt(io.StringIO(body), usecols=columns, **how)
    except ValueError:
        for number, line in lines:
            fields = layout.fields(line)
            if layout.separator is not None:
                fields += ["nan"] * (line.count(layout.separator) + 1 - len(fields))
            if len(fields) <= max(columns) or any(_number(fields[column]) is None for column in columns):
                raise ValueError(f"line {number} is not three numbers ({line[:40]!r}); {ASKED}") from None
        raise ValueError(f"is no table of numbers from line {lines[0][0]} on; {ASKED}") from None


# ---- columns ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Heading:
    """The heading of a table."""

    lines: int = 0  # up to and with it; 0: there is none
    columns: tuple[int, ...] = (0, 1, 2)  # places of x, y and z in a line
    units: np.ndarray | float = 1.0  # mm, one for all columns or one each
    fields: int = 3
    taken: str = ""  # the actual columns, where there are nominal ones, too


def _heading(lines: list[str]) -> _Heading:
    """The heading among the first lines."""
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
                    f"line {row + 1}: its heading, {line[:60]!r}, names nominal coordinates alone; give the measured "
                    "ones, as x, y and z or as x act, y act and z act"
                )
            continue
        if len(chosen) > 3:
            raise ValueError(f"its heading, {line[:60]!r}, names x, y or z twice; name three columns so")
        columns, _, _, units = zip(*sorted(chosen, key=lambda column: column[2]), strict=True)
        taken = ", ".join(words[column].strip().strip("'\"") for column in columns)
        beside = nominal or len(chosen) < len(actual + others)
        return _Heading(
            row + 1, columns, np.array(units), fields=len(words), taken=taken if beside else ""
        )
    return _Heading()


def _words(line: str) -> list[str]:
    """The names of columns in a heading."""
    mark = next((mark for mark in (";", "\t", ",") if mark in line), None)
    if '"' in line and mark is not None:
        return next(csv.reader([line], delimiter=mark, skipinitialspace=True))
    return line.split(mark)


def _coordinate(word: str) -> tuple[str, str, float] | None:
    """("actual", "nominal" or "", "x", "y" or "z", its unit in mm) of the heading of a column such as "X [mm]".

    None if it is no coordinate; ValueError for a unit that is none of WRITTEN.
    """
    parts = re.findall(r"[a-z\u00b5\u03bc]+|\"", word.strip().strip("'\"").lower())
    words = [piece for part in parts for piece in _apart(part)]
    axis = [part for part in words if part in ("x", "y", "z")]
    roles = {"actual": ACTUAL.intersection(words), "nominal": NOMINAL.intersection(words)}
    rest = [part for part in words if part not in BESIDE | ACTUAL | NOMINAL and part not in axis]
    if len(axis) != 1 or len(rest) > 1 or all(roles.values()):
        return None
    if rest and rest[0] not in WRITTEN:
        if re.search(r"[\[(/]", word):
            raise ValueError(f"its heading, {word.strip()[:60]!r}, has a unit that is not known; give mm")
        return None
    return next((role for role, found in roles.items() if found), ""), axis[0], WRITTEN[rest[0]] if rest else 1.0


def _apart(word: str) -> tuple[str, ...]:
    """ "xact" and "actx" as two words."""
    for axis, role in ((word[:1], word[1:]), (word[-1:], word[:-1])):
        if axis in ("x", "y", "z") and role in ACTUAL | NOMINAL:
            return axis, role
    return (word,)


def _hold_to(heading: _Heading, lines: list[tuple[int, str]], layout: _Layout) -> None:
    """ValueError for a line of more fields than the heading has: then columns are not what it says."""
    mark = layout.separator
    for number, line in lines:
        most = len(line.split()) if mark is None else line.count(mark) + 1
        if most <= heading.fields:  # the usual case, without a look at each field
            continue
        if (count := len(layout.fields(line))) > heading.fields:
            raise ValueError(
                f"line {number} holds {count} fields where its heading names {heading.fields} columns; write decimals "
                "with points, and a name in one word or in quotes"
            )


def _without_title(lines: list[tuple[int, str]]) -> list[tuple[int, str]]:
    """The lines from the first one on that holds numbers, which the lines before do not tell apart."""
    for row, (number, line) in enumerate(lines[:HEADING]):
        layout = _Layout.of(line)
        count = sum(_number(field) is not None for field in layout.fields(line))
        if count >= 2:
            if row and len(layout.fields(line)) == len(_words(lines[row - 1][1])) and lines[row - 1][0] == number - 1:
                title = lines[row - 1][1]
                raise ValueError(f"its heading, {title[:60]!r}, names no x, y and z; name these three columns so")
            return lines[row:]
    return lines


def _columns_without_heading(lines: list[tuple[int, str]], layout: _Layout) -> tuple[int, ...]:
    """The three columns of numbers of a table beside names of the points, or behind a column that counts them."""
    sample = [layout.fields(line) for _, line in lines[:SAMPLED]]
    count, first = max(map(len, sample)), lines[0][0]
    numbers = [
        column
        for column in range(count)
        if 2 * sum(column < len(row) and _number(row[column]) is not None for row in sample) > len(sample)
    ]
    if len(numbers) == 4 and _counts([row[numbers[0]] for row in sample if len(row) > numbers[0]]):
        numbers = numbers[1:]
    if len(numbers) > 3:
        raise ValueError(
            f"line {first} holds {count} columns, and no heading says which are x, y and z; put one above them, such "
            "as x,y,z,nx,ny,nz, or give these three alone"
        )
    if len(numbers) < 3:
        raise ValueError(f"line {first} holds {len(numbers)} number{'s' * (len(numbers) != 1)}; {ASKED}")
    if len(lines) > SAMPLED:
        _hold_to(_Heading(fields=count), lines, layout)
    return tuple(numbers)


def _counts(fields: list[str]) -> bool:
    """Does a column number the points: 0, 1, 2 … or 1, 2, 3 …?"""
    values = [int(field) for field in fields if re.fullmatch(r"\d+", field)]
    return len(values) == len(fields) > 2 and values[0] in (0, 1) and all(b - a == 1 for a, b in pairwise(values))
