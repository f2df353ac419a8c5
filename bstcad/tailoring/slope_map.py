"""The transport map of stage 1: optimal transport from points of a face to its slopes, a map that a surface can follow.

The map of Wang et al. 2023 leads from source points to target points.  It is a gradient in the paraxial limit only; off
axis, the part of it that no surface can follow is lost in stage 1.  Here the same transport problem is solved in
coordinates in which a surface is a gradient.  A ray that meets the last freeform face at b and shall reach the target
point t needs the slope p(b, t), which follows from Snell's law or the law of reflection in closed form.  With m the
centroid of the light on the target,

    y = σ (p(b, t) - ∇g(b)),    ∇g(b) ≈ p(b, m)

hardly depends on b for a fixed t; g is nearly the surface that focuses all light on m.  The optimal transport map
b -> y is ∇φ of a convex φ, so that σ y + ∇g are the slopes of a surface.  σ = 1 where light leaves the glass.  Mirrors,
and faces where light enters the glass, turn light against their slope: there σ = -1, so that rays of neighbouring
points do not cross.  If there are surfaces behind the net, light is aimed at the image of the target through them
(optics/unfolding.py).  The remaining dependence on b, of the order of t - m, enters through the b that the previous
round assigned to each t.  At the fixed point the surface solves the Monge-Ampère problem of the system, off axis, in
the near field and behind a curved front alike, for any g.

`map_to_target` and `aim_points` are the map of the paper, from the vertex plane of the front to the target, and the aim
of each ray.  Stage 1 falls back on them, and the baselines follow them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics import sampling
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.emitters import Emitter
from bstcad.optics.interfaces import cross
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.rays import Rays
from bstcad.optics.reach import MAX_EXIT_ANGLE, limit_refraction, reach_margin, wanted_slopes
from bstcad.optics.receivers import Receiver
from bstcad.optics.sides import Sides, as_pair
from bstcad.optics.trace import across, clear_window, is_transmitted
from bstcad.optics.tubes import rays_to
from bstcad.optics.unfolding import image_screen
from bstcad.scene.errors import SceneError
from bstcad.tailoring.slope_fit import Fit, blocks, fit_slopes
from bstcad.transport.bfm import TransportStep
from bstcad.transport.density import Density, spread
from bstcad.transport.mapping import Frame, Mapping, TransportMap, nodes, solve

SUBCELLS = 2  # samples of the light in a transport cell, each way: a rim may cross the cell
SUBPIXELS = 8  # parts of a pixel per transport cell, each way; at least one part per pixel
SLOPE_FLOOR = 1e-3  # floor under the slope density, relative to its mean, that the solver needs in black parts
GATHERING_NET, GATHERING_SAMPLES = 33, 96  # control points a side of g, and samples a side for its fit
GATHERING_WIDTH = (GATHERING_NET - 1) / (GATHERING_NET - 5)  # width of g over the window's: end spans lie outside
GATHERING_FIT = Fit(bending=1e-3, steps=40, degree=5)  # fit of g
PARABOLOID_FIT = Fit(steps=0, degree=2)  # fit of g by a paraboloid, where no face focuses the light
PREVIEW_FIT, PREVIEW_SAMPLES = Fit(steps=0, degree=5), 32  # fit and samples of g in a preview, in a fifth of the time
TARGET_FLOOR = 1e-3  # floor under the irradiance of the target, relative to its mean


@dataclass(frozen=True)
class FaceGrid:
    """Rays and flux density at the cell centres of a rectangle of the last freeform face."""

    window: Rectangle  # rectangle in x and y about the axis (mm)
    at_face: Rays  # (3, m, n) rays before the face: position on the face, direction of incidence
    density: Tensor  # (m, n) flux per mm² of the x-y plane

    @property
    def shape(self) -> tuple[int, int]:
        """Cells along x and along y."""
        m, n = self.density.shape
        return m, n


@torch.no_grad()
def face_grid(source: Emitter, lens: Lens, window: Rectangle, cells: Sides) -> FaceGrid:
    """Return the rays that meet the last freeform face at the centres of `cells` cells of a window.

    The flux density is that of the source on the vertex plane of the first surface, times |∂q/∂b|, where the ray
    through b crosses that plane at q; less the losses at the faces and in the glass, with the present back.
    """
    x, y = (t.to(lens.like.device) for t in sampling.grid(window, cells))
    number = lens.freeform[-1]
    q_x, q_y, at_face = rays_to(source, lens, x=x, y=y, number=number)
    coming = across(source.rays(q_x, q_y, lens.entrance.z, 1.0), lens.interfaces[:number])
    steps = tuple(side / n for side, n in zip((window.width, window.height), as_pair(cells), strict=True))
    xx, xy = torch.gradient(q_x, spacing=steps)
    yx, yy = torch.gradient(q_y, spacing=steps)
    through = lens.last_freeform.outline.contains(x, y) & coming.alive & at_face.alive
    lossless = lens.losses is None
    density = source.irradiance(q_x, q_y, lens.entrance.z) if lossless else cross(coming, lens.last_freeform).rays.flux
    density = density * (xx * yy - xy * yx).abs() * through
    return FaceGrid(window, at_face, density)


def lit_window(source: Emitter, lens: Lens, n: int = 128) -> Rectangle:
    """Return the rectangle of the last freeform face that light meets, with a margin; SceneError if there is none."""
    half_x, half_y = lens.last_freeform.outline.half_extent
    grid = face_grid(source, lens, Rectangle(2 * half_x, 2 * half_y), n)
    lit = grid.density > 0
    if not bool(lit.any()):
        raise SceneError(
            "source: no ray of it reaches the back; move the source away from the front, or the back nearer to it"
        )
    x, y, _ = grid.at_face.position
    reach = ((float(p.abs()[lit].max()) + 2.5 * 2 * half / n, half) for p, half in ((x, half_x), (y, half_y)))
    return Rectangle(*(2 * min(r, half) for r, half in reach))


@dataclass(frozen=True)
class SlopeMap:
    """Transport map b -> y = ∇φ(b); the slope needed at b is σ y + ∇g(b)."""

    mapping: Mapping  # map from points of the last freeform face (mm) to y (dimensionless)
    gathering: BSplineSurface  # surface g
    sign: float  # sign σ, 1 or -1
    places: tuple[np.ndarray, np.ndarray]  # b (mm) for the corners of the target's pixels, (columns + 1, rows + 1)
    moved: float  # RMS change of `places` at lit pixels since the last round, in half windows; NaN: first round

    def slopes(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return the slopes (∂z/∂x, ∂z/∂y) needed at points x, y (n,) of the last freeform face (mm)."""
        sent = self.mapping(x.cpu().double().numpy(), y.cpu().double().numpy())
        mapped = (torch.from_numpy(np.ascontiguousarray(s)).to(x) for s in sent)
        _, *gathering = self.gathering.relative_sag_and_slope(x.cpu().double(), y.cpu().double())
        z_x, z_y = (self.sign * s + g.to(x) for s, g in zip(mapped, gathering, strict=True))
        return z_x, z_y


