"""Ray tubes: a sheet of rays whose quads carry the light between them, cut exactly at the pixel borders.

The corners of a grid of (n, n) tubes are traced to the screen.  A tube of flux F lands on two triangles with F / 2
each, spread evenly over their areas, and each pixel takes what falls into it.  The picture has no noise: its error is
that of the linear interpolation between the corners and falls as the square of their distance.  It is differentiable
in the landing points, whereas the counting of rays in a pixel is not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.interpolate import RectBivariateSpline
from torch import Tensor

from bstcad.optics.irradiance import Screen
from bstcad.optics.kernels import clip, forward
from bstcad.optics.kernels.parts import elementary, total
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Outline, Rectangle
from bstcad.optics.rays import Landed, Rays, Status
from bstcad.optics.simulation import arrive_at_back
from bstcad.optics.sources import Collimated, Point, Source
from bstcad.optics.surfaces import Plane
from bstcad.optics.trace import into_glass, through_back

ALL = slice(None)
EVERYWHERE = Rectangle(math.inf, math.inf)  # an outline that loses no ray
COARSE = 129  # points a side of the grid on which the rays to given points of the back face are found first
SHEET = 256  # tubes a side of the sheet through which finer ones are interpolated
REVERSE_STEPS = 30  # at most, to find those rays
ARRIVED = 1e-8  # of the grid's extent: a ray that meets the back face so near to its point has been found
INWARDS = 1e-9  # of the way to the middle: corners on the rim of the light are counted as lit
ROOM = 1e-4  # of the outline
BAND = 256  # rows of tubes traced at a time for a picture alone; even, since the diagonals alternate
PARTS = 4  # of a tube on the rim of the light, each way
DIFFERENCE = 1e-6  # of the grid's extent: step of the difference quotients


@dataclass(frozen=True)
class Tubes:
    """The light just behind the front face, as tubes between neighbouring rays."""

    in_glass: Rays  # (3, n + 1, n + 1) the corners
    flux: Tensor  # (n, n) of each tube, as a fraction of the source's

    def landing(self, lens: Lens, z: float) -> Landed:
        """Where the corners meet the plane z (mm); the outline counts in the flux, so that no corner is lost to it."""
        return through_back(self.in_glass, replace(lens, outline=EVERYWHERE), z)

    def collect(self, corners: Landed, screen: Screen) -> tuple[Tensor, Tensor]:
        """(picture, outside): flux that falls into each pixel, row 0 = y max; and Σ flux · (pixels beyond the border)².

        Tubes with a lost corner carry nothing.
        """
        return collect(torch.stack(screen.pixel(*corners.position.double())), self.whole(corners), screen.shape)

    def whole(self, corners: Landed) -> Tensor:
        """(n, n) flux of the tubes whose corners all arrive, zero for the others."""
        return _whole(self.flux, corners)

    def picture(self, lens: Lens, screen: Screen) -> Tensor:
        """(rows, columns) flux that falls into each pixel, row 0 = y max."""
        return self.collect(self.landing(lens, screen.z), screen)[0]


# --- launching --------------------------------------------------------------------------------------------------------


@torch.no_grad()
def launch_tubes(source: Source, lens: Lens, n: int) -> Tubes:
    """n x n tubes that hold all the light which gets through both faces of the lens.

    The sheet is spread over the beam's cross-section if all of that gets through, else over the back face: its rim is
    the rim of the light.  A tube in which only part of the light gets through carries that part, spread over all of it.
    """
    sheet = _sheet(source, lens, n)
    return _tubes(source, lens, *sheet.rows(ALL), sheet.cut)


@torch.no_grad()
def picture(source: Source, lens: Lens, screen: Screen, n: int) -> Tensor:
    """(rows, columns) flux that falls into each pixel by n x n tubes, band by band: memory does not grow with n²."""
    sheet = _sheet(source, lens, n)
    whole = torch.zeros(screen.shape, dtype=torch.float64, device=lens.back.heights.device)
    for first in range(0, n, BAND):
        band = sheet.rows(slice(first, min(first + BAND, n) + 1))
        x, y = (p + INWARDS * (middle - p) for p, middle in zip(band, sheet.middle, strict=True))
        whole = whole + _picture(source, lens, screen, x, y, sheet.cut)
    return whole.clamp(min=0)  # a black pixel may be off by rounding


def _picture(source: Source, lens: Lens, screen: Screen, x: Tensor, y: Tensor, cut: bool) -> Tensor:
    """The picture of one band, by the fused forward trace where that serves."""
    if not forward.serves(source, lens):
        return _tubes(source, lens, x, y, cut).picture(lens, screen)

    def land(source: Source, outline: Outline) -> Landed:
        found = forward.land(source, replace(lens, outline=outline), screen.z, x.reshape(-1), y.reshape(-1))
        return Landed(found.position.view(2, *x.shape), found.flux.view(x.shape), found.status.view(x.shape))

    landed, lit = land(source, _grown(lens.outline, 1 + ROOM) if cut else EVERYWHERE), None
    if not bool((landed.alive & (landed.flux > 0)).all()):  # a ray without flux may end anyhow: here none is
        everywhere = _unbounded(source, x, y)
        landed = land(everywhere, EVERYWHERE)
        if cut:
            at_front = land(everywhere, _grown(lens.outline, 1 + INWARDS)).status != int(Status.MISSED_FRONT)
            lit = at_front & (source.irradiance(x, y, lens.front.z) > 0)
    flux = _density(source, lens, x, y, lit) * _area(x, y)
    return collect(torch.stack(screen.pixel(*landed.position)), _whole(flux, landed), screen.shape)[0]


def _grown(outline: Outline, by: float) -> Outline:
    """The outline with room for rounding, or for a rim of the sheet that was found by interpolation."""
    if isinstance(outline, Circle):
        return Circle(outline.radius * by)
    return Rectangle(outline.width * by, outline.height * by)


def _unbounded(source: Source, x: Tensor, y: Tensor) -> Source:
    """A source with the same rays through the points (x, y), in all of which it has light."""
    if isinstance(source, Collimated):
        return Collimated(Rectangle(*(4 * float(p.abs().max()) for p in (x, y))), z=source.z)
    return Point(source.position)


@dataclass(frozen=True)
class _Sheet:
    """Where the corners of (n, n) tubes cross the front's vertex plane."""

    rows: Callable[[slice], tuple[Tensor, Tensor]]  # (x, y) of some rows of them (mm)
    middle: tuple[float, float]  # of all (mm)
    cut: bool  # does the lens cut the beam?


