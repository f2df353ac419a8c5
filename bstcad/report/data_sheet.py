"""Words and figures of a part's data sheet, after ISO 10110-1 and -10; data_sheet_page.py draws the page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.report import order as orders
from bstcad.report.light_figures import View
from bstcad.report.order import NOT_STATED, Order
from bstcad.report.part_views import hole_words, length, wall_words
from bstcad.report.prescription import Face, Prescription, prescription
from bstcad.report.step_part import conic_name
from bstcad.report.units import number, percent, quantity, turned
from bstcad.scene.mount import Mount, as_cut
from bstcad.scene.quality import said_of
from bstcad.scene.scene import Scene
from bstcad.shop.part_drawings import across

DATUMS = {"source": "the scene's", "front": "the front's vertex", "flange": "the flange's lower face"}
MOST = 8  # holes of a kind whose positions are listed
PROFILES = {"gaussian": "Gaussian", "lambertian": "Lambertian", "uniform": "even"}

Row = tuple[str, str]  # name, value


@dataclass(frozen=True, eq=False, kw_only=True)
class Sheet:
    """All that a data sheet is drawn from."""

    scene: Scene
    designed: Lens
    shape: Mapping[str, float | None]  # of the lens as it is cut, and the volume of lens.step
    order: Order  # for the shop, with the file that the sheet belongs to
    target: np.ndarray  # (rows, columns) in coordinates, one sum
    irradiance: np.ndarray
    rrmsd: float
    light_on_target: float  # share of the source's light
    passed: bool  # every check
    version: str  # of the program

    @property
    def mount(self) -> Mount | None:
        """Of a lens that is held in part.step."""
        return self.scene.mount if self.order.file == orders.PART else None

    @cached_property
    def lens(self) -> Lens:
        """Within the rim of its mount."""
        return as_cut(self.designed, self.mount)

    @cached_property
    def record(self) -> Prescription:
        """Of the lens within the rim."""
        return prescription(self.scene, self.lens, self.shape)

    @property
    def view(self) -> View:
        """Of the target."""
        target = self.scene.target
        return View(target.x, target.y, target.seen_from, optic=self.scene.optic, tilt=target.tilt)


# --- the rows of its tables, (name, value) ----------------------------------------------------------------------------


def front_rows(sheet: Sheet, patch: Outline | None) -> Iterator[Row]:
    """The front; patch: clear aperture that the light needs, None: all of it."""
    face, reflects = sheet.record.front, sheet.record.reflects
    if face.curvature is None:
        yield "Form", "freeform, B-spline"
    else:
        yield "Form", conic_name(face.conic_constant or 0.0) if face.radius else "plane"
        yield "Radius", f"{abs(face.radius):.7g} mm {_bent(face)}" if face.radius else "\u221e"
    if face.conic_constant:
        yield "Conic constant", f"{face.conic_constant:.7g}"
    yield "Vertex", f"z = {length(face.vertex[2] - sheet.order.origin)} mm"
    if not reflects:
        yield "Clear aperture", _aperture(patch, sheet.lens)
    yield from _surface(sheet, "front", sheet.scene.part.front_profile)


def body_rows(sheet: Sheet) -> Iterator[Row]:
    """The body between the faces."""
    record, shape, order = sheet.record, sheet.shape, sheet.order
    yield "Outer size", orders.size_words(order)
    if record.reflects:
        yield "Material", f"{orders.material_words(order)}; light does not enter it"
    else:
        yield "Material", order.material or f"{NOT_STATED}, but its index"
        yield "Index", f"n = {record.index:.6g} at {record.wavelength:g} nm"
    yield "Volume", orders.volume_words(order)
    yield "Mass", orders.mass_words(order)
    tolerance = "" if order.thickness_tolerance is None else f" \u00b1 {order.thickness_tolerance:g}"
    yield "Centre thickness", f"{length(shape['centre_thickness'])}{tolerance} mm"
    low, high = (length(shape[f"edge_thickness_{end}"]) for end in ("min", "max"))
    yield "Edge, back to front", f"{low} mm" if low == high else f"{low} to {high} mm"
    low, high = (length(shape[f"thickness_{end}"]) for end in ("min", "max"))
    yield "Thinnest, thickest", f"{low} mm, {high} mm"
    if not record.reflects:
        yield "0/ 1/ 2/", f"stress, bubbles, striae: {NOT_STATED}"
    yield "Tolerances of size", NOT_STATED


def back_rows(sheet: Sheet, patch: Outline | None) -> Iterator[Row]:
    """The back; patch: clear aperture that the light needs, None: all of it."""
    record, shape = sheet.record, sheet.shape
    columns, rows = record.net.control_points
    yield "Form", f"B-spline of degree {record.net.degree}, {columns} \u00d7 {rows}"
    yield "Vertex", f"z = {length(record.back.vertex[2] - sheet.order.origin)} mm"
    yield "Relief, PV", quantity(shape["sag_pv"], "mm")
    yield "Off its best sphere", f"{quantity(shape['departure_best_sphere'], 'mm')} PV"
    radii = ((shape[f"radius_min_{kind}"], sign) for kind, sign in (("concave", "CC"), ("convex", "CX")))
    least = [f"{number(radius)} {sign}" for radius, sign in radii if radius]
    yield "Smallest radii", f"{', '.join(least)} mm" if least else "none: it is level"
    yield "Steepest slope", quantity(shape["slope_max_deg"], "deg")
    yield "Clear aperture", _aperture(patch, sheet.lens)
    yield from _surface(sheet, "back", sheet.scene.part.surface_profile)


def _surface(sheet: Sheet, face: str, profile: float | None) -> Iterator[Row]:
    """Code numbers of a face: form (ISO 10110-5), centring (-6), imperfections (-7), texture (-8), coating (-9).

    Form by the RMS of the total deviation, and by the width of the profile's tolerance zone (mm).
    """
    limit = said_of(sheet.scene.tolerance, f"{face}.form").get("limit")
    form = "" if limit is None else f"3/\u2014RMSt < {1e6 * limit:.4g} nm"
    yield "3/ form", ", ".join(filter(None, (form, orders.profile_words(profile)))) or NOT_STATED
    yield "4/ centring", NOT_STATED
    yield "5/ imperfections", NOT_STATED
    if face in sheet.order.optical:
        yield "Texture", orders.roughness_words(sheet.order)
        yield "\u03bb coating", sheet.order.coating or NOT_STATED


def _bent(face: Face) -> str:
    """Convex or concave from outside, as ISO 10110-10 has it: the centre of a convex front lies behind it, along +z."""
    return "CX" if face.radius > 0 else "CC"


def in_short(face: Face) -> str:
    """Name of a face's form, beside it."""
    if face.curvature is None:
        return "freeform"
    return f"R {abs(face.radius):.5g} {_bent(face)}" if face.radius else "plane"


