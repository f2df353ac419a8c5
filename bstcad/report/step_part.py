"""The part that a STEP file holds, in the words a machine shop asks for it with; no design is needed to say it.

Lengths in mm to a mm, in the coordinates of the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from bstcad.analysis.shape import describe, heights, thickness_range
from bstcad.cad.mass_properties import exact_volume
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.report.units import mm, number, quantity

if TYPE_CHECKING:
    from bstcad.cad.solid_properties import WholePart


ROUNDING = 1e-9  # of a conic constant, as it is read back
FILLED = 1e-3  # of an outline's area; an edge that leaves no more of it out is its own


def part(lens: Lens, whole: WholePart | None = None, density: float | None = None) -> dict[str, str]:
    """The facts of a part in the order in which a machine is set up: {name: value}.

    whole: what is around the lens, if it is not bare: then its outline is no more than what holds the edge of its back.
    density: g/cm³, as the file states it; None: it states none, or several.
    """
    shape = describe(lens)
    low, high = box(lens, whole)
    vertex = lens.front.z + shape["centre_thickness"]
    where = "" if whole is None or _fills(whole.edge, lens.outline) else ", in the rectangle around its edge"
    return {
        "Overall size": " × ".join(mm(b - a) for a, b in zip(low, high, strict=True)) + " mm (x, y, z)",
        "Outline": _outline(lens, whole),
        "Lies at": ", ".join(f"{axis} = {_span(*ends)}" for axis, *ends in zip("xyz", low, high, strict=True)) + " mm",
        "Origin of the file": origin_words(lens, vertex, whole),
        "Orientation": "light travels along +z: it enters the front and leaves through the back, which is freeform",
        "Front": _front(lens),
        "Back": f"freeform, {lens.back.m} × {lens.back.m} control points; crosses the axis at z = {mm(vertex)} mm",
        **_thicknesses(lens, shape, whole),
        "Smallest radii of the back": _radii(shape) + where,
        "Steepest slope of the back": quantity(shape["slope_max_deg"], "deg") + where,
        **_mass(lens, whole, density),
    }


def box(lens: Lens, whole: WholePart | None) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest x, y and z (mm) of the part."""
    half_x, half_y = lens.outline.half_extent
    faces = np.concatenate(heights(lens, None if whole is None else whole.edge))
    low, high = np.array([-half_x, -half_y, faces.min()]), np.array([half_x, half_y, faces.max()])
    if whole is None:
        return low, high
    (low[:2], high[:2]), below, above = (
        (whole.edge.min(0), whole.edge.max(0)),
        np.array(whole.low),
        np.array(whole.high),
    )
    return np.minimum(low, below), np.maximum(high, above)


def _span(low: float, high: float) -> str:
    return f"±{mm(high)}" if mm(-low) == mm(high) else f"{mm(low)} to {mm(high)}"


def _fills(edge: np.ndarray, outline: Outline) -> bool:
    """Is the edge (n, 2) that of the outline itself?"""
    x, y = edge.T
    area = abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
    return outline.shape == "circle" or area > (1 - FILLED) * outline.area


def _thicknesses(lens: Lens, shape: Mapping[str, float | None], whole: WholePart | None) -> dict[str, str]:
    centre = {"Centre thickness": f"{mm(shape['centre_thickness'])} mm"}
    if whole is not None:
        thinnest = thickness_range(lens, whole.edge)[0]
        return centre | {"Thinnest place": f"{mm(thinnest)} mm, between back and front, the latter prolonged"}
    least, most = shape["edge_thickness_min"], shape["edge_thickness_max"]
    edge = {"Edge thickness": f"{mm(least)} to {mm(most)} mm"}
    return centre | edge | {"Thinnest place": f"{mm(shape['thickness_min'])} mm"}


def _mass(lens: Lens, whole: WholePart | None, density: float | None) -> dict[str, str]:
    found = whole and whole.properties
    if whole is not None and found is None:
        return {"Volume": "not found: it has faces of kinds that bstcad does not integrate"}
    volume = exact_volume(lens) if found is None else found.volume
    mass = f"{volume / 1000:.4g} g for each g/cm³ of density"
    if density is not None:
        mass = f"{density * volume / 1000:.4g} g, by the density of {density:g} g/cm³ that the file states"
    return {"Volume": f"{volume / 1000:.4g} cm³", "Mass": mass}


def _outline(lens: Lens, whole: WholePart | None) -> str:
    if whole is not None:
        return f"that of the back: {_of_back(lens, whole)}; around it other walls, such as a flange, a draft or a cut"
    if lens.outline.shape == "circle":
        return f"round, diameter {mm(2 * lens.outline.radius)} mm"
    return f"rectangle, {mm(lens.outline.width)} × {mm(lens.outline.height)} mm"


def _of_back(lens: Lens, whole: WholePart) -> str:
    if _fills(whole.edge, lens.outline):
        return _outline(lens, None)
    (low_x, low_y), (high_x, high_y) = whole.edge.min(0), whole.edge.max(0)
    return f"x = {_span(low_x, high_x)}, y = {_span(low_y, high_y)} mm with cut corners"


def origin_words(lens: Lens, vertex: float, whole: WholePart | None = None) -> str:
    """Where the part's axis and front lie, seen from the point (0, 0, 0) of the file."""
    front = lens.front.z
    if front > 0:
        place = f"{mm(front)} mm before the vertex of the front, on the light's side"
    elif front == 0:
        place = "at the vertex of the front"
    elif vertex >= 0:
        place = f"in the lens, {mm(-front)} mm behind the vertex of the front"
    else:
        place = f"{mm(-vertex)} mm behind the vertex of the back"
    axis = "on the axis of the lens" + (" (the middle of its outline)" if whole is None else "")
    return f"{axis}, {place}"


def _front(lens: Lens) -> str:
    front = lens.front
    if front.curvature is None:
        return f"freeform, {front.m} × {front.m} control points; crosses the axis at z = {mm(front.z)} mm"
    if not front.curvature:
        return f"plane at z = {mm(front.z)} mm"
    radius, bent = 1 / abs(front.curvature), "convex" if front.curvature > 0 else "concave"
    constant = f", conic constant {front.conic_constant:.9g}" if front.conic_constant else ""
    shape = conic_name(front.conic_constant)
    return f"{shape}, {bent}, radius {radius:.9g} mm{constant}; its vertex is at z = {mm(front.z)} mm"


def conic_name(constant: float) -> str:
    """The name of a conic of this constant."""
    if constant == 0:
        return "sphere"
    if abs(constant + 1) < ROUNDING:
        return "paraboloid"
    return "hyperboloid" if constant < -1 else "ellipsoid"


def _radii(shape: Mapping[str, float | None]) -> str:
    found = ((kind, shape[f"radius_min_{kind}"]) for kind in ("concave", "convex"))
    return ", ".join(f"{kind} {f'{number(radius)} mm' if radius else 'none'}" for kind, radius in found)
