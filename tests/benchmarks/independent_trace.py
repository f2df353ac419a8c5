"""Trace single rays through the faces of a lens by numba, for the independent judge (independent.py).

A freeform face is a B-spline surface of degree 2: heights over (x, y), which Newton's method meets in the path alone,
or a dome about a centre, which it meets in u, v and the path.  Rays begin at drawn points of the first face, each with
the flux through its element of area; those of a dome begin at the source, and all have the same flux.

Lengths in mm, angles in radians unless a name says degrees, wavelengths in nm.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.interpolate import BSpline
from scipy.spatial import cKDTree

TABLE = 1025  # places per side of the table of starts of a dome
MARCH = 64  # points along a ray at which its distance is compared with the dome's
STEPS = 40  # largest number of Newton steps at a dome
CONIC, HEIGHTS, DOME = 0, 1, 2  # kinds of faces


class Axis(NamedTuple):
    """One direction of a net of degree 2: polynomials in s, which runs from 0 to 1 in each span."""

    breaks: np.ndarray  # (spans + 1,) coordinate at the knots (mm)
    place: np.ndarray  # (spans, 3) coordinate = place[:, 0] + place[:, 1] s + place[:, 2] s²
    basis: np.ndarray  # (spans, 3, 3) the same of the three B-splines that are not zero in a span


class Net(NamedTuple):
    """A B-spline height over (x, y)."""

    x: Axis
    y: Axis
    z: np.ndarray  # (m, n) heights of the control points (mm)


class Dome(NamedTuple):
    """A B-spline surface of degree 2 about a centre, and a table of it over directions."""

    poles: np.ndarray  # (m, n, 3) mm
    knots_u: np.ndarray  # (m + 3,) full vector
    knots_v: np.ndarray  # (n + 3,)
    centre: np.ndarray  # (3,) mm
    starts: np.ndarray  # (TABLE, TABLE, 3) u, v and distance (mm) of the surface near each direction of the table
    half: float  # half width of the table: its directions have |d_xy| / (1 + d_z) up to there
    nearest: float  # smallest distance of the surface from the centre, mm
    farthest: float


class Border(NamedTuple):
    """The border of a trimmed face over (x, y), of a dome over d_xy / (1 + d_z) of directions from its centre."""

    segments: np.ndarray  # (n, 4) x0, y0, x1, y1
    first: np.ndarray  # (bins + 1,) of `listed`, for each bin of y
    listed: np.ndarray  # numbers of segments
    low: float  # y of the first bin's lower end
    per_mm: float  # bins per mm


class Conic(NamedTuple):
    """z = z0 + c r² / (1 + sqrt(1 - c q r²)), q = c (1 + k)."""

    z0: float
    c: float
    q: float


class Face(NamedTuple):
    """A face of a lens or mirror."""

    kind: int  # CONIC, HEIGHTS or DOME, which name the one of the next three that is used
    conic: Conic
    net: Net
    dome: Dome
    border: Border


class Light(NamedTuple):
    """A source in numbers."""

    parallel: bool
    place: np.ndarray  # (3,) point: position; parallel: middle of the aperture
    axes: np.ndarray  # (3, 3) rows e_x, e_y and the axis n
    sense: float  # 1: light goes along n; -1: against it, down to a mirror
    profile: int  # 0 uniform, 1 gaussian, 2 lambertian
    width: float  # gaussian: 1/e² radius (mm), or its tangent of a point; uniform point: cosine of the half angle
    peak: float  # factor of the profile, so that the whole flux is 1
    round_aperture: bool
    aperture: np.ndarray  # (2,) half extents (mm); of a circle both its radius
    round_extent: bool
    extent: np.ndarray  # (2,) half extents of the source: mm of a point source, direction cosines of a parallel beam
    cone: float  # cosine of the half divergence; the mean of two


class Around(NamedTuple):
    """Faces of windows and mirrors before or behind the lens, in the order of the light: planes and spheres."""

    vertices: np.ndarray  # (k, 3) mm
    normals: np.ndarray  # (k, 3) unit vectors there, upwards
    bends: np.ndarray  # (k,) curvatures (1/mm)
    mirrors: np.ndarray  # (k,) True of a mirror
    rims: np.ndarray  # (k, 2) half extents along x and y (mm)
    circles: np.ndarray  # (k,) True of a round rim
    etas: np.ndarray  # (lines, k) index before the face over that behind it


class Screen(NamedTuple):
    """The target plane."""

    middle: np.ndarray  # (3,)
    axes: np.ndarray  # (3, 3) rows e_x, e_y, normal
    low_x: float
    high_y: float
    per_x: float  # columns per mm
    per_y: float
    columns: int
    rows: int
    in_degrees: bool = False  # coordinates are θ (cos ψ, sin ψ) of directions in degrees, θ the angle from +z


class Glass(NamedTuple):
    """Lines and losses."""

    mirror: bool
    lines: np.ndarray  # (lines, 5): share of the flux, nm, n, k of a mirror's metal, absorption coefficient (1/mm)
    fresnel: bool
    polarisation: np.ndarray  # (2,) shares of s and p
    coating: np.ndarray  # (2,) index and thickness (nm); zeros: none
    outside: float  # index between the source and the lens


NO_AXIS = Axis(np.zeros(2), np.zeros((1, 3)), np.zeros((1, 3, 3)))
NO_NET, NO_CONIC = Net(NO_AXIS, NO_AXIS, np.zeros((1, 1))), Conic(0.0, 0.0, 0.0)
NO_DOME = Dome(np.zeros((1, 1, 3)), np.zeros(1), np.zeros(1), np.zeros(3), np.zeros((1, 1, 3)), 0.0, 0.0, 0.0)


def conic_face(conic, border):
    """The Face of a Conic."""
    return Face(CONIC, conic, NO_NET, NO_DOME, border)


def net_face(net, border):
    """The Face of a Net."""
    return Face(HEIGHTS, NO_CONIC, net, NO_DOME, border)


def dome_face(dome, border):
    """The Face of a Dome."""
    return Face(DOME, NO_CONIC, NO_NET, dome, border)


def uniform_knots(m):
    """{0, 0, 0, 1, …, m - 3, m - 2, m - 2, m - 2}."""
    return np.concatenate([[0.0, 0.0], np.arange(m - 1.0), [m - 2.0, m - 2.0]])


def places_of(poles, knots, u, v):
    """Points (u, v, 3) of a B-spline surface on a grid."""
    rows = BSpline(knots[0], poles, 2)(u).swapaxes(0, 1)
    return BSpline(knots[1], rows, 2)(v).swapaxes(0, 1)


def dome_of(poles, centre=(0.0, 0.0, 0.0), knots=None):
    """The Dome of poles (m, n, 3), by default with uniform knots; starts: the nearest of places four to a span."""
    poles, centre = np.ascontiguousarray(poles, float), np.array(centre, float)
    knots = knots or [uniform_knots(count) for count in poles.shape[:2]]
    u, v = (np.linspace(k[0], k[-1], 4 * (len(k) - 5) + 1) for k in knots)
    places = (places_of(poles, knots, u, v) - centre).reshape(-1, 3)
    u, v = (g.ravel() for g in np.meshgrid(u, v, indexing="ij"))
    rho, flat = np.linalg.norm(places, axis=1), np.stack(flattened(*places.T), axis=1)
    half = float(np.abs(flat).max())
    line = np.linspace(-half, half, TABLE)
    _, at = cKDTree(flat).query(np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2))
    starts = np.stack([u[at], v[at], rho[at]], axis=1).reshape(TABLE, TABLE, 3)
    return Dome(poles, *knots, centre, starts, half, nearest=float(rho.min()), farthest=float(rho.max()))


@njit(nogil=True, cache=True)
def flattened(x, y, z):
    """d_xy / (1 + d_z) of the directions of points from a centre."""
    rho = np.sqrt(x * x + y * y + z * z)
    return x / (rho + z), y / (rho + z)


@njit(nogil=True, cache=True)
def _along(axis, at, values, slopes):
    """The span of a place, and there the three B-splines and their derivatives over the coordinate."""
    last = len(axis.breaks) - 2
    span = int((at - axis.breaks[0]) / (axis.breaks[-1] - axis.breaks[0]) * (last + 1))
    span = min(max(span, 0), last)
    while span > 0 and at < axis.breaks[span]:
        span -= 1
    while span < last and at >= axis.breaks[span + 1]:
        span += 1
    a0, a1, a2 = axis.place[span]
    s = 2 * (at - a0) / (a1 + math.sqrt(max(a1 * a1 + 4 * a2 * (at - a0), 0.0)))
    per_s = 1 / (a1 + 2 * a2 * s)
    for k in range(3):
        b0, b1, b2 = axis.basis[span, k]
        values[k] = b0 + s * (b1 + s * b2)
        slopes[k] = (b1 + 2 * b2 * s) * per_s
    return span


@njit(nogil=True, cache=True)
def height(net, x, y, work):
    """(z, ∂z/∂x, ∂z/∂y) of the net; work: (4, 3), overwritten."""
    i, j = _along(net.x, x, work[0], work[1]), _along(net.y, y, work[2], work[3])
    z = z_x = z_y = 0.0
    for p in range(3):
        row = slope = 0.0
        for q in range(3):
            c = net.z[i + p, j + q]
            row += work[2, q] * c
            slope += work[3, q] * c
        z += work[0, p] * row
        z_x += work[1, p] * row
        z_y += work[0, p] * slope
    return z, z_x, z_y


@njit(nogil=True, cache=True)
def conic_height(conic, x, y):
    """(z, ∂z/∂x, ∂z/∂y) of the conic."""
    r2 = x * x + y * y
    root = math.sqrt(1 - conic.c * conic.q * r2)
    return conic.z0 + conic.c * r2 / (1 + root), conic.c * x / root, conic.c * y / root


@njit(nogil=True, cache=True)
def inside(border, x, y):
    """Is (x, y) inside a trimmed face?"""
    place = (y - border.low) * border.per_mm
    if place < 0 or place >= len(border.first) - 1:
        return False
    b, odd = int(place), False
    for k in range(border.first[b], border.first[b + 1]):
        x0, y0, x1, y1 = border.segments[border.listed[k]]
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
            odd = not odd
    return odd


@njit(nogil=True, cache=True)
def on_extent(light, u, v):
    """Coordinates along e_x and e_y of the place (u, v) in [0, 1]² of the source's extent; equal areas."""
    if light.round_extent:
        r, turn = math.sqrt(u), 2 * math.pi * v
        return light.extent[0] * r * math.cos(turn), light.extent[1] * r * math.sin(turn)
    return light.extent[0] * (2 * u - 1), light.extent[1] * (2 * v - 1)


