"""The shape of a front of which something is free, found together with the freeform back."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy.optimize

from bstcad.optics.lens import Lens
from bstcad.scene.blank import CONIC_CONSTANTS
from bstcad.scene.check import INSIDE

EVALUATIONS = 8  # of a search for one number
BOTH = 40  # for the curvature and the conic constant together
STEEPEST = 0.5  # sine of the slope's angle at the rim
UPRIGHT, CONE = 0.8, 6.0  # (1 + k) c² r² at the rim, and -(1 + k) c² r²: a scene would refuse a little more
UNBOUNDED = (-math.inf, math.inf)

Range = tuple[float, float]
Merit = Callable[[Lens], float]


def best_front(merit: Merit, lens: Lens, free: tuple[str, ...], rim_sags: Range = UNBOUNDED) -> Lens:
    """The lens whose front makes `merit` smallest by the parameters that are free; the merit tailors the back anew.

    Within what the blank allows: the front reaches the rim with a slope of at most 30°, it keeps half the blank's
    thickness there, and its sag there (mm) stays in `rim_sags`.
    """
    if "curvature" in free:
        own = float(lens.front.curvature)
        lens = _along("curvature", merit, lens, _curvatures(lens, rim_sags, own), 1e-4)
    if "conic_constant" in free and lens.front.curvature:
        if "curvature" in free:
            return _together(merit, lens, rim_sags)
        own = float(lens.front.conic_constant)
        low, high = _conic_constants(lens, rim_sags)
        low, high = min(low, own), max(high, own)
        lens = _along("conic_constant", merit, lens, (low, high), 1e-3 * (high - low))
    return lens


def _with(lens: Lens, **values: float) -> Lens:
    return replace(lens, front=lens.front.with_parameters(**values))


def _along(name: str, merit: Merit, lens: Lens, bounds: Range, tolerance: float) -> Lens:
    """The best value of one parameter by a bounded scalar search (Brent), or the one that there is."""
    found = scipy.optimize.minimize_scalar(
        lambda value: merit(_with(lens, **{name: float(value)})), bounds=bounds, method="bounded",
        options={"maxiter": EVALUATIONS, "xatol": tolerance},
    )  # fmt: skip
    start = float(lens.front.parameters()[name])
    best = float(found.x) if found.fun < merit(_with(lens, **{name: start})) else start
    return _with(lens, **{name: best})


def _together(merit: Merit, lens: Lens, rim_sags: Range) -> Lens:
    """Curvature and conic constant by a simplex (Nelder and Mead) from those that there are."""
    c, k = (float(value) for value in (lens.front.curvature, lens.front.conic_constant))

    def at(tried: np.ndarray) -> float:
        there = _with(lens, curvature=float(tried[0]), conic_constant=float(tried[1]))
        if not tried[0]:
            return math.inf
        (low, high), (least, most) = _curvatures(there, rim_sags), _conic_constants(there, rim_sags)
        possible = low <= tried[0] <= high and least <= tried[1] <= most
        return merit(there) if possible or tuple(tried) == (c, k) else math.inf

    low, high = _curvatures(lens, rim_sags)
    step = (high - low) / 16 * (1 if c + (high - low) / 16 <= high else -1)
    simplex = np.array([[c, k], [c + step, k], [c, k - 1.0]])
    found = scipy.optimize.minimize(
        at, simplex[0], method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": BOTH, "xatol": 1e-5}
    )
    best = found.x if found.fun < math.inf else simplex[0]
    return _with(lens, curvature=float(best[0]), conic_constant=float(best[1]))


def _rim(lens: Lens) -> float:
    """Distance of the bounding box's corners from the axis (mm)."""
    return sum(half**2 for half in lens.outline.half_extent) ** 0.5


def _curvatures(lens: Lens, rim_sags: Range, *own: float) -> Range:
    """Between which curvatures (1/mm) the front, of the conic constant k that it has, is possible; its own is.

    Its slope at r has the sine S where c = S / (r sqrt(1 + k S²)).
    """
    rim, k = _rim(lens), float(lens.front.conic_constant)
    room = (lens.back.z - lens.front.z) / 2
    bent = 1 + k * STEEPEST**2
    limit = STEEPEST / rim / math.sqrt(bent) if bent > 0 else math.inf
    if k != -1:
        limit = min(limit, math.sqrt((UPRIGHT if k > -1 else CONE) / abs(1 + k)) / rim)
    low, high = (_of_sag(sag, math.hypot(*lens.outline.farthest), k) for sag in rim_sags)
    return max(-limit, min((low, *own))), min(limit, _of_sag(room, rim, k), max((high, *own)))


def _of_sag(h: float, r: float, k: float) -> float:
    """The curvature of a conic with this sag at r: c = 2 h / (r² + (1 + k) h²), up to where it stands upright."""
    p = 1 + k
    if p == 0:
        return 2 * h / (r * r)
    most = INSIDE * r / math.sqrt(abs(p))
    h = max(-most, min(h, most))
    return 2 * h / (r * r + p * h * h)


def _conic_constants(lens: Lens, rim_sags: Range) -> Range:
    """Between which conic constants the front, of the curvature c that it has, is possible.

    tan² of the slope at r is c² r² / (1 - (1 + k) c² r²), and 1 + k = (2 h - c r²) / (c h²) where the sag is h.
    """
    least, most = CONIC_CONSTANTS
    c, rim = float(lens.front.curvature), _rim(lens)
    room = (lens.back.z - lens.front.z) / 2
    bent = (c * rim) ** 2
    sag = abs(rim_sags[0]) if c < 0 else min(rim_sags[1], room)
    steep = 1 / bent - (1 - STEEPEST**2) / STEEPEST**2
    deep = (2 * sag - abs(c) * rim**2) / (abs(c) * sag**2) if sag < math.inf else steep
    return max(-CONE / bent - 1, least), min(steep, deep, UPRIGHT / bent, 1 + most) - 1
