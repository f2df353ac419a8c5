"""Profiles: the irradiance E(u, v) of a source on a plane of its own, on any scale.

For parallel light u and v are the place in the beam, from its centre (mm).  For a point source they are the slopes of
rays, p · e_x / (p · n) and p · e_y / (p · n) for a ray along p, so E is the irradiance on a plane at distance 1 across
the axis n, and the radiant intensity is I = E / cos³ θ, with θ the angle from the axis.
"""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.numerics.records import NO_NET, Frame3, NetTable, Pattern, floats
from bstcad.optics.numerics.reductions import elementary
from bstcad.optics.surfaces.bspline import evaluate
from bstcad.optics.surfaces.outlines import Circle, Outline
from bstcad.optics.surfaces.rays import Frame

ROUND, GAUSSIAN = math.inf, 2.0  # width of a profile without a fall, order of a Gaussian
NODES, MAX_PANELS = 16, 128  # Gauss-Legendre nodes per panel, largest number of panels along a side
FALL = 32.0  # -ln E at the ellipse outside which a profile is dark


class Net:
    """Irradiance as a B-spline of degree 2 with clamped uniform knots over a rectangle; zero outside it.

    Control points (m, n) are at even spacing from corner to corner, x along the first axis.  The spline is nowhere
    negative if no control point is.  Instances are compared by identity.
    """

    def __init__(self, values: np.ndarray, u: tuple[float, float], v: tuple[float, float]) -> None:
        self.values = torch.from_numpy(np.ascontiguousarray(values, dtype=np.float64))
        self.u, self.v = u, v  # range of each coordinate

    @property
    def per_unit(self) -> tuple[float, float]:
        """Spans between control points per unit of u and of v."""
        m, n = self.values.shape
        return (m - 1) / (self.u[1] - self.u[0]), (n - 1) / (self.v[1] - self.v[0])

    @property
    def flux(self) -> float:
        """∫ E du dv: the control points weighted by the integrals of their basis functions."""
        (m, n), (per_u, per_v) = self.values.shape, self.per_unit
        return float((_areas(m)[:, None] * self.values.numpy() * _areas(n)).sum() / (per_u * per_v))

    def at(self, u: Tensor, v: Tensor) -> Tensor:
        """Return E at (u, v)."""
        inside = (u >= self.u[0]) & (u <= self.u[1]) & (v >= self.v[0]) & (v <= self.v[1])
        places = (
            (t.clamp(*span) - span[0]) * per
            for t, span, per in zip((u, v), (self.u, self.v), self.per_unit, strict=True)
        )
        value = evaluate(self.values.to(u), *places)[0]
        return torch.where(inside, value.clamp(min=0), torch.zeros_like(value))


