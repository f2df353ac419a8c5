"""Files of `bstcad export` and `[output] export`, by kind: tables, tool paths, tiles, drawings, preview meshes.

Tables are text: the first line names the columns, lengths in mm.  Drawings show the outline of a bare lens, or the part
with its [mount], seen from the back: x to the right, y up, mm.  Each kind of edge is a set of closed curves on its own
layer (DXF) or in its own group (SVG).  Centre marks and text are on other layers, so that a saw or a laser can omit
them.  Draft narrows the flange towards +z; the drawing shows its wider edge, which is the one at the smaller z.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bstcad.analysis.far_field import NOMINAL_LUMENS, FarField
from bstcad.cad.mesh import DEFAULT_LABEL, Label, preview_files
from bstcad.cad.tiling import Cell, Tiling
from bstcad.exports.grid_sag import MAX_POINTS, MIN_POINTS, GridLight, GridSag, axes, table_note
from bstcad.exports.heightmap import HeightMap, default_pixels
from bstcad.exports.tile_files import joints, tile_files
from bstcad.exports.toolpath_files import toolpath_files
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK
from bstcad.optics.surfaces.bspline import is_net
from bstcad.optics.surfaces.outlines import Circle, Outline
from bstcad.optics.surfaces.radial import circle_radius, require_radial
from bstcad.optics.surfaces.surfaces import Surface, points_and_normals, sag
from bstcad.photometry import eulumdat, ies, intensity_files, tm25
from bstcad.photometry.intensity import Intensity, Luminaire
from bstcad.report.units import environment, paragraphs
from bstcad.runs import files
from bstcad.scene.blank import export_complaints
from bstcad.scene.moulding import MISSING, Moulding
from bstcad.scene.mount import Mount, Part
from bstcad.toolpath.cutting import DEFAULTS, Cutting

SIDECAR = ".txt"  # suffix of a text file that states how far interpolation of a table moves the light
INTENSITIES = ("ies", "ldt", "csv")  # kinds of intensity files
RAYS = "tm25"  # kind of files of rays
RAY_COUNT = 1_000_000  # number of rays of a file
SHEET = "datasheet"  # kind of export that `export` omits: the caller draws it from the report in the design's folder

OUTLINE, RIM, FLANGE, SCREWS, HOLES = "OUTLINE", "RIM", "FLANGE", "SCREW_HOLES", "HOLES"  # layers of edges
JOINTS = "JOINTS"  # layer of the joints between tiles
CENTRES, TEXT = "CENTRES", "TEXT"  # layers of centre marks and of text
MARK_OVERSHOOT = 1.5  # length by which a centre mark extends beyond the edge of a hole or rim (mm)
SVG_MARGIN = 3.0  # margin around the drawing in the SVG (mm)
EDGE_WIDTH, CENTRE_WIDTH = 0.25, 0.13  # line widths of edges and of centre marks (mm, ISO 128)
CHAIN_LENGTHS = (4.0, 0.8, 0.4, 0.8)  # lengths of dash, gap, dot and gap of a centre line (mm)
CAPITAL_HEIGHT = 1.8  # height of a capital letter (mm, ISO 3098)
FONT_SIZE = CAPITAL_HEIGHT / 0.72  # font size at which capital letters are CAPITAL_HEIGHT high (mm)
MAX_LINE_LENGTH = 60  # largest number of characters per line of text
LETTER_WIDTH = 0.56 * FONT_SIZE  # upper bound of the mean width of a letter (mm)
QUARTER_TURN_BULGE = math.tan(math.pi / 8)  # DXF bulge of an arc of 90 degrees: tan of a quarter of the angle
EDGES = {"fill": "none", "stroke": "black", "stroke-width": f"{EDGE_WIDTH:g}"}  # attributes of a group of edges (SVG)
STYLES = {  # attributes of the other groups (SVG), by layer
    CENTRES: {
        "fill": "none",
        "stroke": "#c00000",
        "stroke-width": f"{CENTRE_WIDTH:g}",
        "stroke-dasharray": " ".join(f"{part:g}" for part in CHAIN_LENGTHS),
    },
    TEXT: {"font-family": "Helvetica, Arial, sans-serif", "font-size": f"{FONT_SIZE:g}"},
}
DXF_SIGNS = str.maketrans({"Ø": "%%c", "°": "%%d", "×": "x"})  # codes that CAD systems show in any font

DEFAULT_TILING = Tiling()  # tiles of `--as tiles` without `--tiles`, and of a scene

# (layer, kind, content); content (mm), by kind: "circle": x, y, radius; "box", centred on the axis: half width, half
# height, corner radius; "line": x and y of one end, then of the other; "text": x, y and the string.
Piece = tuple[str, str, tuple[Any, ...]]


@dataclass(frozen=True)
class Exported:
    """Exported files, and notes on their accuracy."""

    paths: list[Path]
    notes: list[str]  # sentences on how far interpolation of a grid or table moves the light
    failures: dict[str, str]  # reasons why kinds are not possible, by kind


def export(
    lens: Lens, kinds: Sequence[str], folder: Path, points: int | None = None, label: Label = DEFAULT_LABEL,
    mount: Mount | None = None, light: GridLight | None = None, far: FarField | None = None,
    cutting: Cutting = DEFAULTS, moulding: Moulding | None = None, part: Part | None = None,
    tiling: Tiling = DEFAULT_TILING, strict: bool = True,
) -> Exported:  # fmt: skip
    """Write the files of `kinds` (files.EXPORTS; nothing for SHEET) to the folder, each completely or not at all.

    points: number of points along the wider side of a grid; None: as many as the back has control points along its
    longer side (OpticStudio: at the knots).  label: name of a mesh or part.  mount: mount in drawings; None: drawings
    show the outline of the lens.  light: light that is traced to compute the error of grids and tables; None: the error
    is not computed.  far: light for intensity files; None: they cannot be exported.  cutting: settings of tool paths.
    moulding: shrinkage for the cavity; None: it cannot be exported.  part: data of the part that STEP files state.
    tiling: numbers of tiles along x and along y; with the kind "tiles", each tile has a raster and a height map.
    ValueError: a kind is unknown, points is out of range, or a tool path or a tile is not possible.
    strict: False: a kind that is not possible is in `Exported.failures`, and the files of the other kinds are written.
    """
    for kind in kinds:
        if kind not in files.EXPORTS:
            raise ValueError(f"'{kind}' cannot be exported; give one of {', '.join(files.EXPORTS)}")
    if points is not None and not MIN_POINTS <= points <= MAX_POINTS:
        raise ValueError(f"points = {points} is not possible; give a number from {MIN_POINTS} to {MAX_POINTS}")
    lens, found = lens.plain(), Exported([], [], {})
    for complaint in export_complaints(
        kinds, not lens.back.chart.flat, lens.passes.index_before, front_ends=lens.front.outline is not None
    ):  # fmt: skip
        raise ValueError(complaint)
    cells = tiling.cells(lens.plan) if "tiles" in kinds else ()
    intensity = None if far is None else cache(lambda: Stated(far.table(lens), far.lumens))  # traced once for all files
    for kind in dict.fromkeys(kinds):
        written: dict[Path, str | bytes] = {}
        try:
            for name, data in _files(
                kind, lens, points, label=label, mount=mount, light=light, far=far, intensity=intensity,
                cutting=cutting, moulding=moulding, tiling=tiling, cells=cells, part=part or Part(),
            ):  # fmt: skip
                files.put(folder / name, data.encode("utf-8") if isinstance(data, str) else data)
                written[folder / name] = str(data).strip() if name.endswith(SIDECAR) else ""
        except ValueError as error:
            if strict:
                raise
            found.failures[kind] = str(error)
            for path in written:
                path.unlink()
        else:
            found.paths.extend(written)
            found.notes.extend(filter(None, written.values()))
    return found


def _files(
    kind: str,
    lens: Lens,
    points: int | None,
    *,
    label: Label,
    mount: Mount | None,
    light: GridLight | None,
    far: FarField | None,
    intensity: Callable[[], Stated] | None,
    cutting: Cutting,
    moulding: Moulding | None,
    tiling: Tiling,
    cells: Sequence[Cell],
    part: Part,
) -> Iterator[tuple[str, str | bytes]]:
    if kind in (*INTENSITIES, RAYS) and far is None:
        raise ValueError(f"'{kind}' needs the light of a scene; export it from the folder of a design")
    count = min(max(lens.back_net.shape), MAX_POINTS) if points is None else points
    match kind:
        case "sag" if not lens.back.chart.flat:
            yield "sag-polar.csv", polar_table(lens, count)
        case "sag":
            yield "sag.csv", sag_table(lens, count)
            yield from _sidecar("sag", lens, count, light)
        case "points":
            front = (lens.front, lens.plan) if lens.shares_outline else (lens.front.optical, lens.apertures[0])
            for face, inside in zip(lens.faces, (front, (lens.back, lens.outline)), strict=True):
                yield f"points-{face.name}.csv", points_table(lens, *inside, count)
            if lens.back.chart.flat:
                yield from _sidecar("points", lens, count, light)
        case "zemax":  # a front that is not a net has no grid; its numbers are in prescription.txt
            for face in reversed(lens.faces):
                if is_net(face.surface):
                    name, grid = f"zemax-{face.name}", GridSag.of(lens, face.surface, points, light)
                    yield f"{name}.dat", grid.text()
                    yield f"{name}{SIDECAR}", grid.note(f"{name}.dat") + "\n"
        case "turning":
            for face in reversed(lens.faces):
                if face.surface.is_net:
                    name = "turning" if face.name == BACK else f"turning-{face.name}"
                    yield f"{name}.csv", turning_cloud(lens, (count + 1) // 2, face.surface)
        case "spiral" | "raster":
            yield from toolpath_files(kind, lens, cutting, label.title or label.name, cells=cells)
        case "heightmap":
            for cell in cells or (None,):
                pixels = default_pixels(count) if points is None else points
                picture = HeightMap.of(lens.back, lens.plan, pixels, cell)
                yield f"{picture.name}.png", picture.png()
                yield f"{picture.name}.tif", picture.tiff()
                yield f"{picture.name}{SIDECAR}", picture.words() + "\n"
        case "tiles":
            yield from tile_files(lens, tiling, label.name, part)
            yield "tiles.svg", tiles_svg(lens.outline, tiling)
        case "dxf":
            yield "outline.dxf", dxf(lens.plan, mount, label)
        case "svg":
            yield "outline.svg", svg(lens.plan, mount, label)
        case "preview":
            yield from preview_files(lens, label)
        case "ies" | "ldt" | "csv" if intensity is not None:
            yield f"intensity.{kind}", photometric_file(kind, lens, intensity(), label)
        case "tm25" if far is not None:
            yield "rays.tm25ray", tm25.write(far.rays(lens, RAY_COUNT), _luminaire(lens, label))
        case "cavity":
            yield from _cavity_files(lens, moulding, mount, label=label, part=part)


def _cavity_files(
    lens: Lens, moulding: Moulding | None, mount: Mount | None, *, label: Label, part: Part
) -> Iterator[tuple[str, str | bytes]]:
    """Yield (name, content) of the solid of the cavity and of its sidecar."""
    from bstcad.cad import cavity

    if moulding is None:
        raise ValueError(MISSING)
    solid, about = cavity.cavity(lens, moulding, mount)
    what = "lens" if mount is None else "part"
    yield "cavity.step", cavity.step_file(solid, label.name, part)
    words = f"cavity.step: the {what}, enlarged about x = y = 0, z = {about:.6g} mm; {moulding.words()}\n"
    yield f"cavity{SIDECAR}", words


# --- photometric files ---------------------------------------------------------------------------------------------


def _luminaire(lens: Lens, label: Label) -> Luminaire:
    width, height = (2 * half for half in lens.plan.half_extent)
    return Luminaire(label.name, size=(width, height, 0.0), is_round=isinstance(lens.plan, Circle))


@dataclass(frozen=True)
class Stated:
    """Intensity of the light behind a lens, and the flux of its source."""

    table: Intensity
    lumens: float | None  # luminous flux of the source, lm; None: not known, the table is for NOMINAL_LUMENS


def photometric_file(kind: str, lens: Lens, light: Stated, label: Label) -> bytes:
    """Return the intensity of the light behind the lens as an IES or EULUMDAT file, or as a table over C and γ (CSV).

    If the flux of the source is known, the intensities are absolute; otherwise they are for a lamp of 1000 lm.
    """
    if kind == "csv":
        return intensity_files.csv_text(light.table).encode()
    luminaire = _luminaire(lens, label)
    table, lamp = light.table, NOMINAL_LUMENS if light.lumens is None else None
    if kind == "ies":
        return ies.write(table, luminaire, lamp_lumens=lamp)
    return eulumdat.write(table, luminaire, lamp_lumens=light.lumens or lamp)


# --- tables -----------------------------------------------------------------------------------------------------------


def sag_table(lens: Lens, points: int) -> str:
    """Return a CSV table of x, y, front z and back z (mm) on a grid, `points` along its wider side, in the outline."""
    x, y = _inside(lens.plan, points)
    return _csv(x_mm=x, y_mm=y, front_z_mm=sag(lens.front, x, y), back_z_mm=sag(lens.back, x, y))


def points_table(lens: Lens, face: Surface, outline: Outline, points: int) -> str:
    """Return a CSV table of x, y, z and the unit normal, out of the lens, of a face on a grid of its chart.

    outline: outline in the chart; points: number of points along its wider side.
    """
    place, normal = points_and_normals(face, *_inside(outline, points))
    return _csv(**_columns(place, (normal if face is lens.back else -normal) + 0.0))  # 0 in place of -0


def polar_table(lens: Lens, points: int) -> str:
    """Return a CSV table of a radial back over directions from its centre: distance (mm), point (mm) and unit normal.

    Directions have the angle θ (degrees) from +z and the azimuth ψ (degrees) from +x towards +y; normals point out of
    the lens.  There are (points + 1) // 2 rings of equal spacing from the axis to the half angle.
    """
    back = require_radial(lens.back)
    half = back.chart.angle(circle_radius(lens.outline), back.radius)
    theta = np.append(0.0, np.repeat(np.linspace(0.0, half, (points + 1) // 2)[1:], 2 * points))
    psi = np.append(0.0, np.tile(np.arange(2 * points) * (math.pi / points), (points + 1) // 2 - 1))
    place, normal = back.towards(theta, psi)
    angles = {"angle_deg": np.degrees(theta), "azimuth_deg": np.degrees(psi)}
    distance = np.linalg.norm(place - (0.0, 0.0, back.z), axis=1)
    return _csv(**angles, distance_mm=distance, **_columns(place, normal))


def _columns(place: np.ndarray, normal: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of a table of points (n, 3) and unit normals (n, 3)."""
    names = ("x_mm", "y_mm", "z_mm", "normal_x", "normal_y", "normal_z")
    return dict(zip(names, (*place.T, *normal.T), strict=True))


