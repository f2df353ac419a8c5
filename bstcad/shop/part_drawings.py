"""The part that a scene's [mount] makes of a lens, drawn in mm as its back shows it: x to the right, y up.

Its edges are closed curves, those of a kind on a layer of their own (DXF) or in a group of their own (SVG): the lens's
rim as it is cut, the flange's outline, the screws' holes, further holes.  Centre marks and words are on others, so that
a saw or a laser can leave them out.  Draft makes the flange narrower above; its lower, wider edge is drawn.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from xml.sax.saxutils import escape

from bstcad.cad.mesh_files import Label
from bstcad.optics.outlines import Outline
from bstcad.scene.mount import Box, Mount, Round

RIM, FLANGE, SCREWS, HOLES, CENTRES, TEXT = "RIM", "FLANGE", "SCREW_HOLES", "HOLES", "CENTRES", "TEXT"
BEYOND = 1.5  # mm, by which a centre mark reaches beyond the edge that it is for
MARGIN = 3.0  # mm around the drawing in the SVG
EDGE, THIN = 0.25, 0.13  # mm, widths of lines (ISO 128)
CHAIN = (4.0, 0.8, 0.4, 0.8)  # mm of line, gap, dot, gap of a centre line
LETTER = 1.8  # mm, height of a capital (ISO 3098)
FONT = LETTER / 0.72  # mm, of a font with such capitals
COLUMNS = 60  # characters a line of words
ADVANCE = 0.56 * FONT  # mm, of a letter in the mean, at most
QUARTER_TURN = math.tan(math.pi / 8)  # bulge of an arc of 90 degrees: tan of a quarter of its angle
DXF_SIGNS = str.maketrans({"Ø": "%%c", "°": "%%d", "×": "x"})  # which every font of a CAD system has


@dataclass(frozen=True)
class Edge:
    """A closed edge of the part."""

    layer: str
    shape: Round | Box
    x: float = 0.0  # mm, of its middle
    y: float = 0.0

    @property
    def half(self) -> tuple[float, float]:
        """Half its extent along x and y (mm)."""
        if self.shape.shape == "circle":
            return self.shape.diameter / 2, self.shape.diameter / 2
        return self.shape.width / 2, self.shape.height / 2


Line = tuple[float, float, float, float]  # x and y of its ends (mm)


def edges(outline: Outline, mount: Mount) -> list[Edge]:
    """Of the part, from the lens outwards."""
    found, flange = [Edge(RIM, mount.rim_of(outline))], mount.flange
    if flange is not None:
        found.append(Edge(FLANGE, flange.outline))
        screws = flange.screws.holes() if flange.screws else ()
        for layer, holes in ((SCREWS, screws), (HOLES, flange.holes)):
            found += [Edge(layer, Round(shape="circle", diameter=d), _plain(x), _plain(y)) for x, y, d in holes]
    return found


def _axes(edge: Edge) -> tuple[Line, Line]:
    """The two lines that cross in the middle of an edge."""
    a, b = (half + BEYOND for half in edge.half)
    return (edge.x - a, edge.y, edge.x + a, edge.y), (edge.x, edge.y - b, edge.x, edge.y + b)


def _outermost(drawn: list[Edge]) -> Edge:
    """Which has all others in it: the flange's outline, or the rim of a lens without a flange."""
    return next((edge for edge in drawn if edge.layer == FLANGE), drawn[0])


def words(outline: Outline, mount: Mount, label: Label) -> Iterator[str]:
    """What is drawn, a line each."""
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


def _lines(outline: Outline, mount: Mount, label: Label) -> list[str]:
    """The words in lines of COLUMNS at most."""
    return [part for line in words(outline, mount, label) for part in textwrap.wrap(line, COLUMNS) or [""]]


def dxf(outline: Outline, mount: Mount, label: Label) -> str:
    """DXF R2010 in mm: circles, and closed polylines whose rounded corners are arcs; a layer for each kind of edge."""
    import ezdxf  # cadquery brings it
    from ezdxf import units

    drawn = edges(outline, mount)
    drawing = ezdxf.new("R2010", units=units.MM)
    drawing.linetypes.add("CENTER", [sum(CHAIN), *(part * (-1) ** k for k, part in enumerate(CHAIN))])
    for layer in dict.fromkeys(edge.layer for edge in drawn):
        drawing.layers.add(layer, lineweight=round(100 * EDGE))
    drawing.layers.add(CENTRES, color=1, linetype="CENTER", lineweight=round(100 * THIN))
    drawing.layers.add(TEXT, lineweight=round(100 * THIN))
    space = drawing.modelspace()
    for edge in drawn:
        on = {"layer": edge.layer}
        if edge.shape.shape == "circle":
            space.add_circle((edge.x, edge.y), edge.shape.diameter / 2, dxfattribs=on)
        else:
            space.add_lwpolyline(_corners(edge), format="xyb", close=True, dxfattribs=on)
    for edge in _marked(drawn):
        for x0, y0, x1, y1 in _axes(edge):
            space.add_line((x0, y0), (x1, y1), dxfattribs={"layer": CENTRES})
    if radius := pitch_radius(mount):
        space.add_circle((0, 0), radius, dxfattribs={"layer": CENTRES})
    x, y, step = _below(drawn)
    for k, line in enumerate(_lines(outline, mount, label)):
        said = {"layer": TEXT, "height": LETTER, "insert": (x, -y - k * step)}
        space.add_text(line.translate(DXF_SIGNS), dxfattribs=said)
    text = io.StringIO()
    drawing.write(text)
    return text.getvalue()


