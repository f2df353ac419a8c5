"""The curvature of a spherical front, found together with the freeform back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import scipy.optimize

from bstcad.optics.lens import Lens

EVALUATIONS = 8
STEEPEST = 0.5  # of the curvature at which the sphere would end at the rim


def best_curvature(merit: Callable[[Lens], float], lens: Lens, allowed: tuple[float, float]) -> Lens:
    """The lens whose front curvature makes `merit` smallest; the merit tailors the back anew for each front.

    One number, so a bounded scalar search (Brent) over what the blank allows: the sphere reaches the rim with a slope
    of at most 30°, and at the rim it keeps half the blank's thickness.  allowed: between which it has to stay besides
    (1/mm).
    """
    rim = sum(half**2 for half in lens.outline.half_extent) ** 0.5
    room = (lens.back.z - lens.front.z) / 2
    limit = STEEPEST / rim
    deepest = 2 * room / (rim**2 + room**2)  # c of the sphere whose sag at the rim is `room`

    def at(curvature: float) -> float:
        return merit(replace(lens, front=replace(lens.front, curvature=curvature)))

    bounds = (max(-limit, allowed[0]), min(limit, deepest, allowed[1]))
    found = scipy.optimize.minimize_scalar(
        at, bounds=bounds, method="bounded", options={"maxiter": EVALUATIONS, "xatol": 1e-4}
    )
    start = float(lens.front.curvature)
    best = float(found.x) if found.fun < at(start) else start
    return replace(lens, front=replace(lens.front, curvature=best))
