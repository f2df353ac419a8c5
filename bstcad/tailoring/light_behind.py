"""The light that a lens with two freeform faces has to send out: one ray through each place of a target.

Behind a lens the rays of a point or of parallel light are normal to wavefronts (Malus and Dupin; Born and Wolf,
Principles of Optics, section 3.1.2), so that their direction cosines on a plane A are the gradient of an eikonal there.
Which eikonal, is told by a wave that is asked for (`of_wave`), or by a picture on a second plane B (`between_targets`):
the light that crosses A at p shall meet B at t.  With the direction cosines along A

    c(p, t) = (t - p) / |t - p|,    y = σ (c(p, t) - c(p, m)),

m the centroid of B's light, y hardly depends on p for a fixed t, and p -> y is the gradient of a convex function: the
optimal map from A's picture to that of B, whose pixels are seen in these coordinates.  The remaining dependence on p
enters through the p that the previous round assigned to each t, as in slope_map.py.  σ = 1 is the convex solution, in
which no two rays cross between the planes; in the concave one, σ = -1, all of them do.  A is the nearest
target, or, where its picture has clearly more contrast, the furthest one: then light is followed against its way.
Where either picture has clearly more contrast, as letters on black have, the rays are those through its own pixels: the
black ones are then without light to the last bit, whatever the map does in the gaps between letters.

Followed back from the nearest target, rays may cross before they come to the lens: then no lens can send them.  Light
of the convex solution does so where B asks for light much denser than A, by more than the distances A-B and lens-A
allow (an eigenvalue of ∂t/∂p above 1 + |AB| / |lens A|).  `uncrossed` has the nearest light that does not.
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

from bstcad.optics.irradiance import Screen
from bstcad.optics.rays import Vector
from bstcad.optics.receivers import Receiver
from bstcad.optics.surfaces import Surface
from bstcad.optics.wavefront import SphericalWave, Wave
from bstcad.scene.errors import SceneError
from bstcad.tailoring.run import Task
from bstcad.tailoring.slope_map import centroid, pixel_corners, spread_density
from bstcad.transport.bfm import Step
from bstcad.transport.mapping import places_in, solve

ROUNDS, COARSE_SHARE, COARSEST = 3, 4, 64  # of the map between two planes: the last one on all cells
SEARCH = 40  # steps to the place of a stated wave that sends light to a place of the target
FOUND = 1e-9  # mm
DIM = 0.02  # of the mean: the picture that is followed is lifted to it; a hole in it would be a hole in the map
# Pixels: the picture that is followed is blurred so far, and less and less once the map is found.  A portrait whose
# dark parts border on bright ones leaves Newton's method at a mass error of 0.06 to 0.25 without, and of 0.003 so.
BLURS = (4.0, 2.0, 1.0)
FINER = 2  # cells of the map between two planes for one of the transport's grid: a letter's stroke makes much of a face
FALLING = (0.1, 0.03, 0.01, 0.003)  # of the mean: floors of the other one, where it has holes
SHARPER = 1.5  # times the contrast of the other picture: from then on light is followed to the pixels of that one
MEETING = 8  # Newton steps back to a face
CROSSED = 1e-4  # of the light, whose rays may cross before they come to the lens, as rounding leaves

Grid = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class LightBehind:
    """Rays behind the lens through the corners of the pixels of a target, near or far, or of equal parts of them."""

    place: np.ndarray  # (3, c + 1, r + 1) mm in space, x first
    direction: np.ndarray  # (3, c + 1, r + 1) unit vectors
    picture: np.ndarray  # (r, c) the light between each four of them, row 0 = y max

    def turned(self) -> LightBehind:
        """The same rays in the opposite order, both ways."""
        place, direction = (v[:, ::-1, ::-1].copy() for v in (self.place, self.direction))
        return replace(self, place=place, direction=direction, picture=self.picture[::-1, ::-1])

    def on(self, plane: Receiver) -> Grid:
        """x and y (mm) along a plane at which its rays cross it."""
        *along, normal = plane.frame
        centre = np.array(plane.middle)
        off = centre.reshape(3, 1, 1) - self.place
        off = _along(normal, off) / _along(normal, self.direction) * self.direction - off
        return tuple(_along(axis, off) + c for axis, c in zip(along, plane.origin, strict=True))

    def places_of(self, screen: Screen, values: np.ndarray) -> np.ndarray:
        """(k, columns + 1, rows + 1) at the corners of a screen's pixels: values (k, c + 1, r + 1) of its rays."""
        x, y = self.on(screen.plane)
        if float((x[1:] - x[:-1]).mean()) < 0:
            x, y, values = x[::-1, ::-1], y[::-1, ::-1], values[:, ::-1, ::-1]
        return _between(values, *places_in(x, y, *pixel_corners(screen)))

    def meeting(self, surface: Surface) -> np.ndarray:
        """(3, c + 1, r + 1) where each ray, followed back, meets a surface (mm)."""
        (x, y, z), (dx, dy, dz) = (torch.from_numpy(v) for v in (self.place, self.direction))
        path = (surface.z - z) / dz
        for _ in range(MEETING):
            h, z_x, z_y = surface.sag_and_slope(x + path * dx, y + path * dy)
            path = path - (z + path * dz - h) / (dz - z_x * dx - z_y * dy)
        return torch.stack([x + path * dx, y + path * dy, z + path * dz]).numpy()

    def crossed(self, surface: Surface) -> float:
        """Part of the light whose neighbouring rays cross between a surface and the target."""
        return float(self._flux[_folds(*self.meeting(surface)[:2])].sum())

    def beyond(self, surface: Surface, contains: Callable[[Tensor, Tensor], Tensor]) -> float:
        """Part of the light that meets a surface outside of what `contains` says of (x, y) in mm."""
        x, y = (torch.from_numpy(p) for p in self.meeting(surface)[:2])
        outside = (~contains(x, y)).double().numpy()
        share = (outside[1:, 1:] + outside[1:, :-1] + outside[:-1, 1:] + outside[:-1, :-1]) / 4  # of each quad
        return float((self._flux * share).sum())

    def leaving(self, surface: Surface, x: Tensor, y: Tensor) -> Tensor:
        """(3, …) the directions in which light has to leave a surface at points (…) mm; beyond the light as at its rim.

        Linear on the Delaunay triangles of the places where rays meet the surface: where those of two bright parts of
        a picture leave a gap, the directions change evenly across it, whatever the order of the rays.
        x, y: two-dimensional; of more rays than points as many as those are taken, evenly.
        """
        every = np.ix_(
            range(3), *(np.linspace(0, m - 1, min(m, max(x.shape)), dtype=int) for m in self.place.shape[1:])
        )
        few = replace(self, place=self.place[every], direction=self.direction[every])
        met, directions = few.meeting(surface)[:2].reshape(2, -1).T, few.direction.reshape(3, -1).T
        at = np.stack([p.cpu().double().numpy().reshape(-1) for p in (x, y)], axis=-1)
        with threadpool_limits(1, "blas"):  # LAPACK takes a 2 x 2 matrix of each triangle: its threads wait for cores
            found = LinearNDInterpolator(met, directions)(at)
        beyond = np.isnan(found[:, 0])
        found[beyond] = directions[cKDTree(met).query(at[beyond])[1]]
        found = torch.from_numpy(found.T.reshape(3, *x.shape).copy())
        return (found / torch.sqrt((found * found).sum(0))).to(x)

    @property
    def _flux(self) -> np.ndarray:
        """(c, r) of each quad, x first."""
        return self.picture[::-1].T


