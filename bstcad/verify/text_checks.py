"""Checks of the text of a STEP file, read by a parser that is not OCC, against the design and the shape in the file.

Whoever opens the file takes a volume, a material or a tolerance from its text without asking.  A statement that a file
lacks, such as one by another program, is told and not judged.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from bstcad.cad.mass_properties import MassProperties
from bstcad.optics.bspline import knots
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.scene.mount import Part
from bstcad.step_text.part21 import FreeformSurface, StepText
from bstcad.step_text.validation_properties import ValidationProperties
from bstcad.verify.verdict import Check

TEXT = "STEP text"
DENSITY = f"{TEXT}: stated density"  # of a file by itself: no scene says what it should be
NET = 1e-11  # mm; rounding of a control point to sixteen digits of text
AGREE = 1e-6  # of area, volume and the part's size; the sums over a rough back leave some 1e-9
DIGITS = 1e-12  # mm or g/cm³; more than the text leaves of a number

Numbers = tuple[float, ...]


def structure(text: StepText, m: int) -> list[Check]:
    """Structure of the STEP file, read without OCC."""
    faces = [(text.surface, m)] + ([(text.front, len(text.front.control_points))] if text.front else [])
    plain = all(_plain(surface, points) for surface, points in faces)
    degrees = ", ".join(
        "rational, " * surface.rational + f"degree {surface.degrees[0]} x {surface.degrees[1]}" for surface, _ in faces
    )
    moved, knot = max(
        (off_by(full, knots(points), "")[0], off_by(values, np.arange(points - 1.0), f"in {axis}: knot")[1])
        for surface, points in faces
        for axis, full, values in zip("uv", surface.full_knots, surface.knots, strict=True)
    )
    units = f"{text.solids} solids, lengths in {text.unit}"
    return [
        Check.true("STEP text: one solid, in millimetres", text.solids == 1 and text.unit == "millimetre", units),
        Check.true("STEP text: every edge used twice, once each way", text.closed, _open_edge(text)),
        Check.true("STEP text: degree 2 x 2, multiplicities 3, 1, …, 1, 3", plain, degrees),
        Check.at_most("STEP text: knots", moved, 0.0, where=knot),
    ]


def _plain(surface: FreeformSurface, m: int) -> bool:
    """Is it an open surface of degree 2 x 2 with simple inner knots, and not rational?"""
    ones = np.array([3, *[1] * (m - 3), 3])
    simple = all(np.array_equal(counts, ones) for counts in surface.multiplicities)
    open_ = surface.closed == (False, False) and not surface.self_intersecting
    return surface.degrees == (2, 2) and not surface.rational and simple and open_


def _open_edge(text: StepText) -> str:
    """The first edge that is not used once each way."""
    uses = ((name, there, back) for name, (there, back) in text.edge_uses.items() if (there, back) != (1, 1))
    return next((f"edge #{n}: {there} times forwards, {back} times back" for n, there, back in uses), "no edge")


def of_lens(text: StepText, lens: Lens) -> list[Check]:
    """The STEP file as text, held to the design."""
    off, where = off_by(text.surface.control_points, lens.back.control_points(), "control point")
    checks = [*structure(text, lens.back.m), Check.at_most("STEP text: control points", off, NET, "mm", where)]
    if text.front is not None and lens.front.curvature is None:
        off, where = off_by(text.front.control_points, lens.front.control_points(), "control point")
        checks.append(Check.at_most("STEP text: control points of the front", off, NET, "mm", where))
    return checks


def off_by(read: np.ndarray, designed: np.ndarray, name: str) -> tuple[float, str]:
    """(largest absolute difference, where that is); infinite if the shapes differ."""
    if read.shape != designed.shape:
        return float("inf"), f"{name}s: {' x '.join(map(str, read.shape))}, not {' x '.join(map(str, designed.shape))}"
    distance = np.abs(read - designed)
    place = [int(i) for i in np.unravel_index(distance.argmax(), distance.shape)]
    return float(distance.max()), f"{name} {place[0] if len(place) == 1 else tuple(place[:2])}"


# ---- validation properties -----------------------------------------------------------------------------------------


def measures(
    stated: ValidationProperties, shape: MassProperties | None, outline: Outline, name: str = TEXT
) -> Iterator[Check]:
    """The validation properties against those of the shape, which may be None if there are none to be held to it.

    outline: of the lens, for its size.
    """
    if not stated.of_shape:
        yield from _absent(name, {"area": (), "volume": (), "centroid": ()})
        return
    for what, unit, values, own in (
        ("area", "mm²", stated.areas, shape.area),
        ("volume", "mm³", stated.volumes, shape.volume),
    ):
        if values:
            off, said = _worst([(value,) for value in values], (own,))
            where = _difference(said, "its faces give", (own,), unit)
            yield Check.at_most(f"{name}: stated {what} against the faces', relative", off / own, AGREE, "", where)
    if stated.centroids:
        off, said = _worst(stated.centroids, shape.centroid)
        where, size = _difference(said, "its faces give", shape.centroid, "mm"), 2 * math.hypot(*outline.half_extent)
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
    for what, unit, values, asked in (
        ("profile tolerance", "mm", widths, part.surface_profile),
        ("profile tolerance of the front", "mm", of_front, part.front_profile),
        ("density", "g/cm³", stated.densities, part.density),
    ):
        if values and asked is None:
            yield Check.true(f"{name}: {what} is the scene's", False, _difference((values[0],), "the scene", (), unit))
        elif values:
            off, said = _worst([(value,) for value in values], (asked,))
            where = _difference(said, "the scene", (asked,), unit)
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


def _worst(values: Sequence[Numbers], own: Numbers) -> tuple[float, Numbers]:
    """(how far off, what is stated) of the worst; what cannot be read is off without end."""
    off = [math.dist(said, own) for said in values]
    return max((math.inf if math.isnan(by) else by, said) for by, said in zip(off, values, strict=True))


def _difference(said: Numbers, who: str, own: Numbers, unit: str) -> str:
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
