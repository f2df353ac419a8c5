"""What a data sheet says of its part: the words and figures, without the page that they stand on (data_sheet_page.py).

In the manner of ISO 10110-1 and -10.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bstcad.analysis.used_area import Used
from bstcad.optics.lens import Lens
from bstcad.optics.sources import Source
from bstcad.report import order as orders
from bstcad.report.light_figures import View
from bstcad.report.order import NOT_STATED, Order
from bstcad.report.part import conic_name
from bstcad.report.part_views import hole_words, length, wall_words
from bstcad.report.prescription import Face, Prescription, prescription
from bstcad.report.units import number, percent, quantity, turned
from bstcad.scene.mount import Mount, as_cut
from bstcad.scene.scene import Scene
from bstcad.scene.tolerance import said_of
from bstcad.shop.part_drawings import across

PIXELS = 256  # of a picture of the light, along its longer side at most
DATUMS = {"source": "the scene's", "front": "the front's vertex", "flange": "the flange's lower face"}
MOST = 8  # holes of a kind whose places are listed
PROFILES = {"gaussian": "Gaussian", "lambertian": "Lambertian", "uniform": "even"}


@dataclass(frozen=True)
class Stated:
    """What a drawing may state that no design knows; empty: nothing is stated."""

    part_number: str = ""
    author: str = ""
    organisation: str = ""
    date: str = ""
    front_form: str = ""  # code number 3: tolerance of the surface, as it is to stand in the table
    back_form: str = ""


@dataclass(frozen=True, eq=False)
class Sheet:
    """All that a data sheet is drawn from."""

    lens: Lens  # as designed, within the rim of its mount
    source: Source
    record: Prescription
    shape: Mapping[str, float | None]  # analysis.shape's and the volume
    order: Order  # which file it belongs to, and what a shop is told of that
    wanted: str  # the picture, in a few words
    target: np.ndarray  # (rows, columns) in coordinates, one sum
    irradiance: np.ndarray
    view: View
    rrmsd: float
    light_on_target: float  # part of what the source sends out
    passed: bool  # every check
    version: str  # of the program
    stated: Stated
    mount: Mount | None = None  # how it is held in part.step


def sheet_of(
    scene: Scene, lens: Lens, shape: Mapping[str, Any], target: np.ndarray, irradiance: np.ndarray,
    worth: tuple[float, float, bool], version: str, order: Order, stated: Stated | None = None,
) -> Sheet:  # fmt: skip
    """The sheet of a design.

    shape: of the lens as it is cut, and the volume of lens.step.  worth: RRMSD, light on the target, whether every
    check passed.  stated: what the drawing is to state besides; None: what the scene does.
    """
    wanted, mount = scene.target, scene.mount if order.file == orders.PART else None
    lens = as_cut(lens, mount)
    return Sheet(
        lens, scene.source, prescription(scene, lens, shape), shape, order, _picture(scene), _few(target),
        _few(irradiance), View(wanted.x, wanted.y, wanted.seen_from, scene.optic, wanted.tilt), *worth, version,
        stated or stated_by(scene), mount,
    )  # fmt: skip


def stated_by(scene: Scene) -> Stated:
    """What the scene states of its part: its [part] table, and the form errors that its [[tolerance]] tables allow."""
    part = scene.part
    front, back = (
        ", ".join(filter(None, (_form(scene, error), orders.profile_words(width))))
        for error, width in (("front.form", part.front_profile), ("back.form", part.surface_profile))
    )
    return Stated(part.number or "", part.author or "", part.organisation or "", part.date or "", front, back)


def _form(scene: Scene, error: str) -> str:
    """ISO 10110-5, code number 3: the total deviation by its RMS."""
    limit = said_of(scene.tolerance, error).get("limit")
    return "" if limit is None else f"3/\u2014RMSt < {1e6 * limit:.4g} nm"


def _picture(scene: Scene) -> str:
    target = scene.target
    if target.text is not None:
        return f"the letters {target.text!r}"
    if target.uniform:
        return "even light"
    return f"the picture {target.sample if target.image is None else target.image.name}"


def _few(picture: np.ndarray) -> np.ndarray:
    """The picture on at most PIXELS along its longer side, each the mean of whole ones."""
    every = -(-max(picture.shape) // PIXELS)
    starts = [np.arange(0, side, every) for side in picture.shape]
    counts = np.outer(*(np.diff([*start, side]) for start, side in zip(starts, picture.shape, strict=True)))
    return np.add.reduceat(np.add.reduceat(picture, starts[0], 0), starts[1], 1) / counts


# --- the rows of its tables, (name, value) ----------------------------------------------------------------------------


def front_rows(sheet: Sheet, patch: Used | None) -> Iterator[tuple[str, str]]:
    """The front; patch: where its light goes, None where none does."""
    face = sheet.record.front
    if face.curvature is None:
        yield "Form", "freeform, B-spline"
    else:
        yield "Form", conic_name(face.conic_constant or 0.0) if face.radius else "plane"
        yield "Radius", f"{abs(face.radius):.7g} mm {_bent(face)}" if face.radius else "\u221e"
    if face.conic_constant:
        yield "Conic constant", f"{face.conic_constant:.7g}"
    yield "Vertex", f"z = {length(face.vertex[2] - sheet.order.origin)} mm"
    if patch is not None:
        yield "Clear aperture", _aperture(patch, sheet.lens)
    yield from _surface(sheet, sheet.stated.front_form, "front")


def body_rows(sheet: Sheet) -> Iterator[tuple[str, str]]:
    """What lies between the faces."""
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


def back_rows(sheet: Sheet, patch: Used) -> Iterator[tuple[str, str]]:
    """The back; patch: where its light goes."""
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
    yield from _surface(sheet, sheet.stated.back_form, "back")


def _surface(sheet: Sheet, form: str, face: str) -> Iterator[tuple[str, str]]:
    """Its code numbers: form (ISO 10110-5), centring (-6), imperfections (-7), texture (-8), coating (-9)."""
    yield "3/ form", form or NOT_STATED
    yield "4/ centring", NOT_STATED
    yield "5/ imperfections", NOT_STATED
    if face in sheet.order.optical:
        yield "Texture", orders.roughness_words(sheet.order)
        yield "\u03bb coating", sheet.order.coating or NOT_STATED


def _bent(face: Face) -> str:
    """As ISO 10110-10 says convex or concave, from outside: the centre of a convex front lies behind it, along +z."""
    return "CX" if face.radius > 0 else "CC"


def in_short(face: Face) -> str:
    """What a face is, beside it."""
    if face.curvature is None:
        return "freeform"
    if face.radius is None:
        return "plane"
    return f"R {abs(face.radius):.5g} {_bent(face)}"


def _aperture(patch: Used, lens: Lens) -> str:
    """What of a face is to be of optical quality: where its light goes."""
    if patch.shape == "whole":
        return "all of it"
    width, height = (min(_up(side), 2 * half) for side, half in
                     zip((patch.width, patch.height), lens.outline.half_extent, strict=True))  # fmt: skip
    if patch.shape == "circle":
        return f"\u00d8e {length(_up(patch.width))} mm"
    return f"{length(width)} \u00d7 {length(height)} mm"


def _up(value: float) -> float:
    """Rounded up to three digits."""
    if not value > 0:
        return 0.0
    unit = 10.0 ** (math.floor(math.log10(value)) - 2)
    return math.ceil(value / unit * (1 - 1e-4)) * unit


def designed_for(sheet: Sheet) -> Iterator[tuple[str, str]]:
    """Source, target, and how well the one makes the other."""
    source, target, view = sheet.record.source, sheet.record.target, sheet.view
    yield "Source", _source(source, sheet.order.origin)
    if "wavelength" in source:
        yield "Light", _light(source["wavelength"])
    yield "Picture", sheet.wanted
    size = " \u00d7 ".join(length(end - start) for start, end in (view.x, view.y))
    yield "Size", f"{size} mm, {' × '.join(map(str, _pixels(target)))} pixels"
    yield "Screen", f"z = {length(target['z'] - sheet.order.origin)} mm"
    yield "It covers", f"x {_ends(view.x)}, y {_ends(view.y)} mm"
    if view.tilt and any(view.tilt):
        yield "Tilted by", turned(view.tilt, number)
    yield "Pictures are", "seen from the " + (view.optic if view.seen_from == "lens" else "screen's other side")
    yield "RRMSD", f"{number(sheet.rrmsd)}, traced through {sheet.order.file}"
    yield "On target", f"{percent(sheet.light_on_target)} of the source's light"
    yield "Checks", "all passed" if sheet.passed else "not all passed, see report.html"


def held_rows(mount: Mount, origin: float) -> Iterator[tuple[str, str]]:
    """What part.step adds to the lens, (name, value); origin: z in the scene's frame (mm) that is 0 in part.step."""
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
        at = "; ".join(f"{_place(x)}, {_place(y)}" for x, y, _ in holes)
        yield "Holes", f"{text} mm" + f" at x, y = {at}" * (len(holes) <= MOST)