def turning_cloud(lens: Lens, points: int, face: Surface | None = None) -> str:
    """Return a CSV table for slow-tool diamond turning: radius (mm), angle (degrees), height above the vertex (mm).

    face: the back if None.  Angles are from +x towards +y; heights are along +z, which is into the glass at the front.

    There are `points` rings of equal spacing from the axis to the farthest point of the outline.  All rings have the
    same angles; neighbours on the outermost ring are one ring spacing apart.  Points outside the outline are omitted.
    The tool radius is not compensated.
    """
    ring = np.linspace(0.0, float(np.hypot(*lens.plan.farthest)), points)
    count = round(2 * np.pi * (points - 1))
    radius, angle = (p.ravel() for p in np.meshgrid(ring, np.arange(count) * 360.0 / count, indexing="ij"))
    x, y = radius * np.cos(np.radians(angle)), radius * np.sin(np.radians(angle))
    inside = lens.plan.contains(*(torch.from_numpy(p * (1 - 1e-12)) for p in (x, y))).numpy()  # with the rim
    face = face or lens.back
    height = sag(face, x[inside], y[inside]) - sag(face, 0.0, 0.0)
    return _csv(radius_mm=radius[inside], angle_deg=angle[inside], sag_mm=height)


def _sidecar(name: str, lens: Lens, points: int, light: GridLight | None) -> Iterator[tuple[str, str]]:
    """Yield (name, text) of the sidecar of a table of sags, a sentence for each net; nothing if `light` is None."""
    sentences = []
    for face in lens.faces:
        if light is not None and face.surface.is_net:
            table = f"{name}.csv, {face.name}" if name == "sag" else f"{name}-{face.name}.csv"
            sentences.append(table_note(lens, face.surface, table, points=points, light=light))
    if sentences:
        yield f"{name}{SIDECAR}", "\n".join(sentences) + "\n"


