"""The statements of a STEP file about its part besides the shape: area, volume, centroid, material, profile tolerances.

Found by the names of "Recommended Practices for Geometric and Assembly Validation Properties" of the CAx
Interoperability Forum.  A file may hold any of them, or none.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bstcad.runs.files import one_line

VALIDATION, MATERIAL = "geometric validation property", "material property"
PREFIXES = {"$": 1.0, ".MICRO.": 1e-6, ".MILLI.": 1e-3, ".CENTI.": 1e-2, ".DECI.": 1e-1, ".KILO.": 1e3}
UNITS = {"METRE": 1e3, "GRAM": 1.0}  # mm, g
PER_CM3 = 1e3  # g/mm³ in g/cm³
UNKNOWN = math.nan  # a number that cannot be read, or in no unit of these: a check of it fails
NUMBER = r"[-+]?\d+(?:\.\d*(?:E[-+]?\d+)?)?"


@dataclass(frozen=True)
class Profile:
    """A profile tolerance of a surface."""

    width: float  # of its zone (mm)
    surface: str  # entity of the surface under the toleranced face; "": the file refers to it in another way
    face: str = ""  # the name of that face


@dataclass(frozen=True)
class ValidationProperties:
    """Each property as often as the file states it; (): it does not."""

    areas: tuple[float, ...] = ()  # of the part's whole surface (mm²)
    volumes: tuple[float, ...] = ()  # mm³
    centroids: tuple[tuple[float, float, float], ...] = ()  # mm, if the file is in mm
    materials: tuple[str, ...] = ()
    densities: tuple[float, ...] = ()  # g/cm³
    profiles: tuple[Profile, ...] = ()

    @property
    def of_shape(self) -> bool:
        """Does the file state area, volume or centroid?"""
        return bool(self.areas or self.volumes or self.centroids)


@dataclass(frozen=True)
class Statements:
    """The entities of a STEP file but points in space, by the digits of their numbers."""

    bodies: Mapping[str, tuple[str, str]]  # (kind, attributes without blanks); a complex entity's kind is COMPLEX
    strings: Sequence[str]  # 'k' in the attributes is string k, as the file has it

    def of(self, kind: str) -> dict[str, str]:
        """The attributes of the entities of a kind."""
        return {number: body for number, (its, body) in self.bodies.items() if its == kind}

    def references(self, number: str) -> list[str]:
        """The entities that an entity refers to, in order."""
        return re.findall(r"#(\d+)", self.bodies[number][1])

    def string(self, number: str, place: int) -> str:
        """The first or second attribute of an entity as a string in one line; "" if it is none."""
        attributes = re.match(r"\((?:'(\d*)')?(?:,'(\d*)')?", self.bodies[number][1]).groups()
        return decoded(self.strings[int(attributes[place])]) if attributes[place] else ""


def decoded(string: str) -> str:
    """A string of Part 21, without its quotes, as it is meant: escapes resolved, in one line."""
    string = re.sub(r"[\r\n]", "", string).replace("''", "'")
    string = re.sub(
        r"\\X2\\((?:[0-9A-F]{4})*)\\X0\\",
        lambda hit: bytes.fromhex(hit.group(1)).decode("utf-16-be", "replace"),
        string,
    )
    return one_line(re.sub(r"\\X\\([0-9A-F]{2})", lambda hit: chr(int(hit.group(1), 16)), string))


def read(statements: Statements, points: Callable[[np.ndarray], np.ndarray]) -> ValidationProperties:
    """The properties in a file; points: coordinates by numbers.  A number that cannot be made out is nan."""
    items: dict[tuple[str, str], list[str]] = {}  # (kind of property, its name) -> first items of its representations
    for body in statements.of("PROPERTY_DEFINITION_REPRESENTATION").values():
        definition, representation = re.fullmatch(r"\(#(\d+),#(\d+)\)", body).groups()
        kind, name = (statements.string(each, 0) for each in (definition, representation))
        if kind == MATERIAL or (kind == VALIDATION and _is_of_part(statements, definition)):
            items.setdefault((kind, name), []).extend(statements.references(representation)[:1])

    def measures(kind: str, name: str, measure: str) -> tuple[float, ...]:
        return tuple(_measure(statements, item, measure) for item in items.get((kind, name), []))

    return ValidationProperties(
        areas=measures(VALIDATION, "surface area", "AREA_MEASURE"),
        volumes=measures(VALIDATION, "volume", "VOLUME_MEASURE"),
        centroids=tuple(_centroid(item, points) for item in items.get((VALIDATION, "centroid"), [])),
        materials=tuple(statements.string(item, 1) for item in items.get((MATERIAL, "material name"), [])),
        densities=tuple(PER_CM3 * value for value in measures(MATERIAL, "density", r"\w+_MEASURE")),
        profiles=tuple(_profiles(statements)),
    )


def _is_of_part(statements: Statements, definition: str) -> bool:
    """Is a property that of the whole part, not of a face or of an assembly's instance?"""
    target = statements.references(definition)[-1]
    return statements.bodies.get(target, ("",))[0] == "PRODUCT_DEFINITION_SHAPE"


