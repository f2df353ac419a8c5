"""Numbers of a lens and its part: the prescription, the order for a shop, and the facts of a STEP file alone.

The prescription states, with all digits, every surface as it was designed, and source and target.  It may differ
from the scene, since tailoring may change a free radius and move the back.

    lens:    front, glass, back; the vertex of a face is its intersection with the axis
    signs:   light leaves along +z; a radius is positive if the centre of curvature is on the +z side of the vertex

The order is one record for datasheet.pdf, report.html and report.json.  Its sizes, volume and mass are those read
back from the shop's file (with a mount: part.step).  Lengths in mm, angles in degrees, wavelengths in nm.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bstcad.analysis.shape import MAX_RADIUS, describe, heights, survey, thickness_range
from bstcad.designs.as_designed import vertex
from bstcad.optics.lens import face_integrals, passes
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.media import density
from bstcad.optics.lens.passes import BACK, FRONT
from bstcad.optics.surfaces.bspline import DEGREE, BSplineSurface
from bstcad.optics.surfaces.surfaces import Surface
from bstcad.report.units import Rows, paragraphs, tables
from bstcad.scene.fronts import FIT_TOLERANCE
from bstcad.scene.mount import Mount, Part, as_cut
from bstcad.scene.scene import Scene
from bstcad.scene.schema import FileContent

if TYPE_CHECKING:
    from bstcad.cad.solid_properties import WholePart

LIGHT_DIRECTIONS = {  # kind of the optic: direction of the light in words
    "lens": "Light travels along +z",
    "mirror": "Light travels to the mirror along -z and leaves it along +z",
}
HEAD = """\
Prescription of {name}

