"""Spiral for a lathe with a slow tool servo: the spindle turns by C, X moves inwards uniformly, and Z follows the face.

    X(C) = max(X_0 - p C / 2π, 0),   Z(C) = height of the nose's centre in the plane at the angle C, less r.

The nose is round in this plane (X-Z) only: its edge lies in the plane of the axis and the direction C, so that it is
compensated along the normal of the section of the face with this plane.  X_0 lies beyond the point of the outline that
is farthest from the axis by at least the largest distance between nose and contact.  A last turn at X = 0 ends the cut.

Outside the outline of a lens that is not round, Z keeps its value at the border of the net, the sharp edge of which the
nose has then left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from bstcad.toolpath import chords, cusps
from bstcad.toolpath.cusps import ToolPasses
from bstcad.toolpath.cutting import LATHE, Cutting
from bstcad.toolpath.machined_face import MachinedFace, RoundTool

MAX_NOSE_SLOPE = 60.0  # steepest face (degrees) that the round edge of a nose reaches, with an included angle of 120°
ANGLE_DIGITS = 7  # decimals of C (degrees): a tenth of a nanometre at 50 mm from the axis
MIN_STEPS = 24  # smallest number of places per turn at which the subdivision starts


@dataclass(frozen=True)
class Spiral:
    """Points of a spiral, in the order of the cut, rounded as they are written (z: relative to the vertex)."""

    angle: np.ndarray  # C, angle of the part under the tool from +x towards +y, running from turn to turn (degrees)
    x: np.ndarray  # distance of the nose's centre, which is that of its lowest point, from the axis (mm)
    z: np.ndarray  # z of the nose's lowest point (mm)
    tool: RoundTool
    cutting: Cutting  # completed settings
    passes: ToolPasses  # pitch p (mm per turn) and cusp
    slope_along_cut: float  # largest slope of the path along the cut, for the clearance of the tool
    slope_at_axis: float  # slope of the face on the axis, which the nose touches beyond the axis by r sin(atan slope)

    @property
    def face(self) -> MachinedFace:
        """Face that the spiral cuts."""
        return self.tool.face

    @property
    def turns(self) -> float:
        """Number of turns."""
        return float(self.angle[-1]) / 360


def spiral(face: MachinedFace, wanted: Cutting) -> Spiral:
    """Return the spiral that cuts a face; ValueError if the face is too steep for a nose or the path too long."""
    cutting = wanted.completed(LATHE)
    tool, (cusp, tolerance) = RoundTool(face, cutting.radius), cutting.finish
    face.refuse_steep(MAX_NOSE_SLOPE, "nose")
    passes = cusps.spiral_passes(tool, cusps.for_passes(cusp, tolerance), cutting.pitch)
    pitch = passes.pitch
    inwards = math.ceil(
        (math.hypot(*face.outline.farthest) + tool.reach) / pitch
    )  # whole turns, to end at an angle of 0
    start, turns = inwards * pitch, inwards + 1
    chords.refuse_many(turns * MIN_STEPS)

    def distance(turn: np.ndarray) -> np.ndarray:
        return np.maximum(start - pitch * turn, 0.0)

    def height(turn: np.ndarray) -> np.ndarray:
        return nose_height(tool, turn, distance(turn))

    turn, centre = chords.within_tolerance(_first_places(tool.spacing(tolerance), distance, turns), height, tolerance)
    angle, places = np.round(360 * turn, ANGLE_DIGITS), chords.digits(tolerance)
    x, z = np.round(distance(turn), places), face.vertex_z + np.round(centre - tool.radius - face.vertex_z, places)
    z_x, z_y = (float(part) for part in face.slopes_on_axis)
    return Spiral(
        angle, x, z, tool=tool, cutting=cutting, passes=passes,
        slope_along_cut=_slope_along_cut(face), slope_at_axis=math.hypot(z_x, z_y),
    )  # fmt: skip


def flat_places(face: MachinedFace, wanted: Cutting) -> float:
    """Return the number of places at which the spiral of a plane with the outline and net of a face begins."""
    cutting, r = wanted.completed(LATHE), math.hypot(*face.outline.farthest)
    cusp = cusps.for_passes(*cutting.finish)
    return (
        math.pi
        * r
        * r
        / (cusps.flat_pitch(cutting.radius, cusp, cutting.pitch, cusps.SPIRAL_PITCHES) * face.net.detail / 2)
    )


def nose_height(tool: RoundTool, turn: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return z (mm) of the centre of a nose after so many turns, at distances x (mm) from the axis."""
    angle = 2 * math.pi * np.remainder(turn, 1.0)
    return tool.nose(np.minimum(x, _border(tool.face, angle) + tool.reach), angle)


def _slope_along_cut(face: MachinedFace) -> float:
    """Return the largest |∂z/∂ψ| / ρ of the face inside its outline, at two points per control point and axis."""
    (x, y), (_, z_x, z_y) = face.grid
    return float(((x * z_y - y * z_x) / torch.hypot(x, y).clamp_min(1e-9)).abs().max())


def _border(face: MachinedFace, angle: np.ndarray) -> np.ndarray:
    """Return the distance (mm) from the axis to the border of the net in directions `angle` (radians)."""
    (x0, x1), (y0, y1) = face.net.x, face.net.y
    c, s = np.cos(angle), np.sin(angle)
    tiny = 1e-12
    to_x = np.where(c > 0, x1, -x0) / np.maximum(np.abs(c), tiny)
    return np.minimum(to_x, np.where(s > 0, y1, -y0) / np.maximum(np.abs(s), tiny))


def _first_places(spacing: float, distance: chords.Height, turns: int) -> np.ndarray:
    """Return increasing numbers of turns: places at most `spacing` mm apart along the spiral."""
    radius = distance(np.arange(turns))
    counts = np.maximum(np.ceil(2 * math.pi * radius / spacing), MIN_STEPS).astype(np.int64)
    chords.refuse_many(float(counts.sum()))
    which = np.repeat(np.arange(turns), counts)
    step = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.append(which + step / counts[which], float(turns))