def _sheet(source: Source, lens: Lens, n: int) -> _Sheet:
    return _over_the_beam(source, lens, n) or _over_the_back(source, lens, n)


def _tubes(source: Source, lens: Lens, x: Tensor, y: Tensor, cut: bool) -> Tubes:
    z, like = lens.front.z, lens.back.heights
    area = _area(x, y).to(like.device)
    x, y = x.to(like), y.to(like)
    entered = into_glass(source.rays(x, y, z, 1.0), replace(lens, outline=EVERYWHERE))
    lit = None
    if cut:
        inside = _grown(lens.outline, 1 + INWARDS).contains(*entered.position[:2])
        lit = inside & entered.alive & (source.irradiance(x, y, z) > 0)
    return Tubes(entered, _density(source, lens, x, y, lit) * area)


def _density(source: Source, lens: Lens, x: Tensor, y: Tensor, lit: Tensor | None) -> Tensor:
    """Flux a mm² of the vertex plane that each tube carries; `lit`: which corners are, None: all of them."""
    density = source.irradiance(_middle(x), _middle(y), lens.front.z)
    if lit is not None:
        count = _middle(lit.to(density))
        density = torch.where(count == 1, density, torch.zeros_like(density))
        rim = (count > 0) & (count < 1)
        if bool(rim.any()):
            density[rim] = _partly_lit(source, lens, *(_quads(p, rim) for p in (x, y)))
    return density.double()


