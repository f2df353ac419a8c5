"""The independent judge of folders (independent.py) for domes: rays from the source through a radial net, by numba.

It shares no code with bstcad.  The net comes from the text of the STEP file (independent_dome.read_dome), front and
edges from OpenCASCADE.  Rays leave the source as points of a scrambled Sobol sequence: two of four coordinates are the
direction, whose flux is the same for all, and two the place on the source's extent.

Lengths in mm.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from OCP.BRepAdaptor import BRepAdaptor_Curve
from OCP.TopAbs import TopAbs_EDGE
from OCP.TopoDS import TopoDS
from scipy.spatial import cKDTree

from tests.benchmarks import independent_dome
from tests.benchmarks.independent import (
    EDGE_POINTS,
    SAME,
    Border,
    Conic,
    Declined,
    _explored,
    border_from,
    border_of,
    conic_of,
    faces,
    inside,
    refracted,
    transmitted,
)

TABLE = 1025  # places per side of the table of starts
MARCH = 64  # points along a ray at which its distance is compared with the dome's
STEPS = 40  # largest number of Newton steps


class Net(NamedTuple):
    """A B-spline surface of degree 2 about a centre, and a table of it over directions."""

    poles: np.ndarray  # (m, n, 3) mm
    knots_u: np.ndarray
    knots_v: np.ndarray
    centre: np.ndarray  # (3,) mm
    starts: np.ndarray  # (TABLE, TABLE, 3) u, v and distance (mm) of the surface near each direction of the table
    half: float  # half width of the table: its directions have |d_xy| / (1 + d_z) up to there
    nearest: float  # smallest distance of the surface from the centre, mm
    farthest: float


class Lens(NamedTuple):
    """The faces of a dome."""

    net: Net
    rim: Border  # border of the back over d_xy / (1 + d_z) of directions from the centre
    front: Conic
    edge: Border  # border of the front over x and y


def lens_of(folder, scene):
    """The Lens of a folder; its net has to be that of design.npz, but for the shift of part.step."""
    path = folder / ("part.step" if scene.get("mount") else "lens.step")
    found, centre = faces(path), np.array(scene["lens"]["back"]["centre"], float)
    if scene["lens"]["front"]["kind"] not in ("plane", "sphere", "conic"):
        raise Declined("a dome with another front than a plane, sphere or conic")
    dome = independent_dome.read_dome(path.read_text())
    with np.load(folder / "design.npz") as kept:
        off = dome.poles - kept["control_points"]
    lower = float(off[..., 2].mean())
    assert np.abs(off - (0.0, 0.0, lower)).max() < SAME
    net = net_of(dome._replace(poles=dome.poles - (0.0, 0.0, lower), centre=centre))
    (back,), (front,) = found["back"], found["front"]

    def from_centre(x, y, z):
        rho = np.sqrt(x * x + y * y + (z - lower - centre[2]) ** 2)
        return x / (rho + z - lower - centre[2]), y / (rho + z - lower - centre[2])

    rim = border_from([np.stack(from_centre(*curve), axis=1) for curve in edges_of(back)])
    return Lens(net, rim, conic_of(front, scene["lens"]["front"]["z"], lower), border_of(front))


def edges_of(face):
    """Points (3, EDGE_POINTS + 1) along each edge of a face."""
    for item in _explored(face, TopAbs_EDGE):
        curve = BRepAdaptor_Curve(TopoDS.Edge_s(item))
        at = np.linspace(curve.FirstParameter(), curve.LastParameter(), EDGE_POINTS + 1)
        yield np.array([(p.X(), p.Y(), p.Z()) for p in map(curve.Value, at)]).T


def net_of(dome):
    """The Net of an independent_dome.Dome: of each direction the nearest of places four to a span."""
    grid = [np.linspace(k[0], k[-1], 4 * (len(k) - 5) + 1) for k in dome.knots]
    u, v = (g.ravel() for g in np.meshgrid(*grid, indexing="ij"))
    places = independent_dome.surface(dome, u, v)[0] - dome.centre
    rho = np.linalg.norm(places, axis=1)
    flat = places[:, :2] / (rho + places[:, 2])[:, None]
    half = float(np.abs(flat).max())
    line = np.linspace(-half, half, TABLE)
    _, at = cKDTree(flat).query(np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2))
    starts = np.stack([u[at], v[at], rho[at]], axis=1).reshape(TABLE, TABLE, 3)
    return Net(
        dome.poles, *dome.knots, dome.centre, starts, half, nearest=float(rho.min()), farthest=float(rho.max())
    )  # fmt: skip


@njit(nogil=True, cache=True)
def _basis(knots, t, values, slopes):
    """The number of the first of three B-splines that are not zero at t; fills their values and derivatives."""
    k = min(max(np.searchsorted(knots, t, side="right"), 3), len(knots) - 3) - 1
    t0, t1, t2, t3 = knots[k - 1], knots[k], knots[k + 1], knots[k + 2]
    a, b = (t2 - t) / (t2 - t1) / (t2 - t0), (t - t1) / (t2 - t1) / (t3 - t1)
    values[0], values[1], values[2] = (t2 - t) * a, (t - t0) * a + (t3 - t) * b, (t - t1) * b
    slopes[0], slopes[1], slopes[2] = -2 * a, 2 * (a - b), 2 * b
    return k - 2


@njit(nogil=True, cache=True)
def _surface(net, u, v, work):
    """Fills rows 4, 5 and 6 of work (7, 3) with S, ∂S/∂u and ∂S/∂v."""
    i, j = _basis(net.knots_u, u, work[0], work[1]), _basis(net.knots_v, v, work[2], work[3])
    for c in range(3):
        s = s_u = s_v = 0.0
        for p in range(3):
            row = slope = 0.0
            for q in range(3):
                row += work[2, q] * net.poles[i + p, j + q, c]
                slope += work[3, q] * net.poles[i + p, j + q, c]
            s += work[0, p] * row
            s_u += work[1, p] * row
            s_v += work[0, p] * slope
        work[4, c], work[5, c], work[6, c] = s, s_u, s_v


@njit(nogil=True, cache=True)
def _start(net, p, d):
    """(u, v) of the table near the first point at which a ray from inside leaves the dome."""
    x, y, z = p[0] - net.centre[0], p[1] - net.centre[1], p[2] - net.centre[2]
    middle, square = x * d[0] + y * d[1] + z * d[2], x * x + y * y + z * z
    near = math.sqrt(max(middle**2 - square + net.nearest**2, 0.0)) - middle
    far = math.sqrt(max(middle**2 - square + net.farthest**2, 0.0)) - middle
    i = j = 0
    for step in range(MARCH + 1):
        s = near + (far - near) * step / MARCH
        a, b, c = x + s * d[0], y + s * d[1], z + s * d[2]
        distance = math.sqrt(a * a + b * b + c * c)
        a, b = a / max(distance + c, 1e-9), b / max(distance + c, 1e-9)
        i = min(max(int((a / net.half + 1) / 2 * (TABLE - 1) + 0.5), 0), TABLE - 1)
        j = min(max(int((b / net.half + 1) / 2 * (TABLE - 1) + 0.5), 0), TABLE - 1)
        if distance >= net.starts[i, j, 2]:
            break
    return net.starts[i, j, 0], net.starts[i, j, 1]


@njit(nogil=True, cache=True)
def met(net, p, d, work):
    """(arrives, s in mm, place, outward normal) of a ray from inside, by Newton's iteration in u, v and s."""
    u, v = _start(net, p, d)
    last_u, last_v = net.knots_u[-1], net.knots_v[-1]
    _surface(net, u, v, work)
    s = (work[4, 0] - p[0]) * d[0] + (work[4, 1] - p[1]) * d[1] + (work[4, 2] - p[2]) * d[2]
    close = False
    for _ in range(STEPS):
        a = (work[4, 0] - p[0] - s * d[0], work[4, 1] - p[1] - s * d[1], work[4, 2] - p[2] - s * d[2])
        e, f = work[5], work[6]
        n = (e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0])
        size = math.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)
        det = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
        off = max(abs(a[0]), abs(a[1]), abs(a[2]))
        if close or size == 0 or abs(det) < 1e-9 * size:
            break
        close = off < 1e-10 * net.farthest  # one more step leaves rounding alone
        # a + e du + f dv - d ds = 0
        ds = (n[0] * a[0] + n[1] * a[1] + n[2] * a[2]) / det
        w = (ds * d[0] - a[0], ds * d[1] - a[1], ds * d[2] - a[2])
        g = (f[1] * d[2] - f[2] * d[1], f[2] * d[0] - f[0] * d[2], f[0] * d[1] - f[1] * d[0])
        h = (d[1] * e[2] - d[2] * e[1], d[2] * e[0] - d[0] * e[2], d[0] * e[1] - d[1] * e[0])
        du = (g[0] * w[0] + g[1] * w[1] + g[2] * w[2]) / det
        dv = (h[0] * w[0] + h[1] * w[1] + h[2] * w[2]) / det
        short = min(1.0, 2.0 / max(abs(du), abs(dv), 1e-300))
        u, v = min(max(u + short * du, 0.0), last_u), min(max(v + short * dv, 0.0), last_v)
        s += ds if short == 1.0 else short * ds
        _surface(net, u, v, work)
    p = (work[4, 0], work[4, 1], work[4, 2])
    n = (n[0] / size, n[1] / size, n[2] / size)
    return close and off < 1e-9 * net.farthest and s >= 0 and det > 0, s, p, n


