"""What a STEP file states of its part besides the shape: area, volume, centroid, material, density, a tolerance.

Each is found by the names of "Recommended Practices for Geometric and Assembly Validation Properties" of the CAx
Interoperability Forum.  A file may state any of them, or none.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from bstcad.step_text import strings
from bstcad.step_text.entities import Entities
from bstcad.step_text.syntax import NUMBER, Points, Statements

VALIDATION, MATERIAL = "geometric validation property", "material property"
PREFIXES = {"$": 1.0, ".MICRO.": 1e-6, ".MILLI.": 1e-3, ".CENTI.": 1e-2, ".DECI.": 1e-1, ".KILO.": 1e3}
UNITS = {"METRE": 1e3, "GRAM": 1.0}  # mm, g
PER_CM3 = 1e3  # g/mm³ in g/cm³
UNKNOWN = math.nan  # of a number that cannot be read, or whose unit is none of these: whoever judges it fails it


@dataclass(frozen=True)
class Profile:
    """A profile tolerance of a surface."""

    width: float  # of its zone (mm)
    surface: str  # the surface of the face that it is for, by its entity's number; "": the file says it otherwise
    face: str = ""  # the name of that face


@dataclass(frozen=True)
class Stated:
    """What is stated, as often as it is stated; (): it is not."""

    areas: tuple[float, ...] = ()  # of the part's whole surface (mm²)
    volumes: tuple[float, ...] = ()  # mm³
    centroids: tuple[tuple[float, float, float], ...] = ()  # mm, if the file is in mm
    materials: tuple[str, ...] = ()
    densities: tuple[float, ...] = ()  # g/cm³
    profiles: tuple[Profile, ...] = ()


def read(text: str, statements: Statements, points: Points) -> Stated:
    """What the file of this text states; a number that cannot be made out is nan."""
    faces = {number: said[0] for number, said in strings.of_kind("ADVANCED_FACE", text, statements).items()}
    file = _File(Entities(statements, points), points, faces)
    names = {kind: strings.of_kind(kind, text, statements) for kind in (
        "PROPERTY_DEFINITION", "REPRESENTATION", "DESCRIPTIVE_REPRESENTATION_ITEM",
    )}  # fmt: skip
    found: dict[tuple[str, str], list[str]] = {}  # (kind of property, what) -> the items that say it
    for both in file.entities.of("PROPERTY_DEFINITION_REPRESENTATION"):
        definition, representation = (*file.entities.names(both), "", "")[:2]
        kind, _ = names["PROPERTY_DEFINITION"].get(definition, ("", ""))
        what, _ = names["REPRESENTATION"].get(representation, ("", ""))
        if what and (kind != VALIDATION or file.is_of_the_part(definition)):
            found.setdefault((kind, what), []).extend(file.entities.names(representation)[:1])
    materials = found.get((MATERIAL, "material name"), [])
    return Stated(
        tuple(file.measure("AREA_MEASURE", item) for item in found.get((VALIDATION, "surface area"), [])),
        tuple(file.measure("VOLUME_MEASURE", item) for item in found.get((VALIDATION, "volume"), [])),
        tuple(file.point(item) for item in found.get((VALIDATION, "centroid"), [])),
        tuple(names["DESCRIPTIVE_REPRESENTATION_ITEM"].get(item, ("", ""))[1] for item in materials),
        tuple(PER_CM3 * file.measure(r"\w+_MEASURE", item) for item in found.get((MATERIAL, "density"), [])),
        tuple(file.profiles()),
    )


@dataclass(frozen=True)
class _File:
    entities: Entities
    space: Points
    faces: Mapping[str, str]  # number of a face: its name

    def is_of_the_part(self, definition: str) -> bool:
        """Is a property that of the whole part, not of one of its faces or of an assembly's instance?"""
        target = self.entities.names(definition)[-1:]
        return bool(target) and self.entities.kind(target[0]) == "PRODUCT_DEFINITION_SHAPE"

    def measure(self, kind: str, item: str) -> float:
        """The number of a measure of some kind, in mm and g to the powers of its unit."""
        if item in self.space.names:
            return UNKNOWN
        body = self.entities.attributes(item)
        value = re.search(rf"{kind}\(({NUMBER})\),#(\d+)", body)
        return float(value[1]) * self._scale(value[2]) if value else UNKNOWN

    def point(self, item: str) -> tuple[float, float, float]:
        if item not in self.space.names:
            return UNKNOWN, UNKNOWN, UNKNOWN
        x, y, z = self.entities.points([item])[0].tolist()
        return x, y, z

    def profiles(self) -> Iterator[Profile]:
        """The profile tolerances of surfaces."""
        for tolerance in self.entities.of("SURFACE_PROFILE_TOLERANCE", "COMPLEX"):
            body = self.entities.attributes(tolerance)
            if self.entities.kind(tolerance) == "COMPLEX" and "SURFACE_PROFILE_TOLERANCE(" not in body:
                continue
            said = re.search(r"\('',(?:''|\$),#(\d+),#(\d+)", body)
            if said is None:
                yield Profile(UNKNOWN, "")
            else:
                yield Profile(self.measure("LENGTH_MEASURE", said[1]), *self._surface(said[2]))

    def _surface(self, aspect: str) -> tuple[str, str]:
        """(surface, name) of the one face that an aspect of the shape is; ("", "") if it is said in another way."""
        usages = (self.entities.names(name) for name in self.entities.of("GEOMETRIC_ITEM_SPECIFIC_USAGE"))
        faces = {names[-1] for names in usages if names[0] == aspect}
        if len(faces) != 1 or self.entities.kind(face := faces.pop()) != "ADVANCED_FACE":
            return "", ""
        return self.entities.names(face)[-1], self.faces.get(face, "")

    def _scale(self, unit: str) -> float:
        """What a unit is in mm and g, to its powers."""
        if (size := self._size(unit)) is not None:
            return size
        scale = 1.0
        for element in self.entities.names(unit):
            parts, powers = self.entities.names(element), self.entities.numbers(element)
            size = self._size(parts[0]) if len(parts) == len(powers) == 1 else None
            if size is None or self.entities.kind(element) != "DERIVED_UNIT_ELEMENT":
                return UNKNOWN
            scale *= size ** float(powers[0])
        return scale

    def _size(self, unit: str) -> float | None:
        """A named unit of length in mm, of mass in g; None: it is none."""
        said = re.search(r"SI_UNIT\((\.\w+\.|\$),\.(\w+)\.\)", self.entities.attributes(unit))
        return PREFIXES.get(said[1], UNKNOWN) * UNITS.get(said[2], UNKNOWN) if said else None
