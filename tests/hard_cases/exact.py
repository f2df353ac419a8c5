"""The trace in sixty digits: every number as the program is given it, and no rounding after that.

Not the program's arithmetic: lines are followed from the source as points and vectors (numpy arrays of Decimal), and
the spline is written in its parameter t by the Cox-de Boor recursion, with x(t) inverted by Newton's method.
"""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal, localcontext

import numpy as np

from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import knots

DIGITS = 60
SMALL = Decimal(10) ** -45  # mm: where Newton's method ends


def number(value) -> Decimal:
    """A float of any precision, exactly."""
    return Decimal(float(value))


def vector(values: Sequence) -> np.ndarray:
    """Floats or decimals as decimals."""
    return np.array([v if isinstance(v, Decimal) else number(v) for v in values])


def unit(a: np.ndarray) -> np.ndarray:
    return a / (a @ a).sqrt()


class Axis:
    """The B-spline basis of one axis, of a net of m control points from `low` to `high` (mm)."""

    def __init__(self, m: int, ends: tuple[float, float]):
        self.m, self.knots, self.low = m, [number(k) for k in knots(m)], number(ends[0])
        self.pitch = (number(ends[1]) - self.low) / (m - 1)

    def functions(self, t: Decimal, degree: int) -> np.ndarray:
        """All basis functions of a degree at t, by the recursion of Cox and de Boor."""
        k, last = self.knots, self.m - 2  # the last span that is not empty ends at knot m; t there belongs to it
        values = [
            Decimal(int(low <= t < high or (t == last and low == last - 1 and high == last)))
            for low, high in zip(k, k[1:], strict=False)
        ]
        for p in range(1, degree + 1):
            # a quotient with an empty support counts as zero
            up = [(t - k[i]) / (k[i + p] - k[i]) if k[i + p] > k[i] else Decimal(0) for i in range(len(k) - p)]
            down = [1 - up[i] if k[i + p] > k[i] else Decimal(0) for i in range(len(up))]
            values = [values[i] * up[i] + values[i + 1] * down[i + 1] for i in range(len(values) - 1)]
        return np.array(values)

    def derivatives(self, t: Decimal) -> np.ndarray:
        """dB/dt of the quadratic functions: differences of the linear ones."""
        width = [max(high - low, SMALL) for low, high in zip(self.knots, self.knots[2:], strict=False)]
        part = 2 * self.functions(t, 1) / np.array(width)  # the linear function of an empty support is zero
        return part[:-1] - part[1:]

    def at(self, x: Decimal) -> tuple[np.ndarray, np.ndarray]:
        """(B, dB/dx) at x (mm): the control points' own abscissae say where t is."""
        number_of = np.array([Decimal(i) for i in range(self.m)])
        low, high = Decimal(0), Decimal(self.m - 2)
        u, t = min(max((x - self.low) / self.pitch, low), high + 1), high / 2
        for _ in range(200):  # x(t) is monotone: Newton's method, kept between what is known to be below and above
            off = number_of @ self.functions(t, 2) - u
            low, high = (t, high) if off < 0 else (low, t)
            step = t - off / (number_of @ self.derivatives(t))
            if abs(step - t) < SMALL or high - low < SMALL:
                break
            t = step if low < step < high else (low + high) / 2
        slopes = self.derivatives(t)
        return self.functions(t, 2), slopes / (number_of @ slopes * self.pitch)


class Face:
    """Plane, sphere or spline: sag and slopes (from its own plane z)."""

    def __init__(self, surface):
        self.surface, self.z = surface, number(surface.z)
        if surface.is_net:
            self.net = np.array([[number(h) for h in row] for row in surface.heights.detach().tolist()])
            self.x, self.y = Axis(surface.m, surface.x), Axis(surface.m, surface.y)

    def sag(self, x: Decimal, y: Decimal) -> tuple[Decimal, Decimal, Decimal]:
        """(z - z0, ∂z/∂x, ∂z/∂y)."""
        if self.surface.is_net:
            (b, b_x), (e, e_y) = self.x.at(x), self.y.at(y)
            return b @ self.net @ e, b_x @ self.net @ e, b @ self.net @ e_y
        c = number(getattr(self.surface, "curvature", 0.0))  # of a plane 0
        root = (1 - c * c * (x * x + y * y)).sqrt()
        return c * (x * x + y * y) / (1 + root), c * x / root, c * y / root

    def hit(self, start: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(point, unit normal towards +z) where the line from `start` meets the face near its plane."""
        t = (self.z - start[2]) / direction[2]
        for _ in range(60):
            x, y, z = start + t * direction
            h, z_x, z_y = self.sag(x, y)
            normal = np.array([-z_x, -z_y, Decimal(1)])
            step = (z - self.z - h) / (direction @ normal)
            t -= step
            if abs(step) < SMALL:
                return start + t * direction, unit(normal)
        raise ArithmeticError("no hit")


def refracted(direction: np.ndarray, normal: np.ndarray, eta: Decimal) -> np.ndarray:
    """Snell's law: the part along the face is multiplied by η."""
    tangent = eta * (direction - (direction @ normal) * normal)
    return tangent + (1 - tangent @ tangent).sqrt() * normal


def landing(start: Sequence, direction: Sequence, lens: Lens, z: float) -> tuple[Decimal, Decimal]:
    """Return the point (mm) at which the ray from `start` along `direction` (any length) meets the plane z."""
    with localcontext(prec=DIGITS):
        index, at, along = number(lens.index), vector(start), unit(vector(direction))
        for face, eta in ((Face(lens.front), 1 / index), (Face(lens.back), index)):
            at, normal = face.hit(at, along)
            along = refracted(along, normal, eta)
        x, y, _ = at + along * (number(z) - at[2]) / along[2]
        return x, y
