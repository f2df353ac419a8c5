"""Grid sag of a net for Zemax OpticStudio: its points, its file, and the shift of the light by its interpolation.

OpticStudio interpolates between the points of a grid by bicubic Hermite patches.  Except in the end spans, a net is one
biquadratic polynomial in each knot span (optics/surfaces/bspline.py), and the patch over the four corners of the span
equals this polynomial.  A grid that includes all knots is exact there.  In end spans x is quadratic in the parameter t,
so the net is not a polynomial in x; if they reach inside the rim, the grid is refined until the shift is within
MAX_SHIFT.

`Patches` is the surface that OpticStudio interpolates.  Rays through it and through the exact face give the shift.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from scipy.interpolate import RectBivariateSpline
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.numerics.reductions import total
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.bspline import BSplineSurface, basis_matrix
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.surfaces import Surface, sag
from bstcad.optics.trace.trace import launch_strips, trace
from bstcad.report.units import number

MIN_POINTS, MAX_POINTS = 3, 4097  # smallest and largest number of points along the wider side of a table
MIN_ZEMAX_POINTS = 5  # minimum along x and y: "nx and ny values must be no smaller than 5" (OpticStudio, Grid Sag)
MAX_SHIFT = 0.1  # shift of the light (target pixels) by interpolation, up to which a grid or table is fine enough
CELLS_PER_SPAN = (1, 2, 4, 8, 16)  # grid cells per knot span; tried in this order until the grid is fine enough
MAX_FLUSH_POINTS = 1_050_000  # number of points up to which a grid that ends at the rim is preferred to a coarser one
SHIFT_RAYS = 192  # rays per side of the bundle by which a shift is measured
RIM_ROUNDING = 1e-9  # distance from the rim that counts as zero (in pitches of the net, or steps of the grid)
NEWTON_STEPS = 12  # steps of Newton's method to the intersection with the patches; smooth faces need 5
MIN_DERIVATIVE = 1e-6  # |F'| up to which a step of Newton's method divides by this number instead
HIT_TOLERANCE = 1e-9  # residual of the last step below which a ray hits the face (mm)

Pair = tuple[np.ndarray, np.ndarray]  # x and y of the points of a grid (mm)


@dataclass(frozen=True)
class GridLight:
    """Light that is traced to measure the error of a grid."""

    source: Emitter  # point source or parallel beam of one wavelength
    screens: tuple[Screen, ...]


@dataclass(frozen=True)
class Shift:
    """Shift of the light on a target that an approximation of one face of the lens causes."""

    rms: float  # RMS shift, weighted by flux (in `unit`)
    maximum: float  # largest shift (in `unit`)
    pixel: float  # shorter side of a pixel of the target (in `unit`)
    unit: str  # unit of x and y on the target

    def __str__(self) -> str:
        """Return the RMS and maximum shift in `unit` and in pixels."""
        pixels = f"{number(self.rms / self.pixel)} and {number(self.maximum / self.pixel)} target pixels"
        return f"{number(self.rms)} {self.unit} RMS, {number(self.maximum)} {self.unit} at most ({pixels})"


@dataclass(frozen=True)
class Grid:
    """Heights h of a face above a plane, and their derivatives, at each pair of x and y."""

    x: np.ndarray  # (nx,) mm, equally spaced
    y: np.ndarray  # (ny,) mm, equally spaced
    values: tuple[np.ndarray, ...]  # h, ∂h/∂x, ∂h/∂y, ∂²h/∂x∂y (mm, 1, 1, 1/mm), (nx, ny) each

    @property
    def step(self) -> tuple[float, float]:
        """Spacing of the points along x and y (mm)."""
        return tuple(float(at[-1] - at[0]) / (len(at) - 1) for at in (self.x, self.y))


@dataclass(frozen=True)
class Patches(Surface):
    """Bicubic Hermite patches: z - z0 = Σ over a cell's corners of H H h + K H Δx h_x + H K Δy h_y + K K Δx Δy h_xy.

    The first factor is a function of s (along x), the second of t (along y); s and t run from 0 to 1 across a cell.
    For the corners at s = 0, H = (1 + 2 s)(1 - s)² and K = s (1 - s)²; at s = 1, H = s² (3 - 2 s) and K = -s² (1 - s).
    """

    z: float  # position z0 of the plane from which the heights h of the grid are measured (mm)
    grid: Grid
    kind: Literal["patches"] = "patches"

    @property
    def detail(self) -> float:
        """Width of the smooth pieces (mm): the shorter side of a cell."""
        return min(self.grid.step)

    @classmethod
    def through(cls, face: Surface, x: np.ndarray, y: np.ndarray) -> Patches:
        """Return a bicubic spline through a face's heights at x, y (mm), as other programs interpolate such a table."""
        heights = sag(face, x[:, None], y[None, :]) - float(face.z)
        spline = RectBivariateSpline(x, y, heights, kx=min(3, len(x) - 1), ky=min(3, len(y) - 1))
        slopes = (spline(x, y, dx=i, dy=j) for i, j in ((1, 0), (0, 1), (1, 1)))
        return cls(float(face.z), Grid(x, y, (heights, *slopes)))

    def relative_sag_and_slope(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (z - z0 in mm, ∂z/∂x, ∂z/∂y) at (x, y) in mm; a point outside the grid is moved to its boundary."""
        (dx, dy), columns = self.grid.step, len(self.grid.y)
        i, along = _in_cell(x, self.grid.x, dx)
        j, across = _in_cell(y, self.grid.y, dy)
        h = h_x = h_y = torch.zeros_like(x)
        for (order_x, order_y), table in zip(((0, 0), (1, 0), (0, 1), (1, 1)), self.grid.values, strict=True):
            flat = torch.from_numpy(np.ascontiguousarray(table)).reshape(-1) * (dx**order_x * dy**order_y)
            for a in (0, 1):
                for b in (0, 1):
                    value = flat[(i + a) * columns + j + b]
                    (f, f_s), (g, g_t) = along[order_x][a], across[order_y][b]
                    h, h_x, h_y = h + f * g * value, h_x + f_s * g * value / dx, h_y + f * g_t * value / dy
        return h, h_x, h_y

    def crossing(self, x: Tensor, y: Tensor, direction: Tensor, sense: int = 1) -> tuple[Tensor, Tensor]:
        """Return (s in mm, hit): path length of rays from (x, y) in the plane z0 to the surface, and True for a hit.

        Newton's method: F(s) = s d_z - h(x + s d_x, y + s d_y), s ← s - F / F'.  `sense` has no effect.
        """
        dx, dy, dz = direction
        s = torch.zeros_like(x)
        for _ in range(NEWTON_STEPS):
            h, h_x, h_y = self.relative_sag_and_slope(x + s * dx, y + s * dy)
            residual, rise = s * dz - h, dz - h_x * dx - h_y * dy
            s = s - residual / torch.where(rise.abs() > MIN_DERIVATIVE, rise, torch.full_like(rise, MIN_DERIVATIVE))
        return s, residual.abs() < HIT_TOLERANCE

    def sags(self, outline: Outline) -> tuple[float, float]:
        """Return the lowest and the highest height h (mm) of all points of the grid, zero included."""
        heights = self.grid.values[0]
        return min(float(heights.min()), 0.0), max(float(heights.max()), 0.0)


Shapes = tuple[tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]], ...]


def _in_cell(at: Tensor, nodes: np.ndarray, step: float) -> tuple[Tensor, Shapes]:
    """Return the cell of each `at` between `nodes`, and H and K of Patches there, [H or K][corner]: (value, d/ds)."""
    place = ((at - float(nodes[0])) / step).clamp(0.0, len(nodes) - 1.0)
    cell = place.detach().nan_to_num(0.0).floor().clamp(0, len(nodes) - 2)
    s = place - cell
    q = 1 - s
    rise = 6 * s * q
    heights = ((1 + 2 * s) * q * q, -rise), ((3 - 2 * s) * s * s, rise)
    slopes = (s * q * q, q * (1 - 3 * s)), (-s * s * q, s * (3 * s - 2))
    return cell.long(), (heights, slopes)


# ---- the points of a grid --------------------------------------------------------------------------------------------


def axes(outline: Outline, points: int, least: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y (mm) of a grid over the outline's bounding box, with nearly square cells, centred on the axis.

    points: number of points along the wider side, both ends included.  least: smallest number along the other side.
    """
    a, b = outline.half_extent
    spacing = 2 * max(a, b) / (points - 1)
    x, y = (np.linspace(-end, end, max(least, round(2 * end / spacing) + 1)) for end in (a, b))
    return x, y


def through_knots(face: BSplineSurface, outline: Outline, parts: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Return x and y (mm) of a grid through all knots near the outline's bounding box, `parts` cells per knot span.

    None: no such grid is possible.  An inner knot t lies t + 1/2 pitches inside the net.  A grid with one cell per span
    excludes the end spans, 1.5 pitches long; the bounding box has to lie between them.
    """
    found = []
    for (low, _), pitch, m, half in zip((face.x, face.y), face.pitch, face.shape, outline.half_extent, strict=True):
        places = np.arange(m - 3) + 1.5 if parts == 1 else np.arange(parts * (m - 1) + 1) / parts  # pitches
        first = np.searchsorted(places, (-half - low) / pitch + RIM_ROUNDING, "right") - 1
        last = np.searchsorted(places, (half - low) / pitch - RIM_ROUNDING, "left")
        if first < 0 or last >= len(places) or not MIN_ZEMAX_POINTS <= last - first + 1 <= MAX_POINTS:
            return None
        found.append(low + pitch * places[first : last + 1])
    return found[0], found[1]


def _is_flush(x: np.ndarray, y: np.ndarray, outline: Outline) -> bool:
    """Return True if a grid ends at the outline's bounding box; most nets have a knot or a span's centre there."""
    box = zip((x, y), outline.half_extent, strict=True)
    return all(max(abs(at[0] + half), abs(at[-1] - half)) < RIM_ROUNDING * (at[1] - at[0]) for at, half in box)


def on_grid(face: BSplineSurface, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return (z - face.z, ∂z/∂x, ∂z/∂y, ∂²z/∂x∂y) (mm, 1, 1, 1/mm) of a face at each pair of x and y (mm).

    z = Σ_i Σ_j B_i(u(x)) B_j(v(y)) h_ij (Wang et al. 2023, Eq. 2) is a product of three matrices on a grid, and each
    derivative is the same product with derivatives of one or both bases.
    """
    bases = []
    for at, (low, _), pitch, m in zip((x, y), (face.x, face.y), face.pitch, face.shape, strict=True):
        u = np.clip((at - low) / pitch, 0.0, m - 1.0)
        bases.append((basis_matrix(u, m), basis_matrix(u, m, derivative=1) / pitch))
    (b_x, d_x), (b_y, d_y) = bases
    heights = face.plain().heights.numpy()
    along, across = b_x @ heights, d_x @ heights  # (len(x), n)
    return (b_y @ along.T).T, (b_y @ across.T).T, (d_y @ along.T).T, (d_y @ across.T).T


# ---- the light -------------------------------------------------------------------------------------------------------


@torch.no_grad()
def shift_between(lens: Lens, other: Lens, light: GridLight) -> Shift | None:
    """Return the shift between the light of two lenses, on the target where its RMS is largest in pixels.

    None: no light reaches any target.
    """
    found = []
    for screen in light.screens:
        square = weight = largest = 0.0
        for rays in launch_strips(light.source, lens, SHIFT_RAYS, 0):
            one, two = (trace(rays, each, screen.receiver) for each in (lens, other))
            flux = torch.where(one.alive & two.alive, one.flux, torch.zeros_like(one.flux))
            squares = torch.where(flux > 0, ((two.position - one.position) ** 2).sum(0), torch.zeros_like(flux))
            square, weight = square + float(total(flux * squares)), weight + float(total(flux))
            largest = max(largest, float(squares.max())) if squares.numel() else largest  # a strip may launch no rays
        pixel = min((screen.x[1] - screen.x[0]) / screen.columns, (screen.y[1] - screen.y[0]) / screen.rows)
        found += [Shift((square / weight) ** 0.5, largest**0.5, pixel, screen.receiver.unit)] if weight else []
    return max(found, key=lambda each: each.rms / each.pixel, default=None)


def shift_by_patches(lens: Lens, face: Surface, patches: Patches, light: GridLight) -> Shift | None:
    """Return the shift of the light if `patches` replace `face` of a lens; None: no light reaches any target."""
    plain = replace(lens, losses=None, tailored=None)
    return shift_between(plain, plain.with_surface(lens.name_of(face), patches), light)


# ---- the file --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class GridSag:
    """Grid for OpticStudio, and the shift of the light that interpolation of the grid causes."""

    face: BSplineSurface
    grid: Grid
    shift: Shift | None  # None: not measured, or no light reaches the target

    @classmethod
    def of(cls, lens: Lens, face: BSplineSurface, points: int | None = None, light: GridLight | None = None) -> GridSag:
        """Return a grid, `points` along the wider side, or if None through the knots, as fine as MAX_SHIFT requires."""
        if points is not None:
            return cls._at(lens, face, axes(lens.outline, max(points, MIN_ZEMAX_POINTS), MIN_ZEMAX_POINTS), light)
        grids = [at for parts in CELLS_PER_SPAN if (at := through_knots(face, lens.outline, parts)) is not None]
        flush = [(x, y) for x, y in grids[:2] if _is_flush(x, y, lens.outline) and len(x) * len(y) <= MAX_FLUSH_POINTS]
        best = None
        for at in (*flush, *grids):
            best = cls._at(lens, face, at, light)
            if best.shift is None or best.shift.maximum <= MAX_SHIFT * best.shift.pixel:
                return best
        return best or cls.of(lens, face, min(2 * max(face.shape), MAX_POINTS), light)

    @classmethod
    def _at(cls, lens: Lens, face: BSplineSurface, at: Pair, light: GridLight | None) -> GridSag:
        found = cls(face, Grid(*at, on_grid(face, *at)), None)
        return found if light is None else replace(found, shift=shift_by_patches(lens, face, found.patches, light))

    @property
    def patches(self) -> Patches:
        """Surface that OpticStudio interpolates from the grid."""
        return Patches(self.face.z, self.grid)

    def text(self) -> str:
        """Return the text of the file (.DAT).

        Header: nx ny, spacings in x and y, unit (0: mm), decentre in x and y.  Then one line per point, from (-x, +y)
        along +x and downwards: sag above the vertex, ∂z/∂x, ∂z/∂y, ∂²z/∂x∂y, all exact, and 0 (the point is valid).
        """
        (x, y), (dx, dy) = (self.grid.x, self.grid.y), self.grid.step
        vertex = float(sag(self.face, 0.0, 0.0)) - self.face.z
        height, *slopes = self.grid.values
        columns = [values.T[::-1].ravel() for values in (height - vertex, *slopes)]
        decentre = ((at[0] + at[-1]) / 2 if abs(at[0] + at[-1]) > 1e-9 * step else 0 for at, step in ((x, dx), (y, dy)))
        text = io.StringIO()
        text.write(f"{len(x)} {len(y)} {dx:.17g} {dy:.17g} 0 {' '.join(f'{c:.17g}' for c in decentre)}\n")
        np.savetxt(text, np.column_stack(columns), fmt="%.17g %.17g %.17g %.17g 0")
        return text.getvalue()

    def note(self, name: str) -> str:
        """Return a sentence on the grid in the file `name` and on the shift of the light by its interpolation."""
        (dx, dy), grid = self.grid.step, self.grid
        size = f"{name}: {len(grid.x)} x {len(grid.y)} points, spacing {dx:.6g} x {dy:.6g} mm"
        if self.shift is None:
            return f"{size}."
        coarse = self.shift.maximum > MAX_SHIFT * self.shift.pixel
        advice = "; without --points the grid goes through the knots" if coarse else ""
        return f"{size}; bicubic interpolation moves the light on the target by {self.shift}{advice}."


def table_note(lens: Lens, face: Surface, name: str, *, points: int, light: GridLight) -> str:
    """Return a sentence on the shift of the light by a bicubic spline through a face's heights in the table `name`."""
    by = shift_by_patches(lens, face, Patches.through(face, *axes(lens.outline, points)), light)
    if by is None:
        return f"{name}: no light reaches the target."
    coarse = f"; zemax-{lens.name_of(face)}.dat and lens.step are exact" if by.maximum > MAX_SHIFT * by.pixel else ""
    return f"{name}: a bicubic spline through its heights moves the light on the target by {by}{coarse}."