@njit(nogil=True, cache=True)
def emitted(light, p, u, v):
    """(dx, dy, dz, flux density) at the point p of a face, from the place (u, v) in [0, 1]² of the source's extent.

    The density is that through an area across the ray (1/mm²).
    """
    a, b = on_extent(light, u, v)
    e_x, e_y, n = light.axes
    if light.parallel:
        dx = light.cone * n[0] + a * e_x[0] + b * e_y[0]
        dy = light.cone * n[1] + a * e_x[1] + b * e_y[1]
        dz = math.sqrt(max(1 - dx * dx - dy * dy, 0.0))
        way = (p[2] - light.place[2]) / dz
        x, y = p[0] - way * dx - light.place[0], p[1] - way * dy - light.place[1]
        if light.round_aperture:
            lit = x * x + y * y <= light.aperture[0] ** 2
        else:
            lit = abs(x) <= light.aperture[0] and abs(y) <= light.aperture[1]
        e = light.peak * math.exp(-2 * (x * x + y * y) / light.width**2) if light.profile == 1 else light.peak
        return light.sense * dx, light.sense * dy, light.sense * dz, (e / dz if lit else 0.0)
    dx = p[0] - light.place[0] - a * e_x[0] - b * e_y[0]
    dy = p[1] - light.place[1] - a * e_x[1] - b * e_y[1]
    dz = p[2] - light.place[2] - a * e_x[2] - b * e_y[2]
    d = math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / d, dy / d, dz / d
    cos = light.sense * (dx * n[0] + dy * n[1] + dz * n[2])
    if cos <= 0 or light.sense * dz <= 0:
        return dx, dy, dz, 0.0
    intensity = light.peak
    if light.profile == 1:  # on planes across the axis E = I cos³ θ / D²
        intensity *= math.exp(-2 * (1 / (cos * cos) - 1) / light.width**2) / cos**3
    else:
        intensity *= 0.0 if cos < light.width else (cos if light.profile == 2 else 1.0)
    return dx, dy, dz, intensity / (d * d)


