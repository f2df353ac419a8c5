"""Interface of a judge: a module that traces a lens by a program not written here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from bstcad.judges.faces import Off
from bstcad.optics.channels import Channel
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens


@dataclass(frozen=True, eq=False)
class Seen:
    """A picture of the light on a screen, by a program not written here."""

    halves: np.ndarray = field(repr=False)  # (2, rows, columns) flux a pixel, row 0 = y max, each of all light
    rays: int  # of both halves
    off: Off  # of its faces, the worse of the two, against the lens's
    by: str = ""  # the program's variant, if it has several

    @property
    def picture(self) -> np.ndarray:
        """(rows, columns) mean of both halves."""
        return self.halves.mean(axis=0)


class Judge(Protocol):
    """Functions of the module of a judge."""

    def cannot(self, lens: Lens, channels: Sequence[Channel], screen: Screen) -> str:
        """Why it cannot trace this light, in a sentence; "": it can."""

    def light(self, lens: Lens, channels: Sequence[Channel]) -> tuple[Channel, ...]:
        """The channels with the losses that it simulates."""

    def trace(self, lens: Lens, channels: Sequence[Channel], screen: Screen, rays: int, seed: int) -> Seen:
        """The picture on a screen of square pixels by that many rays, in two halves."""
