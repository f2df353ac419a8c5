"""Records of a scene: what their fields hold, and the sentence about a number out of its field's range."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from bstcad.optics.key import keys_of
from bstcad.optics.outlines import Circle, Rectangle

LENGTHS, COORDINATES = (1e-3, 1e6), (-1e8, 1e8)  # mm


class Record(BaseModel):
    """A table of a scene: frozen, with no other keys than its own and no numbers that are not finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


Outlined = Annotated[Rectangle | Circle, Field(discriminator="shape")]


def out_of_range(record: Any, key: str = "") -> Iterator[str]:
    """A sentence for each number of a record, and of the records in it, that is out of its field's range."""
    for name, described in keys_of(type(record)).items():
        value, dotted = getattr(record, name), f"{key}.{name}".lstrip(".")
        for k, table in enumerate(value if isinstance(value, tuple) else ()):
            yield from out_of_range(table, f"{dotted}[{k}]")
        yield from out_of_range(value, dotted)
        unit = f" {described.unit}" if described.unit else ""
        for number in described.outside(value):
            in_um = described.unit == "nm" and 0.1 <= number <= 20
            remedy = f"did you mean {number * 1000:g} nm?" if in_um else "choose a value in between"
            yield (
                f"{dotted}: {number:g}{unit} is not between {described.least:.10g} and {described.most:.10g}{unit}; "
                f"{remedy}"
            )
