"""The lens as the part that a scene's [mount] asks for: its rim, its flange, and where its origin lies."""

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
from bstcad.cad.draft import Lean
from bstcad.cad.mounting import Mounted, Placed
from bstcad.cad.solid import face_names, lens_solid
from bstcad.cad.trimming import named_solid
from bstcad.optics.lens import Lens
from bstcad.scene.mount import Box, Flange, Mount, Round
from bstcad.scene.part import Part

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
    elif placed.trim is not None or placed.lean:
        found = Mounted(*named_solid(lens, placed.trim, lean=placed.lean))
    else:
        found = Mounted(lens_solid(lens), face_names(lens))
    return replace(found, solid=found.solid.translate((0, 0, -origin(lens, mount))))


def _placed(lens: Lens, mount: Mount) -> Placed:
    return Placed(lens, None if mount.rim is None else wire(mount.rim), lean=Lean(mount.draft, mount.bevel))


def origin(lens: Lens, mount: Mount) -> float:
    """z in the scene's frame (mm) that is 0 in the part's file."""
    return mount.origin(lens.front.z)


def wire(outline: Round | Box) -> cadquery.Wire:
    """An outline as a wire in the plane z = 0."""
    import cadquery

    plane = cadquery.Workplane("XY")
    if outline.shape == "circle":
        return plane.circle(outline.diameter / 2).wires().val()
    if outline.corner_radius == 0:
        return plane.rect(outline.width, outline.height).wires().val()
    a, b, r = outline.width / 2, outline.height / 2, outline.corner_radius
    cut = r * (1 - math.sqrt(0.5))  # from the corner that is rounded off to the middle of its arc, along x and y
    pen = plane.moveTo(r - a, -b)
    for x, y, along_x in ((a, -b, True), (a, b, False), (-a, b, True), (-a, -b, False)):
        inwards = (-math.copysign(1, x), -math.copysign(1, y))
        before, after = ((x + r * inwards[0], y), (x, y + r * inwards[1]))[:: 1 if along_x else -1]
        pen = pen.lineTo(*before).threePointArc((x + cut * inwards[0], y + cut * inwards[1]), after)
    return pen.close().wires().val()


def body(flange: Flange) -> cadquery.Workplane:
    """The flange without an opening for the lens, in the scene's frame."""
    import cadquery

    top, lean = flange.z + flange.thickness, math.tan(math.radians(flange.draft))
    if flange.outline.shape == "circle":
        r, b, h = flange.outline.diameter / 2, flange.bevel, flange.thickness
        low, high = r - lean * b, r - lean * (h - b)  # where the wall begins and ends
        corners = [(0, 0), (low - b, 0), (low, b), (high, h - b), (high - b, h), (0, h)]
        profile = cadquery.Workplane("XZ", origin=(0, 0, flange.z)).polyline(corners if b else _without(corners))
        plate = profile.close().revolve(360, (0, 0, 0), (0, 1, 0))
    else:
        plane = cadquery.Workplane("XY").add(wire(flange.outline).translate((0, 0, flange.z)))
        plate = plane.toPending().extrude(flange.thickness, taper=flange.draft or None)
        if flange.bevel:
            plate = cadquery.Workplane(_bevelled(plate.val(), flange.bevel, lean))
    for x, y, diameter in flange.all_holes():
        drill = cadquery.Solid.makeCylinder(diameter / 2, top - flange.z + 2, cadquery.Vector(x, y, flange.z - 1))
        plate = plate.cut(drill)
    return plate


def _bevelled(plate: cadquery.Solid, bevel: float, lean: float) -> cadquery.Solid:
    """A plate without its edges, by so much along z (mm), at 45 degrees; lean: of its walls inwards, mm a mm."""
    import cadquery

    chamfer, wall = BRepFilletAPI_MakeChamfer(plate.wrapped), bevel * math.hypot(1.0, lean)
    for side, across in (("<Z", bevel * (1 + lean)), (">Z", bevel * (1 - lean))):
        face = plate.faces(side)
        for edge in face.Edges():
            chamfer.Add(across, wall, edge.wrapped, face.wrapped)
    return cadquery.Solid(chamfer.Shape())


def _without(corners: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """A profile without the corners that a bevel of no width would leave twice."""
    return [corner for k, corner in enumerate(corners) if k == 0 or math.dist(corner, corners[k - 1]) > 1e-9]


def write_if_it_fits(lens: Lens, mount: Mount, path: str | Path, name: str, said: Part) -> None:
    """part.step, with what is said of the lens; no file where it cannot be built, which `misfit` says in words."""
    try:
        part = part_of(lens, mount)
    except ValueError:
        return
    step_writing.write(part.solid, path, name, said, part.faces, solid_properties.of_solid(part.solid))


def off(lens: Lens, mount: Mount, solid: TopoDS_Shape) -> tuple[float, str]:
    """(how far an edge of a solid lies from the mount's, or one of the mount's from its (mm), where), at the worst.

    ValueError if the mount does not fit the lens.
    """
    wanted, found = map(solid_edges.along_edges, (part_of(lens, mount).solid.wrapped, solid))
    missing, strange = cKDTree(found).query(wanted)[0], cKDTree(wanted).query(found)[0]
    worst, places = max((missing, wanted), (strange, found), key=lambda pair: pair[0].max())
    return float(worst.max()), "edge at ({:.4g}, {:.4g}, {:.4g}) mm".format(*places[worst.argmax()])


def misfit(lens: Lens, mount: Mount) -> str | None:
    """What keeps lens and flange from being one part, in a sentence; None: nothing."""
    try:
        part_of(lens, mount)
    except ValueError as error:
        return str(error)
    return None
