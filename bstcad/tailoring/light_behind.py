"""The rays behind a lens with two freeform faces, from a wavefront or two pictures: one through each target point.

Behind a lens the rays of a point source or of collimated light are normal to wavefronts (theorem of Malus and Dupin;
Born and Wolf, Principles of Optics, section 3.1.2).  So their direction cosines on a plane A are the gradient of
an eikonal.  The eikonal follows from a wavefront goal (`light_of_wave`), or from the pictures on A and on a second
plane B (`between_targets`): light that crosses A at p shall meet B at t.  Let c be the direction cosines along A, and m
the centroid of the light on B.  The coordinate y in

    c(p, t) = (t - p) / |t - p|,    y = σ (c(p, t) - c(p, m)),

hardly depends on p for a fixed t, and p -> y is the gradient of a convex function: the optimal transport map from the
picture on A to the picture on B in the coordinates y.  The remaining dependence on p enters through the p that the
previous round assigned to each t, as in slope_map.py.  In the convex solution, σ = 1, no two rays cross between the
planes; in the concave solution, σ = -1, all do.  A is the nearest target and B the furthest.  If one picture has
clearly more contrast, such as letters on black, the rays pass through the corners of its pixels: its black pixels then
get no light, whatever the map is in the gaps between letters.  If it is the nearest picture, A and B are exchanged, and
the rays are followed backwards.

Between lens and nearest target the rays may cross, and then no lens can send them.  In the convex solution this happens
where the light on A is much denser than on B (an eigenvalue of ∂t/∂p above 1 + |AB| / |lens A|).
`without_crossings` then returns similar rays that do not cross.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits
from torch import Tensor

from bstcad.optics.light.wavefront import SphericalWave, Wave
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces.rays import Vector, dot
from bstcad.optics.surfaces.surfaces import Surface
from bstcad.runs.files import SceneError
from bstcad.tailoring.driver import Task
from bstcad.tailoring.slope_map import centroid, pixel_corners, resample_picture
from bstcad.transport.bfm import TransportStep
from bstcad.transport.mapping import Points, Solver, grid_coordinates, solve

MAP_ROUNDS, COARSE_DIVISOR, MIN_COARSE_CELLS = 3, 4, 64  # rounds; all but the last: max(transport grid / 4, 64)² cells
MAX_WAVE_ITERATIONS = 40  # largest number of iterations for the point of a wave that sends a ray to a given point
WAVE_TOLERANCE = 1e-9  # change (mm) below which the iterations for a point of the wave have converged
SOURCE_FLOOR = 0.02  # smallest irradiance of the picture where a map begins / its mean: black would leave holes
# Standard deviations (pixels) of the blur of the picture where a map begins; the last map uses all in turn.  For a
# portrait with dark beside bright parts, Newton's method ends at a mass error of 0.003, without blur at 0.06 to 0.25.
SOURCE_BLURS = (4.0, 2.0, 1.0)
FINE_FACTOR = 2  # cells per side of the last map, relative to the transport grid: few cells light a thin letter
# Solver with floors under the picture where a map ends, relative to its mean, used one after another
TARGETS_SOLVER = Solver(floors=(0.1, 0.03, 0.01, 0.003))
CONTRAST_RATIO = 1.5  # ratio of contrasts above which rays pass through pixel corners of the higher-contrast picture
INTERSECTION_STEPS = 8  # Newton iterations for the intersection with a face
# Largest number of rays per side in `directions_at`: directions interpolated between 513² of 1537² rays of two pictures
# differ by 1e-5 (RMS) from those between all, a twentieth of a pixel on the target, and take 3 s instead of 30 s.
MAX_TRIANGULATED = 513
CROSSING_TOLERANCE = 1e-4  # fraction of the light up to which crossing rays count as rounding

Picture = tuple[Screen, np.ndarray]  # (screen, flux in its pixels (rows, columns), of any sum)


@dataclass(frozen=True, eq=False)
class LightBehind:
    """Rays behind the lens, through the corners of the pixels of a target or of equal parts of these pixels."""

    position: np.ndarray  # (3, c + 1, r + 1) points of the rays in space (mm), for c columns and r rows of pixels
    direction: np.ndarray  # (3, c + 1, r + 1) unit vectors along the rays
    picture: np.ndarray  # (r, c) flux of each tube, between four neighbouring rays, row 0 = y max

    def reversed(self) -> LightBehind:
        """Return the same rays, numbered backwards along both axes of the arrays."""
        position, direction = (v[:, ::-1, ::-1].copy() for v in (self.position, self.direction))
        return replace(self, position=position, direction=direction, picture=self.picture[::-1, ::-1])

    def positions_on(self, receiver: Receiver) -> Points:
        """Return the coordinates x and y (mm) on a plane of the points where the rays cross it, each (c + 1, r + 1)."""
        (e_x, e_y, normal), (x, y) = _frame(receiver), receiver.origin
        off = np.array(receiver.middle).reshape(3, 1, 1) - self.position
        off = dot(normal, off) / dot(normal, self.direction) * self.direction - off
        return dot(e_x, off) + x, dot(e_y, off) + y

    def sampled_at(self, screen: Screen, values: np.ndarray) -> np.ndarray:
        """Interpolate values at the rays (k, c + 1, r + 1) to a screen's pixel corners, (k, columns + 1, rows + 1)."""
        x, y = self.positions_on(screen.receiver)
        if float((x[1:] - x[:-1]).mean()) < 0:
            x, y, values = x[::-1, ::-1], y[::-1, ::-1], values[:, ::-1, ::-1]
        return _bilinear(values, *grid_coordinates(x, y, *pixel_corners(screen)))

    def intersect(self, surface: Surface) -> np.ndarray:
        """Return the points (3, c + 1, r + 1) where the rays, traced backwards, meet a surface (mm)."""
        (x, y, z), (dx, dy, dz) = (torch.from_numpy(v) for v in (self.position, self.direction))
        path = (surface.z - z) / dz
        for _ in range(INTERSECTION_STEPS):
            h, z_x, z_y = surface.sag_and_slope(x + path * dx, y + path * dy)
            path = path - (z + path * dz - h) / (dz - z_x * dx - z_y * dy)
        return torch.stack([x + path * dx, y + path * dy, z + path * dz]).numpy()

    def crossed_fraction(self, surface: Surface) -> float:
        """Return the fraction of the light whose neighbouring rays cross between a surface and the target."""
        return float(self._flux[_inverted(*self.intersect(surface)[:2])].sum())

    def fraction_outside(self, surface: Surface, contains: Callable[[Tensor, Tensor], Tensor]) -> float:
        """Return the fraction of the light that meets a surface where `contains(x, y)`, in mm, is False."""
        x, y = (torch.from_numpy(p) for p in self.intersect(surface)[:2])
        outside = (~contains(x, y)).double().numpy()
        share = (outside[1:, 1:] + outside[1:, :-1] + outside[:-1, 1:] + outside[:-1, :-1]) / 4  # fraction of a quad
        return float((self._flux * share).sum())

    def directions_at(self, surface: Surface, x: Tensor, y: Tensor) -> Tensor:
        """Return the directions (3, m, n) in which light has to leave a surface at points x and y, (m, n) in mm.

        The directions are interpolated linearly on the Delaunay triangles of the points where the rays meet the
        surface, and so vary linearly across the gap between two bright parts of a picture.  Outside the light the
        direction of the nearest ray is used.  At most max(m, n), and MAX_TRIANGULATED, evenly spaced rays along
        each axis are used.
        """
        most = min(max(x.shape), MAX_TRIANGULATED)
        i, j = (np.linspace(0, m - 1, min(m, most), dtype=int) for m in self.position.shape[1:])
        every = np.ix_(np.arange(3), i, j)
        few = replace(self, position=self.position[every], direction=self.direction[every])
        met, directions = few.intersect(surface)[:2].reshape(2, -1).T, few.direction.reshape(3, -1).T
        at = np.stack([p.cpu().double().numpy().reshape(-1) for p in (x, y)], axis=-1)
        with threadpool_limits(1, "blas"):  # LAPACK inverts a 2 x 2 matrix per triangle: one thread is faster
            found = LinearNDInterpolator(met, directions)(at)
        outside = np.isnan(found[:, 0])
        found[outside] = directions[cKDTree(met).query(at[outside])[1]]
        way = torch.from_numpy(found.T.reshape(3, *x.shape).copy())
        return (way / torch.sqrt((way * way).sum(0))).to(x)

    @property
    def _flux(self) -> np.ndarray:
        """Flux of each tube, between four neighbouring rays, (c, r), x first."""
        return self.picture[::-1].T


