"""The checks of a scene that need several of its tables: can the lens be made from it?

A complaint is one sentence with a remedy.  The first one counts, and those behind it rely on its absence.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from bstcad.optics import sampling
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import TiltedPlane
from bstcad.optics.sources import Collimated, Point, Source
from bstcad.scene.blank import INDICES, LensBlank
from bstcad.scene.target import Target

INSIDE = 0.999  # of the way to where a front would be refused: where the search may go
TINY, FAR = 0.5, 10.0  # mm; in metres no lens is wider than the one, no target further than the other
NARROW = 20.0  # times narrower than the lens: the light of a lens is seldom gathered so far
EDGE_ON = math.radians(1.0)  # a plane seen under less than that has no picture
SINGLE = 2.0**-24  # of a coordinate: the rounding of float32
FINEST = 4 * SINGLE  # of the largest coordinate: no tolerance of a mesh is finer
COVERED = 0.9  # of the lens's width: a beam narrower than that leaves a part dark that somebody pays for
MAX_LEAN = 89.0  # degrees from the lens's axis, of parallel light
SAMPLES = 200  # a side of the lens, at which light is looked for
PROFILES = {  # the width that a profile of the irradiance needs, by the kind of source
    ("collimated", "gaussian"): "radius_1e2",
    ("point", "gaussian"): "half_angle_1e2",
    ("point", "uniform"): "half_angle",
}


def of_source(source: Source, lens: LensBlank) -> Iterator[str]:
    """Complaints about the profile, the spectrum and the size of a source before this lens."""
    width = PROFILES.get((source.kind, source.profile))
    if width and getattr(source, width) is None:
        unit = "mm" if width == "radius_1e2" else "degrees"
        yield f"source.{width}: missing, and a {source.profile} profile needs it; add it in {unit}"
    for other in PROFILES.values():
        if other != width and getattr(source, other, None) is not None:
            yield f"source.{other}: has no meaning for a {source.profile} profile; remove it or change the profile"
    yield from _spectrum(source, lens)
    yield from _cone(source) if isinstance(source, Collimated) else _size(source, lens)


def _spectrum(source: Source, lens: LensBlank) -> Iterator[str]:
    """Lines without a weight, of several indices, or of which the material's index is not known or no glass's."""
    listed = source.wavelength if isinstance(source.wavelength, tuple) else ((source.wavelength, 1.0),)
    if not listed:
        yield "source.wavelength: no line is in it; give one wavelength in nm, or lines such as [[587.6, 1.0]]"
    for nm, weight in listed:
        if not weight > 0:
            yield f"source.wavelength: the weight {weight:g} of the line at {nm:g} nm is not above 0; remove the line"
    if len({nm for nm, _ in listed}) > 1 and lens.index is not None:
        lines = f"the {len(listed)} lines of source.wavelength"
        yield f'lens.index: one index does not hold for {lines}; set lens.material instead, such as material = "PMMA"'
    try:
        indices = [lens.index_at(nm) for nm, _ in listed]
    except ValueError as error:
        yield f"lens.material: {error}"
        return
    low, high = INDICES
    for index in (n for n in indices if lens.material is not None and not low <= n <= high):
        found = f"the index of {lens.material} is {index:.4g} there, not between {low:g} and {high:g}"
        yield f"lens.material: {found}; choose a material that lets the source's light through"


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
    for other in {"width", "height"} - set(given) if given else ():
        yield f"source.{other}: missing, and a source with a {given[0]} needs it; add it in mm"
    sizes = {name: getattr(source, name) or 0.0 for name in ("diameter", "width", "height")}
    name = max(sizes, key=sizes.get)
    distance = abs((lens.back if lens.back.reflect else lens.front).z - source.position[2])
    if source.extent is not None and not sizes[name] <= distance:
        far = f"the {distance:g} mm from the source to the {lens.optic}"
        yield f"source.{name}: {sizes[name]:g} mm is more than {far}; make the source smaller or move it away"


def order(source: Source, lens: LensBlank, target: Target) -> Iterator[str]:
    """Light, lens and target that do not follow each other along z; a mirror's light comes from above."""
    front, back = lens.front.z + lens.front_sags[0], lens.back.z
    key, start = ("source.position", _nearest(source, lens)) if isinstance(source, Point) else ("source.z", source.z)
    if not lens.back.reflect:
        if start is not None and not start < front:
            yield f"{key}: the light starts at z = {start:g}, not before the front at z = {front:g}; move one of them"
    elif start is None:
        yield f"{key}: missing, and a mirror's light comes from above; add the plane it starts from, above z = {back:g}"
    elif not start > back:
        yield f"{key}: the light starts at z = {start:g}, not above the mirror at z = {back:g}; move one of them"
    if lens.back.reflect and lens.front.free:
        yield "lens.front.optimise: the front of a mirror is the rear of its plate, which no light meets; remove it"
    if not target.z > back:
        place = "above the mirror, whose face" if lens.back.reflect else "behind the lens, whose back"
        yield f"target.z: the target at z = {target.z:g} is not {place} is at z = {back:g}; move it further along +z"


