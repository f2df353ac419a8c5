"""Limits: what a scene must be so that a lens can be made from it; each complaint is one sentence with a remedy."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from bstcad.optics.outlines import Circle, Outline
from bstcad.optics.planes import TiltedPlane
from bstcad.optics.sources import Collimated, Point
from bstcad.scene import machining, mount, part, source, tolerance
from bstcad.scene.quality import PRESETS
from bstcad.scene.wanted import LensBlank, Wanted

INSIDE = 0.999  # of the way to where a front would be refused: where the search may go
# What each number may be, by its key or the last part of that: least, greatest, unit.
RANGES: dict[str, tuple[float, float, str]] = {
    **dict.fromkeys(("width", "height", "radius", "radius_1e2"), (1e-3, 1e6, "mm")),
    **dict.fromkeys(("x", "y", "z", "position"), (-1e8, 1e8, "mm")),
    "tilt": (-89.0, 89.0, "degrees"),
    "half_angle": (1e-3, 90.0, "degrees"),
    "half_angle_1e2": (1e-3, 89.0, "degrees"),
    "conic_constant": (-1e3, 1e3, ""),
    "wavelength": (100.0, 20_000.0, "nm"),
    **dict.fromkeys(("source.width", "source.height", "source.diameter", "real_diameter"), (0.0, 1e6, "mm")),
    **dict.fromkeys(("divergence", "real_divergence"), (0.0, 179.0, "degrees")),
    "source.tilt": (-180.0, 180.0, "degrees"),
    "source.centre": (-1e8, 1e8, "mm"),
    "index": (1.01, 5.0, ""),
    "thickness": (0.0, 1e5, "nm"),
    "coefficient": (0.0, 1e3, "1/mm"),
    "pixels": (8, 4096, ""),
    "gamma": (0.1, 10.0, ""),
    **dict.fromkeys(("control_points", "levels"), (5, 2049, "")),
    "rrmsd": (1e-6, 10.0, ""),
    "form": (1e-12, 1.0, "mm"),
    "decentre": (1e-6, 1e3, "mm"),
    **dict.fromkeys(("min_thickness", "max_thickness", "edge_thickness"), (1e-3, 1e6, "mm")),
    "tool_radius": (1e-6, 1e9, "mm"),
    "max_slope": (1e-3, 89.0, "degrees"),
    "mesh_tolerance": (1e-6, 1e3, "mm"),
    **dict.fromkeys(("efficiency", "light_on_target", "leak"), (0.0, 1.0, "")),
    "seed": (0, 2**63 - 1, ""),
    "transport_grid": (16, 2049, ""),
    "source_points": (2, 4096, ""),
    "transport_iterations": (1, 100_000, ""),
    "rays": (16, 16_384, ""),
    **dict.fromkeys(("stage1_iterations", "stage2_iterations"), (0, 1_000_000, "")),
    "rounds": (1, 100, ""),
    "overshoot": (0.0, 1e3, ""),
    "accuracy": (1e-6, 10.0, ""),
    "max_time": (1.0, 1e7, "s"),
    "limit": (1e-12, 1e4, ""),
    "cost": (1e-6, 1e6, ""),
    "density": (1e-3, 30.0, "g/cm³"),
    **dict.fromkeys(("surface_profile", "front_profile", "thickness_tolerance"), (1e-6, 10.0, "mm")),
    "roughness": (0.01, 1e5, "nm"),
    **dict.fromkeys(("correlation_length", "period"), (1e-3, 1e4, "mm")),
    **dict.fromkeys(("mount.rim.diameter", "mount.flange.outline.diameter"), (1e-3, 1e6, "mm")),
    **dict.fromkeys(("mount.flange.screws.diameter", "mount.flange.screws.circle"), (1e-3, 1e6, "mm")),
    "mount.flange.thickness": (1e-2, 1e5, "mm"),
    "mount.flange.draft": (0.0, 45.0, "degrees"),
    **dict.fromkeys(("mount.flange.bevel", "corner_radius"), (0.0, 1e5, "mm")),
    "mount.flange.screws.count": (1, 100, ""),
    "mount.draft": (0.0, mount.MOST_DRAFT, "degrees"),
    "mount.bevel": (0.0, 1e5, "mm"),
}

TINY, FAR = 0.5, 10.0  # mm; in metres no lens is wider than the one, no target further than the other
NARROW = 20.0  # times narrower than the lens: the light of a lens is seldom gathered so far
EDGE_ON = math.radians(1.0)  # a plane seen under less than that has no picture
SINGLE = 2.0**-24  # of a coordinate in STL
FINEST = 4 * SINGLE  # of the largest coordinate: no tolerance of a mesh is finer
COVERED = 0.9  # of the lens's width: a beam narrower than that leaves a part dark that somebody pays for


def complaints(scene: Wanted) -> Iterator[str]:
    """Everything that keeps the scene from being built, the most basic first."""
    of_light = _in_range, source.said, _blank, _effects, _order, source.lit, _tilt, _levels, _stops, _errors
    for check in (*of_light, _integrated, machining.complaints, _mesh, _part, mount.said):
        yield from check(scene)


def doubts(scene: Wanted) -> Iterator[str]:
    """What is possible but perhaps not meant."""
    yield from metres(scene)
    if isinstance(scene.source, Collimated):
        key = "mount.rim" if scene.mount and scene.mount.rim else "lens.outline"
        yield from _beam(scene.source.aperture, scene.rim, key)


def metres(scene: Wanted) -> Iterator[str]:
    """A question where lengths look as if they were in metres."""
    outline, widest = scene.lens.outline, max(scene.target.size)
    name, size = ("radius", outline.radius) if isinstance(outline, Circle) else ("width", outline.width)
    across = 2 * max(outline.half_extent)
    if across < TINY:
        yield f"lens.outline.{name}: {size:g} mm; are these metres? lengths are in mm"
    elif 0 < scene.target.z <= FAR and scene.target.z - scene.lens.back.z < across / 4:
        yield f"target.z: {scene.target.z:g} mm; are these metres? lengths are in mm"
    elif widest < min(across / NARROW, FAR):
        yield f"target.x: {scene.target.size[0]:g} mm wide; are these metres? lengths are in mm"


def _beam(beam: Outline, lens: Outline, key: str) -> Iterator[str]:
    """A parallel beam that is wider than the lens, or leaves part of it dark; key: what bounds the lens."""
    if any(b > h for b, h in zip(beam.half_extent, lens.half_extent, strict=True)):
        yield "source.aperture: the beam is wider than the lens; what passes beside it is lost"
    for axis, b, h in zip("xy", beam.half_extent, lens.half_extent, strict=True):
        if b < COVERED * h:
            yield (
                f"source.aperture: the beam is {2 * b:g} mm wide along {axis} and the lens {2 * h:g} mm; the lens "
                f"stays unlit beyond {axis} = -{b:g} and {b:g} mm, so widen the beam or make {key} smaller"
            )
            return


def _in_range(scene: Wanted) -> Iterator[str]:
    for key, value in _numbers(scene.model_dump(exclude={"target": {"image"}})):
        name = key if key in RANGES else key.rpartition(".")[2]
        if name in RANGES:
            least, greatest, unit = RANGES[name]
            if not least <= value <= greatest:
                hint = f"; did you mean {value * 1000:g} nm?" if unit == "nm" and 0.1 <= value <= 20 else ""
                unit = f" {unit}" if unit else ""
                yield f"{key}: {value:g}{unit} is not between {least:.10g} and {greatest:.10g}{unit}" + (
                    hint or "; choose a value in between"
                )


def _numbers(tree: dict[str, Any], key: str = "") -> Iterator[tuple[str, float]]:
    """Every number of nested tables with its dotted key; those of a list each under the list's key, of lines the nm."""
    for name, value in tree.items():
        dotted = f"{key}.{name}" if key else name
        if isinstance(value, dict):
            yield from _numbers(value, dotted)
        elif name in ("effects", "tolerance"):
            for k, entry in enumerate(value):
                yield from _numbers(entry, f"{dotted}[{k}]")
        else:
            several = value if isinstance(value, tuple | list) else (value,)
            if dotted == "source.wavelength":
                several = [line[0] if isinstance(line, tuple | list) else line for line in several]
            yield from ((dotted, v) for v in several if isinstance(v, int | float) and not isinstance(v, bool))


