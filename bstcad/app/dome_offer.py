"""Conversion of a lens in front of a lamp to a dome and back, and the offer of a dome with the light that it gains."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from bstcad.app.kinds import are_numbers, extent, is_mirror, lamp_z, table_at, value_at
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.light.sphere_light import SphereLight
from bstcad.optics.surfaces.charts import SphereChart
from bstcad.optics.trace.reach import largest_deflection
from bstcad.planning.preview import Preview
from bstcad.runs.files import SentenceError
from bstcad.scene.blank import stated_index
from bstcad.scene.dome_back import DOME_HALF_ANGLE, MIN_DOME_POINTS
from bstcad.scene.picture import letters

BACK_KIND, DOME, HEIGHTS = "lens.back.kind", "radial", "bspline"  # key of the kind of the back, and its two kinds
FRONT_RATIO = 0.4  # largest radius of the front / radius of a new dome, which leaves room for off-axis targets
USUAL_INDEX = 1.49  # refractive index (PMMA) for a material that is not known
SMALLEST_HALF_ANGLE = 5.0  # degrees, smallest lens.back.half_angle
HEIGHTS_LIMIT = 55.0  # angle from the axis (degrees) beyond which a back of heights can take hardly any light
MIN_GAIN = 0.02  # smallest fraction of the lamp's light that an offered dome gains
POINTS = 256  # points per side of the grid over directions, for the light within a cone
LETTER_PIXELS = 256  # pixels on the longer side of a target on which letters are drawn to measure them
MIN_LETTER_PIXELS = 16  # fewest pixels on its shorter side
MAX_LETTERS = 100  # most letters that a scene may have

Table = Mapping[str, Any]


@dataclass(frozen=True)
class Offer:
    """Sentence on the light that a lens and a dome lose; and the change that makes the dome, if it is possible."""

    sentence: str
    key: str = BACK_KIND
    value: str | None = None  # value of the key; None: the dome is not possible


def changes_of_kind(data: Table, kind: Any) -> dict[str, Any]:
    """Return the changes by key that follow lens.back.kind in a scene's tables; {} if a position is missing."""
    before = value_at(BACK_KIND, data) or HEIGHTS
    if (before, kind) == (HEIGHTS, DOME):
        return _to_dome(data)
    return _to_heights(data) if (before, kind) == (DOME, HEIGHTS) else {}


def _to_dome(data: Table) -> dict[str, Any]:
    """Return the changes to a dome with the same vertex about the lamp, and a front that is a sphere about the lamp."""
    lamp, front, back = lamp_z(data), value_at("lens.front.z", data), value_at("lens.back.z", data)
    if is_mirror(data) or not (are_numbers(lamp, front, back) and lamp < front < back):
        return {}
    radius, net = back - lamp, value_at("lens.back.control_points", data)
    inner = rounded(min(front - lamp, FRONT_RATIO * radius))
    sphere = {"kind": "sphere", "z": rounded(lamp + inner), "curvature": -1 / inner}
    return {
        "lens.back.centre": [0.0, 0.0, float(lamp)] if lamp else None,
        "lens.back.radius": rounded(radius),
        "lens.back.half_angle": half_angle(data),
        "lens.back.control_points": net if type(net) is int and net >= MIN_DOME_POINTS else None,
        "lens.front": sphere,
        "lens.outline": None,
    }


def _to_heights(data: Table) -> dict[str, Any]:
    """Return the changes from a dome to a lens with the same vertices and width, and a plane front."""
    dome = table_at("lens.back", data)
    centre, angle = dome.get("centre", [0.0, 0.0, 0.0]), dome.get("half_angle", DOME_HALF_ANGLE)
    radius, front = dome.get("radius"), value_at("lens.front.z", data)
    if not isinstance(centre, list) or len(centre) != 3 or not are_numbers(*centre, angle, radius, front):
        return {}
    width = rounded(2 * radius * math.sin(math.radians(angle)))
    return {
        "lens.back.z": rounded(centre[2] + radius),
        "lens.back.control_points": dome.get("control_points"),
        "lens.front": {"kind": "plane", "z": front},
        "lens.outline": {"shape": "circle", "diameter": width},
    }


def half_angle(data: Table) -> float:
    """Return the half angle (degrees) of a new dome: DOME_HALF_ANGLE, or less for a narrow target.

    Light from the rim of the dome goes to the edge of the lit part, and one face bends it by `largest_deflection`.  The
    half angle is at most the sum of this deflection and the smallest angle of an edge from the axis.  The lit part of
    letters, a profile or an outline is smaller than the target; a photograph is taken as lit to the target's edges.
    """
    angles = [_edge_angle(target, value_at("source.position", data)) for target in _targets(data)]
    reach = min(angles, default=90.0) + math.degrees(largest_deflection(_index(data)))
    return float(min(DOME_HALF_ANGLE, max(math.floor(reach), SMALLEST_HALF_ANGLE)))


def _targets(data: Table) -> list[Table]:
    target = data.get("target")
    return [each for each in (target if isinstance(target, list) else [target]) if isinstance(each, dict)]


