"""The points in space of a STEP file, nearly all of its text, found by a compiled loop.

One is #n=CARTESIAN_POINT('',(x,y,z)); behind a semicolon, n as syntax.NAME and each coordinate as syntax.REAL; what is
written otherwise is left to the patterns there.
"""

from __future__ import annotations

import numpy as np
from numba import njit

WORD = np.frombuffer(b"=CARTESIAN_POINT('',(", np.uint8)
DIGITS = 18  # of an entity's number
EXACT = 1 << 53  # whole numbers up to here are exact in float64 …
POWERS = 10.0 ** np.arange(23)  # … and so are these; then one product or quotient of the two is rounded once: rightly


def take(section: str) -> tuple[np.ndarray, np.ndarray, str]:
    """(numbers (n,), x y z (n, 3), the text without them) of the points in a text without blanks, in its order."""
    text = np.frombuffer(section.encode("latin-1", "replace"), np.uint8)
    most = section.count("=CARTESIAN_POINT(")
    numbers, xyz, hard = np.empty(most, np.int64), np.empty((most, 3)), np.empty((3 * most, 3), np.int64)
    rest = np.empty_like(text)
    count, length, left = _take(text, WORD, POWERS, numbers, xyz, hard, rest)
    flat = xyz.reshape(-1)
    for place, first, last in hard[:left].tolist():  # more digits than a product of two exact numbers gives rightly
        flat[place] = float(section[first:last])
    return numbers[:count], xyz[:count], rest[:length].tobytes().decode("latin-1")


@njit(cache=True, nogil=True)
def _take(text, word, powers, numbers, xyz, hard, rest):
    """Fill the arrays; how many points there are, bytes of the rest, and numbers that are left to be read exactly."""
    count = length = left = at = 0
    while at < len(text):
        if text[at] == ord("#") and at > 0 and text[at - 1] == ord(";"):
            end, found = _point(text, at, word, powers, numbers, xyz, hard, count, left)
            if end > 0:
                count, left, at = count + 1, found, end
                continue
        rest[length] = text[at]
        length += 1
        at += 1
    return count, length, left


@njit
def _point(text, at, word, powers, numbers, xyz, hard, count, left):
    """Read the point that begins at `at`: (where it ends, 0 if it is none; hard numbers so far)."""
    number, start = 0, at + 1
    at = start
    while at < len(text) and 48 <= text[at] < 58 and at - start < DIGITS:
        number = 10 * number + (text[at] - 48)
        at += 1
    if at == start or text[start] == 48 or at + len(word) > len(text):
        return 0, left
    for k in range(len(word)):
        if text[at + k] != word[k]:
            return 0, left
    at += len(word)
    for axis in range(3):
        first = at
        at, value, exact = _real(text, at, powers)
        if at == 0 or at >= len(text) or text[at] != (ord(")") if axis == 2 else ord(",")):
            return 0, left
        xyz[count, axis] = value
        if not exact:
            hard[left, 0], hard[left, 1], hard[left, 2] = 3 * count + axis, first, at
            left += 1
        at += 1
    if at + 1 >= len(text) or text[at] != ord(")") or text[at + 1] != ord(";"):
        return 0, left
    numbers[count] = number
    return at + 2, left


@njit
def _real(text, at, powers):
    """(where the number at `at` ends, 0 if there is none; its value; is that rounded rightly?)."""
    negative = at < len(text) and text[at] == ord("-")
    if at < len(text) and (text[at] == ord("-") or text[at] == ord("+")):
        at += 1
    whole, exponent, zeros, exact, first = np.int64(0), 0, 0, True, at
    point = -1
    while at < len(text) and (48 <= text[at] < 58 or (text[at] == ord(".") and point < 0)):
        if text[at] == ord("."):
            if at == first:
                return 0, 0.0, False
            point = at
        elif text[at] == 48:
            zeros += 1  # of which those at the end do not count
        else:
            for _ in range(min(zeros + 1, 19)):
                exact &= whole < EXACT // 10
                whole = 10 * whole if exact else whole
            whole, zeros = whole + (text[at] - 48), 0
        at += 1
    if point < 0:
        return 0, 0.0, False
    exponent = zeros - (at - point - 1)
    if at < len(text) and text[at] == ord("E"):
        at += 1
        sign = -1 if at < len(text) and text[at] == ord("-") else 1
        if at < len(text) and (text[at] == ord("-") or text[at] == ord("+")):
            at += 1
        first, power = at, 0
        while at < len(text) and 48 <= text[at] < 58:
            power = min(10 * power + (text[at] - 48), 100_000)
            at += 1
        if at == first:
            return 0, 0.0, False
        exponent += sign * power
    value = 0.0
    if whole > 0:
        exact &= abs(exponent) < len(powers)
        if exact:
            value = whole * powers[exponent] if exponent >= 0 else whole / powers[-exponent]
    return at, -value if negative else value, exact
