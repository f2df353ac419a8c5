"""Outline of a bare lens, or of the part that [mount] makes of it, as DXF and SVG: x to the right, y up, mm.

Seen from the back.  Each kind of edge is closed curves on a layer (DXF) or in a group (SVG) of its own; centre marks
and words are on others, so that a saw or a laser can leave them out.  Draft narrows the flange upwards; its lower,
wider edge is drawn.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from bstcad.cad.mesh_files import UNNAMED, Label
from bstcad.optics.outlines import Circle, Outline
from bstcad.scene.mount import Box, Mount, Round

if TYPE_CHECKING:
    from ezdxf.document import Drawing
    from ezdxf.entities import DXFGraphic

OUTLINE, RIM, FLANGE, SCREWS, HOLES = "OUTLINE", "RIM", "FLANGE", "SCREW_HOLES", "HOLES"
CENTRES, TEXT = "CENTRES", "TEXT"
BEYOND = 1.5  # mm by which a centre mark exceeds its edge
MARGIN = 3.0  # mm around the drawing in the SVG
EDGE, THIN = 0.25, 0.13  # mm, widths of lines (ISO 128)
CHAIN = (4.0, 0.8, 0.4, 0.8)  # mm of line, gap, dot, gap of a centre line
LETTER = 1.8  # mm, height of a capital (ISO 3098)
FONT = LETTER / 0.72  # mm, of a font with such capitals
COLUMNS = 60  # characters in a line of words
ADVANCE = 0.56 * FONT  # mm, mean width of a letter at most
QUARTER_TURN = math.tan(math.pi / 8)  # bulge of an arc of 90 degrees: tan of a quarter of its angle
EDGES = {"fill": "none", "stroke": "black", "stroke-width": f"{EDGE:g}"}
STYLES = {  # of the groups in the SVG but those of edges
    CENTRES: {"fill": "none", "stroke": "#c00000", "stroke-width": f"{THIN:g}"},
    TEXT: {"font-family": "Helvetica, Arial, sans-serif", "font-size": f"{FONT:g}"},
}
DASHES = {"stroke-dasharray": " ".join(f"{part:g}" for part in CHAIN)}
DXF_SIGNS = str.maketrans({"Ø": "%%c", "°": "%%d", "×": "x"})  # which every font of a CAD system has


Edge = tuple[str, Outline, float, float]  # layer, closed curve, x and y (mm) of its middle


def edges(outline: Outline, mount: Mount | None) -> list[Edge]:
    """The lens's outline alone, or every edge of the part from the lens outwards."""
    if mount is None:
        return [(OUTLINE, outline, 0.0, 0.0)]
    rim, flange = (RIM, mount.rim_of(outline).outline, 0.0, 0.0), mount.flange
    if flange is None:
        return [rim]
    groups = (SCREWS, flange.screws.holes() if flange.screws else ()), (HOLES, flange.holes)
    holes = [(layer, Circle(d / 2), _plain(x), _plain(y)) for layer, group in groups for x, y, d in group]
    return [rim, (FLANGE, flange.outline.outline, 0.0, 0.0), *holes]


def drawing(outline: Outline, mount: Mount | None, label: Label) -> Drawing:
    """DXF document of a lens of that outline in its mount; mount None: the outline alone, without marks and words."""
    import ezdxf

    document = ezdxf.new("R2010", units=ezdxf.units.MM)
    space, drawn = document.modelspace(), edges(outline, mount)
    for layer in dict.fromkeys(edge[0] for edge in drawn):
        document.layers.add(layer, lineweight=round(100 * EDGE))
    for layer, shape, x, y in drawn:
        on = {"layer": layer}
        if shape.shape == "circle":
            space.add_circle((x, y), shape.radius, dxfattribs=on)
        else:
            space.add_lwpolyline(_corners(shape), format="xyb", close=True, dxfattribs=on)
    if mount is None:
        return document
    document.linetypes.add("CENTER", [sum(CHAIN), *(part * (-1) ** k for k, part in enumerate(CHAIN))])
    document.layers.add(CENTRES, color=1, linetype="CENTER", lineweight=round(100 * THIN))
    document.layers.add(TEXT, lineweight=round(100 * THIN))
    on = {"layer": CENTRES}
    for _, shape, x, y in [edge for edge in drawn if edge[0] != RIM] or drawn:
        a, b = (half + BEYOND for half in shape.half_extent)
        space.add_line((x - a, y), (x + a, y), dxfattribs=on)
        space.add_line((x, y - b), (x, y + b), dxfattribs=on)
    if radius := pitch_radius(mount):
        space.add_circle((0, 0), radius, dxfattribs=on)
    a, b = drawn[-1 if mount.flange is None else 1][1].half_extent
    lines = [part for line in words(outline, mount, label) for part in textwrap.wrap(line, COLUMNS)]
    for k, line in enumerate(lines):
        at = -a - BEYOND, -b - BEYOND - (2 + 1.5 * k) * FONT
        space.add_text(line, height=LETTER, dxfattribs={"layer": TEXT, "insert": at})
    return document


def dxf(outline: Outline, mount: Mount | None = None, label: Label = UNNAMED) -> str:
    """DXF R2010 in mm: circles, and closed polylines whose rounded corners are arcs."""
    document, text = drawing(outline, mount, label), io.StringIO()
    for line in document.modelspace().query("TEXT"):
        line.dxf.text = line.dxf.text.translate(DXF_SIGNS)
    document.write(text)
    return text.getvalue()


