"""RRMSD of any errors of a setup, by superposing pictures of a few.

Near its optimum RRMSD is nearly quadratic in the errors, so its own derivatives mislead; those of the picture add up.
With z the amounts in standard deviations and E(z) the picture, of the target's sum,

    E(z) ≈ E(0) + Σ_k f_k(ξ_k),   ξ = Vᵀ z,

where V are the main directions, in which the pictures' derivatives are orthogonal: errors that move the picture alike
share one direction.  f_k(ξ) is a natural cubic spline through pictures that were traced at a few ξ, so that E(z) is a
sum of pictures P_j with weights φ_j(z), and

    RRMSD²(z) = φᵀ G φ

with the Gram matrix G of E(0) - target and the P_j, all over the target's norm: ten thousand trials are one product of
matrices.  No bit depends on the number of threads: sums over pixels have fixed parts (optics/kernels/reductions.py),
small products are numpy's own loops, and the eigenvectors are LAPACK's in one thread.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import count, repeat
from typing import Any

import numba
import numpy as np
import torch
from scipy.interpolate import CubicSpline
from threadpoolctl import threadpool_limits

from bstcad.optics.kernels.reductions import dot
from bstcad.tolerance.perturbations import Perturbation, perturbed
from bstcad.tolerance.setup import Setup

STEP = 0.5  # standard deviations either way, for the derivative by each perturbation
# (first direction, ξ in standard deviations at which pictures are traced along it and the next): a picture that moves
# by more than its own detail does not grow as a polynomial.
NODES = ((0, (-3.0, -2.0, -1.2, -0.5, 0.5, 1.2, 2.0, 3.0)), (4, (-2.5, -1.0, 1.0, 2.5)), (8, (-1.0, 1.0)))
BENT = 12  # strongest main directions, which have nodes; along the others pictures are straight lines
WEAK = 1e-3  # of the strongest direction's change of the picture: weaker ones are straight lines, too
# Calls work(shared, item) of each item, somewhere: the results, in the order of the items.
Spread = Callable[[Callable[[Any, Any], Any], Any, Sequence[Any]], Iterator[Any]]


def here(work: Callable[[Any, Any], Any], shared: Any, items: Sequence[Any]) -> Iterator[Any]:
    """In this process, two at a time: while one picture keeps a single core busy, the other has the rest."""
    if not len(items):
        return
    yield work(shared, items[0])
    at_once = min(2, torch.get_num_threads()) if _threads_may_share() else 1
    threads = ThreadPoolExecutor(at_once)
    try:
        yield from threads.map(work, repeat(shared), items[1:])
    finally:
        threads.shutdown(cancel_futures=True)


def _threads_may_share() -> bool:
    """May two threads run numba's parallel kernels at a time?  Its own pool of threads (workqueue) would abort."""
    try:
        return numba.threading_layer() in ("tbb", "omp")
    except ValueError:  # not known before the first kernel runs
        return False


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures of a setup with errors, of the target's sum and over the target's norm."""

    setup: Setup
    perturbations: tuple[Perturbation, ...]
    target: np.ndarray  # (rows, columns) of any sum
    tubes: int  # a side, a channel

    def of(self, amounts: Sequence[float]) -> np.ndarray:
        """(pixels,) the picture with these amounts, less the target: its norm is the RRMSD."""
        target = self.target.ravel()
        return (self.light(amounts).ravel() - target) / _norm(target)

    def light(self, amounts: Sequence[float]) -> np.ndarray:
        """(rows, columns) the picture with these amounts, of the target's sum."""
        picture = perturbed(self.setup, self.perturbations, amounts).picture(self.tubes)
        total = picture.sum()
        return picture * (self.target.sum() / total) if total > 0 else picture

    def rrmsd(self, amounts: Sequence[float]) -> float:
        """RRMSD by a full trace (Wang et al. 2023, Eq. 15)."""
        return _norm(self.of(amounts))


