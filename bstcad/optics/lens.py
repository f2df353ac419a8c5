"""The lens: two surfaces, an outline and a medium, and the way that light takes through them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.interfaces import Interface, Reflect, Refract
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import Status
from bstcad.optics.surfaces import Surface


class Dimming(Protocol):
    """What takes flux on the way through a lens (effects.Losses)."""

    def on(self, interfaces: Sequence[Interface]) -> tuple[Interface, ...]:
        """The same interfaces, each with its losses."""


@dataclass(frozen=True)
class Lens:
    """A solid between two surfaces, in air: `front` below, the freeform `back` above it, sides parallel to the axis.

    A lens refracts: light travels along +z, enters through the front and leaves through the back.  A mirror reflects
    at its back: light comes from above, along -z, and leaves along +z; its front is the rear of the plate, and dark.
    """

    front: Surface
    back: BSplineSurface
    outline: Outline  # both faces end on it
    index: float  # refractive index at the design wavelength; of a mirror it does not matter
    reflects: bool = False  # is it a mirror?
    losses: Dimming | None = None  # what faces and glass take of the light; None: nothing

    @property
    def interfaces(self) -> tuple[Interface, ...]:
        """What light crosses, in its order."""
        lossless = self._lossless
        return lossless if self.losses is None else self.losses.on(lossless)

    @property
    def _lossless(self) -> tuple[Interface, ...]:
        missed = Status.MISSED_FRONT
        if self.reflects:
            return (Interface(self.back, self.outline, Reflect(), missed),)
        return (
            Interface(self.front, self.outline, Refract(1.0, self.index), missed),
            Interface(self.back, self.outline, Refract(self.index, 1.0), Status.VIGNETTED),
        )

    @property
    def entrance(self) -> Surface:
        """The surface that light meets first; the plane through its vertex is where rays are counted."""
        return self.back if self.reflects else self.front

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> Lens:
        """The same lens with its tensors in another precision or on another device."""
        return replace(self, front=self.front.to(dtype, device), back=self.back.to(dtype, device))

    def plain(self) -> Lens:
        """The same lens in float64 on the CPU, without gradient."""
        return replace(self, front=self.front.plain(), back=self.back.plain())
