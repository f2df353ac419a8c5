"""The passes of light through a solid: which of its faces it meets, in which order, and by which law each turns it.

All that depends on them is asked here: does light enter the solid, from which side does it come, where does it leave,
what are the faces called.  A lens has a pass at each face, a mirror one at its back; a second-surface mirror has three,
since light crosses its back once on the way to the front, which reflects it, and once on the way out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

from bstcad.optics.interfaces import Law, Reflect, Refract

Face = Literal["front", "back"]


class Pass(NamedTuple):
    """One face that light meets, and what happens there."""

    face: Face
    law: type[Refract] | type[Reflect]


@dataclass(frozen=True)
class Passes:
    """The passes of a solid in air, in the order of the light."""

    steps: tuple[Pass, ...]

    @property
    def faces(self) -> tuple[Face, ...]:
        """The faces that light meets, each once, in its order."""
        return tuple(dict.fromkeys(step.face for step in self.steps))

    def numbers_of(self, face: Face) -> tuple[int, ...]:
        """The numbers of the passes at a face; none where no light meets it."""
        return tuple(k for k, step in enumerate(self.steps) if step.face == face)

    def laws(self, index: float) -> Iterator[Law]:
        """The law of each pass; index: the solid's."""
        inside, outside = index, 1.0
        for _, law in self.steps:
            if law is Reflect:
                yield Reflect()
            else:
                yield Refract(outside, inside)
                inside, outside = outside, inside

    @property
    def enters(self) -> bool:
        """Does light enter the solid?"""
        return any(law is Refract for _, law in self.steps)

    @property
    def reflects(self) -> bool:
        """Does a face reflect the light?"""
        return self.mirror is not None

    @property
    def mirror(self) -> Face | None:
        """The face that reflects the light; None: none does."""
        return next((face for face, law in self.steps if law is Reflect), None)

    @property
    def crossed(self) -> tuple[Face, ...]:
        """The faces that light goes through, each once, in its order."""
        return tuple(dict.fromkeys(face for face, law in self.steps if law is Refract))

    @property
    def sense(self) -> int:
        """The way along z of light that meets the solid: 1 to its front, -1 from above to its back."""
        return 1 if self.steps[0].face == "front" else -1

    @property
    def turn(self) -> int:
        """The way along z of light that leaves, times that of light that comes."""
        return (-1) ** sum(law is Reflect for _, law in self.steps)

    def deflection(self, face: Face, index: float) -> float:
        """The angle by which a face deflects a ray, over the slope angle of the face, both small."""
        by_law = {Reflect: 2.0 * (index if self.enters else 1.0), Refract: abs(index - 1)}
        return sum(by_law[self.steps[k].law] for k in self.numbers_of(face))

    def largest_turn(self, index: float) -> float | None:
        """The largest angle (degrees) by which one face turns light before it reflects all; None: any, by a mirror."""
        return None if self.reflects else math.degrees(math.acos(1 / index))

    @property
    def optic(self) -> Literal["lens", "mirror"]:
        """Return the name of the solid."""
        return "mirror" if self.reflects else "lens"

    @property
    def words(self) -> str:
        """How light passes the solid, such as "by a mirror's back"."""
        return f"by a {self.optic}'s {', '.join(step.face for step in self.steps)}"

    def name(self, face: Face) -> str:
        """What a face is called: front, back, the mirror face, or the rear, which no light meets."""
        laws = [self.steps[k].law for k in self.numbers_of(face)]
        return face if Refract in laws else "mirror face" if laws else "rear"

    def role(self, face: Face) -> str:
        """Say what light does at a face."""
        crossings = [k for k in self.numbers_of(face) if self.steps[k].law is Refract]
        ends = {0: "enters", len(self.steps) - 1: "leaves"}
        does = " and ".join(ends[k] for k in crossings if k in ends)
        return f"light {does}" if does else "light meets it" if face in self.faces else "dark"


LENS = Passes((Pass("front", Refract), Pass("back", Refract)))
MIRROR = Passes((Pass("back", Reflect),))
SECOND_SURFACE = Passes((Pass("back", Refract), Pass("front", Reflect), Pass("back", Refract)))
