"""A goal: the picture that a lens has to project onto a receiver, and its weight."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from bstcad.optics.irradiance import Screen  # a type only: the module loads torch


@dataclass(frozen=True, eq=False)
class Goal:
    """A picture on a receiver."""

    key: str  # key in the scene, sentences and report.json: target, or target[0], target[1], … of several goals
    receiver: Screen  # screen that receives the light
    picture: np.ndarray  # (rows, columns), row 0 = y max: fraction of the flux wanted in each pixel; the sum is 1
    weight: float = 1.0  # weight of the goal's RRMSD² in the merit function
    reachable: np.ndarray | None = None  # (rows, columns), True in the pixels that light can reach; None: all pixels
    whole: np.ndarray | None = None  # (rows, columns), picture before `restricted`; None: not restricted

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
