"""The face that a tool cuts, seen from the side of the tool, and the heights at which a round tool touches it.

The centre of a ball of radius r that touches the face at S is S + r n, n the unit normal on the tool's side.  A machine
states the place (x, y) of the tool; its height without gouge is the maximum over the face of the touching condition
(optics/kernels/tool_contact.py).  If r is below the radius of every valley, each place has one contact, which Newton's
method finds from the place itself; else the highest contact is searched for on a lattice, and refined.

The net of a face ends two knot spans beyond the rim of the lens.  The tool respects this strip like the face.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.kernels.tool_contact import MAX_LATTICE, NetFrame, Search, ball_heights, nose_heights
from bstcad.optics.surfaces import bspline
from bstcad.optics.surfaces.bspline import BSplineSurface, Jet, Spans, span_points
from bstcad.optics.surfaces.outlines import Outline, Rectangle

ROLLING = 0.98  # radius of the tool times the largest curvature of a valley, up to which each place has one contact
POINTS_PER_SPAN = 4  # lattice places per knot span along x and y
STRIP = 3  # width of the strip beyond the rim (spacings of the control points) in which the shape of the face counts
REFINEMENT = 20  # factor of each refinement of the grid about the highest point
MISSED = 10.0  # height that chords may cut off where a tool changes its contact, in tolerances of the path
REACH_MARGIN = 1.02  # factor on the distance between the place of a tool and its contact

Solver = Callable[[Tensor, tuple[NetFrame, Search], np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class MachinedShape:
    """Extremes of a face inside its outline and in the strip around it."""

    slope: float  # largest |∇z|
    valley: float  # largest curvature of a valley, 1/mm; negative: there is no valley
    bend: float  # largest magnitude of a principal curvature, 1/mm


@dataclass(frozen=True)
class MachinedFace:
    """Face z(x, y) that a tool cuts from +z, in float64 on the CPU, and the outline of the lens."""

    net: BSplineSurface  # the exact face
    outline: Outline  # outline of the lens, mm

    @classmethod
    def back(cls, net: BSplineSurface, outline: Outline) -> MachinedFace:
        """Return the back of a lens, which a tool cuts from +z as the scene has it."""
        return cls(net.plain(), outline)

    @classmethod
    def front(cls, net: BSplineSurface, outline: Outline) -> MachinedFace:
        """Return the front of a lens, turned over about the y axis: x and z are those of the scene times -1."""
        net, (low, high) = net.plain(), net.x
        return cls(replace(net, z=-net.z, heights=-net.heights.flip(0), x=(-high, -low)), outline)

    def part(self, x: tuple[float, float], y: tuple[float, float]) -> MachinedFace:
        """Return the face over the rectangle from x[0] to x[1] and y[0] to y[1] (mm), with the axis at its centre."""
        (x0, x1), (y0, y1), at_x, at_y = self.net.x, self.net.y, sum(x) / 2, sum(y) / 2
        net = replace(self.net, x=(x0 - at_x, x1 - at_x), y=(y0 - at_y, y1 - at_y))
        return MachinedFace(net, Rectangle(x[1] - x[0], y[1] - y[0]))

    def spans(self) -> tuple[Tensor, Tensor]:
        """Return the numbers (i, j) of the knot spans inside the outline and in the strip around it."""
        m, n = self.net.shape
        i, j = (k.reshape(-1) for k in torch.meshgrid(torch.arange(m - 2), torch.arange(n - 2), indexing="ij"))
        x, y = (at.reshape(-1) for at in torch.broadcast_tensors(*span_points(self.net, i, j, (0.5,))))
        near = self.outline.depth(x.numpy(), y.numpy()) > -STRIP * max(self.net.pitch)
        return i[torch.from_numpy(near)], j[torch.from_numpy(near)]

    def jets(self, positions: tuple[float, ...]) -> list[Jet]:
        """Return the derivatives of the face at positions x positions of each span of `spans`, in parts."""
        i, j = self.spans()
        parts = zip(i.split(bspline.SPANS_AT_A_TIME), j.split(bspline.SPANS_AT_A_TIME), strict=True)
        return [Spans.of(self.net, *part).jet(positions) for part in parts]

    @cached_property
    def shape(self) -> MachinedShape:
        """Extremes of slope and curvature, at five positions along each side of a span."""
        slope, valley, ridge = 0.0, -math.inf, -math.inf
        for jet in self.jets(bspline.QUARTERS):
            concave, convex = jet.curvatures
            slope = max(slope, float(jet.slope.max()))
            valley, ridge = max(valley, float(concave.max())), max(ridge, -float(convex.min()))
        return MachinedShape(slope, valley, bend=max(abs(valley), abs(ridge)))

    def refuse_steep(self, steepest: float, tool: str) -> None:
        """Raise ValueError if a part of the face is steeper than this tool reaches (degrees)."""
        slope = math.degrees(math.atan(self.shape.slope))
        if slope > steepest:
            steep = f"the face is {slope:.3g} degrees steep, and a {tool} reaches {steepest:g} degrees"
            raise ValueError(f"{steep}; limit lens.max_slope, or cut the face on a machine with more axes")

    def heights(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return z (mm) of the face at points (mm)."""
        return self.net.sag_and_slope(torch.from_numpy(x), torch.from_numpy(y))[0].numpy()

    @property
    def slopes_on_axis(self) -> tuple[Tensor, Tensor]:
        """Slopes ∂z/∂x and ∂z/∂y of the face on the axis."""
        axis = torch.zeros((), dtype=torch.float64)
        return self.net.sag_and_slope(axis, axis)[1:]

    @property
    def vertex_z(self) -> float:
        """Position z (mm) of the face on the axis."""
        return self.net.vertex_z

    @cached_property
    def grid(self) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]:
        """Points (x, y) inside the outline, two per control point and axis, and z, ∂z/∂x and ∂z/∂y there (mm)."""
        halves = zip(self.outline.half_extent, self.net.shape, strict=True)
        axes = (torch.linspace(-half, half, 2 * m + 1, dtype=torch.float64) for half, m in halves)
        x, y = (at.reshape(-1) for at in torch.meshgrid(*axes, indexing="ij"))
        inside = self.outline.contains(x, y)
        x, y = x[inside], y[inside]
        return (x, y), self.net.sag_and_slope(x, y)

    @cached_property
    def highest(self) -> float:
        """Highest z (mm) of the face inside its outline: that of the grid, refined twice about its place."""
        (x, y), (z, _, _) = self.grid
        best, step = int(z.argmax()), max(self.net.pitch) / 2
        place, top = (float(x[best]), float(y[best])), float(z[best])
        for _ in range(2):
            near = torch.linspace(-step, step, 2 * REFINEMENT + 1, dtype=torch.float64)
            x, y = (at.reshape(-1) for at in torch.meshgrid(place[0] + near, place[1] + near, indexing="ij"))
            z = torch.where(self.outline.contains(x, y), self.net.sag_and_slope(x, y)[0], -math.inf)
            best, step = int(z.argmax()), step / REFINEMENT
            if float(z[best]) > top:
                place, top = (float(x[best]), float(y[best])), float(z[best])
        return top


