"""Stage 3, for a source of some size: the merit of stage 2, summed over points of the source, which grows in steps.

The lens for a point throws the target blurred by the source's image (analysis/blur.py).  Stage 3 goes on from it with
fixed points of the source as channels: first of a small source, then of a larger one, at last of the source as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from bstcad.optics.lens import Lens
from bstcad.tailoring.run import Step, Task
from bstcad.tailoring.stage2 import Round, TubeSearch, follow

SIZES = ((1 / 3, 1 / 6), (2 / 3, 1 / 6), (1.0, 2 / 3))  # (of the source, evaluations), as shares of all

Stage2 = Callable[[Task, Lens, Any], Iterator[Step]]


@dataclass(frozen=True)
class Grown:
    """Where stage 3 stands between two steps of a search."""

    grown: TubeSearch


def after(stage2: Stage2, task: Task, lens: Lens, state: Any = None) -> Iterator[Step]:
    """Stage 2 for the source's middle, then stage 3; or on from a state of either.

    What stage 2 has come to is judged by the light of the whole source.
    """
    if not isinstance(state, Grown):
        for last in stage2(task, lens, state):
            if last.ends:
                whole = task.whole
                last = replace(last, judged=whole.rrmsd(last.lens))
            yield replace(last, reason="")
        lens, state = last.lens, None
    for step in follow(rounds(task), lens, state and state.grown):
        yield replace(step, state=step.state and Grown(step.state))


def rounds(task: Task) -> tuple[Round, ...]:
    """One for each size of the source."""
    total = task.knobs.stage2_iterations
    lights = (replace(task, channels=channels, grown=()) for channels in task.grown)
    pairs = zip(lights, SIZES, strict=True)
    return tuple(Round(light, light.tubes, round(share * total), "stage 3") for light, (_, share) in pairs)