@njit(nogil=True, cache=True)
def transmitted(n_in, n_out, cos_in, cos_out, nm, glass):
    """1 - R of a face, bare or with a single layer (Born and Wolf 1.5.2, 1.6.4)."""
    if not glass.fresnel:
        return 1.0
    n_f, thickness = glass.coating
    reflected = 0.0
    for p in range(2):
        if n_f == 0.0:
            r = complex(_amplitude(n_in, n_out, cos_in, cos_out, p))
        else:
            cos_f = math.sqrt(1 - (n_in / n_f) ** 2 * (1 - cos_in * cos_in))
            first = _amplitude(n_in, n_f, cos_in, cos_f, p)
            second = _amplitude(n_f, n_out, cos_f, cos_out, p)
            turn = np.exp(2j * (2 * math.pi * n_f * thickness * cos_f / nm))
            r = (first + second * turn) / (1 + first * second * turn)
        reflected += glass.polarisation[p] * abs(r) ** 2
    return 1 - reflected


@njit(nogil=True, cache=True)
def _amplitude(n_in, n_out, cos_in, cos_out, p):
    if p == 0:
        return (n_in * cos_in - n_out * cos_out) / (n_in * cos_in + n_out * cos_out)
    return (n_out * cos_in - n_in * cos_out) / (n_out * cos_in + n_in * cos_out)


