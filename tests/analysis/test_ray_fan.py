"""The drawn rays are rays: each leg straight through the faces by Snell's law, from the source to the target."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bstcad.analysis.ray_fan import LINES, RAYS, fan, ray_map
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.sources import Collimated, Point
from bstcad.optics.surfaces import Plane, Sphere

SCREEN = 300.0  # mm
INDEX = 1.5
EXACT = 1e-9  # mm; the trace stops at 1e-12 of the lens's size, the way to the screen makes a hundred times more of it
BEAM = Collimated(Circle(6.0), z=-5.0)
LAMP = Point((0.4, 0.0, -30.0))
SOURCES = pytest.mark.parametrize("source", [BEAM, LAMP], ids=["beam", "lamp"])


def lens_of(sag, front, outline=None, m=33):
    """A lens of 16 x 12 mm whose net's heights are sag(x, y)."""
    outline = outline or Rectangle(16.0, 12.0)
    a, b = outline.half_extent
    x, y = torch.linspace(-a, a, m).double()[:, None], torch.linspace(-b, b, m).double()[None, :]
    return Lens(front, BSplineSurface(10.0, sag(x, y) + 0 * x * y, (-a, a), (-b, b)), outline, INDEX)


def rough():
    return lens_of(lambda x, y: 0.05 * torch.sin(x / 2) * torch.cos(y / 3) - 0.01 * (x * x + y * y), Sphere(2.0, 0.01))


def off(surface, points):
    """Distance in z (mm) of points (n, 3) from a surface."""
    x, y, z = torch.from_numpy(points.copy()).T
    return float((surface.sag_and_slope(x, y)[0] - z).abs().max())


def normals(surface, points):
    x, y, _ = torch.from_numpy(points.copy()).T
    _, z_x, z_y = surface.sag_and_slope(x, y)
    normal = torch.stack([-z_x, -z_y, torch.ones_like(z_x)], dim=1)
    return torch.nn.functional.normalize(normal, dim=1).numpy()


def legs(rays):
    """Unit directions (rays, 3, 3) of the three legs."""
    along = np.diff(rays, axis=1)
    return along / np.linalg.norm(along, axis=2, keepdims=True)


@SOURCES
def test_the_fan_runs_from_the_source_over_both_faces_to_the_target(source):
    lens = rough()
    rays = fan(source, lens, SCREEN)
    assert rays.shape[1:] == (4, 3) and RAYS - 2 <= len(rays) <= RAYS  # an outermost ray may be vignetted
    assert np.isfinite(rays).all()
    if source is LAMP:
        assert np.array_equal(rays[:, 0], np.tile(source.position, (len(rays), 1)))
    else:
        assert (rays[:, 0, 2] == source.start(lens.front.z)).all() and np.array_equal(rays[:, 0, :2], rays[:, 1, :2])
    assert off(lens.front, rays[:, 1]) < EXACT and off(lens.back, rays[:, 2]) < EXACT
    assert (rays[:, 3, 2] == SCREEN).all()
    for face in (1, 2):
        assert lens.outline.contains(*torch.from_numpy(rays[:, face, :2].copy()).T).all()
    assert (np.diff(rays[:, :, 2], axis=1) > 0).all()  # always forwards


@SOURCES
def test_each_bend_is_snells(source):
    """n sin θ is kept, as vectors: n d x N is the same on both sides of a face."""
    lens = rough()
    rays = fan(source, lens, SCREEN)
    direction = legs(rays)
    for i, (face, n_in, n_out) in enumerate(((lens.front, 1.0, INDEX), (lens.back, INDEX, 1.0))):
        normal = normals(face, rays[:, i + 1])
        before, after = (n * np.cross(direction[:, i + k], normal) for k, n in ((0, n_in), (1, n_out)))
        assert np.abs(after - before).max() < 1e-10
        assert np.abs(after).max() > 1e-3  # and there is a bend


@SOURCES
def test_the_fan_lies_in_its_section_and_keeps_its_order(source):
    """A lens that is even in y, gently curved: the section stays plane and no ray overtakes another."""
    lens = lens_of(lambda x, y: -0.008 * (x * x + y * y), Plane(2.0))
    rays = fan(source, lens, 60.0)  # before the focus
    assert len(rays) >= RAYS - 1 and np.abs(rays[..., 1]).max() < EXACT
    for stop in (1, 2, 3):
        assert (np.diff(rays[:, stop, 0]) > 0).all()


def test_rays_that_do_not_arrive_are_not_drawn():
    steep = lens_of(lambda x, y: 2.0 * x, Plane(-10.0))  # beyond the critical angle everywhere
    assert fan(BEAM, steep, SCREEN).shape == (0, 4, 3)
    lamp = Point((0.0, 0.0, -2.0))  # so near that the side faces take the outer rays
    rays = fan(lamp, lens_of(lambda x, y: 0 * x, Plane(0.0)), SCREEN)
    assert 0 < len(rays) <= RAYS and np.isfinite(rays).all()


@pytest.mark.parametrize("index", [INDEX, 1.0], ids=["glass", "air"])
def test_a_flat_plate_maps_a_beam_onto_itself(index):
    plate = lens_of(lambda x, y: 0 * x, Plane(2.0))
    start, end = ray_map(BEAM, Lens(plate.front, plate.back, plate.outline, index), SCREEN)
    assert start.shape == end.shape == (LINES, LINES, 2)
    lit = np.isfinite(start).all(axis=-1)
    assert np.abs(end - start)[lit].max() < EXACT
    assert np.hypot(*start[lit].T).max() <= 6.0  # nothing outside the round beam
    assert not lit[0, 0] and lit[LINES // 2, LINES // 2]
    assert lit.mean() == pytest.approx(np.pi / 4, abs=0.1)


def test_without_bending_a_lamp_casts_a_shadow_in_proportion():
    """Index 1: a point (x, y) of the front's plane lands where the straight line from the lamp does."""
    air = Lens(Plane(2.0), lens_of(lambda x, y: 0.1 * x, Plane(2.0)).back, Rectangle(16.0, 12.0), 1.0)
    start, end = ray_map(LAMP, air, SCREEN)
    lamp = np.array(LAMP.position)
    wanted = lamp[:2] + (start - lamp[:2]) * (SCREEN - lamp[2]) / (2.0 - lamp[2])
    lit = np.isfinite(end).all(axis=-1)
    assert lit.sum() > 0.8 * LINES**2
    assert np.abs(end - wanted)[lit].max() < 1e-8
    assert np.array_equal(np.isnan(start), np.isnan(end))  # a lost ray is drawn on neither side


def test_the_map_and_the_fan_are_the_same_light():
    lens = rough()
    start, end = ray_map(BEAM, lens, SCREEN)
    middle = LINES // 2
    assert np.abs(start[:, middle, 1][np.isfinite(start[:, middle, 1])]).max() < 1e-12
    rays = fan(BEAM, lens, SCREEN)
    along = np.isfinite(end[:, middle]).all(axis=-1)
    between = np.interp(rays[1:-1, 0, 0], start[along, middle, 0], end[along, middle, 0])
    assert np.abs(between - rays[1:-1, 3, 0]).max() < 0.5  # mm, of some 30: linear between the map's lines
