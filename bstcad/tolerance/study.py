"""Monte Carlo study of a lens with errors: sensitivities, trials, yield, loosest tolerances, gain by adjustment.

RRMSD of a trial comes from superposed pictures.  Near its optimum RRMSD is nearly quadratic in the errors, so its own
derivatives mislead; those of the picture add up.  With z the amounts in standard deviations and E(z) the picture, of
the target's sum,

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
from dataclasses import dataclass, replace
from itertools import count, repeat
from typing import Any, Protocol

import numba
import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq, minimize
from scipy.stats import binomtest
from threadpoolctl import threadpool_limits

from bstcad.optics.emitters import Emitter
from bstcad.optics.kernels.reductions import dot
from bstcad.optics.lens import Lens
from bstcad.optics.wavefront import Wave
from bstcad.optics.wavefront_error import exit_pupil, moved_pupil, residual, wavefront_error
from bstcad.report.tolerances import WIDEST, Sensitivity
from bstcad.tolerance.grades import GRADES, USUAL, limit
from bstcad.tolerance.perturbations import Perturbation, Setup, draws, kinds, perturbed, trials

Progress = Callable[[str, int, int, str], None]
# Calls work(shared, item) of each item, somewhere: the results, in the order of the items.
Spread = Callable[[Callable[[Any, Any], Any], Any, Sequence[Any]], Iterator[Any]]

RAYS = 192  # rays a side of the light whose wavefront is studied

# --- pictures ---------------------------------------------------------------------------------------------------------


def here(work: Callable[[Any, Any], Any], shared: Any, items: Sequence[Any]) -> Iterator[Any]:
    """In this process, two at a time: while one picture keeps a single core busy, the other has the rest."""
    if not len(items):
        return
    yield work(shared, items[0])
    at_once = min(2, torch.get_num_threads()) if _threads_may_share() else 1
    threads = ThreadPoolExecutor(at_once)
    try:
        yield from threads.map(work, repeat(shared), items[1:])
    finally:  # a picture under way may take ten seconds, and a Ctrl-C does not wait for it
        threads.shutdown(wait=False, cancel_futures=True)


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

    figure = "RRMSD"  # that the norm of `of` is

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
class Wavefronts:
    """Wavefront errors of a setup with errors, in waves of the main wavelength; its first channel is of that line.

    The OPD of a ray, by its place on the plane before the lens, is nearly linear in the errors, and its RMS is a norm,
    as RRMSD is that of a picture: the same model superposes it.  The wanted wave stays in the room; piston and tilt
    are removed anew for each lens, so that a lens may aim its light elsewhere.
    """

    setup: Setup
    perturbations: tuple[Perturbation, ...]
    wave: Wave
    wavelength: float  # nm
    rays: int = RAYS  # a side

    figure = "wavefront RMS"

    def of(self, amounts: Sequence[float]) -> np.ndarray:
        """(rays²,) OPD without piston and tilt, times the root of each ray's share of the flux: its norm is the RMS."""
        setup = perturbed(self.setup, self.perturbations, amounts)
        source, lens = _main(setup)
        pupil = exit_pupil(source, lens, self.wave.z, self.rays)
        if setup.placed is not None:
            pupil = moved_pupil(pupil, setup.placed, self.wave.z)
        return residual(pupil, self.wave, self.wavelength).ravel().numpy()

    @property
    def designed(self) -> float:
        """RMS (waves) of the setup as it is, by as many rays as a report's."""
        return wavefront_error(*_main(self.setup), self.wave).without_tilt.rms


def _main(setup: Setup) -> tuple[Emitter, Lens]:
    """The light of the main line, and the lens as it meets it."""
    channel = setup.channels[0]
    return channel.source, channel.through(setup.lens)


class Traced(Protocol):
    """Protocol of what is traced of a setup with errors: Pictures, or Wavefronts."""

    setup: Setup
    perturbations: tuple[Perturbation, ...]
    figure: str  # of merit

    def of(self, amounts: Sequence[float]) -> np.ndarray:
        """(any,) a vector whose norm is the figure of merit, nearly linear in the amounts."""
        ...


def _figure(goal: Traced, amounts: Sequence[float]) -> float:
    """The figure of merit by a full trace."""
    return _norm(goal.of(amounts))


def _norm(vector: np.ndarray) -> float:
    """sqrt(Σ v²)."""
    vector = torch.from_numpy(vector)
    return math.sqrt(dot(vector, vector))


# --- the model of superposed pictures ---------------------------------------------------------------------------------

