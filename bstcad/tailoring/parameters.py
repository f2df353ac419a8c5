"""What tailoring may change of a lens, as a record: the back's plane and heights, and the front's parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from torch import Tensor

from bstcad.optics.lens import Lens


@dataclass(frozen=True)
class Parameters:
    """Of one lens: all that tells it from the blank that it was tailored from."""

    z: float  # the plane that the heights of the back are measured from (mm)
    heights: Tensor  # (m, m) of the back (mm)
    front: Mapping[str, float | Tensor]  # by name, such as curvature (1/mm); none of a plane

    @classmethod
    def of(cls, lens: Lens) -> Parameters:
        """Those of a lens."""
        return cls(lens.back.z, lens.back.heights, lens.front.parameters())

    def applied(self, lens: Lens) -> Lens:
        """The lens with these, on the device where it is."""
        like = lens.back.heights
        front = lens.front.with_parameters(**self.front).to(like.dtype, like.device)
        return replace(lens, front=front, back=replace(lens.back, z=self.z, heights=self.heights.to(like.device)))
