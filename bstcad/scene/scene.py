"""A scene, read from TOML or changed by values of Python.

Whatever is wrong with it is one sentence (SceneError) before any work starts; keys of features that are not built yet
are refused, never ignored.
"""

from __future__ import annotations

import copy
import datetime
import json
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path, PurePath
from types import MappingProxyType
from typing import Any, Self

import numpy as np
import tomli_w
from pydantic import BaseModel, ValidationError, field_validator, model_validator

from bstcad.runs import files
from bstcad.scene import picture
from bstcad.scene.blank import as_front
from bstcad.scene.check import complaints, doubts, metres
from bstcad.scene.errors import SceneError, explain, line_of, toml_positions
from bstcad.scene.given_net import GivenNet
from bstcad.scene.model import SceneModel
from bstcad.scene.picture import Picture
from bstcad.scene.target import PICTURES

LARGEST_FILE = 1_000_000  # bytes of a scene file
DOTS = 100  # in a line of one: tomllib takes the square of a dotted key's length to read it
DEEPEST = 20  # tables and lists in one another; a scene has four
OUTLINES = (("source", "aperture"), ("lens", "outline"), ("target", "outline"))
ONE_OF = (  # giving one later replaces the other
    ("target", PICTURES),
    ("lens", ("material", "index")),
    *((".".join(place), ("radius", "diameter")) for place in OUTLINES),
)


class Scene(SceneModel):
    """A scene that can be built: it has passed every check."""

    @field_validator("name")
    @classmethod
    def _safe(cls, name: str) -> str:
        safe = picture.safe_name(name)
        if not safe:
            raise ValueError(f"{name!r} makes no folder name; use letters a-z, digits, '-' or '_'")
        return safe

    @field_validator("title")
    @classmethod
    def _one_line(cls, title: str) -> str:
        if not (title.isprintable() and len(title) <= 200):  # it goes to the terminal too
            raise ValueError("must be one line of up to 200 characters that can be printed; shorten it")
        return title

    @model_validator(mode="after")
    def _possible(self) -> Self:
        for complaint in complaints(self):
            raise SceneError("; ".join((complaint, *metres(self))))
        return self

    def warnings(self) -> tuple[str, ...]:
        """What is possible but perhaps not meant."""
        return (*doubts(self), *self.target.remarks())

    def changed(self, changes: Mapping[str, Any]) -> Scene:
        """The scene with other values, by dotted key: scene.changed({"lens.back.z": 21.0, "target.text": "HI"}).

        A value is what Python has for it: a number, a text, a list, a record (bstcad.Sphere(8.0, 0.01)), for
        target.image an array of irradiance; None takes the key out.  Of alternatives (text, image, …) the one given
        replaces the others; a path is relative to the working folder.  Raises SceneError.
        """
        pictures: dict[str, Picture] = {}
        data = _from_python(self, "", pictures)
        for key, value in changes.items():
            _override(data, key, _from_python(value, key, pictures), key)
        return _validated(data, Path("."), pictures)

    def toml(self) -> str:
        """The scene as a file that loads to an equal scene; an image is named by the basename of its copy."""
        unused = set() if self.source.extent else {"source_points"}
        knobs = self.tailoring.resolved(self.lens.back.control_points)
        knobs = knobs.model_dump(exclude={"quality", "seed"} | unused)
        settings = ", ".join(f"{key} {value}" for key, value in knobs.items())
        optic = "a mirror" if self.lens.back.reflect else f"refractive index {self.index:.6g}"
        comment = f"# {optic}; quality {self.tailoring.quality}: {settings}\n"
        return comment + tomli_w.dumps(self.model_dump(mode="json", exclude_none=True))


def load(path: str | Path, overrides: Mapping[str, Any] | None = None) -> Scene:
    """The scene in a TOML file; overrides {"lens.back.z": "20.0"} go before what the file says.

    An override's text is read as a TOML value and, where it is none, as text.  Raises SceneError.
    """
    path = Path(path)
    text, data = _read(path)
    try:
        for key, value in (overrides or {}).items():
            _override(data, key, _toml_value(value) if isinstance(value, str) else value, f"--set {key}")
        return _validated(data, path.parent)
    except RecursionError:
        raise SceneError(f"{path}: is nested too deeply; give a scene file like those in templates") from None
    except SceneError as error:
        key = str(error).partition(":")[0]
        replaced = any(f"{key}.".startswith(f"{name}.") for name in overrides or ())
        if not replaced and (line := line_of(key, toml_positions(text))):
            error.add_note(f"line {line} of {path}")
        raise


