"""Text of the scene of a lens as designed: tailoring may move the back, which the text then states."""

from __future__ import annotations

from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.surfaces import sag
from bstcad.scene.scene import Scene

MIN_NOTED_SHIFT = 1e-3  # smallest shift of the back's vertex that scene.toml mentions, as a fraction of the thickness


def vertex(lens: Lens) -> float:
    """Return the position z of the back on the axis (mm)."""
    return float(sag(lens.back, 0.0, 0.0))


def scene_text(scene: Scene, lens: Lens) -> str:
    """Return the text of scene.toml in a design's folder, with a note if the back was moved."""
    drawn = scene.lens.back.z - scene.lens.front.z
    if not abs(vertex(lens) - scene.lens.back.z) > MIN_NOTED_SHIFT * drawn:
        return scene.toml()
    note = f"the vertex of the back is at z = {vertex(lens)!r} mm; it started at {scene.lens.back.vertex_key} below"
    return f"# as designed, {note}\n{scene.toml()}"
