"""A goal: the picture that a lens has to project onto a receiver, and its weight."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from bstcad.optics.receivers.irradiance import Screen  # a type only: the module loads torch


SUM_ROUNDING = 1e-9  # largest deviation from 1 of the sum of a picture that counts as rounding


@dataclass(frozen=True, eq=False)
class Goal:
    """A picture on a receiver."""

    key: str  # key in the scene, sentences and report.json: target, or target[0], target[1], … of several goals
    screen: Screen  # screen that receives the light
    picture: np.ndarray  # (rows, columns), row 0 = y max: fraction of the flux wanted in each pixel; the sum is 1
    weight: float = 1.0  # weight of the goal's RRMSD² in the merit function
    reachable: np.ndarray | None = None  # (rows, columns), True in the pixels that light can reach; None: all pixels
    whole: np.ndarray | None = None  # (rows, columns), picture before `restricted`; None: not restricted
    # function of a number k that returns the picture of cells, k along each side of a pixel, of sum 1 and before
    # `restricted`; None: `interpolated`
    cell_picture: Callable[[int], np.ndarray] | None = None
    is_shape: bool = False  # True for a profile, a uniform target or an intensity, which have no fine detail

    @property
    def suffix(self) -> str:
        """Suffix of the names of the goal's checks; empty for a single goal."""
        return suffix_of(self.key)

    @property
    def words(self) -> str:
        """Name of the goal in a sentence."""
        return words_of(self.key)

    def restricted(self, part: np.ndarray | None) -> Goal:
        """Return the goal with its picture restricted to the pixels where `part` is True; None: the goal itself."""
        if part is None:
            return self
        return replace(self, picture=restricted(self.picture, part), reachable=part, whole=self.picture)

    def on_cells(self, cells: int) -> Goal:
        """Return the goal with `cells` x `cells` cells in the place of each pixel, drawn as the picture is meant."""
        if cells == 1:
            return self
        picture = self.picture if self.whole is None else self.whole
        fine = interpolated(picture, cells) if self.cell_picture is None else self.cell_picture(cells)
        if abs(picture.sum() - 1) > SUM_ROUNDING and self.cell_picture is not None:
            fine = fine * picture.sum()
        part = self.reachable
        goal = Goal(self.key, self.screen.divided(cells), fine, self.weight, is_shape=self.is_shape)
        return goal.restricted(None if part is None else np.kron(part, np.ones((cells, cells), dtype=bool)))


def interpolated(picture: np.ndarray, cells: int) -> np.ndarray:
    """Return the flux (k rows, k columns) in k x k cells, k = `cells`, of each pixel of a picture (rows, columns).

    Along each axis the density is linear in a pixel, with the monotonised central slope (van Leer 1977): the sum of the
    cells of a pixel is the flux of the pixel, no value is negative, and black pixels stay black.
    """
    for _ in range(2):
        picture = _interpolated_rows(picture, cells).T
    return picture


def _interpolated_rows(picture: np.ndarray, cells: int) -> np.ndarray:
    step = np.diff(picture, axis=0, prepend=picture[:1], append=picture[-1:])
    before, after = step[:-1], step[1:]
    central = (before + after) / 2
    limit = 2 * np.minimum(np.abs(before), np.abs(after)) * (before * after > 0)
    slope = np.clip(central, -limit, limit)
    at = (np.arange(cells) + 0.5) / cells - 0.5  # centres of the cells, in pixels from the centre of a pixel
    parts = picture[:, None] + at[:, None] * slope[:, None]
    return parts.reshape(-1, picture.shape[1]) / cells


def restricted(picture: np.ndarray, part: np.ndarray | None) -> np.ndarray:
    """Return a picture (rows, columns) of the same sum, zero where `part` is False; part None: the picture itself."""
    if part is None:
        return picture
    masked = np.where(part, picture, 0.0)
    return masked * (picture.sum() / (masked.sum() or 1.0))


def suffix_of(key: str) -> str:
    """Return the suffix that names one of several goals; empty for a single goal."""
    return "" if key == "target" else f", {key}"


def words_of(key: str) -> str:
    """Return the name of a goal in a sentence, by its key."""
    return "the target" if key == "target" else key


def worst(rrmsds: Iterable[float | None]) -> int:
    """Return the index of the goal with the largest RRMSD; None or NaN (no light on the goal) counts as infinite."""
    known = [math.inf if each is None or math.isnan(each) else each for each in rrmsds]
    return known.index(max(known))
