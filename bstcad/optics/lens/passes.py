"""Faces of a solid, and the passes of light: which faces it meets, in order, with the law of refraction or reflection.

A body is a list of named faces, the lowest first, and of passes.  Its walls belong to the solid alone (cad).  What is
done for every face loops over the list; FRONT and BACK name a face of a lens or mirror where one of them is meant.

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
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.surfaces import Surface

FRONT, BACK = "front", "back"  # names of the lowest and the highest face of a lens, in its files too


def of_face(face: str) -> str:
    """Return words behind the name of a value of a face: "" for the back, else such as " of the front"."""
    return "" if face == BACK else f" of the {face}"


@dataclass(frozen=True)
class Face:
    """A face of the solid: a surface with a name."""

    name: str  # name of the face, by which passes, scenes and files refer to it
    surface: Surface
    clear: Outline | None = None  # clear aperture, outside which light is lost; None: the outline of face or lens

    @property
    def prefix(self) -> str:
        """Beginning of the names of its values in JSON and files: "" for the back, else such as "front_"."""
        return "" if self.name == BACK else f"{self.name}_"

    @property
    def of(self) -> str:
        """Words behind the name of a value of this face, as `of_face` returns them."""
        return of_face(self.name)


class Pass(NamedTuple):
    """A face that light meets, and the law there."""

    face: str  # name of the face that light meets
    law: type[Refract] | type[Reflect]  # law of the face


@dataclass(frozen=True)
class Passes:
    """Passes of light through a solid, in the order of the light; behind the solid is air."""

    steps: tuple[Pass, ...]  # passes in the order of the light
    index_before: float = 1.0  # refractive index between the source and the solid; above 1: an LED in its encapsulant

    @property
    def faces(self) -> tuple[str, ...]:
        """Faces that light meets, each once, in the order of the light."""
        return tuple(dict.fromkeys(step.face for step in self.steps))

    def numbers_of(self, face: str) -> tuple[int, ...]:
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
    def mirror(self) -> str | None:
        """Face that reflects the light; None: no face does."""
        return next((face for face, law in self.steps if law is Reflect), None)

    @property
    def refracting_faces(self) -> tuple[str, ...]:
        """Faces that refract the light, each once, in the order of the light."""
        return tuple(dict.fromkeys(face for face, law in self.steps if law is Refract))

    @property
    def sense(self) -> int:
        """Direction of incident light along z: 1 for light onto the front, -1 for light from above onto the back."""
        return -1 if self.steps[0].face == BACK else 1

    @property
    def reversal(self) -> int:
        """Direction along z of the emergent light relative to the incident light: 1, or -1 if it is reversed."""
        return (-1) ** sum(law is Reflect for _, law in self.steps)

    def deflection(self, face: str, index: float) -> float:
        """Return the deflection of a ray by all its passes at a face, divided by the face's (small) slope angle."""
        outside = self.index_before if face == self.steps[0].face else 1.0
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

    def name(self, face: str) -> str:
        """Name a face: its own name if it refracts, "mirror face" if it only reflects, "rear" if it stays dark."""
        laws = [self.steps[k].law for k in self.numbers_of(face)]
        return face if Refract in laws else "mirror face" if laws else "rear"

    def role(self, face: str) -> str:
        """Return what light does at a face, such as "light enters and leaves"; "dark" if no light meets it."""
        crossings = [k for k in self.numbers_of(face) if self.steps[k].law is Refract]
        ends = {0: "enters", len(self.steps) - 1: "leaves"}
        does = " and ".join(ends[k] for k in crossings if k in ends)
        return f"light {does}" if does else "light meets it" if face in self.faces else "dark"


LENS = Passes((Pass(FRONT, Refract), Pass(BACK, Refract)))
MIRROR = Passes((Pass(BACK, Reflect),))
SECOND_SURFACE = Passes((Pass(BACK, Refract), Pass(FRONT, Reflect), Pass(BACK, Refract)))