def _measure(statements: Statements, item: str, kind: str) -> float:
    """The number of a measure, in mm and g to the powers of its unit."""
    value = re.search(rf"{kind}\(({NUMBER})\),#(\d+)", statements.bodies.get(item, ("", ""))[1])
    return float(value[1]) * _scale(statements, value[2]) if value else UNKNOWN


def _centroid(item: str, points: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float, float]:
    try:
        x, y, z = points(np.array([item], dtype=np.int64))[0].tolist()
    except KeyError:
        return UNKNOWN, UNKNOWN, UNKNOWN
    return x, y, z


def _scale(statements: Statements, unit: str) -> float:
    """A unit in mm and g, to its powers."""
    if (size := _size(statements, unit)) is not None:
        return size
    scale = 1.0
    for element in statements.references(unit):
        kind, body = statements.bodies[element]
        factor = re.fullmatch(rf"\(#(\d+),({NUMBER})\)", body)
        size = _size(statements, factor[1]) if factor and kind == "DERIVED_UNIT_ELEMENT" else None
        if size is None:
            return UNKNOWN
        scale *= size ** float(factor[2])
    return scale


def _size(statements: Statements, unit: str) -> float | None:
    """A named unit of length in mm, of mass in g; None: it has no SI_UNIT."""
    named = re.search(r"SI_UNIT\((\.\w+\.|\$),\.(\w+)\.\)", statements.bodies[unit][1])
    return PREFIXES.get(named[1], UNKNOWN) * UNITS.get(named[2], UNKNOWN) if named else None


def _profiles(statements: Statements) -> Iterator[Profile]:
    """The profile tolerances of surfaces."""
    kind = "SURFACE_PROFILE_TOLERANCE"
    compound = (body for body in statements.of("COMPLEX").values() if f"{kind}(" in body)
    for body in (*statements.of(kind).values(), *compound):
        tolerance = re.search(r"\('\d*',(?:'\d*'|\$),#(\d+),#(\d+)", body)
        if tolerance is None:
            yield Profile(UNKNOWN, "")
        else:
            yield Profile(_measure(statements, tolerance[1], "LENGTH_MEASURE"), *_face(statements, tolerance[2]))


def _face(statements: Statements, aspect: str) -> tuple[str, str]:
    """(surface, name) of the one face that an aspect of the shape is; ("", "") if the file tells it in another way."""
    usages = map(statements.references, statements.of("GEOMETRIC_ITEM_SPECIFIC_USAGE"))
    faces = {names[-1] for names in usages if names[0] == aspect}
    if len(faces) != 1 or statements.bodies.get(face := faces.pop(), ("",))[0] != "ADVANCED_FACE":
        return "", ""
    return statements.references(face)[-1], statements.string(face, 0)
