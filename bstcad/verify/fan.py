"""A fan of rays in the section y = 0, for the picture of the lens from the side."""

from __future__ import annotations

import numpy as np
import torch

from bstcad.optics.lens import Lens
from bstcad.optics.rays import Status
from bstcad.optics.simulation import clear_window
from bstcad.optics.sources import Source
from bstcad.optics.trace import intersect, into_glass, refract, to_plane

RAYS = 15


def fan(source: Source, lens: Lens, z: float) -> np.ndarray:
    """Polylines (rays, 4, 3) in mm: source, front, back, the plane z; only rays that arrive."""
    half = clear_window(source, lens).width / 2
    x = torch.linspace(-0.98 * half, 0.98 * half, RAYS, dtype=torch.float64)
    started = source.rays(x, torch.zeros_like(x), lens.front.z, 1.0)
    in_glass = into_glass(started, lens)
    at_back, z_x, z_y = intersect(lens.back, in_glass, lens.outline, Status.VIGNETTED)
    landed = to_plane(refract(at_back, z_x, z_y, lens.index, 1.0), z)
    points = torch.stack([rays.position for rays in (started, in_glass, at_back, landed)])
    return points[:, :, landed.alive & (landed.flux > 0)].permute(2, 0, 1).numpy()