STEP = 0.5  # standard deviations either way, for the derivative by each perturbation
# (first direction, ξ in standard deviations at which pictures are traced along it and the next): a picture that moves
# by more than its own detail does not grow as a polynomial.
NODES = ((0, (-3.0, -2.0, -1.2, -0.5, 0.5, 1.2, 2.0, 3.0)), (4, (-2.5, -1.0, 1.0, 2.5)), (8, (-1.0, 1.0)))
BENT = 12  # strongest main directions, which have nodes; along the others pictures are straight lines
WEAK = 1e-3  # of the strongest direction's change of the picture: weaker ones are straight lines, too


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
        """RRMSD (…) of amounts (…, k), of the first k perturbations; the others are zero."""
        k = amounts.shape[-1]
        phi = self._weights(product(amounts / self.sigmas[:k], self.directions[:k]))
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


def model(pictures: Traced, progress: Progress = lambda *told: None, spread: Spread = here) -> Model:
    """Traces two pictures for each perturbation, and some along each main direction, more along the stronger ones."""
    sigmas = np.array([p.sigma for p in pictures.perturbations])
    n = len(sigmas)
    nodes = [next(xi for first, xi in reversed(NODES) if k >= first) for k in range(min(n, BENT))]
    total, done = 1 + 2 * n + sum(map(len, nodes)), count(1)

    def traced(amounts: Sequence[np.ndarray]) -> Iterator[np.ndarray]:
        for picture in spread(type(pictures).of, pictures, [z * sigmas for z in amounts]):
            progress("sensitivity", next(done), total, "")
            yield picture

    straight = traced([np.zeros(n), *(way * STEP * e for e in np.eye(n) for way in (1, -1))])
    nominal = next(straight)
    first = np.stack([(up - next(straight)) / (2 * STEP) for up in straight])
    strength, directions = main_axes(gram(first))
    nodes = nodes[: int(np.sum(strength[:BENT] >= WEAK**2 * strength[0]))]
    bent = [
        picture - nominal
        for picture in traced([xi * directions[:, k] for k, along in enumerate(nodes) for xi in along])
    ]
    every = np.concatenate([np.stack([nominal, *bent]), product(directions.T[len(nodes) :], first)])
    return Model(sigmas, first, directions, nodes=tuple(nodes), gram=gram(every))


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a (…, n) times b (n, m), added up in one order."""
    return np.einsum("...i,ij->...j", a, b, optimize=False)


def gram(rows: np.ndarray) -> np.ndarray:
    """(n, n) products of all pairs of rows (n, long)."""
    vectors = [torch.from_numpy(np.ascontiguousarray(row)) for row in rows]
    products = np.empty((len(vectors), len(vectors)))
    for i, a in enumerate(vectors):
        for j, b in enumerate(vectors[: i + 1]):
            products[i, j] = products[j, i] = dot(a, b)
    return products


def main_axes(symmetric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(eigenvalues (n,), the largest first; eigenvectors (n, n) as columns) of a symmetric matrix."""
    with threadpool_limits(1, user_api="blas"):
        values, axes = np.linalg.eigh(symmetric)
    return values[::-1], axes[:, ::-1]


# --- the study --------------------------------------------------------------------------------------------------------

LINEAR, FULL = 10_000, 200  # trials by the model, and of them by full traces
WORST = 5  # trials that are shown
ADJUSTED = {f"screen.{way}" for way in ("decentre_x", "decentre_y", "axial", "tilt_x", "tilt_y", "clocking")}
REACH = 8.0  # standard deviations over which the screen can be adjusted
ADJUSTABLE = 10.0  # limit of an adjustment that is no error of the study, over that of the usual grade
NEARBY = 1e-4  # standard deviations: step of the difference quotients
OTHER = 7919  # added to the seed, for independent trials

Yield = tuple[float, float, float]  # share of the trials within a limit: low, likely, high (95 %, Wilson)


