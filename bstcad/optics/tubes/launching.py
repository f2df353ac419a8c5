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
from torch import Tensor

from bstcad.optics.interfaces import cross
from bstcad.optics.irradiance import Screen
from bstcad.optics.kernels import forward
from bstcad.optics.kernels.choice import fused_whole
from bstcad.optics.kernels.reductions import elementary, total
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline, Rectangle, Rounded
from bstcad.optics.planes import TargetPlane
from bstcad.optics.rays import Landed, Rays, Status
from bstcad.optics.simulation import arrive_at_back
from bstcad.optics.sources import Source
from bstcad.optics.trace import through_back
from bstcad.optics.tubes.collecting import collect, middle
from bstcad.optics.tubes.finding import rays_to

ALL = slice(None)
SHEET = 256  # tubes a side of the sheet through which finer ones are interpolated
INWARDS = 1e-9  # relative shrink towards the middle: corners on the rim of the light are counted as lit
ROOM = 1e-4  # of the outline
BAND = 256  # rows of tubes traced at a time for a picture alone; even, since the diagonals alternate
PARTS = 4  # of a tube on the rim of the light, each way
Coarse = dict[int, tuple[Tensor, Tensor]]  # by tubes a side: (x, y) of the corners of a sheet (mm)


@dataclass(frozen=True)
class Tubes:
    """The light on its way to the first freeform interface, as tubes between neighbouring rays."""

    coming: Rays  # (3, n + 1, n + 1) the corners
    flux: Tensor  # (n, n) of each tube, as a fraction of the source's, before anything on the way takes some of it
    dims: bool = False  # does something?  Then the flux of a corner is the share that is left of it

    def landing(self, lens: Lens, plane: TargetPlane) -> Landed:
        """Where the corners meet the plane; the outline counts in the flux, so that no corner is lost to it."""
        return through_back(self.coming, lens.unbounded(), plane)

    def collect(self, corners: Landed, screen: Screen) -> tuple[Tensor, Tensor]:
        """(picture, outside): flux that falls into each pixel, row 0 = y max; and Σ flux · (pixels beyond the border)².

        Tubes with a lost corner carry nothing.
        """
        return collect(screen.pixels_of(corners.position.double()), self.whole(corners), screen.shape)

    def whole(self, corners: Landed) -> Tensor:
        """(n, n) flux of the tubes whose corners all arrive, zero for the others."""
        return _whole(self.left(corners), corners)

    def arriving(self, corners: Landed) -> Tensor:
        """(n, n) the same, as if nothing had taken any of it on the way."""
        return _whole(self.flux, corners)

    def left(self, corners: Landed) -> Tensor:
        """(n, n) flux that faces and glass leave each tube, whether it arrives or not."""
        return self.flux * middle(corners.flux) if self.dims else self.flux

    def picture(self, lens: Lens, screen: Screen) -> Tensor:
        """(rows, columns) flux that falls into each pixel, row 0 = y max."""
        return self.collect(self.landing(lens, screen.plane), screen)[0]


@torch.no_grad()
def launch_tubes(source: Source, lens: Lens, n: int) -> Tubes:
    """n x n tubes that hold all the light which gets through both faces of the lens.

    The sheet is spread over the beam's cross-section if all of that gets through, else over the back face: its rim is
    the rim of the light.  A tube in which only part of the light gets through carries that part, spread over all of it.
    """
    sheet = _sheet(source, lens, n)
    return _tubes(source, lens, *sheet.rows(ALL), sheet.cut)


@torch.no_grad()
def picture(
    source: Source, lens: Lens, screen: Screen, n: int, few: int = SHEET, coarse: Coarse | None = None,
    over_the_back: bool = False,
) -> Tensor:  # fmt: skip
    """(rows, columns) flux that falls into each pixel by n x n tubes, band by band: memory does not grow with n².

    few: tubes a side of the sheet through which finer ones are interpolated, where the lens cuts the beam.
    coarse: such sheets of this source and lens, which is found once for pictures of more and more tubes.
    over_the_back: spread them there even where the lens cuts nothing, so that pictures of lenses that differ little err
    alike, whether they cut the beam or just do not.
    """
    sheet = _over_the_back(source, lens, n, few, {}) if over_the_back else _sheet(source, lens, n, few, coarse)
    whole = torch.zeros(screen.shape, dtype=torch.float64, device=lens.like.device)
    for first in range(0, n, BAND):
        band = sheet.rows(slice(first, min(first + BAND, n) + 1))
        x, y = (p + INWARDS * (middle - p) for p, middle in zip(band, sheet.middle, strict=True))
        whole = whole + _picture(source, lens, screen, x, y, sheet.cut)
    return whole.clamp(min=0)  # a black pixel may be off by rounding


