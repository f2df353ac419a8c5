"""A plane or a sphere in any position: c |p - V|² = 2 N · (p - V), curvature c, unit normal N at vertex V, N_z > 0.

Windows and mirrors around a lens have such faces.  With u = (x, y) - (V_x, V_y) the height h over the plane z = V_z is
the root nearer to 0 of c h² - 2 N_z h + f = 0, f = c u² - 2 (N_x u_x + N_y u_y).  It is computed as f / (N_z +
sqrt(N_z² - c f)), which keeps its digits for c = 0, a plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.surfaces.motion import Motion
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.rays import Vector
from bstcad.optics.surfaces.surfaces import MIN_COS2, Surface


@dataclass(frozen=True)
class TiltedSurface(Surface):
    """A plane or a sphere with its vertex off the axis of the lens, or its normal there inclined to the axis."""

    z: float  # V_z, mm
    vertex_xy: tuple[float, float]  # (V_x, V_y), mm
    unit_normal: Vector  # unit normal N at the vertex
    face_curvature: float = 0.0  # curvature c, 1/mm; positive: concave towards +z

    kind = "tilted"

    @classmethod
    def of(cls, surface: Surface) -> TiltedSurface:
        """Return a plane or a sphere as a surface of this class."""
        if isinstance(surface, TiltedSurface):
            return surface
        return cls(float(surface.z), (0.0, 0.0), (0.0, 0.0, 1.0), float(surface.curvature))

    @property
    def vertex(self) -> Vector:
        """Vertex V (mm)."""
        return (*self.vertex_xy, self.z)

    def moved_by(self, motion: Motion) -> TiltedSurface:
        """Return the surface after a rigid motion with a rotation of less than a right angle."""
        x, y, z = motion.point(self.vertex)
        return replace(self, z=z, vertex_xy=(x, y), unit_normal=motion.direction(self.unit_normal))

    def _from_vertex(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (u_x in mm, u_y in mm, f in mm) at (x, y) in mm."""
        (n_x, n_y, _), (v_x, v_y) = self.unit_normal, self.vertex_xy
        x, y = x - v_x, y - v_y
        return x, y, self.face_curvature * (x * x + y * y) - 2 * (n_x * x + n_y * y)

    def _cos2(self, f: Tensor) -> Tensor:
        """Return N_z² - c f, the square of the z component of the normal."""
        return self.unit_normal[2] ** 2 - self.face_curvature * f

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (h in mm, ∂h/∂x, ∂h/∂y), ∂h/∂x = (c u_x - N_x) / (N_z - c h); meaningless where no surface exists."""
        x, y, f = self._from_vertex(x, y)
        cos2 = self._cos2(f)
        root = torch.sqrt(torch.where(cos2 > MIN_COS2, cos2, torch.full_like(cos2, MIN_COS2)))  # no NaN in the gradient
        n_x, n_y, n_z = self.unit_normal
        return f / (n_z + root), (self.face_curvature * x - n_x) / root, (self.face_curvature * y - n_y) / root

    def reaches(self, x: Tensor, y: Tensor) -> Tensor:
        """Return True where the surface has a point over (x, y) and is not vertical."""
        return self._cos2(self._from_vertex(x, y)[2]) > MIN_COS2

    def crossing(self, x: Tensor, y: Tensor, direction: Tensor, sense: int = 1) -> tuple[Tensor, Tensor]:
        """Return (path s in mm along rays from (x, y) on the plane z = V_z, True where they meet the surface).

        s = f / (g + sense sqrt(g² - c f)) is the root near the vertex of c s² - 2 g s + f = 0; d: unit direction,
        g = N · d - c u · d, sense: see Rays.
        """
        (n_x, n_y, n_z), (dx, dy, dz) = self.unit_normal, direction
        x, y, f = self._from_vertex(x, y)
        g = n_x * dx + n_y * dy + n_z * dz - self.face_curvature * (x * dx + y * dy)
        k = g * g - self.face_curvature * f
        below = g + sense * torch.sqrt(torch.where(k > 0, k, torch.ones_like(k)))
        ok = (k > 0) & (sense * below > MIN_COS2)
        s = f / torch.where(ok, below, torch.ones_like(below))
        return s, ok & (self.face_curvature * s * dz < n_z)

    def sags(self, outline: Outline) -> tuple[float, float]:
        """Return minimum and maximum (mm) of 0 and the heights over the plane z on the axis and at the outline."""
        x, y = (torch.from_numpy(np.append(p, 0.0)) for p in outline.rim_points())
        h = self.relative_sag_and_slope(x, y)[0]
        return min(float(h.min()), 0.0), max(float(h.max()), 0.0)

    def height_above(self, point: Vector) -> float:
        """Return N · (p - V), the height (mm) of a point above the tangent plane of the vertex."""
        return math.fsum(n * (p - v) for n, p, v in zip(self.unit_normal, point, self.vertex, strict=True))