def _nearest(source: Point, lens: LensBlank) -> float:
    """z (mm) of the place of a point, disc or rectangle that is nearest to the lens."""
    reach = 0.0 if source.extent is None else source.extent.reach(*(axis[2] for axis in source.axes[:2]))
    return source.position[2] + (-reach if lens.back.reflect else reach)


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


def tilted(target: Target, lens: LensBlank) -> Iterator[str]:
    """A tilted target that does not face the lens, cuts it, or comes down to it."""
    if target.tilt is None:
        return
    screen, back, optic = target.screen, lens.back.z, lens.optic
    plane = screen.plane
    vertex = (0.0, 0.0, back)
    lowest = min(plane.point(x, y)[2] for x in screen.x for y in screen.y)
    if not -plane.height(vertex) > math.sin(EDGE_ON) * math.dist(plane.centre, vertex):
        yield f"target.tilt: the target plane is edge-on to the {optic}, or shows it its rear; turn it less, or move it"
    if not clearance(target, lens, back) > 0:
        yield f"target.tilt: the target plane cuts into the {optic}; turn it less, or move the target further along +z"
    if not lowest > back:
        edge = f"comes down to z = {lowest:.6g}, not beyond the {optic}, whose back is at z = {back:g}"
        yield f"target.tilt: an edge of the target {edge}; turn it less, make it smaller or move it along +z"


def clearance(target: Target, lens: LensBlank, highest: float) -> float:
    """How far (mm) the target's plane passes a lens that reaches up to z = highest (mm); negative: it cuts it."""
    plane = TiltedPlane(target.screen.middle, target.tilt or (0.0, 0.0))
    return -plane.height((0.0, 0.0, highest)) - lens.outline.reach(*plane.axes[2][:2])


def mesh(tolerance: float | None, lens: LensBlank) -> Iterator[str]:
    """A tolerance of the mesh (mm) below the rounding of STL's single precision, SINGLE of a coordinate."""
    size = max(*lens.outline.half_extent, abs(lens.front.z), abs(lens.back.z))
    if tolerance is not None and tolerance < (least := FINEST * size):
        rounded = f"coordinates of {size:g} mm in an STL file are rounded by up to {SINGLE * size:.1g} mm"
        yield f"output.mesh_tolerance: {tolerance:g} mm, and {rounded}; ask for {least:.2g} mm or more"


# ---- possible, but perhaps not meant ---------------------------------------------------------------------------------


def metres(target: Target, lens: LensBlank) -> Iterator[str]:
    """A question where lengths look as if they were in metres."""
    outline, widest = lens.outline, max(target.size)
    name, size = ("radius", outline.radius) if outline.is_round else ("width", outline.width)
    across, question = 2 * max(outline.half_extent), "are these metres? lengths are in mm"
    if across < TINY:
        yield f"lens.outline.{name}: {size:g} mm; {question}"
    elif 0 < target.z <= FAR and target.z - lens.back.z < across / 4:
        yield f"target.z: {target.z:g} mm; {question}"
    elif widest < min(across / NARROW, FAR):
        yield f"target.x: {target.size[0]:g} mm wide; {question}"


def beam(aperture: Outline, rim: Outline, key: str) -> Iterator[str]:
    """A parallel beam that is wider than the lens, or leaves part of it dark; key: of the rim."""
    sides = [*zip("xy", aperture.half_extent, rim.half_extent, strict=True)]
    if any(b > h for _, b, h in sides):
        yield "source.aperture: the beam is wider than the lens; what passes beside it is lost"
    for axis, b, h in [side for side in sides if side[1] < COVERED * side[2]][:1]:
        yield (
            f"source.aperture: the beam is {2 * b:g} mm wide along {axis} and the lens {2 * h:g} mm; the lens "
            f"stays unlit beyond {axis} = -{b:g} and {b:g} mm, so widen the beam or make {key} smaller"
        )
