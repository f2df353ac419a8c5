"""Lenses with rough backs, as a caustic has them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch

from bstcad.cad import step_writing
from bstcad.cad.solid import named_solid
from bstcad.optics.lens.face_integrals import of_lens
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Outline, Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Surface
from bstcad.scene.mount import Part
from tests.lenses import half_over, net, rough

FRONT, OUTLINE = Plane(8.0), Rectangle(24.0, 20.0)


def rough_back(outline: Outline, m: int, ripple: float = 1e-3) -> BSplineSurface:
    """A dome with waves, and a different height at every control point (ripple, mm)."""
    noise = rough(ripple, m, m=m).heights
    return net(
        lambda x, y: 0.05 * x - 0.008 * (x * x + y * y) + 0.2 * torch.sin(x / 2) * torch.cos(y / 3) + noise,
        m=m, half=half_over(outline, m),
    )  # fmt: skip


def encode(lens: Lens, part: Part, name: str = "lens", faces: Sequence[str] | None = None) -> bytes:
    """The STEP file of a lens that states all that it can."""
    solid, names = named_solid(lens)
    return b"".join(step_writing.encode(solid, name, part, faces=faces or names, properties=of_lens(lens)))


@pytest.fixture
def make_lens() -> Callable[..., Lens]:
    def make(front: Surface = FRONT, outline: Outline = OUTLINE, m: int = 17, ripple: float = 1e-3) -> Lens:
        return Lens.between(front, rough_back(outline, m, ripple), outline, 1.49)

    return make
