"""Monte Carlo study of a lens with errors: sensitivities, trials, yield, loosest tolerances, gain by adjustment.

The RRMSD of a trial is computed from superposed pictures.  Near its minimum the RRMSD is nearly quadratic in the
errors, and its derivatives are of little use, but the derivatives of the picture can be superposed.  With the amounts z
in standard deviations and the picture E(z), normalised to the flux of the target,

    E(z) ≈ E(0) + Σ_k f_k(ξ_k),   ξ = Vᵀ z,

where V are the principal directions, along which the derivatives of the picture are orthogonal: errors with the same
effect on the picture share one direction.  f_k(ξ) is a natural cubic spline through pictures traced at a few ξ.  Hence
E(z) is a sum of pictures P_j with weights φ_j(z), and

    RRMSD²(z) = φᵀ G φ

with the Gram matrix G of E(0) - target and the P_j, divided by the squared norm of the target.  Ten thousand trials are
one product of matrices.  Results do not depend on the number of threads: sums over pixels have a fixed order
(optics/numerics/reductions.py), small products use numpy's own loops, and LAPACK finds the eigenvectors in one thread.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import count, repeat
from typing import Any

import numba
import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq, minimize
from threadpoolctl import threadpool_limits

from bstcad.manufacture.tolerance.grades import DEFAULT_GRADE, GRADES, grade_limit
from bstcad.manufacture.tolerance.perturbations import MOTIONS, Perturbation, Setup, draws, kinds, perturb, trials
from bstcad.manufacture.tolerance.tolerances import WIDEST, Sensitivity
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.light.wavefront import Wave
from bstcad.optics.numerics.reductions import dot
from bstcad.optics.trace.wavefront_error import exit_pupil, move_pupil, residual, wavefront_error

Progress = Callable[[str, int, int, str], None]  # called with stage, units done, units in total, text
# Executor: calls work(shared, item) for each item, in this process or others, and yields the results in order.
Spread = Callable[[Callable[[Any, Any], Any], Any, Sequence[Any]], Iterator[Any]]

NORMAL_95 = 1.959963984540054  # quantile of the normal distribution for a two-sided interval of 95 %
WAVEFRONT_RAYS = 192  # rays per side of the grid for a wavefront error

# --- pictures ---------------------------------------------------------------------------------------------------------


def run_locally(work: Callable[[Any, Any], Any], shared: Any, items: Sequence[Any]) -> Iterator[Any]:
    """Call work(shared, item) in this process, for up to two items at a time: parts of a trace use a single core."""
    if not len(items):
        return
    yield work(shared, items[0])
    at_once = min(2, torch.get_num_threads()) if _threads_may_share() else 1
    threads = ThreadPoolExecutor(at_once)
    try:
        yield from threads.map(work, repeat(shared), items[1:])
    finally:  # after Ctrl-C do not wait for a trace, which may take ten seconds
        threads.shutdown(wait=False, cancel_futures=True)


def _threads_may_share() -> bool:
    """Return True if two threads may run kernels at a time, which numba's layer workqueue does not allow."""
    try:
        return numba.threading_layer() in ("tbb", "omp")
    except ValueError:  # unknown before the first kernel runs
        return False


@dataclass(frozen=True, eq=False)
class TargetPictures:
    """Pictures of a setup with errors on one target, whose figure of merit is the RRMSD."""

    setup: Setup
    perturbations: tuple[Perturbation, ...]
    target: np.ndarray  # required picture (rows, columns), of any sum
    tubes: int  # flux tubes per side and channel

    figure = "RRMSD"  # name of the norm of `vector`

    def vector(self, amounts: Sequence[float]) -> np.ndarray:
        """Return (picture with these amounts - target) / norm of the target, (pixels,); its norm is the RRMSD."""
        target = self.target.ravel()
        return (self.light(amounts).ravel() - target) / _norm(target)

    def light(self, amounts: Sequence[float]) -> np.ndarray:
        """Return the picture (rows, columns) with these amounts, scaled to the sum of the target."""
        picture = perturb(self.setup, self.perturbations, amounts).picture(self.tubes)
        total = picture.sum()
        return picture * (self.target.sum() / total) if total > 0 else picture