def of_task(task: Task) -> LightBehind:
    """The light through the nearest target that meets the wave of a task, or that through it and the furthest one."""
    near, *_, far = sorted((*task.goals, *task.goals), key=lambda goal: goal.receiver.plane.throw(0.0))
    if any(goal.receiver.plane.frame is None for goal in (near, far)):
        raise SceneError("target: light through several targets is followed between planes alone; make each a plane")
    n = task.knobs.transport_grid
    if task.wave is not None:
        parts = max(1, round(n / max(near.receiver.shape)))
        return of_wave(near.receiver, near.picture, task.wave, wavelength=task.heaviest.source.wavelength, parts=parts)

    def progress(s: Step) -> None:
        task.progress("stage 1", 0, task.knobs.rounds, f"between the targets, {s.grid}² cells")

    return between_targets(
        (near.receiver, near.picture), (far.receiver, np.maximum(far.picture, task.floor * far.picture.mean())), n,
        sign=task.solution or 1.0, iterations=task.knobs.transport_iterations, progress=progress,
    )  # fmt: skip


def corners(screen: Screen, parts: int) -> Grid:
    """x and y (mm) on the screen of the corners of so many parts of its pixels each way, x first."""
    return tuple(pixel_corners(replace(screen, pixels=(parts * screen.columns, parts * screen.rows))))


