"""The insert of a mould that forms the back of a lens: python templates/mould_insert.py outputs/disk

The insert is a round block with a shoulder.  On its top is the negative of the freeform face, enlarged by the shrinkage
of the plastic.
"""

import sys
from dataclasses import replace

import cadquery as cq

import bstcad

design = bstcad.open(sys.argv[1] if len(sys.argv) > 1 else "outputs/disk")
shrinkage = 0.005  # relative shrinkage of PMMA in every direction
below, shoulder = 12.0, 4.0  # mm; heights of the block below the face, and of its wider foot

# (x, y, z) -> (x, -y, -z) rotates the lens by 180 degrees about x, so that the steel is below the face.
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
