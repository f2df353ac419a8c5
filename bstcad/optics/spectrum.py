"""Spectra: light of one wavelength (nm), or of several lines, each with its share of the flux."""

from __future__ import annotations

import math
from typing import Annotated

from bstcad.optics.key import Key

Wavelength = float | tuple[tuple[float, float], ...]  # nm; or lines, each (nm, weight), weights of any sum
WavelengthKey = Annotated[  # of every source
    Wavelength,
    Key("One wavelength, or lines [[nm, weight], ...] of a spectrum, weights of any sum.", "nm", 100.0, 20_000.0),
]


def lines(wavelength: Wavelength) -> tuple[tuple[float, float], ...]:
    """(nm, share of the flux) of each line, the main one first and the others as they are listed; shares sum to 1."""
    if isinstance(wavelength, int | float):
        return ((wavelength, 1.0),)
    whole, first = math.fsum(weight for _, weight in wavelength), main(wavelength)
    shares = [(nm, weight / whole) for nm, weight in wavelength]
    return tuple(sorted(shares, key=lambda line: line[0] != first))  # stable


def main(wavelength: Wavelength) -> float:
    """The heaviest line (nm); of several as heavy, the middle one."""
    if isinstance(wavelength, int | float):
        return wavelength
    most = max(weight for _, weight in wavelength)
    heaviest = sorted(nm for nm, weight in wavelength if weight == most)
    return heaviest[(len(heaviest) - 1) // 2]
