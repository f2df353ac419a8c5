"""Keys that follow another one, so that a change of one number leaves a scene that a person would draw.

A beam that fills the lens goes on filling it; a picture that is widened keeps its proportions; a lens that is moved or
made thicker keeps its distance to the wall.  In the text of a scene each key can still be set by itself.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

SHAPES = {"lens.outline": "source.aperture"}  # an outline, and the outline that follows where both are alike
MOVED = {"lens.back.z": "target.z"}  # a plane, and the plane that keeps its distance


def with_followers(data: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """The changes, by key, that a change of one key makes in the tables of a scene; that key is the first."""
    changes = {key: value}
    for leader, follower in SHAPES.items():
        table, name = key.rpartition(".")[::2]
        if table == leader and _at(data, leader) == _at(data, follower) is not None:
            changes[f"{follower}.{name}"] = copy.deepcopy(value)
    if key in MOVED and _number(value):
        before, other = _at(data, key), _at(data, MOVED[key])
        if _number(before) and _number(other):
            changes[MOVED[key]] = _rounded(other + value - before)
    if key == "target.x" and _is_range(value):
        x, y = _at(data, "target.x"), _at(data, "target.y")
        if _is_range(x) and _is_range(y):
            ratio, middle = (value[1] - value[0]) / (x[1] - x[0]), (y[0] + y[1]) / 2
            changes["target.y"] = [_rounded(middle + ratio * (end - middle)) for end in y]
    return changes


def _at(data: Any, key: str) -> Any:
    """The value of a dotted key; None if it is not there."""
    for name in key.split("."):
        data = data.get(name) if isinstance(data, Mapping) else None
    return data


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def _is_range(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) == 2 and all(map(_number, value)) and value[1] > value[0]


def _rounded(value: float) -> float:
    """Without the last digits of a sum."""
    return float(f"{value:.10g}")