Lengths in mm, angles in degrees, wavelengths in nm.  The axis is x = y = 0.
{direction}.
A radius is positive if the centre of curvature lies on the +z side of the vertex.
{exact}
"""
EXACT_FACES = (  # sentence on a freeform back, and on two freeform faces
    "The freeform back is exact in lens.step, and its control points are in design.npz.",
    "Both freeform faces are exact in lens.step, and their control points are in design.npz.",
)
SHEET, PART, LENS = "datasheet.pdf", "part.step", "lens.step"
DATUMS = {FRONT: "the vertex of the front", "flange": "the lower face of the flange"}  # plane z = 0, by datum
EDGE_TOLERANCE = 1e-3  # free fraction of an outline's area up to which a back counts as filling the outline

Point = tuple[float, float, float]
Measures = tuple[Point, Point, float | None]  # smallest and largest x, y, z (mm); volume (mm³), None: unknown


def prescription(scene: Scene, lens: Lens, shape: Mapping[str, Any]) -> dict[str, Any]:
    """Return the prescription of a lens for a scene; shape: facts of analysis.shape.describe, and the volume."""
    front, material = lens.front, scene.lens.material
    own = scene.lens.front.with_parameters(front).surface.plain().parameters()  # control points, if the front is a net
    numbers = ({"curvature": 0.0} if front.level else {}) | {n: v for n, v in own.items() if isinstance(v, float)}
    fitted = {"within": FIT_TOLERANCE} if front.is_net and scene.lens.front.kind != "bspline" else {}  # mm
    rho = density(material) if material else None
    values = ((each.name, getattr(scene.source, each.name)) for each in fields(scene.source))
    files = {name: value.name for name, value in values if isinstance(value, FileContent)}
    return {
        "name": scene.name,
        "title": scene.title,
        "wavelength": scene.source.main_wavelength,  # main line of a spectrum
        "material": material,  # None: only the index is known, or the optic is a mirror
        "index": lens.index,
        **({"encapsulant": scene.lens.encapsulant} if scene.lens.encapsulant else {}),  # index before the front
        "outline": asdict(lens.plan),
        "clear": lens.clear and tuple(map(asdict, lens.clear)),  # clear apertures, front and back; None: whole outline
        FRONT: _own_outline(front) | _face(scene.lens.front.kind, lens.front_vertex, numbers) | fitted,
        BACK: _face("bspline", vertex(lens), {}),
        "reflects": lens.reflects,  # True for a mirror
        "net": _net(lens.back_net),
        **({"front_net": _net(lens.front_net), "front_asked": scene.lens.front.z} if lens.is_tailored(FRONT) else {}),
        "back_asked": scene.lens.back.z,  # position of the back's vertex in the scene
        **({} if scene.lens.back.chart.flat else {"back_key": scene.lens.back.vertex_key}),  # if not lens.back.z
        "centre_thickness": shape["centre_thickness"],
        "edge_thickness": (shape["edge_thickness_min"], shape["edge_thickness_max"]),
        "volume": shape["volume"],  # mm³
        "mass": None if rho is None else shape["volume"] * rho / 1000,  # g; None: no density is known
        "source": _without_none(asdict(scene.source) | files),
        **{name: [_without_none(e.model_dump(mode="json")) for e in found] for name, found in scene.elements if found},
        "targets": [_without_none(target.model_dump(mode="json")) for target in scene.targets],
    }


def _net(face: BSplineSurface) -> dict[str, Any]:
    return {
        "control_points": face.shape,  # numbers along x and y
        "degree": DEGREE,
        "knots": _knots(face.shape),
        "x": face.x,  # extent of the net, which for a round lens reaches outside the rim
        "y": face.y,
    }


def _knots(shape: tuple[int, int]) -> str:
    """Return the knots in words: once for both directions, or along x and along y if they differ."""
    each = [f"0, 0, 0, 1, 2, …, {m - 3}, {m - 2}, {m - 2}, {m - 2}" for m in shape]
    return each[0] if each[0] == each[1] else f"{each[0]} along x; {each[1]} along y"


def _face(kind: str, z: float, numbers: Mapping[str, float]) -> dict[str, Any]:
    """Return the entries of a surface with its vertex at z; missing curvature, radius and conic constant are None.

    numbers: shape parameters.  Each curvature adds a radius (mm), such as radius_x for curvature_x; None: infinite.
    """
    curvatures = {name: value for name, value in numbers.items() if name.startswith("curvature")}
    radii = {name.replace("curvature", "radius"): 1 / c if c else None for name, c in curvatures.items()}
    none = dict.fromkeys(("curvature", "radius", "conic_constant"))
    return {"kind": kind, "vertex": (0.0, 0.0, z)} | none | numbers | radii


def _own_outline(front: Surface) -> dict[str, Any]:
    """Return the outline of a front that has one, and z of the plane around it; else nothing."""
    return {} if front.outline is None else {"outline": asdict(front.outline), "around": front.around.z}


def _without_none(table: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if value is not None}


def _passes(record: Mapping[str, Any]) -> passes.Passes:
    """Return the passes of the optic of a prescription; the index of a mirror that light does not enter is 1."""
    mirror = passes.MIRROR if record["index"] == 1 else passes.SECOND_SURFACE
    return mirror if record["reflects"] else passes.LENS


def sections(record: Mapping[str, Any]) -> dict[str, Rows]:
    """Return the rows of a prescription by heading, with all digits."""
    return tables("prescription.txt.j2", lens=record, passes=_passes(record))


def text(record: Mapping[str, Any]) -> str:
    """Return the text of prescription.txt."""
    name = f"{record['name']}: {record['title']}" if record["title"] else record["name"]
    direction = LIGHT_DIRECTIONS[_passes(record).optic]
    head = HEAD.format(name=name, direction=direction, exact=EXACT_FACES["front_net" in record])
    parts = (
        f"\n{heading}\n" + "".join(f"    {name:<30}{value}\n" for name, value in rows)
        for heading, rows in sections(record).items()
    )
    return head + "".join(parts)


# --- a part for a shop -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Order:
    """File for a shop and its facts, in mm and in the frame of the file; a fact is None if not stated, or unknown."""

    file: str  # name of the file with the geometry: part.step for a scene with a mount, else lens.step
    sha256: str  # SHA-256 of that file, hexadecimal
    low: Point  # smallest x, y and z of the part
    high: Point  # largest x, y and z of the part
    volume: float | None  # volume (mm³); None: some faces cannot be integrated
    material: str | None  # name of the material in words
    density: float | None  # density (g/cm³)
    datum: str  # position of z = 0, in words
    origin: float  # z of the file's origin in the scene's frame
    freeform: tuple[str, ...]  # names of the freeform faces
    optical: tuple[str, ...]  # names of the optical faces
    tool_radius: float | None  # smallest concave radius of the optical faces; None: no concave face
    back_profile: float | None  # profile tolerance of the back (ISO 1101)
    front_profile: float | None  # profile tolerance of the front (ISO 1101)
    thickness_tolerance: float | None  # tolerance of the centre thickness (±)
    roughness: float | None  # largest allowed roughness Ra of the optical faces (nm)
    coating: str | None  # coating of the optical faces
    unbuilt: bool  # True if the scene has a mount, but part.step could not be built
    size: Point  # outer sizes along x, y and z
    mass: float | None  # mass (g)


def order_of(
    lens: Lens, shape: Mapping[str, Any], folder: Path, *, stated: Part, mount: Mount | None,
    found: Measures | None = None,
) -> Order:  # fmt: skip
    """Return the order of a design in a folder.

    shape: facts of the lens inside its mount's rim, as in report.json, and the volume of lens.step.  stated: [part] of
    the scene, with defaults from the lens (`Part.of`).  mount: of the scene.  found: measures of part.step; None: there
    is no part.step.
    """
    cut, unbuilt = as_cut(lens, mount), mount is not None and not found
    mount = mount if found else None
    low, high, volume = found or (*_corners(lens, None), shape["volume"])
    path, front = folder / (PART if mount else LENS), lens.front_vertex
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    radii = filter(None, (shape["radius_min_concave"], _front_radius(cut)))
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
        freeform=tuple(face.name for face in reversed(lens.faces) if face.surface.is_net),
        optical=lens.passes.faces[::-1],
        tool_radius=min(radii, default=None),
        back_profile=stated.surface_profile,
        front_profile=stated.front_profile,
        thickness_tolerance=stated.thickness_tolerance,
        roughness=stated.roughness,
        coating=stated.coating,
        unbuilt=unbuilt,
        size=tuple(above - below for below, above in zip(low, high, strict=True)),
        mass=None if volume is None or stated.density is None else volume * stated.density / 1000,
    )


def measured(path: Path) -> Measures:
    """Return the measures of the part in a STEP file, read by OCC; volume None: some faces cannot be integrated."""
    from bstcad.verify import step_checks  # loads OCC, which the first process does not need

    lens, whole = step_checks.whole_part(path)
    return *_corners(lens, whole), _volume(lens, whole)


def order_rows(order: Order) -> Rows:
    """Return the rows of the section "What to order" of report.html."""
    return tables("order.txt.j2", order=order)["order"]


def part(
    lens: Lens, whole: WholePart | None = None, stated: float | None = None, placement: Mapping[str, Any] | None = None
) -> dict[str, str]:
    """Return the facts of a part in a STEP file, in the order in which a machine is set up; no design is needed.

    whole: part that contains the lens; the lens's outline then only encloses the edge of the back.  None: a bare lens.
    stated: density (g/cm³) in the file; None: the file states no density, or several.
    placement: position of the lens in the file (Placement.facts); None: lens and file have the same frame.
    """
    import shapely  # the import takes 0.05 s, and a design does not need it

    shape, lies = describe(lens), list(zip(*_corners(lens, whole), strict=True))
    vertex = lens.front_vertex + shape["centre_thickness"]
    edge, outline = None if whole is None else whole.edge, lens.outline
    fills = edge is None or outline.is_round or shapely.Polygon(edge).area > (1 - EDGE_TOLERANCE) * outline.area
    found = tables(
        "step_part.txt.j2", lens=lens, shape=shape, lies=lies, vertex=vertex, whole=whole is not None,
        origin=_origin(lens, vertex, whole is None), fills=fills,
        edge=edge is not None and list(zip(edge.min(0), edge.max(0), strict=True)),
        thinnest=thickness_range(lens, edge)[0], volume=_volume(lens, whole), density=stated,
        placement=placement,
    )  # fmt: skip
    return dict(found["part"])


def _corners(lens: Lens, whole: WholePart | None) -> tuple[Point, Point]:
    """Return the smallest and the largest x, y and z (mm) of a part."""
    edge = lens.back.silhouette(lens.outline) if whole is None else whole.edge
    faces = np.concatenate(heights(lens, None if whole is None else edge))
    low, high = np.array([*edge.min(0), faces.min()]), np.array([*edge.max(0), faces.max()])
    if whole is not None:
        low, high = np.minimum(low, whole.low), np.maximum(high, whole.high)
    return tuple(low.tolist()), tuple(high.tolist())


def _volume(lens: Lens, whole: WholePart | None) -> float | None:
    """Return the volume of a part (mm³); None: some faces cannot be integrated."""
    if whole is None:
        return face_integrals.of_lens(lens).volume
    return None if whole.properties is None else whole.properties.volume


def _origin(lens: Lens, vertex: float, bare: bool = True) -> str:
    """Return where the file's origin is, in words; vertex: z of the back on the axis; bare: a lens without a mount."""
    at = {"passes": lens.passes, "front": lens.front_vertex, "vertex": vertex, "bare": bare}
    return "".join(paragraphs("part_words.txt.j2", "origin", **at))


def _front_radius(lens: Lens) -> float | None:
    """Return the smallest concave radius (mm) of the front, seen from outside; None: not concave, or a mirror's rear.

    For a conic this is the meridional radius, R (1 - k c² r²)^(3/2), which decreases towards the rim for k > 0.
    """
    front = lens.front
    if FRONT not in lens.passes.faces:
        return None
    if front.is_net:
        found = survey(lens, FRONT).concave.largest
        return found if found < MAX_RADIUS else None
    (x, y), (c, k) = (front.outline or lens.plan).farthest, front.conic()
    if not c < 0:
        return None
    return max(1 - max(k, 0.0) * c * c * (x * x + y * y), 0.0) ** 1.5 / -c
