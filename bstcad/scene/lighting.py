"""Complaints about the source of a scene: its profile, its spectrum, its position, and light that misses the lens."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from bstcad.optics.light.emitters import Emitter
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import Outline
from bstcad.scene.blank import INDICES, LensBlank
from bstcad.scene.dome_back import MIN_DOME_POINTS, own_outline

UNITS = {
    "radius_1e2": " in mm",
    "inner_radius": " in mm",
    "order": ", such as order = 10",
}  # units of keys, in messages
MIN_BEAM_COVERAGE = 0.9  # ratio of the widths of beam and lens below which a warning calls the rest of the lens dark
DOME_FRONTS = ("sphere", "conic", "plane")  # kinds of fronts that a dome can have
IRRADIANCE_SAMPLES = 200  # points per side of the lens at which the irradiance is sampled


def complaints(source: Emitter, lens: LensBlank) -> Iterator[str]:
    """Yield complaints about the profile and the spectrum of the source, and those by source.complaints."""
    yield from _of_profile(source)
    yield from _spectrum(source, lens)
    first = getattr(lens, lens.passes.faces[0])
    yield from (f"source.{complaint}" for complaint in source.complaints(first.z, lens.optic))


def _of_profile(source: Emitter) -> Iterator[str]:
    """Yield complaints about keys that the profile of the source needs, and about keys that it does not use."""
    name = source.profile if isinstance(source.profile, str) else "measured"
    needed = source.widths.get(name, ())
    for key in needed:
        if name != source.unbounded and getattr(source, key) is None:
            unit = UNITS.get(key, " in degrees")
            yield f"source.{key}: missing, and a {name} profile needs it; add it{unit}"
    for other in dict.fromkeys(key for keys in source.widths.values() for key in keys):
        if other not in needed and getattr(source, other) is not None:
            yield f"source.{other}: a {name} profile does not use this key; remove it, or change the profile"
    turns = source.can_rotate  # reads a measured profile, whose faults are refused here
    if getattr(source, "rotate", None) and not turns:
        yield "source.rotate: the profile is round, and a rotation does not change it; remove this key"


def _spectrum(source: Emitter, lens: LensBlank) -> Iterator[str]:
    """Yield complaints: a spectral line without weight, one index for several lines, an unknown or impossible index."""
    listed = source.wavelength if isinstance(source.wavelength, tuple) else ((source.wavelength, 1.0),)
    if not listed:
        yield "source.wavelength: the list is empty; give one wavelength in nm, or lines such as [[587.6, 1.0]]"
    for nm, weight in listed:
        if not weight > 0:
            yield f"source.wavelength: the weight {weight:g} of the line at {nm:g} nm is not above 0; remove the line"
    if len({nm for nm, _ in listed}) > 1 and lens.index is not None:
        lines = f"the {len(listed)} lines of source.wavelength"
        yield f'lens.index: one index is not valid for {lines}; set lens.material instead, such as material = "PMMA"'
    try:
        indices = [lens.index_at(nm) for nm, _ in listed]
    except ValueError as error:
        yield f"lens.material: {error}"
        return
    low, high = INDICES
    for index in (n for n in indices if lens.material is not None and not low <= n <= high):
        found = f"the index of {lens.material} at source.wavelength is {index:.4g}, not between {low:g} and {high:g}"
        yield f"lens.material: {found}; choose a material that transmits the light of the source"


def order_complaints(source: Emitter, lens: LensBlank) -> Iterator[str]:
    """Yield complaints: a source not before the lens (or not above the mirror); keys of a front without light."""
    front, back = lens.front.z + lens.front_sags[0], lens.back.z
    key, start = f"source.{source.start_key}", source.nearest_z(upwards=lens.passes.sense > 0)
    if lens.passes.sense > 0:
        if start is not None and not start < front:
            yield f"{key}: the light starts at z = {start:g}, not before the front at z = {front:g}; move one of them"
    elif start is None:
        yield f"{key}: missing, and a mirror needs light from above; add the plane where it starts, above z = {back:g}"
    elif not start > back:
        yield f"{key}: the light starts at z = {start:g}, not above the mirror at z = {back:g}; move one of them"
    if "front" not in lens.passes.faces and lens.front.outline is not None:
        yield "lens.front.outline: no light meets the front of a mirror, the rear of its plate; remove this key"
    if "front" not in lens.passes.faces and not lens.front.fixed:
        yield "lens.front.optimise: no light meets the front of a mirror, the rear of its plate; remove this key"


def unlit_complaints(source: Emitter, lens: LensBlank, rim: Outline) -> Iterator[str]:
    """Yield complaints about a tilted or decentred source that sends no light to the lens inside this rim."""
    if not (source.tilted or getattr(source, "centre", None)):
        return
    upwards = lens.passes.sense > 0
    z, sags = (lens.front.z, lens.front.surface.sags(rim)) if upwards else (lens.back.z, (0.0,))
    x, y = sampling.grid(source.window(rim, z, sags), IRRADIANCE_SAMPLES)
    if not bool((source.irradiance(x, y, z) > 0).any()):
        key = "tilt" if source.tilted else "centre"
        yield f"source.{key}: no light reaches the {lens.optic}; tilt or move the source towards the {lens.optic}"


def doubts(source: Emitter, rim: Outline, key: str) -> Iterator[str]:
    """Yield warnings about a parallel beam wider than the rim or over 10 % narrower; key: dotted key of the rim."""
    beam, _ = source.spot(0.0)
    if beam is None:  # without an edge
        return
    sides = [*zip("xy", beam.half_extent, rim.half_extent, strict=True)]
    if any(b > h for _, b, h in sides):
        yield "source.aperture: the beam is wider than the lens, and light beside the lens is lost; make it narrower"
    for axis, b, h in [side for side in sides if side[1] < MIN_BEAM_COVERAGE * side[2]][:1]:
        yield (
            f"source.aperture: the beam is {2 * b:g} mm wide along {axis} and the lens {2 * h:g} mm; the lens is dark "
            f"outside {axis} = -{b:g} to {b:g} mm, so widen the beam or make {key} smaller"
        )


def encapsulant_complaints(source: Emitter, lens: LensBlank, given: Mapping[str, bool]) -> Iterator[str]:
    """Yield what does not go with an encapsulant; given: as for `dome_complaints`."""
    if lens.encapsulant is None:
        return
    if source.parallel:
        yield 'lens.encapsulant: parallel light comes through air; remove this key, or write source.kind = "point"'
    for key in (key for key in ("before", "wavefront") if given[key]):
        yield f"{key}: is not possible with lens.encapsulant yet; remove one of them"


def dome_complaints(source: Emitter, lens: LensBlank, given: Mapping[str, bool]) -> Iterator[str]:
    """Yield what does not go with a dome; given: True for each further key that the scene has and a dome excludes."""
    dome, instead = lens.dome, 'or give the lens a back of kind "bspline"'
    if dome is None:
        return
    if source.parallel or source.kind != "point":
        yield f'source.kind: a dome needs a lamp, kind = "point"; write one, {instead}'
    if source.tilted:
        yield f"source.tilt: the lamp of a dome shines along +z; remove this key, {instead}"
    if any(dome.centre[:2]):
        yield "lens.back.centre: lies beside the axis; give 0 for x and y, and shift source.position"
    if lens.outline != own_outline(dome):
        yield f"lens.outline: a dome ends at lens.back.half_angle; remove this key, {instead}"
    front = lens.front.outline
    if front is not None and front.radius >= lens.outline.half_extent[0]:
        wide = f"the front is {2 * front.radius:.5g} mm wide at the half angle, and the dome {2 * dome.radius:g} mm"
        yield f"lens.back.radius: {wide}; make the dome larger, or the front smaller"
    if dome.control_points is not None and dome.control_points < MIN_DOME_POINTS:
        yield f"lens.back.control_points: {dome.control_points} are too few for a dome; give {MIN_DOME_POINTS} or more"
    if lens.front.kind not in DOME_FRONTS or not lens.front.fixed or lens.front.reflect:
        yield f"lens.front.kind: the front of a dome is a fixed sphere, conic or plane; write one of them, {instead}"
    limits = {f"lens.{key}": True for key in (*lens.bounded_by, *(("mould",) if lens.mould else ()))}
    for key in (key for key, has in (limits | dict(given)).items() if has):
        yield f"{key}: is not possible with a dome yet; remove it, {instead}"
