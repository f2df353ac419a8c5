"""What a judge says: a picture in two halves, and how it holds the lens."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bstcad.judges.faces import Off


@dataclass(frozen=True, eq=False)
class Seen:
    """A picture of the light on a screen, by a program not written here."""

    halves: np.ndarray = field(repr=False)  # (2, rows, columns) flux a pixel, row 0 = y max, each of all light
    rays: int  # of both halves
    off: Off  # of its faces, the worse of the two, against the lens's
    by: str = ""  # how it was made, where there is a choice

    @property
    def picture(self) -> np.ndarray:
        """(rows, columns) of both halves."""
        return self.halves.mean(axis=0)
