"""What the entities of a STEP file refer to, asked by their numbers."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from bstcad.step_text.syntax import REAL, Points, Statements

RULED = re.compile(r"\('',\d+,1,\(\(#\d+,#\d+\)")  # of degree 1 from row to row of a net that is two wide
Z_AXIS = np.array([0.0, 0.0, 1.0])  # of a placement that says nothing else


class Entities:
    """The entities of a file; a face, an edge or a curve is named by its number's digits."""

    def __init__(self, statements: Statements, points: Points) -> None:
        self._statements, self._points = statements, points

    def of(self, *kinds: str) -> Iterator[str]:
        """The entities of some kinds."""
        return (name for name, (kind, _) in self._statements.items() if kind in kinds)

    def kind(self, name: str) -> str:
        """Its kind, COMPLEX for a complex one."""
        return self._statements[name][0]

    def attributes(self, name: str) -> str:
        """All of it behind its kind, as the file has it, without strings and blanks."""
        return self._statements[name][1]

    def names(self, name: str) -> list[str]:
        """The entities that it refers to, in order."""
        return re.findall(r"#(\d+)", self._statements[name][1])

    def forward(self, name: str) -> bool:
        """Is its last attribute true?"""
        return self._statements[name][1].endswith(",.T.)")

    def ruled(self, name: str) -> bool:
        """Is it a B-spline surface of straight lines between two curves?"""
        return RULED.match(self._statements[name][1]) is not None

    def points(self, names: list[str]) -> np.ndarray:
        """(n, 3) of points in space."""
        return self._points.at(np.array(names, dtype=np.int64))

    def numbers(self, name: str) -> np.ndarray:
        """The reals among its attributes, such as those of a direction or the radii of an ellipse."""
        return np.array([float(value) for value in re.findall(REAL, self._statements[name][1])])

    def placement(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(place, axis); the axis is z unless the file says otherwise."""
        place, *axis = self.names(name)
        return self.points([place])[0], self.numbers(axis[0]) if axis else Z_AXIS

    def ends(self, edge: str) -> np.ndarray:
        """The first and the second vertex of an EDGE_CURVE, (2, 3)."""
        return self.points([self.names(vertex)[0] for vertex in self.names(edge)[:2]])

    def curve(self, edge: str) -> str:
        """The curve in space of an EDGE_CURVE."""
        curve = self.names(edge)[2]
        return self.names(curve)[0] if self.kind(curve) in ("SURFACE_CURVE", "SEAM_CURVE") else curve