def _blank(scene: Wanted) -> Iterator[str]:
    lens, least = scene.lens, scene.lens.min_thickness
    try:
        indices = [scene.index_at(nm) for nm, _ in scene.source.lines]
    except ValueError as error:
        yield f"lens.material: {error}"
    else:
        low, high, _ = RANGES["index"]
        for index in (n for n in indices if lens.material is not None and not low <= n <= high):
            yield (
                f"lens.material: the index of {lens.material} is {index:.4g} there, not between {low:g} and {high:g}; "
                "choose what lets the source's light through"
            )
    _, rises = _sags(lens)
    yield from (f"lens.front.{complaint}" for complaint in lens.front.complaints(lens.outline))
    highest = "rim" if lens.front.surface.curvature is not None else "thinnest place"
    for where, front in (("centre", lens.front.z), (highest, lens.front.z + rises)):
        if not lens.back.z - front >= least:
            yield (
                f"lens.back.z: the lens is {lens.back.z - front:g} mm thick at its {where}, and "
                f"lens.min_thickness asks for {least:g} mm; move the back to z = {front + least:g} or further"
            )


def _mesh(scene: Wanted) -> Iterator[str]:
    """STL holds single precision, half of whose last place is SINGLE of a number."""
    asked, lens = scene.output.mesh_tolerance, scene.lens
    size = max(*lens.outline.half_extent, abs(lens.front.z), abs(lens.back.z))
    if asked is not None and asked < (least := FINEST * size):
        yield (
            f"output.mesh_tolerance: {asked:g} mm, and coordinates of {size:g} mm in an STL file are rounded by up to "
            f"{SINGLE * size:.1g} mm; ask for {least:.2g} mm or more"
        )


