"""batoid as a judge: a sequential ray tracer for telescopes, in C++ and double precision.

A freeform face becomes batoid's `Bicubic`, from heights, slopes and mixed derivatives on a grid with lines through all
knots.  It equals the spline, except up to one and a half control-point spacings from the edge of the net, where x is
not linear in the spline's parameter.
bstcad's source gives the start, direction and flux of each ray; batoid traces the ray, without losses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import batoid
import numpy as np

from bstcad.optics.lens.interfaces import Reflect
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel, source_numbers
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Circle, Outline
from bstcad.optics.surfaces.rays import Rays, axes
from bstcad.optics.surfaces.tilted import TiltedSurface
from bstcad.optics.trace.measure import side_factor
from bstcad.optics.trace.trace import launch_strips
from bstcad.verify.judges import faces
from bstcad.verify.judges.faces import Face, FaceError, Traced

GRID_MARGIN = 0.125  # margin of a Bicubic beyond each edge of the net / width of the net; searches for hits need it
POLYGON_CORNERS = 4096  # number of corners of the polygon that represents an outline with round corners
COMPARISON_POINTS = 100_000  # largest number of points at which batoid's faces are compared with the lens's


@dataclass(frozen=True)
class PlacedSurface:
    """A face of a lens as a surface of batoid with its coordinate system."""

    face: Face | None  # face of the lens; None: a tilted window or mirror
    surface: Any  # surface of batoid
    frame: Any  # coordinate system of batoid

    def error(self, outline: Outline) -> FaceError:
        """Return the error of the surface against the lens's face, inside the outline."""
        assert self.face is not None
        exact = self.face.at(*faces.random_points(outline, COMPARISON_POINTS, seed=0))
        heights = self.surface.sag(exact.x, exact.y) + self.frame.origin[2]
        return FaceError.between(heights, self.surface.normal(exact.x, exact.y), exact)


def placed(face: Face) -> PlacedSurface:
    """Return a face as a surface of batoid."""
    if isinstance(face, faces.Freeform):
        x, y = map(_extend, face.lines(parts=1))
        shape = face.on_grid(x, y)
        z = float(shape.z.mean())
        surface = batoid.Bicubic(x, y, shape.z - z, *(shape.z_x, shape.z_y, shape.z_xy))
        return PlacedSurface(face, surface, _frame((0.0, 0.0, z)))
    plane = not face.curvature
    surface = batoid.Plane() if plane else batoid.Quadric(1 / face.curvature, face.conic_constant)
    return PlacedSurface(face, surface, _frame((0.0, 0.0, face.z0)))


def surfaces(lens: Lens) -> tuple[PlacedSurface, ...]:
    """Return the surfaces in the order in which light meets them, with windows and mirrors around the lens."""
    return tuple(
        _place_tilted(surface) if isinstance(surface, TiltedSurface) else placed(faces.face(surface, lens.outline))
        for surface in (interface.surface for interface in lens.interfaces)
    )


def _place_tilted(surface: TiltedSurface) -> PlacedSurface:
    """Return a plane or sphere in any position as a surface of batoid; its error is not computed."""
    n = np.array(surface.unit_normal)
    e_x = np.cross((0.0, 1.0, 0.0), n)
    e_x /= np.linalg.norm(e_x)
    shape = batoid.Sphere(1 / surface.face_curvature) if surface.face_curvature else batoid.Plane()
    return PlacedSurface(None, shape, _frame(surface.vertex, np.column_stack([e_x, np.cross(n, e_x), n])))


def vector(rays: Rays, index: float = 1.0) -> Any:
    """Convert rays in a medium of this index to batoid's rays, whose velocity (c = 1) is the direction / index."""
    x, y, _ = rays.position
    velocity = (d / index for d in rays.direction)
    return batoid.RayVector(*(np.ascontiguousarray(p.numpy()) for p in (x, y, rays.above(0.0), *velocity)))


