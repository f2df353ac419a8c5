"""Area, volume and centroid of a solid, which a STEP file states so that its reader can check the shape by them.

By the divergence theorem, A = ∮ dA, V = ∮ r·n dA / 3 and V c = ∮ r (r·n) dA / 4, each summed over the faces.  No OCC
here: it takes minutes over a large net and leaves 1e-5 over a rough one.
"""

from __future__ import annotations

from dataclasses import dataclass

from bstcad.optics import quadrature
from bstcad.optics.lens import Lens
from bstcad.optics.quadrature import Sums


@dataclass(frozen=True)
class MassProperties:
    """Of a solid of even density."""

    area: float  # of the whole surface (mm²)
    volume: float  # mm³
    centroid: tuple[float, float, float]  # mm

    @classmethod
    def of(cls, total: Sums, z: float = 0.0) -> MassProperties:
        """Of a solid by the sums over its whole surface, whose origin is at z (mm) on the axis."""
        c_x, c_y, c_z = (total.moment / total.volume).tolist()
        return cls(total.area, total.volume, (c_x, c_y, z + c_z))


def of_lens(lens: Lens) -> MassProperties:
    """Of a bare lens, from its own surfaces, to about 1e-9."""
    lens, total = lens.plain(), Sums()
    z_ref = lens.front.z  # heights are measured from there, so that digits stay
    for face, sign in ((lens.back, 1), (lens.front, -1)):
        border, raised = quadrature.outline_border(lens.outline, face), face.z - z_ref
        cap, wall = quadrature.of_face(face, border, raised), quadrature.of_wall(face, border, raised)
        total += Sums(cap.area + sign * wall.area, *(sign * (a + b) for a, b in (
            (cap.volume, wall.volume), (cap.moment, wall.moment)
        )))  # fmt: skip
    return MassProperties.of(total, z_ref)
