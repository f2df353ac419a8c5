"""The points of a STEP file, taken out of its text by one pass over its bytes.

Nearly all entities of a lens are control points.  With regular expressions for them, too, a file of 513 x 513 points
takes 0.95 s of CPU, with this pass 0.34 s.  The number strings are left to numpy, and the rest of the file, statements
of the solid and the references of the net, to the expressions of part21.py.
"""

from __future__ import annotations

import re

import numpy as np
from numba import njit

BLANK = np.array([chr(code).isspace() for code in range(256)])
BEGIN = np.frombuffer(b"=CARTESIAN_POINT('',(", np.uint8)  # what stands between the number of a point and its first
END = np.frombuffer(b"));", np.uint8)
LONGEST = 18  # digits of an entity's number: one of 64 bits
LONGEST_REAL = 64  # characters of a coordinate
START, STOP = re.compile(rb"DATA\s*;"), b"ENDSEC"


def taken_out(data: bytes) -> tuple[bytes, np.ndarray, np.ndarray]:
    """(the rest of the text, the entities' numbers (n,), x, y and z (n, 3)) of the points in space without a name.

    Of a file's DATA section; a point in any other form stays in the rest.
    """
    start = START.search(data)
    stop = data.rfind(STOP)
    if start is None or stop < start.end():
        return data, np.empty(0, np.int64), np.empty((0, 3))
    text = np.frombuffer(data, np.uint8)
    rest, reals = np.empty(len(text), np.uint8), np.empty(len(text), np.uint8)
    numbers = np.empty(data.count(b"CARTESIAN_POINT"), np.int64)
    sizes = _taken_out(text, start.end(), stop, BLANK, BEGIN, END, rest, reals, numbers)
    reals.flags.writeable = False  # so that no copy of it need be made
    xyz = np.fromstring(reals[: sizes[1]], dtype=np.float64, sep=",")  # each ends with a comma
    return rest[: sizes[0]].tobytes(), numbers[: sizes[2]].copy(), xyz.reshape(-1, 3)


def references(data: bytes) -> np.ndarray:
    """The numbers of the entities that a text without strings refers to, as often as it does; of too long ones -1."""
    numbers = np.empty(data.count(b"#"), np.int64)
    return numbers[: _references(np.frombuffer(data, np.uint8), numbers)]


@njit(cache=True, nogil=True)
def _references(text, numbers):
    count, i = 0, 0
    while i < text.size:
        i += 1
        if text[i - 1] == 35:  # #
            number, digits = 0, 0
            while i < text.size and 48 <= text[i] <= 57:
                number, digits, i = number * 10 + (text[i] - 48), digits + 1, i + 1
            if digits > 0:
                numbers[count] = number if digits <= LONGEST else -1
                count += 1
    return count


@njit(cache=True, nogil=True)
def _taken_out(text, start, stop, blank, begin, end, rest, reals, numbers):
    """Copies `text` to `rest` without comments and points, whose coordinates go to `reals`, a comma behind each.

    Returns the lengths of rest, reals and numbers.  A point begins behind a semicolon that stands in no string.
    """
    kept, written, count = 0, 0, 0
    in_string, begins = False, False
    i = 0
    while i < text.size:
        c = text[i]
        if begins and c == 35 and start <= i < stop:  # #
            after, used, number = _point(text, i + 1, stop, blank, begin, end, reals, written)
            if after > 0:
                numbers[count] = number
                count += 1
                written = used
                i = after
                continue
        if c == 39:  # '
            in_string = not in_string
        if not in_string and c == 47 and i + 1 < text.size and text[i + 1] == 42:  # /*
            i += 2
            while i + 1 < text.size and not (text[i] == 42 and text[i + 1] == 47):  # */
                i += 1
            i += 2
            continue
        if not blank[c]:
            begins = c == 59 and not in_string  # ;
        rest[kept] = c
        kept += 1
        i += 1
    return kept, written, count


@njit(cache=True, nogil=True)
def _point(text, i, stop, blank, begin, end, reals, written):
    """(place behind the point whose number begins at i, place behind its reals, its number); (0, 0, 0) for no point."""
    number, digits = 0, 0
    while i < stop:
        c = text[i]
        if 48 <= c <= 57 and digits < LONGEST and (digits > 0 or c > 48):
            number = number * 10 + (c - 48)
            digits += 1
        elif not blank[c]:
            break
        i += 1
    i = _behind(text, i, stop, blank, begin)
    if digits == 0 or i == 0:
        return 0, 0, 0
    for axis in range(3):
        i, written = _real(text, i, stop, blank, reals, written)
        if i == 0 or (axis < 2 and text[i] != 44):  # ,
            return 0, 0, 0
        if axis < 2:
            i += 1
        reals[written] = 44
        written += 1
    i = _behind(text, i, stop, blank, end)
    return (i, written, number) if i > 0 else (0, 0, 0)


@njit(cache=True, nogil=True)
def _behind(text, i, stop, blank, word):
    """The place behind a word that begins at i, or after blanks; 0 for another."""
    k = 0
    while k < word.size:
        if i >= stop:
            return 0
        if text[i] == word[k]:
            k += 1
            if k < word.size and word[k - 1] == 39 and word[k] == 39 and text[i + 1] != 39:
                return 0  # a string of blanks is no empty one
        elif not blank[text[i]]:
            return 0
        i += 1
    return i


@njit(cache=True, nogil=True)
def _real(text, i, stop, blank, reals, written):
    """(place of what stands behind a real, place behind its copy); (0, 0) for none: sign, digits, a point, exponent."""
    begun = written
    part, digits = 0, 0  # 0: before the digits, 1: among them, 2: behind the point, 3: behind E, 4: in the exponent
    while i < stop:
        c = text[i]
        if blank[c]:
            i += 1
            continue
        if c == 43 or c == 45:  # + -
            if part != 0 and part != 3:
                break
            part += 1
            digits = 0
        elif 48 <= c <= 57:
            if part == 0 or part == 3:
                part += 1
                digits = 0
            digits += 1
        elif c == 46:  # .
            if part != 1 or digits == 0:
                return 0, 0
            part = 2
        elif c == 69:  # E
            if part != 2:
                return 0, 0
            part, digits = 3, 0
        else:
            break
        reals[written] = c
        written += 1
        i += 1
    if part < 2 or part == 3 or (part == 4 and digits == 0) or written - begun > LONGEST_REAL:
        return 0, 0
    return i, written
