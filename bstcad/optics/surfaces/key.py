"""Keys of a scene: meaning, unit and range, stated on the field of the record into which the key is read.

    radius: Annotated[float, Key("Radius.", "mm", 1e-3, 1e6)]

pydantic checks the range when it reads a scene; scene/schema.py makes the JSON schema and the text of `bstcad keys`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Key:
    """Meaning, unit and range of a field; the range applies to each number of [a, b, …], but in [[a, b], …] to a."""

    meaning: str  # meaning, one sentence
    unit: str = ""  # unit; "": a pure number or a word
    minimum: float | None = None  # lower end of the range; None: no range
    maximum: float | None = None  # upper end of the range
    example: Any = None  # example value, for the reference and for messages; None: no example
    remedy: str = ""  # advice for a number out of range; "": "choose a value in between"
    of_light: bool = False  # True for a limit on the light; a verdict on the light requires at least one such limit

    def in_range(self, value: Any) -> Any:
        """Return the value of a field if all its numbers are in range; otherwise raise ValueError with a sentence."""
        assert self.minimum is not None and self.maximum is not None  # called only for fields with a range
        for number in _numbers(value):
            if not self.minimum <= number <= self.maximum:
                unit = f" {self.unit}" if self.unit else ""
                in_um = self.unit == "nm" and 0.1 <= number <= 20
                remedy = f"did you mean {number * 1000:g} nm?" if in_um else self.remedy or "choose a value in between"
                between = f"{self.minimum:.10g} and {self.maximum:.10g}{unit}"
                raise ValueError(f"{number:g}{unit} is not between {between}; {remedy}")
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> dict[str, Any]:
        """Return the pydantic schema of the field, which checks its type, then its range."""
        if self.minimum is None:
            return handler(source)
        check = {"type": "no-info", "function": self.in_range}
        return {"type": "function-after", "function": check, "schema": handler(source)}

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        """Return the JSON schema of the field, for pydantic."""
        schema = handler(core) | {"description": self.meaning, "unit": self.unit or "none"}
        if self.minimum is not None:
            _bound(schema, self)
        return schema | ({} if self.example is None else {"examples": [self.example]})


def _numbers(value: Any) -> list[float]:
    """Return the numbers of a field's value to which the range applies (see `Key`)."""
    if isinstance(value, tuple):
        return [number for part in value for number in _numbers(part[0] if isinstance(part, tuple) else part)]
    return [value] if isinstance(value, int | float) and not isinstance(value, bool) else []


def _bound(schema: dict[str, Any], key: Key, listed: bool = False) -> None:
    """Add the range of a key to the numbers in its JSON schema (see `Key`); listed: True for an element of a list."""
    if schema.get("type") in ("number", "integer"):
        schema |= {"minimum": key.minimum, "maximum": key.maximum}
    inner = [*schema.get("prefixItems", ()), *([schema["items"]] if isinstance(schema.get("items"), dict) else [])]
    for part in [*schema.get("anyOf", ()), *schema.get("oneOf", ()), *(inner[:1] if listed else inner)]:
        _bound(part, key, schema.get("type") == "array")
