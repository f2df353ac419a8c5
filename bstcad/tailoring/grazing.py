"""A pull that keeps light from total internal reflection where a design goes to the edge of its reach.

Light that a face reflects arrives nowhere and tells no gradient, and near the critical angle a small wave of the face
is enough for that.  So the merit of a design whose target is cut to what light can reach has one term more, from the
slopes of the face alone:

    WEIGHT · mean over the light of max(0, u)²,    u = (η² sin² θ - sin² θ'_most) / (1 - sin² θ'_most)

θ is the angle of incidence and θ'_most that at which light may leave (optics.reach.grazing_of): u is 0 there, and 1 at
total reflection.  Within a span of the net a slope is linear along its own axis and quadratic along the other: the ends
and the middles of spans tell how steep it gets.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import maximum_filter
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface, evaluate
from bstcad.optics.kernels.reductions import total
from bstcad.optics.lens import Lens
from bstcad.optics.rays import Rays
from bstcad.tailoring.merit import SobolevVariable
from bstcad.tailoring.minimise import lbfgs, minimise
from bstcad.tailoring.run import Edge
from bstcad.tailoring.slope_map import between, face_grid, lit_window, rays_at

WEIGHT = 100.0  # beside RRMSD²
MOST = 257  # cells a side, at most, of the grid between which the light is interpolated
CLEAR, SPARE = 0.6, 0.5  # u at which the pull at the end of a design begins; where it ends, of the rest of the way to 1
REPAIR = 60  # evaluations of the pull alone, at most


@dataclass(frozen=True)
class Grazing:
    """The pull at the ends and middles of the spans of the last net."""

    net: BSplineSurface  # of which the heights may be others
    at_face: Rays  # (3, m, n) before it; as it comes to the lens that this was made for
    share: Tensor  # (m, n) of the light, sum 1
    eta: float
    angle: float  # θ'_most (rad)

    @classmethod
    def of(cls, edge: Edge, lens: Lens) -> Grazing:
        """For the light on its way through a lens, at the ends and middles of all spans that it meets."""
        seen = edge.light.through(lens)
        source, net = edge.light.source, seen.nets[-1]
        window = lit_window(source, seen)
        grid = face_grid(source, seen, window, tuple(min(2 * m, MOST) for m in net.shape))
        axes = zip((net.x, net.y), net.pitch, net.shape, strict=True)
        x, y = np.meshgrid(*(low + pitch * _places(m) for (low, _), pitch, m in axes), indexing="ij")
        inside = (np.abs(x) <= window.width / 2) & (np.abs(y) <= window.height / 2)
        light = np.where(inside, between(grid, grid.density[None], (x, y))[0].numpy(), 0.0)
        share = torch.from_numpy(maximum_filter(light, 5))  # a span that is lit in part has places beyond
        rays, eta = rays_at(grid, (x, y)), seen.last_freeform.law.eta
        return cls(net, rays, share / total(share), eta=eta, angle=edge.angle)

    def __call__(self, heights: Tensor) -> tuple[float, Tensor, float]:
        """(value of the term, its gradient in the heights (m, n), the largest u of all light)."""
        (x, y, _), (d_x, d_y, d_z) = self.at_face.position.double(), self.at_face.direction.double()
        pitch_x, pitch_y = self.net.pitch
        leaf, most = heights.detach().double().requires_grad_(), math.sin(self.angle) ** 2
        _, h_u, h_v = evaluate(leaf, *self.net.along_net(x, y))
        z_x, z_y = h_u / pitch_x, h_v / pitch_y
        along = d_z - d_x * z_x - d_y * z_y
        sine = 1 - along * along / (1 + z_x * z_x + z_y * z_y)
        u = (self.eta**2 * sine - most) / (1 - most)
        beyond = torch.relu(u)
        value = WEIGHT * total(self.share * beyond * beyond)
        worst = float(torch.where(self.share > 0, u, torch.zeros_like(u)).detach().max())
        return float(value.detach()), torch.autograd.grad(value, leaf)[0].to(heights), worst


def _places(m: int) -> np.ndarray:
    """Ends and middles of the spans of m control points, in pitches."""
    ends = np.array([0.0, *(np.arange(1, m - 2) + 0.5), m - 1.0])
    return np.sort(np.concatenate([ends, (ends[1:] + ends[:-1]) / 2]))


def cleared(lens: Lens, edge: Edge) -> Lens:
    """The lens with its last net bent as little as it takes for none of the light to be reflected.

    By the pull alone, from CLEAR of its way to total reflection on, where hardly any light is.
    """
    net, most = lens.nets[-1], math.sin(edge.angle) ** 2
    pull = replace(Grazing.of(edge, lens), angle=math.asin(math.sqrt(most + CLEAR * (1 - most))))
    variable = SobolevVariable.of(net, torch.ones_like(net.heights))

    def in_c(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        value, gradient, worst = pull(net.heights + variable.heights(parameters[0].detach()))
        return value, [variable.adjoint(gradient)], worst

    if pull(net.heights)[2] <= SPARE:
        return lens
    for reached in minimise(in_c, lbfgs([torch.zeros_like(net.heights)], REPAIR), REPAIR):
        if reached.best.figure <= SPARE:
            break
    return lens.with_last_net(replace(net, heights=net.heights + variable.heights(reached.best.parameters[0])))
