"""Room between the faces: a back that would come too near to the front, or cross it, is moved along +z as a whole.

The slopes of a face make the picture, its height hardly does: what a piston changes, the rounds of stage 1 after it
take into account.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from bstcad.optics.lens import Lens

PLACES = 513  # points each way at which the thickness is looked at
SPARE = 0.02  # of the relief of the back: what stage 2 may still take


@torch.no_grad()
def moved_clear(lens: Lens, z: float, least: float) -> Lens:
    """The lens with its back's plane at `z` (mm), or as little behind it as leaves `least` mm of glass everywhere."""
    x, y = torch.meshgrid(
        *(torch.linspace(-half, half, PLACES, dtype=torch.float64) for half in lens.outline.half_extent), indexing="ij"
    )
    inside = lens.outline.contains(x, y)
    x, y = (p[inside].to(lens.back.heights) for p in (x, y))
    relative = lens.back.relative_sag_and_slope(x, y)[0]
    thinnest = float((z - lens.front.z + relative - lens.front.relative_sag_and_slope(x, y)[0]).min())
    if thinnest < least:
        z += least - thinnest + SPARE * float(relative.max() - relative.min())
    return replace(lens, back=replace(lens.back, z=z))