@dataclass(frozen=True, eq=False)
class Wavefronts:
    """Wavefront errors of a setup with errors, in waves of the main wavelength, which the first channel has.

    The OPD of a ray that starts at a given position is nearly linear in the errors, and the RMS of the OPDs is a norm.
    Hence the model that superposes pictures also superposes wavefronts.  The required wave is fixed in the room.
    Piston and tilt are removed for each lens separately, so that a lens may deflect its light as a whole.
    """

    setup: Setup
    perturbations: tuple[Perturbation, ...]
    wave: Wave  # required wave
    wavelength: float  # main wavelength, nm
    rays: int = WAVEFRONT_RAYS  # rays per side of the grid

    figure = "wavefront RMS"

    def vector(self, amounts: Sequence[float]) -> np.ndarray:
        """Return the OPD (rays²,) in waves, without piston and tilt, times sqrt(flux share); its norm is the RMS."""
        setup = perturb(self.setup, self.perturbations, amounts)
        source, lens = _main_channel(setup)
        pupil = exit_pupil(source, lens, self.wave.z, self.rays)
        if setup.lens_motion is not None:
            pupil = move_pupil(pupil, setup.lens_motion, self.wave.z)
        return residual(pupil, self.wave, self.wavelength).ravel().numpy()

    @property
    def design_rms(self) -> float:
        """RMS (waves) of the setup without errors, with as many rays as in a report."""
        return wavefront_error(*_main_channel(self.setup), self.wave).without_tilt.rms


def _main_channel(setup: Setup) -> tuple[Emitter, Lens]:
    """Return the emitter of the main line, and the lens at its wavelength."""
    channel = setup.channels[0]
    return channel.source, channel.through(setup.lens)


TracedGoal = TargetPictures | Wavefronts  # both have a `vector` to superpose, whose norm is the figure of merit


def traced_figure(goal: TracedGoal, amounts: Sequence[float]) -> float:
    """Return the figure of merit by a full trace: the RRMSD (Wang et al. 2023, Eq. 15) or the RMS in waves."""
    return _norm(goal.vector(amounts))


def _norm(vector: np.ndarray) -> float:
    tensor = torch.from_numpy(vector)
    return math.sqrt(dot(tensor, tensor))


# --- the model of superposed pictures ---------------------------------------------------------------------------------

DERIVATIVE_STEP = 0.5  # step of the central difference for each perturbation, in standard deviations
# (index of the first principal direction with these nodes, nodes ξ in standard deviations).  A picture that moves by
# more than its detail is not a polynomial of ξ, so strong directions need many nodes.
SPLINE_NODES = ((0, (-3.0, -2.0, -1.2, -0.5, 0.5, 1.2, 2.0, 3.0)), (4, (-2.5, -1.0, 1.0, 2.5)), (8, (-1.0, 1.0)))
NONLINEAR_DIRECTIONS = 12  # largest number of directions with nodes, the strongest; pictures are linear along others
MIN_STRENGTH = 1e-3  # change of the picture / change along the strongest direction, below which there are no nodes


