"""Three by three lenses on a plate, as one part: python templates/lens_array.py outputs/disk"""

import sys

import cadquery as cq

import bstcad

try:
    design = bstcad.open(sys.argv[1] if len(sys.argv) > 1 else "outputs/disk")
    box = design.solid().BoundingBox()
    low, high = design.wall  # mm; z of the rims of front and back
    top = min(low + 1.5, low + 0.7 * (high - low))  # mm; the plate ends on the wall
    bottom = top - 1.0 if top - 1.0 > low else box.zmin - 0.5  # mm; on a wall, or below a thin lens
    gap, edge = 2.0, 4.0  # mm; gap between lenses; sides of the plate beyond three pitches
    pitch_x, pitch_y = box.xlen + gap, box.ylen + gap

    plate = (
        cq.Workplane("XY", origin=(0, 0, bottom))
        .rect(3 * pitch_x + edge, 3 * pitch_y + edge)
        .extrude(top - bottom)
        .edges("|Z")
        .fillet(2.0)
    )
    places = [(i * pitch_x, j * pitch_y) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    part = bstcad.mounted(plate, [(design, at) for at in places])

    path = design.folder / "lens_array.step"
    cq.exporters.export(cq.Workplane(part), str(path))
    print(f"{path}: one solid, {'valid' if part.isValid() else 'NOT valid'}, {part.Volume():.0f} mm³")
except bstcad.SceneError as error:
    sys.exit(f"{error}")
