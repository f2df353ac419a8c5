"""Checks of the text of a STEP file, read by a parser that is not OCC, against the design and the shape in the file.

Whoever opens the file takes a volume, a material or a tolerance from its text without asking.  A statement that a file
lacks, such as one by another program, is told and not judged.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from bstcad.optics.bspline import knots
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.quadrature import MassProperties
from bstcad.scene.mount import Part
from bstcad.step_text.part21 import FreeformSurface, StepText, ValidationProperties
from bstcad.verify.verdict import Check

TEXT = "STEP text"
NET = 1e-11  # mm; rounding of a control point to sixteen digits of text
ROUNDINGS = 2e-15  # rounding, as a part of the largest coordinate; over 5 m from the file's origin it exceeds NET
AGREE = 1e-6  # of area, volume and the part's size; the sums over a rough back leave some 1e-9
DIGITS = 1e-12  # mm or g/cm³; more than the text leaves of a number

Numbers = tuple[float, ...]


def of_lens(text: StepText, lens: Lens) -> list[Check]:
    """The STEP file as text, held to the design."""
    checks = structure(text, lens.back.shape)
    name, back = f"{TEXT}: control points", lens.back.control_points()
    checks.append(net_check(name, text.surface.control_points, back, id="control-points"))
    if lens.front.is_net and (text.front is not None or lens.shapes("front")):
        name, front = f"{TEXT}: control points of the front", lens.front.control_points()
        checks.append(net_check(name, net_of_front(text), front, id="control-points"))
    return checks


def net_of_front(text: StepText) -> np.ndarray:
    """The control points (m, n, 3) of the front that a file holds, in mm; none of a front that is no net."""
    return np.empty((0, 0, 3)) if text.front is None else text.front.control_points


def structure(text: StepText, shape: tuple[int, int], name: str = TEXT, any_unit: bool = False) -> list[Check]:
    """Structure of the STEP file: solids, unit, edges, and the form and knots of its freeform faces.

    shape: numbers of control points of the back along x and along y.  any_unit: of length, as other programs write.
    """
    faces = [(text.surface, shape)] + ([(text.front, text.front.control_points.shape[:2])] if text.front else [])
    plain = all(_is_plain(surface, sides) for surface, sides in faces)
    degrees = ", ".join(f"degree {surface.degrees[0]} x {surface.degrees[1]}" for surface, _ in faces)
    moved, knot = max(
        (_off_by(full, knots(points), "")[0], _off_by(values, np.arange(points - 1.0), f"in {axis}: knot")[1])
        for surface, sides in faces
        for axis, full, values, points in zip("uv", surface.full_knots, surface.knots, sides, strict=True)
    )
    units = f"{text.solids} solids, lengths in {text.unit}"
    return [
        Check.true(
            f"{name}: one solid{'' if any_unit else ', in millimetres'}",
            text.solids == 1 and (any_unit or text.unit == "millimetre"),
            units,
            id="one-solid",
        ),
        Check.true(f"{name}: every edge used twice, once each way", text.closed, _open_edge(text), id="edges-twice"),
        Check.true(f"{name}: degree 2 x 2, multiplicities 3, 1, …, 1, 3", plain, degrees, id="degree"),
        Check.at_most(f"{name}: knots", moved, 0.0, where=knot, id="knots"),
    ]


def _is_plain(surface: FreeformSurface, shape: tuple[int, int]) -> bool:
    """Is it an open surface of degree 2 x 2 with simple inner knots?"""
    pairs = zip(surface.multiplicities, shape, strict=True)
    simple = all(np.array_equal(counts, [3, *[1] * (points - 3), 3]) for counts, points in pairs)
    return surface.degrees == (2, 2) and simple and not (any(surface.closed) or surface.self_intersecting)


def _open_edge(text: StepText) -> str:
    """The first edge that is not used once each way."""
    uses = ((name, there, back) for name, (there, back) in text.edge_uses.items() if (there, back) != (1, 1))
    return next((f"edge #{n}: {there} times forwards, {back} times back" for n, there, back in uses), "no edge")


def net_check(name: str, read: np.ndarray, designed: np.ndarray, *, id: str) -> Check:
    """The control points (m, n, 3) that a file holds against the designed ones (mm)."""
    off, where = _off_by(read, designed, "control point")
    farthest = float(np.abs(designed).max(initial=0.0))
    return Check.at_most(name, off, max(NET, ROUNDINGS * farthest), unit="mm", where=where, id=id)


def _off_by(read: np.ndarray, designed: np.ndarray, name: str) -> tuple[float, str]:
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
    """The validation properties against those of the shape, which may be None if the file states none.

    outline: of the lens, for its size.
    """
    all_stated = {"area": stated.areas, "volume": stated.volumes, "centroid": stated.centroids}
    for quantity, unit in (("area", "mm²"), ("volume", "mm³")):
        if values := all_stated[quantity]:
            own = getattr(shape, quantity)
            off, where = _worst([(value,) for value in values], (own,), "its faces give", unit)
            stated_by = f"{name}: stated {quantity} against the faces', relative"
            yield Check.at_most(stated_by, off / own, AGREE, where=where, id="stated-measures")
    if stated.centroids:
        off, where = _worst(stated.centroids, shape.centroid, "its faces give", "mm")
        size = 2 * math.hypot(*outline.half_extent)
        stated_by = f"{name}: stated centroid against the faces'"
        yield Check.at_most(stated_by, off, AGREE * size, unit="mm", where=where, id="stated-centroid")
    yield from _absent(name, all_stated)


def density(stated: ValidationProperties) -> Iterator[Check]:
    """The density (g/cm³) of a file by itself, as often as it is stated: it has to be a number above zero."""
    for value in stated.densities:
        known = value if value > 0 else None
        yield Check(f"{TEXT}: stated density", known, None, "g/cm³", passed=value > 0, id="stated-density")


def of_part(text: StepText, part: Part, name: str = TEXT) -> Iterator[Check]:
    """Material, density and the profile tolerances of back and front against those in the scene's [part]."""
    stated, back, profile = text.properties, text.surface.entity, "profile tolerance"
    fronts = [each for each in stated.profiles if part.front_profile is not None and each.face == "front"]
    backs = [each for each in stated.profiles if each not in fronts]
    numbers = {  # the quantity: (unit, stated values, the scene's)
        profile: ("mm", [each.width for each in backs], part.surface_profile),
        f"{profile} of the front": ("mm", [each.width for each in fronts], part.front_profile),
        "density": ("g/cm³", stated.densities, part.density),
    }
    for quantity, (unit, values, asked) in numbers.items():
        if values and asked is None:
            difference = f"the file states {_words((values[0],), unit)}, the scene none"
            yield Check.true(f"{name}: {quantity} is the scene's", False, difference, id="stated-values")
        elif values:
            off, where = _worst([(value,) for value in values], (asked,), "the scene", unit)
            apart = f"{name}: {quantity}, difference from the scene's"
            yield Check.at_most(apart, off, DIGITS, unit=unit, where=where, id="stated-values")
    if backs:
        strange = {each.surface for each in backs} - {"", back}
        where = f"it is of the surface #{min(strange)}, the back is #{back}" if strange else ""
        yield Check.true(f"{name}: {profile} is of the back", not strange, where, id="profile-face")
    if fronts:
        where = f"it is of the surface #{back}, which is the back"
        of_front = back not in {each.surface for each in fronts}
        yield Check.true(f"{name}: {profile} of the front is not of the back", of_front, where, id="profile-face")
    if stated.materials:
        wrong = [material for material in stated.materials if material != part.material]
        where = f"the file states {wrong[0]!r}, the scene {part.material!r}" if wrong else ""
        yield Check.true(f"{name}: material is the scene's", not wrong, where, id="material")
    asked_for = {quantity: values for quantity, (_, values, asked) in numbers.items() if asked is not None}
    yield from _absent(name, asked_for | ({} if part.material is None else {"material": stated.materials}))


def _worst(values: Sequence[Numbers], own: Numbers, who: str, unit: str) -> tuple[float, str]:
    """(how far off the worst of stated values is, the difference in words); an unreadable value is off without end."""
    off = [math.dist(each, own) for each in values]
    worst, stated = max((math.inf if math.isnan(by) else by, each) for by, each in zip(off, values, strict=True))
    return worst, f"the file states {_words(stated, unit)}, {who} {_words(own, unit)}"


def _words(values: Numbers, unit: str) -> str:
    if any(map(math.isnan, values)):
        return "a number that cannot be read"
    words = ", ".join(f"{value:.9g}" for value in values)
    return f"({words}) {unit}" if len(values) > 1 else f"{words} {unit}"


def _absent(name: str, stated: dict[str, Sequence]) -> Iterator[Check]:
    """Which statements the file lacks."""
    if missing := [quantity for quantity, values in stated.items() if not values]:
        yield Check(f"{name}: states {', '.join(missing)}", False, None, unit="", passed=True, id="not-stated")