@dataclass(frozen=True, eq=False)
class Model:
    """Model of the RRMSD as a function of the errors, by superposed pictures."""

    sigmas: np.ndarray  # standard deviations (n,), in the units of the perturbations
    first: np.ndarray  # derivatives of the picture (n, pixels), per standard deviation
    directions: np.ndarray  # principal directions V (n, n), orthonormal columns, the strongest first
    nodes: tuple[tuple[float, ...], ...]  # ξ of the pictures traced along each direction with nodes
    gram: np.ndarray  # Gram matrix (1 + j, 1 + j): nominal, pictures at the nodes, derivatives along other directions

    @property
    def rrmsd(self) -> float:
        """RRMSD of the design without errors, with the tubes of the model."""
        return float(np.sqrt(self.gram[0, 0]))

    def rrmsds(self, amounts: np.ndarray) -> np.ndarray:
        """Return the RRMSD (…) for amounts (…, k) of the first k perturbations; further perturbations are zero."""
        k = amounts.shape[-1]
        phi = self._weights(product(amounts / self.sigmas[:k], self.directions[:k]))
        return np.sqrt(np.maximum(np.sum(product(phi, self.gram) * phi, axis=-1), 0.0))

    def _weights(self, along: np.ndarray) -> np.ndarray:
        """Return φ (…, 1 + j) at ξ (…, n) along the principal directions."""
        parts = [np.ones((*along.shape[:-1], 1))]
        for k, nodes in enumerate(self.nodes):
            spline, slope = _cardinal(nodes)
            inside = np.clip(along[..., k], min(nodes), max(nodes))
            parts.append(spline(inside) + slope(inside) * (along[..., k] - inside)[..., None])  # linear extrapolation
        return np.concatenate([*parts, along[..., len(self.nodes) :]], axis=-1)


@functools.cache
def _cardinal(nodes: tuple[float, ...]) -> tuple[CubicSpline, CubicSpline]:
    """Return the cardinal functions of a natural cubic spline that is zero at zero, and their derivatives."""
    xi = np.array(sorted((0.0, *nodes)))
    spline = CubicSpline(xi, np.eye(len(xi))[:, xi != 0.0], bc_type="natural")
    return spline, spline.derivative()


def superpose(pictures: TracedGoal, progress: Progress = lambda *event: None, spread: Spread = run_locally) -> Model:
    """Return the model from two traced pictures per perturbation, and pictures at nodes of principal directions."""
    sigmas = np.array([p.sigma for p in pictures.perturbations])
    n = len(sigmas)
    curved = range(min(n, NONLINEAR_DIRECTIONS))
    nodes = [next(xi for first, xi in reversed(SPLINE_NODES) if k >= first) for k in curved]
    total, done = 1 + 2 * n + sum(map(len, nodes)), count(1)

    def trace(amounts: Sequence[np.ndarray]) -> Iterator[np.ndarray]:
        for picture in spread(type(pictures).vector, pictures, [z * sigmas for z in amounts]):
            progress("sensitivity", next(done), total, "")
            yield picture

    straight = trace([np.zeros(n), *(sign * DERIVATIVE_STEP * e for e in np.eye(n) for sign in (1, -1))])
    nominal = next(straight)
    first = np.stack([(up - next(straight)) / (2 * DERIVATIVE_STEP) for up in straight])
    strength, directions = principal_axes(gram(first))
    nodes = nodes[: int(np.sum(strength[:NONLINEAR_DIRECTIONS] >= MIN_STRENGTH**2 * strength[0]))]
    nonlinear = [
        picture - nominal for picture in trace([xi * directions[:, k] for k, along in enumerate(nodes) for xi in along])
    ]
    vectors = np.concatenate([np.stack([nominal, *nonlinear]), product(directions.T[len(nodes) :], first)])
    return Model(sigmas, first, directions, nodes=tuple(nodes), gram=gram(vectors))


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a (…, n) times b (n, m), summed in a fixed order."""
    return np.einsum("...i,ij->...j", a, b, optimize=False)


def gram(rows: np.ndarray) -> np.ndarray:
    """Return the scalar products (n, n) of all pairs of rows (n, any length)."""
    vectors = [torch.from_numpy(np.ascontiguousarray(row)) for row in rows]
    products = np.empty((len(vectors), len(vectors)))
    for i, a in enumerate(vectors):
        for j, b in enumerate(vectors[: i + 1]):
            products[i, j] = products[j, i] = dot(a, b)
    return products


def principal_axes(symmetric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return eigenvalues (n,), the largest first, and eigenvectors (n, n), as columns, of a symmetric matrix."""
    with threadpool_limits(1, user_api="blas"):
        values, axes = np.linalg.eigh(symmetric)
    return values[::-1], axes[:, ::-1]


