"""An independent judge of domes: radial nets traced from a point source by numpy alone.

It shares no code with bstcad.  The poles and knots come from an array or from the text of a STEP file.  Each ray leaves
the source, crosses an inner sphere, meets the net S(u, v) where S(u, v) = p + s d (three equations, solved for u, v and
s by Newton's method), is refracted there, and lands on a plane z = const or in directions.

Rays are points of a scrambled Sobol sequence over the solid angle of the source; all carry the same flux.
Lengths in mm, angles in radians unless a name says degrees.
"""

import re
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import qmc

STEPS = 40  # largest number of Newton steps
SAME = 1e-11  # length of S - p - s d at which a ray meets the net, as a fraction of the net's size
ALONG = 9  # points along a ray between the smallest and the largest distance of the net, for its first crossing
CHUNK = 1 << 16  # rays traced at a time


class Dome(NamedTuple):
    """A B-spline surface of degree 2 about a centre."""

    poles: np.ndarray  # (m, n, 3) mm
    knots: tuple[np.ndarray, np.ndarray]  # full vectors, (m + 3,) and (n + 3,)
    centre: np.ndarray  # (3,) mm


class Crossing(NamedTuple):
    """First points at which rays meet a dome."""

    found: np.ndarray  # (rays,) True where a ray meets it from inside
    path: np.ndarray  # (rays,) mm
    point: np.ndarray  # (rays, 3) mm
    normal: np.ndarray  # (rays, 3) outward unit vectors


class Judged(NamedTuple):
    """Light behind a dome, as fractions of that within the source's cone."""

    picture: np.ndarray  # (rows, columns), row 0 = y max
    flux: dict[str, float]


def uniform_knots(m):
    """{0, 0, 0, 1, …, m - 3, m - 2, m - 2, m - 2}."""
    return np.concatenate([[0.0, 0.0], np.arange(m - 1.0), [m - 2.0, m - 2.0]])


def dome_of(poles, centre=(0.0, 0.0, 0.0), knots=None):
    """The Dome of poles (m, n, 3), by default with uniform knots."""
    poles = np.asarray(poles, float)
    return Dome(poles, knots or tuple(map(uniform_knots, poles.shape[:2])), np.asarray(centre, float))


def read_dome(text, centre=(0.0, 0.0, 0.0)):
    """The Dome of the largest net in the text of a STEP file, read by regular expressions."""
    lines = dict(re.findall(r"#(\d+)=(.*?);", re.sub(r"\s+", "", text)))
    surfaces = [s for s in lines.values() if "B_SPLINE_SURFACE_WITH_KNOTS(" in s and s.startswith("B_SPLINE")]
    degrees, net, ends = max(surfaces, key=len).partition("((")[0], None, None
    largest = max(surfaces, key=len)
    rows = re.search(r"\(\((#.*?)\)\)", largest).group(1).split("),(")
    net = np.array([[_floats(lines[p[1:]]) for p in row.split(",")] for row in rows])
    ends = re.search(r"\)\),.*?,(\([\d,]+\)),(\([\d,]+\)),(\([^()]*\)),(\([^()]*\)),", largest)
    times_u, times_v, knots_u, knots_v = (_floats(part) for part in ends.groups())
    assert re.search(r",2,2,$", degrees), "the surface has another degree than 2"
    knots = tuple(np.repeat(k, t.astype(int)) for k, t in ((knots_u, times_u), (knots_v, times_v)))
    return Dome(net, knots, np.asarray(centre, float))


def _floats(text):
    return np.array(re.search(r"\(([^()]*)\)\)?$", text).group(1).split(","), float)