def _over_the_beam(source: Source, lens: Lens, n: int) -> _Sheet | None:
    """A sheet over all of the beam; None if the lens cuts it."""
    z = lens.front.z
    if isinstance(source, Collimated):
        spot, centre = source.aperture, (0.0, 0.0)
    elif source.profile == "uniform" and source.half_angle < 89:
        spot = Circle((z - source.position[2]) * math.tan(math.radians(source.half_angle)))
        centre = source.position[:2]
    else:
        return None
    ends = (slice(0, 1), ALL), (slice(n, None), ALL), (ALL, slice(0, 1)), (ALL, slice(n, None))
    sides = zip(*(corners(spot, n, *end) for end in ends), strict=True)
    rim = (
        at + (1 - INWARDS) * torch.cat([p.reshape(-1) for p in side]) for side, at in zip(sides, centre, strict=True)
    )
    rim_x, rim_y = (p.to(lens.back.heights) for p in rim)
    if not bool(arrive_at_back(source.rays(rim_x, rim_y, z, 1.0), lens).all()):
        return None

    def rows(band: slice) -> tuple[Tensor, Tensor]:
        x, y = corners(spot, n, band)
        return x + centre[0], y + centre[1]

    return _Sheet(rows, centre, cut=False)


def _over_the_back(source: Source, lens: Lens, n: int) -> _Sheet:
    """A sheet whose rim meets the rim of the back face; on a fine grid by splines through a coarse one.

    Only the rim has to lie well: a tube may lie anywhere as long as its flux is that of its own quad.
    """
    few = min(n, SHEET)
    x, y, _ = rays_to(source, lens, *corners(lens.outline, few))
    middle = tuple(float(total(p) / p.numel()) for p in (x, y))
    if few == n:
        return _Sheet(lambda band: (x[band], y[band]), middle, cut=True)
    coarse, fine = np.linspace(0, 1, few + 1), np.linspace(0, 1, n + 1)
    through = [RectBivariateSpline(coarse, coarse, p.cpu().numpy(), s=0) for p in (x, y)]
    return _Sheet(lambda band: tuple(torch.from_numpy(p(fine[band], fine)) for p in through), middle, cut=True)


def _quads(p: Tensor, where: Tensor) -> tuple[Tensor, ...]:
    """One coordinate of the corners of the tubes at `where`, each (n,), row by row."""
    return p[:-1, :-1][where], p[:-1, 1:][where], p[1:, :-1][where], p[1:, 1:][where]


def _partly_lit(source: Source, lens: Lens, x: tuple[Tensor, ...], y: tuple[Tensor, ...]) -> Tensor:
    """Mean flux density (1/mm²) of the light that gets through, over PARTS x PARTS parts of each tube of `_quads`."""
    density = torch.zeros_like(x[0])
    inner = [(k + 0.5) / PARTS for k in range(PARTS)]
    for a in inner:
        for b in inner:
            p, q = ((1 - a) * ((1 - b) * c[0] + b * c[1]) + a * ((1 - b) * c[2] + b * c[3]) for c in (x, y))
            through = arrive_at_back(source.rays(p, q, lens.front.z, 1.0), lens)
            density += source.irradiance(p, q, lens.front.z) * through / PARTS**2
    return density


def corners(shape: Outline, n: int, rows: slice = ALL, columns: slice = ALL) -> tuple[Tensor, Tensor]:
    """(n + 1)² points that cover a shape to its rim, neighbours beside each other; x along the first axis (mm).

    A disc by the concentric map, which keeps areas (Shirley and Chiu 1997).
    """
    unit = torch.linspace(-1, 1, n + 1, dtype=torch.float64)
    a, b = torch.meshgrid(unit[rows], unit[columns], indexing="ij")
    if isinstance(shape, Rectangle):
        return a * (shape.width / 2), b * (shape.height / 2)
    steep = b.abs() > a.abs()
    long, short = torch.where(steep, b, a), torch.where(steep, a, b)
    turn = (math.pi / 4) * short / torch.where(long == 0, torch.ones_like(long), long)
    along, across = (shape.radius * long * elementary(f, turn) for f in (torch.cos, torch.sin))
    return torch.where(steep, across, along), torch.where(steep, along, across)