def slope_map(
    source: Emitter, lens: Lens, window: Rectangle, picture: np.ndarray, screen: Screen, n: int,
    previous: SlopeMap | None, preview: bool = False, **solver,
) -> SlopeMap:  # fmt: skip
    """Return the map of one round, by transport on n x n cells for the sag of `lens`.

    previous: map of the last round, which gives b(t); None: b = 0.  window: `lit_window` of the lens.
    preview: fit g in a fifth of the time; the fixed point is the same.  solver: more arguments of transport's `solve`.
    """
    grid, screen, law = square_grid(source, lens, window, n), image_screen(lens, screen), lens.last_freeform.law
    t = pixel_corners(screen)
    b = previous.places if previous else tuple(map(np.zeros_like, t))
    net = gathering(grid, lens, screen.plane, centroid(picture, screen), preview=preview)
    needed = wanted_slopes(rays_at(grid, b), torch.from_numpy(np.stack(t)), screen.plane, law)
    sign = -1.0 if law.reverses or law.eta < 1 else 1.0
    found = transport_slopes(grid, picture, net, needed, places=b, sign=sign, n=n, **solver)
    return found if previous else replace(found, moved=math.nan)


def square_grid(source: Emitter, lens: Lens, window: Rectangle, n: int) -> FaceGrid:
    """Return the `face_grid` of a square around a window, with SUBCELLS x SUBCELLS cells per cell of the transport."""
    side = max(window.width, window.height)
    return face_grid(source, lens, Rectangle(side, side), n * SUBCELLS)


