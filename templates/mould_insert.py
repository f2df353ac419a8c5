"""The insert of a mould that forms the back of a lens: python templates/mould_insert.py outputs/disk

The insert is a round block with a shoulder.  On its top is the negative of the freeform face, enlarged by the shrinkage
of the plastic: that of [moulding] in the scene, or else 0.5 % of the cavity in every direction.  `bstcad export --as
cavity` writes the whole cavity.
"""

import sys

import cadquery as cq

import bstcad
from bstcad.scene.moulding import Moulding

try:
    design = bstcad.open(sys.argv[1] if len(sys.argv) > 1 else "outputs/disk")
    if design.scene.lens.dome is not None:
        sys.exit(f"{design.folder}: the back is a dome, which no insert releases; use bstcad export --as cavity")
    moulding = design.scene.moulding or Moulding(shrinkage=0.005)
    x, y, z = moulding.factors  # cavity / part along each axis
    below, shoulder = 12.0, 4.0  # mm; heights of the block below the face, and of its wider foot

    # (x, y, z) -> (x, -y, -z) rotates the lens by 180 degrees about x, so that the steel is below the face.
    back, outline = design.lens.back, design.lens.outline
    net = back.control_points()[:, ::-1] * (x, -y, -z)
    face = bstcad.BSplineSurface.from_control_points(net)
    if x == y:
        rim = outline.scaled(x)
    elif type(outline) is bstcad.Rectangle:
        rim = bstcad.Rectangle(x * outline.width, y * outline.height)
    else:
        sys.exit(
            "moulding.shrinkage: a round rim needs one shrinkage along x and y; cut the block with cavity.step instead"
        )
    lowest = net[..., 2].min() - below
    insert = bstcad.Lens.between(bstcad.Plane(lowest), face, rim, design.lens.index)

    reach = max(rim.half_extent) * 1.5  # mm
    foot = cq.Workplane("XY", origin=(0, 0, lowest)).circle(reach + 6).extrude(shoulder)
    block = foot.faces(">Z").workplane().circle(reach + 2).extrude(below - 2 - shoulder)
    part = bstcad.mounted(block, [(insert, (0, 0))])

    path = design.folder / "mould_insert.step"
    cq.exporters.export(cq.Workplane(part), str(path))
    print(f"{path}: one solid, {'valid' if part.isValid() else 'NOT valid'}, {part.Volume():.0f} mm³")
except bstcad.SceneError as error:
    sys.exit(f"{error}")