def _inside(outline: Outline, points: int) -> tuple[np.ndarray, np.ndarray]:
    x, y = (p.ravel() for p in np.meshgrid(*axes(outline, points), indexing="ij"))
    inside = outline.contains(torch.from_numpy(x), torch.from_numpy(y)).numpy()
    return x[inside], y[inside]


def _csv(**columns: np.ndarray) -> str:
    text = io.StringIO()
    table, header = np.column_stack(list(columns.values())), ",".join(columns)
    np.savetxt(text, table, fmt="%.12g", delimiter=",", header=header, comments="")
    return text.getvalue()


# --- drawings ---------------------------------------------------------------------------------------------------------


def drawing(outline: Outline, mount: Mount | None, label: Label) -> list[Piece]:
    """Return the pieces of a drawing: lens and mount with centre marks and text; without a mount, only the outline."""
    if mount is None:
        return [_edge(OUTLINE, outline)]
    rim, flange = mount.rim_of(outline).outline, mount.flange
    edges = [(RIM, rim, 0.0, 0.0)]
    if flange is not None:
        edges.append((FLANGE, flange.outline.outline, 0.0, 0.0))
        for layer, holes in ((SCREWS, flange.screws.holes() if flange.screws else ()), (HOLES, flange.holes)):
            edges += [(layer, Circle(d / 2), _plain(x), _plain(y)) for x, y, d in holes]
    pieces = [_edge(*edge) for edge in edges]
    for _, shape, x, y in edges[flange is not None :]:
        a, b = (half + MARK_OVERSHOOT for half in shape.half_extent)
        pieces += [(CENTRES, "line", (x - a, y, x + a, y)), (CENTRES, "line", (x, y - b, x, y + b))]
    if radius := pitch_radius(mount):
        pieces.append((CENTRES, "circle", (0.0, 0.0, radius)))
    a, b = edges[flange is not None][1].half_extent
    lines = [part for line in words(outline, mount, label) for part in textwrap.wrap(line, MAX_LINE_LENGTH)]
    at = [(-a - MARK_OVERSHOOT, -b - MARK_OVERSHOOT - (2 + 1.5 * k) * FONT_SIZE) for k in range(len(lines))]
    return [*pieces, *((TEXT, "text", (*place, line)) for place, line in zip(at, lines, strict=True))]


