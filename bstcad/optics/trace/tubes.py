"""Flux tubes: a grid of rays whose quads carry the light and are clipped exactly at the pixel borders.

The corners of a grid of tubes are traced to the screen.  A tube of flux F lands on two triangles.  Each carries F / 2,
or the share of its area where both differ little (`triangle_fluxes`), spread uniformly over its area, and each pixel
receives the part inside it.  The picture has no noise: its error is that
of linear interpolation between the corners and falls nearly as the square of their distance.  The picture is
differentiable in the landing points, whereas the number of rays in a pixel is not.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.lens.interfaces import cross
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.light.path import MAX_BROYDEN_STEPS, MIN_BROYDEN_DIVISOR, Found, Path
from bstcad.optics.numerics import kernel_choice
from bstcad.optics.numerics.reductions import total
from bstcad.optics.receivers.irradiance import Scale, Screen, scaled
from bstcad.optics.receivers.receivers import LevelPlane, Receiver
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.rays import Landed, Rays, Status, joined, stacked
from bstcad.optics.surfaces.sides import Sides, as_pair, spread
from bstcad.optics.trace.trace import behind, from_first_net_to_each, is_transmitted, whole_kernel

ALL = slice(None)  # all rows or columns
SHEET_TUBES = 256  # tubes per side of the sheet from which finer sheets are interpolated
RIM_SHRINK = 1e-9  # relative shrinkage of a sheet towards its centre, so that corners on the rim of the light are lit
MAX_BAND_ROWS = 256  # maximum rows of tubes traced at a time for a picture; even, since the diagonals alternate
MAX_BAND_TUBES = 1 << 19  # maximum tubes traced at a time for a picture, which limits its memory
MAX_RAYS_PER_BAND = 1 << 17  # maximum rays traced at a time in plain torch, a megabyte per coordinate
PARTS_PER_SIDE = 4  # parts per side into which a partly lit tube is divided
MIN_TRIANGLE_AREA = 1e-9  # smallest area of a triangle that is clipped (pixel²); smaller triangles count in one pixel
# Difference of the areas of a tube's triangles, relative to their sum, up to which the tube has one density, so that
# the diagonal between them need not be followed; and difference from which on each triangle has half of the flux.
EVEN_TUBE, UNEVEN_TUBE = 0.03, 0.12
COARSE_GRID_POINTS = 33  # points per side of the coarse grid on which `rays_to` solves first

PIXELS: Scale = (0.0, 0.0, 1.0, 1.0)  # scale of corners in pixels


@dataclass(frozen=True)
class Tubes:
    """Flux tubes in front of the first freeform interface, each between four neighbouring rays."""

    rays: Rays  # rays at the corners (3, rows + 1, columns + 1); flux: transmitted fraction
    flux: Tensor  # flux launched in each tube (rows, columns), as a fraction of the source's

    def landing(self, lens: Lens, receiver: Receiver) -> Landed:
        """Trace the corners to the receiver without the solid's apertures; `flux` excludes light that these stop."""
        [landed] = self.landings(lens, [receiver])
        return landed

    def landings(self, lens: Lens, planes: Sequence[Receiver]) -> tuple[Landed, ...]:
        """Trace the corners as `landing` does, once, to each of several receivers."""
        return from_first_net_to_each(self.rays, lens.unbounded(), planes)

    def collect(self, corners: Landed, screen: Screen) -> tuple[Tensor, Tensor]:
        """Return (flux per pixel, row 0 = y max; `outside` (pixel²) as the function `collect` defines it)."""
        return collect(corners.position.double(), self.arriving_flux(corners), screen.shape, screen.scale)

    def transmitted_flux(self, corners: Landed) -> Tensor:
        """Return the flux of each tube (rows, columns) after losses at faces and in glass, even if corners are lost."""
        return self.flux * middle(corners.flux) if corners.taken else self.flux

    def arriving_flux(self, corners: Landed) -> Tensor:
        """Return the flux of each tube whose corners all arrive (rows, columns); zero for the others."""
        return arriving_flux(self.transmitted_flux(corners), corners)

    def picture(self, lens: Lens, screen: Screen) -> Tensor:
        """Return the flux in each pixel (rows, columns), row 0 = y max."""
        return self.collect(self.landing(lens, screen.receiver), screen)[0]


