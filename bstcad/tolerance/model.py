"""RRMSD of any error of a setup, from pictures of a few: superposed, not the scalar but the pictures.

Near its optimum RRMSD is nearly quadratic in what is off, so its own derivatives mislead; those of the picture add up.
With z the amounts in standard deviations and E(z) the picture, of the target's sum,

    E(z) ≈ E(0) + Σ_k f_k(ξ_k),   ξ = Vᵀ z,

where V are the main directions, in which the pictures' derivatives are orthogonal: what moves the picture the same way
is one direction, whatever moves it.  f_k(ξ) is a natural cubic spline through pictures that were traced at a few ξ, so
that E(z) is a sum of pictures P_j with weights φ_j(z), and

    RRMSD²(z) = φᵀ G φ

with the Gram matrix G of E(0) - target and the P_j, all over the target's norm: ten thousand trials are one product of
matrices.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numba
import numpy as np
import torch
from scipy.interpolate import CubicSpline

from bstcad.optics.kernels.reductions import dot
from bstcad.tolerance.fixed_sums import gram, main_axes, product
from bstcad.tolerance.perturbation import Perturbation, perturbed
from bstcad.tolerance.setup import Setup

STEP = 0.5  # standard deviations either way, for the derivative by each perturbation
# Where along a main direction pictures are traced, in its standard deviations, from so many directions on: a picture
# that moves by more than its own detail does not grow as a polynomial.
NODES = ((0, (-3.0, -2.0, -1.2, -0.5, 0.5, 1.2, 2.0, 3.0)), (4, (-2.5, -1.0, 1.0, 2.5)), (8, (-1.0, 1.0)))
BENT = 12  # main directions along which that is done, the strongest; along the others pictures are taken as straight
WEAK = 1e-3  # of the strongest: so are those that change the picture by less
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
    """May two threads run numba's parallel kernels at a time?  Its own pool of threads would end the process."""
    try:
        return numba.threading_layer() in ("tbb", "omp")
    except ValueError:  # none has run yet, so that nothing tells
        return False


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures of a setup that is off, of the target's sum and over the target's norm."""

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
    """RRMSD of errors, as above."""

    sigmas: np.ndarray  # (n,) standard deviations, in the perturbations' units
    first: np.ndarray  # (n, pixels) derivative of the picture by each perturbation, over one standard deviation
    directions: np.ndarray  # (n, n) main directions V, orthonormal columns, the strongest first
    nodes: tuple[tuple[float, ...], ...]  # ξ at which pictures were traced along each of the first of them
    gram: np.ndarray  # (1 + j, 1 + j), j pictures: of those nodes, then the derivatives along the other directions

    @property
    def rrmsd(self) -> float:
        """Of what is nominal, by the same tubes."""
        return float(np.sqrt(self.gram[0, 0]))

    def rrmsds(self, amounts: np.ndarray) -> np.ndarray:
        """RRMSD (…) of amounts (…, n)."""
        phi = self._weights(product(amounts / self.sigmas, self.directions))
        return np.sqrt(np.maximum(np.sum(product(phi, self.gram) * phi, axis=-1), 0.0))

    def _weights(self, along: np.ndarray) -> np.ndarray:
        """φ (…, 1 + j) of places (…, n) along the main directions."""
        parts = [np.ones((*along.shape[:-1], 1))]
        for k, nodes in enumerate(self.nodes):
            spline, slope = _cardinal(nodes)
            inside = np.clip(along[..., k], min(nodes), max(nodes))
            parts.append(spline(inside) + slope(inside) * (along[..., k] - inside)[..., None])  # straight on beyond
        return np.concatenate([*parts, along[..., len(self.nodes) :]], axis=-1)


@functools.cache
def _cardinal(nodes: tuple[float, ...]) -> tuple[CubicSpline, CubicSpline]:
    """The weights of the values at the nodes in a natural cubic spline through them and zero at zero; their slopes."""
    places = np.array(sorted((0.0, *nodes)))
    unit = np.eye(len(places))[:, [k for k, place in enumerate(places) if place != 0.0]]
    spline = CubicSpline(places, unit, bc_type="natural")
    return spline, spline.derivative()


def model(
    pictures: Pictures, progress: Callable[[int, int], None] = lambda done, of: None, spread: Spread = here
) -> Model:
    """Traces two pictures for each perturbation, and some along each main direction, more along the stronger ones."""
    sigmas = np.array([p.sigma for p in pictures.perturbations])
    n = len(sigmas)
    count = 1 + 2 * n + sum(len(_nodes(k)) for k in range(min(n, BENT)))
    done = 0

    def traced(places: Sequence[np.ndarray]) -> Iterator[np.ndarray]:
        nonlocal done
        for found in spread(Pictures.of, pictures, [z * sigmas for z in places]):
            done += 1
            progress(done, count)
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
    every = np.concatenate(
        [np.stack([nominal, *(found - nominal for found in traced(along))]), product(directions.T[len(nodes) :], first)]
    )
    return Model(sigmas, first, directions, tuple(nodes), gram(every))


def _norm(vector: np.ndarray) -> float:
    """sqrt(Σ v²)."""
    vector = torch.from_numpy(vector)
    return math.sqrt(dot(vector, vector))


def _nodes(k: int) -> tuple[float, ...]:
    """Where along main direction k pictures are traced."""
    return next(nodes for first, nodes in reversed(NODES) if k >= first)
