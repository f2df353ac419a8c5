"""The lens blank that tailoring begins with."""

from __future__ import annotations

import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.scene.model import SceneModel


def blank(scene: SceneModel, m: int, dtype: torch.dtype, device: str) -> Lens:
    """The lens before tailoring: a flat net of m x m control points.

    The net of a round lens reaches two spans past the rim, where x(t) is linear.
    """
    outline = scene.lens.outline
    reach = (m - 1) / (m - 5) if outline.is_round else 1.0
    half_x, half_y = (reach * half for half in outline.half_extent)
    heights = torch.zeros((m, m), dtype=dtype, device=device)
    back = BSplineSurface(scene.lens.back.z, heights, (-half_x, half_x), (-half_y, half_y))
    front = scene.lens.front.surface.to(dtype, device)
    return scene.as_mounted(Lens(front, back, outline, scene.index, scene.lens.back.reflect))
