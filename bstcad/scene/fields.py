"""Records of a scene: what their fields hold, and the sentence about a number out of its field's range."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, ValidationInfo, WithJsonSchema

from bstcad.optics.key import keys_of
from bstcad.optics.outlines import Circle, Rectangle

ESCAPES = "\0\a\b\f\n\r\t\v\x1b"  # what "C:\new\ten.png" holds once it is read as TOML
LENGTHS, COORDINATES = (1e-3, 1e6), (-1e8, 1e8)  # mm


class Record(BaseModel):
    """A table of a scene: frozen, with no other keys than its own and no numbers that are not finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


Outlined = Annotated[Rectangle | Circle, Field(discriminator="shape")]


def from_file(kind: type, read: Callable[[Path], Any], name: Callable[[Any], str], example: str) -> Any:
    """The type of a field that a file names by its path and that holds the file's content, a `kind`.

    A path is relative to the scene file, or to the user's home; `name` names the copy beside a design.
    """

    def content(given: Any, info: ValidationInfo) -> Any:
        if isinstance(given, kind):
            return given
        if not isinstance(given, str | Path):
            raise ValueError(f"{given!r} is no file name; write for example {example}")
        context = info.context or {}
        if given in (known := context.get("contents", {})):
            return known[given]
        path = Path(context.get("folder", "."), given)
        if not os.path.lexists(path) and any(c in ESCAPES for c in str(given)):
            raise ValueError(f"{given!r} holds an escape such as \\n; write paths with / or in single quotes")
        return read(path if os.path.lexists(path) else Path(context.get("folder", "."), os.path.expanduser(given)))

    return Annotated[
        kind, BeforeValidator(content), PlainSerializer(name, return_type=str), WithJsonSchema({"type": "string"})
    ]


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
