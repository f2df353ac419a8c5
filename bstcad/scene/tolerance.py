"""What a scene says of how exactly its lens is made, mounted and lit: [[tolerance]] tables, none by default.

Each changes what it says of the errors that it names, of all without a name; what comes later goes before.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal

from bstcad.scene.target import Record

# An error, or several that begin so: "lens.decentre" is those in x and in y.
Name = Literal[
    "lens.decentre", "lens.decentre_x", "lens.decentre_y", "lens.axial",
    "lens.tilt", "lens.tilt_x", "lens.tilt_y", "lens.clocking",
    "lens.thickness", "lens.index", "lens.front_power", "lens.scale", "temperature",
    "back.form", "back.ripple", "front.form",
    "source.decentre", "source.decentre_x", "source.decentre_y", "source.axial",
    "source.tilt", "source.tilt_x", "source.tilt_y", "source.angle", "source.size", "wavelength",
    "screen.decentre", "screen.decentre_x", "screen.decentre_y", "screen.axial",
    "screen.tilt", "screen.tilt_x", "screen.tilt_y", "screen.clocking",
]  # fmt: skip
FORM, RIPPLE = ("back.form", "front.form"), ("back.ripple",)
OF_FACES = {"correlation_length": FORM, "period": RIPPLE, "pattern": RIPPLE}  # keys that only these have
NONE = "none"  # a grade: cannot be off


class Tolerance(Record):
    """What is said of the errors of one name; None: what was said before stays."""

    name: Name | None = None  # None: all
    grade: Literal["moulded", "diamond-turned", "precise", "none"] | None = None  # as in that grade
    limit: float | None = None  # ±, mm, degrees, K, nm or a ratio; of form and ripple the RMS (mm)
    distribution: Literal["normal", "uniform"] | None = None  # normal is cut at the limit, two standard deviations
    cost: float | None = None  # of holding it, as against the others, at its limit
    correlation_length: float | None = None  # mm, of a form error
    period: float | None = None  # mm, of a ripple
    pattern: Literal["raster", "spiral"] | None = None  # of a ripple

    def covers(self, error: str) -> bool:
        """Does it speak of this error?"""
        return self.name is None or error == self.name or error.startswith(f"{self.name}_")

    @property
    def told(self) -> dict[str, Any]:
        """What it says, its name apart."""
        return self.model_dump(exclude={"name"}, exclude_none=True)


Tolerancing = tuple[Tolerance, ...]


def said_of(table: Sequence[Tolerance], error: str) -> dict[str, Any]:
    """All that a table says of an error, by key; of a grade and a limit the later."""
    found: dict[str, Any] = {}
    for entry in table:
        if entry.covers(error):
            told = entry.told
            for one, other in (("grade", "limit"), ("limit", "grade")):
                if one in told:
                    found.pop(other, None)
            found |= told
    return found


def complaints(table: Sequence[Tolerance]) -> Iterator[str]:
    """What is wrong with the tables by themselves."""
    for k, entry in enumerate(table):
        where, told = f"tolerance[{k}]", entry.told
        if not told:
            yield f"{where}: says nothing of its errors; add a limit or a grade"
        if "limit" in told and "grade" in told:
            yield f"{where}: has both a limit and a grade; give one of them"
        if "limit" in told and entry.name is None:
            yield f'{where}.limit: {entry.limit:g} holds for no one error; add which, such as name = "lens.decentre"'
        for key, names in OF_FACES.items():
            if key in told and entry.name not in names:
                yield f"{where}.{key}: is for {' and '.join(names)}; remove it or change the name"
        if "distribution" in told and entry.name in FORM:
            yield f"{where}.distribution: a form error is a random field, and its amounts are normal; remove it"
