"""The part that a STEP file holds, in the words a machine shop asks for it with; no design is needed to say it.

Lengths in mm to a micrometre, in the coordinates of the file.
"""

from __future__ import annotations

from collections.abc import Mapping

from bstcad.analysis.shape import describe, heights
from bstcad.cad.volume import exact_volume
from bstcad.optics.lens import Lens
from bstcad.report.units import number, quantity

ROUNDING = 1e-9  # of a conic constant, as it is read back


def part(lens: Lens) -> dict[str, str]:
    """What there is to know of the part, in the order in which it is set up: {what: value}."""
    shape, volume = describe(lens), exact_volume(lens)
    front, back = heights(lens)
    low, high = float(min(front.min(), back.min())), float(max(front.max(), back.max()))
    half_x, half_y = lens.outline.half_extent
    vertex = lens.front.z + shape["centre_thickness"]
    return {
        "Overall size": " × ".join(f"{_mm(side)}" for side in (2 * half_x, 2 * half_y, high - low)) + " mm (x, y, z)",
        "Outline": _outline(lens),
        "Lies at": f"x = ±{_mm(half_x)}, y = ±{_mm(half_y)}, z = {_mm(low)} to {_mm(high)} mm",
        "Origin of the file": _origin(lens, vertex),
        "Orientation": "light travels along +z: it enters the front and leaves through the back, which is freeform",
        "Front": _front(lens),
        "Back": f"freeform, {lens.back.m} × {lens.back.m} control points; crosses the axis at z = {_mm(vertex)} mm",
        "Centre thickness": f"{_mm(shape['centre_thickness'])} mm",
        "Edge thickness": f"{_mm(shape['edge_thickness_min'])} to {_mm(shape['edge_thickness_max'])} mm",
        "Thinnest place": f"{_mm(shape['thickness_min'])} mm",
        "Smallest radii of the back": _radii(shape),
        "Steepest slope of the back": quantity(shape["slope_max_deg"], "deg"),
        "Volume": f"{volume / 1000:.4g} cm³",
        "Mass": f"{volume / 1000:.4g} g for each g/cm³ of density",
    }


def _mm(value: float) -> str:
    return f"{value:.3f}".rstrip("0").rstrip(".").replace("-", "−") if abs(value) >= 5e-4 else "0"


def _outline(lens: Lens) -> str:
    if lens.outline.shape == "circle":
        return f"round, diameter {_mm(2 * lens.outline.radius)} mm"
    return f"rectangle, {_mm(lens.outline.width)} × {_mm(lens.outline.height)} mm"


def _origin(lens: Lens, vertex: float) -> str:
    """Where the part's axis and front lie, seen from the point (0, 0, 0) of the file."""
    front = lens.front.z
    if front > 0:
        place = f"{_mm(front)} mm before the vertex of the front, on the light's side"
    elif front == 0:
        place = "at the vertex of the front"
    elif vertex >= 0:
        place = f"in the lens, {_mm(-front)} mm behind the vertex of the front"
    else:
        place = f"{_mm(-vertex)} mm behind the vertex of the back"
    return f"on the axis of the lens (the middle of its outline), {place}"


def _front(lens: Lens) -> str:
    front = lens.front
    if front.curvature is None:
        return f"freeform, {front.m} × {front.m} control points; crosses the axis at z = {_mm(front.z)} mm"
    if not front.curvature:
        return f"plane at z = {_mm(front.z)} mm"
    radius, bent = 1 / abs(front.curvature), "convex" if front.curvature > 0 else "concave"
    constant = f", conic constant {front.conic_constant:.9g}" if front.conic_constant else ""
    shape = conic_name(front.conic_constant)
    return f"{shape}, {bent}, radius {radius:.9g} mm{constant}; its vertex is at z = {_mm(front.z)} mm"


def conic_name(constant: float) -> str:
    """What a conic of this constant is, in words."""
    if constant == 0:
        return "sphere"
    if abs(constant + 1) < ROUNDING:
        return "paraboloid"
    return "hyperboloid" if constant < -1 else "ellipsoid"


def _radii(shape: Mapping[str, float | None]) -> str:
    found = ((kind, shape[f"radius_min_{kind}"]) for kind in ("concave", "convex"))
    return ", ".join(f"{kind} {f'{number(radius)} mm' if radius else 'none'}" for kind, radius in found)
