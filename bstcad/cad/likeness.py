"""A light likeness of a lens for viewers: the same outline and front, the back on a coarser net.

A viewer turns every face into triangles before it shows it, which takes long with 513 x 513 control points.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle
from bstcad.optics.surfaces import sag

SPARE = 4  # control points a side beyond the rim of a round lens: two spans, and what x(u) takes to become linear


def likeness(lens: Lens, m: int) -> Lens:
    """The lens with a back of m x m control points, each as high as the back itself where it stands.

    That follows what is wider than a few cells of the coarse net, and smooths the rest (de Boor 1978, Schoenberg's
    operator); no light goes through it as through the lens.
    """
    lens = lens.plain()
    if m >= lens.back.m:
        return lens
    stretch = (m - 1) / (m - 1 - 2 * SPARE) if isinstance(lens.outline, Circle) else 1.0
    ends = [stretch * half for half in lens.outline.half_extent]
    spans = zip(ends, (lens.back.x, lens.back.y), strict=True)
    x, y = np.meshgrid(*(np.clip(np.linspace(-end, end, m), *span) for end, span in spans), indexing="ij")
    heights = torch.from_numpy(sag(lens.back, x, y) - lens.back.z)
    return replace(lens, back=BSplineSurface(lens.back.z, heights, *((-end, end) for end in ends)))
