"""Passes of light through a solid: the faces that light meets, in order, with the law of refraction or reflection.

The passes determine whether light enters the solid, from which side it comes, where it leaves, and the names of the
faces.  A lens has a pass at each face, a mirror one at its back.  A second-surface mirror has three: light crosses the
back on the way to the front, which reflects it, and again on the way out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

from bstcad.optics.lens.interfaces import Law, Reflect, Refract

Face = Literal["front", "back"]


class Pass(NamedTuple):
    """A face that light meets, and the law there."""

    face: Face  # face that light meets
    law: type[Refract] | type[Reflect]  # law of the face


@dataclass(frozen=True)
class Passes:
    """Passes of light through a solid, in the order of the light; behind the solid is air."""

    steps: tuple[Pass, ...]  # passes in the order of the light
    index_before: float = 1.0  # refractive index between the source and the solid; above 1: an LED in its encapsulant

    @property
    def faces(self) -> tuple[Face, ...]:
        """Faces that light meets, each once, in the order of the light."""
        return tuple(dict.fromkeys(step.face for step in self.steps))

    def numbers_of(self, face: Face) -> tuple[int, ...]:
        """Return the numbers, from 0, of the passes at a face; empty if no light meets it."""
        return tuple(k for k, step in enumerate(self.steps) if step.face == face)

    def laws(self, index: float) -> Iterator[Law]:
        """Yield the law of each pass; index: refractive index of the solid."""
        before, inside = self.index_before, False
        for _, law in self.steps:
            if law is Reflect:
                yield Reflect()
            else:
                inside = not inside
                after = index if inside else 1.0
                yield Refract(before, after)
                before = after

    @property
    def enters(self) -> bool:
        """True if light enters the solid."""
        return any(law is Refract for _, law in self.steps)

    @property
    def reflects(self) -> bool:
        """True if a face reflects the light."""
        return self.mirror is not None

    @property
    def mirror(self) -> Face | None:
        """Face that reflects the light; None: no face does."""
        return next((face for face, law in self.steps if law is Reflect), None)

    @property
    def refracting_faces(self) -> tuple[Face, ...]:
        """Faces that refract the light, each once, in the order of the light."""
        return tuple(dict.fromkeys(face for face, law in self.steps if law is Refract))

    @property
    def sense(self) -> int:
        """Direction of incident light along z: 1 for light onto the front, -1 for light from above onto the back."""
        return 1 if self.steps[0].face == "front" else -1

    @property
    def reversal(self) -> int:
        """Direction along z of the emergent light relative to the incident light: 1, or -1 if it is reversed."""
        return (-1) ** sum(law is Reflect for _, law in self.steps)

    def deflection(self, face: Face, index: float) -> float:
        """Return the deflection of a ray by all its passes at a face, divided by the face's (small) slope angle."""
        outside = self.index_before if face == "front" else 1.0
        by_law = {Reflect: 2.0 * (index if self.enters else 1.0), Refract: abs(index - outside)}
        return sum(by_law[self.steps[k].law] for k in self.numbers_of(face))

    def largest_deflection(self, index: float) -> float | None:
        """Return the largest deflection (degrees) by one face, limited by total internal reflection; None: a mirror."""
        return None if self.reflects else math.degrees(math.acos(1 / index))

    @property
    def optic(self) -> Literal["lens", "mirror"]:
        """Name of the solid: "mirror" if a face reflects the light, else "lens"."""
        return "mirror" if self.reflects else "lens"

    @property
    def words(self) -> str:
        """Description of the passes, such as "by a mirror's back"."""
        return f"by a {self.optic}'s {', '.join(step.face for step in self.steps)}"

    def name(self, face: Face) -> str:
        """Name a face: "front" or "back" if it refracts, "mirror face" if it only reflects, "rear" if it stays dark."""
        laws = [self.steps[k].law for k in self.numbers_of(face)]
        return face if Refract in laws else "mirror face" if laws else "rear"

    def role(self, face: Face) -> str:
        """Return what light does at a face, such as "light enters and leaves"; "dark" if no light meets it."""
        crossings = [k for k in self.numbers_of(face) if self.steps[k].law is Refract]
        ends = {0: "enters", len(self.steps) - 1: "leaves"}
        does = " and ".join(ends[k] for k in crossings if k in ends)
        return f"light {does}" if does else "light meets it" if face in self.faces else "dark"


LENS = Passes((Pass("front", Refract), Pass("back", Refract)))
MIRROR = Passes((Pass("back", Reflect),))
SECOND_SURFACE = Passes((Pass("back", Refract), Pass("front", Reflect), Pass("back", Refract)))