def light_for_task(task: Task) -> LightBehind:
    """Return the rays behind the lens for the nearest target and the wavefront or, without one, the furthest target."""
    # twice, so that a single goal is both the nearest and the furthest
    near, *_, far = sorted((*task.goals, *task.goals), key=lambda goal: goal.screen.receiver.throw(0.0))
    if any(goal.screen.receiver.frame is None for goal in (near, far)):
        raise SceneError("target: several targets, or a wavefront, need plane targets; make each target a plane")
    n = task.settings.transport_grid
    if task.wave is not None:
        parts = max(1, round(n / max(near.screen.shape)))
        wavelength = task.heaviest.source.main_wavelength
        return light_of_wave(near.screen, near.picture, task.wave, wavelength=wavelength, parts=parts)

    def progress(s: TransportStep) -> None:
        task.progress("stage 1", 0, task.settings.rounds, f"between the targets, {s.grid}² cells")

    lifted = far.screen, np.maximum(far.picture, task.floor * far.picture.mean())
    solver = replace(TARGETS_SOLVER, iterations=task.settings.transport_iterations, progress=progress)
    return between_targets((near.screen, near.picture), lifted, n, sign=task.solution or 1.0, solver=solver)


def corners(screen: Screen, parts: int) -> Points:
    """Return x and y (mm) of the corners of a screen's pixels, each pixel divided into parts x parts; x is axis 0."""
    return pixel_corners(replace(screen, pixels=(parts * screen.columns, parts * screen.rows)))


