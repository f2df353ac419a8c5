"""A simulated shop cuts faces by the written paths: it runs the G-code and the table, and measures what was cut.

The shop shares nothing with the package: the face is scipy's spline of the net, G-code is read by the lines below, and
distances are those of trees of points along the moves.
"""

import io
import math
import re

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.interpolate import NdBSpline
from scipy.spatial import cKDTree

from bstcad.exports.toolpath_files import toolpath_files
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import BSplineSurface, interpolating_net, knots
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.toolpath.cutting import Cutting
from tests import suite

NUMBERED = re.compile(r"([GMFXYZ])(-?\d*\.?\d+)")


def waves(x, y):
    """A smooth relief with valleys of 4 mm radius, tilted and with its vertex nowhere special."""
    return 0.4 * np.sin(x / 2.0) * np.cos(y / 2.5 + 0.3) - 0.005 * (x * x + y * y) + 0.05 * x


def lens_of(relief, outline, m=65, wide=1.1):
    """A lens whose back is the net through a relief z(x, y)."""
    half = max(outline.half_extent) * wide
    x, y = np.meshgrid(np.linspace(-half, half, m), np.linspace(-half, half, m), indexing="ij")
    back = BSplineSurface(6.0, torch.from_numpy(interpolating_net(relief(x, y))), (-half, half), (-half, half))
    return Lens.between(Plane(0.0), back, outline, 1.49)


def written(kind, lens, **settings):
    """The files of a path by their names."""
    return dict(toolpath_files(kind, lens, Cutting(**settings), "a lens"))


def exact(net, x, y):
    """Heights of a net by scipy's splines, at points that are not in the end spans."""
    (m, n), heights = net.heights.shape, net.heights.numpy()
    t, s = ((at - ends[0]) / pitch - 0.5 for at, ends, pitch in zip((x, y), (net.x, net.y), net.pitch, strict=True))
    face = NdBSpline((knots(m), knots(n)), heights, 2, extrapolate=False)
    return net.z + face(np.column_stack([t, s]))


def points_on(net, outline, spacing):
    """Points (n, 3) of the face on a grid inside the outline."""
    axes = (np.arange(-half, half + spacing / 2, spacing) for half in outline.half_extent)
    x, y = (at.ravel() for at in np.meshgrid(*axes, indexing="ij"))
    inside = outline.depth(x, y) >= 0
    return np.column_stack([x[inside], y[inside], exact(net, x[inside], y[inside])])


def highest(net, outline):
    """The highest z of the face, on a grid and on finer ones about its highest point."""
    coarse = points_on(net, outline, max(outline.half_extent) / 120)
    place, reach = coarse[coarse[:, 2].argmax()], max(outline.half_extent) / 120
    for _ in range(2):
        away = np.linspace(-reach, reach, 81)
        x, y = (np.clip(p + away, -h, h) for p, h in zip(place, outline.half_extent, strict=False))
        x, y = (at.ravel() for at in np.meshgrid(x, y))
        inside = outline.depth(x, y) >= 0
        fine = np.column_stack([x, y, exact(net, x, y)])[inside]
        place, reach = fine[fine[:, 2].argmax()], reach / 40
    return place[2]


class Router:
    """A controller with three axes that runs G0 and G1 in millimetres, and keeps the moves in contact by their kind."""

    def __init__(self, text):
        self.place, self.mode, self.feed, self.kind = np.array([0.0, 0.0, math.inf]), None, None, ""
        self.moves, self.units, self.absolute, self.ended = {"Roughing": [], "Finish": []}, False, False, False
        for line in text.splitlines():
            self.run(line)

    def run(self, line):
        assert len(line) <= 80 and line.isascii() and not self.ended
        if line.startswith("("):
            self.kind = line[1:-1]
            return
        words = NUMBERED.findall(line)
        assert "".join(a + b for a, b in words) == line.replace(" ", ""), line
        target = self.place.copy()
        for letter, value in words:
            match letter:
                case "G" if value in ("0", "1"):
                    self.mode = int(value)
                case "G":
                    assert value in ("21", "90", "94", "17")
                    self.units, self.absolute = self.units or value == "21", self.absolute or value == "90"
                case "F":
                    self.feed = float(value)
                case "M":
                    self.ended = value == "2"
                case axis:
                    target["XYZ".index(axis)] = float(value)
        if (target != self.place).any():
            assert self.units and self.absolute and (self.mode == 0 or self.feed > 0)
            if self.mode == 0:  # rapid moves: up, or across above the blank
                assert target[2] >= 1.0 and (self.place[2] == target[2] or (self.place[:2] == target[:2]).all())
            else:
                self.moves[self.kind].append((self.place, target))
        self.place = target


