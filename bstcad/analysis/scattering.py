"""Light scattered by the roughness of a lens's faces, and the blur of a picture by it.

A face between media of indices n1 and n2, with normally distributed heights of RMS σ and covariance σ² exp(-(r / ℓ)²),
delays light by random phases of variance g = (2π |n2 - n1| σ / λ)²; a mirror has 2 n1 in place of |n2 - n1|.  The
fraction exp(-g) of the light goes on as if the face were smooth, and 1 - exp(-g) is scattered: the total integrated
scatter (Bennett and Porteus 1961, J. Opt. Soc. Am. 51, 123).  The series of Beckmann and Spizzichino (1963, The
Scattering of Electromagnetic Waves from Rough Surfaces, ch. 5) gives its angles: its term m has the weight
g^m exp(-g) / m! and is normally distributed with the variance m (λ / (√2 π ℓ))² along each axis, in radians behind the
lens.  For large g the sum tends to the light that rays carry at random facets: the slopes of the face have the
variance 2 (σ / ℓ)² along each axis, and a slope s deflects light by |n2 - n1| s.  Angles are assumed to be small, and
light to meet the face nearly at normal incidence.  The terms of several faces with one ℓ combine to those of g = Σ g.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import toeplitz
from scipy.special import gammaln, ndtr, pdtrc, xlogy

from bstcad.optics.lens.interfaces import Refract
from bstcad.optics.lens.lens import Lens
from bstcad.optics.trace.finish import Finish

MM_PER_NM = 1e-6
MAX_SERIES = 40.0  # largest g at which the series is summed; beyond it one Gaussian replaces the sum
MIN_TERM = 1e-6  # smallest weight of a term that is summed


@dataclass(frozen=True)
class Scatter:
    """Scatter by all rough faces of a lens at one wavelength."""

    strength: float  # g, the variance of the phases (rad²)
    first_angle: float  # standard deviation of the first term's angle along each axis, radians

    @classmethod
    def of(cls, lens: Lens, finish: Finish, wavelength: float) -> Scatter:
        """Return the scatter of a lens whose faces, except planes z = const, have a finish; wavelength: nm."""
        own, before, strength = lens.passes, lens.passes.index_before, 0.0
        for interface, law in zip(lens.interfaces[lens.solid], own.laws(lens.index), strict=True):
            difference = abs(law.n_out - law.n_in) if isinstance(law, Refract) else 2 * before
            before = law.n_out if isinstance(law, Refract) else before
            if not interface.surface.level:
                strength += (2 * math.pi * difference * finish.rms_roughness / wavelength) ** 2
        return cls(strength, wavelength * MM_PER_NM / (math.sqrt(2) * math.pi * finish.roughness_length))

    @property
    def fraction(self) -> float:
        """Fraction of the light that is scattered, the total integrated scatter 1 - exp(-g)."""
        return -math.expm1(-self.strength)

    @property
    def angle(self) -> float:
        """RMS angle (radians) of the scattered light along each axis, first_angle · sqrt(g / (1 - exp(-g)))."""
        return self.first_angle * (math.sqrt(self.strength / self.fraction) if self.strength else 1.0)

    def terms(self) -> Iterator[tuple[float, float]]:
        """Yield (weight, variance along each axis (rad²)) of the parts of the scattered light."""
        if self.strength > MAX_SERIES:
            yield self.fraction, self.angle**2
            return
        m = 0
        while float(pdtrc(m, self.strength)) > MIN_TERM:  # share of the light that is scattered more than m times
            m += 1
            weight = float(np.exp(xlogy(m, self.strength) - gammaln(m + 1) - self.strength))  # Poisson's
            if weight > MIN_TERM:
                yield weight, m * self.first_angle**2

    def blurred(self, picture: np.ndarray, per_radian: tuple[float, float]) -> np.ndarray:
        """Return a picture (rows, columns) with its light scattered; light beyond its edges is lost.

        per_radian: columns and rows by which a deflection of one radian shifts the light.
        """
        shift_x, shift_y = (abs(shift) for shift in per_radian)
        blurred = math.exp(-self.strength) * picture
        for weight, variance in self.terms():
            deviation = math.sqrt(variance)
            rows, columns = (
                _blur_matrix(count, deviation * shift)
                for count, shift in zip(picture.shape, (shift_y, shift_x), strict=True)
            )
            blurred = blurred + weight * (rows @ picture @ columns)
        return blurred


def _blur_matrix(count: int, deviation: float) -> np.ndarray:
    """Return the fractions (count, count) of the light from the middle of each pixel that a Gaussian moves to another.

    deviation: standard deviation in pixels.  The matrix is symmetric.
    """
    if deviation < 1e-3:
        return np.eye(count)
    distance = np.arange(count)
    return toeplitz(ndtr((distance + 0.5) / deviation) - ndtr((distance - 0.5) / deviation))