def _basis(knots, at):
    """(number of the first of three B-splines, their values (3, …), their derivatives (3, …)) by Cox and de Boor."""
    k = np.searchsorted(knots, at, side="right").clip(3, len(knots) - 3) - 1
    t = [knots[k + i] for i in (-1, 0, 1, 2)]
    low, high = (t[2] - at) / (t[2] - t[1]), (at - t[1]) / (t[2] - t[1])  # of degree 1
    a, b = low / (t[2] - t[0]), high / (t[3] - t[1])
    values = (t[2] - at) * a, (at - t[0]) * a + (t[3] - at) * b, (at - t[1]) * b
    return k - 2, np.stack(values), np.stack([-2 * a, 2 * (a - b), 2 * b])


def surface(dome, u, v):
    """(S, ∂S/∂u, ∂S/∂v), each (…, 3)."""
    (i, b_u, d_u), (j, b_v, d_v) = (_basis(k, t) for k, t in zip(dome.knots, (u, v), strict=True))
    three = np.arange(3)
    poles = dome.poles[(i[..., None] + three)[..., :, None], (j[..., None] + three)[..., None, :]]
    return tuple(np.einsum("p...,q...,...pqc->...c", p, q, poles) for p, q in ((b_u, b_v), (d_u, b_v), (b_u, d_v)))


def starts(dome, p, d):
    """(u, v) near the first point at which each ray from inside leaves the dome.

    Places of a grid, two in each span, are looked up by their direction from the centre; a ray has left the dome where
    it is farther from the centre than the place in its direction.
    """
    grid = [np.linspace(k[0], k[-1], 2 * (len(k) - 5) + 1) for k in dome.knots]
    u, v = (g.ravel() for g in np.meshgrid(*grid, indexing="ij"))
    places = surface(dome, u, v)[0] - dome.centre
    rho = np.linalg.norm(places, axis=1)
    tree, o = cKDTree(places / rho[:, None]), p - dome.centre
    middle, square = (o * d).sum(1), (o * o).sum(1)
    near, far = (np.sqrt(np.maximum(middle**2 - square + r * r, 0)) - middle for r in (rho.min(), rho.max()))
    nearest = np.zeros(len(p), int)
    waiting = np.ones(len(p), bool)
    for share in np.linspace(0, 1, ALONG):
        at = o[waiting] + ((1 - share) * near + share * far)[waiting, None] * d[waiting]
        distance = np.linalg.norm(at, axis=1)
        _, found = tree.query(at / distance[:, None])
        nearest[waiting] = found
        waiting[waiting] = distance < rho[found]
    return u[nearest], v[nearest]


def meet(dome, p, d, start=None):
    """The Crossing of rays from points p (n, 3) along unit vectors d; start: (u, v), by default those of `starts`."""
    u, v = starts(dome, p, d) if start is None else start
    size = np.abs(dome.poles - dome.centre).max()
    s = ((surface(dome, u, v)[0] - p) * d).sum(1)
    ends = [(k[0], k[-1]) for k in dome.knots]
    last = False
    for _ in range(STEPS):
        at, along_u, along_v = surface(dome, u, v)
        off = at - p - s[:, None] * d
        found = np.abs(off).max(1) <= SAME * size
        if found.all() and last:
            break
        last = found.all()  # one more step leaves rounding alone
        matrix = np.stack([along_u, along_v, -d], axis=-1)
        safe = np.abs(np.linalg.det(matrix)) > 1e-12
        step = np.linalg.solve(np.where(safe[:, None, None], matrix, np.eye(3)), off[..., None])[..., 0]
        step *= np.minimum(1.0, 3.0 / np.abs(step[:, :2]).max(1).clip(1e-300))[:, None]
        u, v = ((q - c).clip(*e) for q, c, e in zip((u, v), step[:, :2].T, ends, strict=True))
        s = s - step[:, 2]
    normal = np.cross(along_u, along_v)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Crossing(found & (s >= 0) & ((normal * d).sum(1) > 0), s, at, normal)