@njit(nogil=True, cache=True)
def on_conic(front, p, d):
    """(meets, place, unit normal along the light) of the nearest point ahead on the vertex's side of a conic."""
    h = p[2] - front.z0
    a = front.c * (d[0] ** 2 + d[1] ** 2) + front.q * d[2] ** 2
    b = front.c * (p[0] * d[0] + p[1] * d[1]) + front.q * h * d[2] - d[2]
    e = front.c * (p[0] ** 2 + p[1] ** 2) + front.q * h * h - 2 * h
    best, square = math.inf, b * b - a * e
    if square >= 0:
        t = -b - math.copysign(math.sqrt(square), b)
        for top, bottom in ((t, a), (e, t)):
            s = top / bottom if abs(bottom) > 1e-300 else -1.0
            if 0 < s < best and 1 - front.q * (h + s * d[2]) > 0:
                best = s
    if best == math.inf:
        return False, p, d
    p = (p[0] + best * d[0], p[1] + best * d[1], p[2] + best * d[2])
    n = (-front.c * p[0], -front.c * p[1], 1 - front.q * (p[2] - front.z0))
    size = math.copysign(math.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2), n[0] * d[0] + n[1] * d[1] + n[2] * d[2])
    return True, p, (n[0] / size, n[1] / size, n[2] / size)