def transport_slopes(
    grid: FaceGrid, picture: np.ndarray, net: BSplineSurface, needed: tuple[Tensor, Tensor],
    places: tuple[np.ndarray, np.ndarray], *, sign: float, n: int, **solver,
) -> SlopeMap:  # fmt: skip
    """Return the map from the light of a `square_grid` to a picture, given the slopes needed for its pixel corners.

    net: g.  needed: slopes p(b, t) for the corners t of the pixels.  places: their b (mm), those of the last round.
    """
    side = grid.window.width
    rho = grid.density.cpu().double().numpy().reshape(n, SUBCELLS, n, SUBCELLS).mean((1, 3))
    _, *g = net.relative_sag_and_slope(*(torch.from_numpy(p) for p in places))
    y_x, y_y = (sign * (p - own).numpy() for p, own in zip(needed, g, strict=True))
    sigma, frame = spread_density(picture, (y_x, y_y), n)
    mapping = solve(light_density(rho, side), sigma, Frame((0.0, 0.0), side), frame, **solver)
    now = mapping.inverse(y_x, y_y)
    return SlopeMap(mapping, net, sign, places=now, moved=_rms_change(picture, places, now) / (side / 2))


def _rms_change(picture: np.ndarray, before: Sequence[np.ndarray], now: Sequence[np.ndarray]) -> float:
    """Return the RMS distance (mm) between two positions of the corners of the lit pixels."""
    lit = corners_of(picture)
    x, y = ((a - b)[lit] for a, b in zip(now, before, strict=True))
    return float(np.sqrt(np.mean(x * x + y * y)))


def fit_to_map(
    lens: Lens, wanted: SlopeMap, grid: FaceGrid, fit: Fit, unlit: float, parts: int = 1,
    grazing: float = MAX_EXIT_ANGLE,
) -> Lens:  # fmt: skip
    """Return the lens whose last net is fitted to the slopes of a map by least squares; its vertex stays.

    A map may send a little light further than the face can, into the black around a picture; that light leaves at the
    angle `grazing` (rad).  Points without light count with the weight `unlit` and their present slopes; for 0 the
    bending energy alone shapes them.  parts: points per cell of the grid, each way.
    """
    m, n = grid.shape
    places = sampling.grid(grid.window, (parts * m, parts * n))
    x, y = (p.to(grid.density.device).reshape(-1) for p in places)
    lit = (grid.density > 0).repeat_interleave(parts, 0).repeat_interleave(parts, 1).reshape(-1)
    net = lens.nets[-1]
    z_x, z_y = torch.empty_like(x), torch.empty_like(y)
    for some in blocks(len(x)):
        _, *now = net.relative_sag_and_slope(x[some], y[some])
        arriving = rays_at(grid, tuple(p[some].cpu().double().numpy() for p in (x, y)))
        slopes = (s.cpu().double() for s in wanted.slopes(x[some], y[some]))
        slopes = limit_refraction(arriving, tuple(slopes), lens.last_freeform.law, grazing)
        for z, needed, own in zip((z_x, z_y), slopes, now, strict=True):
            z[some] = torch.where(lit[some], needed.to(x), own)
    weight = torch.where(lit, 1.0, unlit).to(x)
    fitted = fit_slopes(net, x, y, z_x=z_x, z_y=z_y, weight=weight, fit=fit)
    return lens.with_last_net(fitted.from_vertex().moved(net.z))


def centroid(picture: np.ndarray, screen: Screen) -> tuple[float, float]:
    """Return the centroid (mm) of the light of a picture, row 0 = y max."""
    sums = picture.sum(0), picture.sum(1)[::-1]
    share_x, share_y = (float(((np.arange(len(s)) + 0.5) * s).sum() / s.sum()) / len(s) for s in sums)
    (left, right), (low, high) = screen.x, screen.y
    return left + share_x * (right - left), low + share_y * (high - low)