def _edge_angle(target: Table, lamp: Any) -> float:
    """Return the smallest angle (degrees) of an edge of the lit part from the axis of a lamp, negative beside the axis.

    The target's tilt is not considered.
    """
    ends, z = [target.get(axis) for axis in "xy"], target.get("z")
    if not all(isinstance(pair, list) and len(pair) == 2 and are_numbers(*pair) for pair in ends):
        return 90.0
    start = lamp if isinstance(lamp, list) and len(lamp) == 3 and are_numbers(*lamp) else [0.0, 0.0, 0.0]
    angular = target.get("kind") == "intensity"
    sizes = *(extent(table_at(name, target)) for name in ("outline", "profile")), _letters_size(target, ends)
    limits = [size for size in sizes if size is not None]
    edges = []
    for k, (low, high) in enumerate(ends):
        middle = (low + high) / 2 - (0.0 if angular else start[k])
        edges.append(min([high - low, *(limit[k] for limit in limits)]) / 2 - abs(middle))
    if angular:
        return min(edges)
    return math.degrees(math.atan2(min(edges), z - start[2])) if are_numbers(z) and z > start[2] else 90.0


def _letters_size(target: Table, ends: Sequence[Sequence[float]]) -> tuple[float, float] | None:
    """Return width and height of the letters of a target with these ends along x and y; None if it has no letters."""
    text, sides = target.get("text"), [high - low for low, high in ends]
    is_text = isinstance(text, str) and 0 < len(text.strip()) <= MAX_LETTERS
    if not (is_text and min(sides) > 0) or target.get("invert") is True:
        return None
    is_turned = target.get("rotate") in (90, 270)  # the letters run along y
    sides = sides[::-1] if is_turned else sides
    pixels = [max(round(LETTER_PIXELS * side / max(sides)), MIN_LETTER_PIXELS) for side in sides]
    try:
        ink = np.asarray(letters(text, *pixels))
    except SentenceError:
        return None
    width, height = (
        side * float(np.ptp(np.flatnonzero(ink.any(axis=axis))) + 1) / n
        for side, n, axis in zip(sides, pixels, (0, 1), strict=True)
    )
    return (height, width) if is_turned else (width, height)


def _index(data: Table) -> float:
    """Return the refractive index of the lens at the first wavelength; USUAL_INDEX if it is not known."""
    wavelength = value_at("source.wavelength", data)
    while isinstance(wavelength, list) and wavelength:
        wavelength = wavelength[0]
    nm = wavelength if are_numbers(wavelength) else 587.6
    lens = table_at("lens", data)
    material, index = lens.get("material"), lens.get("index")
    try:
        index = stated_index(material, index, nm) if isinstance(material, str) else index
    except ValueError:
        return USUAL_INDEX
    return index if are_numbers(index) and index > 1 else USUAL_INDEX


def rounded(value: float) -> float:
    """Return a length without the rounding errors of a sum: ten significant digits."""
    return float(f"{value:.10g}")


# ---- the offer -------------------------------------------------------------------------------------------------------


def offer(found: Preview, dome: Table, refusal: str | None) -> Offer | None:
    """Return the offer of a dome for the scene of a preview; None if a dome would not take more of its light.

    dome: tables of the scene with a dome.  refusal: sentence that refuses them; None if they are valid.
    """
    scene, source = found.scene, found.scene.source
    radius, angle = value_at("lens.back.radius", dome), half_angle(dome)
    if scene.lens.dome is not None or source.kind != "point" or source.tilted or not are_numbers(radius):
        return None
    if flux_within(source, HEIGHTS_LIMIT, radius) > 1 - MIN_GAIN:
        return None
    lost = found.flux["missed the lens"] + found.flux["lost through the sides"]
    now = f"Of the lamp's light, {lost:.0%} misses this lens or leaves through its sides"
    now = now.replace("%", " %")
    if angle <= HEIGHTS_LIMIT:
        bend = f"one face bends light by at most {math.degrees(largest_deflection(_index(dome))):.0f} degrees"
        return Offer(f"{now}. A dome takes more only with a wider or nearer target, since {bend}.")
    less = 1 - flux_within(source, angle, radius)
    if not less < lost - MIN_GAIN:
        return None
    gain = f"A dome that takes light up to {angle:g} degrees from the axis would miss {less:.0%}".replace("%", " %")
    if refusal is not None:
        return Offer(f"{now}. {gain}, but is not possible in this scene: {refusal}.")
    blur = " The image of the lamp may be wider, as the preview then shows." if source.extent is not None else ""
    return Offer(f"{now}. {gain}.{blur}", value=DOME)


def flux_within(source: Emitter, angle: float, radius: float) -> float:
    """Return the fraction of a lamp's light through a dome of this radius (mm) up to an angle (degrees) from its axis.

    It is the sum of E over the cells of a grid on the chart of the sphere: ∫ E dx dy (see sphere_light).
    """
    chart, half = SphereChart(radius), math.radians(angle)
    light = SphereLight.of(source, source.start_point(0.0)[2], chart, half_angle=half)
    cell = 2 * chart.length(half) / POINTS
    ends = (torch.arange(POINTS, dtype=torch.float64) + 0.5 - POINTS / 2) * cell
    x, y = torch.meshgrid(ends, ends, indexing="ij")
    return min(float(light.irradiance(x, y, 0.0).sum()) * cell**2, 1.0)
