"""Size of the smallest cell on which the light of a lens is still right.

The RRMSD is measured on cells of several sizes (optics.trace.measure.CellError), since light that is right on the
pixels of the target may vary inside them.  On cells narrower than the image of the real source, the RRMSD with its size
counts.
"""

from __future__ import annotations

from collections.abc import Sequence

from bstcad.optics.trace.measure import CellError

MAX_GROWTH = 1.5  # largest RRMSD on a cell / RRMSD on pixels at which the light on the cell counts as right
SMALL_RRMSD = 0.03  # RRMSD up to which the light on a cell counts as right, whatever the RRMSD on pixels is


def is_right(rrmsd: float, on_pixels: float) -> bool:
    """Return True if an RRMSD on a cell is at most MAX_GROWTH times that on pixels, or at most SMALL_RRMSD."""
    return rrmsd <= max(MAX_GROWTH * on_pixels, SMALL_RRMSD)


def right_down_to(errors: Sequence[CellError]) -> float | None:
    """Return the side (pixels) of the smallest cell such that the light is right on it and on all larger ones.

    None: the errors were not measured, or the light is not even right on the largest cells.
    """
    on_pixels = next((each.rrmsd for each in errors if each.cell == 1), None)
    smallest = None
    for each in sorted(errors, key=lambda error: -error.cell):
        if on_pixels is None or not is_right(each.counted, on_pixels):
            break
        smallest = each.cell
    return smallest
