"""What all sources say of their colour and of the way that they look, and how their rays begin."""

from __future__ import annotations

import torch
from torch import Tensor

from bstcad.optics import spectrum
from bstcad.optics.spectrum import Wavelength
from bstcad.optics.tilt import Vector, axes


class Emitter:
    """What all sources say of their colour and of the way that they look."""

    wavelength: Wavelength
    tilt: tuple[float, float] | None

    @property
    def lines(self) -> tuple[tuple[float, float], ...]:
        """(nm, share of the flux) of each line, the main one first; shares sum to 1."""
        return spectrum.lines(self.wavelength)

    @property
    def main_wavelength(self) -> float:
        """Of the heaviest line (nm); of several as heavy, the middle one."""
        return spectrum.main(self.wavelength)

    @property
    def tilted(self) -> bool:
        """Does its axis lean against that of the lens?"""
        return self.tilt is not None and any(self.tilt)

    @property
    def axes(self) -> tuple[Vector, Vector, Vector]:
        """Its own axes in space; its light goes along the third, or, to a lens below it, along minus the third."""
        return axes(self.tilt or (0.0, 0.0))


def all_alive(x: Tensor) -> Tensor:
    """The status of rays through x: none is lost yet."""
    return torch.zeros(x.shape, dtype=torch.uint8, device=x.device)
