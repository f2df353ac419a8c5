"""The slope fit: the surface whose slopes send each ray where it should go.

Wang et al. 2023 minimise Σ |P_t - P|² by Adam (paper.py).  With the hit on the back face known, the normal that a ray
needs follows from Snell's law in closed form, and since the spline is linear in its heights the best fit of the slopes
is a linear least-squares problem: a few preconditioned conjugate-gradient steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface, evaluate, net_gradient
from bstcad.optics.interfaces import intersect
from bstcad.optics.kernels.reductions import total
from bstcad.optics.lens import Lens
from bstcad.optics.rays import Rays
from bstcad.optics.reach import wanted_slopes
from bstcad.optics.receivers import Receiver
from bstcad.optics.trace import across
from bstcad.optics.unfolding import seen_from_last_net
from bstcad.tailoring.merit import Spectrum

BLOCK = 1 << 22  # points whose slopes and residuals are held at a time: 0.3 GB
INDEPENDENT = 1e-12  # of a monomial's squared slopes: less than that is rounding


@dataclass(frozen=True)
class Fit:
    """Settings of a slope fit."""

    bending: float = 1e-4  # weight of (spacing · curvature)² beside slope²: decides where no ray falls
    steps: int = 8  # of conjugate gradients
    degree: int = 0  # of a polynomial that is fitted first and goes on smoothly where no ray falls


def fit_slopes(
    surface: BSplineSurface, x: Tensor, y: Tensor, z_x: Tensor, z_y: Tensor, weight: Tensor, fit: Fit = Fit()
) -> BSplineSurface:
    """Least squares: min Σ w |∇h(x, y) - (z_x, z_y)|² + small bending, by conjugate gradients in the Sobolev variable.

    x, y (mm), wanted slopes and weights are (n,); starts from the surface's own heights.
    """
    pitch_x, pitch_y = surface.pitch
    u, v = surface.along_net(x, y)
    spectrum = Spectrum.of(surface)
    weight = weight / total(weight)
    start = surface.heights
    damping = fit.bending * spectrum.energy * pitch_x * pitch_y

    def slopes(h: Tensor, some: slice = slice(None)) -> tuple[Tensor, Tensor]:
        _, h_u, h_v = evaluate(h, u[some], v[some])
        return h_u / pitch_x, h_v / pitch_y

    def missing(some: slice) -> tuple[Tensor, Tensor]:
        now_x, now_y = slopes(start, some)
        return z_x[some] - now_x, z_y[some] - now_y

    def adjoint(of: Callable[[slice], tuple[Tensor, Tensor]]) -> Tensor:
        """The transpose of `slopes`, weighted, of slopes at some points at a time."""
        g = torch.zeros_like(start)
        for some in blocks(len(u)):
            r_x, r_y = of(some)
            seeds = torch.zeros_like(r_x), r_x * weight[some] / pitch_x, r_y * weight[some] / pitch_y
            g = g + net_gradient(start, u[some], v[some], seeds)
        return spectrum.adjoint(g)

    if fit.degree:
        start = with_polynomial(start, monomials(surface, fit.degree), slopes, wanted=(z_x, z_y), weight=weight)

    c = conjugate_gradients(
        lambda c: adjoint(partial(slopes, spectrum.heights(c))) + damping * c,
        torch.zeros_like(start),
        adjoint(missing),
        fit.steps,
    )
    return replace(surface, heights=start + spectrum.heights(c))


def blocks(count: int) -> Iterator[slice]:
    """So many points, BLOCK of them at a time."""
    for first in range(0, count, BLOCK):
        yield slice(first, first + BLOCK)


def conjugate_gradients(normal: Callable[[Tensor], Tensor], x: Tensor, residual: Tensor, steps: int) -> Tensor:
    """x after so many steps towards normal(x) = b, normal symmetric and positive; residual: b - normal(x) at the start.

    Ends earlier where rounding alone is left: below that a step would divide noise by noise.
    """
    p, rho = residual, total(residual**2)
    enough = rho * torch.finfo(rho.dtype).eps ** 2
    for _ in range(steps):
        if not rho > enough:
            break
        q = normal(p)
        alpha = rho / total(p * q)
        x = x + alpha * p
        residual = residual - alpha * q
        rho, previous = total(residual**2), rho
        p = residual + (rho / previous) * p
    return x


def with_polynomial(
    start: Tensor,
    monomials: list[Tensor],
    slopes: Callable[[Tensor], tuple[Tensor, ...]],
    wanted: tuple[Tensor, ...],
    weight: Tensor,
) -> Tensor:
    """start + Σ b_k monomial_k with the b that make Σ w |slopes - wanted|² smallest, by modified Gram-Schmidt.

    Each monomial is made orthogonal, by its weighted slopes (or other samples), to those before it, and then
    takes its part of the residual.  (LAPACK's solvers for this divide their sums among threads; nine columns need
    none.)
    """
    root = weight.sqrt()

    def weighted(pair: tuple[Tensor, ...]) -> Tensor:
        return torch.cat([s * root for s in pair])

    left = weighted(tuple(z - now for z, now in zip(wanted, slopes(start), strict=True)))
    basis: list[tuple[Tensor, Tensor]] = []  # (weighted slopes, heights), orthonormal in the first
    for h in monomials:
        q = weighted(slopes(h))
        before = total(q * q)
        for q_k, h_k in basis:
            shared = total(q_k * q)
            q, h = q - shared * q_k, h - shared * h_k
        length = total(q * q)
        if not length > INDEPENDENT * before:  # where the lit places do not tell it from the others
            continue
        q, h = q / length.sqrt(), h / length.sqrt()
        basis.append((q, h))
        part = total(q * left)
        left, start = left - part * q, start + part * h
    return start


def monomials(surface: BSplineSurface, degree: int) -> list[Tensor]:
    """Heights of (nearly) x^i y^j, 1 <= i + j <= degree, x and y from -1 to 1 across the net."""
    x, y = (torch.linspace(-1.0, 1.0, count).to(surface.heights) for count in surface.shape)
    powers = ((i, j) for i in range(degree + 1) for j in range(degree + 1 - i) if i + j > 0)
    return [x[:, None] ** i * y[None, :] ** j for i, j in powers]


def tailor_to_aim(lens: Lens, rays: Rays, aim: Tensor, plane: Receiver, repeats: int = 3) -> Lens:
    """The lens whose last net sends `rays` (…) to `aim` (2, …) mm on the plane, by a least-squares fit of slopes.

    Repeated, because the sag moves the hits.
    """
    plane = seen_from_last_net(lens, plane)
    coming = across(rays, lens.interfaces[: lens.freeform[-1]])
    for _ in range(repeats):
        face = lens.last_freeform
        at_face, _, _ = intersect(face.surface, coming, face.outline, face.status_if_missed)
        lit = at_face.alive & (at_face.flux > 0)
        z_x, z_y = (torch.where(lit, s, torch.zeros_like(s)) for s in wanted_slopes(at_face, aim, plane, face.law))
        x, y, _ = at_face.position
        flat = (t.reshape(-1) for t in (x, y, z_x, z_y, lit.to(x)))
        lens = lens.with_last_net(fit_slopes(face.surface, *flat).from_vertex().moved(face.surface.z))
    return lens