def _effects(scene: Wanted) -> Iterator[str]:
    mirror = scene.lens.back.reflect
    for k, effect in enumerate(scene.effects):
        key = f"effects[{k}]"
        if any(effect.kind == other.kind for other in scene.effects[:k]):
            yield f"{key}: {effect.kind!r} is named twice; remove one of the two tables"
        if mirror and effect.kind in ("absorption", "ghost"):
            yield f"{key}: light does not enter a mirror (back.reflect), so it has no {effect.kind}; remove the table"
        if effect.kind == "fresnel" and mirror and effect.coating is not None:
            yield f"{key}.coating: a mirror's face is bare metal; remove it, or name the metal by {key}.metal"
        if effect.kind == "fresnel" and not mirror and effect.metal is not None:
            yield f"{key}.metal: is for a mirror (lens.back.reflect); remove it"
        if effect.kind == "absorption" and effect.coefficient is None and scene.lens.material is None:
            yield f"{key}.coefficient: missing, and lens.index names no material; add it in 1/mm, or give lens.material"
    try:
        scene.channels()
    except ValueError as error:
        yield f"effects: {error}"


def _order(scene: Wanted) -> Iterator[str]:
    point = isinstance(scene.source, Point)
    start = scene.source.position[2] if point else scene.source.z
    if point and scene.source.extent:
        start = source.foremost(scene)
    front = scene.lens.front.z + _sags(scene.lens)[0]
    if scene.lens.back.reflect:
        yield from _before_a_mirror(scene, "source.position" if point else "source.z", start)
    elif start is not None and not start < front:
        key = "source.position" if point else "source.z"
        yield f"{key}: the light starts at z = {start:g}, not before the front at z = {front:g}; move one of them"
    place = "above the mirror, whose face" if scene.lens.back.reflect else "behind the lens, whose back"
    if not scene.target.z > scene.lens.back.z:
        yield (
            f"target.z: the target at z = {scene.target.z:g} is not {place} is at z = {scene.lens.back.z:g}; "
            "move it further along +z"
        )