def clearance(moves, radius, lift, points, step):
    """Distances of points from a ball that runs along straight moves, less its radius, to step² / (8 r)."""
    begin, end = (np.array(each) for each in zip(*moves, strict=True))
    begin, end = (each[np.isfinite(begin[:, 2])] for each in (begin, end))
    parts = np.maximum(np.ceil(np.linalg.norm(end - begin, axis=1) / step), 1).astype(int)
    which = np.repeat(np.arange(len(parts)), parts)
    share = (np.arange(len(which)) - np.repeat(np.cumsum(parts) - parts, parts) + 1) / parts[which]
    centres = begin[which] + share[:, None] * (end - begin)[which] + (0.0, 0.0, lift + radius)
    return cKDTree(np.concatenate([centres, begin[:1] + (0.0, 0.0, lift + radius)])).query(points)[0] - radius


def stated(text):
    """Deepest gouge and highest cusp (mm) that the text beside a path states."""
    units = {"mm": 1.0, "µm": 1e-3, "nm": 1e-6, "pm": 1e-9, "": 0.0}
    found = re.search(r"gouge ([\d.]+) ?(\wm|), highest cusp ([\d.]+) (\wm)", text)
    return float(found[1]) * units[found[2]], float(found[3]) * units[found[4]]


def mill(lens, spacing, step, **settings):
    """Run a raster; return the router, and the clearances of roughing and of all moves over the face."""
    files = written("raster", lens, **settings)
    router = Router(files["toolpath-raster.nc"])
    points, net = points_on(lens.back, lens.outline, spacing), lens.back
    radius, stock = settings.get("tool_radius", 1.5), settings.get("stock", 0.2)
    lift = highest(net, lens.outline) + stock  # Z0 is the top of the blank
    rough = clearance(router.moves["Roughing"], radius, lift, points, step) if stock else None
    found = clearance(router.moves["Roughing"] + router.moves["Finish"], radius, lift, points, step)
    return router, rough, found, files


@pytest.mark.parametrize(
    ("outline", "along"), suite.in_turns([(Rectangle(9.0, 7.0), "x"), (Circle(4.0), "y")], 2), ids=["plate", "disc"]
)
def test_a_router_cuts_the_face_without_gouge_and_with_the_cusps_that_are_stated(outline, along):
    router, rough, found, files = mill(lens_of(waves, outline), 0.04, 0.03, along=along)
    gouge, cusp = stated(files["toolpath-raster.txt"])
    assert router.ended and -found.min() < 1e-3 and -found.min() < gouge + 1e-4  # 1 µm, and 0.1 µm by this shop
    assert found.max() == pytest.approx(cusp, rel=0.05)
    assert 0.9 * 0.01 < cusp < 1.05 * 0.01  # as asked by default
    assert rough.min() > 0.2 - 0.025  # roughing leaves the stock of 0.2 mm, within a tenth
    assert rough.max() < 0.2 + 0.75**2 / 12 / 0.8 + 0.02  # and nothing above it but its own cusps
    levels = {-1.0, -2.0, -3.0}
    lowest = [min(target[2] for _, target in router.moves["Roughing"])]
    assert min(lowest) > -3.0 and any(target[2] in levels for _, target in router.moves["Roughing"])