def _edge(layer: str, outline: Outline, x: float = 0.0, y: float = 0.0) -> Piece:
    """Return a closed curve with centre (x, y); only a circle may be off the axis."""
    if outline.is_round:
        return layer, "circle", (x, y, outline.radius)
    return layer, "box", (*outline.half_extent, math.sqrt(outline.limits[2]))


def dxf(outline: Outline, mount: Mount | None = None, label: Label = DEFAULT_LABEL) -> str:
    """Return a DXF R2010 drawing in mm: circles, and closed polylines whose rounded corners are arcs."""
    import ezdxf

    document, pieces = ezdxf.new("R2010", units=ezdxf.units.MM), drawing(outline, mount, label)
    document.linetypes.add("CENTER", [sum(CHAIN_LENGTHS), *(part * (-1) ** k for k, part in enumerate(CHAIN_LENGTHS))])
    attributes = {CENTRES: {"color": 1, "linetype": "CENTER"}}
    for layer in dict.fromkeys(layer for layer, _, _ in pieces):
        weight = round(100 * (CENTRE_WIDTH if layer in STYLES else EDGE_WIDTH))
        document.layers.add(layer, lineweight=weight, **attributes.get(layer, {}))
    space = document.modelspace()
    for layer, kind, at in pieces:
        on = {"layer": layer}
        match kind:
            case "circle":
                space.add_circle(at[:2], at[2], dxfattribs=on)
            case "box":
                space.add_lwpolyline(_corners(*at), format="xyb", close=True, dxfattribs=on)
            case "line":
                space.add_line(at[:2], at[2:], dxfattribs=on)
            case "text":
                space.add_text(at[2].translate(DXF_SIGNS), height=CAPITAL_HEIGHT, dxfattribs=on | {"insert": at[:2]})
    text = io.StringIO()
    document.write(text)
    return text.getvalue()