@dataclass(frozen=True)
class Profile:
    """E = exp(-2 q^(order / 2)), q = (u' / w_u)² + (v' / w_v)², times a net's value; zero for u² + v² < inner².

    (u', v') is (u, v) rotated by -rotate.  order 2: an elliptical Gaussian, with w_u and w_v its radii at 1/e²; larger:
    a super-Gaussian (Shealy and Hoffnagle, Appl. Opt. 45, 5118 (2006)).
    """

    widths: tuple[float, float] = (ROUND, ROUND)  # w_u, w_v; inf: no fall
    order: float = GAUSSIAN
    inner: float = 0.0  # radius of a dark disc at the centre
    rotate: float = 0.0  # rotation about the centre, degrees, from u towards v
    net: Net | None = None
    stereographic: bool = False  # True: stereographic coordinates and radiant intensity
    whole: float | None = None  # flux over all places or directions; None: computed from E

    def density(self, u: Tensor, v: Tensor) -> Tensor:
        """Return E(u, v), 1 at the peak of a profile without a net."""
        dark = u * u + v * v < self.inner**2
        if self.rotate:
            cos, sin = self._turn
            u, v = cos * u + sin * v, cos * v - sin * u
        value = torch.ones_like(u)
        if self.falls:
            q = (u / self.widths[0]) ** 2 + (v / self.widths[1]) ** 2
            value = elementary(lambda t: (-2 * t ** (self.order / 2)).exp(), q)
        if self.net is not None:
            value = value * self.net.at(u, v)
        return torch.where(dark, torch.zeros_like(value), value)

    @property
    def falls(self) -> bool:
        """True if the profile has a width."""
        return self.widths != (ROUND, ROUND)

    @property
    def _turn(self) -> tuple[float, float]:
        return math.cos(math.radians(self.rotate)), math.sin(math.radians(self.rotate))

    @property
    def is_round(self) -> bool:
        """True if a rotation about the centre leaves E unchanged."""
        return self.net is None and self.widths[0] == self.widths[1]

    def flux(self, outline: Outline) -> float:
        """Return ∫ E du dv inside an outline about the centre."""
        return _cached_flux(self, outline) if self.whole is None else self.whole

    def _integral(self, outline: Outline) -> float:
        """Return `flux`, computed anew.

        Inside an ellipse of 1e-13 of the peak it is π w_u w_v 2^(-2 / order) Γ(1 + 2 / order); otherwise composite
        Gauss-Legendre quadrature, u = a + r sin t along the arcs of the rim.
        """
        hole = replace(self, inner=0.0).flux(Circle(self.inner)) if self.inner else 0.0
        if self.falls and self.net is None and self._is_inside(outline):
            k = 2 / self.order
            return math.pi * math.prod(self.widths) * 2**-k * math.gamma(1 + k) - hole
        a, b, r2 = outline.limits
        if self.net is not None and not self.falls and not math.isfinite(r2):
            return self.net.flux - hole
        r, panels = math.sqrt(r2), self._panels(outline)
        node, weight = _composite(panels)
        parts = [(a * node, np.full(node.size, b + r), a * weight)] if a else []
        turn = (node + 1) * math.pi / 4
        x, half, along = a + r * np.sin(turn), b + r * np.cos(turn), r * np.cos(turn) * weight * math.pi / 4
        parts += [(sign * x, half, along) for sign in (-1, 1) if r]
        u, half, along = (np.concatenate(each) for each in zip(*parts, strict=True))
        places = np.stack(np.broadcast_arrays(u[:, None], half[:, None] * node))
        value = replace(self, inner=0.0).density(*torch.from_numpy(places))
        return float((along * half * (value.numpy() * weight).sum(1)).sum()) - hole

    def _is_inside(self, outline: Outline) -> bool:
        """Return True if an outline contains the ellipse outside which the profile is dark."""
        (w_u, w_v), (cos, sin) = self.widths, np.abs(self._turn)
        reach, (a, b, r2) = (FALL / 2) ** (1 / self.order), outline.limits
        along_u, along_v = (reach * math.hypot(*part) for part in ((w_u * cos, w_v * sin), (w_u * sin, w_v * cos)))
        return max(along_u - a, 0.0) ** 2 + max(along_v - b, 0.0) ** 2 <= r2

    def _panels(self, outline: Outline) -> int:
        """Return the number of panels of the quadrature along each side: about one per radius, or per two spans."""
        sides = [2 * half / width for half in outline.half_extent for width in self.widths]
        sides += [side / 2 for side in self.net.values.shape] if self.net else []
        return min(max(math.ceil(max(sides)), 4), MAX_PANELS)

    def pattern(self, frame: Frame | None = None, sense: int = 1) -> Pattern:
        """Return the profile for the kernels; frame: axes of a point source (None: parallel light), sense: see Rays.

        The axes are given in the frame in which light starts along +z.
        """
        e_x, e_y, n = frame or ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        cos, sin = self._turn
        u_axis = tuple(cos * p + sin * q for p, q in zip(e_x, e_y, strict=True))
        v_axis = tuple(cos * q - sin * p for p, q in zip(e_x, e_y, strict=True))
        u_axis, v_axis = (Frame3(t[0], t[1], sense * t[2]) for t in (u_axis, v_axis))
        w_u, w_v = self.widths
        table = NO_NET
        if (net := self.net) is not None:
            (m, n_v), (per_u, per_v) = net.values.shape, net.per_unit
            ends = floats(u_min=net.u[0], u_max=net.u[1], v_min=net.v[0], v_max=net.v[1])
            table = NetTable(m=m, n=n_v, per_u=per_u, per_v=per_v, values=net.values.numpy().ravel(), **ends)
        axis = Frame3(sense * n[0], sense * n[1], n[2])
        numbers = floats(fall_u=1 / w_u, fall_v=1 / w_v, power=self.order / 2, inner2=self.inner**2)
        shape = int(self.stereographic)
        return Pattern(present=1, x=u_axis, y=v_axis, axis=axis, stereographic=shape, net=table, **numbers)


@functools.lru_cache(maxsize=64)
def _cached_flux(profile: Profile, outline: Outline) -> float:
    return profile._integral(outline)


class MeasuredProfile(ABC):
    """An irradiance, or a radiant intensity, from a file."""

    @property
    @abstractmethod
    def law(self) -> Profile:
        """The irradiance; its net is the same instance at every call."""

    @property
    def lumens(self) -> float | None:
        """Total flux by the file (lm); None: not stated."""
        return None

    @property
    def half_angle(self) -> float | None:
        """Largest angle from the axis (degrees) with light; None: not known."""
        return None

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on readings that the file does not state plainly."""
        return ()

    @property
    @abstractmethod
    def words(self) -> str:
        """Name and sizes in words."""


def pair_of(width: float | tuple[float, float]) -> tuple[float, float]:
    """Return the widths along u and v of one number or two."""
    return width if isinstance(width, tuple) else (width, width)


def _areas(m: int) -> np.ndarray:
    """Return the integrals of the m basis functions over the place (not the knot parameter), in spacings."""
    areas, ends = np.ones(m), (-5 / 12, -1 / 8, 1 / 24)  # in the end spans the place is 2t - t² / 2 (bspline.position)
    areas[:3] += ends
    areas[:-4:-1] += ends
    return areas


def _composite(panels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes in [-1, 1] and weights of Gauss-Legendre quadrature in equal panels."""
    node, weight = np.polynomial.legendre.leggauss(NODES)
    middle = (2 * np.arange(panels) + 1) / panels - 1
    return (middle[:, None] + node / panels).ravel(), np.tile(weight / panels, panels)
