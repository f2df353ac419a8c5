"""Whether a lens of two freeform faces can serve all of its goals, found before the long stages, on coarse grids.

The light behind the lens follows from its goals (light_behind.py), and from it the places of the back and the angles
by which the front turns light towards them.  Three things can forbid it: rays that would have to cross between lens and
target, light that would have to leave the back outside of the lens, and a turn that no front can give.

A front can turn light by 48 degrees at an index of 1.49, but a back that turns it back by as much is a wall, and faces
that start as walls stay so.  Where the front would have to turn light by more than GENTLE, stage 1 therefore lifts the
dark parts of the furthest picture, which take the light furthest aside; stage 2 has the picture as it is.  (Two faces
6 mm apart that have to turn by 38 degrees for a square and letters: RRMSD 0.34 and 0.63 after 100 evaluations of each
round without, 0.37 and 0.48 with it.)
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from bstcad.optics.lens import Lens
from bstcad.optics.reach import largest_deflection
from bstcad.tailoring import light_behind
from bstcad.tailoring.light_behind import LightBehind
from bstcad.tailoring.run import Task, silent
from bstcad.tailoring.slope_map import corners_of, lit_window
from bstcad.tailoring.stage2 import coarsened
from bstcad.tailoring.two_faces import front_map

CELLS, PIXELS = 64, 128  # a side
ITERATIONS = 100
MOST = 0.5  # of the light, that may be beyond what two faces can do
SAID = 1e-3  # of the light: what fails for less of it is not said
GENTLE = 30.0  # degrees
FLOORS = (0.1, 0.2, 0.4, 1.0)  # of its mean, to which the furthest picture is lifted for stage 1: the first that serves
SOLUTIONS = {1.0: "convex", -1.0: "concave"}


@dataclass(frozen=True)
class Demand:
    """What the goals ask of a lens, by one of the two solutions."""

    solution: float  # σ of light_behind.py
    angle: float  # degrees; the largest from the axis at which light leaves the lens
    mean_angle: float  # degrees; RMS of the same
    crossed: float  # part of the light whose rays would cross between lens and target
    outside: float  # part of the light that would leave the back outside of the lens
    turn: float  # degrees; the largest by which the front turns light; NaN: nobody asked
    limit: float  # degrees; the largest by which a front can turn light
    floor: float = 0.0  # of its mean, to which stage 1 lifts the furthest picture
    lifted_turn: float = math.nan  # degrees; the largest turn then

    @property
    def rank(self) -> tuple[float, float]:
        """Less is better: what cannot be served, then the angles."""
        lost = self.crossed + self.outside
        return (lost if lost > SAID else 0.0), self.mean_angle

    def sentences(self, thickness: float) -> Iterator[str]:
        """What the lens has to do, and what it cannot; thickness: of its middle (mm)."""
        yield (
            f"{SOLUTIONS[self.solution]} solution: light leaves the lens at up to {self.angle:.3g} degrees from the "
            f"axis, and the front turns it by up to {self.turn:.3g} degrees"
        )
        if self.floor:
            yield (
                f"tailoring starts from a furthest target whose dark parts have {100 * self.floor:g} % of its mean: "
                f"for that the front turns light by up to {self.lifted_turn:.3g} degrees"
            )
        if self.crossed > SAID:
            yield (
                f"rays of {100 * self.crossed:.3g} % of the light would have to cross between the lens and the nearest "
                "target; there the further goals are met as far as rays that do not cross allow: bring the nearest "
                "target closer to the lens, or move the others further away"
            )
        if self.outside > SAID:
            yield (
                f"{100 * self.outside:.3g} % of the light would have to leave the back outside of lens.outline; "
                "make the targets smaller, or the lens wider"
            )
        if self.turn > self.limit:
            yield (
                f"the front would have to turn light by {self.turn:.3g} degrees, and can turn it by {self.limit:.3g} "
                f"degrees at most; make the lens thicker than {thickness:.3g} mm"
            )


def demands(task: Task, lens: Lens) -> Demand:
    """The gentler demand of a task, or that of its own solution; lens: the blank, both of its faces free."""
    task = task.aimed(lens)
    tried = [_of(_small(task, solution), lens) for solution in _solutions(task)]
    best, light = min(tried, key=lambda one: one[0].rank)
    if refused(best):
        return best
    best = replace(best, turn=_turn(task, lens, light))
    lifted = [replace(best, lifted_turn=best.turn)]
    for floor in FLOORS if len(task.goals) > 1 and task.wave is None else ():
        if lifted[-1].lifted_turn <= GENTLE:
            break
        _, light = _of(_small(replace(task, floor=floor), best.solution), lens)
        lifted.append(replace(best, floor=floor, lifted_turn=_turn(task, lens, light)))
    return min(lifted, key=lambda each: max(GENTLE, each.lifted_turn))


def _solutions(task: Task) -> tuple[float, ...]:
    if task.solution is not None:
        return (task.solution,)
    return (1.0,) if task.wave is not None else (1.0, -1.0)


def _small(task: Task, solution: float) -> Task:
    knobs = task.knobs.model_copy(update={"transport_grid": CELLS, "transport_iterations": ITERATIONS})
    return replace(coarsened(task, PIXELS), knobs=knobs, solution=solution, progress=silent)


def _of(task: Task, lens: Lens) -> tuple[Demand, LightBehind]:
    light = light_behind.of_task(task)
    angle = np.degrees(np.arccos(light.direction[2].clip(-1, 1)))[corners_of(light.picture)]
    crossed = light.crossed(lens.back)
    near = min(task.goals, key=lambda goal: goal.receiver.plane.throw(0.0))
    served = light_behind.uncrossed(light, near.receiver, lens.back, CELLS)
    asked = Demand(
        task.solution, float(angle.max()), float(np.sqrt((angle**2).mean())), crossed=crossed,
        outside=served.beyond(lens.back, lens.apertures[1].scaled(1 + 1e-3).contains),
        turn=math.nan, limit=math.degrees(largest_deflection(lens.index)),
    )  # fmt: skip
    return asked, served


@torch.no_grad()
def _turn(task: Task, lens: Lens, light: LightBehind) -> float:
    """The largest angle (degrees) between the ray that comes to the front and its way to the back."""
    front, source = lens.shaping("front"), task.heaviest.source
    back = light.meeting(lens.back)
    wanted = front_map(source, front, lit_window(source, front), light.picture, back=back, n=CELLS, places=None)
    lit = corners_of(light.picture)
    x, y = (torch.from_numpy(q[lit]) for q in wanted.places)
    way = torch.from_numpy(back[:, lit]) - torch.stack([x, y, lens.front.sag_and_slope(x, y)[0]])
    coming = source.rays(x, y, lens.entrance.z, 1.0).direction
    cosine = (way * coming).sum(0) / torch.sqrt((way * way).sum(0))
    return math.degrees(math.acos(max(-1.0, min(1.0, float(cosine.min())))))


def refused(demand: Demand) -> bool:
    """Is too much of the light beyond what two faces can do?"""
    return demand.outside + demand.crossed > MOST
