"""A lens in its mount, with cadquery: run `python templates/mount.py` after `bstcad generate templates/disk.toml`.

Opens a design, builds a frame with a seat around its lens, and writes both as one assembly.
"""

import sys

import cadquery as cq

import bstcad

design = bstcad.open(sys.argv[1] if len(sys.argv) > 1 else "outputs/disk")
lens = design.solid()  # with the exact control points and knots of the design

box = lens.BoundingBox()
play, wall, ledge = 0.05, 3.0, 1.0  # mm
width, height = box.xlen + 2 * play, box.ylen + 2 * play
frame = (
    cq.Workplane("XY", origin=(0, 0, box.zmin - ledge))
    .rect(width + 2 * wall, height + 2 * wall)
    .rect(width - 2 * ledge, height - 2 * ledge)
    .extrude(ledge)  # the ledge that the front's rim rests on
    .faces(">Z")
    .workplane()
    .rect(width + 2 * wall, height + 2 * wall)
    .rect(width, height)
    .extrude(box.zlen)
)

assembly = cq.Assembly(name="lens in its mount")
assembly.add(lens, name="lens", color=cq.Color(0.6, 0.8, 1.0, 0.5))
assembly.add(frame, name="frame", color=cq.Color(0.2, 0.2, 0.2))
assembly.export(str(design.folder / "mounted.step"))
print(f"{design.folder / 'mounted.step'}: lens {lens.Volume():.0f} mm³, frame {frame.val().Volume():.0f} mm³")