@dataclass(frozen=True, eq=False)
class Study:
    """Result of a Monte Carlo of a setup; of a wavefront every RRMSD is its RMS in waves."""

    perturbations: tuple[Perturbation, ...]
    model: Model  # of the perturbations, followed by the adjustments of the screen that are not among them
    sensitivities: tuple[Sensitivity, ...]  # the worst first
    limit: float  # RRMSD; infinite: any passes
    seed: int
    rrmsd: float  # of the setup as designed
    linear: np.ndarray  # (trials,) RRMSD of all trials by the model
    full: np.ndarray  # (fewer,) RRMSD of the first trials by full traces
    adjusted: np.ndarray  # (fewer,) of the same by the model, with the screen adjusted

    @property
    def disagreement(self) -> np.ndarray:
        """(fewer,) relative difference of the model from the full traces."""
        return np.abs(self.linear[: len(self.full)] / self.full - 1)

    def change_of(self, error: str) -> float:
        """The change of its figure by one standard deviation of an error."""
        return next(s.rrmsd_change for s in self.sensitivities if s.name == error)

    @property
    def worst(self) -> list[int]:
        """Numbers of the worst fully traced trials."""
        return np.argsort(self.full)[::-1][:WORST].tolist()

    def share(self, rrmsds: np.ndarray) -> Yield:
        """Share of these trials within the limit."""
        return share_of(rrmsds <= self.limit)

    @property
    def off(self) -> float:
        """What the design's own figure, squared, has too much by the traces of the study."""
        return self.model.rrmsd**2 - self.rrmsd**2

    def kept(self, amounts: np.ndarray) -> np.ndarray:
        """(…) True for amounts (…, k) with which the limit is kept, by the model."""
        return _less(self.model.rrmsds(amounts), self.off) <= self.limit


def share_of(good: np.ndarray) -> Yield:
    """Share of the trials (trials,) that are True."""
    interval = binomtest(int(good.sum()), len(good)).proportion_ci(method="wilson")
    return float(interval.low), int(good.sum()) / len(good), float(interval.high)


def worst_of(studies: Sequence[Study]) -> Study:
    """Studies of the targets of one lens, of the same trials and one limit: in each figure the worst target; one as is.

    Shares are of the mean square that errors add to all pictures, each over its target's norm.
    """
    first, *others = studies
    if not others:
        return first
    added = sum(np.sum(study.model.first[: len(first.perturbations)] ** 2, axis=1) for study in studies)
    shares = {p.kind.name: float(a) for p, a in zip(first.perturbations, added / (added.sum() or 1.0), strict=True)}
    changes = {name: max(s.change_of(name) for s in studies) for name in shares}
    sensitivities = [
        replace(s, rrmsd_change=changes[s.name], share=shares[s.name])
        for s in sorted(first.sensitivities, key=lambda s: changes[s.name], reverse=True)
    ]
    worst = {name: np.max([getattr(s, name) for s in studies], axis=0) for name in ("linear", "full", "adjusted")}
    return replace(first, sensitivities=tuple(sensitivities), rrmsd=max(s.rrmsd for s in studies), **worst)


def study(
    pictures: Traced, limit: float, seed: int, rrmsd: float, *, linear: int = LINEAR, full: int = FULL,
    progress: Progress = lambda *told: None, spread: Spread = here,
) -> Study:  # fmt: skip
    """Sensitivities and trials.  spread: where pictures are traced.

    limit and rrmsd are those of the figure of merit, of a wavefront its RMS in waves, as are all figures of the study.
    rrmsd: of the design, by independent rays.  Tubes have an error, the same in every trial: its square is taken off
    each RRMSD², so that the trials compare with the design's own figure.
    """
    perturbations = pictures.perturbations
    with_adjustments = (*perturbations, *adjustments(pictures.setup, perturbations))
    superposed = model(replace(pictures, perturbations=with_adjustments), progress, spread)
    off = superposed.rrmsd**2 - rrmsd**2
    amounts = trials(perturbations, seed, range(linear))
    traced = []
    for k, rrmsd_of_it in enumerate(spread(_figure, pictures, amounts[:full]), 1):
        traced.append(rrmsd_of_it)
        progress("trials", k, min(full, linear), f"{pictures.figure} {rrmsd_of_it:.4f}")
    adjusted = [adjust(superposed, with_adjustments, amounts[k]) for k in range(len(traced))]
    return Study(
        perturbations, superposed, _sensitivities(superposed, perturbations, off), limit=limit, seed=seed, rrmsd=rrmsd,
        linear=_less(superposed.rrmsds(amounts), off), full=_less(np.array(traced), off),
        adjusted=_less(np.array(adjusted), off),
    )  # fmt: skip


def _less(rrmsds: np.ndarray, off: float) -> np.ndarray:
    """RRMSDs without the error of the tubes, whose square is `off`."""
    return np.sqrt(np.maximum(rrmsds**2 - off, 0.0))


