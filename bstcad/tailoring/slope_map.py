"""The transport map of stage 1: optimal transport from points of a face to its slopes, a map that a surface can follow.

The map of Wang et al. 2023 leads from source points to target points.  The slopes that it needs are a gradient only in
the paraxial limit; off axis, a fit to them loses the part that no surface can follow.  Here the transport problem is
solved between points of the face and slopes, which are a gradient.  A ray that meets the last freeform face at b and
shall reach the target point t needs the slope p(b, t), which follows from Snell's law or the law of reflection in
closed form.  Let m be the centroid of the light on the target, and g a surface fitted to the slopes p(b, m), which
nearly sends all light to m.  The coordinate

    y = σ (p(b, t) - ∇g(b))

hardly depends on b for a fixed t.  The optimal transport map b -> y is ∇φ of a convex φ, so that σ y + ∇g are the
slopes of a surface.  σ = 1 where light leaves the glass.  Mirrors, and faces where light enters the glass, deflect
light against their slope: there σ = -1, so that rays of neighbouring points do not cross.  If there are surfaces behind
the net, light is aimed at the image of the target through them (optics/trace/unfolding.py).  y still depends on b a
little, in proportion to t - m.  Therefore each round computes y(t) at the b(t) of the previous round, and the rounds
are a fixed-point iteration.  At the fixed point the surface solves the Monge-Ampère problem of the system, also off
axis, in the near field and behind a curved front; g does not change it.

`map_to_target` and `aim_points` give the map of the paper, from the vertex plane of the first surface to the target,
and the aim of each ray.  Stage 1 falls back on this map, and the baselines use it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.lens.interfaces import Reflect
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.charts import HEIGHTS
from bstcad.optics.surfaces.outlines import Outline, Rectangle
from bstcad.optics.surfaces.rays import Rays
from bstcad.optics.surfaces.sides import Sides, as_pair
from bstcad.optics.trace.reach import MAX_EXIT_ANGLE, limit_refraction, reach_margin, wanted_slopes
from bstcad.optics.trace.trace import across, behind, clear_window, is_transmitted
from bstcad.optics.trace.tubes import rays_to
from bstcad.optics.trace.unfolding import image_screen
from bstcad.runs.files import SceneError
from bstcad.tailoring.effort import GATHERING, Gathering
from bstcad.tailoring.slope_fit import Fit, blocks, fit_slopes, monomials, with_polynomial
from bstcad.transport.density import Density, resample_flux
from bstcad.transport.mapping import AT_ENTRANCE, AT_FACE, Frame, Mapping, Points, TransportMap, nodes, solve
from bstcad.transport.mapping import Solver as Solver  # exported to packages that may not import transport

SUBCELLS = 2  # samples of the light per axis in a transport cell, since a rim may cross the cell
SUBPIXELS = 8  # number of pixel parts per axis in a transport cell; a pixel has at least one part
SLOPE_FLOOR = 1e-3  # smallest density of light over slopes, relative to its mean: the solver needs light in black parts
GATHERING_NET = 33  # control points per side of g
GATHERING_WIDTH = (GATHERING_NET - 1) / (GATHERING_NET - 5)  # width of g / width of the window: end spans lie outside
PARABOLOID_FIT = Fit(steps=0, degree=2)  # fit of g by a paraboloid, if no face can send all light to m
BENDING_DEGREE, BENDING_STEP = 8, 1e-3  # degree of g on a dome; step of its differences / width of the window
BENT_SHARE = 0.5  # share of a round's b(t) on a dome; with all of it large deflections make the rounds diverge
TARGET_FLOOR = 1e-3  # smallest irradiance of the target in the map of the paper, relative to its mean

Slopes = tuple[Tensor, Tensor]  # ∂z/∂x and ∂z/∂y, of one shape


@dataclass(frozen=True)
class FaceGrid:
    """Rays and flux density at the cell centres of a rectangle of the last freeform face."""

    window: Rectangle  # rectangle in x and y about the axis (mm)
    at_face: Rays  # (3, m, n) rays before the face: position on the face, direction of incidence
    density: Tensor  # (m, n) flux per mm² of the x-y plane

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells along x and along y."""
        m, n = self.density.shape
        return m, n

    def thinned(self, samples: int) -> FaceGrid:
        """Return the grid with every k-th cell along each axis; at least `samples` cells, or all, are left on each."""
        thin = tuple(slice(step // 2, None, step) for step in (max(1, n // samples) for n in self.shape))
        position, direction = (v[:, *thin] for v in (self.at_face.position, self.at_face.direction))
        return FaceGrid(self.window, replace(self.at_face, position=position, direction=direction), self.density[thin])


@torch.no_grad()
def face_grid(source: Emitter, lens: Lens, window: Rectangle, cells: Sides) -> FaceGrid:
    """Return the rays that meet the last freeform face at the cell centres of a window; cells: number per side.

    The flux density is the irradiance from the source on the vertex plane of the first surface times |∂q/∂b|, where
    the ray through b crosses this plane at q, minus the losses before and at this face.
    """
    x, y = (t.to(lens.like.device) for t in sampling.grid(window, cells))
    number = lens.tailored_numbers[-1]
    q_x, q_y, at_face = rays_to(source, lens, x=x, y=y, number=number)
    coming = across(source.rays_through(q_x, q_y, lens.entrance.z, 1.0), lens.interfaces[:number])
    steps = tuple(side / n for side, n in zip((window.width, window.height), as_pair(cells), strict=True))
    xx, xy = torch.gradient(q_x, spacing=steps)
    yx, yy = torch.gradient(q_y, spacing=steps)
    through = lens.last_tailored.outline.contains(x, y) & coming.alive & at_face.alive
    lossless = lens.losses is None
    density = source.irradiance(q_x, q_y, lens.entrance.z) if lossless else behind(coming, lens.last_tailored).flux
    density = density * (xx * yy - xy * yx).abs() * through
    return FaceGrid(window, at_face, density)


def lit_window(source: Emitter, lens: Lens, n: int = 128) -> Rectangle:
    """Return the lit rectangle of the last freeform face, with a margin, found on n x n cells; SceneError if unlit."""
    half_x, half_y = lens.last_tailored.outline.half_extent
    grid = face_grid(source, lens, Rectangle(2 * half_x, 2 * half_y), n)
    lit = grid.density > 0
    if not bool(lit.any()):
        raise SceneError(
            "source: no ray reaches the tailored face; move the source away from the front, or lower lens.back.z"
        )
    x, y = grid.at_face.places
    x_max, y_max = (float(p.abs()[lit].max()) + 2.5 * 2 * half / n for p, half in ((x, half_x), (y, half_y)))
    return Rectangle(2 * min(x_max, half_x), 2 * min(y_max, half_y))


@dataclass(frozen=True)
class SlopeMap:
    """Transport map b -> y = ∇φ(b); the slope needed at b is σ y + ∇g(b)."""

    mapping: Mapping  # map from points of the last freeform face (mm) to y (dimensionless)
    gathering: BSplineSurface  # surface g
    sign: float  # sign σ, 1 or -1
    face_points: Points  # b (mm) for the corners of the target's pixels, (columns + 1, rows + 1)
    moved: float  # RMS change of b in the last round at lit corners / half side of the `square_grid`; NaN: first round

    def slopes(self, x: Tensor, y: Tensor) -> Slopes:
        """Return the slopes (∂z/∂x, ∂z/∂y) needed at points x, y (n,) of the last freeform face (mm)."""
        sent = self.mapping(x.cpu().double().numpy(), y.cpu().double().numpy())
        mapped = (torch.from_numpy(np.ascontiguousarray(s)).to(x) for s in sent)
        _, *gathering = self.gathering.relative_sag_and_slope(x.cpu().double(), y.cpu().double())
        z_x, z_y = (self.sign * s + g.to(x) for s, g in zip(mapped, gathering, strict=True))
        return z_x, z_y


def slope_map(
    lens: Lens, grid: FaceGrid, goal: Goal, previous: SlopeMap | None, solver: Solver, effort: Gathering = GATHERING
) -> SlopeMap:
    """Return the slope map of one round, for the sag of `lens`.

    grid: `square_grid` of the lit window.  previous: map of the last round, which gives b(t); None: b = 0.
    effort: of the fit of g.
    """
    picture, screen, law = goal.picture, image_screen(lens, goal.screen), lens.last_tailored.law
    t = pixel_corners(screen)
    flat = grid.at_face.chart is HEIGHTS
    if previous:
        b = previous.face_points
    else:
        b = (np.zeros_like(t[0]), np.zeros_like(t[1])) if flat else straight_points(grid, screen, lit_corners(picture))
    if flat:
        g = gathering(grid, lens, screen.receiver, centroid(picture, screen), effort=effort)
    else:
        g = bending(grid, lens, screen.receiver, t, points=b, lit=lit_corners(picture))
    needed = wanted_slopes(rays_at(grid, b), torch.from_numpy(np.stack(t)), screen.receiver, law)
    sign = -1.0 if law.reverses or law.eta < 1 else 1.0
    found = transport_slopes(grid, picture, g, needed, points=b, sign=sign, solver=solver)
    if not flat:
        x, y = (BENT_SHARE * now + (1 - BENT_SHARE) * old for now, old in zip(found.face_points, b, strict=True))
        found = replace(found, face_points=(x, y))
    return found if previous else replace(found, moved=math.nan)


def straight_points(grid: FaceGrid, screen: Screen, lit: np.ndarray) -> Points:
    """Return b for the pixel corners: points of the chart in the directions of the target, scaled to the lit window."""
    aim = torch.from_numpy(np.stack(pixel_corners(screen)))
    centre = Rays(torch.zeros_like(aim[:1]).expand(3, *aim.shape[1:]), aim, aim[0], aim[0], z=grid.at_face.z)
    x, y, _ = (p.numpy() for p in grid.at_face.chart.coordinates(screen.receiver.vector_to(centre, aim)))
    scale = min(grid.window.width, grid.window.height) / 2 / float(np.hypot(x, y)[lit].max())
    return scale * x, scale * y


def square_grid(source: Emitter, lens: Lens, window: Rectangle, n: int) -> FaceGrid:
    """Return the `face_grid` of a square around a window, with SUBCELLS² cells in each of n x n transport cells."""
    side = max(window.width, window.height)
    grid = face_grid(source, lens, Rectangle(side, side), n * SUBCELLS)
    if grid.at_face.chart is HEIGHTS:
        return grid
    return replace(grid, density=shared_at_rim(grid.density, lens.last_tailored.outline, grid))


def shared_at_rim(density: Tensor, outline: Outline, grid: FaceGrid) -> Tensor:
    """Return the density (m, n) in which cells across the rim of the face have the share of their area inside it.

    The share is 1/2 + d / w, from 0 to 1: d the distance of the centre from the rim (positive inside), w the width of
    the cell towards the rim, in the direction of the centre from the axis.  A cell whose centre lies outside has the
    mean density of its lit neighbours.  Without this, the rim of the light is a staircase of cells: the rim of a dome
    was 2e-4 of its radius off.
    """
    x, y = grid.at_face.places
    step = grid.window.width / density.shape[0]
    around = torch.nn.functional.avg_pool2d(
        torch.stack([density, (density > 0).to(density)])[:, None], 3, stride=1, padding=1, divisor_override=1
    )
    flux, lit = around[:, 0]
    inside = outline.contains(x, y)
    whole = torch.where(inside, density, flux / lit.clamp(min=1.0))
    r = torch.hypot(x, y).clamp(min=step)
    depth = torch.from_numpy(outline.depth(x.cpu().double().numpy(), y.cpu().double().numpy())).to(x)
    return whole * (0.5 + depth / (step * (x.abs() + y.abs()) / r)).clamp(0.0, 1.0)


def transport_slopes(
    grid: FaceGrid, picture: np.ndarray, g: BSplineSurface, needed: Slopes, points: Points, sign: float, solver: Solver
) -> SlopeMap:
    """Return the map from the light of a `square_grid` to a picture, given the slopes needed for its pixel corners.

    needed: slopes p(b, t) for the pixel corners t.  points: b (mm) of these corners in the last round.  sign: σ.
    """
    side, n = grid.window.width, grid.shape[0] // SUBCELLS
    rho = grid.density.cpu().double().numpy().reshape(n, SUBCELLS, n, SUBCELLS).mean((1, 3))
    _, *gathered = g.relative_sag_and_slope(*(torch.from_numpy(p) for p in points))
    y_x, y_y = (sign * (p - s).numpy() for p, s in zip(needed, gathered, strict=True))
    sigma, frame = resample_picture(picture, (y_x, y_y), n)
    mapping = solve(light_density(rho, side), sigma, Frame((0.0, 0.0), side), frame, solver=solver)
    now = mapping.inverse(y_x, y_y)
    lit = lit_corners(picture)
    x, y = ((after - before)[lit] for after, before in zip(now, points, strict=True))
    return SlopeMap(mapping, g, sign, now, moved=float(np.sqrt(np.mean(x * x + y * y))) / (side / 2))


def fit_to_map(
    lens: Lens, slopes: SlopeMap, grid: FaceGrid, fit: Fit, parts: int = 1, grazing: float = MAX_EXIT_ANGLE
) -> Lens:
    """Return the lens whose last net is fitted to the slopes of a map by least squares; its vertex stays.

    A map may send a little light further than the face can, into the black around a picture; the slopes are limited so
    that this light leaves at the angle `grazing` (rad).  Points with light have the weight 1.  Points without light
    have the weight `fit.unlit` and their present slopes; with 0 only the bending energy shapes their surroundings.
    parts: points per axis in each cell of the grid.
    """
    m, n = grid.shape
    centres = sampling.grid(grid.window, (parts * m, parts * n))
    x, y = (p.to(grid.density.device).reshape(-1) for p in centres)
    lit = (grid.density > 0).repeat_interleave(parts, 0).repeat_interleave(parts, 1).reshape(-1)
    net = lens.nets[-1]
    z_x, z_y = torch.empty_like(x), torch.empty_like(y)
    for some in blocks(len(x)):
        _, *now = net.relative_sag_and_slope(x[some], y[some])
        b_x, b_y = (p[some].cpu().double().numpy() for p in (x, y))
        p_x, p_y = (s.cpu().double() for s in slopes.slopes(x[some], y[some]))
        reachable = limit_refraction(rays_at(grid, (b_x, b_y)), (p_x, p_y), lens.last_tailored.law, grazing)
        for z, needed, present in zip((z_x, z_y), reachable, now, strict=True):
            z[some] = torch.where(lit[some], needed.to(x), present)
    weight = torch.where(lit, 1.0, fit.unlit).to(x)
    fitted = fit_slopes(net, x, y, z_x=z_x, z_y=z_y, weight=weight, fit=fit)
    return lens.with_last_net(fitted.from_vertex().moved(net.z))


def centroid(picture: np.ndarray, screen: Screen) -> tuple[float, float]:
    """Return the centroid (x, y) of a picture on its screen, in the receiver's unit; row 0 = y max."""
    sums = picture.sum(0), picture.sum(1)[::-1]
    share_x, share_y = (float(((np.arange(len(s)) + 0.5) * s).sum() / s.sum()) / len(s) for s in sums)
    (left, right), (low, high) = screen.x, screen.y
    return left + share_x * (right - left), low + share_y * (high - low)


def gathering(
    grid: FaceGrid, lens: Lens, receiver: Receiver, middle: tuple[float, float], effort: Gathering
) -> BSplineSurface:
    """Return g, the net of GATHERING_NET points per side whose slopes fit p(b, m) best over the lit part of a grid.

    The slopes p(b, m) themselves are in general not exactly the gradient of a surface.  middle: m on the receiver.
    """
    few, law = grid.thinned(effort.samples), lens.last_tailored.law
    x, y = few.at_face.places
    aim = torch.stack([torch.full_like(x, m) for m in middle])
    reaches = reach_margin(few.at_face, aim, receiver, law=law) >= 0  # False: the slope is a placeholder
    fit = effort.fit if few.at_face.chart is not HEIGHTS or bool(reaches[few.density > 0].all()) else PARABOLOID_FIT
    return fit_gathering(few, wanted_slopes(few.at_face, aim, receiver, law), fit)


def bending(
    grid: FaceGrid, lens: Lens, receiver: Receiver, corners: Points, *, points: Points, lit: np.ndarray
) -> BSplineSurface:
    """Return g whose second derivatives fit those of the slopes p(b, t) in b best, at the pairs b(t) of a round.

    Where light is deflected by large angles, ∂p/∂b depends on t so much that the slopes towards one point m do not
    serve: rounds with them diverge.  With this g the coordinate y of a target point hardly depends on b near b(t).
    corners, points: t and b of the target's pixel corners.  lit: True at the corners that count.
    """
    half_x, half_y = (GATHERING_WIDTH * size / 2 for size in (grid.window.width, grid.window.height))
    flat = torch.zeros((GATHERING_NET, GATHERING_NET), dtype=torch.float64)
    net, law = BSplineSurface(0.0, flat, (-half_x, half_x), (-half_y, half_y)), lens.last_tailored.law
    few = tuple(slice(None, None, max(1, n // GATHERING.samples)) for n in lit.shape)
    x, y, *aims = (p[few][lit[few]] for p in (*points, *corners))
    aim, step = torch.from_numpy(np.stack(aims)), BENDING_STEP * grid.window.width

    def derivatives(slopes: Callable[[np.ndarray, np.ndarray], Slopes]) -> tuple[Tensor, ...]:
        """Return ∂p_x/∂x, √2 times the mean of ∂p_x/∂y and ∂p_y/∂x, and ∂p_y/∂y by central differences."""
        right, left, up, down = (slopes(x + i * step, y + j * step) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1)))
        xx, yx = ((a - b) / (2 * step) for a, b in zip(right, left, strict=True))
        xy, yy = ((a - b) / (2 * step) for a, b in zip(up, down, strict=True))
        return xx, (xy + yx) / math.sqrt(2), yy

    def needed(x: np.ndarray, y: np.ndarray) -> Slopes:
        return wanted_slopes(rays_at(grid, (x, y)), aim, receiver, law)

    def of_net(heights: Tensor) -> tuple[Tensor, ...]:
        surface = replace(net, heights=heights)
        return derivatives(lambda x, y: surface.relative_sag_and_slope(torch.from_numpy(x), torch.from_numpy(y))[1:])

    weight = torch.full((len(x),), 1 / len(x), dtype=torch.float64)
    heights = with_polynomial(flat, monomials(net, BENDING_DEGREE), of_net, data=derivatives(needed), weight=weight)
    return replace(net, heights=heights)


def fit_gathering(grid: FaceGrid, slopes: Slopes, fit: Fit) -> BSplineSurface:
    """Fit a net of GATHERING_NET points per side to slopes at the lit cell centres of a grid."""
    half_x, half_y = (GATHERING_WIDTH * size / 2 for size in (grid.window.width, grid.window.height))
    flat = torch.zeros((GATHERING_NET, GATHERING_NET), dtype=torch.float64)
    net = BSplineSurface(0.0, flat, (-half_x, half_x), (-half_y, half_y))
    samples = (*grid.at_face.places, *slopes, grid.density > 0)
    x, y, z_x, z_y, weight = (p.reshape(-1).cpu().double() for p in samples)
    return fit_slopes(net, x, y, z_x=z_x, z_y=z_y, weight=weight, fit=fit)


def interpolate(grid: FaceGrid, values: Tensor, b: Points) -> Tensor:
    """Interpolate values (k, m, n) at cell centres bilinearly to points b (…) mm, constant outside; return (k, …)."""
    sizes = (grid.window.width, grid.window.height)
    x, y = (torch.from_numpy(p) / (size / 2) for p, size in zip(b, sizes, strict=True))
    where = torch.stack([y, x], dim=-1)  # -1 to 1 across the window; the last axis of the values comes first
    found = torch.nn.functional.grid_sample(
        values.cpu().double()[None], where.reshape(1, 1, -1, 2), padding_mode="border", align_corners=False
    )
    return found.view(len(values), *x.shape)


def rays_at(grid: FaceGrid, b: Points) -> Rays:
    """Return the rays that meet the face at points b (mm), with sag and direction interpolated from the grid."""
    chart = grid.at_face.chart
    *_, height = chart.coordinates(grid.at_face.position)
    sag, d_x, d_y, d_z = interpolate(grid, torch.cat([height[None], grid.at_face.direction]), b)
    position = chart.point(torch.from_numpy(b[0]), torch.from_numpy(b[1]), sag)
    direction = torch.stack([d_x, d_y, d_z]) / torch.sqrt(d_x * d_x + d_y * d_y + d_z * d_z)
    return replace(grid.at_face, position=position, direction=direction)


def map_from_face(points: Points, screen: Screen) -> TransportMap:
    """Return the inverse map, from the target's pixel corners to the points (mm) of the last tailored face.

    points: x and y, each (columns + 1, rows + 1).  The plane of the map is AT_FACE.
    """
    x, y = (np.linspace(*ends, n + 1) for ends, n in ((screen.x, screen.columns), (screen.y, screen.rows)))
    i, j = nodes(screen.columns), nodes(screen.rows)
    source = np.stack([p[np.ix_(i, j)] for p in points], axis=-1)
    return TransportMap(x[i], y[j], source.astype(np.float32), AT_FACE)


def pixel_corners(screen: Screen) -> Points:
    """Return x and y of the corners of the pixels, in the receiver's unit, each (columns + 1, rows + 1), x first."""
    sides = np.linspace(*screen.x, screen.columns + 1), np.linspace(*screen.y, screen.rows + 1)
    x, y = np.meshgrid(*sides, indexing="ij")
    return x, y


def resample_picture(picture: np.ndarray, corners: Points, n: int) -> tuple[Density, Frame]:
    """Return the density of a picture on n x n cells of the smallest square around its lit corners, and the square."""
    lit = lit_corners(picture)
    low, high = (np.array([f(c[lit]) for c in corners]) for f in (np.min, np.max))
    x_mean, y_mean = (low + high) / 2
    frame = Frame((x_mean, y_mean), float((high - low).max()))
    flux = np.ascontiguousarray(picture[::-1].T)  # row 0 is y max
    columns, rows = (max(1, round(SUBPIXELS * n / pixels)) for pixels in flux.shape)
    x, y = (np.ascontiguousarray(n * c) for c in frame.to_unit(*corners))
    return Density.from_values(resample_flux(flux, x, y, n=n, parts=(columns, rows)), floor=SLOPE_FLOOR), frame


def light_density(values: np.ndarray, side: float, lens: Lens | None = None) -> Density:
    """Return the density of light from `values` (n, n) on a square of `side` mm; SceneError if all of them are zero.

    lens: lens whose elements the light has passed; None: light that has not passed them.
    """
    if not values.any():
        for key, width in narrow_elements(lens, side / len(values)) if lens else ():
            raise SceneError(
                f"{key}.outline: is {width:.3g} mm wide, and no light of the {side:.3g} mm at the lens passes it; "
                "make it wider"
            )
        raise SceneError(
            f"source: its light at the lens is a strip narrower than a cell ({side / len(values):.3g} mm) of the "
            "square transport grid; make the lit part of lens.outline less oblong, or raise tailoring.transport_grid"
        )
    return Density.from_values(values)


def narrow_elements(lens: Lens, width: float) -> Iterator[tuple[str, float]]:
    """Yield key and width (mm) of each window and mirror of a scene that is narrower than `width` (mm)."""
    for name, interfaces in (("before", lens.before), ("behind", lens.behind)):
        number = 0.0  # number of the element: a window has two interfaces, a mirror one
        for interface in interfaces:
            across = 2 * min(interface.outline.half_extent)
            if across < width:
                yield f"{name}[{int(number)}]", across
            number += 1.0 if isinstance(interface.law, Reflect) else 0.5


def lit_corners(picture: np.ndarray) -> np.ndarray:
    """Return True at the corners of all pixels that are not black, (columns + 1, rows + 1), x first."""
    lit = np.pad(picture[::-1].T > 0, 1)  # row 0 is y max
    return lit[1:, 1:] | lit[1:, :-1] | lit[:-1, 1:] | lit[:-1, :-1]


@torch.no_grad()
def map_to_target(source: Emitter, lens: Lens, goal: Goal, n: int, solver: Solver) -> Mapping:
    """Return the transport map of the paper, from the vertex plane of the first surface (mm) to the target (mm).

    The map is solved on n x n cells, for the light that passes all faces.  A tilted target is projected from the vertex
    of the front onto the plane z = const through its centre: in the coordinates of the target, the map that a surface
    can realise is not close to a gradient.
    """
    picture, screen = goal.picture, image_screen(lens, goal.screen)
    area = clear_window(source, lens)
    side = max(area.width, area.height)
    x, y = (t.to(lens.like.device) for t in sampling.grid(Rectangle(side, side), n * SUBCELLS))
    flux = source.irradiance(x, y, lens.entrance.z)
    flux = flux * is_transmitted(source.rays_through(x, y, lens.entrance.z, 1.0), lens)
    density = light_density(flux.cpu().numpy().reshape(n, SUBCELLS, n, SUBCELLS).mean((1, 3)), side, lens)
    if not screen.receiver.is_level:
        target, frame = resample_picture(
            picture, screen.receiver.to_level_plane(*pixel_corners(screen), lens.front.z), n
        )
    else:
        width, height = screen.x[1] - screen.x[0], screen.y[1] - screen.y[0]
        target = Density.from_picture(picture, n, width=width, height=height, floor=TARGET_FLOOR)
        frame = Frame(((screen.x[0] + screen.x[1]) / 2, (screen.y[0] + screen.y[1]) / 2), max(width, height))
    return solve(density, target, Frame((0.0, 0.0), side), frame, solver=solver)


def map_from_entrance(mapping: Mapping, lens: Lens, screen: Screen) -> TransportMap:
    """Return the inverse of the map of `map_to_target` at the corners of the target's pixels."""
    screen = image_screen(lens, screen)
    corners = pixel_corners(screen)
    if not screen.receiver.is_level:
        corners = screen.receiver.to_level_plane(*corners, lens.front.z)
    return replace(map_from_face(mapping.inverse(*corners), screen), plane=AT_ENTRANCE)


def aim_points(mapping: Mapping, lens: Lens, screen: Screen, x: Tensor, y: Tensor) -> Tensor:
    """Return the points of the screen (2, …), in its unit, to which the map of `map_to_target` sends x, y (…) mm."""
    screen, sent = image_screen(lens, screen), mapping(*(p.detach().cpu().double().numpy() for p in (x, y)))
    if not screen.receiver.is_level:
        sent = screen.receiver.from_level_plane(*sent, lens.front.z)
    return torch.stack([torch.from_numpy(np.ascontiguousarray(s)) for s in sent]).to(x)


# --- an earlier lens --------------------------------------------------------------------------------------------------

CARRIED_CELLS = 128  # points per side of the grid for `carry_light`
CARRIED_FIT = Fit(bending=1e-3, steps=20, degree=5)  # fit of the change


@torch.no_grad()
def carry_light(source: Emitter, before: Lens, after: Lens, goal: Goal) -> Lens:
    """Return `after`, whose last net is that of `before`, with slopes that send each ray where it landed before.

    source: with the index of both lenses set for its wavelength.  goal: target, for its receiver.  Both lenses have the
    same last net, but another front, thickness or index, so that a ray meets this net elsewhere and in another
    direction.  At points b of the net the slope p(b, t) sends the new ray to the target point t of the earlier ray.  A
    fit adds the change of the slopes to the net; the change is smooth even if the net is not, so that one fit on a
    coarse grid does for a relief of any fineness.  The rays through b come from elsewhere on the source's cone, so that
    the flux at t changes a little; stage 2 corrects this.
    """
    window = lit_window(source, after)
    seen, receiver = (image_screen(lens, goal.screen).receiver for lens in (before, after))
    old, new = (face_grid(source, lens, window, CARRIED_CELLS) for lens in (before, after))
    landed = seen.land(behind(old.at_face, before.last_tailored))
    aim = torch.stack(list(landed.position))
    lit = (old.density > 0) & (new.density > 0) & landed.alive
    wanted = torch.where(lit, aim, torch.zeros_like(aim))
    needed = wanted_slopes(new.at_face, wanted, receiver, after.last_tailored.law)
    x, y, z_x, z_y = (part[lit] for part in (*new.at_face.places, *needed))
    net = after.nets[-1]
    fitted = fit_slopes(net, x, y, z_x=z_x, z_y=z_y, weight=torch.ones_like(x), fit=CARRIED_FIT)
    return after.with_last_net(fitted.from_vertex().moved(net.z))
