"""The rays to given points of an interface: by Broyden's method on where they cross the plane of the first vertex."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from bstcad.optics.lens import Lens
from bstcad.optics.rays import Rays, Status
from bstcad.optics.sources import Source
from bstcad.optics.trace import towards

COARSE = 129  # points a side of the grid on which the rays to given points are found first
REVERSE_STEPS = 30  # at most, to find those rays
ARRIVED = 1e-8  # of the grid's extent: a ray that meets the interface so near to its point is found
DIFFERENCE = 1e-6  # of the grid's extent: step of the difference quotients
SINGULAR = 0.1  # of what an update divides by, over the square of the step: from there on it would tell nothing


@torch.no_grad()
def rays_to(source: Source, lens: Lens, x: Tensor, y: Tensor, number: int | None = None) -> tuple[Tensor, Tensor, Rays]:
    """The rays that meet an interface of the lens at the points (x, y) (n, n) mm.

    Returns where they cross the vertex plane of the first surface (mm), and the rays at the interface, before they
    cross it.  number: of the interface; None: the back.  The points are neighbours on a grid.

    By Broyden's method from a Jacobian of difference quotients; on a fine grid with start and Jacobian from a coarse
    one.
    """
    x, y = (p.to(lens.like.device) for p in (x, y))
    number = lens.number_of_back if number is None else number
    face = lens.interfaces[number].surface
    z = face.relative_sag_and_slope(x.to(lens.like), y.to(lens.like))[0].double()
    extent = float(torch.maximum(x.max() - x.min(), y.max() - y.min()))
    before = replace(lens.unbounded(), losses=None).interfaces[:number]  # the way alone is asked for

    def arrive(p: Tensor, q: Tensor, height: Tensor) -> Rays:
        coming = towards(source.rays(p, q, lens.entrance.z, 1.0), before)
        ahead = (coming.sense * coming.direction[2]).clamp(min=1e-3)
        path = coming.sense * (height - coming.above(face.z)) / ahead
        return replace(coming, position=coming.position + path * coming.direction)

    def jacobian(p: Tensor, q: Tensor, height: Tensor) -> list[Tensor]:
        """∂(hit) / ∂(p, q), inverted: [xx, xy, yx, yy]."""
        step = DIFFERENCE * extent
        one, two = (arrive(p + a, q + b, height).position - arrive(p - a, q - b, height).position
                    for a, b in ((step, 0.0), (0.0, step)))  # fmt: skip
        xx, yx, xy, yy = (d / (2 * step) for d in (one[0], one[1], two[0], two[1]))
        det = xx * yy - xy * yx
        det = torch.where(det.abs() > 1e-6, det, torch.ones_like(det))
        return [yy / det, -xy / det, -yx / det, xx / det]

    p, q, inverse, last = x, y, None, None
    n = x.shape[0]
    if n > 2 * COARSE and not arrive(x[:1, :1], y[:1, :1], z[:1, :1]).axial:  # along the axis x and y are the answer
        some = torch.linspace(0, n - 1, COARSE).round().long()
        c_p, c_q, _ = rays_to(source, lens, x[some][:, some], y[some][:, some], number)
        inverse = [_between(some, n, t) for t in jacobian(c_p, c_q, z[some][:, some])]
        p, q = (_between(some, n, t) for t in (c_p, c_q))
    for _ in range(REVERSE_STEPS):
        hit = arrive(p, q, z)
        off_x, off_y = x - hit.position[0], y - hit.position[1]
        wrong = torch.where(hit.alive, torch.maximum(off_x.abs(), off_y.abs()), torch.zeros_like(x))
        if not bool(wrong.any()):
            break  # along the axis, say, where the start is the answer
        if last is not None:
            step, (was_x, was_y) = last
            inverse = _improved(inverse, step, (was_x - off_x, was_y - off_y))
        xx, xy, yx, yy = inverse = inverse or jacobian(p, q, z)
        step = xx * off_x + xy * off_y, yx * off_x + yy * off_y
        p, q, last = p + step[0], q + step[1], (step, (off_x, off_y))
        if float(wrong.max()) <= ARRIVED * extent:
            break
    position = torch.stack([x, y, z])
    status = hit.lose(wrong > 1e3 * ARRIVED * extent, Status.VIGNETTED)
    return p, q, replace(hit, position=position, z=face.z, status=status)


def _improved(inverse: list[Tensor], step: tuple[Tensor, Tensor], moved: tuple[Tensor, Tensor]) -> list[Tensor]:
    """Broyden's update of each inverse Jacobian B, so that B moved = step for what the last step moved the hit."""
    xx, xy, yx, yy = inverse
    (s_x, s_y), (m_x, m_y) = step, moved
    off_x, off_y = s_x - (xx * m_x + xy * m_y), s_y - (yx * m_x + yy * m_y)
    row_x, row_y = s_x * xx + s_y * yx, s_x * xy + s_y * yy  # stepᵀ B
    scale = row_x * m_x + row_y * m_y
    small = scale.abs() <= SINGULAR * (s_x * s_x + s_y * s_y)
    scale = torch.where(small, torch.full_like(scale, torch.inf), scale)
    off_x, off_y = off_x / scale, off_y / scale
    return [xx + off_x * row_x, xy + off_x * row_y, yx + off_y * row_x, yy + off_y * row_y]


def _between(some: Tensor, n: int, t: Tensor) -> Tensor:
    """(n, n) linear interpolation along both axes of t (k, k), given in the rows and columns `some` of n."""
    rows = torch.arange(n)
    right = torch.searchsorted(some, rows, right=True).clamp(1, len(some) - 1)
    share = ((rows - some[right - 1]).double() / (some[right] - some[right - 1])).to(t)
    right = right.to(t.device)
    for _ in range(2):  # each turn takes one axis and swaps the two
        t = (torch.lerp(t[right - 1], t[right], share[:, None])).T
    return t.contiguous()
