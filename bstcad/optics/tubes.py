"""Ray tubes: a sheet of rays whose quads carry the light between them, cut exactly at the pixel borders.

The corners of a grid of tubes are traced to the screen.  A tube of flux F lands on two triangles with F / 2
each, spread evenly over their areas, and each pixel takes the part that falls into it.  The picture has no noise: its
error is that of the linear interpolation between the corners and falls as the square of their distance.  It is
differentiable in the landing points, whereas the counting of rays in a pixel is not.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics import ops
from bstcad.optics.emitters import Emitter
from bstcad.optics.interfaces import cross
from bstcad.optics.irradiance import Screen
from bstcad.optics.kernels.reductions import total
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import Landed, Rays, Status, joined
from bstcad.optics.receivers import LevelPlane, Receiver
from bstcad.optics.sides import Sides, as_pair, spread
from bstcad.optics.trace import behind, from_first_net, gets_through, whole_kernel

ALL = slice(None)
SHEET = 256  # tubes a side of the sheet through which finer ones are interpolated
INWARDS = 1e-9  # relative shrink towards the middle: corners on the rim of the light are counted as lit
BAND = 256  # rows of tubes at most traced at a time for a picture alone; even, since the diagonals alternate
IN_BAND = 1 << 19  # tubes at most in these rows: of more columns fewer rows, so that memory does not grow
CACHED = 1 << 17  # rays that plain torch takes at a time: a megabyte of each quantity
PARTS = 4  # parts of a tube on the rim of the light, each way
THINNEST = 1e-9  # pixel²: a triangle of less area gives all its flux to the pixel of its centre, without gradient
COARSE = 65  # points a side of the grid on which the rays to given points are found first
REVERSE_STEPS = 30  # at most, to find those rays
ARRIVED = 1e-8  # distance from its point at which a ray is found, as a part of the grid's extent
DIFFERENCE = 1e-6  # step of the difference quotients, as a part of the grid's extent
SINGULAR = 0.1  # Broyden's update is skipped where its divisor is less than this times the square of the step


@dataclass(frozen=True)
class Tubes:
    """The light on its way to the first freeform interface, as tubes between neighbouring rays."""

    coming: Rays  # (3, rows + 1, columns + 1) the corners; their flux is the share that faces and glass leave
    flux: Tensor  # (rows, columns) launched in each tube, as a fraction of the source's

    def landing(self, lens: Lens, plane: Receiver) -> Landed:
        """Where the corners meet the receiver; the outline counts in the flux, so that no corner is lost to it."""
        return from_first_net(self.coming, lens.unbounded(), plane)

    def collect(self, corners: Landed, screen: Screen) -> tuple[Tensor, Tensor]:
        """(picture, outside): flux that falls into each pixel, row 0 = y max; and Σ flux · (pixels beyond the border)².

        Tubes with a lost corner carry nothing.
        """
        return collect(screen.pixels_of(corners.position.double()), self.whole(corners), screen.shape)

    def carried(self, corners: Landed) -> Tensor:
        """(rows, columns) flux that faces and glass leave each tube, whether it arrives or not."""
        return self.flux * middle(corners.flux) if corners.taken else self.flux

    def whole(self, corners: Landed) -> Tensor:
        """(rows, columns) flux that arrives: of tubes whose corners all arrive, zero of the others."""
        return arriving(self.carried(corners), corners)

    def picture(self, lens: Lens, screen: Screen) -> Tensor:
        """(rows, columns) flux that falls into each pixel, row 0 = y max."""
        return self.collect(self.landing(lens, screen.plane), screen)[0]


@torch.no_grad()
def launch_tubes(source: Emitter, lens: Lens, n: int) -> Tubes:
    """n x n tubes that hold all the light which gets through both faces of the lens.

    Across a net of another number of control points along x than along y there are about as many, in the proportion of
    its spans under the light.
    The sheet is spread over the beam's cross-section if all of that gets through, else over the back face: its rim is
    the rim of the light.  A tube in which only part of the light gets through carries that part, spread over all of it.
    """
    sheet = _sheet(source, lens, n)
    flux: list[Tensor] = []

    def coming() -> Iterator[Rays]:
        for rows in _bands(sheet.count, _few_rows(n)):
            band = _tubes(source, lens, *sheet.rows(rows), sheet.cut)
            flux.append(band.flux)
            yield band.coming

    whole = joined(coming(), sheet.count + 1, shared=1)
    if not whole.taken:  # all of them still have the share 1: told once
        whole = replace(whole, flux=whole.flux[:1, :1].clone().expand(whole.flux.shape))
    return Tubes(whole, torch.cat(flux))


@torch.no_grad()
def picture(
    source: Emitter, lens: Lens, screen: Screen, n: int, few: int = SHEET, over_the_back: bool = False
) -> Tensor:
    """(rows, columns) flux in each pixel by n x n tubes (`launch_tubes`), band by band: memory does not grow with n².

    few: tubes a side of the sheet through which finer ones are interpolated, where the lens cuts the beam.
    over_the_back: spread them there even where the lens cuts nothing, so that pictures of lenses that differ little err
    alike, whether they cut the beam or just do not.
    """
    sheet = _sheet(source, lens, n, few=few, over_the_back=over_the_back)
    whole = torch.zeros(screen.shape, dtype=torch.float64, device=lens.like.device)
    for rows in _bands(sheet.count, min(BAND, 2 * max(1, IN_BAND // (2 * n)))):
        x, y = (p + INWARDS * (middle - p) for p, middle in zip(sheet.rows(rows), sheet.middle, strict=True))
        whole = whole + _tubes(source, lens, x=x, y=y, cut=sheet.cut).picture(lens, screen)
    return whole.clamp(min=0)  # a black pixel may be off by rounding


@dataclass(frozen=True)
class _Sheet:
    """Where the corners of tubes cross the vertex plane of the first surface."""

    rows: Callable[[slice], tuple[Tensor, Tensor]]  # (x, y) of some rows of them (mm)
    count: int  # rows of tubes, along x
    middle: tuple[float, float]  # middle of all (mm)
    cut: bool  # does the lens cut the beam?


def _bands(count: int, size: int) -> Iterator[slice]:
    """The rows of corners of `size` rows of tubes at a time, of so many in all."""
    for first in range(0, count, size):
        yield slice(first, min(first + size, count) + 1)


def _few_rows(columns: int) -> int:
    """Rows of a sheet that plain torch takes at a time."""
    return max(1, CACHED // columns)


def _tubes(source: Emitter, lens: Lens, x: Tensor, y: Tensor, cut: bool) -> Tubes:
    z, like = lens.entrance.z, lens.like
    area = area_of(x, y).to(like.device)
    x, y = x.to(like), y.to(like)
    light, lit = source.rays(x, y, z, 1.0), None
    light = replace(light, flux=torch.ones_like(light.flux))
    inside, ways = source.irradiance(x, y, z) > 0, [light]  # ways: before each interface
    interfaces = lens.unbounded().interfaces
    edges = lens.with_apertures_scaled(1 + INWARDS).interfaces  # margin for rounding
    first, back = lens.freeform[0], lens.number_of("back")
    end = lens.solid.stop if lens.solid.stop > back + 1 else back  # light may meet the front again behind the back
    for k in range(max(first, end)):
        ways.append(cross(ways[k], interfaces[k]).rays)
        if k < end and k != back:  # the sheet ends at the back's rim by itself
            inside = inside & edges[k].outline.contains(*ways[-1].position[:2])
    if cut:
        lit = inside & ways[end].alive
    return Tubes(ways[first], _density(source, lens, x=x, y=y, lit=lit) * area)


def _density(source: Emitter, lens: Lens, x: Tensor, y: Tensor, lit: Tensor | None) -> Tensor:
    """Flux a mm² of the vertex plane that each tube carries; `lit`: which corners are, None: all of them."""
    density = source.irradiance(middle(x), middle(y), lens.entrance.z)
    if lit is not None:
        count = middle(lit.to(density))
        density = torch.where(count == 1, density, torch.zeros_like(density))
        rim = (count > 0) & (count < 1)
        if bool(rim.any()):
            density[rim] = _partly_lit(source, lens, *(_quads(p, rim) for p in (x, y))).to(density)
    return density.double()


def _sheet(source: Emitter, lens: Lens, n: int, few: int = SHEET, over_the_back: bool = False) -> _Sheet:
    """The sheet over the beam if all of that gets through and none is asked for over the back."""
    return (None if over_the_back else _over_the_beam(source, lens, n)) or _over_the_back(source, lens, n, few)


def _over_the_beam(source: Emitter, lens: Lens, n: int) -> _Sheet | None:
    """A sheet over all of the beam; None if the lens cuts it."""
    z = lens.entrance.z
    spot, centre = source.spot(z)
    if spot is None:
        return None
    count = _proportioned(lens, spot, n)
    n_x, n_y = as_pair(count)
    ends = (slice(0, 1), ALL), (slice(n_x, None), ALL), (ALL, slice(0, 1)), (ALL, slice(n_y, None))
    sides = zip(*(corners(spot, count, *end) for end in ends), strict=True)
    rim = (
        at + (1 - INWARDS) * torch.cat([p.reshape(-1) for p in side]) for side, at in zip(sides, centre, strict=True)
    )
    rim_x, rim_y = (p.to(lens.like) for p in rim)
    if not bool(gets_through(source.rays(rim_x, rim_y, z, 1.0), lens).all()):
        return None

    def rows(band: slice) -> tuple[Tensor, Tensor]:
        x, y = corners(spot, count, band)
        return x + centre[0], y + centre[1]

    return _Sheet(rows, n_x, centre, cut=False)


def _over_the_back(source: Emitter, lens: Lens, n: int, few: int) -> _Sheet:
    """A sheet whose rim meets the rim of the back face; on a fine grid by splines through a coarse one.

    Only the rim has to lie well: a tube may lie anywhere as long as its flux is that of its own quad.
    """
    from scipy.interpolate import RectBivariateSpline  # with much else, which a plan has no use for

    n_x, n_y = as_pair(_proportioned(lens, lens.apertures[1], n))
    few_x, few_y = min(n_x, few), min(n_y, few)
    x, y, _ = rays_to(source, lens, *corners(lens.apertures[1], (few_x, few_y)))
    middle = tuple(float(total(p) / p.numel()) for p in (x, y))
    if (few_x, few_y) == (n_x, n_y):
        return _Sheet(lambda band: (x[band], y[band]), n_x, middle, cut=True)
    places = [np.linspace(0, 1, k + 1) for k in (few_x, few_y)]
    fine_x, fine_y = (np.linspace(0, 1, k + 1) for k in (n_x, n_y))
    through = [RectBivariateSpline(*places, p.cpu().numpy(), s=0) for p in (x, y)]
    return _Sheet(lambda band: tuple(torch.from_numpy(p(fine_x[band], fine_y)) for p in through), n_x, middle, cut=True)


def _proportioned(lens: Lens, light: Outline, n: int) -> Sides:
    """n a side; over an oblong net about n² in the proportion of the spans of it that an outline holds each way."""
    net = lens.nets[-1]
    if net.shape[0] == net.shape[1]:
        return n
    return spread(n, *(half / pitch for half, pitch in zip(light.half_extent, net.pitch, strict=True)))


def _quads(p: Tensor, where: Tensor) -> tuple[Tensor, ...]:
    """One coordinate of the corners of the tubes at `where`, each (n,), row by row."""
    row, column = where.nonzero(as_tuple=True)
    return p[row, column], p[row, column + 1], p[row + 1, column], p[row + 1, column + 1]


def _partly_lit(source: Emitter, lens: Lens, x: tuple[Tensor, ...], y: tuple[Tensor, ...]) -> Tensor:
    """Mean flux density (1/mm²) of the light that gets through, over PARTS x PARTS parts of each tube of `_quads`."""
    inner = torch.tensor([(k + 0.5) / PARTS for k in range(PARTS)], dtype=x[0].dtype, device=x[0].device)
    a, b = (t.reshape(-1, 1) for t in torch.meshgrid(inner, inner, indexing="ij"))
    p, q = (((1 - a) * ((1 - b) * c[0] + b * c[1]) + a * ((1 - b) * c[2] + b * c[3])).reshape(-1) for c in (x, y))
    return _getting_through(source, lens, p, q).view(PARTS**2, -1).mean(0)


def _getting_through(source: Emitter, lens: Lens, x: Tensor, y: Tensor) -> Tensor:
    """Flux density (n,) (1/mm²) at points of the first vertex's plane (n,), zero where the lens cuts the light."""
    behind = LevelPlane(lens.back.z + 1.0)  # a plane behind the lens, whichever
    if lens.losses is None and (fast := whole_kernel("trace.land", source, lens, behind)):
        landed = fast(source, lens, behind, x=x.double(), y=y.double())
        return landed.flux * ((landed.status != int(Status.MISSED_FRONT)) & (landed.status != int(Status.VIGNETTED)))
    return source.irradiance(x, y, lens.entrance.z) * gets_through(source.rays(x, y, lens.entrance.z, 1.0), lens)


