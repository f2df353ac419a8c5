"""What a source must be so that a lens can be made for its light; each complaint is one sentence with a remedy."""

from __future__ import annotations

import math
from collections.abc import Iterator

from bstcad.optics import sampling
from bstcad.optics.outlines import Circle
from bstcad.optics.sources import Collimated
from bstcad.scene.wanted import Wanted

STEEPEST = 89.0  # degrees; of parallel light
LOOKED = 200  # points a side of the lens, where light is looked for


def said(scene: Wanted) -> Iterator[str]:
    """What is wrong with the source by itself."""
    for check in (_profile, _spectrum, _extent):
        yield from check(scene)


def _profile(scene: Wanted) -> Iterator[str]:
    source = scene.source
    needed = {("collimated", "gaussian"): "radius_1e2", ("point", "gaussian"): "half_angle_1e2"}
    needed[("point", "uniform")] = "half_angle"
    width = needed.get((source.kind, source.profile))
    if width and getattr(source, width) is None:
        unit = "mm" if width == "radius_1e2" else "degrees"
        yield f"source.{width}: missing, and a {source.profile} profile needs it; add it in {unit}"
    for other in ("radius_1e2", "half_angle_1e2", "half_angle"):
        if other != width and getattr(source, other, None) is not None:
            yield f"source.{other}: has no meaning for a {source.profile} profile; remove it or change the profile"


def _spectrum(scene: Wanted) -> Iterator[str]:
    lines = scene.source.wavelength
    if isinstance(lines, float | int):
        return
    if not lines:
        yield "source.wavelength: no line is in it; give one wavelength in nm, or lines such as [[587.6, 1.0]]"
    for nm, weight in lines:
        if not weight > 0:
            yield f"source.wavelength: the weight {weight:g} of the line at {nm:g} nm is not above 0; remove the line"
    if len({nm for nm, _ in lines}) > 1 and scene.lens.index is not None:
        yield (
            f"lens.index: one index does not hold for the {len(lines)} lines of source.wavelength; "
            'set lens.material instead, such as material = "PMMA"'
        )


def _extent(scene: Wanted) -> Iterator[str]:
    """A source that is more than a point fits before the lens; how far its light spreads is known."""
    source = scene.source
    if isinstance(source, Collimated):
        lean = math.degrees(math.acos(max(-1.0, min(1.0, source.axes[2][2]))))
        if not lean + (source.divergence or 0.0) / 2 < STEEPEST:
            key, what = ("divergence", "some of the light runs") if source.divergence else ("tilt", "the light runs")
            yield f"source.{key}: {what} {STEEPEST:g} degrees off the lens's axis or more; make it smaller"
        return
    given = [name for name in ("width", "height") if getattr(source, name) is not None]
    if given and source.diameter is not None:
        yield f"source.diameter: the source also has a {given[0]}; give a diameter, or width and height"
    if len(given) == 1:
        [other] = {"width", "height"} - set(given)
        yield f"source.{other}: missing, and a source with a {given[0]} needs it; add it in mm"
    if source.extent is not None:
        first = scene.lens.back if scene.lens.back.reflect else scene.lens.front
        distance = abs(first.z - source.position[2])
        name = "diameter" if source.diameter else max(given, key=lambda name: getattr(source, name))
        if not (size := getattr(source, name)) <= distance:
            yield (
                f"source.{name}: {size:g} mm is more than the {distance:g} mm from the source to the "
                f"{scene.optic}; make the source smaller or move it away"
            )


def lit(scene: Wanted) -> Iterator[str]:
    """A source that is turned or moved sideways still sends light to the lens."""
    source, lens = scene.source.central, scene.lens
    if not (source.tilted or getattr(source, "centre", None)):
        return
    z, sags = lens.back.z, (0.0,)
    if not lens.back.reflect:
        z, sags = lens.front.z, lens.front.surface.sags(scene.rim)
    x, y = sampling.grid(source.window(scene.rim, z, sags), LOOKED)
    if not bool((source.irradiance(x, y, z) > 0).any()):
        key = "tilt" if source.tilted else "centre"
        yield f"source.{key}: none of the light goes to the {scene.optic}; turn or move the source towards it"


def foremost(scene: Wanted) -> float:
    """z (mm) of the place of a disc or a rectangle that is nearest to the lens."""
    source = scene.source
    e_x, e_y, _ = source.axes
    if isinstance(source.extent, Circle):
        reach = source.extent.radius * math.hypot(e_x[2], e_y[2])
    else:
        reach = sum(half * abs(e[2]) for half, e in zip(source.extent.half_extent, (e_x, e_y), strict=True))
    return source.position[2] + (-reach if scene.lens.back.reflect else reach)
