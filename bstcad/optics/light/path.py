"""Search for the rays that meet given points behind the interfaces before a face: the task and its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from bstcad.optics.lens.interfaces import Interface
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.surfaces.rays import Rays
from bstcad.optics.surfaces.surfaces import Surface

MAX_BROYDEN_STEPS = 30  # maximum number of Broyden steps of the search
RAY_TOLERANCE = 1e-8  # distance of rays from their points at which the search ends, as a fraction of the grid's extent
RELATIVE_DIFFERENCE_STEP = 1e-6  # step of the difference quotients of the search, as a fraction of the grid's extent
MIN_BROYDEN_DIVISOR = 0.1  # divisor of a Broyden update, relative to the squared step, up to which there is no update


class Found(NamedTuple):
    """Rays that a search found; (rows, columns) for one source, (k, rows, columns) for k sources."""

    x: Tensor  # points (mm) at which they cross the vertex plane of the first surface
    y: Tensor
    rays: Rays  # rays at the heights
    error: Tensor  # largest distance (mm) in x and y from the wanted points before the last step; 0 for lost rays


@dataclass(frozen=True)
class Path:
    """Light of one source, or of k sources, on its way to heights over the plane of a face."""

    sources: tuple[Emitter, ...]
    before: Sequence[Interface]  # interfaces before the face, unbounded and without losses
    start: float  # z (mm) of the vertex plane of the first surface, through whose points rays are launched
    face: Surface  # face, in whose chart the points and heights are given
    sense: int  # +1 or -1, direction of the light along z
    extent: float  # extent (mm) of the grid of points

    @property
    def tolerance(self) -> float:
        """Distance of rays from their points (mm) at which the search ends."""
        return RAY_TOLERANCE * self.extent

    @property
    def step(self) -> float:
        """Step of the difference quotients (mm)."""
        return RELATIVE_DIFFERENCE_STEP * self.extent
