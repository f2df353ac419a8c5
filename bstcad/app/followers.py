"""Keys that follow another key, so that one change on the page leaves a sensible scene.

A beam that fills the lens keeps filling it.  A lens that is moved or made thicker keeps its distance from the wall.
A beam with another profile gets the width that it needs.  With a closed lock, width and height keep their ratio.
A back that becomes a dome gets a front about the lamp, and a sphere about the lamp stays one.
No key follows an invalid value.  In the text of a scene, each key can still be set alone.

`impossible_choices` tries the choices of a form and returns those that the scene cannot have, with the reasons.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from typing import Any

from bstcad.app.dome_offer import BACK_KIND, changes_of_kind, rounded
from bstcad.app.form import LOCKED_SIDES, form
from bstcad.app.kinds import are_numbers, extent, lamp_z, table_at, value_at
from bstcad.app.scene_text import changed, is_same, tables
from bstcad.app.words import typed
from bstcad.runs.files import SentenceError

SHAPES = {"lens.outline": "source.aperture"}  # table of an outline: table that follows it while the two are equal
BACK_PLANE = "lens.back.z"  # key of the plane from which targets keep their distance
FRONT_Z, FRONT_CURVATURE = "lens.front.z", "lens.front.curvature"  # keys that a sphere about the lamp changes together
CENTRE_TOLERANCE = 1e-6  # largest distance of the lamp from the centre of a sphere about it / radius of the sphere
WIDTHS = {  # keys that a profile needs, by (kind of the source, profile)
    ("collimated", "gaussian"): ("radius_1e2",),
    ("collimated", "super_gaussian"): ("radius_1e2", "order"),
    ("collimated", "annular"): ("inner_radius",),
    ("point", "gaussian"): ("half_angle_1e2",),
    ("point", "uniform"): ("half_angle",),
}
PAIRS = ("radius_1e2", "half_angle_1e2", "divergence")  # keys of a source that may have two values, which rotate turns
ORDER, DARK_CENTRE = 10.0, 0.25  # order of a super-Gaussian, and radius of a dark centre / lens width, when chosen
PICTURE_KEYS = ("rotate", "fit", "seen_from", "sample")  # keys whose choices are not tried: each try reads a photo


def take_change(
    text: str, key: str, value: Any, *, is_valid: Callable[[str], bool], valid_text: str | None = None,
    locked: bool = False,
) -> tuple[str, tuple[str, ...]]:  # fmt: skip
    """Return the text of a scene with another value of a key, and the other keys that changed with it.

    is_valid: returns True for the text of a valid scene; keys follow only if the resulting scene is valid.
    valid_text: the latest valid text, from which followers are computed, so that an invalid value in between does not
    affect them; None: the text itself.  locked: see `with_followers`.
    """
    alone = changed(text, key, value)
    now = tables(text)
    before = now if valid_text is None else tables(valid_text)
    of_an_aperture = key == "lens.outline.shape" and table_at("source.aperture", before)  # needs the same shape
    aperture = {"source.aperture.shape": value} if of_an_aperture else {}
    for changes in (with_followers(before, key, value, locked=locked), aperture):
        others = {other: own for other, own in changes.items() if other != key}
        if not others or not all(is_same(value_at(other, before), value_at(other, now)) for other in others):
            continue  # a key that would follow has changed since the latest valid scene
        try:
            together = alone
            for other, own in others.items():
                if isinstance(own, dict) and table_at(other, now):  # a comment on the old table must not stay
                    together = changed(together, other, None)
                together = changed(together, other, own)
        except SentenceError:
            continue
        if is_valid(together):
            return together, tuple(other for other in others if not is_same(value_at(other, now), others[other]))
        if is_valid(alone):
            break
    return alone, ()


def with_followers(data: Mapping[str, Any], key: str, value: Any, locked: bool = False) -> dict[str, Any]:
    """Return the change of a key in the tables of a scene, and all changes that follow from it, by key.

    locked: the other side of a target or an outline keeps its ratio to the changed side.
    """
    changes = {key: value} | (_other_side(data, key, value) if locked else {})
    for leader, follower in SHAPES.items():
        for each, own in [*changes.items()]:
            table, name = each.rpartition(".")[::2]
            if table == leader and value_at(leader, data) == value_at(follower, data) is not None:
                changes[f"{follower}.{name}"] = copy.deepcopy(own)
    if key == BACK_PLANE and are_numbers(value) and are_numbers(before := value_at(key, data)):
        targets = data.get("target")
        names = [f"target[{k}].z" for k in range(len(targets))] if isinstance(targets, list) else ["target.z"]
        changes |= {name: rounded(z + value - before) for name in names if are_numbers(z := value_at(name, data))}
    if key in (FRONT_Z, FRONT_CURVATURE):
        return changes | _sphere_about_lamp(data, key, value)
    if key == BACK_KIND:
        return changes | changes_of_kind(data, value)
    return changes | (_profile_widths(data, value) if key == "source.profile" else {})


def _sphere_about_lamp(data: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """Return the change that keeps the lamp in the centre of a front: z + 1 / c = z of the lamp; {} for other fronts.

    key: FRONT_Z or FRONT_CURVATURE, of which the other one changes.
    """
    lamp, z, curvature = lamp_z(data), value_at(FRONT_Z, data), value_at(FRONT_CURVATURE, data)
    is_sphere = value_at("lens.front.kind", data) == "sphere" and are_numbers(lamp, z, curvature, value)
    if not (is_sphere and abs(1 + curvature * (z - lamp)) < CENTRE_TOLERANCE):
        return {}
    if key == FRONT_Z:
        return {FRONT_CURVATURE: -1 / (value - lamp)} if value > lamp else {}
    return {FRONT_Z: rounded(lamp - 1 / value)} if value < 0 else {}


def _other_side(data: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """Return {key: value} of the other side, in its ratio to the changed side; {} if a length is missing or invalid."""
    parent, _, name = key.rpartition(".")
    other = f"{parent}.{LOCKED_SIDES.get(name, '')}"
    was, its = value_at(key, data), value_at(other, data)
    if are_numbers(value, was, its) and was and value > 0:
        return {other: rounded(its * value / was)}
    if not (_is_range(value) and _is_range(was) and _is_range(its)):
        return {}
    ratio, middle = (value[1] - value[0]) / (was[1] - was[0]), (its[0] + its[1]) / 2
    return {other: [rounded(middle + ratio * (end - middle)) for end in its]}


def _profile_widths(data: Mapping[str, Any], profile: Any) -> dict[str, Any]:
    """Return the changes for a beam with another profile: a missing width fills the lens, other widths are removed."""
    source = table_at("source", data)
    kind = source.get("kind")
    wanted = WIDTHS.get((kind, profile), ()) if isinstance(profile, str) else ()
    known = {name for (of, _), names in WIDTHS.items() if of == kind for name in names}
    changes: dict[str, Any] = {f"source.{name}": None for name in sorted(known - {*wanted}) if name in source}
    pairs = (name for name in PAIRS if isinstance(source.get(name), list) and f"source.{name}" not in changes)
    if "rotate" in source and not any(pairs):
        changes["source.rotate"] = None
    for name in wanted:
        if name not in source and (made := _width(data, source, name)) is not None:
            changes[f"source.{name}"] = made
    return changes


def _width(data: Mapping[str, Any], source: Mapping[str, Any], name: str) -> float | None:
    """Return the beam width that fills the lens: radius (mm) or half angle to the corners (degrees); None: unknown."""
    if name == "order":
        return ORDER
    sizes = extent(table_at("lens.outline", data))
    if sizes is None:
        return None
    if name == "radius_1e2":
        return max(sizes) / 2
    if name == "inner_radius":
        return rounded(DARK_CENTRE * min(sizes) / 2)
    position, front = source.get("position"), value_at("lens.front.z", data)
    start = position[-1] if isinstance(position, list) and position else 0.0
    if not are_numbers(start, front) or front == start:
        return None
    return round(math.degrees(math.atan(math.hypot(*sizes) / 2 / abs(front - start))), 1)


def _is_range(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) == 2 and are_numbers(*value) and value[1] > value[0]


# ---- choices that a scene cannot have --------------------------------------------------------------------------------


def impossible_choices(text: str, fault: Callable[[str], str | None]) -> dict[str, dict[str, str]]:
    """Return, by key and choice, the reason why the scene with this choice is refused; {} for an invalid scene.

    fault: returns the sentence that refuses the scene of a text; None for a valid one.
    """
    if fault(text) is not None:
        return {}
    found: dict[str, dict[str, str]] = {}
    for field in form(tables(text)).fields():
        if field.control != "choice" or field.key.rpartition(".")[2] in PICTURE_KEYS:
            continue
        for choice in field.choices:
            if choice != field.value and (why := _refusal(text, field.key, choice, fault)) is not None:
                found.setdefault(field.key, {})[choice] = why
    return found


def _refusal(text: str, key: str, choice: str, fault: Callable[[str], str | None]) -> str | None:
    """Return the sentence that refuses a scene with another choice, or None.  fault: see `impossible_choices`."""
    try:
        value = typed(key, choice, tables(text))
        return fault(take_change(text, key, value, is_valid=lambda each: fault(each) is None)[0])
    except SentenceError as refusal:
        return str(refusal)
