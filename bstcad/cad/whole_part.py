"""A part that is more than a bare lens, or less: what a STEP file holds of it besides the lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from OCP.Bnd import Bnd_Box
from OCP.BRepAdaptor import BRepAdaptor_Surface
from OCP.BRepBndLib import BRepBndLib
from OCP.TopAbs import TopAbs_FACE
from OCP.TopExp import TopExp_Explorer
from OCP.TopoDS import TopoDS

from bstcad.cad import step_reading
from bstcad.cad.mass_properties import MassProperties
from bstcad.cad.step_reading import StepLens

Place = tuple[float, float, float]


@dataclass(frozen=True)
class WholePart:
    """A lens whose walls are not those of its outline: one with a flange, draft or bevel, or cut to a wire."""

    edge: np.ndarray  # (n, 2) places in mm, once around the back
    low: Place  # least x, y and z (mm) of all faces but freeform ones, whose edges are others', too
    high: Place  # the largest
    properties: MassProperties | None  # None: it has faces of kinds that nothing here integrates


def of(reread: StepLens, properties: MassProperties | None) -> WholePart | None:
    """What is around the lens of a file; None of a bare lens."""
    if reread.edge is None:
        return None
    box, faces = Bnd_Box(), TopExp_Explorer(reread.shape, TopAbs_FACE)
    while faces.More():
        if not step_reading.is_freeform(BRepAdaptor_Surface(TopoDS.Face_s(faces.Current()))):
            BRepBndLib.AddOptimal_s(faces.Current(), box, False, False)  # by the shape, not by its mesh and tolerance
        faces.Next()
    low, high = (corner.Coord() for corner in (box.CornerMin(), box.CornerMax()))
    return WholePart(reread.edge, low, high, properties)
