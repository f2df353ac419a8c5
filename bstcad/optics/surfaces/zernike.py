"""Zernike's circle polynomials in Noll's order, orthonormal on the unit disc, with their gradients.

Z_j = sqrt(n + 1) R_n^m(ρ), for m > 0 times sqrt(2) cos mθ (even j) or sqrt(2) sin mθ (odd j): the mean of Z_i Z_j over
the disc is 1 for i = j, else 0 (Noll, J. Opt. Soc. Am. 66, 207, 1976).  With ζ = x + i y and V_n^m = R_n^|m| e^imθ,

    V_n^m = ζ V_{n-1}^{m-1} + ζ* V_{n-1}^{m+1} - V_{n-2}^m,
    ∂V_n^m/∂x = n (V_{n-1}^{m-1} + V_{n-1}^{m+1}) + ∂V_{n-2}^m/∂x,
    ∂V_n^m/∂y = i n (V_{n-1}^{m-1} - V_{n-1}^{m+1}) + ∂V_{n-2}^m/∂y,

with V_n^m = 0 for |m| > n and V_n^-m = V_n^m*.  These recurrences lose no digits at high orders (Shakibaei and
Paramesran, Opt. Lett. 38, 2487, 2013; Janssen, J. Opt. Soc. Am. A 31, 1604, 2014).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

POINTS_AT_A_TIME = 1 << 13  # points evaluated at a time, whose harmonics fit the cache
Complex = tuple[Tensor, Tensor]  # real and imaginary part, since torch's own complex numbers are slower
Harmonic = tuple[Complex, Complex, Complex]  # V_n^m and its derivatives in x and in y


def noll(j: int) -> tuple[int, int]:
    """Return (n, m) of Z_j, j = 1, 2, 3, …; m > 0: cos mθ, m < 0: sin |m|θ.  Noll 1976, Table I."""
    n = (math.isqrt(8 * j - 7) - 1) // 2
    place = j - n * (n + 1) // 2  # number 1 … n + 1 among the terms of degree n
    m = 2 * (place // 2) if n % 2 == 0 else 2 * ((place - 1) // 2) + 1
    return n, m if j % 2 == 0 else -m


def series(coefficients: Sequence[float], x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return (f, ∂f/∂x, ∂f/∂y) of f = Σ_j c_j Z_j, j = 1, 2, …, at points x, y in radii of the disc; shaped like x.

    Differentiable in x and y.  The polynomials are also evaluated outside the disc, where they soon grow.
    """
    chunks = (p.reshape(-1).split(POINTS_AT_A_TIME) for p in (x, y))
    parts = [_series(coefficients, *chunk) for chunk in zip(*chunks, strict=True)]
    f, f_x, f_y = (torch.cat(part).view(x.shape) for part in zip(*parts, strict=True))
    return f, f_x, f_y


def _series(coefficients: Sequence[float], x: Tensor, y: Tensor) -> list[Tensor]:
    wanted = {noll(j): c for j, c in enumerate(coefficients, start=1) if c}
    zero = torch.zeros_like(x)
    sums = [zero, zero, zero]
    before: dict[int, Harmonic] = {}  # harmonics of degree n - 2, by m
    last: dict[int, Harmonic] = {}  # harmonics of degree n - 1, by m
    for n in range(1 + max((degree for degree, _ in wanted), default=-1)):
        now = {m: _harmonic((x, y), n, m, known=(before, last)) for m in range(n % 2, n + 1, 2)}
        for m, harmonic in now.items():
            scale = math.sqrt((n + 1) * (2 if m else 1))
            for part, sign in enumerate((1, -1) if m else (1,)):  # cosine, sine
                if c := wanted.get((n, sign * m), 0.0) * scale:
                    sums = [whole + c * value[part] for whole, value in zip(sums, harmonic, strict=True)]
        before, last = last, now
    return sums


def _harmonic(zeta: Complex, n: int, m: int, known: tuple[dict[int, Harmonic], dict[int, Harmonic]]) -> Harmonic:
    """Return V_n^m, m >= 0, at ζ = zeta; known: harmonics of degrees n - 2 and n - 1, each by m."""
    (x, y), (before, last), zero = zeta, known, torch.zeros_like(zeta[0])
    if n == 0:
        return (torch.ones_like(x), zero), (zero, zero), (zero, zero)
    none = (zero, zero), (zero, zero), (zero, zero)
    (low, *_), (high, *_), (value, in_x, in_y) = last.get(abs(m - 1), none), last.get(m + 1, none), before.get(m, none)
    if m == 0:
        low = low[0], -low[1]  # V_n^-m = V_n^m*
    plus, minus = [p + q for p, q in zip(low, high, strict=True)], [p - q for p, q in zip(low, high, strict=True)]
    return (
        (x * plus[0] - y * minus[1] - value[0], x * plus[1] + y * minus[0] - value[1]),
        (in_x[0] + n * plus[0], in_x[1] + n * plus[1]),
        (in_y[0] - n * minus[1], in_y[1] + n * minus[0]),
    )