def _aperture(patch: Outline | None, lens: Lens) -> str:
    """Size of the clear aperture of a face."""
    if patch is None:
        return "all of it"
    if patch.shape == "circle":
        return f"\u00d8e {length(_up(2 * patch.radius))} mm"
    sides = zip(patch.half_extent, lens.outline.half_extent, strict=True)
    return " \u00d7 ".join(length(min(_up(2 * side), 2 * half)) for side, half in sides) + " mm"


def _up(value: float) -> float:
    """Rounded up to three digits."""
    if not value > 0:
        return 0.0
    unit = 10.0 ** (math.floor(math.log10(value)) - 2)
    return math.ceil(value / unit * (1 - 1e-4)) * unit


def purpose_rows(sheet: Sheet) -> Iterator[Row]:
    """Source, target, and how well the lens makes one into the other."""
    source, target, view = sheet.record.source, sheet.scene.target, sheet.view
    yield "Source", _source(source, sheet.order.origin)
    if "wavelength" in source:
        lines = source["wavelength"]
        lines = [(lines, 1.0)] if isinstance(lines, float | int) else lines
        yield "Light", f"{', '.join(f'{nm:g}' for nm, _ in lines)} nm"
    if target.text is not None:
        yield "Picture", f"the letters {target.text!r}"
    else:
        picture = target.sample if target.image is None else target.image.name
        yield "Picture", "even light" if target.uniform else f"the picture {picture}"
    size = " \u00d7 ".join(length(end - start) for start, end in (view.x, view.y))
    pixels = target.pixels if isinstance(target.pixels, list | tuple) else (target.pixels,)
    yield "Size", f"{size} mm, {' × '.join(map(str, pixels))} pixels"
    yield "Screen", f"z = {length(target.z - sheet.order.origin)} mm"
    yield "It covers", f"x {_ends(view.x)}, y {_ends(view.y)} mm"
    if view.tilt and any(view.tilt):
        yield "Tilted by", turned(view.tilt, number)
    yield "Pictures are", "seen from the " + (view.optic if view.seen_from == "lens" else "screen's other side")
    yield "RRMSD", f"{number(sheet.rrmsd)}, traced through {sheet.order.file}"
    yield "On target", f"{percent(sheet.light_on_target)} of the source's light"
    yield "Checks", "all passed" if sheet.passed else "not all passed, see report.html"


