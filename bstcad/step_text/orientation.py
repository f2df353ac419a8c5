"""Does each face of a STEP file look out of the lens, and does each edge and loop run as its flags say?

OCC mends such flags silently while it reads; another program may show the lens inside out.  So they are judged from the
text: the back looks towards +z, the front towards -z, the wall away from the axis; an edge's curve runs from its first
vertex to its second, and the edges of a loop follow one another.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from bstcad.step_text.syntax import REAL, Points, Statements


def turned(
    statements: Statements, points: Points, back: np.ndarray, front: np.ndarray | None = None
) -> tuple[str, ...]:
    """The faces, edges and loops that do not, such as 'face #17'; back, front: the nets of the freeform faces."""
    text = _Text(statements, points)
    return (*_faces(text, back, front), *_edges(text), *_loops(text))


class _Text:
    """What the entities of a file refer to."""

    def __init__(self, statements: Statements, points: Points) -> None:
        self._statements, self._points = statements, points

    def of(self, *kinds: str) -> Iterator[str]:
        return (name for name, (kind, _) in self._statements.items() if kind in kinds)

    def kind(self, name: str) -> str:
        return self._statements[name][0]

    def names(self, name: str) -> list[str]:
        return re.findall(r"#(\d+)", self._statements[name][1])

    def forward(self, name: str) -> bool:
        return self._statements[name][1].endswith(",.T.)")

    def points(self, names: list[str]) -> np.ndarray:
        return self._points.at(np.array(names, dtype=np.int64))

    def direction(self, name: str) -> np.ndarray:
        return np.array([float(value) for value in re.findall(REAL, self._statements[name][1])])

    def placement(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(place, axis); the axis is z unless the file says otherwise."""
        place, *axis = self.names(name)
        return self.points([place])[0], self.direction(axis[0]) if axis else np.array([0.0, 0.0, 1.0])

    def ends(self, edge: str) -> np.ndarray:
        """The first and the second vertex of an EDGE_CURVE, (2, 3)."""
        return self.points([self.names(vertex)[0] for vertex in self.names(edge)[:2]])


def _faces(text: _Text, back: np.ndarray, front: np.ndarray | None) -> Iterator[str]:
    for face in text.of("ADVANCED_FACE"):
        *bounds, surface = text.names(face)
        if _looks_out(text, bounds, surface, back, front) == (not text.forward(face)):
            yield f"face #{face}"


def _looks_out(text: _Text, bounds: list[str], surface: str, back: np.ndarray, front: np.ndarray | None) -> bool | None:
    """Does the surface's own normal look out of the lens?  None: it is none that a lens has."""
    kind = text.kind(surface)
    if kind == "CYLINDRICAL_SURFACE":
        return True
    if kind == "PLANE":
        place, normal = text.placement(text.names(surface)[0])
        return bool(normal[2] < 0 if abs(normal[2]) > 0.5 else normal[:2] @ place[:2] > 0)
    if kind == "SPHERICAL_SURFACE":  # a cap: the pole that its rim is nearer to
        centre, _ = text.placement(text.names(surface)[0])
        [edge, *_] = text.names(text.names(bounds[0])[0])
        return bool(text.ends(text.names(edge)[0])[0, 2] < centre[2])
    poles = text.points(text.names(surface))
    if len(poles) == 9:  # a conic, or so flat a sphere that it is a patch of 3 x 3
        return not _rises(poles.reshape(3, 3, 3))
    for net, upwards in ((back, True), (front, False)):
        if net is not None and np.array_equal(net.reshape(-1, 3), poles):
            return _rises(net) == upwards
    return None


def _rises(net: np.ndarray) -> bool:
    """Does the normal ∂u x ∂v of a net point towards +z?"""
    return bool(np.cross(net[-1, 0] - net[0, 0], net[0, -1] - net[0, 0])[2] > 0)


def _edges(text: _Text) -> Iterator[str]:
    for edge in text.of("EDGE_CURVE"):
        ends, curve = text.ends(edge), text.names(edge)[2]
        if text.kind(curve) in ("SURFACE_CURVE", "SEAM_CURVE"):
            curve = text.names(curve)[0]
        if not np.array_equal(*ends) and _runs_along(text, curve, ends) == (not text.forward(edge)):
            yield f"edge #{edge}"


def _runs_along(text: _Text, curve: str, ends: np.ndarray) -> bool | None:
    """Does the curve run from the first of two points to the second?  None: it is none that a lens has."""
    kind, (first, second) = text.kind(curve), ends
    if kind == "LINE":
        return bool(text.direction(text.names(text.names(curve)[1])[0]) @ (second - first) > 0)
    if kind == "CIRCLE":  # the short way
        centre, axis = text.placement(text.names(curve)[0])
        return bool(np.cross(first - centre, second - centre) @ axis > 0)
    if kind == "B_SPLINE_CURVE_WITH_KNOTS":
        start = text.points(text.names(curve)[:1])[0]
        return bool(np.linalg.norm(start - first) < np.linalg.norm(start - second))
    return None


def _loops(text: _Text) -> Iterator[str]:
    for loop in text.of("EDGE_LOOP"):
        walked = []
        for oriented in text.names(loop):
            start, end = text.names(text.names(oriented)[0])[:2]
            walked.append((start, end) if text.forward(oriented) else (end, start))
        if any(before[1] != after[0] for before, after in zip(walked, walked[1:] + walked[:1], strict=True)):
            yield f"loop #{loop}"
