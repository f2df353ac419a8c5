"""Whether a lens of two freeform faces can serve all of its goals, found before the long stages, on coarse grids.

The light behind the lens follows from its goals (light_behind.py), and from it the places of the back and the angles
in the glass.  Three things can forbid it: rays that would have to cross between lens and target, light that would
have to leave the back outside of the lens, and a turn in the glass that no front can give.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from bstcad.optics.lens import Lens
from bstcad.tailoring import light_behind
from bstcad.tailoring.light_behind import LightBehind
from bstcad.tailoring.run import Task, silent
from bstcad.tailoring.slope_map import corners_of, lit_window
from bstcad.tailoring.stage2 import coarsened
from bstcad.tailoring.two_faces import Aims, front_map, limit_in_glass, steepest_in_glass

CELLS, PIXELS = 64, 128  # a side
ITERATIONS = 100
MOST = 0.5  # of the light, that may be beyond what two faces can do
SAID = 1e-3  # of the light: what fails for less of it is not said
SOLUTIONS = {1.0: "convex", -1.0: "concave"}


@dataclass(frozen=True)
class Demand:
    """What the goals ask of a lens, by one of the two solutions."""

    solution: float  # σ of light_behind.py
    angle: float  # degrees; the largest from the axis at which light leaves the lens
    mean_angle: float  # degrees; RMS of the same
    crossed: float  # part of the light whose rays would cross between lens and target
    outside: float  # part of the light that would leave the back outside of the lens
    in_glass: float  # degrees; the largest angle from the axis in the glass; NaN: nobody asked
    limit: float  # degrees; the largest by which a front can turn light

    @property
    def rank(self) -> tuple[float, float]:
        """Less is better: what cannot be served, then the angles."""
        lost = self.crossed + self.outside
        return (lost if lost > SAID else 0.0), self.mean_angle

    def sentences(self, thickness: float) -> Iterator[str]:
        """What the lens has to do, and what it cannot; thickness: of its middle (mm)."""
        yield (
            f"{SOLUTIONS[self.solution]} solution: light leaves the lens at up to {self.angle:.3g} degrees from the "
            f"axis and runs at up to {self.in_glass:.3g} degrees in the glass"
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
        if self.in_glass > self.limit:
            yield (
                f"light would have to run at {self.in_glass:.3g} degrees in the glass, and a front turns it by "
                f"{self.limit:.3g} degrees at most; make the lens thicker than {thickness:.3g} mm"
            )


def demands(task: Task, lens: Lens) -> Demand:
    """The gentler demand of a task, or that of its own solution; lens: the blank, both of its faces free."""
    tried = [_of(_small(task, solution), lens) for solution in _solutions(task)]
    best, light = min(tried, key=lambda one: one[0].rank)
    if refused(best):
        return best
    return replace(best, in_glass=_in_glass(_small(task, best.solution), lens, light))


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
    near = min(task.goals, key=lambda goal: goal.screen.z)
    served = light_behind.uncrossed(light, near.screen, lens.back, CELLS)
    asked = Demand(
        task.solution, float(angle.max()), float(np.sqrt((angle**2).mean())), crossed=crossed,
        outside=served.beyond(lens.back, lens.apertures[1].scaled(1 + 1e-3).contains),
        in_glass=math.nan, limit=limit_in_glass(lens.index),
    )  # fmt: skip
    return asked, served


def _in_glass(task: Task, lens: Lens, light: LightBehind) -> float:
    front, source = replace(lens, shaped=(0,)), task.heaviest.source
    back = light.meeting(lens.back)
    with torch.no_grad():
        wanted = front_map(source, front, lit_window(source, front), Aims(light.picture, back), n=CELLS, places=None)
    lit = corners_of(light.picture)
    return steepest_in_glass(lens, tuple(q[lit] for q in wanted.places), back[:, lit])


def refused(demand: Demand) -> bool:
    """Is too much of the light beyond what two faces can do?"""
    return demand.outside + demand.crossed > MOST