def test_a_ball_that_is_too_large_is_said_where_it_does_not_reach():
    """A groove along y with a radius of 0.45 mm, and a ball of 1.5 mm: the ball rests on its shoulders."""
    lens = lens_of(lambda x, y: -0.1 * np.exp(-((x / 0.3) ** 2)) + 0 * y, Rectangle(6.0, 4.0), m=129)
    _, _, found, files = mill(lens, 0.03, 0.03, stock=0.0)
    text = files["toolpath-raster.txt"]
    fraction, left = re.search(r"does not reach ([\d.]+) % of the face, where ([\d.]+) µm stays", text).groups()
    expected = 100 * (found > 2 * 0.01).mean()
    assert 2 < expected < 30 and float(fraction) == pytest.approx(expected, rel=0.25)
    assert float(left) == pytest.approx(1e3 * found.max(), rel=0.05)
    assert -found.min() < 1e-3
    picture = np.asarray(Image.open(io.BytesIO(files["toolpath-raster-unreached.png"])).convert("RGB"), float)
    assert (np.abs(picture - (213, 94, 0)).sum(-1) < 60).sum() > 200  # the line around the groove


def turned(lens, planes, spacing, **settings):
    """Run the table of a spiral; return the clearances of the face from the nose in some planes, and the text."""
    files = written("spiral", lens, **settings)
    head, rows = files["toolpath-spiral.csv"].split("\n", 1)
    assert head == "c_deg,x_mm,z_mm"
    c, x, z = np.loadtxt(io.StringIO(rows), delimiter=",").T
    assert (np.diff(c) > 0).all() and (np.diff(x) <= 0).all() and x[-1] == 0
    radius, vertex = settings.get("tool_radius", 0.5), exact(lens.back, np.zeros(1), np.zeros(1))[0]
    found = []
    for angle in planes:
        a, b = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        centres = []
        for side, start in ((1, angle), (-1, angle + 180)):  # the plane has two sides of the axis
            at = np.arange(start, c[-1], 360.0)
            at = at[at >= 0]
            centres.append(np.column_stack([side * np.interp(at, c, x), np.interp(at, c, z) + vertex + radius]))
        s = np.arange(-10.0, 10.0, spacing)
        s = s[lens.outline.depth(s * a, s * b) >= 0]
        face = np.column_stack([s, exact(lens.back, s * a, s * b)])
        found.append(cKDTree(np.concatenate(centres)).query(face)[0] - radius)
    return np.concatenate(found), files["toolpath-spiral.txt"]


@pytest.mark.parametrize("outline", suite.in_turns([Circle(3.0), Rectangle(5.0, 3.0)], 2), ids=["disc", "plate"])
def test_a_lathe_cuts_the_face_without_gouge_and_with_the_cusps_that_are_stated(outline):
    planes = np.random.default_rng(3).uniform(0, 180, 20)
    found, text = turned(lens_of(waves, outline, wide=1.2), planes, 2e-3, cusp=4e-4)
    gouge, cusp = stated(text)
    assert -found.min() < 1e-5 and gouge < 1e-5  # 10 nm
    assert found.max() == pytest.approx(cusp, rel=0.05) and 0.9 * 4e-4 < cusp < 1.05 * 4e-4


@pytest.mark.bench
def test_the_plate_of_the_sun_is_milled():
    """100 mm with a ball of 3 mm diameter, as the acceptance asks."""
    lens = lens_of(lambda x, y: 5 * waves(x / 5, y / 5), Rectangle(100.0, 100.0), m=257)
    _, _, found, files = mill(lens, 0.1, 0.04)
    gouge, cusp = stated(files["toolpath-raster.txt"])
    print(f"gouge {1e6 * -found.min():.0f} nm (stated {1e6 * gouge:.0f}), cusp {1e3 * found.max():.3f} µm", end=" ")
    print(f"(stated {1e3 * cusp:.3f}), {len(files['toolpath-raster.nc']) / 1e6:.1f} MB")
    assert -found.min() < 1e-3 and found.max() == pytest.approx(cusp, rel=0.05) and cusp < 1.05 * 0.01
