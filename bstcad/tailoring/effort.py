"""Effort of tailoring beside the settings of its scene: the numbers of rays, tubes, points and evaluations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from bstcad.optics.receivers.goal import Goal
from bstcad.optics.trace.measure import Effort
from bstcad.tailoring.settings import COARSEST_GRID
from bstcad.tailoring.slope_fit import Fit
from bstcad.tailoring.source_image import ErrorRays


@dataclass(frozen=True)
class FrontSearch:
    """Effort of the search for a front in stage 1."""

    cells: int = COARSEST_GRID  # cells per side of the transport map
    iterations: int = 100  # iterations of the map; stage 1 states its own number
    repeats: int = 3  # slope fits of the back for each front


@dataclass(frozen=True)
class Gathering:
    """Effort of the fit of g, which does not change the fixed point of stage 1 (slope_map.py)."""

    samples: int = 96  # samples per side
    fit: Fit = Fit(bending=1e-3, steps=40, degree=5)


GATHERING = Gathering()


@dataclass(frozen=True)
class TailoringEffort:
    """Effort of tailoring.

    Rays for the RRMSD of a lens between the stages (`stage`) are accurate to 5 % or so for `stage_pixels` pixels per
    side.  RRMSD² is estimated from products of two pictures (measure.py).  With n² stratified rays per picture its
    error varies as (p / n)³ / p, so p pixels per side need (p / stage_pixels)^⅔ times as many rays per side.
    """

    stage: Effort = Effort(rays=724, accuracy=0, witness=False, cells=1)  # rays for the RRMSD between the stages
    stage_pixels: int = 512  # pixels per side for which `stage` holds
    fine: Effort = Effort(
        rays=2048, accuracy=0.01, witness=False, cells=1
    )  # rays with accuracy or bounds, and in `better`
    flux: Effort = Effort(rays=128, accuracy=1.0, witness=False, cells=1)  # rays for the flux on the target alone
    thickness_points: int = 1025  # points per side at which the thickness after stage 1 is checked
    wavefront_tubes: int = 256  # flux tubes per side that measure the wavefront error between the stages
    coarsest_grid: int = COARSEST_GRID  # fewest cells per side of the transport map in a round of stage 1
    front_net: int | None = None  # control points per side of the back in the search for a front; None: coarsest net
    front_search: FrontSearch | None = None  # None: FrontSearch with the iterations of the settings
    gathering: Gathering = GATHERING
    trial_cells: int = 64  # cells per side of the transport map in the trial for two faces (feasibility.py)
    trial_pixels: int = 128  # pixels on the longer side of the pictures in this trial
    trial_iterations: int = 100  # largest number of iterations of its map
    blur: ErrorRays | None = ErrorRays()  # rays that measure the error of the blur by images; None: it is not measured
    compared_net: int = 65  # largest number of control points per side in the comparison of float32 with float64
    compared_tubes: int = 128  # tubes per side in this comparison
    compared_evaluations: int = 6  # evaluations in each precision
    rates_lenses: bool = True  # rate lenses by rays after stages and rounds, keep the best, try costly alternatives
    divides_rounds: bool = True  # divide stages 2 and 3 into rounds
    refines_merit: bool = True  # rate light inside the pixels, and hold it from folding

    def between_stages(self, goals: Sequence[Goal], factor: float = 1.0) -> Effort:
        """Return `stage`, scaled to the number of pixels of the goals; factor: of the rays per side."""
        pixels = max(goal.picture.size for goal in goals)
        rays = factor * self.stage.rays * (pixels / self.stage_pixels**2) ** (1 / 3)
        return replace(self.stage, rays=round(rays))


FULL = TailoringEffort()
BRIEF = TailoringEffort(
    front_net=17,
    front_search=FrontSearch(cells=32, iterations=40, repeats=1),
    gathering=Gathering(32, Fit(steps=0, degree=5)),  # five times faster
    thickness_points=257,
    blur=None,
    rates_lenses=False,
)
PREVIEW = replace(BRIEF, divides_rounds=False, refines_merit=False)