def gathering(
    grid: FaceGrid, lens: Lens, plane: Receiver, middle: tuple[float, float], preview: bool = False
) -> BSplineSurface:
    """Return g, the net of GATHERING_NET points a side whose slopes fit p(b, m) best over the lit part of a grid.

    With the sag fixed, p(b, m) is a gradient but for a curl of the order ∂p/∂z x y.
    """
    count, fit = (PREVIEW_SAMPLES, PREVIEW_FIT) if preview else (GATHERING_SAMPLES, GATHERING_FIT)
    thin = tuple(slice(step // 2, None, step) for step in (max(1, n // count) for n in grid.shape))
    faces = replace(grid.at_face, **{k: getattr(grid.at_face, k)[(..., *thin)] for k in ("position", "direction")})
    x, y, _ = faces.position
    aim = torch.stack([torch.full_like(x, m) for m in middle])
    z_x, z_y = wanted_slopes(faces, aim, plane, lens.last_freeform.law)
    lit = grid.density[thin] > 0
    reaches = reach_margin(faces, aim, plane, law=lens.last_freeform.law) >= 0  # elsewhere the slope is a placeholder
    return fit_gathering(grid, (x, y, z_x, z_y, lit), fit if bool(reaches[lit].all()) else PARABOLOID_FIT)


def fit_gathering(grid: FaceGrid, samples: tuple[Tensor, ...], fit: Fit) -> BSplineSurface:
    """Fit a net of GATHERING_NET points a side over a grid to the slopes of samples (x, y, z_x, z_y, weight)."""
    half_x, half_y = (GATHERING_WIDTH * size / 2 for size in (grid.window.width, grid.window.height))
    flat = torch.zeros((GATHERING_NET, GATHERING_NET), dtype=torch.float64)
    net = BSplineSurface(0.0, flat, (-half_x, half_x), (-half_y, half_y))
    return fit_slopes(net, *(p.reshape(-1).cpu().double() for p in samples), fit=fit)


def interpolate(grid: FaceGrid, values: Tensor, b: tuple) -> Tensor:
    """Interpolate values (k, m, n) at cell centres to points b (…) mm, bilinear, constant outside; return (k, …)."""
    sizes = (grid.window.width, grid.window.height)
    x, y = (torch.from_numpy(p) / (size / 2) for p, size in zip(b, sizes, strict=True))
    where = torch.stack([y, x], dim=-1)  # -1 to 1 across the window; the last axis of the values comes first
    found = torch.nn.functional.grid_sample(
        values.cpu().double()[None], where.reshape(1, 1, -1, 2), padding_mode="border", align_corners=False
    )
    return found.view(len(values), *x.shape)


def rays_at(grid: FaceGrid, b: tuple) -> Rays:
    """Return the rays that meet the face at points b (mm), with sag and direction interpolated in the grid."""
    sag, d_x, d_y, d_z = interpolate(grid, torch.cat([grid.at_face.position[2:], grid.at_face.direction]), b)
    position = torch.stack([torch.from_numpy(b[0]), torch.from_numpy(b[1]), sag])
    direction = torch.stack([d_x, d_y, d_z]) / torch.sqrt(d_x * d_x + d_y * d_y + d_z * d_z)
    return replace(grid.at_face, position=position, direction=direction)


def map_from_face(places: tuple[np.ndarray, np.ndarray], screen: Screen) -> TransportMap:
    """Return the map for the corners of the target's pixels, given as points (mm) of the last tailored face.

    places: x and y, each (columns + 1, rows + 1).  The plane of the map is named "back" even if the face is the front.
    """
    x, y = (np.linspace(*ends, n + 1) for ends, n in ((screen.x, screen.columns), (screen.y, screen.rows)))
    i, j = nodes(screen.columns), nodes(screen.rows)
    source = np.stack([place[np.ix_(i, j)] for place in places], axis=-1)
    return TransportMap(x[i], y[j], source.astype(np.float32), "back")


def pixel_corners(screen: Screen) -> list[np.ndarray]:
    """Return x and y (mm) of the corners of the pixels, each (columns + 1, rows + 1), x first."""
    sides = np.linspace(*screen.x, screen.columns + 1), np.linspace(*screen.y, screen.rows + 1)
    return np.meshgrid(*sides, indexing="ij")


def spread_density(picture: np.ndarray, corners: tuple[np.ndarray, np.ndarray], n: int) -> tuple[Density, Frame]:
    """Resample a picture with the given pixel corners on n x n cells of the smallest square around its lit part."""
    lit = corners_of(picture)
    low, high = (np.array([f(c[lit]) for c in corners]) for f in (np.min, np.max))
    frame = Frame(tuple((low + high) / 2), float((high - low).max()))
    flux = np.ascontiguousarray(picture[::-1].T)  # row 0 is y max
    parts = tuple(max(1, round(SUBPIXELS * n / pixels)) for pixels in flux.shape)
    x, y = (np.ascontiguousarray(n * c) for c in frame.to_unit(*corners))
    return Density.from_values(spread(flux, x, y, n=n, parts=parts), floor=SLOPE_FLOOR), frame


def light_density(values: np.ndarray, side: float) -> Density:
    """Return the density of light in cells of a square of `side` mm; SceneError if it falls between the samples."""
    if not values.any():
        raise SceneError(
            "source: its light at the lens is narrower than a cell of the transport grid "
            f"({side / len(values):.3g} mm); make the sides of lens.outline more alike, or raise "
            "tailoring.transport_grid"
        )
    return Density.from_values(values)


def corners_of(picture: np.ndarray) -> np.ndarray:
    """Return True at the corners of all pixels that are not black, (columns + 1, rows + 1), x first."""
    lit = np.pad(picture[::-1].T > 0, 1)  # row 0 is y max
    return lit[1:, 1:] | lit[1:, :-1] | lit[:-1, 1:] | lit[:-1, :-1]


@torch.no_grad()
def map_to_target(
    source: Emitter,
    lens: Lens,
    picture: np.ndarray,
    screen: Screen,
    n: int,
    iterations: int,
    progress: Callable[[TransportStep], None],
) -> Mapping:
    """Return the transport map of the paper, from the vertex plane of the front (mm) to the target (mm).

    It is solved on n x n cells, for the light that passes all faces.  A tilted target is projected from the vertex of
    the front onto the level plane through its centre: in its own coordinates the map would be far from a gradient.
    """
    screen = image_screen(lens, screen)
    area = clear_window(source, lens)
    side = max(area.width, area.height)
    x, y = (t.to(lens.like.device) for t in sampling.grid(Rectangle(side, side), n * SUBCELLS))
    flux = source.irradiance(x, y, lens.entrance.z)
    flux = flux * is_transmitted(source.rays(x, y, lens.entrance.z, 1.0), lens)
    density = light_density(flux.cpu().numpy().reshape(n, SUBCELLS, n, SUBCELLS).mean((1, 3)), side)
    if not screen.plane.is_level:
        wanted, frame = spread_density(picture, screen.plane.to_level_plane(*pixel_corners(screen), lens.front.z), n)
    else:
        width, height = screen.x[1] - screen.x[0], screen.y[1] - screen.y[0]
        wanted = Density.from_picture(picture, n, width=width, height=height, floor=TARGET_FLOOR)
        frame = Frame(((screen.x[0] + screen.x[1]) / 2, (screen.y[0] + screen.y[1]) / 2), max(width, height))
    return solve(density, wanted, Frame((0.0, 0.0), side), frame, iterations=iterations, progress=progress)


def map_from_entrance(mapping: Mapping, lens: Lens, screen: Screen) -> TransportMap:
    """Return the inverse of the map of `map_to_target` at the corners of the target's pixels."""
    screen = image_screen(lens, screen)
    corners = pixel_corners(screen)
    if not screen.plane.is_level:
        corners = screen.plane.to_level_plane(*corners, lens.front.z)
    return replace(map_from_face(mapping.inverse(*corners), screen), plane="entrance")


def aim_points(mapping: Mapping, lens: Lens, screen: Screen, x: Tensor, y: Tensor) -> Tensor:
    """Return the points of the screen (2, …) mm to which the map of `map_to_target` sends points x, y (…) mm."""
    screen, sent = image_screen(lens, screen), mapping(*(p.detach().cpu().double().numpy() for p in (x, y)))
    if not screen.plane.is_level:
        sent = screen.plane.from_level_plane(*sent, lens.front.z)
    return torch.stack([torch.from_numpy(np.ascontiguousarray(s)) for s in sent]).to(x)
