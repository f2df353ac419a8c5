"""Lenses with rough backs, as a caustic has them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch

from bstcad.cad import step_writing
from bstcad.cad.solid import named_solid
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Outline, Rectangle
from bstcad.optics.quadrature import of_lens
from bstcad.optics.surfaces import Plane, Sphere
from bstcad.scene.mount import Part

FRONT, OUTLINE = Plane(8.0), Rectangle(24.0, 20.0)


def rough_back(outline: Outline, m: int, ripple: float = 1e-3) -> BSplineSurface:
    """A dome with waves, and a different height at every control point (ripple, mm)."""
    half_x, half_y = outline.half_extent
    if isinstance(outline, Circle):
        half_x = half_y = outline.radius * (m - 1) / (m - 5)  # two spans past the rim
    x = torch.linspace(-half_x, half_x, m, dtype=torch.float64)[:, None]
    y = torch.linspace(-half_y, half_y, m, dtype=torch.float64)[None, :]
    noise = torch.randn(m, m, generator=torch.Generator().manual_seed(m), dtype=torch.float64)
    heights = 0.05 * x - 0.008 * (x * x + y * y) + 0.2 * torch.sin(x / 2) * torch.cos(y / 3) + ripple * noise
    return BSplineSurface(20.0, heights, (-half_x, half_x), (-half_y, half_y))


def encoded(lens: Lens, part: Part, name: str = "lens", faces: Sequence[str] | None = None) -> bytes:
    """The STEP file of a lens that states all that it can."""
    solid, names = named_solid(lens)
    return step_writing.encode(solid, name, part, faces=faces or names, properties=of_lens(lens))


@pytest.fixture
def make_lens() -> Callable[..., Lens]:
    def make(
        front: Plane | Sphere = FRONT, outline: Outline = OUTLINE, m: int = 17, ripple: float = 1e-3
    ) -> Lens:  # fmt: skip
        return Lens(front, rough_back(outline, m, ripple), outline, 1.49)

    return make
