"""The variable of stage 2, in which the merit is nearly round.

A change δz of the last face moves the light by the throw L times its slope and so changes the irradiance by about
E L Δδz; with dA_t = (e / E) dA_b, e the flux density on the back face, the squared error is

    ∫ δE² dA_t  =  L² ∫ e E (Δδz)² dA_b.

Its Hessian is Δ e E Δ, so in c with δz = Δ^-1 E^-1/2 c it would be the unit matrix for a beam of even e.  The pixels
average out what is finer than they are, which makes a weaker power of Δ better: 0.5 by measurement, since letters gain
by a still weaker one and portraits by a stronger one.  The weight E^-1/2 halves the evaluations that a picture with
dark parts takes.  Δ is diagonal in the cosine transform of the net.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, map_coordinates
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.sources import Source
from bstcad.optics.trace import through
from bstcad.optics.tubes.finding import rays_to
from bstcad.tailoring.cosine_basis import cosine, inverse_cosine, laplacian

EXPONENT = 0.5  # of the Laplacian
BLUR = 1.0  # pixels; irradiance for the weight
SMOOTH = 1.5  # control points; of the weight's logarithm
MOST = 4.0  # weights are clamped to [1 / MOST, MOST]


@dataclass(frozen=True)
class SobolevVariable:
    """Heights h (m, m) in mm as a function of c (m, m): h = p C^T (λ^-EXPONENT · C (w c) C^T) C.

    C is the orthonormal cosine transform; λ_ij = 4 - 2 cos(π i / m) - 2 cos(π j / m) is the Laplacian on the
    net, zero for the piston; p the pitch in mm.
    """

    weight: Tensor  # (m, m) w, a local step size
    scale: Tensor  # (m, m) p λ^-EXPONENT

    @classmethod
    def of(cls, surface: BSplineSurface, weight: Tensor) -> SobolevVariable:
        """For the net of a surface."""
        axis = laplacian(surface.m)
        energy = axis[:, None] + axis
        # by numpy, in one thread: torch rounds a power in another way where a thread's share ends
        power = torch.from_numpy(np.power(torch.where(energy > 0, energy, math.inf).numpy(), -EXPONENT))
        scale = math.sqrt(math.prod(surface.pitch)) * power
        return cls(weight.to(surface.heights), scale.to(surface.heights))

    def heights(self, c: Tensor) -> Tensor:
        """h of c (mm)."""
        return inverse_cosine(self.scale * cosine(self.weight * c))

    def adjoint(self, g: Tensor) -> Tensor:
        """The transpose of `heights`: from a gradient in the control points to one in c."""
        return self.weight * inverse_cosine(self.scale * cosine(g))


def local_weight(source: Source, lens: Lens, target: np.ndarray, screen: Screen, number: int | None = None) -> Tensor:
    """w = (E / mean E)^-1/2 at each control point, E the target's irradiance where its light lands, smoothed.

    1 where the light does not land on the screen.  number: of the interface, which is a net; None: the back.
    """
    number = lens.number_of_back if number is None else number
    net, onwards = lens.interfaces[number].surface, lens.unbounded().interfaces[number:]
    places = (torch.linspace(low, high, net.m, dtype=torch.float64) for low, high in (net.x, net.y))
    x, y = torch.meshgrid(*places, indexing="ij")
    _, _, at_net = rays_to(source, lens, x, y, number)
    with torch.no_grad():
        landed = through(at_net, onwards, screen.plane)
    column, row = (p.cpu().double().numpy() for p in screen.pixel(*landed.position))
    seen = landed.alive.cpu().numpy() & (column > 0) & (column < screen.columns) & (row > 0) & (row < screen.rows)
    picture = gaussian_filter(target / target.mean(), BLUR)
    found = map_coordinates(picture, [row - 0.5, column - 0.5], order=1, mode="nearest")
    logarithm = np.where(seen, np.log(np.maximum(found, MOST**-4)), 0.0)
    return torch.from_numpy(np.clip(np.exp(-0.5 * gaussian_filter(logarithm, SMOOTH)), 1 / MOST, MOST))
