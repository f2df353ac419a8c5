"""Étendue: how much of the light of a source fits into the lit part of a target, whatever the faces of the lens.

No lens increases the radiance of light, in air behind it: L / n² is constant along a ray, n the refractive index.  Let
e(q) be the flux per area at a point q of the entrance, as a fraction of the light that enters the lens, and
ω(q) = ∫ cos θ dΩ the projected solid angle of the source there: the area that its directions fill in the plane of the
direction cosines (d_x, d_y).  The radiance behind the lens is at most

    L = max_q e(q) / (n² ω(q)).

A pixel j receives at most L g_j, where g_j = ∫ cos θ dΩ dA (mm² sr) is the étendue between the outline of the last face
and the pixel.  So at most Σ_j min(P_j, L g_j) of the light fits into a picture P of the sum 1.  An even cone about the
axis that takes all light has a half angle of at least θ, sin² θ = 1 / (π A L), A the area of the outline.
(Chaves, J., Introduction to Nonimaging Optics, 2nd ed. 2016, chapter 18.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.numerics.reductions import total
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.rays import Rays
from bstcad.optics.trace.trace import clear_window, is_transmitted
from bstcad.optics.trace.unfolding import image_from_last_net

ENTRANCE_POINTS, FACE_POINTS = 48, 9  # points per side of the entrance and of the last face
AIMS_AT_A_TIME = 1 << 14  # number of pixels whose étendue is computed at a time
SILHOUETTES, DOME_RINGS = 65, 33  # numbers of directions, and of rings of points of a dome
MAX_SIDE = 256  # largest number of cells along the longer side of a target, of which a pixel has a power of two
FORBIDDEN = 0.9  # fraction of the light that fits, below which a request is called impossible


@dataclass(frozen=True)
class Etendue:
    """Largest share of the light that a target can take, and the narrowest even light that takes all of it."""

    fits: float  # largest fraction of the light that fits into the picture
    narrowest: (
        float  # smallest half angle (degrees) of an even cone, or radius (mm) of an even disc, with all the light
    )
    unit: str  # unit of `narrowest`

    @property
    def forbids(self) -> bool:
        """True if much of the light cannot fit into the picture."""
        return self.fits < FORBIDDEN


@torch.no_grad()
def etendue(source: Emitter, lens: Lens, goal: Goal) -> Etendue | None:
    """Return how much light of a source of finite size fits into the picture of a goal; None: it has no size.

    lens: the blank, or a finished lens.
    """
    if source.extent is None or source.is_given:
        return None
    radiance = largest_radiance(source, lens)
    if radiance is None:
        return None
    area = Silhouette.of(lens).area(np.ones(1))[0]
    cells = 1 << max(0, int(math.log2(MAX_SIDE / max(goal.screen.shape))))  # the target as it is meant, not its pixels
    fine = goal.on_cells(cells)
    wanted, share = fine.picture / fine.picture.sum(), radiance * pixel_etendue(lens, fine)
    half = math.asin(min(math.sqrt(1 / (math.pi * area * radiance)), 1.0))
    receiver = image_from_last_net(lens, goal.screen.receiver)
    if receiver.unit == "degrees":
        return Etendue(float(np.minimum(wanted, share).sum()), math.degrees(half), receiver.unit)
    throw = abs(receiver.throw(float(lens.back.z)))
    return Etendue(float(np.minimum(wanted, share).sum()), throw * math.tan(min(half, 1.5)), receiver.unit)


def largest_radiance(source: Emitter, lens: Lens) -> float | None:
    """Return L (1 / (mm² sr)) of the light that passes the lens, as a fraction of it; None if there is none."""
    extent, centre, z = source.extent, source.central, lens.entrance.z
    assert extent is not None, "a source without extent has no radiance"
    area = clear_window(centre, lens)
    x, y = sampling.grid(area, ENTRANCE_POINTS)
    # points with the second moments of an even disc or rectangle, along each axis
    (a, b), share = extent.half_extent, 1 / 2 if extent.is_round else 1 / math.sqrt(3)
    signs = ((1, 1), (1, -1), (-1, 1), (-1, -1))
    elements = [source.element(share * a * u, share * b * v).central for u, v in signs]
    rays = [each.rays_through(x, y, z, 1.0) for each in elements]
    flux = sum((each.irradiance(x, y, z) for each in elements), torch.zeros_like(x)) / len(elements)
    flux = torch.where(is_transmitted(centre.rays_through(x, y, z, 1.0), lens), flux, torch.zeros_like(flux))
    along_x, along_y = (
        torch.stack([sign[axis] * each.direction[:2] for sign, each in zip(signs, rays, strict=True)]).mean(0) / half
        for axis, half in ((0, share * a), (1, share * b))
    )
    turned = along_x[0] * along_y[1] - along_x[1] * along_y[0]
    solid = lens.passes.index_before**2 * extent.area * turned.abs()
    whole = float(total(flux)) * area.area / ENTRANCE_POINTS**2
    return float((flux[flux > 0] / solid[flux > 0]).max()) / whole if whole > 0 else None


def pixel_etendue(lens: Lens, goal: Goal) -> np.ndarray:
    """Return g (rows, columns), mm² sr, of the pixels of a goal, seen from the last face through its outline."""
    screen = goal.screen
    receiver, sizes = image_from_last_net(lens, screen.receiver), screen.cell_sizes
    (left, right), (low, high) = screen.x, screen.y
    columns = left + (np.arange(screen.columns) + 0.5) * (right - left) / screen.columns
    rows = high - (np.arange(screen.rows) + 0.5) * (high - low) / screen.rows
    x, y = (torch.from_numpy(p.copy()).reshape(-1) for p in np.meshgrid(columns, rows))
    found = np.empty(len(x))
    for first in range(0, len(x), AIMS_AT_A_TIME):
        part = slice(first, first + AIMS_AT_A_TIME)
        found[part] = _seen(lens, receiver, torch.stack([x[part], y[part]]))
    return found.reshape(screen.shape) * sizes


def _seen(lens: Lens, receiver: Receiver, aim: Tensor) -> np.ndarray:
    """Return g of aims (2, n) per area (mm²) or solid angle (sr) of the receiver, unfolded to `receiver`."""
    outline, sum_of_all = lens.plan, np.zeros(aim.shape[1])
    half_x, half_y = outline.half_extent
    x, y = (p.reshape(-1) for p in sampling.grid(Rectangle(2 * half_x, 2 * half_y), FACE_POINTS))
    places, seen = torch.stack([x, y])[:, outline.contains(x, y)].T, Silhouette.of(lens)
    places = places[:1] if receiver.unit == "degrees" else places  # a direction is the same from everywhere
    for p in places:
        position = torch.tensor([*p.tolist(), 0.0], dtype=torch.float64)[:, None].expand(3, aim.shape[1])
        rays = Rays(position, position, position[0], torch.zeros(aim.shape[1], dtype=torch.uint8), z=float(lens.back.z))
        towards = receiver.vector_to(rays, aim)
        square = (towards * towards).sum(0)
        direction = towards / torch.sqrt(square)
        weight = np.ones(aim.shape[1])
        if receiver.unit != "degrees":
            normal = torch.stack([torch.as_tensor(n).expand_as(direction[0]) for n in receiver.normal(aim)])
            weight = ((normal * direction).sum(0).abs() / square).numpy()
        sum_of_all += weight * seen.area(direction[2].abs().numpy())
    return sum_of_all / len(places)


@dataclass(frozen=True)
class Silhouette:
    """Area of the lit last face as it is seen from a direction.

    A face of heights is seen through its outline, A cos θ; of a dome, the convex hull of its points is seen, as if the
    dome were a figure of revolution.
    """

    cosines: np.ndarray  # cos θ (k,), increasing, θ the angle of the direction to the axis
    areas: np.ndarray  # areas (k,), mm²

    @classmethod
    def of(cls, lens: Lens) -> Silhouette:
        """Return the silhouette of the last face of a lens."""
        cosines, back = np.linspace(0.0, 1.0, SILHOUETTES), lens.plain().back
        if back.chart.flat:
            return cls(cosines, lens.apertures[1].area * cosines)
        x, y = (torch.from_numpy(p) for p in lens.last_tailored.outline.rim_points())
        share = torch.linspace(0.0, 1.0, DOME_RINGS, dtype=torch.float64)[:, None]
        points = back.at((share * x).reshape(-1), (share * y).reshape(-1)).position.numpy()
        sines = np.sqrt(1 - cosines**2)
        flat = (
            np.stack([c * points[0] - s * points[2], points[1]], axis=1) for c, s in zip(cosines, sines, strict=True)
        )
        return cls(cosines, np.array([ConvexHull(p).volume for p in flat]))  # in two dimensions the area

    def area(self, cosines: np.ndarray) -> np.ndarray:
        """Return the areas (mm²) from directions with these cosines to the axis."""
        return np.interp(cosines, self.cosines, self.areas)
