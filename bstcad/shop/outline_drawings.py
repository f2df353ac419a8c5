"""The outline of a lens as a drawing, in mm: DXF for a saw or a laser, SVG for a page."""

from __future__ import annotations

import io

from bstcad.optics.outlines import Circle, Outline

MARGIN = 1.0  # mm around the outline in the SVG
LINE = 0.1  # mm
LAYER = "OUTLINE"


def dxf(outline: Outline) -> str:
    """DXF R2010 in mm, one closed curve around the origin."""
    import ezdxf  # cadquery brings it
    from ezdxf import units

    drawing = ezdxf.new("R2010", units=units.MM)
    drawing.layers.add(LAYER)
    space = drawing.modelspace()
    if isinstance(outline, Circle):
        space.add_circle((0, 0), outline.radius, dxfattribs={"layer": LAYER})
    else:
        space.add_lwpolyline(_corners(outline), close=True, dxfattribs={"layer": LAYER})
    text = io.StringIO()
    drawing.write(text)
    return text.getvalue()


def svg(outline: Outline) -> str:
    """SVG in true size, y upwards as in the lens's frame."""
    a, b = outline.half_extent
    left, top = -a - MARGIN, -b - MARGIN
    width, height = -2 * left, -2 * top
    if isinstance(outline, Circle):
        curve = f'<circle r="{outline.radius:.12g}"'
    else:
        places = " ".join(f"{x:.12g},{-y:.12g}" for x, y in _corners(outline))
        curve = f'<polygon points="{places}"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.12g}mm" height="{height:.12g}mm" '
        f'viewBox="{left:.12g} {top:.12g} {width:.12g} {height:.12g}">\n'
        f'  {curve} fill="none" stroke="black" stroke-width="{LINE:g}"/>\n</svg>\n'
    )


def _corners(outline: Outline) -> list[tuple[float, float]]:
    """Counterclockwise from (-x, -y) (mm)."""
    a, b = outline.half_extent
    return [(-a, -b), (a, -b), (a, b), (-a, b)]
