"""Reading of a scene file: its text, and its TOML tables before they are checked."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path
from typing import Any

from bstcad.runs import files
from bstcad.scene.errors import SceneError

MAX_SCENE_SIZE = 1_000_000  # largest scene file (bytes)
MAX_DOTS = 100  # largest number of dots in a line; the time of tomllib grows with the square of a dotted key's length
MAX_NESTING = 20  # largest number of levels of nested tables and lists; a scene has four
NESTED = "is nested too deeply; give a scene file like those in templates"


def read(path: Path) -> tuple[str, dict[str, Any]]:
    """Read (text, tables) of a scene file; SceneError if it cannot be read or is not valid TOML."""
    if os.path.isdir(path):
        inside = min(path.glob("*.toml"), default=path / "scene.toml")
        raise SceneError(f"{path}: is a folder; give a scene file, such as {inside}")
    if not os.path.isfile(path):
        raise SceneError(f"{path}: no such scene file; give the path of a TOML file, such as templates/thu.toml")
    try:
        text = files.contents(path, MAX_SCENE_SIZE).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SceneError(f"{path}: is not UTF-8 text; give a TOML file") from None
    except ValueError as error:
        raise SceneError(f"{path}: cannot be read ({error}); give the path of a scene file") from None
    return text, tables(text, path)


def tables(text: str, path: Path) -> dict[str, Any]:
    """Return the tables in the text of a scene file; path: path of the file, for messages."""
    if too_dotted(text):
        raise SceneError(f"{path}: a line has more than {MAX_DOTS} dots; shorten that line")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise SceneError(f"{path}: {NESTED}") from None
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"{path}: not valid TOML: {_fault(text, str(error))}") from None
    except ValueError:
        raise SceneError(f"{path}: a number has too many digits; shorten it") from None


def _fault(text: str, fault: str) -> str:
    """Return the sentence `fault` of tomllib, such as "Expected ']' (at line 3, column 5)", with a remedy."""
    lines = text.split("\n")
    fault = fault.replace("at end of document", f"at line {len(lines)}, column {len(lines[-1]) + 1}")
    place = re.search(r"at line (\d+)", fault)
    assert place is not None  # tomllib states the line of each fault
    line = lines[int(place[1]) - 1]
    remedy = "write paths with / or in single quotes" if "\\" in line else "correct that line"
    return f"{fault[:1].lower()}{fault[1:]}; {remedy}"


def too_dotted(text: str) -> bool:
    """Return True if a line other than a comment has more than MAX_DOTS dots, so that parsing could take hours."""
    return any(line.count(".") > MAX_DOTS for line in text.split("\n") if not line.lstrip().startswith("#"))


def toml_value(text: str) -> Any:
    """Return the TOML value of an override, or its text if it is not a TOML value."""
    try:
        table = {} if too_dotted(text) else tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return table["value"] if len(table) == 1 else text


def check_plain(data: Any, key: str = "", depth: int = 0) -> None:
    """Raise SceneError for a date, NaN, a number beyond ±1e300, a lone surrogate; RecursionError: too deeply nested."""
    if depth > MAX_NESTING:
        raise RecursionError
    if isinstance(data, dict | list):
        for name, value in data.items() if isinstance(data, dict) else enumerate(data):
            where = f"{key}[{name}]" if isinstance(data, list) else f"{key}.{name}".lstrip(".")
            check_plain(name, where, depth + 1)
            check_plain(value, where, depth + 1)
    elif isinstance(data, int | float) and not abs(data) < 1e300:  # also NaN
        shown = data if isinstance(data, float) else "a number of more than 300 digits"  # too long to print
        raise SceneError(f"{key}: {shown} is not a finite number of magnitude below 1e300; give another number")
    elif isinstance(data, str) and not data.isascii() and any("\ud800" <= c <= "\udfff" for c in data):
        raise SceneError(f"{key}: the text has an incomplete character; write it again in UTF-8")
    elif not isinstance(data, str | int | float):
        raise SceneError(f"{key}: {data} is a date or a time; give a number or a text")
