"""A lens with a flange and three screw holes, as one part: python templates/flanged_lens.py outputs/disk

The flange is an ordinary cadquery solid; bstcad joins it to the lens, whose optical faces do not change.
"""

import sys

import cadquery as cq

import bstcad

try:
    design = bstcad.open(sys.argv[1] if len(sys.argv) > 1 else "outputs/disk")
    box = design.solid().BoundingBox()
    low, high = design.wall  # mm; z of the rims of front and back
    top = min(low + 2.0, low + 0.7 * (high - low))  # mm; the flange ends on the wall
    bottom = top - 1.5 if top - 1.5 > low else box.zmin - 0.5  # mm; on a wall, or below a thin lens
    reach = max(box.xlen, box.ylen) * 0.5**0.5  # mm; distance of the lens's corners from its axis

    flange = (
        cq.Workplane("XY", origin=(0, 0, bottom))
        .circle(reach + 7)
        .extrude(top - bottom)
        .faces("|Z")
        .edges()
        .chamfer(0.2)
        .faces(">Z")
        .workplane()
        .polarArray(reach + 3.5, 90, 360, 3)
        .cboreHole(3.2, 5.0, 0.5)  # for M3 screws: diameters of hole and counterbore, depth of the counterbore (mm)
    )
    part = design.solid(body=flange)

    path = design.write_part(design.folder / "flanged_lens.step", body=flange)  # with named faces, all digits
    print(f"{path}: one solid, {'valid' if part.isValid() else 'NOT valid'}, {part.Volume():.0f} mm³")
except bstcad.SceneError as error:
    sys.exit(f"{error}")