def _whole(flux: Tensor, corners: Landed) -> Tensor:
    """The flux of each tube whose corners all arrive, zero for the others."""
    alive = corners.alive
    whole = alive[1:, 1:] & alive[1:, :-1] & alive[:-1, 1:] & alive[:-1, :-1]
    return torch.where(whole, flux, torch.zeros_like(flux))


def _middle(corner: Tensor) -> Tensor:
    """Mean of the four corners of each quad."""
    return (corner[1:, 1:] + corner[1:, :-1] + corner[:-1, 1:] + corner[:-1, :-1]) / 4


def _area(x: Tensor, y: Tensor) -> Tensor:
    """Area of each quad: half the cross product of its diagonals."""
    return ((x[1:, 1:] - x[:-1, :-1]) * (y[:-1, 1:] - y[1:, :-1])
            - (x[:-1, 1:] - x[1:, :-1]) * (y[1:, 1:] - y[:-1, :-1])).abs() / 2  # fmt: skip


# --- the rays to given points of the back face ------------------------------------------------------------------------


@torch.no_grad()
def rays_to(source: Source, lens: Lens, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Rays]:
    """The rays that meet the back face at the points (x, y) (n, n) mm: where they cross the front's vertex plane (mm),
    and they themselves at the back face.

    The points are neighbours on a grid.  By Newton's method; on a fine grid with start and Jacobian from a coarse one.
    """
    x, y = (p.to(lens.back.heights.device) for p in (x, y))
    z = lens.back.relative_sag_and_slope(x.to(lens.back.heights), y.to(lens.back.heights))[0].double()
    extent = float(torch.maximum(x.max() - x.min(), y.max() - y.min()))
    free = replace(lens, outline=EVERYWHERE)

    def arrive(p: Tensor, q: Tensor, height: Tensor) -> Rays:
        entered = into_glass(source.rays(p, q, lens.front.z, 1.0), free)
        path = (height - entered.above(lens.back.z)) / entered.direction[2].clamp(min=1e-3)
        return replace(entered, position=entered.position + path * entered.direction)

    def jacobian(p: Tensor, q: Tensor, height: Tensor) -> list[Tensor]:
        """∂(hit) / ∂(p, q), inverted: [xx, xy, yx, yy]."""
        step = DIFFERENCE * extent
        one, two = (arrive(p + a, q + b, height).position - arrive(p - a, q - b, height).position
                    for a, b in ((step, 0.0), (0.0, step)))  # fmt: skip
        xx, yx, xy, yy = (d / (2 * step) for d in (one[0], one[1], two[0], two[1]))
        det = xx * yy - xy * yx
        det = torch.where(det.abs() > 1e-6, det, torch.ones_like(det))
        return [yy / det, -xy / det, -yx / det, xx / det]

    p, q, inverse = x, y, None
    n = x.shape[0]
    if n > 2 * COARSE and not (isinstance(lens.front, Plane) and isinstance(source, Collimated)):
        some = torch.linspace(0, n - 1, COARSE).round().long()
        c_p, c_q, _ = rays_to(source, lens, x[some][:, some], y[some][:, some])
        inverse = [_between(some, n, t) for t in jacobian(c_p, c_q, z[some][:, some])]
        p, q = (_between(some, n, t) for t in (c_p, c_q))
    for _ in range(REVERSE_STEPS):
        hit = arrive(p, q, z)
        off_x, off_y = x - hit.position[0], y - hit.position[1]
        wrong = torch.where(hit.alive, torch.maximum(off_x.abs(), off_y.abs()), torch.zeros_like(x))
        if float(wrong.max()) <= ARRIVED * extent:
            break
        xx, xy, yx, yy = inverse or jacobian(p, q, z)
        p, q = p + (xx * off_x + xy * off_y), q + (yx * off_x + yy * off_y)
    position = torch.stack([x, y, z])
    status = hit.lose(wrong > 1e3 * ARRIVED * extent, Status.VIGNETTED)
    return p, q, replace(hit, position=position, z=lens.back.z, status=status)