@njit(nogil=True, cache=True)
def metal_reflectance(index, cos, glass):
    """R of a metal of the complex index n + ik, by Fresnel's amplitudes with a complex cosine."""
    inner = np.sqrt(1 - (1 - cos * cos) / (index * index))
    s = abs((cos - index * inner) / (cos + index * inner)) ** 2
    p = abs((index * cos - inner) / (index * cos + inner)) ** 2
    return glass.polarisation[0] * s + glass.polarisation[1] * p


@njit(nogil=True, cache=True)
def refracted(d, n, eta, cos_in, cos_out):
    """Snell's law: η d + (cos θ' - η cos θ) N, N along the light."""
    f = cos_out - eta * cos_in
    return eta * d[0] + f * n[0], eta * d[1] + f * n[1], eta * d[2] + f * n[2]


@njit(nogil=True, cache=True)
def past(around, first, line, p, d):
    """(arrives, p, d) behind the faces from number `first` on; the ray begins on face `first` - 1 or before it."""
    for k in range(first, len(around.bends)):
        v, n, c = around.vertices[k], around.normals[k], around.bends[k]
        w = (p[0] - v[0], p[1] - v[1], p[2] - v[2])
        b = n[0] * d[0] + n[1] * d[1] + n[2] * d[2] - c * (w[0] * d[0] + w[1] * d[1] + w[2] * d[2])
        e = c * (w[0] ** 2 + w[1] ** 2 + w[2] ** 2) - 2 * (n[0] * w[0] + n[1] * w[1] + n[2] * w[2])
        if b * b - c * e <= 0:
            return False, p, d
        s = e / (b + math.copysign(math.sqrt(b * b - c * e), b))
        if s < 0:
            return False, p, d
        arrives, p, d = _turned_by(around, k, line, (p[0] + s * d[0], p[1] + s * d[1], p[2] + s * d[2]), d)
        if not arrives:
            return False, p, d
    return True, p, d


