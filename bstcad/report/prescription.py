"""A lens and its part in figures: the prescription, the order for a shop, and the facts of a STEP file alone.

The prescription is every surface as it was designed, with source and target, to the last bit: not the numbers of the
scene, whose radius may have been free and whose back may have had to move, and not rounded:

    the lens:    front at its vertex, glass, back at its vertex (where each crosses the axis)
    the signs:   light travels along +z; a radius is positive if its centre lies further along +z than its vertex

The order is one record for datasheet.pdf, report.html and report.json.  Its sizes, volume and mass are those of the
file that is sent, as it was read back: part.step of a scene with a mount.  Lengths are in mm, angles in degrees,
wavelengths in nm.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bstcad.analysis.shape import FLATTEST, describe, heights, survey_front, thickness_range
from bstcad.optics import passes, quadrature
from bstcad.optics.bspline import DEGREE, BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.media import density
from bstcad.optics.surfaces import Surface, sag
from bstcad.report.units import Rows, paragraphs, tables
from bstcad.scene.blank import FIT_TOLERANCE
from bstcad.scene.mount import as_cut
from bstcad.scene.scene import Scene
from bstcad.scene.schema import FileContent

if TYPE_CHECKING:
    from bstcad.cad.solid_properties import WholePart

MOVED = 1e-3  # of the thickness that was drawn; by less the vertex moves in stage 2 anyhow
WAYS = {  # of the light
    "lens": "Light travels along +z",
    "mirror": "Light comes down to the mirror along -z and leaves it along +z",
}
TEXT = """\
Prescription of {name}

