"""What a key of a scene means: it stands on the field of the record that the key is read into.

    radius: Annotated[float, Key("Radius.", "mm", 1e-3, 1e6)]

pydantic checks the range as it reads a scene; its JSON schema and `bstcad keys` are made of keys too (scene/schema.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Key:
    """Meaning, unit and range of a field; a range holds for each number of a list, of a list of lists for the first."""

    meaning: str  # one sentence
    unit: str = ""  # "": a pure number or a word
    least: float | None = None  # None: the field holds no number
    most: float | None = None
    example: Any = None  # value of a key that every scene has to give
    remedy: str = ""  # advice on a number out of range; "": choose one in between
    of_light: bool = False  # is it a limit of the light, which a verdict asks for?

    def in_range(self, value: Any) -> Any:
        """The value of a field, if all of its numbers are in the range; else ValueError, a sentence."""
        for number in _numbers(value):
            if not self.least <= number <= self.most:
                unit = f" {self.unit}" if self.unit else ""
                in_um = self.unit == "nm" and 0.1 <= number <= 20
                remedy = f"did you mean {number * 1000:g} nm?" if in_um else self.remedy or "choose a value in between"
                between = f"{self.least:.10g} and {self.most:.10g}{unit}"
                raise ValueError(f"{number:g}{unit} is not between {between}; {remedy}")
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> dict[str, Any]:
        """The validation of the field: its type, then the range; pydantic calls it."""
        if self.least is None:
            return handler(source)
        check = {"type": "no-info", "function": self.in_range}
        return {"type": "function-after", "function": check, "schema": handler(source)}

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        """The JSON schema of the field; pydantic calls it."""
        schema = handler(core) | {"description": self.meaning, "unit": self.unit or "none"}
        if self.least is not None:
            _bound(schema, self)
        return schema | ({} if self.example is None else {"examples": [self.example]})


def _numbers(value: Any) -> list[float]:
    """The numbers of a field's value: itself, each of a list, the first of each list in a list."""
    if isinstance(value, tuple):
        return [number for part in value for number in _numbers(part[0] if isinstance(part, tuple) else part)]
    return [value] if isinstance(value, int | float) and not isinstance(value, bool) else []


def _bound(schema: dict[str, Any], key: Key, listed: bool = False) -> None:
    """Put the range to the numbers of a JSON schema, as `_numbers` takes them."""
    if schema.get("type") in ("number", "integer"):
        schema |= {"minimum": key.least, "maximum": key.most}
    inner = [*schema.get("prefixItems", ()), *([schema["items"]] if isinstance(schema.get("items"), dict) else [])]
    for part in [*schema.get("anyOf", ()), *schema.get("oneOf", ()), *(inner[:1] if listed else inner)]:
        _bound(part, key, schema.get("type") == "array")