def _between(some: Tensor, n: int, t: Tensor) -> Tensor:
    """(n, n) linear interpolation along both axes of t (k, k), given in the rows and columns `some` of n."""
    rows = torch.arange(n)
    right = torch.searchsorted(some, rows, right=True).clamp(1, len(some) - 1)
    share = ((rows - some[right - 1]).double() / (some[right] - some[right - 1])).to(t)
    right = right.to(t.device)
    for _ in range(2):  # each turn takes one axis and swaps the two
        t = (torch.lerp(t[right - 1], t[right], share[:, None])).T
    return t.contiguous()


# --- the picture ------------------------------------------------------------------------------------------------------


def collect(corner: Tensor, flux: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """(picture (rows, columns), outside) of tubes; corner (2, n + 1, m + 1) in pixels: column, row; flux (n, m).

    outside is Σ flux · (mean square of the corners' distance beyond the border, in pixels): a pull for light that no
    pixel sees.
    """
    if clip.serves(corner):
        return clip.Clip.apply(corner, flux, shape)
    return collect_plain(corner, flux, shape)


def collect_plain(corner: Tensor, flux: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """`collect` in plain torch, by Green's theorem (see clip.py): the edges are split at all pixel borders."""
    off = sum((p - p.clamp(0, size)) ** 2 for p, size in zip(corner, reversed(shape), strict=True))
    outside = total(flux * _middle(off))
    rows, columns = shape
    first, second, third = _triangles(corner)
    flux = torch.cat([flux.reshape(-1) / 2] * 2)
    area = ((second - first)[0] * (third - first)[1] - (third - first)[0] * (second - first)[1]) / 2
    cell = torch.stack([p.detach().floor() for p in (first, second, third)])
    whole = (cell == cell[0]).all(0).all(0) | (area.detach().abs() < clip.THINNEST)
    sums = torch.zeros(rows * (columns + 1), dtype=corner.dtype, device=corner.device)

    column, row = ((first + second + third) / 3).detach().floor()
    at = whole & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    index = (row * (columns + 1) + column)[at].long()
    sums = sums.index_add(0, index, flux[at]).index_add(0, index + 1, -flux[at])

    weight = -(flux / torch.where(whole, torch.ones_like(area), area))[~whole]
    for start, end in ((first, second), (second, third), (third, first)):
        edge, s_0, s_1 = _pieces(start[:, ~whole], end[:, ~whole], (columns, rows))
        a, d = start[:, ~whole][:, edge], (end - start)[:, ~whole][:, edge]
        middle_x, middle_y = a + (s_0 + s_1) / 2 * d
        share = weight[edge] * (s_1 - s_0) * d[1]
        column, row = middle_x.detach().floor(), middle_y.detach().floor()
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


def _pieces(start: Tensor, end: Tensor, sizes: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """(edge, s at its start, s at its end) of each piece between pixel borders; s from 0 to 1 along the edge.

    What lies before the first or behind the last border of the screen (columns, rows) is not split any further.
    """
    edges = torch.arange(start.shape[1], device=start.device)
    edge, s = [edges], [torch.zeros_like(start[0])]
    for a, b, size in zip(start, end, sizes, strict=True):
        ends = torch.minimum(a, b).detach().floor(), torch.maximum(a, b).detach().floor()
        low, high = (f.clamp(-1, size) for f in ends)
        count = (high - low).long()
        which = edges.repeat_interleave(count)
        nth = torch.arange(len(which), device=start.device) - (count.cumsum(0) - count)[which]
        edge.append(which)
        s.append(((low[which] + 1 + nth - a[which]) / (b - a)[which]).clamp(0, 1))
    edge, s = torch.cat(edge), torch.cat(s)
    order = torch.argsort(s.detach(), stable=True)
    order = order[torch.argsort(edge[order], stable=True)]
    edge, s = edge[order], s[order]
    last = torch.cat([edge[1:] != edge[:-1], torch.ones(1, dtype=torch.bool, device=edge.device)])
    return edge, s, torch.where(last, torch.ones_like(s), torch.cat([s[1:], s[-1:]]))
