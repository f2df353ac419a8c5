"""Area, volume and centroid of what is made of a lens: cut to a wire, drilled, or held by a body.

The lens's part comes from its own quadrature, the body's from OCC, which has to find nothing but simple faces there.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from OCP.BRepAdaptor import BRepAdaptor_Surface
from OCP.GeomAbs import GeomAbs_SurfaceType as Kind
from OCP.TopAbs import TopAbs_FACE
from OCP.TopExp import TopExp_Explorer
from OCP.TopoDS import TopoDS, TopoDS_Shape

from bstcad.cad import mass_properties, solid_properties
from bstcad.cad.mass_properties import MassProperties
from bstcad.cad.mounting import Mounted, Placed
from bstcad.cad.trimming import cut_loops
from bstcad.cad.wires import Piece, breaks
from bstcad.optics.border_sums import Border, border_sums
from bstcad.optics.face_sums import gauss_points
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import Surface

POINTS = 4  # in each part of a border
FINE = 256  # parts of a curve that is neither line nor circle, whose own knots nobody asks for
PLAIN = {Kind.GeomAbs_Plane, Kind.GeomAbs_Cylinder, Kind.GeomAbs_Cone, Kind.GeomAbs_SurfaceOfExtrusion}
SIMPLE = PLAIN | {Kind.GeomAbs_Sphere, Kind.GeomAbs_Torus}


def of_placed(placed: Placed) -> MassProperties | None:
    """Of one lens in the frame of what holds it, to about 1e-8; None where its walls lean: see `of_faces`."""
    if placed.draft:
        return None
    lens = placed.lens.plain()
    whole = placed.trim is None and not len(placed.holes)
    found = mass_properties.of_lens(lens) if whole else of_cut(lens, cut_loops(lens, placed.trim, placed.holes))
    x, y, z = (np.array(found.centroid) + placed.at).tolist()
    return MassProperties(found.area, found.volume, (x, y, z))


def of_mounted(found: Mounted, lenses: Sequence[Placed]) -> MassProperties | None:
    """Of lenses in a body, from those of each, whose contact is surface of neither any more.

    None where the body has freeform faces, over which OCC would take as long as it pleases, and where walls lean and
    its faces are not all PLAIN.
    """
    if any(placed.draft for placed in lenses):
        return of_faces(found.solid.wrapped) if _has_only(PLAIN, found.body) else None
    if not _has_only(SIMPLE, found.body):
        return None
    around = mass_properties.by_occ(found.body)
    area, volume, moment = around.area - 2 * found.contact, around.volume, around.volume * np.array(around.centroid)
    for own in map(of_placed, lenses):
        area, volume, moment = area + own.area, volume + own.volume, moment + own.volume * np.array(own.centroid)
    x, y, z = (moment / volume).tolist()
    return MassProperties(area, volume, (x, y, z))


def of_faces(solid: TopoDS_Shape) -> MassProperties | None:
    """Of a part whose walls lean, from its own faces and edges; None if a face is of a kind that is not known there."""
    try:
        return solid_properties.of_solid(solid)
    except ValueError:
        return None


def _has_only(kinds: Collection[Kind], body: TopoDS_Shape) -> bool:
    faces = TopExp_Explorer(body, TopAbs_FACE)
    while faces.More():
        if BRepAdaptor_Surface(TopoDS.Face_s(faces.Current())).GetType() not in kinds:
            return False
        faces.Next()
    return True


def of_cut(lens: Lens, loops: Sequence[Sequence[Piece]]) -> MassProperties:
    """Of a lens within loops that have it on their left (trimming.cut_loops), in its own frame."""
    foot = lens.front.z  # heights are measured from there, so that digits stay
    back, front = (border_sums(face, _border(face, loops), face.z - foot) for face in (lens.back, lens.front))
    return mass_properties.between(back, front, back.first - front.first, foot)


def _border(surface: Surface, loops: Sequence[Sequence[Piece]]) -> Border:
    """Gauss points of all loops, in parts that meet no knot line of the surface."""
    found = [_points(surface, piece) for loop in loops for piece in loop]
    return Border(*(np.concatenate(each) for each in zip(*found, strict=True)))


def _points(surface: Surface, piece: Piece) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(x, y, weights of dx, weights of ds)."""
    parts = breaks(surface, piece)
    if not piece.straight and piece.centre is None:
        parts = np.union1d(parts, np.linspace(0.0, piece.end, FINE + 1))
    t, weight = gauss_points(parts, POINTS)
    places, along = piece.points(t)
    x, y = (np.ascontiguousarray(place) for place in places.T)
    return x, y, weight * along[:, 0], weight * np.hypot(*along.T)
