"""Sets of rays that stand for a light source, with random subsets and parts.

Each ray has a position, a direction and a power.  A sum over the rays, Σ power f(position, direction), is an estimate
of an integral over the light of the source; random subsets keep its expectation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bstcad.optics.surfaces.sampling import hash_seed, jitter

RAYS_PER_BLOCK = 1 << 16  # number of rays that are handled at a time
READING, DRAWING, PARTING = range(3)  # uses of random numbers, which are independent


@dataclass(frozen=True, eq=False)
class RaySet:
    """Rays of a light source; all arrays are float32."""

    position: np.ndarray  # (n, 3) points from which the rays start, mm
    direction: np.ndarray  # (n, 3) unit vectors
    power: np.ndarray  # (n,) powers above 0, in the unit
    unit: str = "lm"  # unit of the powers: "lm" or "W"
    wavelength: np.ndarray | float | None = None  # (n,) wavelengths, or that of all rays, nm; None: not stated
    stated: float | None = None  # flux of the set by the header of the file, in the unit; None: not stated
    stated_lumens: float | None = None  # luminous flux of the set by the header, lm, also of powers in W
    name: str = ""  # name of the light source by the file
    remarks: tuple[str, ...] = ()  # sentences on readings that the file does not state plainly

    def __len__(self) -> int:
        """Return the number of rays."""
        return len(self.power)

    @property
    def flux(self) -> float:
        """Sum of the powers, in the unit."""
        return float(self.power.sum(dtype=np.float64))

    @property
    def main_wavelength(self) -> float | None:
        """Mean of the wavelengths, weighted by power, nm; None: not stated."""
        if isinstance(self.wavelength, np.ndarray):
            return float(np.multiply(self.power, self.wavelength, dtype=np.float64).sum() / self.flux)
        return self.wavelength

    def drawn(self, count: int, seed: int = 0) -> RaySet:
        """Return `count` (at least 1) random rays in the order of the set, each once, with powers times n / count.

        Every subset of this size is equally probable, so that the expectation of any sum over the rays is that of the
        set.  The set itself is returned if it has no more rays.
        """
        if count < 1:
            raise ValueError(f"{count} rays cannot be drawn; give a number above 0")
        n = len(self)
        if count >= n:
            return self
        order = np.concatenate([chances(first, n, seed, use=DRAWING) for first in range(0, n, RAYS_PER_BLOCK)])
        kept = np.sort(np.argpartition(order, count - 1)[:count])
        return self._subset(kept, factor=n / count)

    def parts(self, number: int, seed: int = 0) -> tuple[RaySet, ...]:
        """Return random disjoint parts of the set, each of about n / number rays with their own powers.

        Each ray is in exactly one part, so that the fluxes of the parts sum to the flux of the set.
        """
        n = len(self)
        part = np.empty(n, dtype=np.int32)
        for first in range(0, n, RAYS_PER_BLOCK):
            part[first : first + RAYS_PER_BLOCK] = number * chances(first, n, seed, use=PARTING)
        return tuple(replace(self._subset(part == each), stated=None, stated_lumens=None) for each in range(number))

    def _subset(self, kept: np.ndarray, factor: float = 1.0) -> RaySet:
        """Return the rays of an index or a mask, with powers times the factor."""
        return replace(
            self, position=self.position[kept], direction=self.direction[kept],
            power=scaled(self.power[kept], factor),
            wavelength=self.wavelength[kept] if isinstance(self.wavelength, np.ndarray) else self.wavelength,
        )  # fmt: skip


def scaled(values: np.ndarray, factor: float) -> np.ndarray:
    """Return values times a factor in float32, rounded once; infinite beyond its range."""
    if factor == 1.0:
        return values
    with np.errstate(over="ignore", invalid="ignore"):
        return (values * np.float64(factor)).astype(np.float32)


def chances(first: int, n: int, seed: int, use: int) -> np.ndarray:
    """Return a number in (0, 1), a hash of its number, for each ray of the block that begins at ray `first` of n."""
    key = hash_seed(hash_seed(seed) + use)
    upper, _ = jitter(key, np.arange(first, min(first + RAYS_PER_BLOCK, n)))
    return upper
