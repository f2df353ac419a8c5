"""Room between the faces: a back that would come too near to the front, or cross it, is moved along +z as a whole.

The slopes of a face make the picture, its height hardly does: what a piston changes, the rounds of stage 1 after it
take into account.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from bstcad.optics.lens import Lens
from bstcad.optics.sampling import rim
from bstcad.scene.blank import Bounds

PLACES = 513  # points each way at which the thickness is looked at
RIM = 1025  # times four: points along the rim
SPARE = 0.02  # of the relief of the back: what stage 2 may still take


@torch.no_grad()
def moved_clear(lens: Lens, z: float, least: float, bounds: Bounds | None = None) -> Lens:
    """The lens with its back's plane at `z` (mm), or as little behind it as leaves `least` mm of glass everywhere.

    With bounds, the rim's least thickness and the greatest thickness anywhere hold, too; where they exclude each other
    the back exceeds both by the same length.
    """
    x, y = places(lens)
    relative = lens.back.relative_sag_and_slope(x, y)[0]
    glass = z - lens.front.z + relative - lens.front.relative_sag_and_slope(x, y)[0]
    relief = float(relative.max() - relative.min())
    if bounds is None:
        thinnest = float(glass.min())
        if thinnest < least:
            z += least - thinnest + SPARE * relief
        return replace(lens, back=lens.back.moved(z))
    x, y = on_rim(lens)
    edge = z + lens.back.relative_sag_and_slope(x, y)[0] - lens.front.sag_and_slope(x, y)[0]
    short = max(least, bounds.thinnest or least) - float(torch.minimum(glass.min(), edge.min()))
    if bounds.edge is not None:
        short = max(short, bounds.edge - float(edge.min()))
    room = math.inf if bounds.thickest is None else bounds.thickest - float(torch.maximum(glass.max(), edge.max()))
    spare = min(SPARE * relief, max(room - short, 0.0) / 2)
    shift = max(short + spare, 0.0) + min(room - spare, 0.0) if short <= room else (short + room) / 2
    return replace(lens, back=lens.back.moved(z + shift))


def places(lens: Lens) -> tuple[Tensor, Tensor]:
    """Points inside the outline (mm) at which the thickness is looked at."""
    x, y = torch.meshgrid(
        *(torch.linspace(-half, half, PLACES, dtype=torch.float64) for half in lens.outline.half_extent), indexing="ij"
    )
    inside = lens.outline.contains(x, y)
    return tuple(p[inside].to(lens.like) for p in (x, y))


def on_rim(lens: Lens) -> tuple[Tensor, Tensor]:
    """The same along the rim (mm)."""
    return tuple(p.to(lens.like) for p in rim(lens.outline, RIM))
