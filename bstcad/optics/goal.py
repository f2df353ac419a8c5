"""A goal: a picture on a receiver, which a lens shall throw there, and how much it matters."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from bstcad.optics.irradiance import Screen  # which loads torch


@dataclass(frozen=True, eq=False)
class Goal:
    """A picture on a receiver."""

    key: str  # the name by which sentences and report.json call it: target, or target[0], target[1], … of several
    receiver: Screen  # where its light is collected
    picture: np.ndarray  # (rows, columns), row 0 = y max: the light wanted in each pixel, of sum 1
    weight: float = 1.0  # the weight of its RRMSD² among all goals
    reachable: np.ndarray | None = None  # (rows, columns) True in the pixels that light can reach; None: all to be lit
    whole: np.ndarray | None = None  # the picture before it was restricted to `reachable`; None: `picture` is whole

    @property
    def suffix(self) -> str:
        """Behind the names of its checks: which of several goals it is."""
        return suffix_of(self.key)

    @property
    def words(self) -> str:
        """The goal in a sentence."""
        return words_of(self.key)

    def restricted(self, part: np.ndarray | None) -> Goal:
        """The goal with the light of its picture in the pixels in which `part` is True; None: itself."""
        if part is None:
            return self
        return replace(self, picture=restricted(self.picture, part), reachable=part, whole=self.picture)


def restricted(picture: np.ndarray, part: np.ndarray | None) -> np.ndarray:
    """A picture (rows, columns) of the same sum, dark but for the pixels in which `part` is True; None: itself."""
    if part is None:
        return picture
    kept = np.where(part, picture, 0.0)
    return kept * (picture.sum() / (kept.sum() or 1.0))


def suffix_of(key: str) -> str:
    """Behind a name: which of several goals it is of; nothing where there is one."""
    return "" if key == "target" else f", {key}"


def words_of(key: str) -> str:
    """A goal in a sentence, by its key."""
    return "the target" if key == "target" else key


def worst(rrmsds: Iterable[float | None]) -> int:
    """The number of the goal with the largest RRMSD, whose figures stand for all; None, NaN: no light falls on it."""
    known = [math.inf if each is None or math.isnan(each) else each for each in rrmsds]
    return known.index(max(known))
