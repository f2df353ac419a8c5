"""Lines of text from rows of numbers, equal to the bytes of Python's %.10g but seven times faster, for 3MF files."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numba import njit

FORMAT = b"%.10g"
ROWS_PER_BLOCK = 1 << 15  # number of rows that are formatted at a time, so that their text stays in the cache
MAX_NUMBER_BYTES = 17  # upper bound of the length of a number by FORMAT (bytes)
TEN_DIGITS, MAX_EXACT_POWER = 1e9, 13  # smallest number of ten digits, and exponent that gives any number ten digits
POWERS = 10.0 ** np.arange(MAX_EXACT_POWER + 1)  # exact in float64
SMALLEST, LARGEST = 1e-4, 1e9  # limits of the absolute values, except integers, that the kernel formats


def format_rows(line: bytes, rows: np.ndarray) -> Iterator[bytes]:
    """Yield `line` formatted with each row of numbers (n, k), in blocks; line: text that has FORMAT k times."""
    ends = np.cumsum([0, *map(len, line.split(FORMAT))])
    words = np.frombuffer(line.replace(FORMAT, b""), np.uint8)
    text = np.empty(ROWS_PER_BLOCK * (len(line) + MAX_NUMBER_BYTES * rows.shape[1]), np.uint8)
    for first in range(0, len(rows), ROWS_PER_BLOCK):
        part = rows[first : first + ROWS_PER_BLOCK]
        left, start = _format_backwards(part, words, ends, text, len(text))
        while left:
            row = np.frombuffer(line % tuple(part[left - 1].tolist()), np.uint8)
            start -= len(row)
            text[start : start + len(row)] = row
            left, start = _format_backwards(part[: left - 1], words, ends, text, start)
        yield text[start:].tobytes()


@njit(cache=True, nogil=True)
def _format_backwards(rows, words, ends, text, at):
    """Write lines of words and numbers in front of index `at` of the text, the last row and the last digit first.

    ends: indices in `words` at which a word ends and the next begins.  Returns (number of rows that are left, index of
    the first byte).  The last row that is left has a number that Python must format.
    """
    for i in range(len(rows) - 1, -1, -1):
        end = at
        for j in range(rows.shape[1], -1, -1):
            for k in range(ends[j + 1] - 1, ends[j] - 1, -1):
                at -= 1
                text[at] = words[k]
            if j > 0:
                value = float(rows[i, j - 1])
                digits, decimals = _decimal(abs(value))
                if digits < 0:
                    return i + 1, end
                at = _put(digits, decimals, math.copysign(1.0, value) < 0.0, text, at)
    return 0, at


@njit(inline="always")
def _decimal(size):
    """Return (digits, decimals) of a number rounded to ten digits, size = digits / 10^decimals; (-1, 0): unknown.

    The product with a power of ten is rounded by less than its own last bit.  Since half of the last digit is a
    multiple of this bit, only a product that is exactly in the middle between two integers may be rounded wrongly.
    """
    if size < LARGEST and size == math.floor(size):
        return int(size), 0
    if not SMALLEST <= size < LARGEST:
        return -1, 0
    decimals = 1
    while size * POWERS[decimals] < TEN_DIGITS:
        decimals += 1
    product = size * POWERS[decimals]
    digits = int(product)
    rest = product - digits
    if rest == 0.5:
        return -1, 0
    if rest > 0.5:
        digits += 1
    while decimals > 0 and digits % 10 == 0:
        digits //= 10
        decimals -= 1
    return digits, decimals


@njit(inline="always")
def _put(digits, decimals, negative, text, at):
    """Write digits / 10^decimals in front of index `at` of the text; return the index of its first byte."""
    written = 0
    while written <= decimals or digits > 0:
        if written == decimals and decimals > 0:
            at -= 1
            text[at] = 46  # the decimal point
        at -= 1
        text[at] = 48 + digits % 10
        digits //= 10
        written += 1
    if negative:
        at -= 1
        text[at] = 45  # the minus sign
    return at