@njit(nogil=True, cache=True)
def emitted(light, a, b, u, v):
    """(place, direction) of a ray of a flux that all share: a, b in [0, 1) its direction, u, v its place."""
    if light.profile == 2:  # I ∝ cos θ: the flux within θ grows with sin² θ
        cos = math.sqrt(1 - a * (1 - light.width**2))
    elif light.profile == 1:  # the flux within θ is 1 - exp(-2 tan² θ / width²)
        cos = 1 / math.sqrt(1 - light.width**2 * math.log(1 - a) / 2)
    else:
        cos = 1 - a * (1 - light.width)
    sin, turn = math.sqrt(1 - cos * cos), 2 * math.pi * b
    if light.round_extent:  # equal areas
        r, way = math.sqrt(u), 2 * math.pi * v
        x, y = light.extent[0] * r * math.cos(way), light.extent[1] * r * math.sin(way)
    else:
        x, y = light.extent[0] * (2 * u - 1), light.extent[1] * (2 * v - 1)
    e_x, e_y, n = light.axes
    p, q, o = sin * math.cos(turn), sin * math.sin(turn), light.place
    start = (o[0] + x * e_x[0] + y * e_y[0], o[1] + x * e_x[1] + y * e_y[1], o[2] + x * e_x[2] + y * e_y[2])
    d_x, d_y = p * e_x[0] + q * e_y[0] + cos * n[0], p * e_x[1] + q * e_y[1] + cos * n[1]
    return start, (d_x, d_y, p * e_x[2] + q * e_y[2] + cos * n[2])