def svg(outline: Outline, mount: Mount | None = None, label: Label = UNNAMED) -> str:
    """The same drawing in true size.

    Not by ezdxf's SVG backend, which turns circles into splines and letters into curves, rounds to a millionth of the
    page and has no groups (ezdxf 1.4.5).
    """
    from ezdxf import bbox

    space = drawing(outline, mount, label).modelspace()
    lines, box = space.query("TEXT"), bbox.extents(space.query("* !TEXT"))
    left, top = box.extmin.x - MARGIN, box.extmax.y + MARGIN
    right = max([-left, *(line.dxf.insert.x + ADVANCE * len(line.dxf.text) + MARGIN for line in lines)])
    low = min([-top, *(line.dxf.insert.y - MARGIN for line in lines)])
    size = {"width": f"{right - left:.12g}mm", "height": f"{top - low:.12g}mm"}
    view = f"{left:.12g} {-top:.12g} {right - left:.12g} {top - low:.12g}"
    root = ElementTree.Element("svg", xmlns="http://www.w3.org/2000/svg", **size, viewBox=view)
    if lines:
        ElementTree.SubElement(root, "title").text = lines[0].dxf.text
    for layer, entities in space.groupby("layer").items():
        group = ElementTree.SubElement(root, "g", {"id": layer.lower().replace("_", "-"), **STYLES.get(layer, EDGES)})
        for entity in entities:
            name, attributes, text = _element(entity)
            ElementTree.SubElement(group, name, attributes).text = text
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _element(entity: DXFGraphic) -> tuple[str, dict[str, str], str | None]:
    """Name, attributes and text of an entity's SVG element; in SVG y points down."""
    about = entity.dxf
    if entity.dxftype() == "CIRCLE":
        dashes = DASHES if about.layer == CENTRES else {}
        return "circle", {"cx": _mm(about.center.x), "cy": _mm(-about.center.y), "r": _mm(about.radius)} | dashes, None
    if entity.dxftype() == "TEXT":
        return "text", {"x": _mm(about.insert.x), "y": _mm(-about.insert.y)}, about.text
    if entity.dxftype() == "LINE":
        (x0, y0, _), (x1, y1, _) = about.start, about.end
        start = (CHAIN[0] - math.hypot(x1 - x0, y1 - y0)) / 2 % sum(CHAIN)  # puts a dash in the middle
        dashes = DASHES | {"stroke-dashoffset": f"{start:.6g}"}
        return "line", {"x1": _mm(x0), "y1": _mm(-y0), "x2": _mm(x1), "y2": _mm(-y1)} | dashes, None
    corners = entity.get_points("xy")
    (p, b), a = corners[1], max(x for x, _ in corners)
    size = {"x": _mm(-a), "y": _mm(b), "width": _mm(2 * a), "height": _mm(-2 * b)}
    return "rect", size | ({"rx": _mm(a - p)} if a - p else {}), None


def words(outline: Outline, mount: Mount, label: Label) -> Iterator[str]:
    """Sizes of the part in words."""
    rim, flange = across(mount.rim_of(outline)), mount.flange
    yield f"{label.name}: {label.title}" if label.title else label.name
    yield "As in part.step, seen from the back: x right, y up; in mm"
    yield f"{RIM}: {rim}" + f", cut from {across(Mount().rim_of(outline))}" * (mount.rim is not None)
    if mount.draft:
        below = "the back" if flange is None else "the flange"
        yield f"below {below} its walls lean inwards by {mount.draft:g}° from this"
    if mount.bevel:
        yield f"its edge with the front is bevelled by {mount.bevel:g}, not drawn"
    if flange is None:
        return
    yield f"{FLANGE}: {across(flange.outline)}, {flange.thickness:.6g} thick"
    if flange.draft:
        yield f"its walls lean inwards by {flange.draft:g}° from this, their lower edge"
    if flange.bevel:
        yield f"its edges are bevelled by {flange.bevel:g}, which is not drawn"
    if (screws := flange.screws) is not None:
        yield f"{SCREWS}: {screws.count} × Ø{screws.diameter:.6g} on Ø{screws.circle:.6g}, one at {screws.first:g}°"
    if flange.holes:
        counted = Counter(diameter for _, _, diameter in flange.holes)
        yield f"{HOLES}: " + ", ".join(f"{count} × Ø{diameter:.6g}" for diameter, count in counted.items())


def across(shape: Round | Box) -> str:
    """Ø15, or 26 × 24, R3 (mm)."""
    if shape.shape == "circle":
        return f"Ø{shape.diameter:.6g}"
    return f"{shape.width:.6g} × {shape.height:.6g}" + f", R{shape.corner_radius:.6g}" * bool(shape.corner_radius)


def pitch_radius(mount: Mount) -> float | None:
    """Radius (mm) of the circle of screws where it lies within the flange; beyond it would look like an edge."""
    screws = mount.flange and mount.flange.screws
    if not screws or 2 * min(mount.flange.outline.outline.half_extent) <= screws.circle:
        return None
    return screws.circle / 2


def _corners(outline: Outline) -> list[tuple[float, float, float]]:
    """x, y (mm) and bulge of a rectangle's corners or of the ends of its arcs, counterclockwise from (-x, -y)."""
    (a, b), (p, q, r2) = outline.half_extent, outline.limits
    if not r2:
        return [(-a, -b, 0.0), (a, -b, 0.0), (a, b, 0.0), (-a, b, 0.0)]
    return [
        (-p, -b, 0.0), (p, -b, QUARTER_TURN), (a, -q, 0.0), (a, q, QUARTER_TURN),
        (p, b, 0.0), (-p, b, QUARTER_TURN), (-a, q, 0.0), (-a, -q, QUARTER_TURN),
    ]  # fmt: skip


def _plain(value: float) -> float:
    """To 1e-12 mm: without the remainder of a cosine of 90 degrees, and no -0."""
    return round(value, 12) + 0.0


def _mm(value: float) -> str:
    return f"{_plain(value):.15g}"
