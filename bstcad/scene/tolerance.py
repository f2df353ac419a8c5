"""What a scene says of how exactly its lens is made, mounted and lit: [[tolerance]] tables, none by default.

Each changes what it says of the errors that it names, of all without a name; what comes later goes before.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal

from bstcad.optics.key import Key
from bstcad.scene.fields import Record

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

    name: Annotated[Name | None, Key("The error, or the errors that begin so; all if absent.")] = None
    grade: Annotated[
        Literal["moulded", "diamond-turned", "precise", "none"] | None, Key("The limit of that grade; none: never off.")
    ] = None
    limit: Annotated[
        float | None,
        Key("Limit (+-) in the error's unit; of form and ripple the RMS.", "", 1e-12, 1e4),
    ] = None
    distribution: Annotated[
        Literal["normal", "uniform"] | None, Key("normal is cut at the limit, two standard deviations.")
    ] = None
    cost: Annotated[float | None, Key("Cost of holding the limit, relative to the other errors.", "", 1e-6, 1e6)] = None
    correlation_length: Annotated[float | None, Key("Correlation length of a form error.", "mm", 1e-3, 1e4)] = None
    period: Annotated[float | None, Key("Period of a ripple.", "mm", 1e-3, 1e4)] = None
    pattern: Annotated[Literal["raster", "spiral"] | None, Key("Marks of the tool that make the ripple.")] = None

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