@njit(nogil=True, cache=True)
def trace(points, light, lens, glass, screen, picture, ledger):
    """Adds the flux of rays, points (n, 4) in [0, 1), to a picture and to a ledger, as independent.trace does."""
    work = np.empty((7, 3))
    for a, b, u, v in points:
        start, d = emitted(light, a, b, u, v)
        meets, place, n = on_conic(lens.front, start, d)
        if not meets or not inside(lens.edge, place[0], place[1]):
            continue  # it misses the lens
        cos = d[0] * n[0] + d[1] * n[1] + d[2] * n[2]
        for line in glass.lines:
            rest, nm, index, absorbed = line[0], line[1], line[2], line[4]
            eta = glass.outside / index
            cos2 = 1 - eta * eta * (1 - cos * cos)
            if cos2 <= 0:
                ledger[3] += rest
                continue
            cos_out = math.sqrt(cos2)
            kept = rest * transmitted(glass.outside, index, cos, cos_out, nm, glass)
            ledger[4] += rest - kept
            rest = kept
            inner = refracted(d, n, eta, cos, cos_out)
            arrives, s, p, m = met(lens.net, place, inner, work)
            if arrives:
                x, y, z = p[0] - lens.net.centre[0], p[1] - lens.net.centre[1], p[2] - lens.net.centre[2]
                rho = math.sqrt(x * x + y * y + z * z)
                arrives = inside(lens.rim, x / (rho + z), y / (rho + z))
            if not arrives:
                ledger[2] += rest
                continue
            kept = rest * math.exp(-absorbed * s)
            ledger[5] += rest - kept
            rest = kept
            cos_in = inner[0] * m[0] + inner[1] * m[1] + inner[2] * m[2]
            cos2 = 1 - index * index * (1 - cos_in * cos_in)
            if cos2 <= 0:
                ledger[3] += rest
                continue
            kept = rest * transmitted(index, 1.0, cos_in, math.sqrt(cos2), nm, glass)
            ledger[4] += rest - kept
            rest = kept
            e = refracted(inner, m, index, cos_in, math.sqrt(cos2))
            e_x, e_y, across = screen.axes
            o = screen.middle
            fall = e[0] * across[0] + e[1] * across[1] + e[2] * across[2]
            gap = (o[0] - p[0]) * across[0] + (o[1] - p[1]) * across[1] + (o[2] - p[2]) * across[2]
            on = fall != 0 and gap / fall > 0
            if on:
                s = gap / fall
                f, g, h = p[0] + s * e[0] - o[0], p[1] + s * e[1] - o[1], p[2] + s * e[2] - o[2]
                column = (f * e_x[0] + g * e_x[1] + h * e_x[2] + o[0] - screen.low_x) * screen.per_x
                row = (screen.high_y - o[1] - f * e_y[0] - g * e_y[1] - h * e_y[2]) * screen.per_y
                on = 0 <= column < screen.columns and 0 <= row < screen.rows
            if on:
                ledger[0] += rest
                picture[int(row), int(column)] += rest
            else:
                ledger[1] += rest
