"""Values as a script has them (records, arrays, paths, tuples), as a scene file would have them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import PurePath
from typing import Any

import numpy as np
from pydantic import BaseModel

from bstcad.scene.errors import SceneError
from bstcad.scene.front import as_front
from bstcad.scene.given_net import GivenNet
from bstcad.scene.picture import Picture, from_array

PICTURE = "target.image"  # where an array is a picture
FRONT = "lens.front"  # and a surface a front


def as_in_a_file(value: Any, key: str, pictures: dict[str, Picture]) -> Any:
    """The value under a dotted key as TOML could have it; None stays None.

    A picture, or a given net, is put into `pictures`, and a name that no file has stands for it.
    """
    if hasattr(value, "__array__") and np.ndim(value) and key == PICTURE:
        value = from_array(np.asarray(value))
    if key == FRONT:
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
        told = {str(k): as_in_a_file(part, f"{key}.{k}".lstrip("."), pictures) for k, part in value.items()}
        return {name: part for name, part in told.items() if part is not None}
    if isinstance(value, list | tuple):
        return [as_in_a_file(part, f"{key}[{i}]", pictures) for i, part in enumerate(value)]
    if isinstance(value, PurePath):
        return str(value)
    if value is None or isinstance(value, str | int | float):
        return value
    raise SceneError(
        f"{key}: no scene holds a value of type {type(value).__name__}; give a number, a text, a list or a record"
    )