@torch.no_grad()
def launch_tubes(source: Emitter, lens: Lens, n: int) -> Tubes:
    """Launch n x n tubes that carry all the light which both faces of the lens transmit.

    If the net has different numbers of control points along x and y, about n² tubes are launched, in the proportion of
    its spans under the light.  The sheet of tubes covers the beam's cross-section if the lens transmits all of the
    beam, else the back face; its rim is the rim of the light.  A partly lit tube spreads its flux over its whole area.
    """
    sheet = _sheet(source, lens, n)
    flux: list[Tensor] = []

    def bands() -> Iterator[Rays]:
        for rows in _bands(sheet.count, _rows_at_a_time(n)):
            band = _tubes(source, lens, *sheet.rows(rows), sheet.cut)
            flux.append(band.flux)
            yield band.rays

    rays = joined(bands(), sheet.count + 1, shared=1)
    if not rays.taken:  # all fluxes are still 1: store one number
        rays = replace(rays, flux=rays.flux[:1, :1].clone().expand(rays.flux.shape))
    return Tubes(rays, torch.cat(flux))


@torch.no_grad()
def picture(
    source: Emitter, lens: Lens, screen: Screen, n: int, few: int = SHEET_TUBES, over_the_back: bool = False
) -> Tensor:
    """Return the flux in each pixel (rows, columns) by n x n tubes (`launch_tubes`), in bands to limit the memory.

    few: tubes per side of the sheet from which finer sheets over the back face are interpolated.
    over_the_back: spread the tubes over the back face even if the lens does not cut the beam.  Pictures of lenses
    that differ little then have similar errors, even if only some of them cut the beam.
    """
    sheet = _sheet(source, lens, n, few=few, over_the_back=over_the_back)
    flux = torch.zeros(screen.shape, dtype=torch.float64, device=lens.like.device)
    for rows in _bands(sheet.count, min(MAX_BAND_ROWS, 2 * max(1, MAX_BAND_TUBES // (2 * n)))):
        x, y = (p + RIM_SHRINK * (middle - p) for p, middle in zip(sheet.rows(rows), sheet.middle, strict=True))
        flux = flux + _tubes(source, lens, x=x, y=y, cut=sheet.cut).picture(lens, screen)
    return flux.clamp(min=0)  # rounding may make a black pixel negative


@dataclass(frozen=True)
class _Sheet:
    """Points at which the corners of tubes cross the vertex plane of the first surface."""

    rows: Callable[[slice], tuple[Tensor, Tensor]]  # (x, y) of the corners in a slice of rows (mm)
    count: int  # number of rows of tubes, along x
    middle: tuple[float, float]  # centre of all corners (mm)
    cut: bool  # True if the lens cuts the beam


def _bands(count: int, size: int) -> Iterator[slice]:
    """Yield the rows of corners of each band of `size` rows of tubes, as a slice; count: rows of tubes in total."""
    for first in range(0, count, size):
        yield slice(first, min(first + size, count) + 1)


def _rows_at_a_time(columns: int) -> int:
    return max(1, MAX_RAYS_PER_BAND // columns)


def _tubes(source: Emitter, lens: Lens, x: Tensor, y: Tensor, cut: bool) -> Tubes:
    z, like = lens.entrance.z, lens.like
    area = area_of(x, y).to(like.device)
    x, y = x.to(like), y.to(like)
    light, lit = source.rays_through(x, y, z, 1.0), None
    light = replace(light, flux=torch.ones_like(light.flux))
    rays = [light]  # in front of each interface
    interfaces = lens.unbounded().interfaces
    first, back = lens.tailored_numbers[0], lens.number_of(BACK)
    end = lens.solid.stop if lens.solid.stop > back + 1 else back  # faces behind the back: in a second-surface mirror
    for k in range(max(first, end)):
        rays.append(cross(rays[k], interfaces[k]).rays)
    if cut:
        lit = (source.irradiance(x, y, z) > 0) & rays[end].alive
        edges = lens.with_apertures_scaled(1 + RIM_SHRINK).interfaces  # margin for rounding
        for k in range(end):
            if k != back:  # the sheet itself ends at the back's rim
                lit = lit & edges[k].outline.contains(*rays[k + 1].position[:2])
    return Tubes(rays[first], _density(source, lens, x=x, y=y, lit=lit) * area)


def _density(source: Emitter, lens: Lens, x: Tensor, y: Tensor, lit: Tensor | None) -> Tensor:
    """Return each tube's flux per mm² of the vertex plane; lit: True at lit corners, or None if all are lit."""
    density = source.irradiance(middle(x), middle(y), lens.entrance.z)
    if lit is not None:
        count = middle(lit.to(density))
        density = torch.where(count == 1, density, torch.zeros_like(density))
        rim = (count > 0) & (count < 1)
        if bool(rim.any()):
            density[rim] = _mean_lit_density(source, lens, *(_quads(p, rim) for p in (x, y))).to(density)
    return density.double()


def _sheet(source: Emitter, lens: Lens, n: int, few: int = SHEET_TUBES, over_the_back: bool = False) -> _Sheet:
    """Return the sheet over the beam, or over the back face if the lens cuts the beam or `over_the_back` is True."""
    return (None if over_the_back else _over_the_beam(source, lens, n)) or _over_the_back(source, lens, n, few)


def _over_the_beam(source: Emitter, lens: Lens, n: int) -> _Sheet | None:
    """Return a sheet over the whole beam; None if the lens cuts the beam."""
    z = lens.entrance.z
    spot, centre = source.spot(z)
    if spot is None:
        return None
    count = _tubes_per_side(lens, spot, n)
    n_x, n_y = as_pair(count)
    ends = (slice(0, 1), ALL), (slice(n_x, None), ALL), (ALL, slice(0, 1)), (ALL, slice(n_y, None))
    sides = zip(*(corners(spot, count, *end) for end in ends), strict=True)
    rim = (
        at + (1 - RIM_SHRINK) * torch.cat([p.reshape(-1) for p in side]) for side, at in zip(sides, centre, strict=True)
    )
    rim_x, rim_y = (p.to(lens.like) for p in rim)
    if not bool(is_transmitted(source.rays_through(rim_x, rim_y, z, 1.0), lens).all()):
        return None

    def rows(band: slice) -> tuple[Tensor, Tensor]:
        x, y = corners(spot, count, band)
        return x + centre[0], y + centre[1]

    return _Sheet(rows, n_x, centre, cut=False)


def _over_the_back(source: Emitter, lens: Lens, n: int, few: int) -> _Sheet:
    """Return a sheet whose rim meets the rim of the back face; splines interpolate a fine sheet from a coarse one.

    Only the rim must be exact: a tube may lie anywhere as long as it carries the flux of its quad.
    """
    from scipy.interpolate import RectBivariateSpline  # slow to import, and not needed for a plan

    n_x, n_y = as_pair(_tubes_per_side(lens, lens.apertures[1], n))
    few_x, few_y = min(n_x, few), min(n_y, few)
    x, y, _ = rays_to(source, lens, *corners(lens.apertures[1], (few_x, few_y)))
    mean_x, mean_y = (float(total(p) / p.numel()) for p in (x, y))
    if (few_x, few_y) == (n_x, n_y):
        return _Sheet(lambda band: (x[band], y[band]), n_x, (mean_x, mean_y), cut=True)
    coarse = [np.linspace(0, 1, k + 1) for k in (few_x, few_y)]
    fine_x, fine_y = (np.linspace(0, 1, k + 1) for k in (n_x, n_y))
    splines = [RectBivariateSpline(*coarse, p.cpu().numpy(), s=0) for p in (x, y)]

    def rows(band: slice) -> tuple[Tensor, Tensor]:
        x, y = (torch.from_numpy(p(fine_x[band], fine_y)) for p in splines)
        return x, y

    return _Sheet(rows, n_x, (mean_x, mean_y), cut=True)


def _tubes_per_side(lens: Lens, light: Outline, n: int) -> Sides:
    """Return n tubes per side; for a net of unequal sides about n² in all, in proportion to its spans in `light`."""
    net = lens.last_tailored.net
    if net.shape[0] == net.shape[1]:
        return n
    return spread(n, *(half / pitch for half, pitch in zip(light.half_extent, net.pitch, strict=True)))


def _quads(p: Tensor, where: Tensor) -> tuple[Tensor, ...]:
    """Return p (x or y of all corners) at the four corners of each tube where `where` is True: (n,) each, by rows."""
    row, column = where.nonzero(as_tuple=True)
    return p[row, column], p[row, column + 1], p[row + 1, column], p[row + 1, column + 1]


def _mean_lit_density(source: Emitter, lens: Lens, x: tuple[Tensor, ...], y: tuple[Tensor, ...]) -> Tensor:
    """Return the mean flux density (1/mm²) of transmitted light over PARTS_PER_SIDE² parts of each tube of `_quads`."""
    inner = ((torch.arange(PARTS_PER_SIDE) + 0.5) / PARTS_PER_SIDE).to(x[0])
    a, b = (t.reshape(-1, 1) for t in torch.meshgrid(inner, inner, indexing="ij"))
    p, q = (((1 - a) * ((1 - b) * c[0] + b * c[1]) + a * ((1 - b) * c[2] + b * c[3])).reshape(-1) for c in (x, y))
    return _transmitted_density(source, lens, p, q).view(PARTS_PER_SIDE**2, -1).mean(0)


def _transmitted_density(source: Emitter, lens: Lens, x: Tensor, y: Tensor) -> Tensor:
    """Return the flux density (1/mm²) at points (n,) of the vertex plane, zero where light misses a face."""
    receiver = LevelPlane(lens.back.z + 1.0)  # any plane behind the lens
    if lens.losses is None and (fast := whole_kernel("trace.land", source, lens, receiver)):
        landed = fast(source, lens, receiver, x=x.double(), y=y.double())
        return landed.flux * ((landed.status != int(Status.MISSED_FRONT)) & (landed.status != int(Status.VIGNETTED)))
    z = lens.entrance.z
    return source.irradiance(x, y, z) * is_transmitted(source.rays_through(x, y, z, 1.0), lens)


def corners(shape: Outline, sides: Sides, rows: slice = ALL, columns: slice = ALL) -> tuple[Tensor, Tensor]:
    """Return (x, y) (mm) of the corners of a grid of tubes that covers a shape to its rim; x along the first axis."""
    along_x, along_y = (torch.linspace(-1, 1, n + 1, dtype=torch.float64) for n in as_pair(sides))
    return shape.map_square(*torch.meshgrid(along_x[rows], along_y[columns], indexing="ij"))


def arriving_flux(flux: Tensor, corners: Landed) -> Tensor:
    """Return the flux of each tube whose corners all arrive; zero for the others."""
    alive = corners.alive
    if bool(alive.all()):
        return flux
    whole = alive[..., 1:, 1:] & alive[..., 1:, :-1] & alive[..., :-1, 1:] & alive[..., :-1, :-1]
    return torch.where(whole, flux, torch.zeros_like(flux))


def area_of(x: Tensor, y: Tensor) -> Tensor:
    """Return the area of each quad: half the cross product of its diagonals a and b."""
    (a_x, b_x), (a_y, b_y) = ((p[..., 1:, 1:] - p[..., :-1, :-1], p[..., :-1, 1:] - p[..., 1:, :-1]) for p in (x, y))
    return (a_x * b_y - b_x * a_y).abs() / 2


@torch.no_grad()
def rays_to(
    source: Emitter | Sequence[Emitter], lens: Lens, x: Tensor, y: Tensor, number: int | None = None
) -> tuple[Tensor, Tensor, Rays]:
    """Find the rays that meet an interface of the lens at the points (x, y), a grid (rows, columns) in mm.

    source: one source, or k sources, whose results have the shape (k, rows, columns).  number: number of the interface;
    None: the back.  Returns x and y (mm) at which the rays cross the vertex plane of the first surface, and the rays at
    the interface, not yet deflected; rays that are not found there are lost.
    """
    x, y = (p.to(lens.like.device) for p in (x, y))
    number = lens.number_of(BACK) if number is None else number
    face = lens.interfaces[number].surface
    h = face.relative_sag_and_slope(x.to(lens.like), y.to(lens.like))[0].double()
    sources: Sequence[Emitter] = (source,) if isinstance(source, Emitter) else source
    if not isinstance(source, Emitter):
        x, y, h = (t.expand(len(sources), *t.shape[-2:]) for t in (x, y, h))
    extent = float(torch.maximum(x.max() - x.min(), y.max() - y.min()))
    before = replace(lens.to(x.dtype).unbounded(), losses=None).interfaces[:number]  # in the precision of x and y
    path = Path(tuple(sources), before, lens.entrance.z, face=face, sense=lens.passes.sense, extent=extent)
    found = search(path, x, y, h)
    status = found.rays.lose(found.error > 1e3 * path.tolerance, Status.VIGNETTED)
    at_face = face.chart.point(x, y, h)
    return found.x, found.y, replace(found.rays, position=at_face, z=face.z, status=status, chart=face.chart)


def search(path: Path, x: Tensor, y: Tensor, height: Tensor) -> Found:
    """Find the rays that meet the points (x, y) at heights over the plane of the face (mm).

    x, y, height: (rows, columns) for one source, (k, rows, columns) for k sources.
    """
    fast = None
    if x.dtype == torch.float64:
        fast = kernel_choice.front_kernel("tubes.search", path.before, x)
    if fast is not None and all(source.beam(path.start) is not None for source in path.sources):
        return fast(path, x=x, y=y, height=height)
    return search_plain(path, x, y, height)


def _arrive(path: Path, x: Tensor, y: Tensor, height: Tensor) -> Rays:
    """Trace rays through points (x, y) of the first vertex's plane to the heights, in plain torch."""
    rows = _rows_at_a_time(x[..., 0, :].numel())
    if x.shape[-2] <= rows:
        return _arrive_band(path, x, y, height)
    bands = (slice(first, first + rows) for first in range(0, x.shape[-2], rows))
    return joined((_arrive_band(path, *(t[..., band, :] for t in (x, y, height))) for band in bands), x.shape[-2])


def _arrive_band(path: Path, x: Tensor, y: Tensor, height: Tensor) -> Rays:
    if x.ndim == 2:
        [source] = path.sources
        rays = source.rays_through(x, y, path.start, 1.0)
    else:
        points = zip(path.sources, x, y, strict=True)
        rays = stacked([source.rays_through(p, q, path.start, 1.0) for source, p, q in points])
    rays = functools.reduce(behind, path.before, rays)
    return path.face.arrive(rays, height)


def search_plain(path: Path, x: Tensor, y: Tensor, height: Tensor) -> Found:
    """Find rays as `search` does, in plain torch.

    Broyden's method starts from a Jacobian of difference quotients.  On a fine grid the initial points and Jacobian
    are interpolated from the solution on a coarse grid.
    """
    jacobian = functools.partial(_inverse_jacobian, functools.partial(_arrive, path), path.step)
    p, q = x, y
    inverse: list[Tensor] | None = None
    last: tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]] | None = None  # step, and distance left before it
    # for light along the axis, x and y are the solution
    sides = x.shape[-2:]
    if max(sides) > 2 * COARSE_GRID_POINTS and not _arrive(path, *(t[..., :1, :1] for t in (x, y, height))).axial:
        lines = tuple(torch.linspace(0, n - 1, min(n, COARSE_GRID_POINTS)).round().long() for n in sides)
        coarse = [t[..., lines[0][:, None], lines[1]] for t in (x, y, height)]
        few = search_plain(path, *coarse)
        inverse = [_interpolate(lines, sides, t) for t in jacobian(few.rays, few.x, few.y, coarse[2])]
        p, q = (_interpolate(lines, sides, t) for t in (few.x, few.y))
    for _ in range(MAX_BROYDEN_STEPS):
        hit = _arrive(path, p, q, height)
        off_x, off_y = (wanted - at for wanted, at in zip((x, y), hit.places, strict=True))
        error = torch.where(hit.alive, torch.maximum(off_x.abs(), off_y.abs()), torch.zeros_like(x))
        if not bool(error.any()):
            break  # the start is the solution, as for light along the axis
        if last is not None and inverse is not None:
            step, (last_x, last_y) = last
            inverse = _broyden_update(inverse, step, (last_x - off_x, last_y - off_y))
        xx, xy, yx, yy = inverse = inverse or jacobian(hit, p, q, height)
        step = xx * off_x + xy * off_y, yx * off_x + yy * off_y
        p, q, last = p + step[0], q + step[1], (step, (off_x, off_y))
        if float(error.max()) <= path.tolerance:
            break
    return Found(p, q, hit, error)


def _inverse_jacobian(
    arrive: Callable[..., Rays], step: float, hit: Rays, p: Tensor, q: Tensor, height: Tensor
) -> list[Tensor]:
    """Return [xx, xy, yx, yy], the inverse of ∂(hit of `arrive`) / ∂(p, q) by difference quotients of `step` (mm)."""
    shifted = arrive(*(torch.cat(pair, dim=-2) for pair in ((p + step, p), (q, q + step), (height, height))))
    (xx, xy), (yx, yy) = (
        [(moved - at) / step for moved in place.chunk(2, dim=-2)]
        for place, at in zip(shifted.places, hit.places, strict=True)
    )
    det = xx * yy - xy * yx
    det = torch.where(det.abs() > 1e-6, det, torch.ones_like(det))
    return [yy / det, -xy / det, -yx / det, xx / det]


def _broyden_update(inverse: list[Tensor], step: tuple[Tensor, Tensor], shift: tuple[Tensor, Tensor]) -> list[Tensor]:
    """Return Broyden's update of each inverse Jacobian B, so that B shift = step; shift: change of hits by `step`."""
    xx, xy, yx, yy = inverse
    (s_x, s_y), (m_x, m_y) = step, shift
    off_x, off_y = s_x - (xx * m_x + xy * m_y), s_y - (yx * m_x + yy * m_y)
    row_x, row_y = s_x * xx + s_y * yx, s_x * xy + s_y * yy  # stepᵀ B
    scale = row_x * m_x + row_y * m_y
    small = scale.abs() <= MIN_BROYDEN_DIVISOR * (s_x * s_x + s_y * s_y)
    scale = torch.where(small, torch.full_like(scale, torch.inf), scale)
    off_x, off_y = off_x / scale, off_y / scale
    return [xx + off_x * row_x, xy + off_x * row_y, yx + off_y * row_x, yy + off_y * row_y]


def _interpolate(lines: Sequence[Tensor], shape: Sequence[int], t: Tensor) -> Tensor:
    """Interpolate t linearly along the last two axes to (…, rows, columns); lines: rows and columns of the values t."""
    for known, n in zip(lines, shape, strict=True):  # each iteration interpolates along one axis and transposes t
        index = torch.arange(n)
        right = torch.searchsorted(known, index, right=True).clamp(1, len(known) - 1)
        fraction = ((index - known[right - 1]).double() / (known[right] - known[right - 1])).to(t)
        right = right.to(t.device)
        t = torch.lerp(t[..., right - 1, :], t[..., right, :], fraction[:, None]).transpose(-1, -2)
    return t.contiguous()


def collect(corner: Tensor, flux: Tensor, shape: tuple[int, int], scale: Scale = PIXELS) -> tuple[Tensor, Tensor]:
    """Return (picture (rows, columns), outside) of tubes.

    corner: corners (2, n + 1, m + 1); column and row of (x, y) are (x - x_0) s_x and (y - y_0) s_y pixels, by
    scale = (x_0, y_0, s_x, s_y).  flux: flux of the tubes, (n, m).
    outside: Σ flux · (mean squared distance of corners to the picture, pixel²), so that light outside has a gradient.
    """
    if corner.dtype == torch.float64 and (fast := kernel_choice.kernel("tubes.collect", corner)):
        return fast(corner, flux, (shape, scale), (MIN_TRIANGLE_AREA, EVEN_TUBE, UNEVEN_TUBE))
    return collect_plain(corner, flux, shape, scale)


def collect_plain(corner: Tensor, flux: Tensor, shape: tuple[int, int], scale: Scale = PIXELS) -> tuple[Tensor, Tensor]:
    """Collect as `collect` does, but in plain torch, by Green's theorem (clip.py); edges are split at pixel borders.

    On a GPU `index_add` sums in no fixed order, so that the last bits change from run to run.
    """
    corner = scaled(corner, scale)
    off = sum((p - p.clamp(0, size)) ** 2 for p, size in zip(corner, reversed(shape), strict=True))
    outside = total(flux * middle(off))
    rows, columns = shape
    first, second, third = triangles(corner)
    area = ((second - first)[0] * (third - first)[1] - (third - first)[0] * (second - first)[1]) / 2
    flux = triangle_fluxes(flux.reshape(-1), area)
    cell = torch.stack([p.detach().floor() for p in (first, second, third)])
    whole = (cell == cell[0]).all(0).all(0) | (area.detach().abs() < MIN_TRIANGLE_AREA)
    sums = torch.zeros(rows * (columns + 1), dtype=corner.dtype, device=corner.device)

    column, row = ((first + second + third) / 3).detach().floor()
    on_screen = (whole & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)).nonzero()[:, 0]
    index, inside = (row * (columns + 1) + column)[on_screen].long(), flux.index_select(0, on_screen)
    sums = sums.index_add(0, index, inside).index_add(0, index + 1, -inside)

    # index_select, whose gradient needs no sorting, instead of a mask: half the time of an evaluation on a GPU
    clipped = (~whole).nonzero()[:, 0]
    weight = -(flux.index_select(0, clipped) / area.index_select(0, clipped))
    first, second, third = (p.index_select(1, clipped) for p in (first, second, third))
    for start, end in ((first, second), (second, third), (third, first)):
        edge, s_0, s_1, column, row = _pieces(start, end, (columns, rows))
        a, d = start.index_select(1, edge), (end - start).index_select(1, edge)
        middle_x = a[0] + (s_0 + s_1) / 2 * d[0]
        share = weight.index_select(0, edge) * (s_1 - s_0) * d[1]
        counted = ((row >= 0) & (row < rows) & (column < columns)).nonzero()[:, 0]
        column, row = column[counted], row[counted]
        share, middle_x = share.index_select(0, counted), middle_x.index_select(0, counted)
        offset = torch.where(column < 0, torch.zeros_like(middle_x), middle_x - column)
        index = (row * (columns + 1) + column.clamp(min=0)).long()
        sums = sums.index_add(0, index, share * (1 - offset)).index_add(0, index + 1, share * offset)
    return sums.view(rows, columns + 1).cumsum(1)[:, :columns], outside


def triangle_fluxes(flux: Tensor, area: Tensor) -> Tensor:
    """Return the flux of the first triangles (n,) and of the second triangles of tubes, (2 n,).

    flux F (n,): that of the tubes.  area (2 n,): signed areas A_1 and A_2 of the triangles (pixel²).  A triangle has

        F ((1 - w) A_k / (A_1 + A_2) + w / 2),   w = 3 t² - 2 t³,   t = (|A_1 - A_2| / |A_1 + A_2| - ε_0) / (ε_1 - ε_0),

    with t between 0 and 1, ε_0 = EVEN_TUBE and ε_1 = UNEVEN_TUBE: one density for both where they are nearly alike.
    """
    one, two = area.chunk(2)
    clipped = torch.minimum(one.abs(), two.abs()) >= MIN_TRIANGLE_AREA
    alike = clipped & ((one - two).abs() < UNEVEN_TUBE * (one + two).abs())
    whole = torch.where(alike, one + two, torch.ones_like(one))
    t = ((((one - two) / whole).abs() - EVEN_TUBE) / (UNEVEN_TUBE - EVEN_TUBE)).clamp(0, 1)
    apart = torch.where(alike, t * t * (3 - 2 * t), torch.ones_like(one))
    return torch.cat([flux * ((1 - apart) * part / whole + apart / 2) for part in (one, two)])


def triangles(corner: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the three corners (2, 2 n m) of the two triangles of each quad; the diagonal alternates between quads."""
    p0, p1, p2, p3 = corner[:, :-1, :-1], corner[:, 1:, :-1], corner[:, 1:, 1:], corner[:, :-1, 1:]
    i, j = (torch.arange(k, device=corner.device) for k in p0.shape[1:])
    even = ((i[:, None] + j) % 2 == 0).expand_as(p0)
    one = (p0, p1, torch.where(even, p2, p3))
    two = (torch.where(even, p0, p1), p2, p3)
    a, b, c = (torch.cat([p.reshape(2, -1), q.reshape(2, -1)], dim=1) for p, q in zip(one, two, strict=True))
    return a, b, c


def _pieces(start: Tensor, end: Tensor, sizes: tuple[int, int]) -> tuple[Tensor, ...]:
    """Return (number of the edge, s at start and end, column, row) of each piece of an edge between pixel borders.

    s runs from 0 to 1 along the edge.  Outside the screen (columns, rows) edges are not split.  The pixel of a piece
    follows from the borders crossed before it.  Its midpoint would not do: at the corner of a pixel a piece has length
    0, but its ends have derivatives, and rounding could give these to another pixel.
    """
    edges = torch.arange(start.shape[1], device=start.device)
    parts = [(edges, torch.zeros_like(start[0]), torch.full_like(edges, -1))]  # edges, starts s, axes of the borders
    cells, senses = [], []
    for axis, (a, b, size) in enumerate(zip(start, end, sizes, strict=True)):
        first, last = (p.detach().floor().clamp(-1, size) for p in (a, b))
        low, count = torch.minimum(first, last), (last - first).abs().long()
        which = edges.repeat_interleave(count)
        nth = torch.arange(len(which), device=start.device) - (count.cumsum(0) - count)[which]
        at = ((low[which] + 1 + nth - a.index_select(0, which)) / (b - a).index_select(0, which)).clamp(0, 1)
        parts.append((which, at, torch.full_like(which, axis)))
        cells.append(first)
        senses.append(torch.sign(last - first))
    edge, s, kind = (torch.cat(part) for part in zip(*parts, strict=True))
    order = torch.argsort(s.detach(), stable=True)
    order = order[torch.argsort(edge[order], stable=True)]
    edge, s, kind = edge[order], s.index_select(0, order), kind[order]
    begins = (kind == -1).nonzero(as_tuple=True)[0]  # first piece of each edge, sorted first at s = 0
    pixel = []
    for axis in (0, 1):
        crossed = (kind == axis).cumsum(0)
        pixel.append(cells[axis][edge] + senses[axis][edge] * (crossed - crossed[begins][edge]))
    last = torch.cat([edge[1:] != edge[:-1], torch.ones(1, dtype=torch.bool, device=edge.device)])
    return edge, s, torch.where(last, torch.ones_like(s), torch.cat([s[1:], s[-1:]])), *pixel


def middle(corner: Tensor) -> Tensor:
    """Return the mean of the four corners of each quad."""
    low, high = corner[..., :-1, :], corner[..., 1:, :]
    return (high[..., 1:] + high[..., :-1] + low[..., 1:] + low[..., :-1]) / 4