def _picture(source: Source, lens: Lens, screen: Screen, x: Tensor, y: Tensor, cut: bool) -> Tensor:
    """The picture of one band, by the fused forward trace where there is one."""
    if lens.losses is not None or not fused_whole(lens.interfaces):
        return _tubes(source, lens, x, y, cut).picture(lens, screen)

    def land(source: Source, lens: Lens, at: tuple[Tensor, Tensor]) -> Landed:
        return forward.land(source, lens, screen.plane, *at)

    points = x.reshape(-1), y.reshape(-1)
    landed, lit = land(source, lens.grown(1 + INWARDS) if cut else lens.unbounded(), points), None
    lost = ~(landed.alive & (landed.flux > 0))  # a ray without flux may end anyhow
    if bool(lost.any()):
        if cut:
            lit = (landed.flux > 0) & (landed.status != int(Status.MISSED_FRONT))
        again = land(source.unbounded(x, y, lens.entrance.z), lens.unbounded(), tuple(p[lost] for p in points))
        landed.position[:, lost], landed.status[lost] = again.position, again.status
    landed = Landed(landed.position.view(2, *x.shape), landed.flux.view(x.shape), landed.status.view(x.shape))
    lit = None if lit is None else lit.view(x.shape)
    flux = _density(source, lens, x, y, lit) * area_of(x, y)
    return collect(screen.pixels_of(landed.position), _whole(flux, landed), screen.shape)[0]


@dataclass(frozen=True)
class _Sheet:
    """Where the corners of (n, n) tubes cross the vertex plane of the first surface."""

    rows: Callable[[slice], tuple[Tensor, Tensor]]  # (x, y) of some rows of them (mm)
    middle: tuple[float, float]  # of all (mm)
    cut: bool  # does the lens cut the beam?


def _sheet(source: Source, lens: Lens, n: int, few: int = SHEET, coarse: Coarse | None = None) -> _Sheet:
    return _over_the_beam(source, lens, n) or _over_the_back(source, lens, n, few, {} if coarse is None else coarse)


def _tubes(source: Source, lens: Lens, x: Tensor, y: Tensor, cut: bool) -> Tubes:
    z, like = lens.entrance.z, lens.like
    area = area_of(x, y).to(like.device)
    x, y = x.to(like), y.to(like)
    light, lit = source.rays(x, y, z, 1.0), None
    if lens.losses is not None:
        light = replace(light, flux=torch.ones_like(light.flux))
    inside, ways = source.irradiance(x, y, z) > 0, [light]  # ways: before each interface, as far as the back
    before_back = slice(lens.number_of_back)
    edges = lens.grown(1 + INWARDS).interfaces[before_back]  # grown: room for rounding
    for free, bound in zip(lens.unbounded().interfaces[before_back], edges, strict=True):
        ways.append(cross(ways[-1], free).rays)
        inside = inside & bound.outline.contains(*ways[-1].position[:2])
    if cut:
        lit = inside & ways[-1].alive
    coming = ways[min(lens.freeform[0], lens.number_of_back)]
    return Tubes(coming, _density(source, lens, x, y, lit) * area, lens.losses is not None)


def _density(source: Source, lens: Lens, x: Tensor, y: Tensor, lit: Tensor | None) -> Tensor:
    """Flux a mm² of the vertex plane that each tube carries; `lit`: which corners are, None: all of them."""
    density = source.irradiance(middle(x), middle(y), lens.entrance.z)
    if lit is not None:
        count = middle(lit.to(density))
        density = torch.where(count == 1, density, torch.zeros_like(density))
        rim = (count > 0) & (count < 1)
        if bool(rim.any()):
            density[rim] = _partly_lit(source, lens, *(_quads(p, rim) for p in (x, y))).to(density)
    return density.double()


def _over_the_beam(source: Source, lens: Lens, n: int) -> _Sheet | None:
    """A sheet over all of the beam; None if the lens cuts it."""
    z = lens.entrance.z
    spot, centre = source.spot(z)
    if spot is None:
        return None
    ends = (slice(0, 1), ALL), (slice(n, None), ALL), (ALL, slice(0, 1)), (ALL, slice(n, None))
    sides = zip(*(corners(spot, n, *end) for end in ends), strict=True)
    rim = (
        at + (1 - INWARDS) * torch.cat([p.reshape(-1) for p in side]) for side, at in zip(sides, centre, strict=True)
    )
    rim_x, rim_y = (p.to(lens.like) for p in rim)
    if not bool(arrive_at_back(source.rays(rim_x, rim_y, z, 1.0), lens).all()):
        return None

    def rows(band: slice) -> tuple[Tensor, Tensor]:
        x, y = corners(spot, n, band)
        return x + centre[0], y + centre[1]

    return _Sheet(rows, centre, cut=False)