def svg(outline: Outline, mount: Mount, label: Label) -> str:
    """SVG in true size; a group with an id for each kind of edge."""
    drawn, said = edges(outline, mount), _lines(outline, mount, label)
    x, y, step = _below(drawn)
    left = x - MARGIN
    right = max(-left, x + ADVANCE * max(map(len, said)) + MARGIN)
    top, bottom = -(_outermost(drawn).half[1] + BEYOND + MARGIN), y + (len(said) - 1) * step + MARGIN
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{right - left:.12g}mm" height="{bottom - top:.12g}mm" '
        f'viewBox="{left:.12g} {top:.12g} {right - left:.12g} {bottom - top:.12g}">',
        f"  <title>{escape(said[0])}</title>",
    ]
    for layer in dict.fromkeys(edge.layer for edge in drawn):
        lines.append(f'  <g id="{_name(layer)}" fill="none" stroke="black" stroke-width="{EDGE:g}">')
        lines += [f"    {_element(edge)}" for edge in drawn if edge.layer == layer] + ["  </g>"]
    chain = " ".join(f"{part:g}" for part in CHAIN)
    lines.append(f'  <g id="{_name(CENTRES)}" fill="none" stroke="#c00000" stroke-width="{THIN:g}">')
    for k, edge in enumerate(_marked(drawn)):
        for x0, y0, x1, y1 in _axes(edge):
            start = (CHAIN[0] - math.hypot(x1 - x0, y1 - y0)) / 2 % sum(CHAIN)  # so that a dash lies in the middle
            dashes = f' stroke-dasharray="{chain}" stroke-dashoffset="{start:.6g}"' if k == 0 else ""  # long ones alone
            lines.append(f'    <line x1="{_mm(x0)}" y1="{_mm(-y0)}" x2="{_mm(x1)}" y2="{_mm(-y1)}"{dashes}/>')
    if radius := pitch_radius(mount):
        lines.append(f'    <circle r="{_mm(radius)}" stroke-dasharray="{chain}"/>')
    lines += ["  </g>", f'  <g id="{_name(TEXT)}" font-family="Helvetica, Arial, sans-serif" font-size="{FONT:g}">']
    lines += [f'    <text x="{x:.12g}" y="{y + k * step:.12g}">{escape(line)}</text>' for k, line in enumerate(said)]
    return "\n".join([*lines, "  </g>", "</svg>", ""])


def _name(layer: str) -> str:
    """The id of its group."""
    return layer.lower().replace("_", "-")


def _marked(drawn: list[Edge]) -> list[Edge]:
    """Whose middles are marked: the part's own first, then each hole's."""
    return [_outermost(drawn), *(edge for edge in drawn if edge.layer in (SCREWS, HOLES))]


def pitch_radius(mount: Mount) -> float | None:
    """Of the circle that the screws lie on (mm), where it lies in the flange; beyond it would look like an edge."""
    screws = mount.flange and mount.flange.screws
    if not screws or 2 * min(Edge(FLANGE, mount.flange.outline).half) <= screws.circle:
        return None
    return screws.circle / 2


def _below(drawn: list[Edge]) -> tuple[float, float, float]:
    """Where the words begin: x of their left end, -y of the first line, and from line to line (mm)."""
    a, b = _outermost(drawn).half
    return -a - BEYOND, b + BEYOND + 2 * FONT, 1.5 * FONT


def _corners(edge: Edge) -> list[tuple[float, float, float]]:
    """x, y (mm) and bulge of a rectangle's corners or of the ends of its arcs, counterclockwise from (-x, -y)."""
    (a, b), r = edge.half, edge.shape.corner_radius
    if not r:
        return [(-a, -b, 0.0), (a, -b, 0.0), (a, b, 0.0), (-a, b, 0.0)]
    return [
        (r - a, -b, 0.0), (a - r, -b, QUARTER_TURN), (a, r - b, 0.0), (a, b - r, QUARTER_TURN),
        (a - r, b, 0.0), (r - a, b, QUARTER_TURN), (-a, b - r, 0.0), (-a, r - b, QUARTER_TURN),
    ]  # fmt: skip


def _element(edge: Edge) -> str:
    (a, b), shape = edge.half, edge.shape
    if shape.shape == "circle":
        return f'<circle cx="{_mm(edge.x)}" cy="{_mm(-edge.y)}" r="{_mm(a)}"/>'
    corner = f' rx="{_mm(shape.corner_radius)}"' if shape.corner_radius else ""
    return f'<rect x="{_mm(-a)}" y="{_mm(-b)}" width="{_mm(2 * a)}" height="{_mm(2 * b)}"{corner}/>'


def _plain(value: float) -> float:
    """To 1e-12 mm: without what a cosine of 90 degrees leaves, and no -0."""
    return round(value, 12) + 0.0


def _mm(value: float) -> str:
    return f"{_plain(value):.15g}"