@njit(nogil=True, cache=True)
def _turned_by(around, k, line, p, d):
    """(goes on, p, d) behind face k, for a ray at a point of it."""
    a, b = around.rims[k]
    within = abs(p[0]) <= a and abs(p[1]) <= b
    if around.circles[k]:
        within = p[0] * p[0] + p[1] * p[1] <= a * a
    v, c = around.vertices[k], around.bends[k]
    m = around.normals[k]
    m = (m[0] - c * (p[0] - v[0]), m[1] - c * (p[1] - v[1]), m[2] - c * (p[2] - v[2]))
    size = math.sqrt(m[0] ** 2 + m[1] ** 2 + m[2] ** 2)
    cos = (m[0] * d[0] + m[1] * d[1] + m[2] * d[2]) / size
    size = math.copysign(size, cos)
    m, cos = (m[0] / size, m[1] / size, m[2] / size), abs(cos)
    if around.mirrors[k]:
        return within, p, (d[0] - 2 * cos * m[0], d[1] - 2 * cos * m[1], d[2] - 2 * cos * m[2])
    eta = around.etas[line, k]
    cos2 = 1 - eta * eta * (1 - cos * cos)
    if cos2 <= 0:
        return False, p, d
    return within, p, refracted(d, m, eta, cos, math.sqrt(cos2))


@njit(nogil=True, cache=True)
def face_height(face, x, y, work):
    """(z, z_x, z_y) of a face that is no dome."""
    return height(face.net, x, y, work) if face.kind == HEIGHTS else conic_height(face.conic, x, y)


@njit(nogil=True, cache=True)
def upwards(z_x, z_y):
    """The unit normal of a face, upwards."""
    size = math.sqrt(1 + z_x * z_x + z_y * z_y)
    return -z_x / size, -z_y / size, 1 / size


@njit(nogil=True, cache=True)
def met(face, p, d, work):
    """(arrives, s in mm, place, normal) of a ray from p along d; the normal points upwards, of a dome outwards."""
    if face.kind == CONIC:
        near, s, p, n = on_conic(face.conic, p, d)
    elif face.kind == HEIGHTS:
        near, s, p, n = on_net(face.net, p, d, work)
    else:
        dome, (u, v) = face.dome, start(face.dome, p, d)
        near, s, p, n = on_dome(dome, u, v, p, d, work)
        if not near:
            return False, s, p, n
        x, y = flattened(p[0] - dome.centre[0], p[1] - dome.centre[1], p[2] - dome.centre[2])
        return inside(face.border, x, y), s, p, n
    return near and s >= 0 and inside(face.border, p[0], p[1]), s, p, n


@njit(nogil=True, cache=True)
def on_net(net, p, d, work):
    """(meets, s in mm, place, normal upwards) of a ray at heights, by Newton's iteration."""
    z, z_x, z_y = height(net, p[0], p[1], work)
    s, near = (z - p[2]) / d[2], False
    for _ in range(30):
        z, z_x, z_y = height(net, p[0] + s * d[0], p[1] + s * d[1], work)
        step = (p[2] + s * d[2] - z) / (d[2] - z_x * d[0] - z_y * d[1])
        s -= step
        if abs(step) < 1e-11:
            near = True
            break
    p = (p[0] + s * d[0], p[1] + s * d[1], p[2] + s * d[2])
    _, z_x, z_y = height(net, p[0], p[1], work)
    return near, s, p, upwards(z_x, z_y)


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
def point_of(net, u, v, work):
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
def start(net, p, d):
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
        a, b = a / max(distance + c, 1e-9), b / max(distance + c, 1e-9)  # as `flattened`, and finite at -z
        i = min(max(int((a / net.half + 1) / 2 * (TABLE - 1) + 0.5), 0), TABLE - 1)
        j = min(max(int((b / net.half + 1) / 2 * (TABLE - 1) + 0.5), 0), TABLE - 1)
        if distance >= net.starts[i, j, 2]:
            break
    return net.starts[i, j, 0], net.starts[i, j, 1]


