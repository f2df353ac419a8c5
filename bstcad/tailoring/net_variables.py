"""The variables of stage 2 for all nets of a lens together.

For a point source or collimated light the two faces of a lens act nearly alike.  Let light from the point q of the
front meet the back at b(q).  Its landing point on a plane behind the lens moves by nearly the same amount for a slope
of either face, so that the merit in the heights of the two nets is a long narrow valley.  But a change h(q) of the
front that the back repeats where the light arrives,

    δz_front(q) = h(q),    δz_back(b(q)) = κ h(q),    κ = (n d_z - d_z,in) / (n d_z - d_z,out),

leaves all optical paths unchanged to first order.  Here d_z, d_z,in and d_z,out are the cosines of the ray with the
axis in the glass, before and behind the lens.  The light behind the lens keeps its wavefront, and only its irradiance
changes.  So the two blocks of the variable c are

    δz_front = f S_front c_1,    δz_back = S_back c_2 + R δz_front,

with S as in merit.py, and R the interpolation of κ h along the rays: c_1 changes the irradiance behind the lens, c_2
the wavefront.  Two photographs end at an RRMSD of 0.061 and 0.057 after 98 evaluations, and at 0.071 and 0.063 with
independent blocks.
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
from bstcad.transport.mapping import grid_coordinates

SCALE_FRACTION = 0.2  # f relative to the scale at which both blocks move the pictures equally far, by measurement
# Standard deviation of the smoothing of q(b), in control points of the back.  In a gap between two parts of the light,
# where few rays fall and some cross, q(b) jumps: without smoothing R makes ripples of 0.07 mm between the tubes.
POSITION_SMOOTHING = 3.0
INTERPOLATION_POINTS = 4  # control points of the front, each way, in the interpolation at one of the back


@dataclass(frozen=True)
class NetVariables:
    """Heights (mm) of the nets of a lens as a function of one block of variables c per net."""

    blocks: tuple[SobolevVariable | CoarseVariable, ...]
    along: csr_array | None = None  # matrix R, (points of the back, points of the front); None: independent blocks
    scale: float = 1.0  # factor f

    def zeros(self) -> list[Tensor]:
        """Return c = 0, no change of the heights."""
        return [block.zero() for block in self.blocks]

    def heights(self, c: Sequence[Tensor]) -> list[Tensor]:
        """Return the change of the heights of each net (mm) at c."""
        parts = [block.heights(at) for block, at in zip(self.blocks, c, strict=True)]
        if self.along is None:
            return parts
        front, back = self.scale * parts[0], parts[1]
        return [front, back + _multiply(self.along, front, back)]

    def adjoint(self, g: Sequence[Tensor]) -> list[Tensor]:
        """Apply the transpose of `heights`: from gradients in the control points to those in c."""
        if self.along is not None:
            front, back = g
            g = [self.scale * (front + _multiply(self.along.T, back, front)), back]
        return [block.adjoint(part) for block, part in zip(self.blocks, g, strict=True)]


def _multiply(matrix: csr_array, t: Tensor, like: Tensor) -> Tensor:
    """Return matrix t by scipy, in one thread, whose sums have a fixed order."""
    return torch.from_numpy(matrix @ t.cpu().double().numpy().reshape(-1)).reshape(like.shape).to(like)


@torch.no_grad()
def along_light(source: Emitter, lens: Lens, goals: Sequence[Goal]) -> tuple[csr_array, float]:
    """Return R and f for a lens with two nets.

    f is SCALE_FRACTION times the scale at which both blocks move the pictures equally far, by the paraxial shifts
    T / (n m_b) and d_k / m_k of the light from q.  T is the thickness, d_k the distance from the back to plane k, and
    m_b and m_k are the magnifications of b(q) and of picture k.
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
    row, column = grid_coordinates(*places, *(p.numpy() for p in torch.meshgrid(*_control_points(back), indexing="ij")))
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
    return csr_array(carried), SCALE_FRACTION * abs(mean / own)


def _control_points(net: BSplineSurface) -> list[Tensor]:
    """Return x and y (mm) of the control points of a net, evenly spaced."""
    return [torch.linspace(*ends, m, dtype=torch.float64) for ends, m in zip((net.x, net.y), net.shape, strict=True)]


def _array(t: Tensor) -> np.ndarray:
    return t.cpu().double().numpy()


def _magnification(q: np.ndarray, places: Sequence[np.ndarray], lit: np.ndarray) -> float:
    """Return the mean of ∂x/∂q_x and ∂y/∂q_y of points (2, …), by least squares over the lit ones."""

    def along(p: np.ndarray, at: np.ndarray) -> float:
        p, at = p[lit] - p[lit].mean(), at[lit] - at[lit].mean()
        return float((p * at).sum() / (at * at).sum())

    lit = lit > 0
    return (along(places[0], q[0]) + along(places[1], q[1])) / 2


def _smoothed(at: np.ndarray) -> np.ndarray:
    """Smooth by a Gaussian of POSITION_SMOOTHING, with linear trends continued across the rim."""
    wide = math.ceil(4 * POSITION_SMOOTHING)
    padded = np.pad(at, wide, mode="reflect", reflect_type="odd")
    return gaussian_filter(padded, POSITION_SMOOTHING)[wide:-wide, wide:-wide]


def _interpolation(row: np.ndarray, column: np.ndarray, sides: tuple[int, int]) -> csr_array:
    """Return the matrix (points, control points) that interpolates a net at fractional rows and columns."""
    (i, a), (j, b) = (_cubic_weights(p.reshape(-1), m) for p, m in zip((row, column), sides, strict=True))
    values, columns = a[:, :, None] * b[:, None, :], i[:, :, None] * sides[1] + j[:, None, :]
    starts = np.arange(0, values.size + 1, INTERPOLATION_POINTS**2)
    return csr_array((values.reshape(-1), columns.reshape(-1), starts), shape=(row.size, sides[0] * sides[1]))


def _cubic_weights(at: np.ndarray, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Return indices and weights (k, 4) of the cubic convolution (Keys 1981, a = -1/2) at positions (k,) among m."""
    first = np.minimum(at.astype(int), m - 2)
    t = at - first
    weights = t * (-1 + t * (2 - t)), 2 + t * t * (-5 + 3 * t), t * (1 + t * (4 - 3 * t)), t * t * (t - 1)
    return np.clip(first[:, None] + np.arange(-1, 3), 0, m - 1), np.stack(weights, axis=1) / 2