Lengths in mm, angles in degrees, wavelengths in nm.  The axis is x = y = 0.
{way}.
A radius is positive if its centre lies further along +z than the vertex.
{exact}
"""
EXACT = (  # of a lens with one tailored face, and with two
    "The freeform back is exact in lens.step, and its control points are in design.npz.",
    "Both freeform faces are exact in lens.step, and their control points are in design.npz.",
)
SHEET, PART, LENS = "datasheet.pdf", "part.step", "lens.step"
DATUMS = {"front": "the vertex of the front", "flange": "the lower face of the flange"}  # mount.datum: z = 0 is there
FILLED = 1e-3  # of an outline's area; an edge that leaves no more of it out is its own

Place = tuple[float, float, float]


def prescription(scene: Scene, lens: Lens, shape: Mapping[str, Any]) -> dict[str, Any]:
    """Of `lens` as it was designed for `scene`; shape: of bstcad.analysis.shape, and the volume."""
    front, material = lens.front, scene.lens.material
    own = scene.lens.front.designed(front).surface.plain().parameters()  # heights, if it is a net
    numbers = ({"curvature": 0.0} if front.level else {}) | {n: v for n, v in own.items() if isinstance(v, float)}
    fitted = {"within": FIT_TOLERANCE} if front.is_net and scene.lens.front.kind != "bspline" else {}  # mm
    heavy = density(material) if material else None
    held = ((each.name, getattr(scene.source, each.name)) for each in fields(scene.source))
    files = {name: value.name for name, value in held if isinstance(value, FileContent)}
    return {
        "name": scene.name,
        "title": scene.title,
        "wavelength": scene.source.main_wavelength,  # of several lines the main one
        "material": material,  # None: only the index is known, or it is a mirror
        "index": lens.index,
        "outline": asdict(lens.outline),
        "clear": lens.clear and tuple(map(asdict, lens.clear)),  # apertures of front and back; None: no mount
        "front": _own(front) | _face(scene.lens.front.kind, lens.front_vertex, numbers) | fitted,
        "back": _face("bspline", vertex(lens), {}),
        "reflects": lens.reflects,  # is it a mirror?
        "net": _net(lens.back),
        **({"front_net": _net(front), "front_asked": scene.lens.front.z} if lens.shapes("front") else {}),
        "back_asked": scene.lens.back.z,  # z at which the scene has the back's vertex
        "centre_thickness": shape["centre_thickness"],
        "edge_thickness": (shape["edge_thickness_min"], shape["edge_thickness_max"]),
        "volume": shape["volume"],  # mm³
        "mass": None if heavy is None else shape["volume"] * heavy / 1000,  # g; None: no density is known
        "source": _known(asdict(scene.source) | files),
        **{name: [_known(e.model_dump(mode="json")) for e in found] for name, found in scene.elements if found},
        "targets": [_known(target.model_dump(mode="json")) for target in scene.targets],
    }


def _net(face: BSplineSurface) -> dict[str, Any]:
    """The net of a face that is tailored."""
    return {
        "control_points": face.shape,  # along x and y
        "degree": DEGREE,
        "knots": _knots(face.shape),
        "x": face.x,  # between which the net lies; beyond the rim of a round lens
        "y": face.y,
    }


def _knots(shape: tuple[int, int]) -> str:
    """The knots in either direction, or along x and along y where these differ."""
    each = [f"0, 0, 0, 1, 2, …, {m - 3}, {m - 2}, {m - 2}, {m - 2}" for m in shape]
    return each[0] if each[0] == each[1] else f"{each[0]} along x; {each[1]} along y"


def _face(kind: str, z: float, numbers: Mapping[str, float]) -> dict[str, Any]:
    """A surface that crosses the axis at z; curvature, radius and conic constant are None where it has none.

    numbers: its shape; each curvature is followed by its radius, such as curvature_x by radius_x, None of a plane.
    """
    curvatures = {name: value for name, value in numbers.items() if name.startswith("curvature")}
    radii = {name.replace("curvature", "radius"): 1 / c if c else None for name, c in curvatures.items()}
    none = dict.fromkeys(("curvature", "radius", "conic_constant"))
    return {"kind": kind, "vertex": (0.0, 0.0, z)} | none | numbers | radii


def _own(front: Surface) -> dict[str, Any]:
    """Of a front with an outline of its own: that, and z of the plane around it."""
    return {} if front.outline is None else {"outline": asdict(front.outline), "around": front.around.z}


def _known(table: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if value is not None}


def vertex(lens: Lens) -> float:
    """z (mm) where the back crosses the axis."""
    return float(sag(lens.back, 0.0, 0.0))


def scene_text(scene: Scene, lens: Lens) -> str:
    """scene.toml beside `lens`, from which the same lens is designed again, with a note on the z of its back."""
    drawn = scene.lens.back.z - scene.lens.front.z
    if not abs(vertex(lens) - scene.lens.back.z) > MOVED * drawn:
        return scene.toml()
    stands = f"as designed, the vertex of the back stands at z = {vertex(lens)!r} mm; it started at lens.back.z below"
    return f"# {stands}\n{scene.toml()}"


def _passes(record: Mapping[str, Any]) -> passes.Passes:
    """The passes of light; the index of a mirror that light does not enter is 1."""
    mirror = passes.MIRROR if record["index"] == 1 else passes.SECOND_SURFACE
    return mirror if record["reflects"] else passes.LENS


def sections(record: Mapping[str, Any]) -> dict[str, Rows]:
    """The prescription in words, by headings; numbers in full."""
    return tables("prescription.txt.j2", lens=record, passes=_passes(record))


def text(record: Mapping[str, Any]) -> str:
    """prescription.txt."""
    name = f"{record['name']}: {record['title']}" if record["title"] else record["name"]
    way = WAYS[_passes(record).optic]
    head = TEXT.format(name=name, way=way, exact=EXACT["front_net" in record])
    parts = (f"\n{heading}\n" + "".join(f"    {name:<30}{value}\n" for name, value in rows)
             for heading, rows in sections(record).items())  # fmt: skip
    return head + "".join(parts)


# --- a part for a shop -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Order:
    """The file for a shop and its facts; lengths in mm, coordinates of the file; None: not stated, or not known."""

    file: str  # with the geometry: part.step of a scene with a mount, else lens.step
    sha256: str  # of that file, in hexadecimal digits
    low: Place  # least x, y and z
    high: Place  # largest x, y and z
    volume: float | None  # mm³; None: of faces that nothing here integrates
    material: str | None  # in words
    density: float | None  # g/cm³
    datum: str  # where z = 0 lies, in words
    origin: float  # z of the file's origin in the scene's frame
    freeform: tuple[str, ...]  # names of the freeform faces
    optical: tuple[str, ...]  # names of the faces that light meets
    tool_radius: float | None  # smallest concave radius of the optical faces; None: none of them is concave
    back_profile: float | None  # width of the tolerance zone of a face's profile (ISO 1101)
    front_profile: float | None  # the same of the front (mm)
    thickness_tolerance: float | None  # ± of the centre thickness
    roughness: float | None  # Ra of the optical faces, at most (nm)
    coating: str | None  # of the optical faces
    unbuilt: bool  # does the scene ask for a part.step that could not be built?
    size: Place  # outer sizes along x, y and z
    mass: float | None  # g


def order_of(
    scene: Scene, lens: Lens, shape: Mapping[str, Any], folder: Path,
    found: tuple[Place, Place, float | None] | None = None,
) -> Order:  # fmt: skip
    """The order of a design in a folder.

    shape: of the lens as it is cut, as report.json has it, and the volume of lens.step.  found: part.step as
    `measured`; None: there is none.
    """
    mount, stated = scene.mount if found else None, scene.part.of(scene.lens)
    low, high, volume = found or (*_corners(lens, None), shape["volume"])
    path, front = folder / (PART if mount else LENS), lens.front_vertex
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    radii = filter(None, (shape["radius_min_concave"], _front_radius(as_cut(lens, scene.mount))))
    return Order(
        file=path.name,
        sha256=digest,
        low=low,
        high=high,
        volume=volume,
        material=stated.material,
        density=stated.density,
        datum=DATUMS.get(mount.datum if mount else "") or _origin(lens, front + shape["centre_thickness"]),
        origin=mount.origin(front) if mount else 0.0,
        freeform=("back", "front") if lens.front.is_net else ("back",),
        optical=tuple(reversed(lens.optical_faces)),
        tool_radius=min(radii, default=None),
        back_profile=stated.surface_profile,
        front_profile=stated.front_profile,
        thickness_tolerance=stated.thickness_tolerance,
        roughness=stated.roughness,
        coating=stated.coating,
        unbuilt=scene.mount is not None and mount is None,
        size=tuple(above - below for below, above in zip(low, high, strict=True)),
        mass=None if volume is None or stated.density is None else volume * stated.density / 1000,
    )


def measured(path: Path) -> tuple[Place, Place, float | None]:
    """(least, largest x, y and z (mm), volume (mm³)) of the part in a STEP file, re-read by OCC.

    The volume is None where the part has faces that nothing here integrates.
    """
    from bstcad.verify import step_checks  # the first process need not load OCC

    lens, whole = step_checks.whole_part(path)
    return *_corners(lens, whole), _volume(lens, whole)


def order_rows(order: Order) -> Rows:
    """The block "What to order" of report.html."""
    return tables("order.txt.j2", order=order)["order"]


def part(
    lens: Lens, whole: WholePart | None = None, stated: float | None = None, placement: Mapping[str, Any] | None = None
) -> dict[str, str]:  # fmt: skip
    """The facts of a part that a STEP file holds, in the order in which a machine is set up; no design is needed.

    whole: the walls around the lens, if it is not bare: then its outline only holds the edge of its back.
    stated: density (g/cm³) in the file; None: the file states none, or several.
    placement: of the lens in the file (its words); None: its own frame is that of the file.
    """
    import shapely  # a twentieth of a second, which a design need not pay

    shape, lies = describe(lens), list(zip(*_corners(lens, whole), strict=True))
    vertex = lens.front_vertex + shape["centre_thickness"]
    edge, outline = None if whole is None else whole.edge, lens.outline
    fills = edge is None or outline.is_round or shapely.Polygon(edge).area > (1 - FILLED) * outline.area
    found = tables(
        "step_part.txt.j2", lens=lens, shape=shape, lies=lies, vertex=vertex, whole=whole is not None,
        origin=_origin(lens, vertex, whole is None), fills=fills,
        edge=edge is not None and list(zip(edge.min(0), edge.max(0), strict=True)),
        thinnest=thickness_range(lens, edge)[0], volume=_volume(lens, whole), density=stated,
        placement=placement,
    )  # fmt: skip
    return dict(found["part"])


def _corners(lens: Lens, whole: WholePart | None) -> tuple[Place, Place]:
    """The least and the largest x, y and z (mm) of a part."""
    half = np.array(lens.outline.half_extent)
    edge = np.array([-half, half]) if whole is None else whole.edge
    faces = np.concatenate(heights(lens, None if whole is None else edge))
    low, high = np.array([*edge.min(0), faces.min()]), np.array([*edge.max(0), faces.max()])
    if whole is not None:
        low, high = np.minimum(low, whole.low), np.maximum(high, whole.high)
    return tuple(low.tolist()), tuple(high.tolist())


def _volume(lens: Lens, whole: WholePart | None) -> float | None:
    """Of a part (mm³); None: it has faces that nothing here integrates."""
    if whole is None:
        return quadrature.of_lens(lens).volume
    return None if whole.properties is None else whole.properties.volume


def _origin(lens: Lens, vertex: float, bare: bool = True) -> str:
    """The position of axis and front, seen from the point (0, 0, 0) of the file; vertex: z of the back's."""
    at = {"passes": lens.passes, "front": lens.front_vertex, "vertex": vertex, "bare": bare}
    return "".join(paragraphs("part_words.txt.j2", "origin", **at))


def _front_radius(lens: Lens) -> float | None:
    """The smallest concave radius (mm) of the front, which is seen from below; None: of none, or a mirror's rear.

    Of a conic the meridional radius, R (1 - k c² r²)^(3/2), which falls towards the rim for k > 0.
    """
    front = lens.front
    if "front" not in lens.passes.faces:
        return None
    if front.is_net:
        found = survey_front(lens).concave.largest
        return found if found < FLATTEST else None
    (x, y), (c, k) = (front.outline or lens.outline).farthest, front.conic()
    if not c < 0:
        return None
    return max(1 - max(k, 0.0) * c * c * (x * x + y * y), 0.0) ** 1.5 / -c