@njit(nogil=True, cache=True)
def on_dome(net, u, v, p, d, work):
    """(meets, s in mm, place, outward normal) of a ray from inside, by Newton's iteration from u and v, and in s."""
    last_u, last_v = net.knots_u[-1], net.knots_v[-1]
    point_of(net, u, v, work)
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
        point_of(net, u, v, work)
    p = (work[4, 0], work[4, 1], work[4, 2])
    n = (n[0] / size, n[1] / size, n[2] / size)
    return close and off < 1e-9 * net.farthest and s >= 0 and det > 0, s, p, n


@njit(nogil=True, cache=True)
def on_conic(front, p, d):
    """(meets, s in mm, place, unit normal upwards) of the nearest point ahead on the vertex's side of a conic."""
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
        return False, best, p, d
    p = (p[0] + best * d[0], p[1] + best * d[1], p[2] + best * d[2])
    n = (-front.c * p[0], -front.c * p[1], 1 - front.q * (p[2] - front.z0))
    size = math.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)
    return True, best, p, (n[0] / size, n[1] / size, n[2] / size)


@njit(nogil=True, cache=True)
def sent(light, a, b, u, v):
    """(place, direction) of a ray of a flux that all share: a, b in [0, 1) its direction, u, v its place."""
    if light.profile == 2:  # I ∝ cos θ: the flux within θ grows with sin² θ
        cos = math.sqrt(1 - a * (1 - light.width**2))
    elif light.profile == 1:  # the flux within θ is 1 - exp(-2 tan² θ / width²)
        cos = 1 / math.sqrt(1 - light.width**2 * math.log(1 - a) / 2)
    else:
        cos = 1 - a * (1 - light.width)
    sin, turn, (x, y) = math.sqrt(1 - cos * cos), 2 * math.pi * b, on_extent(light, u, v)
    e_x, e_y, n = light.axes
    p, q, o = sin * math.cos(turn), sin * math.sin(turn), light.place
    start = (o[0] + x * e_x[0] + y * e_y[0], o[1] + x * e_x[1] + y * e_y[1], o[2] + x * e_x[2] + y * e_y[2])
    d_x, d_y = p * e_x[0] + q * e_y[0] + cos * n[0], p * e_x[1] + q * e_y[1] + cos * n[1]
    return start, (d_x, d_y, p * e_x[2] + q * e_y[2] + cos * n[2])


@njit(nogil=True, cache=True)
def at_first(light, first, before, p, area, u, v, work):
    """(lit, flux, direction, place, normal upwards) of a ray at a drawn point of the face that light meets first.

    That face is the first of `before`, and `first` where there are none.
    """
    x, y, _ = p
    if len(before.bends):
        c, m, o = before.bends[0], before.normals[0], before.vertices[0]
        f = c * ((x - o[0]) ** 2 + (y - o[1]) ** 2) - 2 * (m[0] * (x - o[0]) + m[1] * (y - o[1]))
        if m[2] * m[2] - c * f <= 0:
            return False, 0.0, p, p, p
        root = math.sqrt(m[2] * m[2] - c * f)
        z, z_x, z_y = o[2] + f / (m[2] + root), (c * (x - o[0]) - m[0]) / root, (c * (y - o[1]) - m[1]) / root
    elif inside(first.border, x, y):
        z, z_x, z_y = face_height(first, x, y, work)
    else:
        return False, 0.0, p, p, p
    p, n = (x, y, z), upwards(z_x, z_y)
    dx, dy, dz, flux = emitted(light, p, u, v)
    along = light.sense * (dx * n[0] + dy * n[1] + dz * n[2])
    return flux > 0 and along > 0, flux * area * along / n[2], (dx, dy, dz), p, n