def svg(outline: Outline, mount: Mount | None = None, label: Label = DEFAULT_LABEL) -> str:
    """Return the drawing as SVG in true size.

    The SVG backend of ezdxf 1.4.5 is not used: it converts circles to splines and text to curves, rounds to a millionth
    of the page and has no groups.
    """
    whole = outline if mount is None else (mount.flange.outline if mount.flange else mount.rim_of(outline)).outline
    a, b = (half + SVG_MARGIN + MARK_OVERSHOOT * (mount is not None) for half in whole.half_extent)
    return svg_of(drawing(outline, mount, label), (a, b))


def svg_of(pieces: Sequence[Piece], half_extent: tuple[float, float]) -> str:
    """Return pieces of a drawing as SVG in true size; half_extent: half of its width and height (mm), without text."""
    (a, b), texts = half_extent, [at for _, kind, at in pieces if kind == "text"]
    right = max([a, *(x + LETTER_WIDTH * len(line) + SVG_MARGIN for x, _, line in texts)])
    low = min([-b, *(y - SVG_MARGIN for _, y, _ in texts)])
    layers: dict[str, list[tuple[str, tuple[Any, ...]]]] = {}
    for layer, kind, at in pieces:
        layers.setdefault(layer, []).append((kind, at))
    return environment().get_template("outline.svg.j2").render(
        layers=layers, left=-a, top=-b, width=right + a, height=b - low, title=texts[0][2] if texts else "",
        styles=STYLES, edges=EDGES, n=lambda value: f"{_plain(value):.15g}",
        dash=lambda at: (CHAIN_LENGTHS[0] - math.dist(at[:2], at[2:])) / 2 % sum(CHAIN_LENGTHS),  # a dash at the centre
    ) + "\n"  # fmt: skip


