"""Pitch of neighbouring passes from the height of the cusps between them.

Two passes of a round tool of radius r, whose centres are D apart on the offset surface, leave a cusp of the height

    h = D² / 8 · (1 / r + κ_o),   κ_o = κ / (1 - r κ),

κ the curvature of the face across the passes (a valley is positive) and κ_o that of the offset surface.  For a plane
it is the textbook's p² / (8 r).  The formula is of second order in D / r.  A ridge has lower cusps than a plane for the
same pitch of the centres, and a valley higher ones: its contacts are further apart than the centres.

A lathe: the section in the plane of the nose, D² = p² (1 + f'²), and κ is the curvature of this section.
A router with lines along x: D² = p² N² / (1 + f_x²), N² = 1 + |∇f|², and κ_o is the curvature of the offset surface
across the lines, (W (I - r W)⁻¹)₂₂ with W the shape operator in the tangent basis along and across the lines.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from bstcad.optics.surfaces.bspline import Jet, span_points
from bstcad.toolpath.machined_face import RoundTool

POSITIONS = (0.25, 0.75)  # positions in each knot span at which the cusp is computed
TIGHT = 0.75  # radius of the tool times the curvature of a valley, above which a valley does not determine the pitch
SPIRAL_PITCHES = (1e-5, 0.5)  # smallest and largest pitch of a spiral, as a fraction of the radius of the tool
RASTER_PITCHES = (1e-3, 0.5)  # smallest and largest pitch of a raster, as a fraction of the radius of the tool

Sharpness = Callable[[Jet, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class ToolPasses:
    """Spacing of neighbouring passes, and the height of the highest cusp between them by the formula."""

    pitch: float  # mm
    cusp: float  # mm


def for_passes(cusp: float, tolerance: float) -> float:
    """Return the part of a cusp height (mm) that is left for the passes, since chords leave up to half a tolerance."""
    return max(cusp - tolerance / 2, cusp / 2)


def flat_pitch(radius: float, cusp: float, pitch: float | None, fractions: tuple[float, float]) -> float:
    """Return the pitch (mm) of passes over a plane; fractions: smallest and largest pitch / radius from a cusp."""
    return _passes(1 / radius, cusp, pitch, limits=(fractions[0] * radius, fractions[1] * radius)).pitch


def spiral_passes(tool: RoundTool, cusp: float, pitch: float | None) -> ToolPasses:
    """Return the passes of a spiral whose cusps in the plane of the nose are at most `cusp` (mm), or of this pitch."""

    def sharpness(jet: Jet, x: Tensor, y: Tensor) -> Tensor:
        r = torch.sqrt(x * x + y * y).clamp_min(torch.finfo(x.dtype).tiny)
        c, s = x / r, y / r
        slope2 = (jet.z_x * c + jet.z_y * s) ** 2
        bend = jet.z_xx * c * c + 2 * jet.z_xy * c * s + jet.z_yy * s * s
        room = 1 - tool.radius * bend / (1 + slope2) ** 1.5
        return (1 + slope2) / (tool.radius * room.clamp_min(1 - TIGHT))

    low, high = (fraction * tool.radius for fraction in SPIRAL_PITCHES)
    return _passes(_sharpest(tool, sharpness), cusp, pitch, (low, high))


def raster_passes(tool: RoundTool, cusp: float, pitch: float | None, along: str) -> ToolPasses:
    """Return the passes of lines along x or y whose cusps are at most `cusp` (mm), or of this pitch (mm)."""

    def sharpness(jet: Jet, x: Tensor, y: Tensor) -> Tensor:
        return _across_lines(jet if along == "x" else _exchanged(jet), tool.radius)

    low, high = (fraction * tool.radius for fraction in RASTER_PITCHES)
    return _passes(_sharpest(tool, sharpness), cusp, pitch, (low, high))


def _passes(sharpest: float, cusp: float, pitch: float | None, limits: tuple[float, float]) -> ToolPasses:
    """Return the passes for the largest 8 h / p² (1/mm); limits: smallest and largest pitch from a cusp (mm)."""
    p = pitch or min(max(math.sqrt(8 * cusp / sharpest), limits[0]), limits[1])
    return ToolPasses(p, p * p * sharpest / 8)


def _sharpest(tool: RoundTool, sharpness: Sharpness) -> float:
    """Return the largest 8 h / p² (1/mm) at all positions inside the outline."""
    face, largest = tool.face, 0.0
    i, j = face.spans()
    jets, start = face.jets(POSITIONS), 0
    for jet in jets:
        part = slice(start, start + jet.z_x.shape[-1])
        x, y = torch.broadcast_tensors(*span_points(face.net, i[part], j[part], POSITIONS))
        inside = face.outline.contains(x, y)
        if inside.any():
            largest = max(largest, float(sharpness(jet, x, y)[inside].max()))
        start = part.stop
    return largest


def _exchanged(jet: Jet) -> Jet:
    """Return the derivatives with x and y exchanged."""
    return Jet(jet.z_y, jet.z_x, z_xx=jet.z_yy, z_xy=jet.z_xy, z_yy=jet.z_xx)


def _across_lines(jet: Jet, radius: float) -> Tensor:
    """Return 8 h / p² (1/mm) of lines along x."""
    p, q = jet.z_x, jet.z_y
    length2 = 1 + p * p  # square of the tangent (1, 0, f_x)
    norm2 = length2 + q * q
    norm = norm2.sqrt()
    # second fundamental form for e₁ = (1, 0, f_x) / L and e₂ = n x e₁, in x and y (-f_x f_y, 1 + f_x²) / (L N)
    a, b = -p * q, length2
    along = jet.z_xx / (length2 * norm)
    mixed = (jet.z_xx * a + jet.z_xy * b) / (length2 * norm2)
    across = (jet.z_xx * a * a + 2 * jet.z_xy * a * b + jet.z_yy * b * b) / (length2 * norm2 * norm)
    # W (I - r W)⁻¹ = ((I - r W)⁻¹ - I) / r, so that 1 / r + its last entry is the last entry of (I - r W)⁻¹ / r
    det = (1 - radius * along) * (1 - radius * across) - (radius * mixed) ** 2
    room = det / (1 - radius * along).clamp_min(1 - TIGHT)
    return norm2 / length2 / (radius * room.clamp_min(1 - TIGHT))
