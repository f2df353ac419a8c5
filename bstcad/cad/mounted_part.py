"""The lens as the part that a scene's [mount] describes: its rim, its flange, and its datum."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from OCP.BRepFilletAPI import BRepFilletAPI_MakeChamfer
from OCP.Standard import Standard_Failure
from OCP.StdFail import StdFail_NotDone
from OCP.TopoDS import TopoDS_Shape
from scipy.spatial import cKDTree

from bstcad.cad import mounting, solid_edges, solid_properties, step_writing
from bstcad.cad.draft import Draft
from bstcad.cad.mounting import Mounted, Placed
from bstcad.cad.solid import face_names, lens_solid
from bstcad.cad.trimming import named_solid
from bstcad.optics.lens import Lens
from bstcad.scene.mount import Box, Flange, Mount, Part, Round

if TYPE_CHECKING:
    import cadquery


def part_of(lens: Lens, mount: Mount) -> Mounted:
    """The solid in the frame of the mount's datum, and its faces' names; ValueError if lens and flange do not fit."""
    try:
        return _built(lens, mount)
    except (Standard_Failure, StdFail_NotDone) as error:
        raise ValueError(
            f"mount: OCC cannot build it ({type(error).__name__}); make bevel or draft smaller, or leave them out"
        ) from error


def _built(lens: Lens, mount: Mount) -> Mounted:
    placed = _placed(lens, mount)
    if mount.flange is not None:
        found = mounting.mounted(body(mount.flange), [placed])
    elif placed.trim is not None or placed.draft:
        found = Mounted(*named_solid(lens, placed.trim, draft=placed.draft))
    else:
        found = Mounted(lens_solid(lens), face_names(lens))
    return replace(found, solid=found.solid.translate((0, 0, -origin(lens, mount))))


def _placed(lens: Lens, mount: Mount) -> Placed:
    return Placed(lens, None if mount.rim is None else wire(mount.rim), draft=Draft(mount.draft, mount.bevel))


def origin(lens: Lens, mount: Mount) -> float:
    """z in the scene's frame (mm) that is 0 in the part's file."""
    return mount.origin(lens.front.z)


def wire(outline: Round | Box) -> cadquery.Wire:
    """An outline as a wire in the plane z = 0."""
    import cadquery

    plane = cadquery.Workplane("XY")
    if outline.shape == "circle":
        return plane.circle(outline.diameter / 2).wires().val()
    sharp = plane.rect(outline.width, outline.height).wires().val()
    return sharp.fillet2D(outline.corner_radius, sharp.Vertices()) if outline.corner_radius else sharp


def body(flange: Flange) -> cadquery.Workplane:
    """The flange without an opening for the lens, in the scene's frame."""
    import cadquery

    lean, height = math.tan(math.radians(flange.draft)), flange.thickness
    if flange.outline.shape == "circle" and lean:  # OCC cannot chamfer a circle that it has tapered
        radius, base = flange.outline.diameter / 2, cadquery.Vector(0, 0, flange.z)
        plate = cadquery.Workplane(cadquery.Solid.makeCone(radius, radius - lean * height, height, base))
    else:
        rim = cadquery.Workplane("XY").add(wire(flange.outline).translate((0, 0, flange.z)))
        plate = rim.toPending().extrude(height, taper=flange.draft or None)
    if flange.bevel:
        plate = cadquery.Workplane(_bevelled(plate.val(), flange.bevel, lean))
    for x, y, diameter in flange.all_holes():
        base = cadquery.Vector(x, y, flange.z - 1)
        plate = plate.cut(cadquery.Solid.makeCylinder(diameter / 2, height + 2, base))
    return plate


def _bevelled(plate: cadquery.Solid, bevel: float, lean: float) -> cadquery.Solid:
    """A plate with bevels of this height along z (mm), at 45 degrees; lean: of its walls inwards, mm a mm.

    Workplane.chamfer does not say which of its two lengths belongs to which face.
    """
    import cadquery

    chamfer, wall = BRepFilletAPI_MakeChamfer(plate.wrapped), bevel * math.hypot(1.0, lean)
    for side, across in (("<Z", bevel * (1 + lean)), (">Z", bevel * (1 - lean))):
        face = plate.faces(side)
        for edge in face.Edges():
            chamfer.Add(across, wall, edge.wrapped, face.wrapped)
    return cadquery.Solid(chamfer.Shape())


def write_if_it_fits(lens: Lens, mount: Mount, path: str | Path, name: str, said: Part) -> None:
    """part.step, with the statements of [part]; no file if it cannot be built, for which `misfit` gives the reason."""
    try:
        part = part_of(lens, mount)
    except ValueError:
        return
    properties = solid_properties.of_solid(part.solid)
    step_writing.write(part.solid, path, name, said, faces=part.faces, properties=properties)


def off(lens: Lens, mount: Mount, solid: TopoDS_Shape) -> tuple[float, str]:
    """(largest distance (mm) between an edge of a solid and those of the mount's part, or the other way, its position).

    ValueError if the mount does not fit the lens.
    """
    wanted, found = map(solid_edges.along_edges, (part_of(lens, mount).solid.wrapped, solid))
    missing, strange = cKDTree(found).query(wanted)[0], cKDTree(wanted).query(found)[0]
    worst, places = max((missing, wanted), (strange, found), key=lambda pair: pair[0].max())
    return float(worst.max()), "edge at ({:.4g}, {:.4g}, {:.4g}) mm".format(*places[worst.argmax()])


def misfit(lens: Lens, mount: Mount) -> str | None:
    """The reason why lens and flange are not one part, in a sentence; None: they are."""
    try:
        part_of(lens, mount)
    except ValueError as error:
        return str(error)
    return None
