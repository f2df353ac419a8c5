"""The far field of a lens: the intensity of its light over directions, on the grid of a photometric file."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from bstcad.optics.channels import Channel
from bstcad.optics.directions import Directions
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.measure import side_factor, simulated
from bstcad.photometry.intensity import Intensity

RAYS = 2048  # rays per side, all points of a source together
SEED = 64  # seed of the rays, other than those of a verification
PIXEL = 0.25  # size of the pixels of the picture over directions, degrees
HALF_SPACE = 90.0  # largest angle from the axis, degrees
PLANE_STEP, ANGLE_STEP = 5.0, 1.0  # steps of C and γ in a file, degrees
PARTS = 4  # points per side of a cell of C and γ, over which the intensity is averaged
NOMINAL_LUMENS = 1000.0  # flux of a lamp whose flux is not stated, lm: EULUMDAT states cd per 1000 lm


@dataclass(frozen=True)
class FarField:
    """Light of a scene for its intensity behind a lens."""

    channels: tuple[Channel, ...]
    lumens: float | None = None  # luminous flux of the source, lm; None: not known, NOMINAL_LUMENS are assumed

    def table(self, lens: Lens, rays: int = RAYS) -> Intensity:
        """Return the intensity (cd) on even grids of C and γ up to 90 degrees; its integral is the flux there.

        A value is the mean over its cell, weighted by solid angle, of the intensity of pixels of PIXEL degrees.
        """
        columns = round(2 * HALF_SPACE / PIXEL)
        screen = Screen(0.0, *2 * ((-HALF_SPACE, HALF_SPACE),), pixels=columns, surface=Directions("C"))
        side = max(1, round(side_factor(self.channels) * rays))
        [light] = simulated(lens, self.channels, [screen], side, seed=SEED)
        flux = light.box.numpy() * (NOMINAL_LUMENS if self.lumens is None else self.lumens)
        middle = (np.arange(columns) + 0.5) * PIXEL - HALF_SPACE
        theta = np.radians(np.hypot(middle, middle[:, None]))
        within = theta <= math.radians(HALF_SPACE)
        intensity = flux / (math.radians(PIXEL) ** 2 * np.sinc(theta / np.pi))
        around, along = np.arange(0.0, 360.0, PLANE_STEP), np.arange(0.0, HALF_SPACE + ANGLE_STEP / 2, ANGLE_STEP)
        found = Intensity("C", around, along, _means(intensity, around, along))
        whole = float((flux * within).sum())
        scale = whole / found.lumens if found.lumens > 0 else 0.0
        return Intensity("C", around, along, scale * found.candela)


def _means(intensity: np.ndarray, around: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return means over cells about C and γ (k, n) of a picture over directions, row 0 at y max; C is from x to -y."""
    part = (np.arange(PARTS) + 0.5) / PARTS - 0.5
    c = np.radians(np.asarray(around)[:, None] + PLANE_STEP * part).ravel()
    gamma = np.abs(np.asarray(along)[:, None] + ANGLE_STEP * part).ravel()
    gamma = np.minimum(gamma, HALF_SPACE)
    x, y = np.outer(np.cos(c), gamma), -np.outer(np.sin(c), gamma)  # degrees
    column, row = (x + HALF_SPACE) / PIXEL - 0.5, (HALF_SPACE - y) / PIXEL - 0.5
    values = map_coordinates(intensity, np.stack([row, column]), order=1, mode="nearest")
    weight = np.sin(np.radians(gamma)) + 1e-12
    cells = (len(around), PARTS, len(along), PARTS)
    return (values * weight).reshape(cells).sum((1, 3)) / np.broadcast_to(weight, values.shape).reshape(cells).sum(
        (1, 3)
    )
