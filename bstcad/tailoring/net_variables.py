"""The variables of stage 2 for all nets of a lens: coupled for two faces and several pictures, otherwise independent.

For a point source or collimated light the slopes of both faces have nearly the same effect: light from the point q of
the front meets the back at b(q), and a slope at q moves the landing point of this light on a plane behind the lens
nearly as far as an equal slope at b(q).  In the heights of the two nets the merit is therefore a long narrow valley.
The directions along and across the valley separate if the back repeats each change h(q) of the front where the light
from q arrives:

    δz_front(q) = h(q),    δz_back(b(q)) = κ h(q),    κ = (n d_z - d_z,in) / (n d_z - d_z,out).

Here n is the index, and d_z, d_z,in and d_z,out are the cosines of the angles of the ray to the axis in the glass,
before and behind the lens.  Such a pair of changes leaves all optical paths, and so the wavefront behind the lens,
unchanged to first order.  It moves b(q), and so changes only the irradiance behind the lens.  A change of the back
alone changes the wavefront.  The variable c has one block for the pair and one for the back alone,

    δz_front = f S_front c_1,    δz_back = S_back c_2 + R δz_front,

with the Sobolev variable S of merit.py, a scale f, and the interpolation R of κ h along the rays.  Two photographs end
at RRMSDs of 0.061 and 0.057 after 98 evaluations, and at 0.071 and 0.063 with independent blocks.
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

from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import FRONT
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.trace.trace import across, behind
from bstcad.tailoring.merit import CoarseVariable, SobolevVariable, control_point_axes
from bstcad.transport.mapping import grid_coordinates

SCALE_FRACTION = 0.2  # measured best ratio of f to the scale at which both blocks move the pictures equally far
# Standard deviation of the smoothing of q(b), in control points of the back.  In a gap between two parts of the light,
# where few rays fall and some cross, q(b) jumps: without smoothing R causes ripples of 0.07 mm between the tubes.
POSITION_SMOOTHING = 3.0
INTERPOLATION_POINTS = 4  # front control points per axis from which R interpolates at a control point of the back


@dataclass(frozen=True)
class NetVariables:
    """Changes of the heights (mm) of the nets of a lens, as a function of one block of variables c per net."""

    blocks: tuple[SobolevVariable | CoarseVariable, ...]
    along: csr_array | None = None  # matrix R, (points of the back, points of the front); None: independent blocks
    scale: float = 1.0  # factor f

    def zeros(self) -> list[Tensor]:
        """Return c = 0, no change of the heights."""
        return [block.zero() for block in self.blocks]

    def heights(self, c: Sequence[Tensor]) -> list[Tensor]:
        """Return the changes (mm) of the heights of each net at c."""
        parts = [block.heights(at) for block, at in zip(self.blocks, c, strict=True)]
        if self.along is None:
            return parts
        front, back = self.scale * parts[0], parts[1]
        return [front, back + _multiply(self.along, front, back)]

    def adjoint(self, g: Sequence[Tensor]) -> list[Tensor]:
        """Apply the transpose of `heights`: turn g, gradients in the heights of each net, into gradients in c."""
        if self.along is not None:
            front, back = g
            g = [self.scale * (front + _multiply(self.along.T, back, front)), back]
        return [block.adjoint(part) for block, part in zip(self.blocks, g, strict=True)]


def _multiply(matrix: csr_array, t: Tensor, like: Tensor) -> Tensor:
    """Return `matrix` times t, with shape and type of `like`, by scipy, whose single thread sums in a fixed order."""
    return torch.from_numpy(matrix @ t.cpu().double().numpy().reshape(-1)).reshape(like.shape).to(like)


@torch.no_grad()
def along_light(source: Emitter, lens: Lens, goals: Sequence[Goal]) -> tuple[csr_array, float]:
    """Return R and f for a lens with two nets.

    f is SCALE_FRACTION times the scale at which both blocks move the pictures equally far: the weighted RMS over the
    goals k of d_k / m_k, divided by T / (n m_b); both are paraxial shifts per slope.  T is the thickness, d_k the
    distance from the back to plane k, and m_b and m_k are the magnifications of b(q) and of picture k.
    """
    front, back = lens.nets
    q_x, q_y = torch.meshgrid(*control_point_axes(front), indexing="ij")
    q, device = torch.stack([q_x, q_y]).numpy(), lens.like.device
    coming = source.rays_through(q_x.to(device), q_y.to(device), lens.entrance.z, 1.0)
    interfaces, number = lens.unbounded().interfaces, lens.number_of(FRONT)
    within = behind(across(coming, interfaces[:number]), interfaces[number])
    out = behind(within, interfaces[number + 1])
    glass = lens.index * within.direction[2]
    factor = _array((glass - lens.passes.index_before * coming.direction[2]) / (glass - out.direction[2]))
    x, y, _ = coming.position
    lit = (_array(source.irradiance(x, y, lens.entrance.z)) > 0) & (_array(out.alive) > 0)
    if any(np.unique(at[lit]).size < 2 for at in q):  # a narrow beam and few control points
        lit = _array(out.alive) > 0
    b = _array(out.position[:2])
    row, column = grid_coordinates(*b, *(p.numpy() for p in torch.meshgrid(*control_point_axes(back), indexing="ij")))
    carried = _interpolation(_smoothed(row), _smoothed(column), front.shape)
    carried = carried @ diags_array(np.where(lit, factor, 1.0).reshape(-1))

    shift_on_back = (back.z - front.z) / lens.index / _magnification(q, b, lit)
    planes = [goal.screen.receiver for goal in goals]
    shifts = [p.per_radian(back.z) / _magnification(q, _array(p.land(out).position), lit) for p in planes]
    weights = [goal.weight for goal in goals]
    mean = math.sqrt(sum(w * s * s for w, s in zip(weights, shifts, strict=True)) / sum(weights))
    return csr_array(carried), SCALE_FRACTION * abs(mean / shift_on_back)


def _array(t: Tensor) -> np.ndarray:
    return t.cpu().double().numpy()


def _magnification(q: np.ndarray, points: np.ndarray, lit: np.ndarray) -> float:
    """Return the mean of ∂x/∂q_x and ∂y/∂q_y of the points x, y (2, …), by least squares over the lit points."""
    p, at = ([axis[lit] - axis[lit].mean() for axis in each] for each in (points, q))
    return sum(float((u * v).sum() / (v * v).sum()) for u, v in zip(p, at, strict=True)) / 2


def _smoothed(at: np.ndarray) -> np.ndarray:
    """Smooth positions with a Gaussian of POSITION_SMOOTHING; linear trends continue across the rim."""
    wide = math.ceil(4 * POSITION_SMOOTHING)
    padded = np.pad(at, wide, mode="reflect", reflect_type="odd")
    return gaussian_filter(padded, POSITION_SMOOTHING)[wide:-wide, wide:-wide]


def _interpolation(row: np.ndarray, column: np.ndarray, sides: tuple[int, int]) -> csr_array:
    """Return the matrix (points, control points) that interpolates a net of `sides` at fractional rows and columns."""
    (i, a), (j, b) = (_cubic_weights(p.reshape(-1), m) for p, m in zip((row, column), sides, strict=True))
    values, columns = a[:, :, None] * b[:, None, :], i[:, :, None] * sides[1] + j[:, None, :]
    starts = np.arange(0, values.size + 1, INTERPOLATION_POINTS**2)
    return csr_array((values.reshape(-1), columns.reshape(-1), starts), shape=(row.size, sides[0] * sides[1]))


def _cubic_weights(at: np.ndarray, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Return indices and weights (k, 4) of cubic convolution (Keys 1981, a = -1/2) at positions (k,) among m points."""
    first = np.minimum(at.astype(int), m - 2)
    t = at - first
    weights = t * (-1 + t * (2 - t)), 2 + t * t * (-5 + 3 * t), t * (1 + t * (4 - 3 * t)), t * t * (t - 1)
    return np.clip(first[:, None] + np.arange(-1, 3), 0, m - 1), np.stack(weights, axis=1) / 2
