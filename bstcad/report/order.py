"""The order for a machine shop: one record for datasheet.pdf, report.html and report.json.

Sizes, volume and mass are those of the file that is sent, as it was read back: part.step of a scene with a mount.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bstcad.analysis.shape import FLATTEST, survey
from bstcad.optics.lens import Lens
from bstcad.report.step_part import box, origin_words
from bstcad.report.units import mm, number
from bstcad.scene.mount import as_cut
from bstcad.scene.scene import Scene

SHEET, PART, LENS = "datasheet.pdf", "part.step", "lens.step"
NOT_STATED = "not stated"
DATUMS = {"front": "the vertex of the front", "flange": "the lower face of the flange"}  # mount.datum: z = 0 is there

Place = tuple[float, float, float]


@dataclass(frozen=True)
class Order:
    """The file for a shop and its facts; lengths in mm, coordinates of the file; None: not stated, or not known."""

    file: str  # with the geometry: part.step of a scene with a mount, else lens.step
    sha256: str  # of that file, in hexadecimal digits
    low: Place  # least x, y and z
    high: Place  # largest x, y and z
    volume: float | None  # mm³; None: of faces that nothing here integrates
    material: str | None
    density: float | None  # g/cm³
    datum: str  # where z = 0 lies, in words
    origin: float  # z of the file's origin in the scene's frame
    freeform: tuple[str, ...]  # names of the freeform faces
    optical: tuple[str, ...]  # names of the faces that light meets
    tool_radius: float | None  # smallest concave radius of the optical faces; None: none of them is concave
    back_profile: float | None  # width of the tolerance zone of a face's profile (ISO 1101)
    front_profile: float | None
    thickness_tolerance: float | None  # ± of the centre thickness
    roughness: float | None  # Ra of the optical faces, at most (nm)
    coating: str | None  # of the optical faces
    unbuilt: bool  # does the scene ask for a part.step that could not be built?
    size: Place  # outer sizes along x, y and z
    mass: float | None  # g


def measured(path: Path) -> tuple[Place, Place, float | None]:
    """(least, largest x, y and z (mm), volume (mm³)) of the part in a STEP file, re-read by OCC.

    The volume is None where it has faces that nothing here integrates.
    """
    from bstcad.cad import solid_properties, step_reading  # the first process need not load OCC
    from bstcad.cad.mass_properties import exact_volume

    reread = step_reading.read(path)
    lens, properties = step_reading.lens(reread, index=1.5), solid_properties.of_solid(reread.shape)
    whole = solid_properties.whole_part(reread, properties)
    low, high = (tuple(end.tolist()) for end in box(lens, whole))
    if whole is None:
        return low, high, exact_volume(lens)
    return low, high, None if properties is None else properties.volume


def order_of(
    scene: Scene, lens: Lens, shape: Mapping[str, Any], folder: Path,
    found: tuple[Place, Place, float | None] | None = None,
) -> Order:  # fmt: skip
    """The order of a design in a folder.

    shape: of the lens as it is cut, as report.json has it, and the volume of lens.step.  found: part.step as
    `measured`; None: there is none.
    """
    mount, stated = scene.mount if found else None, scene.part.of(scene.lens)
    if found is None:
        low, high = (tuple(end.tolist()) for end in box(lens, None))
        found = low, high, shape["volume"]
    path, origin = folder / (PART if mount else LENS), mount.origin(float(lens.front.z)) if mount else 0.0
    vertex = float(lens.front.z) + shape["centre_thickness"]
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    radii = filter(None, (shape["radius_min_concave"], _front_radius(as_cut(lens, scene.mount))))
    (low, high, volume), density = found, stated.density
    return Order(
        file=path.name,
        sha256=digest,
        low=low,
        high=high,
        volume=volume,
        material=stated.material,
        density=density,
        datum=DATUMS.get(mount.datum if mount else "") or origin_words(lens, vertex),
        origin=origin,
        freeform=("back", "front") if lens.front.curvature is None else ("back",),
        optical=("back",) if lens.reflects else ("back", "front"),
        tool_radius=min(radii, default=None),
        back_profile=stated.surface_profile,
        front_profile=stated.front_profile,
        thickness_tolerance=stated.thickness_tolerance,
        roughness=stated.roughness,
        coating=stated.coating,
        unbuilt=scene.mount is not None and mount is None,
        size=tuple(above - below for below, above in zip(low, high, strict=True)),
        mass=None if volume is None or density is None else volume * density / 1000,
    )


def _front_radius(lens: Lens) -> float | None:
    """The smallest concave radius (mm) of the front, which is seen from below; None: of none, or a mirror's rear.

    Of a conic the meridional one, R (1 - k c² r²)^(3/2), which falls towards the rim for k > 0.
    """
    front = lens.front
    if lens.reflects:
        return None
    if front.curvature is None:
        found = survey(replace(lens, back=front)).convex.largest  # a ridge from above is a valley from below
        return found if found < FLATTEST else None
    if not front.curvature < 0:
        return None
    (x, y), c, k = lens.outline.farthest, float(front.curvature), float(front.conic_constant)
    return max(1 - max(k, 0.0) * c * c * (x * x + y * y), 0.0) ** 1.5 / -c


# --- in words ---------------------------------------------------------------------------------------------------------


def rows(order: Order) -> Iterator[tuple[str, str]]:
    """The block "What to order" of report.html: (name, value)."""
    yield "Files to send", f"{order.file}, exact, in mm; {SHEET}, the drawing that goes with it"
    if order.unbuilt:
        yield PART, "could not be built: the failed check says why"
    yield f"SHA-256 of {order.file}", order.sha256
    yield "Outer size", f"{size_words(order)} (x, y, z)"
    yield "Material", material_words(order)
    yield "Volume", volume_words(order)
    yield "Mass", mass_words(order)
    yield "z = 0 of the file", order.datum
    yield "Freeform", f"the face named {' and the face named '.join(order.freeform)}, B-spline, exact in {order.file}"
    for face, width in (("back", order.back_profile), ("front", order.front_profile)):
        if face in order.optical:
            yield f"Profile tolerance, {face}", profile_words(width) or NOT_STATED
    yield "Roughness of optical faces", roughness_words(order)
    yield "Coating of optical faces", order.coating or NOT_STATED
    thickness = order.thickness_tolerance
    yield "Tolerance of the centre thickness", NOT_STATED if thickness is None else f"± {thickness:g} mm"
    yield "Radius of the tool's tip", tool_words(order)


def size_words(order: Order) -> str:
    """26 × 26 × 4.379 mm."""
    return " × ".join(map(mm, order.size)) + " mm"


def material_words(order: Order) -> str:
    """The material of the part."""
    return order.material or NOT_STATED


def volume_words(order: Order) -> str:
    """1.528 cm³."""
    return "not known" if order.volume is None else f"{order.volume / 1000:.4g} cm³"


def mass_words(order: Order) -> str:
    """1.819 g (1.19 g/cm³)."""
    if order.mass is None:
        return "not known: " + ("the volume is not" if order.density else "density not stated")
    return f"{order.mass:.4g} g ({order.density:.4g} g/cm³)"


def profile_words(width: float | None) -> str:
    """A tolerance of the profile of a surface, without a datum; "": not stated."""
    return "" if width is None else f"profile {width:g} mm (ISO 1101)"


def roughness_words(order: Order) -> str:
    """P: polished (ISO 10110-8); Ra in nm (ISO 21920-2)."""
    return NOT_STATED if order.roughness is None else f"P, Ra ≤ {order.roughness:g} nm"


def tool_words(order: Order) -> str:
    """How large a ball-nose tool may be."""
    if order.tool_radius is None:
        return "any: no optical face is concave"
    return f"below {number(order.tool_radius)} mm, the smallest concave radius"
