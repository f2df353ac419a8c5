"""Light of a lamp described on a sphere about a point, where planes would end: light of a half space for domes.

Emitters describe their light by points (x, y) of a plane.  Light that leads along this plane never meets it, and light
near that direction meets it far away.  `SphereLight` describes the light of a point near the centre c of a sphere by
the stereographic coordinates (x, y) of the point q = c + R d at which it leaves the sphere (charts.SphereChart).  With
the radiant intensity I of the source at p, the unit vector s = (q - p) / |q - p| and the stretch s_c of the chart,

    E(x, y) = I(s) (s · d) / |q - p|² s_c²    (1/mm² of the chart).

I follows from the irradiance E_D of the source on the plane at the distance D: I = E_D D² / cos³ θ, θ from +z.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bstcad.optics.light.emitters import Emitter, Wavelength, all_alive
from bstcad.optics.numerics.records import Beam, Frame3, SphereBeam
from bstcad.optics.surfaces.charts import SphereChart
from bstcad.optics.surfaces.motion import Motion
from bstcad.optics.surfaces.outlines import Circle, Outline, Rectangle
from bstcad.optics.surfaces.rays import Rays, Vector
from bstcad.optics.surfaces.surfaces import Surface

MIN_AXIAL_COSINE = 1e-6  # smallest cosine with +z of light: beyond it no irradiance on a plane is known

CONCENTRIC = 1e-9  # distance of a front's centre from the dome's, relative to its radius, up to which it bends no light
FRONT_MARGIN = 1e-4  # relative angle by which a front may end beyond the rim of the dome
RIM_ROUNDING = 1 + 1e-12  # factor of the square of the disc's radius, so that points of its rim lie inside


def light_angle(source: Emitter, front: Surface, centre: Vector, rim: float) -> float:
    """Return the angle (rad) from +z, seen from a dome's centre, up to which light is launched; rim: of the dome.

    It is 90 degrees, since a front may bend light from beyond the rim to the dome.  A front about a point source bends
    none.  If it ends at the rim, the light ends there, too, so that no flux tube crosses the rim.
    """
    if front.kind != "sphere" or source.extent is not None or source.start_point(centre[2]) != centre:
        return math.pi / 2
    c, _ = front.conic()
    ends = math.pi / 2 if front.outline is None else math.asin(min(front.outline.radius * abs(c), 1.0))
    bends = not c < 0 or abs(float(front.z) + 1 / c - centre[2]) > CONCENTRIC * abs(1 / c)
    return math.pi / 2 if bends or ends > rim * (1 + FRONT_MARGIN) else rim


@dataclass(frozen=True)
class SphereLight(Emitter):
    """Light of a source above its plane, within `half_angle` of +z, by points of a sphere about (0, 0, z)."""

    source: Emitter  # lamp near the centre of the sphere
    z: float  # z of the centre of the sphere, mm
    chart: SphereChart
    half_angle: float  # angle (rad) from +z, seen from the centre, up to which light is launched

    wavelength: Wavelength = 0.0  # wavelength of the source, nm

    kind = "sphere"

    @classmethod
    def of(cls, source: Emitter, z: float, chart: SphereChart, half_angle: float) -> SphereLight:
        """Return the light of a source, for a file of rays the light of its model, with all spectral lines."""
        lines = source.lines  # wavelengths of the rays of a file, in place of source.wavelength
        wavelength = lines if len(lines) > 1 else lines[0][0]
        return cls(source, z, chart, half_angle=half_angle, wavelength=wavelength)

    def irradiance(self, x: Tensor, y: Tensor, z: float) -> Tensor:
        """Return E(x, y) (1/mm² of the chart); z: not used.  The total flux is 1."""
        return self._light(x, y)[2]

    def rays_through(self, x: Tensor, y: Tensor, z: float, area: float) -> Rays:
        """Return rays through (x, y) of the sphere, each with the flux of a cell of `area` (mm² of the chart)."""
        position, direction, density = self._light(x, y)
        return Rays(position, direction, density * area, all_alive(x), z=self.z)

    def _light(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (position of the source relative to the centre, unit vectors s, E) for points of the sphere."""
        d = self.chart.direction(x, y)
        start_x, start_y, start_z = self.source.start_point(self.z)
        start = x.new_tensor((start_x, start_y, start_z - self.z)).view(3, *([1] * x.ndim))
        path = self.chart.radius * d - start
        length = torch.sqrt((path * path).sum(0))
        s = path / length
        ahead = s[2] > MIN_AXIAL_COSINE
        axial = torch.where(ahead, s[2], torch.ones_like(length))
        distance = self.chart.radius
        on_plane = [p * (distance / axial) for p in s[:2]]
        e = self.source.irradiance(on_plane[0] + start_x, on_plane[1] + start_y, start_z + distance)
        intensity = torch.where(ahead, e * distance**2 / axial**3, torch.zeros_like(e))
        stretch = (1 + d[2]) / 2
        density = intensity * (s * d).sum(0) / length**2 * stretch**2
        return start.expand_as(s), s, torch.where(self._within(x, y), density, torch.zeros_like(density))

    def _within(self, x: Tensor, y: Tensor) -> Tensor:
        return x * x + y * y <= self.chart.length(self.half_angle) ** 2 * RIM_ROUNDING

    def beam(self, z: float) -> SphereBeam | None:
        """Return the light for the kernels, whose positions are relative to the centre; z: not used."""
        start_x, start_y, start_z = self.source.start_point(self.z)
        formula = self.source.beam(start_z + self.chart.radius)
        if not isinstance(formula, Beam):
            return None
        lamp, limit = Frame3(start_x, start_y, start_z - self.z), self.chart.length(self.half_angle) ** 2
        limit_r2 = limit * RIM_ROUNDING
        return SphereBeam(formula, self.chart.radius, lamp, limit_r2=limit_r2, least=MIN_AXIAL_COSINE)

    def window(self, outline: Outline, z: float, sags: tuple[float, ...]) -> Rectangle:
        """Return the square of the chart with all directions within the half angle."""
        side = 2 * self.chart.length(self.half_angle)
        return Rectangle(side, side)

    @property
    def extent(self) -> Outline | None:
        """Extent of the source."""
        return self.source.extent

    @property
    def central(self) -> SphereLight:
        """Light of the centre of the source, at the main wavelength."""
        return replace(self, source=self.source.central, wavelength=self.main_wavelength)

    def element(self, x: float, y: float) -> SphereLight:
        """Return the light of the simple source at (x, y) of the extent."""
        return replace(self, source=self.source.element(x, y))

    def scaled(self, share: float) -> SphereLight:
        """Return the light of the source with its extent multiplied by `share`."""
        return replace(self, source=self.source.scaled(share))

    def resized(self, key: str, size: float) -> SphereLight:
        """Return the light of the source with another size."""
        return replace(self, source=self.source.resized(key, size))

    def moved(self, motion: Motion, entrance: float) -> SphereLight:
        """Return the light of the moved source; the sphere stays."""
        return replace(self, source=self.source.moved(motion, entrance))

    @property
    def is_rotation_invariant(self) -> bool:
        """True if a rotation about the source's axis leaves the light unchanged."""
        return self.source.is_rotation_invariant

    def with_wider_cone(self, by: float) -> SphereLight | None:
        """Return the light of the source with a wider cone; None: the source has no cone."""
        wider = self.source.with_wider_cone(by)
        return None if wider is None else replace(self, source=wider)

    def moved_away(self, by: float, about: Vector) -> SphereLight | None:
        """Return the light of the source at a larger distance from a point; None: the source has no position."""
        further = self.source.moved_away(by, about)
        return None if further is None else replace(self, source=further)

    def sizes(self) -> Iterator[tuple[str, float | tuple[float, float], str]]:
        """Yield (key, size, unit) for each key that defines the extent of the source."""
        yield from self.source.sizes()

    def start_point(self, entrance: float) -> Vector:
        """Return the centre of the source (mm)."""
        return self.source.start_point(entrance)

    @property
    def size_key(self) -> str | None:  # type: ignore[override]
        """Scene key of the size of the source."""
        return self.source.size_key

    def spot(self, z: float) -> tuple[Outline | None, tuple[float, float]]:
        """Return (disc of the half angle, its centre in the chart)."""
        return Circle(self.chart.length(self.half_angle)), (0.0, 0.0)
