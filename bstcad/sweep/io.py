"""Records of runs as JSON, read back strictly, and as tables."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict

from bstcad.runs import files
from bstcad.scene.errors import MachineError

LARGEST = 100_000_000  # bytes of a file
DIGITS = 6


class Stored(BaseModel):
    """A frozen record that a file holds."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


Record = TypeVar("Record", bound=Stored)


def read(kind: type[Record], path: Path, remedy: str) -> Record:
    """The record that a file holds; MachineError if the file is damaged or foreign."""
    try:
        return kind.model_validate_json(files.contents(path, LARGEST))
    except ValueError:  # of which pydantic's error is one
        raise MachineError(f"{path}: is damaged, or another program's; {remedy}") from None


def put(path: Path, record: Stored) -> None:
    """Write a record whole, every digit of it."""
    files.put(path, f"{record.model_dump_json(indent=1)}\n".encode())


def put_rounded(path: Path, record: Stored) -> None:
    """Write a record whole, for people: numbers to DIGITS digits."""
    text = json.dumps(rounded(record.model_dump(mode="json")), ensure_ascii=False, indent=1)
    files.put(path, f"{text}\n".encode())


def rounded(value: Any, digits: int = DIGITS) -> Any:
    """A JSON value with numbers of so many digits; null for a number that is not finite."""
    if isinstance(value, Mapping):
        return {key: rounded(part, digits) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(part, digits) for part in value]
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    return value


def table(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write these columns of all rows as CSV."""
    text = io.StringIO()
    lines = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    lines.writeheader()
    lines.writerows(rows)
    files.put(path, text.getvalue().encode())
