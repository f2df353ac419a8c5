"""A designed lens with its course, in memory; folder.py writes it and reads it back to the last bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bstcad.designs.course import DesignCourse
from bstcad.optics.surfaces.bspline import is_net
from bstcad.optics.surfaces.surfaces import Surface
from bstcad.transport.mapping import TransportMap
from bstcad.verify.nominal import Nominal


@dataclass(frozen=True)
class DesignedLens(Nominal):
    """Designed lens as a folder stores it: on the CPU, with goals restricted to the pixels that light can reach."""

    course: DesignCourse = DesignCourse()  # stages, history and machine, for the report
    device: str = "cpu"  # device on which the lens was designed: "cpu" or "cuda"
    transport: TransportMap | None = None  # transport map of stage 1; None: the user's own lens, or not stored
    # Function that returns `course` with the comparison of float32 and float64 for the report; None: nothing to add.
    precision_comparison: Callable[[], DesignCourse] | None = None

    def with_report_data(self) -> DesignedLens:
        """Return this design with the comparison of float32 and float64 that the report prints."""
        compare = self.precision_comparison
        return self if compare is None else replace(self, course=compare(), precision_comparison=None)

    def is_lens_of(self, other: Nominal) -> bool:
        """Return True if lens (to the last bit), source and targets are equal to those of another design."""
        return (
            same_front(self.lens.front, other.lens.front)
            and np.array_equal(self.lens.back_net.control_points(), other.lens.back_net.control_points())
            and self.scene.source == other.scene.source
            and self.scene.targets == other.scene.targets
        )


def same_front(one: Surface, other: Surface) -> bool:
    """Return True if two fronts are equal to the last bit."""
    if is_net(one) and is_net(other):  # independent of their planes z
        return np.array_equal(one.control_points(), other.control_points())
    both = [{"z": front.z, **front.parameters()} for front in (one.plain(), other.plain())]
    same = (one.kind, one.outline) == (other.kind, other.outline) and both[0].keys() == both[1].keys()
    return same and all(np.array_equal(both[0][key], both[1][key]) for key in both[0])
