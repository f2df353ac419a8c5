"""Rays of a file in random order, and the facts of their model, for which a lens is tailored.

Random numbers divide the rays among PARTS disjoint parts.  A part stands for the whole source: each set of rays of a
measurement draws from its own part, so that the noise of the file itself is independent from set to set and biases no
figure.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from bstcad.optics.light.profiles import MeasuredProfile, Profile
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.rays import Vector
from bstcad.optics.surfaces.sampling import hash_seed, jitter

PARTS = 8  # number of disjoint parts, one for each set of rays of a measurement (measure.SETS)
ORDER_SEED = 25  # seed of the random order of the rays


class GivenRays(Protocol):
    """Rays of a file, in its own coordinates; the light goes along +z."""

    @property
    def position(self) -> np.ndarray:
        """Positions (n, 3), mm."""

    @property
    def direction(self) -> np.ndarray:
        """Unit vectors (n, 3)."""

    @property
    def power(self) -> np.ndarray:
        """Powers (n,), in any unit."""


@dataclass(frozen=True, eq=False)
class RayOrder:
    """Rays of a file in random order, so that each run of neighbours is a random sample of them."""

    rays: GivenRays
    order: np.ndarray  # (n,) numbers of the rays

    @classmethod
    def of(cls, rays: GivenRays, chosen: np.ndarray | None = None) -> RayOrder:
        """Return rays in random order; chosen: numbers of those rays that count (default: all)."""
        numbers = np.arange(len(rays.power)) if chosen is None else chosen
        chance, _ = jitter(hash_seed(ORDER_SEED), numbers)
        key = (chance * 2.0**32).astype(np.uint64) << np.uint64(32) | numbers.astype(np.uint64)
        return cls(rays, (np.sort(key) & np.uint64(0xFFFFFFFF)).astype(np.uint32))  # faster than np.argsort

    def sample(self, part: int, count: int, seed: int) -> np.ndarray:
        """Return the numbers of `count` random rays of one of the PARTS parts; all of its rays if it has no more."""
        own = self.order[part % PARTS :: PARTS]
        if count >= len(own):
            return own
        (start,), _ = jitter(hash_seed(seed), np.zeros(1, np.int64))
        first = int(start * len(own))
        return np.concatenate([own[first : first + count], own[: max(first + count - len(own), 0)]])


@dataclass(frozen=True, eq=False)
class RayFacts:
    """Facts of a model of rays: an even disc or rectangle of points, each with the radiant intensity `law`."""

    law: Profile  # radiant intensity over stereographic coordinates
    extent: Outline | None  # emitting disc or rectangle (mm); None: a point
    origin: Vector  # centre of the emitting area in the coordinates of the file, mm
    lines: tuple[tuple[float, float], ...]  # (nm, fraction of the flux), the main line first; (): no stated wavelength
    lumens: float | None  # luminous flux of the file, lm; None: a radiant flux
    half_angle: float  # largest angle from the axis with light, degrees


class MeasuredRays(MeasuredProfile):
    """A file of rays with its model, or a model alone."""

    @property
    @abstractmethod
    def facts(self) -> RayFacts:
        """Facts of the model."""

    @property
    def law(self) -> Profile:
        """Radiant intensity of the model."""
        return self.facts.law

    @property
    def lumens(self) -> float | None:
        """Luminous flux of the file (lm); None: it states a radiant flux."""
        return self.facts.lumens

    @property
    def half_angle(self) -> float:
        """Largest angle from the axis (degrees) with light."""
        return self.facts.half_angle

    @abstractmethod
    def scaled(self, share: float) -> MeasuredRays:
        """Return the model with its extent multiplied by `share`."""

    def rays_of(self, line: int) -> RayOrder | None:
        """Return the rays of a spectral line in random order; None: a model alone."""
        return None
