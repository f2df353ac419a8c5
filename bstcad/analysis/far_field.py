"""The far field of a lens: the intensity of its light over directions, on the grid of a photometric file."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from bstcad.analysis.leaving_rays import rays_behind
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel, SourceSampler
from bstcad.optics.receivers.directions import Directions
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.trace.measure import (
    FULL,
    GHOST_DIVISOR,
    SETS,
    GhostTracer,
    side_factor,
    simulated,
)
from bstcad.photometry.intensity import Intensity
from bstcad.photometry.projection import Projection
from bstcad.photometry.ray_set import RaySet

RAYS = 2048  # rays per side, all points of a source together
SEED = 64  # seed of the rays, other than those of a verification
PIXEL = 0.25  # size of the pixels of the picture over directions, degrees
HALF_SPACE = 90.0  # largest angle from the axis, degrees
PLANE_STEP, ANGLE_STEP = 5.0, 1.0  # steps of C and γ in a file, degrees
PARTS = 4  # points per side of a pixel, among which its light is divided
NOMINAL_LUMENS = 1000.0  # flux of a lamp whose flux is not stated, lm: EULUMDAT states cd per 1000 lm

Grid = tuple[np.ndarray, np.ndarray]  # C (k,) and γ (n,), degrees


def default_grid() -> Grid:
    """Return planes C in steps of PLANE_STEP and angles γ up to HALF_SPACE in steps of ANGLE_STEP (degrees)."""
    return np.arange(0.0, 360.0, PLANE_STEP), np.arange(0.0, HALF_SPACE + ANGLE_STEP / 2, ANGLE_STEP)


def grid_of(table: Intensity) -> Grid:
    """Return the grid of a table of an intensity, so that both can be compared value by value.

    Angles that the table omits, up to HALF_SPACE, are added at its first and last step.  A table of one plane has the
    default planes; tables of the types A and B have the default grid.
    """
    around, along = default_grid()
    if table.kind != "C":
        return around, along
    along, step = table.along, float(np.diff(table.along)[-1])
    if along[0] > 0:
        first = float(np.diff(along)[0])
        along = np.append(np.arange(round(along[0] % first, 6) % first, along[0] - first / 2, first), along)
        along = along if along[0] == 0 else np.append(0.0, along)
    if along[-1] < HALF_SPACE:
        more = np.arange(along[-1] + step, HALF_SPACE - step / 2, step)
        along = np.concatenate([along, more, [HALF_SPACE]])
    return (table.around if len(table.around) > 1 else around), along


@dataclass(frozen=True)
class FarField:
    """Light of a scene for its intensity behind a lens."""

    channels: tuple[Channel, ...]
    lumens: float | None = None  # luminous flux of the source, lm; None: not known, NOMINAL_LUMENS are assumed
    ghost: GhostTracer | None = None  # function that traces light reflected twice inside the lens; None: no ghost
    sampler: SourceSampler | None = None  # samples points of an extended source; None: those of `channels`
    grid: Grid | None = None  # C and γ of the table; None: `default_grid`
    seed: int = SEED  # seed of the rays

    @property
    def source_lumens(self) -> float:
        """Luminous flux of the source (lm), NOMINAL_LUMENS if it is not known."""
        return NOMINAL_LUMENS if self.lumens is None else self.lumens

    def table(self, lens: Lens, rays: int = RAYS) -> Intensity:
        """Return the intensity (cd) on a grid of C and γ; its integral is the flux up to the last γ.

        The light of a picture with pixels of PIXEL degrees is projected on the grid (photometry.projection).
        """
        around, along = self.grid or default_grid()
        reach = max(float(along[-1]), PIXEL)
        columns = 2 * math.ceil(reach / PIXEL)
        half = columns * PIXEL / 2
        screen = Screen(0.0, *2 * ((-half, half),), pixels=columns, surface=Directions("C"))
        flux = self.source_lumens * self._picture(lens, screen, rays)
        row, column = np.nonzero(flux)
        lit, projection = flux[row, column] / PARTS**2, Projection(around, along)
        part = (np.arange(PARTS) + 0.5) / PARTS
        for p in part:
            x = (column + p) * PIXEL - half
            for q in part:
                y = half - (row + q) * PIXEL
                projection.add(np.degrees(np.arctan2(-y, x)), np.hypot(x, y), lit)  # C is from x towards -y
        return projection.table()

    def sampled(self, rays: int) -> tuple[Channel, ...]:
        """Return the channels for so many rays: points of an extended source, or all parts of the rays of a file."""
        if self.sampler is None:
            return self.channels
        if self.sampler.largest_side is None:
            return tuple(self.sampler(FULL.points_for(rays), self.seed))
        parts = (self.sampler(1, part) for part in range(SETS))
        return tuple(replace(channel, weight=channel.weight / SETS) for part in parts for channel in part)

    def rays(self, lens: Lens, count: int) -> RaySet:
        """Return so many rays that leave the lens, in lm if the flux of the source is known (`rays_behind`)."""
        return rays_behind(lens, self.sampled(count), count, seed=self.seed, lumens=self.lumens)

    def _picture(self, lens: Lens, screen: Screen, rays: int) -> np.ndarray:
        """Return the flux in each pixel (rows, columns) as a fraction of the source's, with that of a ghost."""
        channels = self.sampled(rays**2)
        side = max(1, round(side_factor(channels) * rays))
        [light] = simulated(lens, channels, [screen], side, seed=self.seed)
        if self.ghost is None:
            return light.box.cpu().numpy()
        side = max(1, round(side_factor(self.channels) * rays / GHOST_DIVISOR))
        twice = self.ghost(lens, self.channels, screen, side, self.seed).picture
        return (light.box + twice.to(light.box)).cpu().numpy()