def _validated(data: dict[str, Any], folder: Path, pictures: Mapping[str, Picture] = MappingProxyType({})) -> Scene:
    """The scene that tables as of a file make; `pictures` by their name, others are files relative to `folder`."""
    _renamed(data)
    _date(data)
    _plain(data)
    for table, key in OUTLINES:
        _circle(data, table, key)
    try:
        # By way of JSON, pydantic is strict (no "8" for 8.0, no true for 1) and still takes lists for tuples.
        context = {"folder": folder, "contents": pictures}
        scene = Scene.model_validate_json(json.dumps(data), strict=True, context=context)
    except ValidationError as error:
        raise SceneError(explain(error, data)) from None
    scene.target.irradiance()  # a damaged or black picture is found before any work
    return scene


def _read(path: Path) -> tuple[str, dict[str, Any]]:
    if os.path.isdir(path):
        inside = min(path.glob("*.toml"), default=path / "scene.toml")
        raise SceneError(f"{path}: is a folder; give a scene file, such as {inside}")
    if not os.path.isfile(path):
        raise SceneError(f"{path}: no such scene file; give the path of a TOML file, such as templates/thu.toml")
    try:
        data = files.contents(path, LARGEST_FILE)
    except ValueError as error:
        raise SceneError(f"{path}: cannot be read ({error}); give the path of a scene file") from None
    try:
        text = data.decode("utf-8-sig")
        if _dotted(text):
            raise SceneError(f"{path}: has a line of over {DOTS} dots, which is no scene file; shorten that line")
        return text, tomllib.loads(text)
    except UnicodeDecodeError:
        raise SceneError(f"{path}: is not UTF-8 text; give a TOML file") from None
    except RecursionError:
        raise SceneError(f"{path}: is nested too deeply; give a scene file like those in templates") from None
    except tomllib.TOMLDecodeError as error:  # "Expected ']' (at line 3, column 5)"
        lines = text.split("\n")
        end = f"at line {len(lines)}, column {len(lines[-1]) + 1}"
        fault = str(error).replace("at end of document", end)
        line = lines[int(re.search(r"at line (\d+)", fault)[1]) - 1]
        remedy = "write paths with / or in single quotes" if "\\" in line else "mend that line"
        raise SceneError(f"{path}: not valid TOML: {fault[:1].lower()}{fault[1:]}; {remedy}") from None
    except ValueError as error:
        if isinstance(error, SceneError):
            raise
        raise SceneError(f"{path}: has a number of too many digits; shorten it") from None


def _override(data: dict[str, Any], key: str, value: Any, said: str) -> None:
    """Set a dotted key, `said` so in a sentence; None takes it out.  It replaces its alternatives (ONE_OF)."""
    *tables, last = key.split(".")
    if not all((*tables, last)):
        raise SceneError(f"{said}: is no dotted key; write one such as lens.back.control_points")
    place = data
    for table in tables:
        place = place.setdefault(table, {})
        if not isinstance(place, dict):
            raise SceneError(f"{said}: {table} is not a table; set it whole instead")
    if value is None:
        place.pop(last, None)
        return
    for table, names in ONE_OF:
        if ".".join(tables) == table and last in names:
            for name in names:
                place.pop(name, None)
    place[last] = copy.deepcopy(value)  # a later key may go into it


def _dotted(text: str) -> bool:
    """Has a line that is no comment more than DOTS dots, so that reading it could take hours?"""
    return any(line.count(".") > DOTS for line in text.split("\n") if not line.lstrip().startswith("#"))


def _toml_value(text: str) -> Any:
    if _dotted(text):
        return text
    try:
        table = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return table["value"] if len(table) == 1 else text


def _renamed(data: dict[str, Any]) -> None:
    """SceneError for [tolerances], which is [accept] now; the thickness of the lens stands in [lens]."""
    if "tolerances" not in data:
        return
    old = data["tolerances"]
    for key in old if isinstance(old, dict) else ():
        table = "lens" if key.endswith("_thickness") else "accept"
        raise SceneError(f"tolerances.{key}: this table is called [{table}] now; write {table}.{key}")
    raise SceneError("tolerances: this table is called [accept] now; write [accept]")