def _place(value: float) -> str:
    return length(round(value, 6) + 0.0)


def _light(wavelength: float | Sequence[Sequence[float]]) -> str:
    """Of one wavelength or of lines (nm, weight)."""
    if isinstance(wavelength, float | int):
        return f"{wavelength:g} nm"
    return f"{', '.join(f'{nm:g}' for nm, _ in wavelength)} nm"


def _pixels(target: Mapping[str, Any]) -> tuple[int, ...]:
    """Columns and rows as the scene gives them."""
    pixels = target["pixels"]
    return tuple(pixels) if isinstance(pixels, list | tuple) else (pixels,)


def _ends(ends: Sequence[float]) -> str:
    return f"\u00b1{length(ends[1])}" if ends[0] == -ends[1] else " to ".join(map(length, ends))


def _source(source: Mapping[str, Any], origin: float) -> str:
    """What shines, from where; origin: z in the scene's frame (mm) that is 0 on the sheet."""
    if source["kind"] == "point":
        x, y, z = source["position"]
        place = ", ".join(map(length, (x, y, z - origin)))
        said = f"point at ({place}) mm, {PROFILES.get(source['profile'], source['profile'])}"
        if angle := source.get("half_angle") or source.get("half_angle_1e2"):
            said += f", half angle {number(angle)}\u00b0"
        size = [f"{key} {number(source[key])} mm" for key in ("diameter", "width", "height") if source.get(key)]
    else:
        said = f"parallel light, {PROFILES.get(source['profile'], source['profile'])}"
        size = [f"divergence {number(source['divergence'])}\u00b0"] if source.get("divergence") else []
        aperture = source["aperture"]
        if aperture["shape"] == "circle":
            size.append(f"\u00d8{length(2 * aperture['radius'])} mm")
        else:
            size.append(f"{length(aperture['width'])} \u00d7 {length(aperture['height'])} mm")
    if (tilt := source.get("tilt")) and any(tilt):
        size.append(f"tilted by {turned(tilt, number)}")
    return ", ".join([said, *size])
