"""The checks of a scene: can the lens be made from it?  Each complaint is one sentence with a remedy.

Each table's module has the `complaints` about that table; here are those that need several tables.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from bstcad.optics.outlines import Circle, Outline
from bstcad.optics.rays import TiltedPlane
from bstcad.optics.sources import Collimated, Point
from bstcad.scene import effects, mount, source, tolerance
from bstcad.scene.blank import INDICES
from bstcad.scene.fields import out_of_range
from bstcad.scene.model import SceneModel

INSIDE = 0.999  # of the way to where a front would be refused: where the search may go
TINY, FAR = 0.5, 10.0  # mm; in metres no lens is wider than the one, no target further than the other
NARROW = 20.0  # times narrower than the lens: the light of a lens is seldom gathered so far
EDGE_ON = math.radians(1.0)  # a plane seen under less than that has no picture
SINGLE = 2.0**-24  # of a coordinate in STL
FINEST = 4 * SINGLE  # of the largest coordinate: no tolerance of a mesh is finer
COVERED = 0.9  # of the lens's width: a beam narrower than that leaves a part dark that somebody pays for


def complaints(scene: SceneModel) -> Iterator[str]:
    """Everything that keeps the scene from being built, the most basic first."""
    lens = scene.lens
    yield from out_of_range(scene)
    yield from source.complaints(scene.source, lens)
    yield from _material(scene)
    yield from lens.room()
    yield from effects.complaints(scene.effects, lens)
    yield from _channels(scene)
    yield from source.order(scene.source, lens)
    yield from _order(scene)
    yield from source.unlit(scene.source, lens, scene.rim)
    yield from _tilt(scene)
    yield from scene.tailoring.complaints(lens)
    yield from tolerance.complaints(scene.tolerance)
    yield from lens.complaints()
    yield from _mesh(scene)
    yield from scene.part.complaints(lens)
    if scene.mount is not None:
        yield from mount.complaints(scene.mount, lens)


def doubts(scene: SceneModel) -> Iterator[str]:
    """What is possible but perhaps not meant."""
    yield from metres(scene)
    if isinstance(scene.source, Collimated):
        key = "mount.rim" if scene.mount and scene.mount.rim else "lens.outline"
        yield from _beam(scene.source.aperture, scene.rim, key)


def metres(scene: SceneModel) -> Iterator[str]:
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


def _material(scene: SceneModel) -> Iterator[str]:
    try:
        indices = [scene.index_at(nm) for nm, _ in scene.source.lines]
    except ValueError as error:
        yield f"lens.material: {error}"
        return
    low, high = INDICES
    for index in (n for n in indices if scene.lens.material is not None and not low <= n <= high):
        yield (
            f"lens.material: the index of {scene.lens.material} is {index:.4g} there, not between {low:g} and "
            f"{high:g}; choose what lets the source's light through"
        )


def _channels(scene: SceneModel) -> Iterator[str]:
    """Data of the material or the metal that an effect lacks."""
    try:
        scene.channels()
    except ValueError as error:
        yield f"effects: {error}"


def _order(scene: SceneModel) -> Iterator[str]:
    """A mirror whose front is to be found, and a target that does not lie beyond the back."""
    lens = scene.lens
    if lens.back.reflect and lens.front.free:
        yield "lens.front.optimise: the front of a mirror is the rear of its plate, which no light meets; remove it"
    place = "above the mirror, whose face" if lens.back.reflect else "behind the lens, whose back"
    if not scene.target.z > lens.back.z:
        yield (
            f"target.z: the target at z = {scene.target.z:g} is not {place} is at z = {lens.back.z:g}; "
            "move it further along +z"
        )


def _mesh(scene: SceneModel) -> Iterator[str]:
    """STL holds single precision, half of whose last place is SINGLE of a number."""
    asked, lens = scene.output.mesh_tolerance, scene.lens
    size = max(*lens.outline.half_extent, abs(lens.front.z), abs(lens.back.z))
    if asked is not None and asked < (least := FINEST * size):
        yield (
            f"output.mesh_tolerance: {asked:g} mm, and coordinates of {size:g} mm in an STL file are rounded by up to "
            f"{SINGLE * size:.1g} mm; ask for {least:.2g} mm or more"
        )


def _tilt(scene: SceneModel) -> Iterator[str]:
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


def clearance(scene: SceneModel, highest: float) -> float:
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


def rim_sags(scene: SceneModel) -> tuple[float, float]:
    """Between which sags at the rim (mm) a front of the scene, whose own is possible, may be bent.

    The blank keeps lens.min_thickness at the rim, and the rim stays behind the source.
    """
    lens, source = scene.lens, scene.source
    start = source.position[2] if isinstance(source, Point) else source.z
    falls = start - lens.front.z if start is not None else -math.inf
    return INSIDE * falls, INSIDE * (lens.back.z - lens.front.z - lens.min_thickness)