@dataclass(frozen=True)
class RoundTool:
    """Round tool of radius r on a face: a ball, or the nose of a lathe tool."""

    face: MachinedFace
    radius: float  # r, mm

    @property
    def reaches_all(self) -> bool:
        """True if the tool is smaller than every valley of the face."""
        return self.radius * self.face.shape.valley < ROLLING

    def spacing(self, tolerance: float) -> float:
        """Return the spacing (mm) of places along a path from which chords within a tolerance (mm) are found.

        It is half a knot span.  A tool that is larger than a valley changes its contact along the path: contacts that
        are highest over a short way only are then missed up to a height h = MISSED tolerances, by places sqrt(4 h r)
        apart.
        """
        half = self.face.net.detail / 2
        return half if self.reaches_all else min(half, math.sqrt(4 * MISSED * tolerance * self.radius))

    @property
    def reach(self) -> float:
        """Largest distance (mm) in x and y between the centre of the tool and its contact on the face."""
        slope = self.face.shape.slope
        return min(REACH_MARGIN * slope / math.hypot(1.0, slope), 0.95) * self.radius

    def ball(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return z (mm) of the centre of a ball over places (x, y) (mm)."""
        return self._solved(ball_heights, x, y)

    def nose(self, x: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Return z (mm) of the centre of a nose at distances x (mm) from the axis and angles of the part (radians)."""
        return self._solved(nose_heights, x, angle)

    def _solved(self, solve: Solver, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        net, frame = self.face.net, self._frame
        z, found = solve(net.heights, (frame, self._search(0.0 if self.reaches_all else self.reach)), x, y)
        if not found.all():
            again = ~found
            z[again], found[again] = solve(net.heights, (frame, self._search(self.reach)), x[again], y[again])
        if not found.all():
            raise ValueError(f"a tool of {self.radius:g} mm finds no contact with the face; give a larger tool_radius")
        return float(net.z) + z

    @cached_property
    def _frame(self) -> NetFrame:
        net = self.face.net
        (x0, x1), (y0, y1), (per_x, per_y) = net.x, net.y, (1 / pitch for pitch in net.pitch)
        return NetFrame(*net.shape, float(x0), float(y0), per_x=per_x, per_y=per_y, wide=x1 - x0, high=y1 - y0)

    def _search(self, window: float) -> Search:
        """Return a search; a lattice misses the top of a maximum by at most step² (κ + 1 / (r cos³ θ)) / 4."""
        shape = self.face.shape
        step = max(min(self.face.net.detail / POINTS_PER_SPAN, self.radius / 4), 2 * window / (MAX_LATTICE - 2))
        sharpest = shape.bend + (1 + shape.slope**2) ** 1.5 / self.radius
        return Search(self.radius, window, step, slack=step * step * sharpest / 4)
