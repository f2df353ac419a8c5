"""A lens in a housing with its LED, as an assembly: python templates/housing.py outputs/disk

Writes housing.step beside the design: lens, housing and LED, each at its place, with names and colours.
"""

import sys

import cadquery as cq

import bstcad

try:
    design = bstcad.open(sys.argv[1] if len(sys.argv) > 1 else "outputs/disk")
    lens = design.solid()  # with the exact control points and knots of the design
    source = design.scene.source  # the LED is placed at the position of a point source
    if source.kind != "point":
        sys.exit(
            f"{design.folder}: the source is a beam, which has no place for an LED; give a design with a point source"
        )
    x, y, z = source.position

    box = lens.BoundingBox()
    play, wall, ledge = 0.05, 2.0, 1.0  # mm
    width, height = box.xlen + 2 * play, box.ylen + 2 * play
    floor = z - 3.0  # mm; 3 mm below the light source
    housing = (
        cq.Workplane("XY", origin=(0, 0, floor))
        .rect(width + 2 * wall, height + 2 * wall)
        .extrude(box.zmax - floor)
        .faces(">Z")
        .workplane()
        .rect(width, height)
        .cutBlind(box.zmin - box.zmax)  # the seat of the lens
        .faces(">Z")
        .workplane(offset=box.zmin - box.zmax)
        .rect(width - 2 * ledge, height - 2 * ledge)
        .cutBlind(z - 1.5 - box.zmin)  # room for the LED and its light below the seat
    )
    led = cq.Workplane("XY", origin=(x, y, z - 1.5)).rect(3.5, 3.5).extrude(1.0)
    led = led.faces(">Z").workplane().circle(1.2).extrude(0.5)  # the light leaves its upper face, at z

    assembly = cq.Assembly(name="lamp")
    assembly.add(lens, name="lens", color=cq.Color(0.6, 0.8, 1.0, 0.5))
    assembly.add(housing, name="housing", color=cq.Color(0.2, 0.2, 0.2))
    assembly.add(led, name="LED", color=cq.Color(1.0, 0.8, 0.2))
    path = design.folder / "housing.step"
    assembly.export(str(path))
    print(f"{path}: lens {lens.Volume():.0f} mm³, housing {housing.val().Volume():.0f} mm³")
except bstcad.SceneError as error:
    sys.exit(f"{error}")