def parted(picture: np.ndarray, parts: int) -> np.ndarray:
    """A picture with each pixel's light shared out evenly among so many parts of it each way."""
    return np.kron(picture, np.ones((parts, parts)) / parts**2)


def in_space(plane: Receiver, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(3, …) the points (mm) of places of a receiver."""
    return np.stack(plane.point(x, y))


def _along(vector: Vector, of: np.ndarray) -> np.ndarray:
    return vector[0] * of[0] + vector[1] * of[1] + vector[2] * of[2]


def of_wave(screen: Screen, picture: np.ndarray, wave: Wave, *, wavelength: float, parts: int) -> LightBehind:
    """The light that is a wave, through the places of a screen; wavelength: nm."""
    place, picture = in_space(screen.plane, *corners(screen, parts)), parted(picture, parts)
    if isinstance(wave, SphericalWave):  # each ray is the line through the focus
        way = _unit(place - np.array(wave.focus).reshape(3, 1, 1))
        return LightBehind(place, way * np.where(way[2] < 0, -1.0, 1.0), picture)
    x, y = (torch.from_numpy(p) for p in place[:2])
    below = torch.from_numpy(wave.z - place[2])
    direction = wave.directions(x, y, wavelength)
    for _ in range(SEARCH):  # the place of the wave's plane whose ray goes there
        path = below / direction[2]
        there = x + path * direction[0], y + path * direction[1]
        before, direction = direction, wave.directions(*there, wavelength)
        if not bool(((direction - before).abs() * below.abs().max() > FOUND).any()):
            return LightBehind(place, direction.numpy(), picture)
    raise SceneError(
        f"wavefront.z: rays of the wave at z = {wave.z:g} cross on their way to the target; move the wavefront's plane "
        "nearer to it, or make the coefficients smaller"
    )


def between_targets(
    near: tuple[Screen, np.ndarray], far: tuple[Screen, np.ndarray], n: int, *, sign: float = 1.0, iterations: int = 40,
    progress: Callable[[Step], None] | None = None,
) -> LightBehind:  # fmt: skip
    """The light through two pictures, (screen, (rows, columns) of any sum) each, by transport on n x n cells.

    sign: σ, 1 for the convex solution and -1 for the concave one.  Light through the pixels of the near picture is
    followed to the far one, or against its way where the near picture has clearly more contrast: maps to pictures with
    holes are found more safely than maps from such.  The rays are about as close as the cells; of a picture of much
    contrast closer, for its bright pixels have to tell the other picture's detail.
    """
    contrasts = [float((p**2).mean() / p.mean() ** 2) for _, p in (near, far)]
    against = contrasts[0] > SHARPER * contrasts[1]  # is light followed against its way, from far to near?
    (screen, picture), (behind, wanted) = (far, near) if against else (near, far)
    own, *pictures = (
        np.maximum(p, DIM * p.mean()) for p in (picture, *(gaussian_filter(picture, b, mode="nearest") for b in BLURS))
    )
    along = screen.plane.frame[:2]

    def cosines(p: np.ndarray, t: np.ndarray) -> Grid:
        way = _unit(t - p)
        return _along(along[0], way), _along(along[1], way)

    t = in_space(behind.plane, *pixel_corners(behind))
    m = in_space(behind.plane, *(np.array(c) for c in centroid(wanted, behind))).reshape(3, 1, 1)
    p = in_space(screen.plane, *(np.full_like(t[0], sum(ends) / 2) for ends in (screen.x, screen.y)))
    for turn in range(ROUNDS):
        last = turn == ROUNDS - 1
        cells = FINER * n if last else max(COARSEST, n // COARSE_SHARE)
        y = tuple(sign * (c - g) for c, g in zip(cosines(p, t), cosines(p, m), strict=True))
        (rho, frame), *others = (spread_density(each, tuple(pixel_corners(screen)), cells) for each in pictures)
        sharper = [other for other, _ in others] if last else []
        sigma, seen = spread_density(wanted, y, cells)
        mapping = solve(
            rho, sigma, frame, seen, sharper=sharper, iterations=iterations, falling=FALLING, progress=progress
        )
        p = in_space(screen.plane, *mapping.inverse(*y))
    if max(contrasts) > SHARPER * min(contrasts):
        parts = max(1, round(n * math.sqrt(max(contrasts)) / max(behind.shape)))
        place = in_space(behind.plane, *corners(behind, parts))
        i, j = np.meshgrid(*(np.arange(parts * pixels + 1) / parts for pixels in behind.shape[::-1]), indexing="ij")
        way = _unit(place - in_space(screen.plane, *mapping.inverse(*_between(np.stack(y), i, j))))
        light = LightBehind(place, -way if against else way, parted(wanted / wanted.sum(), parts))
        return light.turned() if sign < 0 and not against else light
    parts = max(1, round(n / max(screen.shape)))
    place, there = in_space(screen.plane, *corners(screen, parts)), mapping(*corners(screen, parts))
    i, j = places_in(*(sign * c for c in y), *(sign * c for c in there))  # which increase with t
    way = _unit(in_space(behind.plane, *_between(np.stack(pixel_corners(behind)), i, j)) - place)
    return LightBehind(place, way, parted(own / own.sum(), parts))


def _unit(way: np.ndarray) -> np.ndarray:
    """(3, …) the unit vectors along vectors."""
    return way / np.sqrt((way * way).sum(0))


def uncrossed(light: LightBehind, screen: Screen, surface: Surface, n: int) -> LightBehind:
    """The light itself, or the nearest to it of which no rays cross between a level surface and the screen.

    It sends each place of the surface as much light, by the optimal map from the screen, which crosses no rays.
    """
    if light.crossed(surface) <= CROSSED:
        return light
    b_x, b_y, b_z = light.meeting(surface)
    rho, frame = spread_density(light.picture, light.on(screen.plane), n)
    sigma, seen = spread_density(light.picture, (b_x, b_y), n)
    mapping, there = solve(rho, sigma, frame, seen), light.on(screen.plane)
    b = np.stack([*mapping(*there), np.full(light.place.shape[1:], float(b_z.mean()))])
    place = in_space(screen.plane, *there)
    return replace(light, place=place, direction=_unit(place - b))


# ---- grids of places -------------------------------------------------------------------------------------------------


def _folds(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Which quads of a grid of places are turned over."""
    return (x[1:, 1:] - x[:-1, :-1]) * (y[:-1, 1:] - y[1:, :-1]) - (x[:-1, 1:] - x[1:, :-1]) * (
        y[1:, 1:] - y[:-1, :-1]
    ) <= 0


def _between(values: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Values (k, m, n) of the corners of a grid at real places among them, bilinear."""
    row = np.clip(i.astype(int), 0, values.shape[-2] - 2)
    column = np.clip(j.astype(int), 0, values.shape[-1] - 2)
    a, b = i - row, j - column
    here = (1 - b) * values[:, row, column] + b * values[:, row, column + 1]
    below = (1 - b) * values[:, row + 1, column] + b * values[:, row + 1, column + 1]
    return (1 - a) * here + a * below
