"""Feasibility of two freeform faces: a check on coarse grids, before the long stages, that a lens can meet all goals.

The wavefront, or the two pictures, determine the rays behind the lens (light_behind.py).  These rays determine where
the light meets the back, and by which angle the front has to deflect it.  A design is refused if, for much of the
light, rays would have to cross between lens and target, or to leave the back outside of its clear aperture.  If the
front would have to deflect light by more than refraction can, this is only reported.

At an index of 1.49 a front can deflect light by up to 43 degrees (incidence at 85 degrees).  A back that cancels this
is nearly vertical, and remains so in stage 2.  If the deflection would exceed MAX_GENTLE_DEFLECTION, stage 1 raises the
dark parts of the furthest picture, which cause the largest deflections, to a floor; stage 2 uses the unchanged picture.
(Example: two faces 6 mm apart that have to deflect light by 38 degrees, for a square and letters.  RRMSD 0.34 and 0.63
after 100 evaluations per round without this floor, 0.37 and 0.48 with it.)
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import FRONT
from bstcad.optics.trace.reach import largest_deflection
from bstcad.tailoring import light_behind
from bstcad.tailoring.driver import Task, no_progress
from bstcad.tailoring.light_behind import LightBehind
from bstcad.tailoring.slope_map import lit_corners, lit_window, square_grid
from bstcad.tailoring.stage2 import with_pixels
from bstcad.tailoring.two_faces import front_map
from bstcad.transport.mapping import Solver

MAX_UNSERVED = 0.5  # largest fraction of the light whose rays may miss the back's aperture or cross each other
REPORTED_FRACTION = 1e-3  # smallest reported fraction of light that misses the aperture or whose rays cross
MAX_GENTLE_DEFLECTION = 30.0  # largest deflection at the front for which the furthest picture needs no floor (degrees)
TRIED_FLOORS = (0.1, 0.2, 0.4, 1.0)  # floors, relative to the mean of the furthest picture, tried in this order
SOLUTION_NAMES = {1.0: "convex", -1.0: "concave"}  # names of the solutions with the sign σ of light_behind.py


@dataclass(frozen=True)
class Demand:
    """Deflections and losses that the goals cause in a lens, for one of the two solutions."""

    solution: float  # sign σ of the solution: 1 convex, -1 concave (light_behind.py)
    angle: float  # largest angle to the axis at which light leaves the lens (degrees)
    rms_angle: float  # RMS angle to the axis over the rays (degrees)
    crossed: float  # fraction of the light whose rays would cross between lens and target
    outside: float  # fraction of the light that would leave the back outside of its clear aperture
    deflection: float  # largest angle by which the front deflects light (degrees); NaN: not computed
    limit: float  # largest angle by which a front can deflect light (degrees)
    floor: float = 0.0  # irradiance, relative to the mean, to which stage 1 raises dark parts of the furthest picture
    lifted_deflection: float = math.nan  # largest deflection by the front with this floor (degrees)

    @property
    def rank(self) -> tuple[float, float]:
        """Sort key, smallest for the best solution: (crossed + outside, or 0 up to REPORTED_FRACTION; RMS angle)."""
        lost = self.crossed + self.outside
        return (lost if lost > REPORTED_FRACTION else 0.0), self.rms_angle

    def sentences(self, thickness: float) -> Iterator[str]:
        """Yield sentences on angles, on a floor, and on each failure with its remedy; thickness: mm, at the centre."""
        yield (
            f"{SOLUTION_NAMES[self.solution]} solution: light leaves the lens at up to {self.angle:.3g} degrees from "
            f"the axis, and the front deflects it by up to {self.deflection:.3g} degrees"
        )
        if self.floor:
            yield (
                f"stage 1 raises the dark parts of the furthest target to {100 * self.floor:g} % of its mean "
                f"irradiance, so that the front deflects light by at most {self.lifted_deflection:.3g} degrees"
            )
        if self.crossed > REPORTED_FRACTION:
            result = "" if is_infeasible(self) else ", so the other pictures or the wavefront are only approximate"
            yield (
                f"rays of {100 * self.crossed:.3g} % of the light would have to cross between the lens and the nearest "
                f"target{result}; bring the nearest target closer to the lens, or move the others further away"
            )
        if self.outside > REPORTED_FRACTION:
            yield (
                f"{100 * self.outside:.3g} % of the light would have to leave the back outside of lens.outline; "
                "make the targets smaller, or lens.outline wider"
            )
        if self.deflection > self.limit:
            yield (
                f"the front would have to deflect light by {self.deflection:.3g} degrees, but refraction deflects it "
                f"by at most {self.limit:.3g} degrees; make the lens thicker than {thickness:.3g} mm"
            )


def find_demand(task: Task, lens: Lens) -> Demand:
    """Return the demand of the task's solution, or of the better solution if the task states none; lens: the blank."""
    task = task.with_imaged_receivers(lens)
    both = (1.0,) if task.wave is not None else (1.0, -1.0)
    solutions = [_demand(task, sign, lens) for sign in (both if task.solution is None else (task.solution,))]
    best, light = min(solutions, key=lambda one: one[0].rank)
    if is_infeasible(best):
        return best
    best = replace(best, deflection=_largest_deflection(task, lens, light))
    lifted = [replace(best, lifted_deflection=best.deflection)]
    for floor in TRIED_FLOORS if len(task.goals) > 1 and task.wave is None else ():
        if lifted[-1].lifted_deflection <= MAX_GENTLE_DEFLECTION:
            break
        _, light = _demand(replace(task, floor=floor), best.solution, lens)
        lifted.append(replace(best, floor=floor, lifted_deflection=_largest_deflection(task, lens, light)))
    return min(lifted, key=lambda each: max(MAX_GENTLE_DEFLECTION, each.lifted_deflection))


