"""The variables of stage 2 for all nets of a lens at once.

Two faces of a lens in parallel or point light work nearly alike: light from the place q of the front, which meets the
back at b(q), moves on a plane behind the lens by much the same for a slope of either face, and the merit in the heights
of the two nets is a long narrow valley.  But a change of the front alone, h(q), that the back repeats where its light
arrives,

    δz_front(q) = h(q),    δz_back(b(q)) = κ h(q),    κ = (n d_z - d_z,in) / (n d_z - d_z,out),

d_z the cosines of the ray with the axis in the glass, before and behind it, leaves all optical paths as they are, to
the first order: the light behind the lens keeps its wavefront, and its rays only bring another part of the source's
light.  So the two blocks of the variable c are

    δz_front = f S_front c_1,    δz_back = S_back c_2 + R δz_front,

S as in merit.py, R the interpolation of κ h along the light: c_1 changes which light goes where behind the lens, c_2
the wavefront.  Two photographs end at an RRMSD of 0.061 and 0.057 after 98 evaluations, and at 0.071 and 0.063 with a
block a net.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_array, diags_array
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.emitters import Emitter
from bstcad.optics.goal import Goal
from bstcad.optics.lens import Lens
from bstcad.optics.trace import across, behind
from bstcad.tailoring.merit import CoarseVariable, SobolevVariable
from bstcad.transport.mapping import places_in

SHARE = 0.2  # of the scale at which both blocks move the pictures as far, by measurement
# Control points of the back over which q is smoothed.  In a gap between two parts of the light, where few rays fall and
# some cross, q(b) jumps from point to point: R then drew ripples of 0.07 mm into the back, that no ray tube saw.
SMOOTH = 3.0
TAPS = 4  # control points of the front each way from which one of the back takes its share


@dataclass(frozen=True)
class NetVariables:
    """Heights (mm) of the nets of a lens as a function of one block c a net."""

    blocks: tuple[SobolevVariable | CoarseVariable, ...]
    along: csr_array | None = None  # R: (points of the back, points of the front); None: each net has its block alone
    scale: float = 1.0  # f

    def zeros(self) -> list[Tensor]:
        """c of no change."""
        return [block.zero() for block in self.blocks]

    def heights(self, c: Sequence[Tensor]) -> list[Tensor]:
        """The change of the heights of each net (mm) at c."""
        parts = [block.heights(at) for block, at in zip(self.blocks, c, strict=True)]
        if self.along is None:
            return parts
        front, back = self.scale * parts[0], parts[1]
        return [front, back + _times(self.along, front, back)]

    def adjoint(self, g: Sequence[Tensor]) -> list[Tensor]:
        """The transpose of `heights`: from gradients in the control points to those in c."""
        if self.along is not None:
            front, back = g
            g = [self.scale * (front + _times(self.along.T, back, front)), back]
        return [block.adjoint(part) for block, part in zip(self.blocks, g, strict=True)]


def _times(matrix: csr_array, t: Tensor, like: Tensor) -> Tensor:
    """By scipy, in one thread, whose sums have one order."""
    return torch.from_numpy(matrix @ t.cpu().double().numpy().reshape(-1)).reshape(like.shape).to(like)


@torch.no_grad()
def along_light(source: Emitter, lens: Lens, goals: Sequence[Goal]) -> tuple[csr_array, float]:
    """R and f for a lens with two nets.

    f is SHARE of the scale that makes both blocks move the pictures as far: by the paraxial shifts T / (n m_b) and
    d_k / m_k of the light from q, T the thickness, d_k the ways from the back to the planes, m_b and m_k the
    magnifications of b(q) and of the picture.
    """
    front, back = lens.nets
    q = torch.stack(torch.meshgrid(*_control_points(front), indexing="ij"))
    coming = source.rays(*q.to(lens.like.device), lens.entrance.z, 1.0)
    interfaces, number = lens.unbounded().interfaces, lens.number_of("front")
    within = behind(across(coming, interfaces[:number]), interfaces[number])
    out = behind(within, interfaces[number + 1])
    glass = lens.index * within.direction[2]
    factor = _array((glass - coming.direction[2]) / (glass - out.direction[2]))
    lit = _array((source.irradiance(*coming.position[:2], lens.entrance.z) > 0) & out.alive)
    if any(np.unique(at[lit > 0]).size < 2 for at in q.numpy()):  # a narrow beam and few control points
        lit = _array(out.alive)
    places = [_array(p) for p in out.position[:2]]
    row, column = places_in(*places, *(p.numpy() for p in torch.meshgrid(*_control_points(back), indexing="ij")))
    row, column = (_smoothed(at) for at in (row, column))
    carried = _interpolation(row, column, q.shape[1:]) @ diags_array(np.where(lit, factor, 1.0).reshape(-1))

    own = (back.z - front.z) / lens.index / _magnification(q.numpy(), places, lit)
    shifts = [
        goal.receiver.plane.per_radian(back.z)
        / _magnification(q.numpy(), _array(goal.receiver.plane.land(out).position), lit)
        for goal in goals
    ]
    weights = [goal.weight for goal in goals]
    mean = math.sqrt(sum(w * s * s for w, s in zip(weights, shifts, strict=True)) / sum(weights))
    return csr_array(carried), SHARE * abs(mean / own)


def _control_points(net: BSplineSurface) -> list[Tensor]:
    """x and y (mm) of its control points, evenly apart."""
    return [torch.linspace(*ends, m, dtype=torch.float64) for ends, m in zip((net.x, net.y), net.shape, strict=True)]


def _array(t: Tensor) -> np.ndarray:
    return t.cpu().double().numpy()


def _magnification(q: np.ndarray, places: Sequence[np.ndarray], lit: np.ndarray) -> float:
    """The mean of ∂x/∂q_x and ∂y/∂q_y of places (2, …), by least squares over the light."""

    def along(p: np.ndarray, at: np.ndarray) -> float:
        p, at = p[lit] - p[lit].mean(), at[lit] - at[lit].mean()
        return float((p * at).sum() / (at * at).sum())

    lit = lit > 0
    return (along(places[0], q[0]) + along(places[1], q[1])) / 2


def _smoothed(at: np.ndarray) -> np.ndarray:
    """By a Gaussian of SMOOTH; beyond the rim it goes on as steeply as within."""
    wide = math.ceil(4 * SMOOTH)
    padded = np.pad(at, wide, mode="reflect", reflect_type="odd")
    return gaussian_filter(padded, SMOOTH)[wide:-wide, wide:-wide]


def _interpolation(row: np.ndarray, column: np.ndarray, sides: tuple[int, int]) -> csr_array:
    """(places, control points): a net's heights at real rows and columns among its control points."""
    (i, a), (j, b) = (_taps(p.reshape(-1), m) for p, m in zip((row, column), sides, strict=True))
    values, columns = a[:, :, None] * b[:, None, :], i[:, :, None] * sides[1] + j[:, None, :]
    starts = np.arange(0, values.size + 1, TAPS**2)
    return csr_array((values.reshape(-1), columns.reshape(-1), starts), shape=(row.size, sides[0] * sides[1]))


def _taps(at: np.ndarray, m: int) -> tuple[np.ndarray, np.ndarray]:
    """(k, TAPS) indices and weights of the cubic convolution (Keys 1981, a = -1/2) at real places (k,) among m."""
    first = np.minimum(at.astype(int), m - 2)
    t = at - first
    weights = np.stack([
        t * (-1 + t * (2 - t)), 2 + t * t * (-5 + 3 * t), t * (1 + t * (4 - 3 * t)), t * t * (t - 1),
    ], axis=1) / 2  # fmt: skip
    return np.clip(first[:, None] + np.arange(-1, 3), 0, m - 1), weights