def subdivide(picture: np.ndarray, parts: int) -> np.ndarray:
    """Return a picture with each pixel divided into parts x parts of equal flux."""
    return np.kron(picture, np.ones((parts, parts)) / parts**2)


def in_space(receiver: Receiver, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the points (3, …) in space (mm) at x and y (…) on a receiver."""
    return np.stack(receiver.point(x, y))


def _frame(receiver: Receiver) -> tuple[Vector, Vector, Vector]:
    assert receiver.frame is not None, "`light_for_task` refuses receivers that are not planes"
    return receiver.frame


def light_of_wave(screen: Screen, picture: np.ndarray, wave: Wave, *, wavelength: float, parts: int) -> LightBehind:
    """Return the rays of a wave through the corners of a screen's pixels, each pixel divided into parts x parts.

    wavelength: nm.  SceneError if rays of the wave cross before the screen.
    """
    place, picture = in_space(screen.receiver, *corners(screen, parts)), subdivide(picture, parts)
    if isinstance(wave, SphericalWave):  # each ray is the line through the focus
        way = _normalised(place - np.array(wave.focus).reshape(3, 1, 1))
        return LightBehind(place, way * np.where(way[2] < 0, -1.0, 1.0), picture)
    x, y = (torch.from_numpy(p) for p in place[:2])
    below = torch.from_numpy(wave.z - place[2])
    direction = wave.directions(x, y, wavelength)
    for _ in range(MAX_WAVE_ITERATIONS):  # iterate the point of the wave's plane from which the ray meets the corner
        path = below / direction[2]
        there = x + path * direction[0], y + path * direction[1]
        before, direction = direction, wave.directions(*there, wavelength)
        if not bool(((direction - before).abs() * below.abs().max() > WAVE_TOLERANCE).any()):
            return LightBehind(place, direction.numpy(), picture)
    raise SceneError(
        f"wavefront.z: rays of the wave at z = {wave.z:g} mm cross before the target; move the wavefront's plane "
        "nearer to the target, or make wavefront.coefficients smaller"
    )


def between_targets(
    near: Picture, far: Picture, n: int, sign: float = 1.0, solver: Solver = TARGETS_SOLVER
) -> LightBehind:
    """Return the rays through two pictures by transport on FINE_FACTOR * n cells per side, at first on fewer.

    sign: σ, 1 for the convex and -1 for the concave solution.
    The map leads from the near to the far picture, or in reverse if the near one has clearly more contrast: a map to a
    picture with black parts converges more safely than a map from it.  About n rays per side are returned; for a
    picture of high contrast more, since few bright pixels have to resolve the other picture.
    """
    contrasts = [float((p**2).mean() / p.mean() ** 2) for _, p in (near, far)]
    against = contrasts[0] > CONTRAST_RATIO * contrasts[1]  # True: rays are followed backwards, from far to near
    (screen, picture), (behind, target) = (far, near) if against else (near, far)
    smooth = (gaussian_filter(picture, width, mode="nearest") for width in SOURCE_BLURS)
    sharp, *pictures = (np.maximum(p, SOURCE_FLOOR * p.mean()) for p in (picture, *smooth))
    e_x, e_y, _ = _frame(screen.receiver)

    def cosines(p: np.ndarray, t: np.ndarray) -> Points:
        way = _normalised(t - p)
        return dot(e_x, way), dot(e_y, way)

    t = in_space(behind.receiver, *pixel_corners(behind))
    m = in_space(behind.receiver, *(np.array(c) for c in centroid(target, behind))).reshape(3, 1, 1)
    p = in_space(screen.receiver, *(np.full_like(t[0], sum(ends) / 2) for ends in (screen.x, screen.y)))
    for number in range(MAP_ROUNDS):
        last = number == MAP_ROUNDS - 1
        cells = FINE_FACTOR * n if last else max(MIN_COARSE_CELLS, n // COARSE_DIVISOR)
        (c_x, c_y), (g_x, g_y) = cosines(p, t), cosines(p, m)
        y = sign * (c_x - g_x), sign * (c_y - g_y)
        (rho, frame), *others = (resample_picture(each, pixel_corners(screen), cells) for each in pictures)
        sharper = [other for other, _ in others] if last else []
        sigma, y_frame = resample_picture(target, y, cells)
        mapping = solve(rho, sigma, frame, y_frame, solver=solver, sharper=sharper)
        p = in_space(screen.receiver, *mapping.inverse(*y))
    if max(contrasts) > CONTRAST_RATIO * min(contrasts):
        parts = max(1, round(n * math.sqrt(max(contrasts)) / max(behind.shape)))
        place = in_space(behind.receiver, *corners(behind, parts))
        i, j = np.meshgrid(*(np.arange(parts * pixels + 1) / parts for pixels in behind.shape[::-1]), indexing="ij")
        way = _normalised(place - in_space(screen.receiver, *mapping.inverse(*_bilinear(np.stack(y), i, j))))
        light = LightBehind(place, -way if against else way, subdivide(target / target.sum(), parts))
        return light.reversed() if sign < 0 and not against else light
    parts = max(1, round(n / max(screen.shape)))
    place, there = in_space(screen.receiver, *corners(screen, parts)), mapping(*corners(screen, parts))
    i, j = grid_coordinates(*(sign * c for c in y), *(sign * c for c in there))  # now increasing with t
    way = _normalised(in_space(behind.receiver, *_bilinear(np.stack(pixel_corners(behind)), i, j)) - place)
    return LightBehind(place, way, subdivide(sharp / sharp.sum(), parts))


def _normalised(way: np.ndarray) -> np.ndarray:
    return way / np.sqrt((way * way).sum(0))


def without_crossings(light: LightBehind, screen: Screen, surface: Surface, n: int) -> LightBehind:
    """Return `light`, or if its rays cross between a surface and the screen, similar rays that do not.

    The flux on the surface stays the same.  The new rays follow the optimal map on n x n cells from screen to surface.
    """
    if light.crossed_fraction(surface) <= CROSSING_TOLERANCE:
        return light
    b_x, b_y, b_z = light.intersect(surface)
    rho, frame = resample_picture(light.picture, light.positions_on(screen.receiver), n)
    sigma, back_frame = resample_picture(light.picture, (b_x, b_y), n)
    mapping, there = solve(rho, sigma, frame, back_frame), light.positions_on(screen.receiver)
    b = np.stack([*mapping(*there), np.full(light.position.shape[1:], float(b_z.mean()))])
    place = in_space(screen.receiver, *there)
    return replace(light, position=place, direction=_normalised(place - b))


def _inverted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return True (m - 1, n - 1) where four neighbours of the points x, y (m, n) span an inverted (crossed) quad."""
    return (x[1:, 1:] - x[:-1, :-1]) * (y[:-1, 1:] - y[1:, :-1]) - (x[:-1, 1:] - x[1:, :-1]) * (
        y[1:, 1:] - y[:-1, :-1]
    ) <= 0


def _bilinear(values: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Interpolate values (k, m, n) on a grid bilinearly at fractional indices i and j."""
    row = np.clip(i.astype(int), 0, values.shape[-2] - 2)
    column = np.clip(j.astype(int), 0, values.shape[-1] - 2)
    a, b = i - row, j - column
    first = (1 - b) * values[:, row, column] + b * values[:, row, column + 1]
    second = (1 - b) * values[:, row + 1, column] + b * values[:, row + 1, column + 1]
    return (1 - a) * first + a * second
