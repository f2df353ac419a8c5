"""Framing: how a picture lies on its target, and what of it falls into each pixel.

Row 0 of an array is the top, column 0 the left, as a person sees it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import torch
from scipy.sparse import csr_array

from bstcad.optics.outlines import Outline

STRIP = 256  # rows of a picture in work at a time


@dataclass(frozen=True)
class Turn:
    """A picture mirrored left to right or not, and then turned counterclockwise by quarters."""

    mirror: bool = False
    quarters: int = 0

    def then(self, other: Turn) -> Turn:
        """This one and then the other; mirrored, a turn goes the other way round."""
        before = -self.quarters if other.mirror else self.quarters
        return Turn(self.mirror != other.mirror, (before + other.quarters) % 4)

    def of(self, picture: np.ndarray) -> np.ndarray:
        """The picture turned."""
        return np.rot90(picture[:, ::-1] if self.mirror else picture, self.quarters)

    @property
    def lays_down(self) -> bool:
        """Do width and height change places?"""
        return self.quarters % 2 == 1


EXIF = {  # a camera's orientation: what makes the stored picture upright
    2: Turn(True), 3: Turn(False, 2), 4: Turn(True, 2), 5: Turn(True, 1), 6: Turn(False, 3), 7: Turn(True, 3),
    8: Turn(False, 1),
}  # fmt: skip


@dataclass(frozen=True)
class Frame:
    """What a picture has to fill, and how it is laid into it."""

    columns: int
    rows: int
    width: float  # mm
    height: float  # mm
    fit: str = "crop"  # crop | pad | stretch, where the picture has other proportions
    turn: Turn = Turn()  # of the upright picture

    def lying(self) -> Self:
        """With width and height changed."""
        return type(self)(self.rows, self.columns, self.height, self.width, self.fit, self.turn)

    def window(self, width: int, height: int) -> Window:
        """What of a picture of width x height pixels fills the frame: the middle of it, or more than all of it.

        Less than a pixel in excess is no other proportion.
        """
        across, down = height * self.width / self.height, width * self.height / self.width
        wide = width >= across  # for the frame; then the height is `across` frames wide
        if self.fit == "stretch" or abs(width - across if wide else height - down) < 1:
            return Window(0.0, 0.0, width, height)
        if wide == (self.fit == "crop"):
            return Window((width - across) / 2, 0.0, (width + across) / 2, height)
        return Window(0.0, (height - down) / 2, width, (height + down) / 2)

    def remark(self, width: int, height: int) -> str:
        """What `fit` does to a picture of width x height pixels, in a sentence; empty if it does nothing."""
        left, top, right, bottom = self.window(width, height)
        target = "square" if self.width == self.height else f"{self.width:g} x {self.height:g} mm"
        said = f"target.fit: the picture is {width} x {height}, the target {target}"
        stretched = (width * self.height) / (height * self.width)
        if (right - left, bottom - top) != (width, height):
            if self.fit == "pad":
                return f'{said}: kept whole, with dark strips beside it; fit = "crop" fills the target'
            size = f"{right - left:.0f} x {bottom - top:.0f}"
            return f'{said}: cropped to the middle {size}; fit = "pad" keeps it whole'
        if self.fit == "stretch" and abs(stretched - 1) * max(width, height) >= 1:
            more = 100 * (max(stretched, 1 / stretched) - 1)
            along = "upwards" if stretched > 1 else "sideways"
            return f'{said}: stretched {along} by {more:.2g} %; fit = "crop" keeps its proportions'
        return ""


class Window(NamedTuple):
    """A part of a picture, in its pixels from its top left corner; it may reach beyond."""

    left: float
    top: float
    right: float
    bottom: float


Box = tuple[int, int, int, int]  # whole pixels of a picture: left, top, right, bottom


def average(light: Callable[[Box], np.ndarray], size: tuple[int, int], window: Window, frame: Frame) -> np.ndarray:
    """(rows, columns) means of a picture of `size` over equal parts of a window, dark beyond the picture.

    Exact for any ratio of the sizes; strip by strip to spare memory: `light` gives a box's values.
    """
    width, height = size
    left, right = max(int(window.left), 0), min(int(np.ceil(window.right)), width)
    top, bottom = max(int(window.top), 0), min(int(np.ceil(window.bottom)), height)
    across = overlap(right - left, frame.columns, window.left - left, window.right - left)
    down = overlap(bottom - top, frame.rows, window.top - top, window.bottom - top)
    parts = (light(box) for box in strips(left, top, right, bottom))
    return down @ np.concatenate([(across @ part.T).T for part in parts])


def strips(left: int, top: int, right: int, bottom: int) -> Iterator[Box]:
    """A box in parts of a few rows each, from the top."""
    return ((left, start, right, min(start + STRIP, bottom)) for start in range(top, bottom, STRIP))


def overlap(size: int, pixels: int, start: float = 0.0, stop: float | None = None) -> csr_array:
    """Averaging matrix (pixels, size): the share of each of the pixels from start to stop that each input covers."""
    stop = size if stop is None else stop
    edges = start + np.arange(pixels + 1) * (stop - start) / pixels
    edges[-1] = stop
    cuts = np.union1d(np.arange(size + 1), np.clip(edges, 0, size))
    cuts = cuts[(cuts >= start) & (cuts <= stop)]
    middle = (cuts[1:] + cuts[:-1]) / 2
    to = np.clip(((middle - start) * pixels / (stop - start)).astype(int), 0, pixels - 1)
    of = np.clip(middle.astype(int), 0, size - 1)
    return csr_array((np.diff(cuts) * pixels / (stop - start), (to, of)), shape=(pixels, size))


def inside(outline: Outline, columns: int, rows: int, width: float, height: float) -> np.ndarray:
    """The share of each pixel that lies inside an outline centred in a width x height rectangle (mm)."""
    fine = max(2048 // max(columns, rows), 4)  # sub-pixels along a pixel's side
    x, y = (
        ((torch.arange(n * fine, dtype=torch.float64) + 0.5) / (n * fine) - 0.5) * size
        for n, size in ((columns, width), (rows, -height))
    )
    high = fine * max(2**20 // (columns * fine * fine), 1)  # about a million sub-pixels at a time
    bands = (outline.contains(x, band[:, None]).numpy() for band in y.split(high))
    return np.concatenate([band.reshape(-1, fine, columns, fine).mean((1, 3)) for band in bands])