def _date(data: dict[str, Any]) -> None:
    """A drawing's date may be written as TOML has dates; the record has it as text."""
    part = data.get("part")
    if isinstance(part, dict) and type(part.get("date")) is datetime.date:
        part["date"] = part["date"].isoformat()


def _circle(data: dict[str, Any], table: str, key: str) -> None:
    """A circle may be written by its diameter; the record has one noun, the radius."""
    outline = data[table].get(key) if isinstance(data.get(table), dict) else None
    if not isinstance(outline, dict):
        return
    if outline.get("shape") not in ("circle", "rectangle"):
        raise SceneError(f'{table}.{key}.shape: must be "circle" or "rectangle"; write one of them')
    if outline["shape"] == "rectangle" or "diameter" not in outline:
        return
    if "radius" in outline:
        raise SceneError(f"{table}.{key}: has both radius and diameter; give one of them")
    diameter = outline.pop("diameter")
    if isinstance(diameter, bool) or not isinstance(diameter, int | float):
        raise SceneError(f"{table}.{key}.diameter: {diameter!r} is not a number; write one, without quotes")
    outline["radius"] = diameter / 2


def _spectrum(data: list[Any]) -> None:
    """SceneError for a list that is no spectrum, of which pydantic would say that it is no number."""
    for line in data:
        if not (isinstance(line, list) and len(line) == 2 and all(type(p) in (int, float) for p in line)):
            raise SceneError(
                "source.wavelength: a spectrum is a list of lines, each a wavelength in nm and a weight; write it such "
                "as [[486.1, 1.0], [587.6, 1.0]]"
            )


def _plain(data: Any, key: str = "", depth: int = 0) -> None:
    """SceneError for values that pydantic would refuse in other words: dates, infinity, NaN, half characters."""
    if depth > DEEPEST:
        raise RecursionError
    children = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for name, value in children:
        where = f"{key}[{name}]" if isinstance(data, list) else f"{key}.{name}" if key else str(name)
        _plain(value, where, depth + 1)
        _plain(name, where, depth + 1)
    if key == "source.wavelength" and isinstance(data, list):
        _spectrum(data)
    if isinstance(data, int | float) and not abs(data) < 1e300:  # also NaN
        shown = data if isinstance(data, float) else "a number of over 300 digits"  # too many may not be written out
        raise SceneError(f"{key}: {shown} is not a finite number; give one")
    if isinstance(data, str) and not data.isascii() and any("\ud800" <= c <= "\udfff" for c in data):
        raise SceneError(f"{key}: holds half a character; write the text again in UTF-8")
    if not isinstance(data, dict | list | str | int | float):
        raise SceneError(f"{key}: {data} is a date or a time; give a number or a text")


def _from_python(value: Any, key: str, pictures: dict[str, Picture]) -> Any:
    """A value of Python (record, array, path, tuple) under a dotted key as TOML could have it; None stays None.

    A picture, or a given net, is put into `pictures`, and a name that no file has stands for it.
    """
    if hasattr(value, "__array__") and np.ndim(value) and key == "target.image":
        value = picture.from_array(np.asarray(value))
    if key == "lens.front":
        value = as_front(value)
    if isinstance(value, Picture | GivenNet):
        name = f"\0{len(pictures)}"
        pictures[name] = value
        return name
    if isinstance(value, BaseModel):
        value = {name: getattr(value, name) for name in type(value).model_fields}
    elif is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    elif hasattr(value, "__array__"):
        value = np.asarray(value).tolist()  # also a single number of numpy or torch
    if isinstance(value, Mapping):
        table = {str(k): _from_python(part, f"{key}.{k}".lstrip("."), pictures) for k, part in value.items()}
        return {name: part for name, part in table.items() if part is not None}
    if isinstance(value, list | tuple):
        return [_from_python(part, f"{key}[{i}]", pictures) for i, part in enumerate(value)]
    if isinstance(value, PurePath):
        return str(value)
    if value is None or isinstance(value, str | int | float):
        return value
    raise SceneError(
        f"{key}: no scene holds a value of type {type(value).__name__}; give a number, a text, a list or a record"
    )