@njit(nogil=True, cache=True)
def landed(screen, p, e):
    """(True of a ray that lands on a pixel, row, column) of a ray from p along e."""
    if screen.in_degrees:
        across = math.hypot(e[0], e[1])
        theta = math.degrees(math.atan2(across, e[2])) / max(across, 1e-30)
        x, y = theta * e[0], theta * e[1]
    else:
        e_x, e_y, n = screen.axes
        o = screen.middle
        fall = e[0] * n[0] + e[1] * n[1] + e[2] * n[2]
        gap = (o[0] - p[0]) * n[0] + (o[1] - p[1]) * n[1] + (o[2] - p[2]) * n[2]
        if fall == 0 or gap / fall <= 0:
            return False, 0, 0
        s = gap / fall
        a, b, c = p[0] + s * e[0] - o[0], p[1] + s * e[1] - o[1], p[2] + s * e[2] - o[2]
        x, y = a * e_x[0] + b * e_x[1] + c * e_x[2] + o[0], a * e_y[0] + b * e_y[1] + c * e_y[2] + o[1]
    column, row = (x - screen.low_x) * screen.per_x, (screen.high_y - y) * screen.per_y
    return 0 <= column < screen.columns and 0 <= row < screen.rows, int(row), int(column)


@njit(nogil=True, cache=True)
def trace(points, area, light, first, back, glass, screen, before, behind, picture, ledger):
    """Adds the flux of rays to a picture and to a ledger, for the caller to divide by the number of points.

    points: (n, 4): x and y (mm) on the first face, and the place on the source's extent in [0, 1]²; area: (n,) mm² of
    the face that each of them stands for, times n.  Where the back is a dome: two numbers in [0, 1) of the direction of
    a ray of the source instead of x and y, and any area.
    """
    work = np.empty((7, 3))
    apart, from_source = len(before.bends) > 0, back.kind == DOME  # does light meet something before the lens?
    to_lens = -1.0 if glass.mirror else 1.0
    for number in range(len(points)):
        x, y, u, v = points[number]
        if from_source:
            place, along = sent(light, x, y, u, v)
            lit, _, place, facing = met(first, place, along, work)
            flux = 1.0
        else:
            lit, flux, along, place, facing = at_first(light, first, before, (x, y, 0.0), area[number], u, v, work)
        if not lit:
            continue
        for i, line in enumerate(glass.lines):
            share, nm, index, extinction, absorbed = line
            rest, p, d, n = flux * share, place, along, facing
            if apart:
                arrives, p, d = _turned_by(before, 0, i, p, d)
                if arrives:
                    arrives, p, d = past(before, 1, i, p, d)
                if arrives:
                    arrives, _, p, n = met(first, p, d, work)
                if not arrives:
                    continue
            cos = to_lens * (d[0] * n[0] + d[1] * n[1] + d[2] * n[2])
            if cos <= 0:
                continue  # it misses the lens
            if glass.mirror:
                e = (d[0] + 2 * cos * n[0], d[1] + 2 * cos * n[1], d[2] + 2 * cos * n[2])
                if glass.fresnel:
                    kept = rest * metal_reflectance(complex(index, extinction), cos, glass)
                    ledger[6] += rest - kept
                    rest = kept
            else:
                eta = glass.outside / index
                cos2 = 1 - eta * eta * (1 - cos * cos)
                if cos2 <= 0:
                    ledger[3] += rest
                    continue
                cos_out = math.sqrt(cos2)
                kept = rest * transmitted(glass.outside, index, cos, cos_out, nm, glass)
                ledger[4] += rest - kept
                inner, rest = refracted(d, n, eta, cos, cos_out), kept
                arrives, s, p, m = met(back, p, inner, work)
                if not arrives:
                    ledger[2] += rest
                    continue
                kept = rest * math.exp(-absorbed * s)
                ledger[5] += rest - kept
                rest = kept
                cos_in = inner[0] * m[0] + inner[1] * m[1] + inner[2] * m[2]
                cos2 = 1 - index * index * (1 - cos_in * cos_in)
                if cos2 <= 0 or cos_in <= 0:
                    ledger[3] += rest
                    continue
                kept = rest * transmitted(index, 1.0, cos_in, math.sqrt(cos2), nm, glass)
                ledger[4] += rest - kept
                rest = kept
                e = refracted(inner, m, index, cos_in, math.sqrt(cos2))
            arrives, p, e = past(behind, 0, i, p, e)
            if not arrives:
                ledger[7] += rest
                continue
            on, row, column = landed(screen, p, e)
            if on:
                ledger[0] += rest
                picture[row, column] += rest
            else:
                ledger[1] += rest
