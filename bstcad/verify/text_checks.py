"""Checks of the text of a STEP file, read without OCC, against the design and the shape in the file.

A user of the file trusts the volume, the material and the tolerances that it states.  A missing statement, as in a
file of another program, is reported but not judged.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from bstcad.optics.lens.face_integrals import MassProperties
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK, FRONT, of_face
from bstcad.optics.surfaces.bspline import knots
from bstcad.optics.surfaces.outlines import Outline
from bstcad.scene.mount import Part
from bstcad.step_text.part21 import FreeformSurface, StepText, ValidationProperties
from bstcad.verify.verdict import Check

SOURCE = "STEP text"  # source of the checked values, at the beginning of the checks' names
NET_TOLERANCE = 1e-11  # absolute tolerance of control points (mm), larger than their rounding in the text
RELATIVE_ROUNDING = 2e-15  # relative tolerance of coordinates, larger than NET_TOLERANCE beyond 5 m from the origin
MIN_SCALE_ERROR = 1e-6  # smallest difference from 1 of a scale that is named
SCALED_ROUNDING = 1e-9  # largest rounding error of a scaled net, relative to its largest coordinate
MEASURE_TOLERANCE = 1e-6  # relative tolerance of area and volume, and of centroid / diagonal; integrals err by 1e-9
VALUE_TOLERANCE = 1e-12  # absolute tolerance of stated numbers (mm or g/cm³), more than their rounding in the text

Numbers = tuple[float, ...]


def lens_checks(text: StepText, lens: Lens) -> list[Check]:
    """Check the text of the STEP file against the design."""
    checks = structure_checks(text, lens.back_net.shape)
    name, back = f"{SOURCE}: deviation of the control points", lens.back_net.control_points()
    checks.append(net_check(name, text.surface.control_points, back, id="control-points"))
    if lens.front.is_net and (text.front is not None or lens.is_tailored(FRONT)):
        name, front = f"{SOURCE}: deviation of the control points of the front", lens.front_net.control_points()
        checks.append(net_check(name, net_of_front(text), front, id="control-points"))
    return checks


def check_size(text: StepText, lens: Lens, file: str) -> None:
    """Raise ValueError if the back in a file is the designed one at another scale, about any point.

    A lens and its light scale together, so that many checks would fail and none would name the scale.
    """
    read, designed = text.surface.control_points, lens.back_net.control_points()
    if read.shape != designed.shape:
        return
    read, designed = (net - net.mean(axis=(0, 1)) for net in (read, designed))
    scale = float((read * designed).sum() / (designed * designed).sum())
    size = float(np.abs(read).max())
    if abs(scale - 1) > MIN_SCALE_ERROR and np.abs(read - scale * designed).max() <= SCALED_ROUNDING * size:
        times = f"{scale:.6g} times"
        raise ValueError(
            f"{file}: it is {times} as large as the design, so that its picture stands at {times} the distance; "
            "export it without scaling, or generate the design again"
        )


def net_of_front(text: StepText) -> np.ndarray:
    """Return the control points (m, n, 3) of the front in a file, in mm; an empty array if the front is not a net."""
    return np.empty((0, 0, 3)) if text.front is None else text.front.control_points


def structure_checks(text: StepText, shape: tuple[int, int], name: str = SOURCE, any_unit: bool = False) -> list[Check]:
    """Check the structure of the STEP file: solids, unit, edges, and degree and knots of its freeform faces.

    shape: numbers of control points of the back along x and y.  any_unit: accept any unit of length.
    """
    faces = [(text.surface, shape)] + ([(text.front, text.front.control_points.shape[:2])] if text.front else [])
    plain = all(_is_plain(surface, sides) for surface, sides in faces)
    degrees = ", ".join(f"degree {surface.degrees[0]} x {surface.degrees[1]}" for surface, _ in faces)
    off, knot = max(
        (
            _largest_difference(full, knots(points), "")[0],
            _largest_difference(values, np.arange(points - 1.0), f"in {axis}: knot")[1],
        )
        for surface, sides in faces
        for axis, full, values, points in zip("uv", surface.full_knots, surface.knots, sides, strict=True)
    )
    units = f"number of solids: {text.solids}, unit of length: {text.unit}"
    single, one_solid = text.solids == 1 and (any_unit or text.unit == "millimetre"), f"{name}: one solid"
    return [
        Check.true(one_solid if any_unit else f"{one_solid}, in millimetres", single, units, id="one-solid"),
        Check.true(f"{name}: every edge used twice, once each way", text.closed, _open_edge(text), id="edges-twice"),
        Check.true(f"{name}: degree 2 x 2, multiplicities 3, 1, …, 1, 3", plain, degrees, id="degree"),
        Check.at_most(f"{name}: deviation of the knots", off, 0.0, where=knot, id="knots"),
    ]


def _is_plain(surface: FreeformSurface, shape: tuple[int, int]) -> bool:
    pairs = zip(surface.multiplicities, shape, strict=True)
    simple = all(np.array_equal(counts, [3, *[1] * (points - 3), 3]) for counts, points in pairs)
    return surface.degrees == (2, 2) and simple and not (any(surface.closed) or surface.self_intersecting)


def _open_edge(text: StepText) -> str:
    """Return the first edge that is not used once in each direction, in words."""
    uses = ((n, ahead, back) for n, (ahead, back) in text.edge_uses.items() if (ahead, back) != (1, 1))
    return next((f"edge #{n}: used {ahead} x forwards, {back} x backwards" for n, ahead, back in uses), "no edge")


def net_check(name: str, read: np.ndarray, designed: np.ndarray, *, id: str) -> Check:
    """Check the control points (m, n, 3) in a file against the designed control points (mm)."""
    off, where = _largest_difference(read, designed, "control point")
    farthest = float(np.abs(designed).max(initial=0.0))
    return Check.at_most(name, off, max(NET_TOLERANCE, RELATIVE_ROUNDING * farthest), unit="mm", where=where, id=id)


def _largest_difference(read: np.ndarray, designed: np.ndarray, name: str) -> tuple[float, str]:
    """Return the largest absolute difference and its position in words; infinite if the shapes differ."""
    if read.shape != designed.shape:
        return float("inf"), f"{name}s: {' x '.join(map(str, read.shape))}, not {' x '.join(map(str, designed.shape))}"
    distance = np.abs(read - designed)
    index = [int(i) for i in np.unravel_index(distance.argmax(), distance.shape)]
    return float(distance.max()), f"{name} {index[0] if len(index) == 1 else tuple(index[:2])}"


# ---- validation properties -----------------------------------------------------------------------------------------


def measure_checks(
    stated: ValidationProperties, shape: MassProperties | None, outline: Outline, name: str = SOURCE
) -> Iterator[Check]:
    """Check stated measures against `shape`, found from the faces (None: the file states none); outline: the lens's."""
    if stated.of_shape:
        assert shape is not None
        measures = ("area", "mm²", stated.areas, shape.area), ("volume", "mm³", stated.volumes, shape.volume)
        for quantity, unit, values, own in measures:
            if values:
                off, where = _worst_value([(value,) for value in values], (own,), "its faces give", unit)
                deviation = f"{name}: stated {quantity}, relative deviation from the {quantity} of its faces"
                yield Check.at_most(deviation, off / own, MEASURE_TOLERANCE, where=where, id="stated-measures")
        if stated.centroids:
            off, where = _worst_value(stated.centroids, shape.centroid, "its faces give", "mm")
            size = 2 * math.hypot(*outline.half_extent)
            deviation = f"{name}: stated centroid, deviation from the centroid of its faces"
            yield Check.at_most(deviation, off, MEASURE_TOLERANCE * size, unit="mm", where=where, id="stated-centroid")
    all_stated = {"area": stated.areas, "volume": stated.volumes, "centroid": stated.centroids}
    yield from _missing_statements(name, all_stated)


