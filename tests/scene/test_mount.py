"""[mount]: what cannot be built is one sentence before any work."""

import numpy as np
import pytest

from bstcad.cad.mounting import wire
from bstcad.scene.mount import Box, Round
from bstcad.scene.scene import load
from tests.conftest import DISK

FLANGE = {"outline": {"shape": "circle", "diameter": 40.0}, "z": 15.5, "thickness": 1.0}


def test_it_comes_back_from_the_file_that_a_design_keeps(tmp_path):
    flange = FLANGE | {"screws": {"count": 3, "diameter": 3.2, "circle": 34.0}, "draft": 1.0, "bevel": 0.2}
    rim = {"shape": "rectangle", "width": 15.0, "height": 14.0, "corner_radius": 2.0}
    mount = {"datum": "flange", "rim": rim, "draft": 1.5, "bevel": 0.1, "flange": flange}
    scene = load(DISK).changed({"mount": mount})
    (tmp_path / "scene.toml").write_text(scene.toml(), encoding="utf-8")
    assert load(tmp_path / "scene.toml") == scene
    assert load(DISK).mount is None


@pytest.mark.parametrize("outline", [
    Round(shape="circle", diameter=7.0),
    Box(shape="rectangle", width=8.0, height=6.0),
    Box(shape="rectangle", width=8.0, height=6.0, corner_radius=1.5),
])  # fmt: skip
def test_what_is_held_against_an_outline_is_the_wire_that_is_built(outline):
    """Along the wire the depth is 0, and it is so along the places that stand for it, half as long inside."""
    edges, outline = wire(outline).Edges(), outline.outline
    found = [edge.positionAt(t) for edge in edges for t in np.linspace(0, 1, 9)]
    assert np.abs(outline.depth(np.array([p.x for p in found]), np.array([p.y for p in found]))).max() < 1e-12
    x, y = outline.places()
    assert np.abs(outline.depth(x, y)).max() < 1e-12 and (outline.depth(x / 2, y / 2) > 0).all()
    assert (outline.depth(1.1 * x, 1.1 * y) < 0).all()
