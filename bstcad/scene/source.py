"""Checks of a source; each complaint is one sentence with a remedy."""

from __future__ import annotations

import math
from collections.abc import Iterator

from bstcad.optics import sampling
from bstcad.optics.outlines import Circle, Outline
from bstcad.optics.sources import Collimated, Point, Source
from bstcad.scene.blank import LensBlank

MAX_LEAN = 89.0  # degrees from the lens's axis, of parallel light
SAMPLES = 200  # a side of the lens, at which light is looked for


def complaints(source: Source, lens: LensBlank) -> Iterator[str]:
    """Complaints about the source by itself, and about its size, its spectrum and the lens."""
    yield from _profile(source)
    yield from _spectrum(source, lens)
    yield from _cone(source) if isinstance(source, Collimated) else _size(source, lens)


def _profile(source: Source) -> Iterator[str]:
    needed = {("collimated", "gaussian"): "radius_1e2", ("point", "gaussian"): "half_angle_1e2"}
    needed[("point", "uniform")] = "half_angle"
    width = needed.get((source.kind, source.profile))
    if width and getattr(source, width) is None:
        unit = "mm" if width == "radius_1e2" else "degrees"
        yield f"source.{width}: missing, and a {source.profile} profile needs it; add it in {unit}"
    for other in ("radius_1e2", "half_angle_1e2", "half_angle"):
        if other != width and getattr(source, other, None) is not None:
            yield f"source.{other}: has no meaning for a {source.profile} profile; remove it or change the profile"


def _spectrum(source: Source, lens: LensBlank) -> Iterator[str]:
    lines = source.wavelength
    if isinstance(lines, float | int):
        return
    if not lines:
        yield "source.wavelength: no line is in it; give one wavelength in nm, or lines such as [[587.6, 1.0]]"
    for nm, weight in lines:
        if not weight > 0:
            yield f"source.wavelength: the weight {weight:g} of the line at {nm:g} nm is not above 0; remove the line"
    if len({nm for nm, _ in lines}) > 1 and lens.index is not None:
        yield (
            f"lens.index: one index does not hold for the {len(lines)} lines of source.wavelength; "
            'set lens.material instead, such as material = "PMMA"'
        )


def _cone(source: Collimated) -> Iterator[str]:
    """Parallel light whose directions lean too far from the axis."""
    lean = math.degrees(math.acos(max(-1.0, min(1.0, source.axes[2][2]))))
    if not lean + (source.divergence or 0.0) / 2 < MAX_LEAN:
        key, light = ("divergence", "some of the light runs") if source.divergence else ("tilt", "the light runs")
        yield f"source.{key}: {light} {MAX_LEAN:g} degrees off the lens's axis or more; make it smaller"


def _size(source: Point, lens: LensBlank) -> Iterator[str]:
    """A disc or a rectangle that is not described, or that is larger than its distance from the lens."""
    given = [name for name in ("width", "height") if getattr(source, name) is not None]
    if given and source.diameter is not None:
        yield f"source.diameter: the source also has a {given[0]}; give a diameter, or width and height"
    if len(given) == 1:
        [other] = {"width", "height"} - set(given)
        yield f"source.{other}: missing, and a source with a {given[0]} needs it; add it in mm"
    if source.extent is not None:
        first = lens.back if lens.back.reflect else lens.front
        distance = abs(first.z - source.position[2])
        name = "diameter" if source.diameter else max(given, key=lambda name: getattr(source, name))
        if not (size := getattr(source, name)) <= distance:
            yield (
                f"source.{name}: {size:g} mm is more than the {distance:g} mm from the source to the "
                f"{lens.optic}; make the source smaller or move it away"
            )


def unlit(source: Source, lens: LensBlank, rim: Outline) -> Iterator[str]:
    """A source that is turned or moved sideways and sends no light to the lens inside its rim."""
    source = source.central
    if not (source.tilted or getattr(source, "centre", None)):
        return
    z, sags = lens.back.z, (0.0,)
    if not lens.back.reflect:
        z, sags = lens.front.z, lens.front.surface.sags(rim)
    x, y = sampling.grid(source.window(rim, z, sags), SAMPLES)
    if not bool((source.irradiance(x, y, z) > 0).any()):
        key = "tilt" if source.tilted else "centre"
        yield f"source.{key}: none of the light goes to the {lens.optic}; turn or move the source towards it"


def order(source: Source, lens: LensBlank) -> Iterator[str]:
    """Light that starts behind the front of a lens, or below a mirror, whose light comes from above."""
    key, start = ("source.position", nearest(source, lens)) if isinstance(source, Point) else ("source.z", source.z)
    front, back = lens.front.z + lens.front_sags[0], lens.back.z
    if not lens.back.reflect:
        if start is not None and not start < front:
            yield f"{key}: the light starts at z = {start:g}, not before the front at z = {front:g}; move one of them"
    elif start is None:
        yield f"{key}: missing, and a mirror's light comes from above; add the plane it starts from, above z = {back:g}"
    elif not start > back:
        yield f"{key}: the light starts at z = {start:g}, not above the mirror at z = {back:g}; move one of them"


def nearest(source: Point, lens: LensBlank) -> float:
    """z (mm) of the place of a point, disc or rectangle that is nearest to the lens."""
    if source.extent is None:
        return source.position[2]
    e_x, e_y, _ = source.axes
    if isinstance(source.extent, Circle):
        reach = source.extent.radius * math.hypot(e_x[2], e_y[2])
    else:
        reach = sum(half * abs(e[2]) for half, e in zip(source.extent.half_extent, (e_x, e_y), strict=True))
    return source.position[2] + (-reach if lens.back.reflect else reach)
