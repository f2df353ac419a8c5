"""Keys that follow another one, so that a change of one number leaves a scene that a person would draw.

A beam that fills the lens goes on filling it; a lens that is moved or made thicker keeps its distance to the wall; and
light of another profile gets the width that this profile has.  With a closed lock, width and height keep their
proportions.  Nothing follows a wrong entry.  In the text of a scene each key can still be set by itself.

The choices of a form that a scene cannot have are found by trying them, each with the reason.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from typing import Any

from bstcad.app.form import LOCKS, form
from bstcad.app.kinds import are_numbers, extent, table_at, value_at
from bstcad.app.scene_text import changed, same, tables
from bstcad.app.words import typed
from bstcad.runs.files import SentenceError

SHAPES = {"lens.outline": "source.aperture"}  # an outline, and the outline that follows where both are alike
MOVED = "lens.back.z"  # the plane from which targets keep their distance
WIDTHS = {  # the key that states the width of a profile, by the kind of source and the profile
    ("collimated", "gaussian"): "radius_1e2",
    ("point", "gaussian"): "half_angle_1e2",
    ("point", "uniform"): "half_angle",
}
SAFE = ("rotate", "fit", "seen_from", "sample")  # they change the picture alone, and reading a photo takes long


def take_change(
    text: str, key: str, value: Any, *, is_sound: Callable[[str], bool], sound: str | None = None, locked: bool = False
) -> tuple[str, tuple[str, ...]]:
    """Return a scene's text with another value of a key, and the keys that followed.

    is_sound: is a text a valid scene?  Keys follow only where the scene is valid with them.  sound: the latest valid
    text of the scene, from which followers are computed, so that a wrong entry in between leaves no trace in them.
    """
    alone = changed(text, key, value)
    now = tables(text)
    before = now if sound is None else tables(sound)
    of_an_aperture = key == "lens.outline.shape" and table_at("source.aperture", before)  # it needs that shape, too
    aperture = {"source.aperture.shape": value} if of_an_aperture else {}
    for changes in (with_followers(before, key, value, locked=locked), aperture):
        others = {other: own for other, own in changes.items() if other != key}
        if not others or not all(same(value_at(other, before), value_at(other, now)) for other in others):
            continue  # a key that would follow has another value than the latest valid scene
        try:
            together = alone
            for other, own in others.items():
                together = changed(together, other, own)
        except SentenceError:
            continue
        if is_sound(together):
            return together, tuple(other for other in others if not same(value_at(other, now), others[other]))
        if is_sound(alone):
            break
    return alone, ()


def with_followers(data: Mapping[str, Any], key: str, value: Any, locked: bool = False) -> dict[str, Any]:
    """Return the changes, by key, that a change of one key makes in the tables of a scene; that key is the first.

    locked: the other side of a target or an outline keeps its ratio to the side that is changed.
    """
    changes = {key: value} | (_locked(data, key, value) if locked else {})
    for leader, follower in SHAPES.items():
        for each, own in [*changes.items()]:
            table, name = each.rpartition(".")[::2]
            if table == leader and value_at(leader, data) == value_at(follower, data) is not None:
                changes[f"{follower}.{name}"] = copy.deepcopy(own)
    if key == MOVED and are_numbers(value) and are_numbers(before := value_at(key, data)):
        targets = data.get("target")
        names = [f"target[{k}].z" for k in range(len(targets))] if isinstance(targets, list) else ["target.z"]
        changes |= {name: _rounded(z + value - before) for name in names if are_numbers(z := value_at(name, data))}
    return changes | (_of_profile(data, value) if key == "source.profile" else {})


def _locked(data: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """Return the other side of a table, in the ratio to this one that it has; {} where one of them has no length."""
    place, _, name = key.rpartition(".")
    other = f"{place}.{LOCKS.get(name, '')}"
    was, its = value_at(key, data), value_at(other, data)
    if are_numbers(value, was, its) and was and value > 0:
        return {other: _rounded(its * value / was)}
    if not (_is_range(value) and _is_range(was) and _is_range(its)):
        return {}
    ratio, middle = (value[1] - value[0]) / (was[1] - was[0]), (its[0] + its[1]) / 2
    return {other: [_rounded(middle + ratio * (end - middle)) for end in its]}


def _of_profile(data: Mapping[str, Any], profile: Any) -> dict[str, Any]:
    """Return the widths of a profile: the one that it has is made of the lens, those of other profiles go."""
    source = table_at("source", data)
    kind = source.get("kind")
    wanted = WIDTHS.get((kind, profile))
    changes: dict[str, Any] = {
        f"source.{name}": None for (of, _), name in WIDTHS.items() if of == kind and name in source and name != wanted
    }
    if wanted is not None and wanted not in source and (made := _width(data, source, wanted)) is not None:
        changes[f"source.{wanted}"] = made
    return changes


def _width(data: Mapping[str, Any], source: Mapping[str, Any], name: str) -> float | None:
    """Return the width of a profile that fills the lens: a radius (mm), or the half angle of its corners (degrees)."""
    sizes = extent(table_at("lens.outline", data))
    if sizes is None:
        return None
    if name == "radius_1e2":
        return max(sizes) / 2
    position, front = source.get("position"), value_at("lens.front.z", data)
    start = position[-1] if isinstance(position, list) and position else 0.0
    if not are_numbers(start, front) or front == start:
        return None
    return round(math.degrees(math.atan(math.hypot(*sizes) / 2 / abs(front - start))), 1)


def _is_range(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) == 2 and are_numbers(*value) and value[1] > value[0]


def _rounded(value: float) -> float:
    """Return a number without the last digits of a sum."""
    return float(f"{value:.10g}")


# ---- choices that a scene cannot have --------------------------------------------------------------------------------


def impossible(text: str, fault: Callable[[str], str | None]) -> dict[str, dict[str, str]]:
    """Return, by key and choice, why a valid scene would be refused with it; {} for a scene that is wrong itself.

    fault: the sentence that refuses the scene of a text; None for a valid one.
    """
    if fault(text) is not None:
        return {}
    found: dict[str, dict[str, str]] = {}
    for field in form(tables(text)).fields():
        if field.control != "choice" or field.key.rpartition(".")[2] in SAFE:
            continue
        for choice in field.choices:
            if choice != field.value and (why := _refusal(text, field.key, choice, fault)) is not None:
                found.setdefault(field.key, {})[choice] = why
    return found


def _refusal(text: str, key: str, choice: str, fault: Callable[[str], str | None]) -> str | None:
    """Return the sentence that refuses a scene with another choice; None: it is possible."""
    try:
        value = typed(key, choice, tables(text))
        return fault(take_change(text, key, value, is_sound=lambda each: fault(each) is None)[0])
    except SentenceError as refusal:
        return str(refusal)
