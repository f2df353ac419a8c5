"""The lens: two surfaces, an outline and a medium, and the way that light takes through them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.interfaces import Interface, Reflect, Refract
from bstcad.optics.outlines import EVERYWHERE, Outline
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
    outline: Outline  # both faces of the solid end on it
    index: float  # refractive index at the design wavelength; of a mirror it does not matter
    reflects: bool = False  # is it a mirror?
    losses: Dimming | None = None  # what faces and glass take of the light; None: nothing
    clear: tuple[Outline, Outline] | None = None  # of front and back, outside which light is lost; None: the outline

    @property
    def interfaces(self) -> tuple[Interface, ...]:
        """What light crosses, in its order."""
        lossless = self._lossless
        return lossless if self.losses is None else self.losses.on(lossless)

    @property
    def _lossless(self) -> tuple[Interface, ...]:
        missed, (front, back) = Status.MISSED_FRONT, self.apertures
        if self.reflects:
            return (Interface(self.back, back, Reflect(), missed),)
        return (
            Interface(self.front, front, Refract(1.0, self.index), missed),
            Interface(self.back, back, Refract(self.index, 1.0), Status.VIGNETTED),
        )

    @property
    def apertures(self) -> tuple[Outline, Outline]:
        """The clear apertures of front and back: light that meets a face outside of its own is lost."""
        return self.clear or (self.outline, self.outline)

    @property
    def entrance_aperture(self) -> Outline:
        """That of the surface that light meets first."""
        return self.apertures[1 if self.reflects else 0]

    def unbounded(self) -> Lens:
        """The same surfaces without an edge: no light misses them."""
        return replace(self, outline=EVERYWHERE, clear=None)

    def grown(self, by: float) -> Lens:
        """The same surfaces, their clear apertures larger by a factor."""
        return replace(self, clear=tuple(aperture.scaled(by) for aperture in self.apertures))

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