def refracted(d, normal, eta):
    """(unit vectors behind a face, True where no light goes on); eta: index before the face over that behind it."""
    cos = (d * normal).sum(1)
    cos2 = 1 - eta * eta * (1 - cos * cos)
    blocked = (cos2 <= 0) | (cos <= 0)
    return eta * d + (np.sqrt(cos2.clip(0)) - eta * cos)[:, None] * normal, blocked


def out_of_sphere(p, d, centre, radius):
    """(point, outward normal) where rays from inside leave a sphere."""
    o = p - centre
    middle = (o * d).sum(1)
    path = np.sqrt(middle**2 - (o * o).sum(1) + radius**2) - middle
    at = p + path[:, None] * d
    return at, (at - centre) / radius


def light(given, half_angle, lambertian):
    """Unit vectors of equal flux within a cone about +z, from points (n, 2) in [0, 1]²."""
    if lambertian:  # I ∝ cos θ: the flux within θ grows with sin² θ
        cos = np.sqrt(1 - given[:, 0] * np.sin(half_angle) ** 2)
    else:
        cos = 1 - given[:, 0] * (1 - np.cos(half_angle))
    sin, turn = np.sqrt(1 - cos**2), 2 * np.pi * given[:, 1]
    return np.stack([sin * np.cos(turn), sin * np.sin(turn), cos], axis=1)


def through(dome, inner, index, place, d, rim):
    """(points on the dome, unit vectors behind it, fate): fate 0 goes on, 1 beside the dome, 2 totally reflected.

    inner: radius (mm) of a sphere about the centre of the dome.  rim: half angle of the dome, seen from its centre.
    """
    p = np.broadcast_to(np.asarray(place, float), d.shape)
    p, normal = out_of_sphere(p, d, dome.centre, inner)
    d, _ = refracted(d, normal, 1 / index)
    met = meet(dome, p, d)
    from_centre = met.point - dome.centre
    within = from_centre[:, 2] >= np.cos(rim) * np.linalg.norm(from_centre, axis=1) - 1e-12
    d, blocked = refracted(d, met.normal, index)
    return met.point, d, np.where(met.found & within, np.where(blocked, 2, 0), 1)


def judge(dome, inner, index, place, *, half_angle, rim, lambertian, land, extent, pixels, rays, seed=0):
    """The Judged light of a point at `place` within `half_angle`, on the square |x|, |y| <= extent of `land`.

    rim: half angle of the dome, seen from its centre.  land: of points and unit vectors, returns x, y and True where
    light arrives.
    """
    picture, fates = np.zeros((pixels, pixels)), np.zeros(4)
    engine = qmc.Sobol(2, seed=seed)
    for start in range(0, rays, CHUNK):
        d = light(engine.random(min(CHUNK, rays - start)), half_angle, lambertian)
        p, d, fate = through(dome, inner, index, place, d, rim)
        x, y, arrives = land(p, d)
        on = (fate == 0) & arrives & (np.abs(x) <= extent) & (np.abs(y) <= extent)
        picture += np.histogram2d(-y[on], x[on], pixels, ((-extent, extent),) * 2)[0]
        fates += [on.sum(), ((fate == 0) & ~on).sum(), (fate == 1).sum(), (fate == 2).sum()]
    names = "on target", "off target", "beside the dome", "total internal reflection"
    return Judged(picture / rays, dict(zip(names, (fates / rays).tolist(), strict=True)))


def on_plane(z):
    """`land` for the plane z (mm)."""

    def land(p, d):
        up = d[:, 2] > 1e-9
        s = (z - p[:, 2]) / np.where(up, d[:, 2], 1.0)
        return p[:, 0] + s * d[:, 0], p[:, 1] + s * d[:, 1], up

    return land


def in_directions(p, d):
    """`land` for directions: θ (cos ψ, sin ψ) in degrees, θ the angle from +z."""
    across = np.hypot(d[:, 0], d[:, 1])
    theta = np.degrees(np.arctan2(across, d[:, 2])) / across.clip(1e-30)
    return theta * d[:, 0], theta * d[:, 1], np.ones(len(d), bool)