def density_checks(stated: ValidationProperties) -> Iterator[Check]:
    """Check that each stated density (g/cm³) of a file without a design is a number above zero."""
    for value in stated.densities:
        known = value if value > 0 else None
        yield Check(f"{SOURCE}: stated density", known, None, "g/cm³", passed=value > 0, id="stated-density")


def part_checks(text: StepText, part: Part, name: str = SOURCE) -> Iterator[Check]:
    """Check material, density and profile tolerances of back and front against the scene's [part]."""
    stated, back, profile = text.properties, text.surface.entity, "profile tolerance"
    numbers: dict[str, tuple[str, Sequence[float], float | None]] = {}  # quantity: (unit, stated values, scene's value)
    named = {face for face, width in part.profiles.items() if face != BACK and width is not None}
    zones = {  # a face without a name of its own counts as the back
        face: [each for each in stated.profiles if (each.face if each.face in named else BACK) == face]
        for face in part.profiles
    }
    for face, width in part.profiles.items():
        numbers[f"{profile}{of_face(face)}"] = "mm", [each.width for each in zones[face]], width
    numbers["density"] = "g/cm³", stated.densities, part.density
    for quantity, (unit, values, required) in numbers.items():
        if required is not None and values:
            off, where = _worst_value([(value,) for value in values], (required,), "the scene states", unit)
            difference = f"{name}: {quantity}, difference from the scene's"
            yield Check.at_most(difference, off, VALUE_TOLERANCE, unit=unit, where=where, id="stated-values")
        elif values:
            difference = f"the file states {_words((values[0],), unit)}, but the scene states none"
            yield Check.true(f"{name}: {quantity} is the scene's", False, difference, id="stated-values")
    if backs := zones[BACK]:
        others = {each.surface for each in backs} - {"", back}
        where = f"it refers to the surface #{min(others)}, but the back is #{back}" if others else ""
        yield Check.true(f"{name}: {profile} refers to the back", not others, where, id="profile-face")
    if fronts := zones[FRONT]:
        where = f"it refers to the surface #{back}, which is the back"
        of_front = back not in {each.surface for each in fronts}
        own = f"{name}: {profile} of the front does not refer to the back"
        yield Check.true(own, of_front, where, id="profile-face")
    if stated.materials:
        wrong = [material for material in stated.materials if material != part.material]
        own = "none" if part.material is None else repr(part.material)
        where = f"the file states {wrong[0]!r}, but the scene states {own}" if wrong else ""
        yield Check.true(f"{name}: material is the scene's", not wrong, where, id="material")
    expected: dict[str, Sequence] = {q: values for q, (_, values, required) in numbers.items() if required is not None}
    yield from _missing_statements(name, expected | ({} if part.material is None else {"material": stated.materials}))


def _worst_value(values: Sequence[Numbers], own: Numbers, who: str, unit: str) -> tuple[float, str]:
    """Return how far values are from `own` at most (infinite: unreadable), and a sentence; who: words before `own`."""
    off = [math.dist(each, own) for each in values]
    worst, stated = max((math.inf if math.isnan(by) else by, each) for by, each in zip(off, values, strict=True))
    return worst, f"the file states {_words(stated, unit)}, but {who} {_words(own, unit)}"


def _words(values: Numbers, unit: str) -> str:
    if any(map(math.isnan, values)):
        return "a number that cannot be read"
    words = ", ".join(f"{value:.9g}" for value in values)
    return f"({words}) {unit}" if len(values) > 1 else f"{words} {unit}"


def _missing_statements(name: str, stated: Mapping[str, Sequence]) -> Iterator[Check]:
    """Yield a check, which always passes, that names the quantities which the file does not state."""
    if missing := [quantity for quantity, values in stated.items() if not values]:
        yield Check(f"{name}: states {', '.join(missing)}", False, None, unit="", passed=True, id="not-stated")