def mount_rows(mount: Mount, origin: float) -> Iterator[Row]:
    """Additions of part.step to the lens; origin: z in the scene's frame (mm) that is 0 in part.step."""
    yield "z = 0", DATUMS[mount.datum]
    if mount.rim is not None:
        yield "Lens cut to", f"{across(mount.rim)} mm"
    if walls := wall_words(mount.draft, mount.bevel):
        yield "Lens's walls", walls
    flange = mount.flange
    if flange is None:
        return
    lower, upper = flange.z - origin, flange.z + flange.thickness - origin
    below = ", at its lower face" if flange.draft else ""
    yield "Flange", f"{across(flange.outline)} mm{below}" + ", before its bevel" * bool(flange.bevel)
    yield "from, to", f"z = {length(lower)}, {length(upper)} mm"
    if walls := wall_words(flange.draft, flange.bevel):
        yield "Its walls", walls
    for text, holes in hole_words(mount):
        at = "; ".join(", ".join(length(round(end, 6) + 0.0) for end in hole[:2]) for hole in holes)
        yield "Holes", f"{text} mm" + f" at x, y = {at}" * (len(holes) <= MOST)


def _ends(ends: Sequence[float]) -> str:
    return f"\u00b1{length(ends[1])}" if ends[0] == -ends[1] else " to ".join(map(length, ends))


def _source(source: Mapping[str, Any], origin: float) -> str:
    """Kind, position, profile and size of the source; origin: z in the scene's frame (mm) that is 0 on the sheet."""
    profile = PROFILES.get(source["profile"], source["profile"])
    if source["kind"] == "point":
        x, y, z = source["position"]
        words = [f"point at ({', '.join(map(length, (x, y, z - origin)))}) mm", profile]
        if angle := source.get("half_angle") or source.get("half_angle_1e2"):
            words.append(f"half angle {number(angle)}\u00b0")
        words += [f"{key} {number(source[key])} mm" for key in ("diameter", "width", "height") if source.get(key)]
    else:
        words, aperture = ["parallel light", profile], source["aperture"]
        if source.get("divergence"):
            words.append(f"divergence {number(source['divergence'])}\u00b0")
        if aperture["shape"] == "circle":
            words.append(f"\u00d8{length(2 * aperture['radius'])} mm")
        else:
            words.append(f"{length(aperture['width'])} \u00d7 {length(aperture['height'])} mm")
    if (tilt := source.get("tilt")) and any(tilt):
        words.append(f"tilted by {turned(tilt, number)}")
    return ", ".join(words)