# --- the study --------------------------------------------------------------------------------------------------------

MODEL_TRIALS = 10_000  # default number of trials by the model
WORST_SHOWN = 5  # number of reported worst trials
SCREEN_ADJUSTMENTS = {f"screen.{motion}" for motion, *_ in MOTIONS}  # motions by which a user adjusts the screen
ADJUSTMENT_RANGE = 8.0  # largest adjustment (±) of each motion of the screen, in standard deviations
ADJUSTMENT_FACTOR = 10.0  # limit, relative to the default grade, of an adjustment that is not an error of the study
QUOTIENT_STEP = 1e-4  # step of the difference quotients in `adjusted_rrmsd`, in standard deviations
INDEPENDENT_SEED = 7919  # offset of the seed of the independent trials in `loosest_limits`

Yield = tuple[float, float, float]  # fraction of trials within a limit: low, estimate, high (Wilson's 95 % interval)


@dataclass(frozen=True)
class StudySettings:
    """Settings of a study; its results do not depend on `progress` and `spread`."""

    grade: str | None = None  # grade that replaces the grade in the scene; None: grade in the scene
    wanted: float | None = None  # yield (0 … 1) for which the loosest tolerances are computed; None: not computed
    seed: int = 0  # seed of the trials
    trials: int = MODEL_TRIALS  # number of trials by the model
    full: int = 200  # number of the first trials that are also traced in full
    tubes: int = 1031  # flux tubes per side and channel; their numerical error is equal in every trial
    progress: Progress = lambda *event: None  # receives the progress of the traces
    spread: Spread = run_locally  # executor of the traces


@dataclass(frozen=True, eq=False)
class Study:
    """Result of a Monte Carlo study of a setup.  For a wavefront goal each RRMSD is an RMS in waves."""

    perturbations: tuple[Perturbation, ...]
    model: Model  # model of the perturbations, followed by further adjustments of the screen
    sensitivities: tuple[Sensitivity, ...]  # sensitivities, the largest first
    limit: float  # maximum RRMSD; infinite: every lens passes
    seed: int
    rrmsd: float  # RRMSD of the setup without errors
    linear: np.ndarray  # RRMSD of all trials (trials,) by the model
    full: np.ndarray  # RRMSD of the first trials (fewer,) by full traces
    adjusted: np.ndarray  # RRMSD of the first trials (fewer,) by the model, with the screen adjusted

    @property
    def disagreement(self) -> np.ndarray:
        """Relative difference between model and full trace, for each of the trials that are traced in full."""
        return np.abs(self.linear[: len(self.full)] / self.full - 1)

    def change_of(self, error: str) -> float:
        """Return the change of the RRMSD by one standard deviation of the error with this name."""
        return next(s.rrmsd_change for s in self.sensitivities if s.name == error)

    @property
    def worst(self) -> list[int]:
        """Numbers of the worst trials by full traces."""
        return np.argsort(self.full)[::-1][:WORST_SHOWN].tolist()

    def fraction_within(self, rrmsds: np.ndarray) -> Yield:
        """Return (low, estimate, high) of the fraction within the limit, for trials with these RRMSDs."""
        return estimate_yield(rrmsds <= self.limit)

    @property
    def bias(self) -> float:
        """Squared numerical error of the tubes: squared RRMSD of the design by tubes minus that by independent rays."""
        return self.model.rrmsd**2 - self.rrmsd**2

    def within_limit(self, amounts: np.ndarray) -> np.ndarray:
        """Return True (…) for amounts (…, k) whose RRMSD by the model is within the limit."""
        return _unbiased(self.model.rrmsds(amounts), self.bias) <= self.limit


