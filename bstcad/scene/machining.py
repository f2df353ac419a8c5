"""What a shop can make: bounds that the back keeps while it is tailored, as a scene's table [lens] states them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bstcad.scene.wanted import Wanted

KEYS = ("tool_radius", "max_slope", "max_thickness", "edge_thickness")  # of [lens]; lens.min_thickness is always kept


@dataclass(frozen=True)
class Bounds:
    """Of a back, everywhere inside the outline; None: there is none."""

    concave: float | None = None  # largest curvature of a valley towards +z (1/mm)
    convex: float | None = None  # of a ridge (1/mm)
    slope: float | None = None  # steepest |∇z|
    thinnest: float = 0.0  # mm; between front and back, along the axis
    thickest: float | None = None  # mm
    edge: float | None = None  # mm; least thickness along the rim


def bounds_of(scene: Wanted) -> Bounds | None:
    """The bounds that the scene states by KEYS; None: it states none."""
    lens = scene.lens
    if all(getattr(lens, key) is None for key in KEYS):
        return None
    curvature = None if lens.tool_radius is None else 1 / lens.tool_radius
    return Bounds(
        None if lens.mould else curvature,
        curvature if lens.mould else None,
        None if lens.max_slope is None else math.tan(math.radians(lens.max_slope)),
        lens.min_thickness,
        lens.max_thickness,
        lens.edge_thickness,
    )


def complaints(scene: Wanted) -> Iterator[str]:
    """What keeps every back, a flat one too, from meeting the bounds; and what contradicts itself."""
    lens = scene.lens
    given = [key for key in KEYS if getattr(lens, key) is not None]
    if lens.mould and lens.tool_radius is None:
        yield "lens.mould: says whose valleys lens.tool_radius is for, and there is none; add it in mm, or remove mould"
    who, other = {
        "adam": ("the paper's procedure", "quality"),
        "integration": ("point-by-point integration", "method"),
    }.get(scene.tailoring.resolved(lens.back.control_points).method, ("", ""))
    if given and who:
        yield f"lens.{given[0]}: {who} knows no such bounds; remove it, or choose another tailoring.{other}"
    most = lens.max_thickness
    if most is None:
        return
    falls, rises = lens.front.surface.sags(lens.outline)
    for key, least in (
        ("lens.min_thickness", lens.min_thickness),
        ("lens.edge_thickness", lens.edge_thickness),
    ):
        if least is not None and not least <= most:
            yield f"lens.max_thickness: {most:g} mm, and {key} asks for {least:g} mm; allow more, or ask for less"
    least = lens.min_thickness
    if not most - least >= rises - falls:
        yield (
            f"lens.max_thickness: {most:g} mm, and {least:g} mm at its thinnest place under a flat back the lens is "
            f"{least + rises - falls:.6g} mm thick at its thickest, since its front is curved; allow more"
        )
