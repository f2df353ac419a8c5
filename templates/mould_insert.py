"""The insert of a mould that forms the back of a lens: python templates/mould_insert.py outputs/disk

The negative of the freeform face, turned over so that it looks up, larger by what the plastic shrinks, on a round block
with a shoulder.
"""

import sys
from dataclasses import replace

import cadquery as cq

import bstcad

design = bstcad.open(sys.argv[1] if len(sys.argv) > 1 else "outputs/disk")
shrinkage = 0.005  # of PMMA, of every length
below, shoulder = 12.0, 4.0  # mm, of the block under the face, and of its wider foot

# (x, y, z) -> (x, -y, -z) turns the lens over about x; then the steel lies below the face that the plastic fills.
back, outline = design.lens.back, design.lens.outline
net = (1 + shrinkage) * back.control_points()[:, ::-1] * (1, -1, -1)
face = bstcad.BSplineSurface.from_control_points(net)
larger = {key: (1 + shrinkage) * value for key, value in vars(outline).items() if key != "shape"}
lowest = net[..., 2].min() - below
insert = bstcad.Lens(bstcad.Plane(lowest), face, replace(outline, **larger), design.lens.index)

reach = max(outline.half_extent) * 1.5  # mm
foot = cq.Workplane("XY", origin=(0, 0, lowest)).circle(reach + 6).extrude(shoulder)
block = foot.faces(">Z").workplane().circle(reach + 2).extrude(below - 2 - shoulder)
part = bstcad.mounted(block, [(insert, (0, 0))])

path = design.folder / "mould_insert.step"
cq.exporters.export(cq.Workplane(part), str(path))
print(f"{path}: one solid, {'valid' if part.isValid() else 'NOT valid'}, {part.Volume():.0f} mm³")
