"""The table [moulding]: the shrinkage of a moulded part, from which the size of its cavity follows.

A part shrinks while it cools in and outside the mould.  ISO 294-4 and data sheets of plastics state the moulding
shrinkage s relative to the cavity: part = (1 - s) cavity.  Shops also state the allowance relative to the part:
cavity = (1 + s) part.  For s = 0.005 and a part of 300 mm, the cavity is 301.5075 mm by the first meaning and 301.5 mm
by the second.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from bstcad.optics.surfaces.key import Key
from bstcad.scene.schema import OneOrThreeNumbers, Record

MAX_SHRINKAGE = 0.2  # largest shrinkage; polymers have 0.001 to 0.04, sintered ceramics up to 0.2
CAVITY = "cavity"  # kind of export that needs this table
MISSING = '"cavity" needs the shrinkage of the moulding; add the table [moulding] to the scene'


class Moulding(Record):
    """Shrinkage of a moulded part: the cavity is the part enlarged by a factor along each axis."""

    shrinkage: Annotated[
        OneOrThreeNumbers,
        Key(
            "Shrinkage, or [along x, along y, along z].", "", 0.0, MAX_SHRINKAGE, example=0.005,
            remedy="give a fraction, such as 0.005 for 0.5 %",
        ),
    ]  # fmt: skip
    relative_to: Annotated[
        Literal["cavity", "part"],
        Key("Length to which the shrinkage relates: of the cavity (ISO 294-4), or of the part.", example="part"),
    ] = "cavity"

    @property
    def per_axis(self) -> tuple[float, float, float]:
        """Shrinkage along x, y and z."""
        given = self.shrinkage
        return given if isinstance(given, tuple) else (given, given, given)

    @property
    def factors(self) -> tuple[float, float, float]:
        """Ratios cavity / part along x, y and z: 1 / (1 - s) relative to the cavity, 1 + s relative to the part."""
        x, y, z = (1 / (1 - s) if self.relative_to == "cavity" else 1 + s for s in self.per_axis)
        return x, y, z

    def as_measured(self, scales: Sequence[float]) -> tuple[float, ...]:
        """Return the shrinkages, with this table's meaning, of parts that were made in the cavity of this table.

        scales: ratios of the measured part to the design along x, y and z.  A cavity by these shrinkages gives parts
        of the size of the design: its factor is F / m, F this table's factor and m the measured scale.
        """
        ratios = [factor / scale for factor, scale in zip(self.factors, scales, strict=True)]
        return tuple(1 - 1 / ratio if self.relative_to == "cavity" else ratio - 1 for ratio in ratios)

    def words(self) -> str:
        """Return the shrinkage with its meaning, and the factors, in words."""
        each = f"{self.per_axis[0]:g}" if self.is_uniform else _listed(self.per_axis)
        formula = "cavity = part / (1 - s), ISO 294-4" if self.relative_to == "cavity" else "cavity = part (1 + s)"
        ratios = f"{self.factors[0]:.8g}" if self.is_uniform else _listed(self.factors)
        return f"s = {each} relative to the {self.relative_to}: {formula}; cavity / part = {ratios}"

    @property
    def is_uniform(self) -> bool:
        """True if the shrinkage is equal along x, y and z."""
        return len(set(self.per_axis)) == 1


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.8g} in {axis}" for value, axis in zip(values, "xyz", strict=True))