def estimate_yield(good: np.ndarray) -> Yield:
    """Return (low, estimate, high) of the fraction of trials (trials,) that are True; low, high: 95 % interval.

    The interval (Wilson 1927) is (p + z² / 2n ± z sqrt(p (1 - p) / n + z² / 4n²)) / (1 + z² / n).
    """
    n, p = len(good), int(good.sum()) / len(good)
    middle, half = p + NORMAL_95**2 / (2 * n), NORMAL_95 * math.sqrt(p * (1 - p) / n + NORMAL_95**2 / (4 * n**2))
    low, high = ((middle + sign * half) / (1 + NORMAL_95**2 / n) for sign in (-1, 1))
    return max(low, 0.0) if p > 0 else 0.0, p, min(high, 1.0) if p < 1 else 1.0


def worst_of(studies: Sequence[Study]) -> Study:
    """Combine studies of several targets with equal trials and limit: each figure is that of the worst target.

    The `share` of an error is its fraction of the mean square change of all pictures, each over its target's norm.
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


def study(pictures: TracedGoal, limit: float, rrmsd: float, settings: StudySettings) -> Study:
    """Return sensitivities and trials of a setup with errors.

    limit: maximum figure of merit (RRMSD, or RMS in waves).  rrmsd: figure of the design by independent rays.  To make
    the trials comparable with it, the square of the tubes' numerical error is subtracted from each RRMSD².
    """
    perturbations = pictures.perturbations
    with_adjustments = (*perturbations, *adjustments(pictures.setup, perturbations))
    superposed = superpose(replace(pictures, perturbations=with_adjustments), settings.progress, settings.spread)
    bias = superposed.rrmsd**2 - rrmsd**2
    amounts = trials(perturbations, settings.seed, range(settings.trials))
    full = []
    for k, traced in enumerate(settings.spread(traced_figure, pictures, list(amounts[: settings.full])), 1):
        full.append(traced)
        settings.progress("trials", k, min(settings.full, settings.trials), f"{pictures.figure} {traced:.4f}")
    adjusted = [adjusted_rrmsd(superposed, with_adjustments, amounts[k]) for k in range(len(full))]
    figures = {"linear": superposed.rrmsds(amounts), "full": np.array(full), "adjusted": np.array(adjusted)}
    unbiased = {name: _unbiased(rrmsds, bias) for name, rrmsds in figures.items()}
    sensitivities = _sensitivities(superposed, perturbations, bias)
    return Study(perturbations, superposed, sensitivities, limit=limit, seed=settings.seed, rrmsd=rrmsd, **unbiased)


def _unbiased(rrmsds: np.ndarray, bias: float) -> np.ndarray:
    """Return RRMSDs without the error of the tubes, whose square is `bias`."""
    return np.sqrt(np.maximum(rrmsds**2 - bias, 0.0))


def _sensitivities(superposed: Model, perturbations: Sequence[Perturbation], bias: float) -> tuple[Sensitivity, ...]:
    """Return the effect on the RRMSD of one standard deviation of each error, mean of both signs, the largest first."""
    n = len(perturbations)
    sigmas = np.diag(superposed.sigmas[:n])
    mean_rrmsds = (_unbiased(superposed.rrmsds(sigmas), bias) + _unbiased(superposed.rrmsds(-sigmas), bias)) / 2
    added = np.sum(superposed.first[:n] ** 2, axis=1)
    changes, shares = mean_rrmsds - _unbiased(np.array([superposed.rrmsd]), bias), added / (added.sum() or 1.0)
    sensitivities = []
    for p, change, share in zip(perturbations, changes.tolist(), shares.tolist(), strict=True):
        kind: dict[str, Any] = {"name": p.kind.name, "words": p.kind.words, "unit": p.kind.unit}
        size: dict[str, Any] = {"limit": p.limit, "distribution": p.distribution, "cost": p.cost, "sigma": p.sigma}
        sensitivities.append(Sensitivity(**kind, **size, rrmsd_change=change, share=share))
    return tuple(sorted(sensitivities, key=lambda s: s.rrmsd_change, reverse=True))


def adjustments(setup: Setup, errors: Sequence[Perturbation]) -> tuple[Perturbation, ...]:
    """Return perturbations by shift, focus, tilt and clocking of the screen, except for motions among the errors."""
    known, grade = {error.kind.name for error in errors}, GRADES[DEFAULT_GRADE]
    missing = [kind for name, kind in kinds(setup).items() if name in SCREEN_ADJUSTMENTS - known]
    return tuple(Perturbation(kind, ADJUSTMENT_FACTOR * grade_limit(kind, grade, setup)) for kind in missing)


def adjusted_rrmsd(superposed: Model, perturbations: Sequence[Perturbation], amounts: np.ndarray) -> float:
    """Return the smallest RRMSD of the model over shifts, focus, tilts and clocking of the screen.

    perturbations: perturbations of the model.  amounts: amounts (k,) of the first k perturbations.
    """
    free = [k for k, p in enumerate(perturbations) if p.kind.name in SCREEN_ADJUSTMENTS]
    amounts = np.pad(amounts, (0, len(perturbations) - len(amounts)))

    def moved(steps: np.ndarray) -> np.ndarray:
        varied = np.broadcast_to(amounts, (*steps.shape[:-1], len(amounts))).copy()
        varied[..., free] += steps * superposed.sigmas[free]
        return varied

    offsets = QUOTIENT_STEP * np.eye(len(free))
    nearby = np.concatenate([np.zeros((1, len(free))), offsets, -offsets])

    def square_and_gradient(steps: np.ndarray) -> tuple[float, np.ndarray]:
        value, up, down = np.split(superposed.rrmsds(moved(steps + nearby)) ** 2, [1, 1 + len(free)])
        return float(value[0]), (up - down) / (2 * QUOTIENT_STEP)

    bounds = [(-ADJUSTMENT_RANGE, ADJUSTMENT_RANGE)] * len(free)
    best = minimize(square_and_gradient, np.zeros(len(free)), jac=True, bounds=bounds, method="L-BFGS-B")
    return float(superposed.rrmsds(moved(best.x)))


def loosest_limits(study: Study, wanted: float, others: Sequence[Study] = ()) -> tuple[tuple[Perturbation, ...], Yield]:
    """Return the loosest tolerances with the `wanted` yield (0 … 1), and their yield by independent trials.

    others: studies of the other goals with the same trials.  A lens passes if it meets all limits.

    To keep error i within u_i times its limit costs c_i / u_i and adds q_i u_i² to the mean square change of the
    pictures, summed over the goals, each relative to its limit.  For a given sum Σ q_i u_i² the cost is minimal at
    u_i ∝ (c_i / q_i)^(1/3).  A common factor is then chosen such that the model has the yield; u_i is at most WIDEST.
    """
    perturbations, goals = study.perturbations, (study, *others)
    added = sum(
        (study.limit / goal.limit) ** 2 * np.sum(goal.model.first[: len(perturbations)] ** 2, axis=1) for goal in goals
    )
    added = np.maximum(added, 1e-30)
    shape = np.cbrt(np.array([p.cost for p in perturbations]) / added)
    shape /= np.exp(np.mean(np.log(shape)))
    uniform = np.random.default_rng((study.seed, INDEPENDENT_SEED)).random((MODEL_TRIALS, len(perturbations)))
    unit = draws(perturbations, uniform)

    def all_within(amounts: np.ndarray) -> np.ndarray:
        return np.logical_and.reduce([goal.within_limit(amounts) for goal in goals])

    def excess(log_factor: float) -> float:
        widths = np.minimum(np.exp(log_factor) * shape, WIDEST)
        return float(np.mean(all_within(unit * widths))) - wanted

    log_factor = 10.0 if excess(10.0) >= 0 else brentq(excess, -10.0, 10.0, xtol=1e-4)
    widths = np.minimum(np.exp(log_factor) * shape, WIDEST)
    loosened = tuple(replace(p, limit=float(p.limit * w)) for p, w in zip(perturbations, widths, strict=True))
    independent = trials(loosened, study.seed + INDEPENDENT_SEED, range(MODEL_TRIALS))
    return loosened, estimate_yield(all_within(independent))
