"""A referee for beam shapers: a Gaussian beam to an even disc between plane waves, by one quadrature; no bstcad in it.

Light along +z meets the front at r, goes straight to the back and leaves it along +z at R: it lands at R on a screen
at any distance.  With ρ = R - r, the rise h along z from front to back, and L² = ρ² + h², three laws give the lens:

flux   ∫_0^r E r dr / ∫_0^a E r dr = R² / D², E = exp(-2 r² / w²), a the radius of the beam and D that of the disc
path   n L - h = (n - 1) T, T the thickness on the axis
Snell  a face between the directions (0, 1) in air and (ρ, h) / L in glass has the slope n ρ / (L - n h), front as back

R has the sign of r: no ray crosses the axis (Galilean).  The method is that of Kreuzer, US patent 3 476 463 (1969), and
of Rhodes and Shealy, Appl. Opt. 19, 3545 (1980); see also Hoffnagle and Jefferson, Appl. Opt. 39, 5488 (2000).  It is
derived anew here, and no formula is taken from them.
"""

from dataclasses import dataclass

import numpy as np

NODES, WEIGHTS = np.polynomial.legendre.leggauss(32)  # slopes are analytic in r: 24 come to 1e-14 mm


@dataclass(frozen=True)
class BeamShaper:
    """A lens whose front crosses the axis at z = 0; lengths in mm, radii as arrays of any shape."""

    radius_1e2: float  # w, where the irradiance is 1 / e² of its peak
    aperture: float  # a, where the beam is cut
    disc: float  # D
    index: float  # n
    thickness: float  # T

    @property
    def lost(self):
        """The share of the whole Gaussian beam outside the aperture: exp(-2 a² / w²)."""
        return float(np.exp(-2 * (self.aperture / self.radius_1e2) ** 2))

    def lands_at(self, r):
        """R(r) = D sqrt((1 - exp(-2 r² / w²)) / (1 - exp(-2 a² / w²))); it goes on beyond a."""
        return self.disc * np.sqrt(-np.expm1(-2 * (r / self.radius_1e2) ** 2) / (1 - self.lost))

    def comes_from(self, landing):
        """r(R), the inverse of `lands_at`, for R <= D."""
        return self.radius_1e2 * np.sqrt(-np.log1p((self.lost - 1) * (landing / self.disc) ** 2) / 2)

    def in_glass(self, r):
        """(ρ, h): by the path (n² - 1) h = K + n sqrt(K² - (n² - 1) ρ²), K = (n - 1) T."""
        rho, n, k = self.lands_at(r) - r, self.index, (self.index - 1) * self.thickness
        return rho, (k + n * np.sqrt(k * k - (n * n - 1) * rho * rho)) / (n * n - 1)

    def slope(self, r):
        """dz/dr of the front at r, and dz/dR of the back at R(r): n ρ / (L - n h)."""
        rho, h = self.in_glass(r)
        return self.index * rho / (np.hypot(rho, h) - self.index * h)

    def front(self, r):
        """(z, dz/dr) of the front: ∫_0^r slope dr by Gauss's rule."""
        r = np.asarray(r, dtype=float)
        return r / 2 * (self.slope(r[..., None] / 2 * (1 + NODES)) @ WEIGHTS), self.slope(r)

    def back(self, landing):
        """(z, dz/dR) of the back at R <= D: the front's z and h."""
        r = self.comes_from(np.asarray(landing, dtype=float))
        return self.front(r)[0] + self.in_glass(r)[1], self.slope(r)

    def path(self, plane):
        """The optical path of each ray from z = 0 to a plane behind the lens (mm): n T + z - T."""
        return self.index * self.thickness + plane - self.thickness

    def errors(self, r):
        """The largest errors at r > 0: Snell's law at front and back, the path (mm), the slope of the front.

        Snell: n d x N - n' d' x N, with the ray drawn from the point on the front to that on the back.
        """
        landing, n = self.lands_at(r), self.index
        (front, front_slope), (back, back_slope) = self.front(r), self.back(landing)
        length = np.hypot(landing - r, back - front)
        across, along = (landing - r) / length, (back - front) / length
        snell = [(n * (across + along * s) - s) / np.hypot(1, s) for s in (front_slope, back_slope)]
        off = front + n * length + (self.thickness - back) - n * self.thickness
        step = 1e-5  # mm, for slopes as differences of the heights
        rise = (self.front(r + step)[0] - self.front(r - step)[0]) / (2 * step) - front_slope
        return tuple(float(np.abs(error).max()) for error in (*snell, off, rise))
