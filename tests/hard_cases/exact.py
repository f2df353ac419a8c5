"""The trace in sixty digits: every number as the program is given it, and no rounding after that.

Not the program's arithmetic: lines are followed from the source as points and vectors, and the spline is written in its
parameter t by the Cox-de Boor recursion, with x(t) inverted by bisection and Newton's method.
"""

from __future__ import annotations

from decimal import Decimal, localcontext

from bstcad.optics.bspline import BSplineSurface, knots
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import Plane, Sphere

DIGITS = 60
SMALL = Decimal(10) ** -45  # mm: where Newton's method ends

Vector = tuple[Decimal, Decimal, Decimal]


def number(value) -> Decimal:
    """A float of any precision, exactly."""
    return Decimal(float(value))


def dot(a: Vector, b: Vector) -> Decimal:
    return sum((p * q for p, q in zip(a, b, strict=True)), Decimal(0))


def scaled(a: Vector, by: Decimal) -> Vector:
    return tuple(by * p for p in a)


def added(a: Vector, b: Vector) -> Vector:
    return tuple(p + q for p, q in zip(a, b, strict=True))


def unit(a: Vector) -> Vector:
    return scaled(a, 1 / dot(a, a).sqrt())


class Axis:
    """The B-spline basis of one axis, of a net of m control points from `low` to `high` (mm)."""

    def __init__(self, m: int, ends: tuple[float, float]):
        self.m, self.knots = m, [number(k) for k in knots(m)]
        self.low = number(ends[0])
        self.pitch = (number(ends[1]) - self.low) / (m - 1)

    def functions(self, t: Decimal, degree: int) -> list[Decimal]:
        """All basis functions of a degree at t, by the recursion of Cox and de Boor."""
        k, m = self.knots, self.m
        last = m - 2  # the last span that is not empty ends at knot m; t there belongs to it
        values = [
            Decimal(int(k[i] <= t < k[i + 1] or (t == last and k[i] == last - 1 and k[i + 1] == last)))
            for i in range(len(k) - 1)
        ]
        for p in range(1, degree + 1):
            values = [
                (values[i] * (t - k[i]) / (k[i + p] - k[i]) if k[i + p] > k[i] else Decimal(0))
                + (values[i + 1] * (k[i + p + 1] - t) / (k[i + p + 1] - k[i + 1]) if k[i + p + 1] > k[i + 1] else 0)
                for i in range(len(k) - 1 - p)
            ]
        return values

    def derivatives(self, t: Decimal) -> list[Decimal]:
        """dB/dt of the quadratic functions: differences of the linear ones."""
        k, linear = self.knots, self.functions(t, 1)

        def part(i: int) -> Decimal:
            width = k[i + 2] - k[i]
            return 2 * linear[i] / width if width > 0 else Decimal(0)

        return [part(i) - part(i + 1) for i in range(self.m)]

    def at(self, x: Decimal) -> tuple[list[Decimal], list[Decimal]]:
        """(B, dB/dx) at x (mm): the control points' own abscissae say where t is."""
        u = min(max((x - self.low) / self.pitch, Decimal(0)), Decimal(self.m - 1))
        low, high = Decimal(0), Decimal(self.m - 2)
        t = (low + high) / 2
        for _ in range(200):  # x(t) is monotone: Newton's method, kept between what is known to be below and above
            off = sum(i * b for i, b in enumerate(self.functions(t, 2))) - u
            if off == 0 or high - low < SMALL:
                break
            low, high = (t, high) if off < 0 else (low, t)
            step = t - off / sum(i * b for i, b in enumerate(self.derivatives(t)))
            if abs(step - t) < SMALL:
                t = min(max(step, Decimal(0)), Decimal(self.m - 2))
                break
            t = step if low < step < high else (low + high) / 2
        slopes = self.derivatives(t)
        du_dt = sum(i * b for i, b in enumerate(slopes))
        return self.functions(t, 2), [b / (du_dt * self.pitch) for b in slopes]


class Face:
    """Plane, sphere or spline: sag and slopes (from its own plane z)."""

    def __init__(self, surface: Plane | Sphere | BSplineSurface):
        self.surface, self.z = surface, number(surface.z)
        if isinstance(surface, BSplineSurface):
            self.net = [[number(h) for h in row] for row in surface.heights.detach().tolist()]
            self.x, self.y = Axis(surface.m, surface.x), Axis(surface.m, surface.y)

    def sag(self, x: Decimal, y: Decimal) -> tuple[Decimal, Decimal, Decimal]:
        """(z - z0, ∂z/∂x, ∂z/∂y)."""
        if isinstance(self.surface, Plane):
            return Decimal(0), Decimal(0), Decimal(0)
        if isinstance(self.surface, Sphere):
            c = number(self.surface.curvature)
            root = (1 - c * c * (x * x + y * y)).sqrt()
            return c * (x * x + y * y) / (1 + root), c * x / root, c * y / root
        (b, d), (e, f) = self.x.at(x), self.y.at(y)
        rows = [(sum(q * h for q, h in zip(e, row, strict=True)), sum(q * h for q, h in zip(f, row, strict=True)))
                for row in self.net]  # fmt: skip
        pairs = list(zip(b, d, rows, strict=True))
        return (
            sum(p * r[0] for p, _, r in pairs),
            sum(q * r[0] for _, q, r in pairs),
            sum(p * r[1] for p, _, r in pairs),
        )

    def hit(self, start: Vector, direction: Vector) -> tuple[Vector, Vector]:
        """(point, unit normal towards +z) where the line from `start` meets the face near its plane."""
        t = (self.z - start[2]) / direction[2]
        for _ in range(60):
            x, y, z = added(start, scaled(direction, t))
            h, z_x, z_y = self.sag(x, y)
            step = (z - self.z - h) / (direction[2] - z_x * direction[0] - z_y * direction[1])
            t -= step
            if abs(step) < SMALL:
                return added(start, scaled(direction, t)), unit((-z_x, -z_y, Decimal(1)))
        raise ArithmeticError("no hit")


def refracted(direction: Vector, normal: Vector, eta: Decimal) -> Vector:
    """Snell's law: the part along the face is multiplied by η."""
    along = added(direction, scaled(normal, -dot(direction, normal)))
    tangent = scaled(along, eta)
    return added(tangent, scaled(normal, (1 - dot(tangent, tangent)).sqrt()))


def landing(start: tuple, direction: tuple, lens: Lens, z: float) -> tuple[Decimal, Decimal]:
    """Where the ray from `start` along `direction` (any length) meets the plane z behind the lens (mm)."""
    with localcontext(prec=DIGITS):
        index, at = number(lens.index), tuple(number(p) for p in start)
        along = unit(tuple(d if isinstance(d, Decimal) else number(d) for d in direction))
        for face, eta in ((Face(lens.front), 1 / index), (Face(lens.back), index)):
            at, normal = face.hit(at, along)
            along = refracted(along, normal, eta)
        x, y, _ = added(at, scaled(along, (number(z) - at[2]) / along[2]))
        return x, y
