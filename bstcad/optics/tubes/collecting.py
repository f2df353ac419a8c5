"""The picture that ray tubes make: each is cut at the pixel borders, and each pixel takes what falls into it."""

from __future__ import annotations

import torch
from torch import Tensor

from bstcad.optics.kernels import clip
from bstcad.optics.kernels.choice import fused
from bstcad.optics.kernels.reductions import total

THINNEST = 1e-9  # pixel²: a triangle of less area gives all its flux to the pixel of its centre, without gradient


def collect(corner: Tensor, flux: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """(picture (rows, columns), outside) of tubes; corner (2, n + 1, m + 1) in pixels: column, row; flux (n, m).

    outside is Σ flux · (mean square of the corners' distance beyond the border, in pixels): a pull for light that no
    pixel sees.
    """
    if corner.dtype == torch.float64 and fused(corner):
        return clip.Clip.apply(corner, flux, shape, THINNEST)
    return collect_plain(corner, flux, shape)


def collect_plain(corner: Tensor, flux: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """`collect` in plain torch, by Green's theorem (see clip.py): the edges are split at all pixel borders.

    On a GPU `index_add` adds up in no fixed order, so that the last bits change from run to run.
    """
    off = sum((p - p.clamp(0, size)) ** 2 for p, size in zip(corner, reversed(shape), strict=True))
    outside = total(flux * middle(off))
    rows, columns = shape
    first, second, third = _triangles(corner)
    flux = torch.cat([flux.reshape(-1) / 2] * 2)
    area = ((second - first)[0] * (third - first)[1] - (third - first)[0] * (second - first)[1]) / 2
    cell = torch.stack([p.detach().floor() for p in (first, second, third)])
    whole = (cell == cell[0]).all(0).all(0) | (area.detach().abs() < THINNEST)
    sums = torch.zeros(rows * (columns + 1), dtype=corner.dtype, device=corner.device)

    column, row = ((first + second + third) / 3).detach().floor()
    at = whole & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    index = (row * (columns + 1) + column)[at].long()
    sums = sums.index_add(0, index, flux[at]).index_add(0, index + 1, -flux[at])

    weight = -(flux / torch.where(whole, torch.ones_like(area), area))[~whole]
    for start, end in ((first, second), (second, third), (third, first)):
        edge, s_0, s_1, column, row = _pieces(start[:, ~whole], end[:, ~whole], (columns, rows))
        a, d = start[:, ~whole][:, edge], (end - start)[:, ~whole][:, edge]
        middle_x = a[0] + (s_0 + s_1) / 2 * d[0]
        share = weight[edge] * (s_1 - s_0) * d[1]
        seen = (row >= 0) & (row < rows) & (column < columns)
        beyond = torch.where(column < 0, torch.zeros_like(middle_x), middle_x - column)[seen]
        index = (row * (columns + 1) + column.clamp(min=0))[seen].long()
        sums = sums.index_add(0, index, share[seen] * (1 - beyond)).index_add(0, index + 1, share[seen] * beyond)
    return sums.view(rows, columns + 1).cumsum(1)[:, :columns], outside


def _triangles(corner: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The three corners (2, 2 n m) of both triangles of each quad; the diagonal changes from quad to quad."""
    p0, p1, p2, p3 = corner[:, :-1, :-1], corner[:, 1:, :-1], corner[:, 1:, 1:], corner[:, :-1, 1:]
    i, j = (torch.arange(k, device=corner.device) for k in p0.shape[1:])
    even = ((i[:, None] + j) % 2 == 0).expand_as(p0)
    one = (p0, p1, torch.where(even, p2, p3))
    two = (torch.where(even, p0, p1), p2, p3)
    return tuple(torch.cat([a.reshape(2, -1), b.reshape(2, -1)], dim=1) for a, b in zip(one, two, strict=True))


def _pieces(start: Tensor, end: Tensor, sizes: tuple[int, int]) -> tuple[Tensor, ...]:
    """(edge, s at its start, s at its end, column, row) of each piece between pixel borders; s from 0 to 1 on the edge.

    What lies before the first or behind the last border of the screen (columns, rows) is not split any further.  The
    pixel follows from the borders crossed so far: where an edge meets the corner of a pixel a piece has no length, so
    that rounding decides where its middle lies, but the derivatives of its ends count for the pixel that it is in.
    """
    edges = torch.arange(start.shape[1], device=start.device)
    edge, s, kind = [edges], [torch.zeros_like(start[0])], [torch.full_like(edges, -1)]
    cells, senses = [], []
    for axis, (a, b, size) in enumerate(zip(start, end, sizes, strict=True)):
        first, last = (p.detach().floor().clamp(-1, size) for p in (a, b))
        low, count = torch.minimum(first, last), (last - first).abs().long()
        which = edges.repeat_interleave(count)
        nth = torch.arange(len(which), device=start.device) - (count.cumsum(0) - count)[which]
        edge.append(which)
        s.append(((low[which] + 1 + nth - a[which]) / (b - a)[which]).clamp(0, 1))
        kind.append(torch.full_like(which, axis))
        cells.append(first)
        senses.append(torch.sign(last - first))
    edge, s, kind = torch.cat(edge), torch.cat(s), torch.cat(kind)
    order = torch.argsort(s.detach(), stable=True)
    order = order[torch.argsort(edge[order], stable=True)]
    edge, s, kind = edge[order], s[order], kind[order]
    begins = (kind == -1).nonzero(as_tuple=True)[0]  # an edge's first piece: at s = 0, and before all others there
    pixel = []
    for axis in (0, 1):
        crossed = (kind == axis).cumsum(0)
        pixel.append(cells[axis][edge] + senses[axis][edge] * (crossed - crossed[begins][edge]))
    last = torch.cat([edge[1:] != edge[:-1], torch.ones(1, dtype=torch.bool, device=edge.device)])
    return edge, s, torch.where(last, torch.ones_like(s), torch.cat([s[1:], s[-1:]])), *pixel


def middle(corner: Tensor) -> Tensor:
    """Mean of the four corners of each quad."""
    return (corner[1:, 1:] + corner[1:, :-1] + corner[:-1, 1:] + corner[:-1, :-1]) / 4
