"""A penalty against total internal reflection, for designs that light all that they can reach of a target.

Light that is reflected inside the lens misses the target and contributes no gradient.  Near the critical angle a small
ripple of the face suffices for total internal reflection.  So the merit of a design whose target is cut to its
reachable part has one more term, which depends on the slopes of the face alone:

    PENALTY_WEIGHT · mean over the light of max(0, u)²,    u = (η² sin² θ - sin² θ'_max) / (1 - sin² θ'_max)

θ is the angle of incidence, θ'_max the largest angle of refraction allowed (optics.trace.reach.grazing_of), and η the
index before the face / index behind it: u = 0 at θ'_max, and u = 1 at total internal reflection.  Within a knot span
∂z/∂x is linear in x and quadratic in y, and ∂z/∂y the reverse; both are near their extremes at the ends and centres of
spans.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import maximum_filter
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.numerics.reductions import total
from bstcad.optics.surfaces.bspline import BSplineSurface, evaluate
from bstcad.optics.surfaces.rays import Rays
from bstcad.tailoring.driver import Edge
from bstcad.tailoring.merit import SobolevVariable
from bstcad.tailoring.minimise import lbfgs, minimise
from bstcad.tailoring.slope_map import face_grid, interpolate, lit_window, rays_at

PENALTY_WEIGHT = 100.0  # weight of the penalty relative to RRMSD²
MAX_LIGHT_CELLS = 257  # largest number of cells per side of the grid from which the light is interpolated
PENALTY_START = 0.6  # value of u at which the penalty of `without_reflection` begins
ACCEPTED_EXCESS = 0.5  # largest accepted (u - PENALTY_START) / (1 - PENALTY_START) after `without_reflection`
MAX_EVALUATIONS = 60  # largest number of evaluations of the penalty in `without_reflection`


@dataclass(frozen=True)
class Grazing:
    """Penalty at the ends and centres of the knot spans of the last net, as a function of its heights."""

    net: BSplineSurface  # net whose knots are used; its heights are ignored
    at_face: Rays  # (3, j, k) rays at these points before refraction, interpolated from the lens given to `of`
    weight: Tensor  # (j, k) fraction of the light at each point, sum 1
    eta: float  # index before the face / index behind it
    angle: float  # θ'_max (rad)

    @classmethod
    def of(cls, edge: Edge, lens: Lens) -> Grazing:
        """Make the penalty at the last tailored face of a lens; edge: the light, and the angle θ'_max."""
        own_lens = edge.light.through(lens)
        source, net = edge.light.source, own_lens.nets[-1]
        window = lit_window(source, own_lens)
        m, n = net.shape
        grid = face_grid(source, own_lens, window, (min(2 * m, MAX_LIGHT_CELLS), min(2 * n, MAX_LIGHT_CELLS)))
        axes = zip((net.x, net.y), net.pitch, net.shape, strict=True)
        x, y = np.meshgrid(*(low + pitch * _span_points(count) for (low, _), pitch, count in axes), indexing="ij")
        inside = (np.abs(x) <= window.width / 2) & (np.abs(y) <= window.height / 2)
        light = np.where(inside, interpolate(grid, grid.density[None], (x, y))[0].numpy(), 0.0)
        weight = torch.from_numpy(maximum_filter(light, 5))  # a span that is lit in part gets its full weight
        rays, eta = rays_at(grid, (x, y)), own_lens.last_tailored.law.eta
        return cls(net, rays, weight / total(weight), eta=eta, angle=edge.angle)

    def __call__(self, heights: Tensor) -> tuple[float, Tensor, float]:
        """Return the penalty, its gradient in the heights (m, n) in 1/mm, and the largest u where there is light."""
        (x, y, _), (d_x, d_y, d_z) = self.at_face.position.double(), self.at_face.direction.double()
        pitch_x, pitch_y = self.net.pitch
        leaf, limit = heights.detach().double().requires_grad_(), math.sin(self.angle) ** 2
        _, h_u, h_v = evaluate(leaf, *self.net.along_net(x, y))
        z_x, z_y = h_u / pitch_x, h_v / pitch_y
        along = d_z - d_x * z_x - d_y * z_y
        sine = 1 - along * along / (1 + z_x * z_x + z_y * z_y)
        u = (self.eta**2 * sine - limit) / (1 - limit)
        excess = torch.relu(u)
        value = PENALTY_WEIGHT * total(self.weight * excess * excess)
        worst = float(torch.where(self.weight > 0, u, torch.zeros_like(u)).detach().max())
        return float(value.detach()), torch.autograd.grad(value, leaf)[0].to(heights), worst


def _span_points(m: int) -> np.ndarray:
    """Return the positions of the ends and centres of the knot spans of m control points, in control-point spacings."""
    ends = np.array([0.0, *(np.arange(1, m - 2) + 0.5), m - 1.0])
    return np.sort(np.concatenate([ends, (ends[1:] + ends[:-1]) / 2]))


def without_reflection(lens: Lens, edge: Edge) -> Lens:
    """Return the lens with its last net changed just enough that no light undergoes total internal reflection there.

    It runs after stage 2 and minimises the penalty alone, which begins here at u = PENALTY_START: for little light.
    """
    net, limit = lens.nets[-1], math.sin(edge.angle) ** 2
    penalty = replace(Grazing.of(edge, lens), angle=math.asin(math.sqrt(limit + PENALTY_START * (1 - limit))))
    variable = SobolevVariable.of(net, torch.ones_like(net.heights))

    def in_c(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        value, gradient, worst = penalty(net.heights + variable.heights(parameters[0].detach()))
        return value, [variable.adjoint(gradient)], worst

    if penalty(net.heights)[2] <= ACCEPTED_EXCESS:
        return lens
    for reached in minimise(in_c, lbfgs([torch.zeros_like(net.heights)], MAX_EVALUATIONS), MAX_EVALUATIONS):
        if reached.best.figure <= ACCEPTED_EXCESS:
            break
    return lens.with_last_net(replace(net, heights=net.heights + variable.heights(reached.best.parameters[0])))