def _tilt(scene: Wanted) -> Iterator[str]:
    """A tilted target faces the lens, all of it lies beyond, and its plane passes the lens."""
    screen, back, optic = scene.target.screen, scene.lens.back.z, scene.optic
    plane = screen.plane
    if not isinstance(plane, TiltedPlane):
        return
    vertex = (0.0, 0.0, back)
    lowest = min(plane.point(x, y)[2] for x in screen.x for y in screen.y)
    if not -plane.height(vertex) > math.sin(EDGE_ON) * math.dist(plane.centre, vertex):
        yield (
            f"target.tilt: the target plane is edge-on to the {optic}, or shows it its rear; "
            "turn it less, or move the target"
        )
    elif not clearance(scene, back) > 0:
        yield f"target.tilt: the target plane cuts into the {optic}; turn it less, or move the target further along +z"
    elif not lowest > back:
        yield (
            f"target.tilt: an edge of the target comes down to z = {lowest:.6g}, not beyond the {optic}, whose back is "
            f"at z = {back:g}; turn it less, make it smaller or move it further along +z"
        )


def clearance(scene: Wanted, highest: float) -> float:
    """How far (mm) the target's plane passes a lens that reaches up to z = highest (mm); negative: it cuts it."""
    plane, outline = scene.target.screen.plane, scene.lens.outline
    if not isinstance(plane, TiltedPlane):
        return plane - highest
    n_x, n_y, _ = plane.axes[2]
    if isinstance(outline, Circle):
        across = outline.radius * math.hypot(n_x, n_y)
    else:
        across = sum(abs(n) * half for n, half in zip((n_x, n_y), outline.half_extent, strict=True))
    return -plane.height((0.0, 0.0, highest)) - across


def _before_a_mirror(scene: Wanted, key: str, start: float | None) -> Iterator[str]:
    """A mirror looks along +z: its light comes from above, and its rear is dark."""
    back = scene.lens.back.z
    if start is None:
        yield f"{key}: missing, and a mirror's light comes from above; add the plane it starts from, above z = {back:g}"
    elif not start > back:
        yield f"{key}: the light starts at z = {start:g}, not above the mirror at z = {back:g}; move one of them"
    if scene.lens.front.free:
        yield "lens.front.optimise: the front of a mirror is the rear of its plate, which no light meets; remove it"


def _levels(scene: Wanted) -> Iterator[str]:
    levels, m = scene.tailoring.levels, scene.lens.back.control_points
    if levels is None:
        return
    if not levels or levels[-1] != m:
        yield f"tailoring.levels: must end with the back's control_points, {m}; add it at the end"
    if any(coarse >= fine for coarse, fine in zip(levels, levels[1:], strict=False)):
        yield f"tailoring.levels: {list(levels)} does not grow; list the nets from coarse to fine"


def _stops(scene: Wanted) -> Iterator[str]:
    wanted = scene.tailoring
    who, other = {
        "adam": ("the paper's procedure", "quality"),
        "integration": ("point-by-point integration", "tailoring.method"),
    }.get(wanted.method or PRESETS[wanted.quality]["method"], ("", ""))
    for name in ("accuracy", "max_time"):
        if who and getattr(wanted, name) is not None:
            yield f"tailoring.{name}: {who} runs to its end; remove it or choose another {other}"


def _integrated(scene: Wanted) -> Iterator[str]:
    """Point-by-point integration has a front that stands, and nothing after it."""
    if scene.tailoring.method != "integration":
        return
    if scene.lens.front.free:
        yield (
            "lens.front.optimise: point-by-point integration finds no front; remove it and give the front as it shall "
            "be, or choose another tailoring.method"
        )
    if scene.tailoring.stage2_iterations:
        yield (
            "tailoring.stage2_iterations: point-by-point integration is followed by no stage 2; remove it or choose "
            "another tailoring.method"
        )


def _errors(scene: Wanted) -> Iterator[str]:
    yield from tolerance.complaints(scene.tolerance)


def _part(scene: Wanted) -> Iterator[str]:
    yield from part.complaints(scene.part, scene.lens)


def rim_sags(scene: Wanted) -> tuple[float, float]:
    """Between which sags at the rim (mm) a front of the scene, whose own is possible, may be bent.

    The blank keeps lens.min_thickness at the rim, and the rim stays behind the source.
    """
    lens, source = scene.lens, scene.source
    start = source.position[2] if isinstance(source, Point) else source.z
    falls = start - lens.front.z if start is not None else -math.inf
    return INSIDE * falls, INSIDE * (lens.back.z - lens.front.z - lens.min_thickness)


def _sags(lens: LensBlank) -> tuple[float, float]:
    """Lowest and highest sag of the front inside the outline (mm), and zero."""
    return lens.front.surface.sags(lens.outline)