def land(rays: Any, screen: Screen, sense: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Move batoid's rays to a screen; return x, y on it (mm) and mask of hits.  sense: 1 for light along +z, or -1."""
    x, y, _ = screen.middle
    batoid.intersect(batoid.Plane(), rays, _frame(screen.middle, np.column_stack(axes(screen.tilt or (0.0, 0.0)))))
    arrived = ~rays.failed & ~rays.vignetted & np.isfinite(rays.x) & np.isfinite(rays.y) & (sense * rays.vz > 0)
    return rays.x + x, rays.y + y, arrived


def through(lens: Lens, known: Sequence[PlacedSurface], rays: Rays) -> Any:
    """Trace rays from the source through the lens; return rays of batoid.  known: surfaces of the lens in batoid."""
    theirs = vector(rays, lens.passes.index_before)
    for interface, at in zip(lens.interfaces, known, strict=True):
        if isinstance(interface.law, Reflect):
            batoid.reflect(at.surface, theirs, coordSys=at.frame)
        else:
            media = (batoid.ConstMedium(n) for n in (interface.law.n_in, interface.law.n_out))
            batoid.refract(at.surface, theirs, *media, coordSys=at.frame)
        if isinstance(interface.surface, TiltedSurface):  # the outline is a projection along z
            theirs.toCoordSys(batoid.CoordSys())
        batoid.obscure(_outside(interface.outline), theirs)
    return theirs


def cannot(lens: Lens, channels: Sequence[Channel]) -> str:
    """Return "": batoid can trace any light."""
    return ""


def light(lens: Lens, channels: Sequence[Channel]) -> tuple[Channel, ...]:
    """Return the channels without losses, which batoid does not simulate."""
    return tuple(replace(channel, losses=None) for channel in channels)


def trace(lens: Lens, channels: Sequence[Channel], screen: Screen, rays: int, seed: int) -> Traced:
    """Trace about `rays` stratified rays; return two pictures on a screen, each from half of the rays."""
    n = max(1, round(side_factor(channels) * math.sqrt(rays / 2)))
    known = surfaces(lens)
    halves, count = np.zeros((2, *screen.shape)), 0
    sense = lens.passes.sense * (-1) ** sum(interface.law.reverses for interface in lens.interfaces[lens.solid.start :])
    for half, picture in enumerate(halves):
        for channel, number in zip(channels, source_numbers(channels), strict=True):
            glass, landed, launched = channel.through(lens), np.zeros(screen.shape), 0.0
            for strip in launch_strips(channel.source, glass, n, seed + half + 2 * number):
                x, y, arrived = land(through(glass, known, strip), screen, sense)
                flux = strip.flux.numpy()
                landed += bin_flux(x[arrived], y[arrived], flux[arrived], screen)
                launched += flux.sum()
                count += len(x)
            picture += channel.weight / max(launched, 1.0) * landed  # `launched` may exceed 1 by cells on a beam's rim
    faces_of = zip(known[lens.solid], lens.interfaces[lens.solid], strict=True)
    return Traced(halves, count, FaceError.worst(face.error(interface.outline) for face, interface in faces_of))


def bin_flux(x: np.ndarray, y: np.ndarray, flux: np.ndarray, screen: Screen) -> np.ndarray:
    """Return the flux of rays at (x, y) in each pixel (rows, columns), by numpy's histogram; row 0 = y max."""
    image, _, _ = np.histogram2d(y, x, bins=screen.shape, range=(screen.y, screen.x), weights=flux)
    return image[::-1]


def _extend(line: np.ndarray) -> np.ndarray:
    step, more = line[1] - line[0], math.ceil(GRID_MARGIN * (len(line) - 1))
    return np.concatenate([line[0] - step * np.arange(more, 0, -1), line, line[-1] + step * np.arange(1, more + 1)])


def _frame(origin: tuple[float, float, float], turned: np.ndarray | None = None) -> Any:
    return batoid.CoordSys(origin=list(origin), rot=turned)


def _outside(outline: Outline) -> Any:
    if isinstance(outline, Circle):
        inside = batoid.ObscCircle(outline.radius)
    elif outline.limits[2]:
        inside = batoid.ObscPolygon(*faces.rim(outline, POLYGON_CORNERS).T)
    else:
        inside = batoid.ObscRectangle(outline.width, outline.height)
    return batoid.ObscNegation(inside)