def tiles_svg(outline: Outline, tiling: Tiling) -> str:
    """Return the plan of the tiles of a plate as SVG in true size, seen from the back: outline, joints and names."""
    cells = tiling.cells(outline)
    pieces = [_edge(OUTLINE, outline), *((JOINTS, "line", ends) for ends in joints(cells))]
    for cell in cells:
        x, y = (sum(span) / 2 for span in cell.extent)
        pieces.append((TEXT, "text", (x - LETTER_WIDTH * len(cell.name) / 2, y - CAPITAL_HEIGHT / 2, cell.name)))
    a, b = outline.half_extent
    return svg_of(pieces, (a + SVG_MARGIN, b + SVG_MARGIN))


def words(outline: Outline, mount: Mount, label: Label) -> list[str]:
    """Return the text of a drawing, which states the sizes of the part, one string per line."""
    return paragraphs("outline.txt.j2", "words", lens=outline, mount=mount, label=label, across=across)


def across(outline: Outline) -> str:
    """Return the size of an outline (mm), such as Ø15 or 26 × 24, R3."""
    if outline.is_round:
        return f"Ø{2 * outline.radius:.6g}"
    corner = math.sqrt(outline.limits[2])
    return f"{outline.width:.6g} × {outline.height:.6g}" + f", R{corner:.6g}" * bool(corner)


def pitch_radius(mount: Mount) -> float | None:
    """Return the radius (mm) of the screws' pitch circle; None: no screws, or the circle leaves the flange."""
    screws = mount.flange and mount.flange.screws
    if not screws or 2 * min(mount.flange.outline.outline.half_extent) <= screws.circle:
        return None
    return screws.circle / 2


def _corners(a: float, b: float, r: float) -> list[tuple[float, float, float]]:
    """Return (x, y, bulge) of a box's corners or ends of arcs, counterclockwise; a, b: half sizes, r: radius (mm)."""
    p, q, turn = a - r, b - r, QUARTER_TURN_BULGE
    if not r:
        return [(-a, -b, 0.0), (a, -b, 0.0), (a, b, 0.0), (-a, b, 0.0)]
    corners = ((-p, -b), (p, -b), (a, -q), (a, q), (p, b), (-p, b), (-a, q), (-a, -q))
    return [(x, y, turn * (k % 2)) for k, (x, y) in enumerate(corners)]


def _plain(value: float) -> float:
    """Round to 1e-12 mm, which removes the rounding error of cos 90° and the sign of -0."""
    return round(value, 12) + 0.0
