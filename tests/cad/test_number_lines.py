"""Rows of numbers as text: the bytes of Python's own format, for any number."""

import numpy as np
import pytest

from bstcad.cad.number_lines import ROWS_PER_BLOCK, format_rows

LINE = b'<v x="%.10g" y="%.10g"/>\n'
RANDOM = np.random.default_rng(0)
TEN_DIGITS = RANDOM.integers(10**9, 10**10, (20_000, 2))


@pytest.mark.parametrize(
    "rows",
    [
        RANDOM.normal(size=(3 * ROWS_PER_BLOCK // 2, 2)),
        RANDOM.normal(size=(20_000, 2)) * 10 ** RANDOM.uniform(-8, 12, (20_000, 2)),
        np.round(RANDOM.uniform(-50, 50, (20_000, 2)), 3),
        RANDOM.integers(-2_000_000, 2_000_000, (20_000, 2)).astype(np.int32),
        TEN_DIGITS // 10 + 0.25,  # exactly in the middle between two numbers of ten digits
        (TEN_DIGITS + 0.5) / 1e8,
        np.nextafter((TEN_DIGITS + 0.5) / 1e8, 0),
        np.array([[0.0, -0.0], [999999999.5, 0.99999999995], [9.99999999996e-5, 1e-4], [1e10, -1e300]]),
        np.zeros((0, 2)),
    ],
    ids=["two blocks", "all sizes", "decimals", "integers", "halves", "near halves", "below halves", "special", "none"],
)
def test_the_text_is_that_of_python(rows):
    assert b"".join(format_rows(LINE, rows)) == (LINE * len(rows)) % tuple(rows.ravel().tolist())
