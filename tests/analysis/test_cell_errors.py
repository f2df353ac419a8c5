"""The light is right down to the smallest cell such that its error on it and on all larger cells is small enough."""

from __future__ import annotations

import pytest

from bstcad.analysis.cell_errors import is_right, right_down_to
from bstcad.optics.trace.measure import CellError

SIZES = (4.0, 2.0, 1.0, 0.5, 0.25)


def errors(*rrmsds, **blurred):
    """Return the errors on cells of SIZES; blurred: RRMSD with the real source, by "pixel", "half" or "quarter"."""
    real = {{"pixel": 1.0, "half": 0.5, "quarter": 0.25}[name]: value for name, value in blurred.items()}
    return [CellError(size, rrmsd, 1e-4, real.get(size)) for size, rrmsd in zip(SIZES, rrmsds, strict=False)]


@pytest.mark.parametrize(
    ("found", "cell"),
    [
        (errors(0.08, 0.09, 0.10, 0.149, 0.151), 0.5),  # 1.5 times 0.1
        (errors(0.08, 0.09, 0.10, 0.30, 0.12), 1.0),  # a smaller cell does not count beyond a larger one that fails
        (errors(0.002, 0.002, 0.002, 0.01, 0.0299), 0.25),  # at most 0.03
        (errors(0.002, 0.002, 0.002, 0.01, 0.0301), 0.5),
        (errors(0.08, 0.09, 0.10, 0.12), 0.5),  # the quarter was not measured
        (errors(0.2, 0.09, 0.10, 0.12), None),
        (errors(0.02, 0.02, 0.02, 0.2, 0.3, half=0.025, quarter=0.029), 0.25),  # the real source blurs the stripes
        (errors(0.02, 0.02, 0.02, 0.02, 0.02, pixel=0.2, half=0.2, quarter=0.2), 2.0),  # and the picture, too
        ([], None),
    ],
)
def test_the_smallest_cell_follows_from_the_errors(found, cell):
    assert right_down_to(found) == cell
    assert right_down_to(found[::-1]) == cell  # in any order


def test_an_error_is_right_by_its_ratio_or_if_it_is_small():
    assert is_right(0.03, 0.001) and not is_right(0.031, 0.02) and is_right(0.15, 0.1) and not is_right(0.151, 0.1)
