"""Area, volume and centroid of a solid: what a STEP file states so that its reader can tell whether it got the same."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from bstcad.cad.volume import exact_volume
from bstcad.optics.face_sums import FaceSums, face_sums
from bstcad.optics.lens import Lens

if TYPE_CHECKING:  # the first process, which proves a lens without OCC, need not load it
    import cadquery
    from OCP.TopoDS import TopoDS_Shape

PRECISE = 1e-7  # of themselves, asked of OCC


@dataclass(frozen=True)
class MassProperties:
    """Of a solid of even density."""

    area: float  # of the whole surface (mm²)
    volume: float  # mm³
    centroid: tuple[float, float, float]  # mm


def of_lens(lens: Lens) -> MassProperties:
    """Of a lens, from its own surfaces and without OCC: volume and centroid to rounding, the area to about 1e-8.

    V = ∫∫ (b - f), V c = ∫∫ (x (b - f), y (b - f), (b² - f²) / 2), b and f the heights of back and front over the
    outline; A = ∫∫ sqrt(1 + |∇b|²) + ∫∫ sqrt(1 + |∇f|²) + ∮ (b - f) ds.
    """
    lens = lens.plain()
    volume, foot = exact_volume(lens), lens.front.z  # heights are measured from there, so that digits stay
    back, front = (face_sums(face, lens.outline, face.z - foot) for face in (lens.back, lens.front))
    return between(back, front, volume, foot)


def between(back: FaceSums, front: FaceSums, volume: float, foot: float) -> MassProperties:
    """Of what stands between two faces and the walls along their rim, heights measured from z = foot (mm)."""
    centroid = (
        (back.in_x - front.in_x) / volume,
        (back.in_y - front.in_y) / volume,
        foot + (back.second - front.second) / 2 / volume,
    )
    return MassProperties(back.area + front.area + back.along_rim - front.along_rim, volume, centroid)


def by_occ(shape: cadquery.Shape | TopoDS_Shape) -> MassProperties:
    """Of any solid, as OCC finds them: for small nets, since 17 x 17 control points take seconds and 65 x 65 a minute.

    On rough nets it leaves 1e-5 though it is asked for 1e-7.
    """
    from OCP.BRepGProp import BRepGProp
    from OCP.GProp import GProp_GProps

    shape, solid, surface = getattr(shape, "wrapped", shape), GProp_GProps(), GProp_GProps()
    BRepGProp.VolumePropertiesGK_s(shape, solid, PRECISE, False, False, True)  # with the centroid
    BRepGProp.SurfaceProperties_s(shape, surface, PRECISE)
    return MassProperties(surface.Mass(), solid.Mass(), solid.CentreOfMass().Coord())