def corners(shape: Outline, sides: Sides, rows: slice = ALL, columns: slice = ALL) -> tuple[Tensor, Tensor]:
    """The corners of so many tubes, which cover a shape to its rim; x along the first axis (mm)."""
    along_x, along_y = (torch.linspace(-1, 1, n + 1, dtype=torch.float64) for n in as_pair(sides))
    return shape.map_square(*torch.meshgrid(along_x[rows], along_y[columns], indexing="ij"))


def arriving(flux: Tensor, corners: Landed) -> Tensor:
    """The flux of each tube whose corners all arrive, zero for the others."""
    alive = corners.alive
    if bool(alive.all()):
        return flux
    whole = alive[1:, 1:] & alive[1:, :-1] & alive[:-1, 1:] & alive[:-1, :-1]
    return torch.where(whole, flux, torch.zeros_like(flux))


def area_of(x: Tensor, y: Tensor) -> Tensor:
    """Area of each quad: half the cross product of its diagonals."""
    return ((x[1:, 1:] - x[:-1, :-1]) * (y[:-1, 1:] - y[1:, :-1])
            - (x[:-1, 1:] - x[1:, :-1]) * (y[1:, 1:] - y[:-1, :-1])).abs() / 2  # fmt: skip


@torch.no_grad()
def rays_to(
    source: Emitter, lens: Lens, x: Tensor, y: Tensor, number: int | None = None
) -> tuple[Tensor, Tensor, Rays]:
    """The rays that meet an interface of the lens at the points (x, y) (rows, columns) mm.

    Returns where they cross the vertex plane of the first surface (mm), and the rays at the interface, before they
    cross it.  number: of the interface; None: the back.  The points are neighbours on a grid.

    By Broyden's method from a Jacobian of difference quotients; on a fine grid with start and Jacobian from a coarse
    one.
    """
    x, y = (p.to(lens.like.device) for p in (x, y))
    number = lens.number_of("back") if number is None else number
    face = lens.interfaces[number].surface
    z = face.relative_sag_and_slope(x.to(lens.like), y.to(lens.like))[0].double()
    extent = float(torch.maximum(x.max() - x.min(), y.max() - y.min()))
    way = replace(lens.to(x.dtype).unbounded(), losses=None)  # alone; in float32 a net would lie beside x and y
    before = way.interfaces[:number]

    def arrive(p: Tensor, q: Tensor, height: Tensor) -> Rays:
        bands = range(0, len(p), rows := _few_rows(p.shape[1]))
        return joined((arrive_few(*(t[first : first + rows] for t in (p, q, height))) for first in bands), len(p))

    def arrive_few(p: Tensor, q: Tensor, height: Tensor) -> Rays:
        coming = functools.reduce(behind, before, source.rays(p, q, lens.entrance.z, 1.0))
        ahead = (coming.sense * coming.direction[2]).clamp(min=1e-3)
        path = coming.sense * (height - coming.above(face.z)) / ahead
        return replace(coming, position=coming.position + path * coming.direction)

    def jacobian(p: Tensor, q: Tensor, height: Tensor) -> list[Tensor]:
        """∂(hit) / ∂(p, q), inverted: [xx, xy, yx, yy]."""
        step = DIFFERENCE * extent
        beside = [torch.cat(turns) for turns in ((p + step, p - step, p, p), (q, q, q + step, q - step))]
        right, left, above, below = arrive(*beside, height.repeat(4, 1)).position.chunk(4, dim=1)
        one, two = right - left, above - below
        xx, yx, xy, yy = (d / (2 * step) for d in (one[0], one[1], two[0], two[1]))
        det = xx * yy - xy * yx
        det = torch.where(det.abs() > 1e-6, det, torch.ones_like(det))
        return [yy / det, -xy / det, -yx / det, xx / det]

    p, q, inverse, last = x, y, None, None
    # along the axis x and y are the answer
    if max(x.shape) > 2 * COARSE and not arrive(x[:1, :1], y[:1, :1], z[:1, :1]).axial:
        some = tuple(torch.linspace(0, n - 1, min(n, COARSE)).round().long() for n in x.shape)
        few = torch.meshgrid(*some, indexing="ij")
        c_p, c_q, _ = rays_to(source, lens, x=x[few], y=y[few], number=number)
        inverse = [_between(some, x.shape, t) for t in jacobian(c_p, c_q, z[few])]
        p, q = (_between(some, x.shape, t) for t in (c_p, c_q))
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
    """Broyden's update of each inverse Jacobian B, so that B moved = step, moved: the last step of the hit."""
    xx, xy, yx, yy = inverse
    (s_x, s_y), (m_x, m_y) = step, moved
    off_x, off_y = s_x - (xx * m_x + xy * m_y), s_y - (yx * m_x + yy * m_y)
    row_x, row_y = s_x * xx + s_y * yx, s_x * xy + s_y * yy  # stepᵀ B
    scale = row_x * m_x + row_y * m_y
    small = scale.abs() <= SINGULAR * (s_x * s_x + s_y * s_y)
    scale = torch.where(small, torch.full_like(scale, torch.inf), scale)
    off_x, off_y = off_x / scale, off_y / scale
    return [xx + off_x * row_x, xy + off_x * row_y, yx + off_y * row_x, yy + off_y * row_y]


def _between(some: tuple[Tensor, Tensor], shape: tuple[int, ...], t: Tensor) -> Tensor:
    """(rows, columns) linear interpolation along both axes of t, given in `some` rows and columns."""
    for known, n in zip(some, shape, strict=True):  # each turn takes one axis and swaps the two
        wanted = torch.arange(n)
        right = torch.searchsorted(known, wanted, right=True).clamp(1, len(known) - 1)
        share = ((wanted - known[right - 1]).double() / (known[right] - known[right - 1])).to(t)
        right = right.to(t.device)
        t = (torch.lerp(t[right - 1], t[right], share[:, None])).T
    return t.contiguous()


def collect(corner: Tensor, flux: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """(picture (rows, columns), outside) of tubes; corner (2, n + 1, m + 1) in pixels: column, row; flux (n, m).

    outside is Σ flux · (mean square of the corners' distance beyond the border, in pixels): a pull for light that no
    pixel sees.
    """
    if corner.dtype == torch.float64 and (fast := ops.kernel("tubes.collect", corner)):
        return fast(corner, flux, shape, THINNEST)
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
