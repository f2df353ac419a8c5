"""The slope fit of stage 1: a linear least-squares fit of a surface to given slopes.

Wang et al. 2023 minimise Σ |P_t - P|², from landing point P to aim P_t, by Adam (tailoring/baselines/paper.py).  The
slopes here are those of the transport map (`slope_map.fit_to_map`), or those that send each ray to its aim
(`tailor_to_aim`): at a known point of the face they follow from Snell's law in closed form.  The spline is linear in
its heights, so the best fit is a linear least-squares problem, which takes a few preconditioned conjugate-gradient
steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from bstcad.optics.lens.interfaces import intersect
from bstcad.optics.lens.lens import Lens
from bstcad.optics.numerics.reductions import total
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces.bspline import BSplineSurface, evaluate, net_gradient
from bstcad.optics.surfaces.rays import Rays
from bstcad.optics.trace.reach import wanted_slopes
from bstcad.optics.trace.trace import across
from bstcad.optics.trace.unfolding import image_from_last_net
from bstcad.tailoring.merit import Spectrum

BLOCK_POINTS = 1 << 22  # number of points whose slopes and residuals are in memory together: 0.3 GB
DEPENDENCE_TOLERANCE = 1e-12  # squared slopes of a monomial after / before orthogonalisation; less is rounding


@dataclass(frozen=True)
class Fit:
    """Settings of a slope fit."""

    # weight of the bending energy (spacing · curvature)² of the change of the surface, relative to slope²; if unlit
    # is 0, this energy determines the surface where no ray falls
    bending: float = 1e-4
    steps: int = 8  # number of conjugate-gradient steps
    degree: int = 0  # degree of a polynomial that is fitted first and extrapolates where no ray falls; 0: no polynomial
    unlit: float = 0.0  # weight of a point without light, fitted to its present slopes; the weight of a lit point is 1


def fit_slopes(
    surface: BSplineSurface, x: Tensor, y: Tensor, z_x: Tensor, z_y: Tensor, weight: Tensor, fit: Fit = Fit()
) -> BSplineSurface:
    """Return the surface after `fit.steps` steps that minimise Σ w |∇h - (z_x, z_y)|² / Σ w plus a bending energy.

    Conjugate gradients start from the surface plus the polynomial of the fit, in the variable of `Spectrum`; only the
    change from this start has bending energy.  x, y (mm), slopes z_x, z_y and weights are (n,).
    """
    pitch_x, pitch_y = surface.pitch
    u, v = surface.along_net(x, y)
    spectrum = Spectrum.of(surface)
    weight = weight / total(weight)
    start = surface.potential
    damping = fit.bending * spectrum.energy * pitch_x * pitch_y

    def slopes(h: Tensor, some: slice = slice(None)) -> tuple[Tensor, Tensor]:
        _, h_u, h_v = evaluate(h, u[some], v[some])
        return h_u / pitch_x, h_v / pitch_y

    def missing(some: slice) -> tuple[Tensor, Tensor]:
        now_x, now_y = slopes(start, some)
        return z_x[some] - now_x, z_y[some] - now_y

    def adjoint(of: Callable[[slice], tuple[Tensor, Tensor]]) -> Tensor:
        """Apply the weighted transpose of `slopes` to the slopes `of(block)`, block by block."""
        g = torch.zeros_like(start)
        for some in blocks(len(u)):
            r_x, r_y = of(some)
            seeds = torch.zeros_like(r_x), r_x * weight[some] / pitch_x, r_y * weight[some] / pitch_y
            g = g + net_gradient(start, u[some], v[some], seeds)
        return spectrum.adjoint(g)

    if fit.degree:
        start = with_polynomial(start, monomials(surface, fit.degree), slopes, data=(z_x, z_y), weight=weight)

    def normal(c: Tensor) -> Tensor:
        return adjoint(partial(slopes, spectrum.heights(c))) + damping * c

    c = conjugate_gradients(normal, torch.zeros_like(start), adjoint(missing), fit.steps)
    return surface.with_potential(start + spectrum.heights(c))


def blocks(count: int) -> Iterator[slice]:
    """Yield slices of at most BLOCK_POINTS points that cover `count`."""
    for first in range(0, count, BLOCK_POINTS):
        yield slice(first, first + BLOCK_POINTS)


def conjugate_gradients(normal: Callable[[Tensor], Tensor], x: Tensor, residual: Tensor, steps: int) -> Tensor:
    """Return x after `steps` steps towards normal(x) = b; `normal` is linear, symmetric and positive definite.

    residual: b - normal(x) at the start.  The iteration ends earlier if the residual consists of rounding.
    """
    p, rho = residual, total(residual**2)
    tolerance = rho * torch.finfo(rho.dtype).eps ** 2
    for _ in range(steps):
        if not rho > tolerance:
            break
        q = normal(p)
        alpha = rho / total(p * q)
        x = x + alpha * p
        residual = residual - alpha * q
        rho, previous = total(residual**2), rho
        p = residual + (rho / previous) * p
    return x


Samples = tuple[Tensor, ...]  # values of a linear function at points, (n,) for each component


def with_polynomial(
    start: Tensor, monomials: list[Tensor], sample: Callable[[Tensor], Samples], data: Samples, weight: Tensor
) -> Tensor:
    """Return h = start + Σ b_k monomial_k with the b_k that minimise Σ w |sample(h) - data|², by modified Gram-Schmidt.

    sample: linear function of heights, such as the slopes at the points of the data.  The weighted samples of each
    monomial are made orthogonal to those of the previous ones.  (LAPACK's solvers divide their sums among threads,
    which changes their rounding.)
    """
    root = weight.sqrt()

    def weighted(samples: Samples) -> Tensor:
        return torch.cat([s * root for s in samples])

    left = weighted(tuple(z - now for z, now in zip(data, sample(start), strict=True)))
    basis: list[tuple[Tensor, Tensor]] = []  # (weighted samples, heights); the samples are orthonormal
    for h in monomials:
        q = weighted(sample(h))
        before = total(q * q)
        for q_k, h_k in basis:
            shared = total(q_k * q)
            q, h = q - shared * q_k, h - shared * h_k
        length = total(q * q)
        if not length > DEPENDENCE_TOLERANCE * before:  # dependent on the others at the lit points
            continue
        q, h = q / length.sqrt(), h / length.sqrt()
        basis.append((q, h))
        part = total(q * left)
        left, start = left - part * q, start + part * h
    return start


def monomials(surface: BSplineSurface, degree: int) -> list[Tensor]:
    """Return nets whose heights are x^i y^j, 1 <= i + j <= degree, with x and y from -1 to 1 across the net."""
    x, y = (torch.linspace(-1.0, 1.0, count).to(surface.heights) for count in surface.shape)
    powers = ((i, j) for i in range(degree + 1) for j in range(degree + 1 - i) if i + j > 0)
    return [x[:, None] ** i * y[None, :] ** j for i, j in powers]


def tailor_to_aim(lens: Lens, rays: Rays, aim: Tensor, receiver: Receiver, repeats: int = 3) -> Lens:
    """Return the lens whose last net sends `rays` (…) to `aim` (2, …) on a receiver, by fits of the slopes.

    repeats: number of fits; each fit changes the sag, and so the points where the rays meet the face.
    """
    receiver = image_from_last_net(lens, receiver)
    coming = across(rays, lens.interfaces[: lens.tailored_numbers[-1]])
    for _ in range(repeats):
        face = lens.last_tailored
        at_face, _ = intersect(face.surface, coming, face.outline, face.status_if_missed)
        lit = at_face.alive & (at_face.flux > 0)
        z_x, z_y = (torch.where(lit, s, torch.zeros_like(s)) for s in wanted_slopes(at_face, aim, receiver, face.law))
        samples = (*at_face.places, z_x, z_y, lit.to(z_x))
        x, y, z_x, z_y, weight = (t.reshape(-1) for t in samples)
        net = face.net
        lens = lens.with_last_net(fit_slopes(net, x, y, z_x=z_x, z_y=z_y, weight=weight).from_vertex().moved(net.z))
    return lens
