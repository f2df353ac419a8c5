"""Does each face of a STEP file look out of the lens, and does each edge and loop run as its flags say?

OCC mends such flags silently while it reads; another program may show the lens inside out.  So they are judged from the
text: the back looks towards +z and a curved front towards -z; planes and walls look to where their outer loop runs
counterclockwise, and so does the back, which makes all of a closed shell look out (neighbours walk the edge they share
in opposite directions), whatever its outline and holes; an edge's curve runs from its first vertex to its second, and
the edges of a loop follow one another.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bstcad.step_text.entities import Entities
from bstcad.step_text.face_loops import about_a_ruled_wall, counterclockwise, seen_from_above
from bstcad.step_text.syntax import Points, Statements

HALF = 1e-9  # of a circle's radius squared; arcs that are nearer to half of it have no short way


def turned(
    statements: Statements, points: Points, back: np.ndarray, front: np.ndarray | None = None
) -> tuple[str, ...]:
    """The faces, edges and loops that do not, such as 'face #17'; back, front: the nets of the freeform faces."""
    entities = Entities(statements, points)
    return (*_faces(entities, back, front), *_edges(entities), *_loops(entities))


def _faces(entities: Entities, back: np.ndarray, front: np.ndarray | None) -> Iterator[str]:
    for face in entities.of("ADVANCED_FACE"):
        *bounds, surface = entities.names(face)
        if (not entities.forward(face)) in _look_out(entities, bounds, surface, back, front):
            yield f"face #{face}"


def _look_out(
    entities: Entities, bounds: list[str], surface: str, back: np.ndarray, front: np.ndarray | None
) -> Iterator[bool | None]:
    """Does the surface's own normal look out of the lens?  By where it lies, and by its loop; None: nobody knows."""
    kind = entities.kind(surface)
    if kind == "SPHERICAL_SURFACE":  # a cap: the pole that its rim is nearer to
        centre, _ = entities.placement(entities.names(surface)[0])
        [edge, *_] = entities.names(entities.names(bounds[0])[0])
        yield bool(entities.ends(entities.names(edge)[0])[0, 2] < centre[2])
    if kind not in ("B_SPLINE_SURFACE_WITH_KNOTS", "COMPLEX"):
        yield counterclockwise(entities, bounds, surface)
        return
    poles = entities.points(entities.names(surface))
    if entities.ruled(surface):
        yield about_a_ruled_wall(entities, bounds, poles.reshape(-1, 2, 3))
        return
    if len(poles) == 9:  # a conic, or so flat a sphere that it is a patch of 3 x 3
        yield not _rises(poles.reshape(3, 3, 3))
    for net, upwards in ((back, True), (front, False)):
        if net is not None and np.array_equal(net.reshape(-1, 3), poles):
            yield _rises(net) == upwards
            from_above = seen_from_above(entities, bounds)
            yield None if from_above is None else from_above == _rises(net)


def _rises(net: np.ndarray) -> bool:
    """Does the normal ∂u x ∂v of a net point towards +z?"""
    return bool(np.cross(net[-1, 0] - net[0, 0], net[0, -1] - net[0, 0])[2] > 0)


def _edges(entities: Entities) -> Iterator[str]:
    for edge in entities.of("EDGE_CURVE"):
        ends, curve = entities.ends(edge), entities.curve(edge)
        if not np.array_equal(*ends) and _runs_along(entities, curve, ends) == (not entities.forward(edge)):
            yield f"edge #{edge}"


def _runs_along(entities: Entities, curve: str, ends: np.ndarray) -> bool | None:
    """Does the curve run from the first of two points to the second?  None: it is none that a lens has."""
    kind, (first, second) = entities.kind(curve), ends
    if kind == "LINE":
        return bool(entities.numbers(entities.names(entities.names(curve)[1])[0]) @ (second - first) > 0)
    if kind == "CIRCLE":  # the short way
        centre, axis = entities.placement(entities.names(curve)[0])
        turn = float(np.cross(first - centre, second - centre) @ axis)
        return turn > 0 if abs(turn) > HALF * float((first - centre) @ (first - centre)) else None
    if kind == "B_SPLINE_CURVE_WITH_KNOTS":
        start = entities.points(entities.names(curve)[:1])[0]
        return bool(np.linalg.norm(start - first) < np.linalg.norm(start - second))
    return None


def _loops(entities: Entities) -> Iterator[str]:
    for loop in entities.of("EDGE_LOOP"):
        walked = []
        for oriented in entities.names(loop):
            start, end = entities.names(entities.names(oriented)[0])[:2]
            walked.append((start, end) if entities.forward(oriented) else (end, start))
        if any(before[1] != after[0] for before, after in zip(walked, walked[1:] + walked[:1], strict=True)):
            yield f"loop #{loop}"
