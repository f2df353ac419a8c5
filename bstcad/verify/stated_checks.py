"""What a STEP file states of its part, held to the shape in the same file and to the scene.

Whoever opens the file takes a volume, a material or a tolerance from there without asking.  What a file does not state,
such as one by another program, is said and not judged.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from bstcad.cad.mass_properties import MassProperties
from bstcad.optics.outlines import Outline
from bstcad.scene.part import Part
from bstcad.step_text.part21 import StepText
from bstcad.step_text.validation_properties import ValidationProperties
from bstcad.verify.verdict import Check

TEXT = "STEP text"
DENSITY = f"{TEXT}: stated density"  # of a file by itself: no scene says what it should be
AGREE = 1e-6  # of area, volume and the part's size; the quadrature of a rough back leaves some 1e-8
DIGITS = 1e-12  # mm or g/cm³; more than the text leaves of a number

Numbers = tuple[float, ...]


def measures(
    stated: ValidationProperties, found: MassProperties | None, outline: Outline, name: str = TEXT
) -> Iterator[Check]:
    """The validation properties against those of the shape, which may be None if there are none to be held to it.

    outline: of the lens, for its size.
    """
    if not stated.of_shape:
        yield from _absent(name, {"area": (), "volume": (), "centroid": ()})
        return
    for what, unit, all_said, own in (
        ("area", "mm²", stated.areas, found.area),
        ("volume", "mm³", stated.volumes, found.volume),
    ):
        if all_said:
            off, said = _worst([(value,) for value in all_said], (own,))
            where = _apart(said, "its faces give", (own,), unit)
            yield Check.at_most(f"{name}: stated {what} against the faces', relative", off / own, AGREE, "", where)
    if stated.centroids:
        off, said = _worst(stated.centroids, found.centroid)
        where, size = _apart(said, "its faces give", found.centroid, "mm"), 2 * math.hypot(*outline.half_extent)
        yield Check.at_most(f"{name}: stated centroid against the faces'", off, AGREE * size, "mm", where)
    yield from _absent(name, {"area": stated.areas, "volume": stated.volumes, "centroid": stated.centroids})


def density(stated: ValidationProperties) -> Iterator[Check]:
    """The density (g/cm³) of a file by itself, as often as it is stated: it has to be a number above zero."""
    for value in stated.densities:
        yield Check(DENSITY, value if value > 0 else None, None, "g/cm³", value > 0)


def of_part(text: StepText, part: Part, name: str = TEXT) -> Iterator[Check]:
    """Material, density and the profile tolerances of back and front against what the scene says of the part."""
    stated = text.properties
    fronts = [each for each in stated.profiles if part.front_profile is not None and each.face == "front"]
    backs = [each for each in stated.profiles if each not in fronts]
    widths, of_front = [each.width for each in backs], [each.width for each in fronts]
    for what, unit, all_said, asked in (
        ("profile tolerance", "mm", widths, part.surface_profile),
        ("profile tolerance of the front", "mm", of_front, part.front_profile),
        ("density", "g/cm³", stated.densities, part.density),
    ):
        if all_said and asked is None:
            yield Check.true(f"{name}: {what} is the scene's", False, _apart((all_said[0],), "the scene", (), unit))
        elif all_said:
            off, said = _worst([(value,) for value in all_said], (asked,))
            where = _apart(said, "the scene", (asked,), unit)
            yield Check.at_most(f"{name}: {what}, difference from the scene's", off, DIGITS, unit, where)
    if backs:
        strange = {profile.surface for profile in backs} - {"", text.surface.entity}
        where = f"it is of the surface #{min(strange)}, the back is #{text.surface.entity}" if strange else ""
        yield Check.true(f"{name}: profile tolerance is of the back", not strange, where)
    if fronts:
        strange = text.surface.entity in {profile.surface for profile in fronts}
        where = f"it is of the surface #{text.surface.entity}, which is the back" if strange else ""
        yield Check.true(f"{name}: profile tolerance of the front is not of the back", not strange, where)
    if stated.materials:
        wrong = [said for said in stated.materials if said != part.material]
        where = f"the file states {wrong[0]!r}, the scene {part.material!r}" if wrong else ""
        yield Check.true(f"{name}: material is the scene's", not wrong, where)
    asked = {"profile tolerance": part.surface_profile, "profile tolerance of the front": part.front_profile,
             "material": part.material, "density": part.density}  # fmt: skip
    said = {"profile tolerance": widths, "profile tolerance of the front": of_front, "material": stated.materials,
            "density": stated.densities}  # fmt: skip
    yield from _absent(name, {what: said[what] for what, value in asked.items() if value is not None})


def _worst(all_said: Sequence[Numbers], own: Numbers) -> tuple[float, Numbers]:
    """(how far off, what is stated) of the worst; what cannot be read is off without end."""
    off = [math.dist(said, own) for said in all_said]
    return max((math.inf if math.isnan(by) else by, said) for by, said in zip(off, all_said, strict=True))


def _apart(said: Numbers, who: str, own: Numbers, unit: str) -> str:
    return f"the file states {_words(said, unit)}, {who} {_words(own, unit)}"


def _words(values: Numbers, unit: str) -> str:
    if not values or any(map(math.isnan, values)):
        return "a number that cannot be read" if values else "none"
    said = ", ".join(f"{value:.9g}" for value in values)
    return f"({said}) {unit}" if len(values) > 1 else f"{said} {unit}"


def _absent(name: str, said: dict[str, Sequence]) -> Iterator[Check]:
    """What is missing in the file: told, not judged."""
    if missing := [what for what, values in said.items() if not values]:
        yield Check(f"{name}: states {', '.join(missing)}", False, None, "", True)