def _demand(task: Task, solution: float, lens: Lens) -> tuple[Demand, LightBehind]:
    """Return the demand of a solution on coarse grids (deflection: NaN), and rays behind the lens that do not cross."""
    effort = task.effort
    cells, iterations = effort.trial_cells, effort.trial_iterations
    settings = replace(task.settings, transport_grid=cells, transport_iterations=iterations)
    task = with_pixels(task, effort.trial_pixels)
    task = replace(task, settings=settings, solution=solution, progress=no_progress)
    light = light_behind.light_for_task(task)
    if task.wave is not None:  # the picture, resampled by means, has a sum below 1
        light = replace(light, picture=light.picture / light.picture.sum())
    angle = np.degrees(np.arccos(light.direction[2].clip(-1, 1)))[lit_corners(light.picture)]
    crossed = light.crossed_fraction(lens.back)
    near = min(task.goals, key=lambda goal: goal.screen.receiver.throw(0.0))
    served = light_behind.without_crossings(light, near.screen, lens.back, cells)
    outside = served.fraction_outside(lens.back, lens.apertures[1].scaled(1 + 1e-3).contains)
    limit, largest, rms = math.degrees(largest_deflection(lens.index)), float(angle.max()), np.sqrt((angle**2).mean())
    return Demand(solution, largest, float(rms), crossed, outside=outside, deflection=math.nan, limit=limit), served


@torch.no_grad()
def _largest_deflection(task: Task, lens: Lens, light: LightBehind) -> float:
    """Return the largest angle (degrees) between the directions of a ray before the front and in the glass."""
    front, source = lens.with_tailored(FRONT), task.heaviest.source
    window, b = lit_window(source, front), light.intersect(lens.back)
    grid = square_grid(source, front, window, task.effort.trial_cells)
    slopes = front_map(front, grid, window, light.picture, b=b, q=None, solver=Solver())
    lit = lit_corners(light.picture)
    x, y = (torch.from_numpy(q[lit]) for q in slopes.face_points)
    way = torch.from_numpy(b[:, lit]) - torch.stack([x, y, lens.front.sag_and_slope(x, y)[0]])
    coming = source.rays_through(x, y, lens.entrance.z, 1.0).direction
    cosine = (way * coming).sum(0) / torch.sqrt((way * way).sum(0))
    return math.degrees(math.acos(max(-1.0, min(1.0, float(cosine.min())))))


def is_infeasible(demand: Demand) -> bool:
    """Return True if rays of more than MAX_UNSERVED of the light would miss the back's aperture or cross each other."""
    return demand.outside + demand.crossed > MAX_UNSERVED
