"""The record of all that tailoring may change of a lens: planes and heights of its nets, and the front's parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from torch import Tensor

from bstcad.optics.lens import Lens


@dataclass(frozen=True)
class NetParameters:
    """Of one freeform interface."""

    z: float  # the plane that its heights are measured from (mm)
    heights: Tensor  # (m, m) mm


@dataclass(frozen=True)
class Parameters:
    """Of one lens: all that tells it from the blank that it was tailored from."""

    nets: tuple[NetParameters, ...]  # in the order of Lens.freeform
    front: Mapping[str, float | Tensor]  # by name, such as curvature (1/mm); none of a plane or of a net

    @classmethod
    def of(cls, lens: Lens) -> Parameters:
        """Those of a lens."""
        front = {} if lens.front.is_net else lens.front.parameters()
        return cls(tuple(NetParameters(net.z, net.heights) for net in lens.nets), front)

    def applied(self, lens: Lens) -> Lens:
        """The lens with these, on the device where it is."""
        like = lens.like
        lens = replace(lens, front=lens.front.with_parameters(**self.front).to(like.dtype, like.device))
        own = zip(lens.nets, self.nets, strict=True)
        return lens.with_nets(replace(net, z=p.z, heights=p.heights.to(like.device)) for net, p in own)