def _sensitivities(superposed: Model, perturbations: Sequence[Perturbation], off: float) -> tuple[Sensitivity, ...]:
    """Effect of one standard deviation of each error alone, as the mean of both signs; the worst first."""
    n = len(perturbations)
    sigmas = np.diag(superposed.sigmas[:n])
    either = (_less(superposed.rrmsds(sigmas), off) + _less(superposed.rrmsds(-sigmas), off)) / 2
    added = np.sum(superposed.first[:n] ** 2, axis=1)
    changes, shares = either - _less(np.array([superposed.rrmsd]), off), added / (added.sum() or 1.0)
    each = [
        Sensitivity(
            name=p.kind.name, words=p.kind.words, unit=p.kind.unit, limit=p.limit, distribution=p.distribution,
            cost=p.cost, sigma=p.sigma, rrmsd_change=float(change), share=float(share),
        )
        for p, change, share in zip(perturbations, changes, shares, strict=True)
    ]  # fmt: skip
    return tuple(sorted(each, key=lambda s: s.rrmsd_change, reverse=True))


def adjustments(setup: Setup, errors: Sequence[Perturbation]) -> tuple[Perturbation, ...]:
    """Shift, focus, tilt and clocking of the screen, as far as they are not among the errors."""
    named, usual = {error.kind.name for error in errors}, GRADES[USUAL]
    missing = [kind for name, kind in kinds(setup).items() if name in ADJUSTED - named]
    return tuple(Perturbation(kind, ADJUSTABLE * limit(kind, usual, setup)) for kind in missing)


def adjust(superposed: Model, perturbations: Sequence[Perturbation], amounts: np.ndarray) -> float:
    """RRMSD by the model with the screen where it is least: shift, focus, tilt and clocking.

    perturbations: those of the model.  amounts (k,): of the first k.
    """
    free = [k for k, p in enumerate(perturbations) if p.kind.name in ADJUSTED]
    amounts = np.pad(amounts, (0, len(perturbations) - len(amounts)))

    def moved(steps: np.ndarray) -> np.ndarray:
        tried = np.broadcast_to(amounts, (*steps.shape[:-1], len(amounts))).copy()
        tried[..., free] += steps * superposed.sigmas[free]
        return tried

    nearby = np.concatenate([np.zeros((1, len(free))), NEARBY * np.eye(len(free)), -NEARBY * np.eye(len(free))])

    def square_and_gradient(steps: np.ndarray) -> tuple[float, np.ndarray]:
        at, up, down = np.split(superposed.rrmsds(moved(steps + nearby)) ** 2, [1, 1 + len(free)])
        return float(at[0]), (up - down) / (2 * NEARBY)

    best = minimize(
        square_and_gradient, np.zeros(len(free)), jac=True, bounds=[(-REACH, REACH)] * len(free), method="L-BFGS-B"
    )
    return float(superposed.rrmsds(moved(best.x)))


def loosest(study: Study, wanted: float, others: Sequence[Study] = ()) -> tuple[tuple[Perturbation, ...], Yield]:
    """The loosest tolerances that keep a yield (0 … 1), and their yield by independent trials.

    others: studies of the other goals by the same trials; a lens passes that keeps to all limits, over which the
    squares q_i of all goals add up.

    Holding error i at u_i times its limit costs c_i / u_i and adds q_i u_i² to the mean square of the picture.  The
    least cost for a given sum of the latter is at u_i ∝ (c_i / q_i)^(1/3); one factor on all then brings the yield, by
    the model.
    """
    perturbations, goals = study.perturbations, (study, *others)
    added = sum(
        (study.limit / goal.limit) ** 2 * np.sum(goal.model.first[: len(perturbations)] ** 2, axis=1) for goal in goals
    )
    added = np.maximum(added, 1e-30)
    shape = np.cbrt(np.array([p.cost for p in perturbations]) / added)
    shape /= np.exp(np.mean(np.log(shape)))
    even = np.random.default_rng((study.seed, OTHER)).random((LINEAR, len(perturbations)))
    unit = draws(perturbations, even)

    def all_kept(amounts: np.ndarray) -> np.ndarray:
        return np.logical_and.reduce([goal.kept(amounts) for goal in goals])

    def excess(log_factor: float) -> float:
        widths = np.minimum(np.exp(log_factor) * shape, WIDEST)
        return float(np.mean(all_kept(unit * widths))) - wanted

    log_factor = 10.0 if excess(10.0) >= 0 else brentq(excess, -10.0, 10.0, xtol=1e-4)
    widths = np.minimum(np.exp(log_factor) * shape, WIDEST)
    loose = tuple(replace(p, limit=float(p.limit * w)) for p, w in zip(perturbations, widths, strict=True))
    fresh = trials(loose, study.seed + OTHER, range(LINEAR))
    return loose, share_of(all_kept(fresh))
