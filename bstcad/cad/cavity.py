"""The cavity of a mould: the lens, or the part with its mount, enlarged by the shrinkage about its datum."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from bstcad.cad import mounting, scaling, step_writing
from bstcad.cad.solid import named_solid
from bstcad.optics.lens import Lens
from bstcad.scene.moulding import Moulding
from bstcad.scene.mount import Mount, Part

if TYPE_CHECKING:
    from bstcad.cad.solid import NamedSolid


def cavity(lens: Lens, moulding: Moulding, mount: Mount | None = None) -> tuple[NamedSolid, float]:
    """Return the solid that fills the cavity, and z (mm) of the point of the axis about which it is enlarged.

    With a mount the solid is the part in the frame of its datum, as in part.step.  The point is the datum, or else the
    vertex of the front.  Raises ValueError if the part or the cavity is no valid solid.
    """
    if mount is None:
        part, about = named_solid(lens), lens.front_vertex
    else:
        part, about = mounting.part_of(lens, mount), 0.0
        if mount.datum == "source":
            about = lens.front_vertex
    return scaling.scaled(part, moulding.factors, about), about


def step_file(solid: NamedSolid, name: str, part: Part) -> bytes:
    """Return the STEP file of a cavity; of the data of the part it states number, author, organisation and schema."""
    keys = {key: getattr(part, key) for key in ("number", "author", "organisation", "schema")}
    return b"".join(step_writing.encode(solid.solid, name, replace(Part(), **keys), faces=solid.faces))