def _over_the_back(source: Source, lens: Lens, n: int, few: int, known: Coarse) -> _Sheet:
    """A sheet whose rim meets the rim of the back face; on a fine grid by splines through a coarse one.

    Only the rim has to lie well: a tube may lie anywhere as long as its flux is that of its own quad.
    """
    from scipy.interpolate import RectBivariateSpline  # with much else, which a plan has no use for

    few = min(n, few)
    if few not in known:
        known[few] = rays_to(source, lens, *corners(lens.apertures[1], few))[:2]
    x, y = known[few]
    middle = tuple(float(total(p) / p.numel()) for p in (x, y))
    if few == n:
        return _Sheet(lambda band: (x[band], y[band]), middle, cut=True)
    places, fine = np.linspace(0, 1, few + 1), np.linspace(0, 1, n + 1)
    through = [RectBivariateSpline(places, places, p.cpu().numpy(), s=0) for p in (x, y)]
    return _Sheet(lambda band: tuple(torch.from_numpy(p(fine[band], fine)) for p in through), middle, cut=True)


def _quads(p: Tensor, where: Tensor) -> tuple[Tensor, ...]:
    """One coordinate of the corners of the tubes at `where`, each (n,), row by row."""
    row, column = where.nonzero(as_tuple=True)
    return p[row, column], p[row, column + 1], p[row + 1, column], p[row + 1, column + 1]


def _partly_lit(source: Source, lens: Lens, x: tuple[Tensor, ...], y: tuple[Tensor, ...]) -> Tensor:
    """Mean flux density (1/mm²) of the light that gets through, over PARTS x PARTS parts of each tube of `_quads`."""
    inner = torch.tensor([(k + 0.5) / PARTS for k in range(PARTS)], dtype=x[0].dtype, device=x[0].device)
    a, b = (t.reshape(-1, 1) for t in torch.meshgrid(inner, inner, indexing="ij"))
    p, q = (((1 - a) * ((1 - b) * c[0] + b * c[1]) + a * ((1 - b) * c[2] + b * c[3])).reshape(-1) for c in (x, y))
    return _getting_through(source, lens, p, q).view(PARTS**2, -1).mean(0)


def _getting_through(source: Source, lens: Lens, x: Tensor, y: Tensor) -> Tensor:
    """Flux density (n,) (1/mm²) at points of the first vertex's plane (n,), zero where the lens cuts the light."""
    if lens.losses is None and fused_whole(lens.interfaces):
        landed = forward.land(source, lens, lens.back.z + 1.0, x.double(), y.double())  # a plane behind it, whichever
        return landed.flux * ((landed.status != int(Status.MISSED_FRONT)) & (landed.status != int(Status.VIGNETTED)))
    return source.irradiance(x, y, lens.entrance.z) * arrive_at_back(source.rays(x, y, lens.entrance.z, 1.0), lens)


def corners(shape: Outline, n: int, rows: slice = ALL, columns: slice = ALL) -> tuple[Tensor, Tensor]:
    """(n + 1)² points that cover a shape to its rim, neighbours beside each other; x along the first axis (mm).

    A disc by the concentric map, which keeps areas (Shirley and Chiu 1997); a rectangle with round corners by moving
    each of its concentric rings towards the axis, onto a ring with corners as round.
    """
    unit = torch.linspace(-1, 1, n + 1, dtype=torch.float64)
    a, b = torch.meshgrid(unit[rows], unit[columns], indexing="ij")
    if isinstance(shape, Rectangle):
        shrink = _onto_round_corners(shape, a, b) if isinstance(shape, Rounded) else 1.0
        return a * (shape.width / 2) * shrink, b * (shape.height / 2) * shrink
    steep = b.abs() > a.abs()
    long, short = torch.where(steep, b, a), torch.where(steep, a, b)
    turn = (math.pi / 4) * short / torch.where(long == 0, torch.ones_like(long), long)
    along, across = (shape.radius * long * elementary(f, turn) for f in (torch.cos, torch.sin))
    return torch.where(steep, across, along), torch.where(steep, along, across)


def _onto_round_corners(shape: Rounded, a: Tensor, b: Tensor) -> Tensor:
    """By what to multiply places (a, b) in the square from -1 to 1, so that its rim is that of the shape."""
    ring = torch.maximum(a.abs(), b.abs()).clamp(min=1e-300)
    x, y = a.abs() / ring * (shape.width / 2), b.abs() / ring * (shape.height / 2)  # on the rim of the rectangle
    c, d, r2 = shape.limits
    along, square = x * c + y * d, x * x + y * y
    # the farther of the places t (x, y) with |t (x, y) - (c, d)| = r, the centre of the corner's circle
    t = (along + torch.sqrt((along * along - square * (c * c + d * d - r2)).clamp(min=0))) / square
    return torch.where((x > c) & (y > d) & (t * x > c) & (t * y > d), t, torch.ones_like(t))


def _whole(flux: Tensor, corners: Landed) -> Tensor:
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