@dataclass(frozen=True, eq=False)
class Model:
    """RRMSD of errors by superposed pictures."""

    sigmas: np.ndarray  # (n,) standard deviations, in the perturbations' units
    first: np.ndarray  # (n, pixels) derivative of the picture by each perturbation, over one standard deviation
    directions: np.ndarray  # (n, n) main directions V, orthonormal columns, the strongest first
    nodes: tuple[tuple[float, ...], ...]  # ξ of the pictures traced along each of the first directions
    gram: np.ndarray  # (1 + j, 1 + j), j pictures: of those nodes, then the derivatives along the other directions

    @property
    def rrmsd(self) -> float:
        """Of the design itself, by the same tubes."""
        return float(np.sqrt(self.gram[0, 0]))

    def rrmsds(self, amounts: np.ndarray) -> np.ndarray:
        """RRMSD (…) of amounts (…, n)."""
        phi = self._weights(product(amounts / self.sigmas, self.directions))
        return np.sqrt(np.maximum(np.sum(product(phi, self.gram) * phi, axis=-1), 0.0))

    def _weights(self, along: np.ndarray) -> np.ndarray:
        """φ (…, 1 + j) at ξ (…, n) along the main directions."""
        parts = [np.ones((*along.shape[:-1], 1))]
        for k, nodes in enumerate(self.nodes):
            spline, slope = _cardinal(nodes)
            inside = np.clip(along[..., k], min(nodes), max(nodes))
            parts.append(spline(inside) + slope(inside) * (along[..., k] - inside)[..., None])  # straight on beyond
        return np.concatenate([*parts, along[..., len(self.nodes) :]], axis=-1)


@functools.cache
def _cardinal(nodes: tuple[float, ...]) -> tuple[CubicSpline, CubicSpline]:
    """Weights of the nodes' values in a natural cubic spline through them and zero at zero, and their slopes."""
    xi = np.array(sorted((0.0, *nodes)))
    spline = CubicSpline(xi, np.eye(len(xi))[:, xi != 0.0], bc_type="natural")
    return spline, spline.derivative()


def model(
    pictures: Pictures, progress: Callable[[int, int], None] = lambda done, of: None, spread: Spread = here
) -> Model:
    """Traces two pictures for each perturbation, and some along each main direction, more along the stronger ones."""
    sigmas = np.array([p.sigma for p in pictures.perturbations])
    n = len(sigmas)
    total = 1 + 2 * n + sum(len(_nodes(k)) for k in range(min(n, BENT)))
    done = count(1)

    def traced(amounts: Sequence[np.ndarray]) -> Iterator[np.ndarray]:
        for found in spread(Pictures.of, pictures, [z * sigmas for z in amounts]):
            progress(next(done), total)
            yield found

    steps = [way * STEP * e for e in np.eye(n) for way in (1, -1)]
    found = traced([np.zeros(n), *steps])
    nominal = next(found)
    first = np.stack([(up - next(found)) / (2 * STEP) for up in found])
    strength, directions = main_axes(gram(first))
    along, nodes = [], []
    for k in range(min(n, BENT)):
        if strength[k] < WEAK**2 * strength[0]:
            break
        nodes.append(_nodes(k))
        along += [xi * directions[:, k] for xi in nodes[-1]]
    bent = [found - nominal for found in traced(along)]
    every = np.concatenate([np.stack([nominal, *bent]), product(directions.T[len(nodes) :], first)])
    return Model(sigmas, first, directions, nodes=tuple(nodes), gram=gram(every))


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a (…, n) times b (n, m), added up in one order."""
    return np.einsum("...i,ij->...j", a, b, optimize=False)


def gram(rows: np.ndarray) -> np.ndarray:
    """(n, n) products of all pairs of rows (n, long)."""
    vectors = [torch.from_numpy(np.ascontiguousarray(row)) for row in rows]
    found = np.empty((len(vectors), len(vectors)))
    for i, a in enumerate(vectors):
        for j, b in enumerate(vectors[: i + 1]):
            found[i, j] = found[j, i] = dot(a, b)
    return found


def main_axes(symmetric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(eigenvalues (n,), the largest first; eigenvectors (n, n) as columns) of a symmetric matrix."""
    with threadpool_limits(1, user_api="blas"):
        values, axes = np.linalg.eigh(symmetric)
    return values[::-1], axes[:, ::-1]


def _norm(vector: np.ndarray) -> float:
    """sqrt(Σ v²)."""
    vector = torch.from_numpy(vector)
    return math.sqrt(dot(vector, vector))


def _nodes(k: int) -> tuple[float, ...]:
    """ξ of the pictures traced along main direction k."""
    return next(nodes for first, nodes in reversed(NODES) if k >= first)
