"""Faces, meshes and lamps for judges, against bstcad's own surfaces, areas and closed forms; no judge is needed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.optics.light.channels import Channel, channels_of
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.surfaces.outlines import Circle, Rectangle, Rounded
from bstcad.optics.surfaces.surfaces import Conic, Plane, Sphere, sag
from bstcad.verify.judges import faces, mitsuba
from bstcad.verify.judges.faces import FaceError
from tests.verify.judges.lenses import MIRROR, SCREEN, lens, waved

OUTLINES = pytest.mark.parametrize(
    "outline", [Circle(8.5), Rectangle(18.0, 15.0), Rounded(18.0, 15.0, corner_radius=3.0)],
    ids=lambda outline: type(outline).__name__,
)  # fmt: skip


@pytest.mark.parametrize(
    "surface",
    [waved(), waved(m=(33, 21)), Plane(3.0), Sphere(12.0, -0.01), Conic(12.0, 0.02, -0.5)],
    ids=lambda s: s.kind,
)
def test_faces_are_those_of_the_lens(surface):
    """scipy's spline against bstcad's, in the rim's uneven spans too, and between an even grid's lines."""
    face = faces.face(surface, Circle(9.0))
    x, y = faces.random_points(Rectangle(20.0, 20.0), 500, seed=1)
    found = face.at(x, y)
    exact = [p.numpy() for p in surface.sag_and_slope(*map(torch.from_numpy, (x, y)))]
    np.testing.assert_allclose(np.stack([found.z, found.z_x, found.z_y]), np.stack(exact), atol=1e-12)
    grid = face.on_grid(*face.lines(1))
    np.testing.assert_allclose(grid.z, sag(surface, grid.x, grid.y), atol=1e-12)


def test_the_mixed_derivative_is_that_of_the_slope():
    face, (x, y), step = faces.face(waved(), Circle(9.0)), np.linspace(-8.9, 8.7, (2 * 7)).reshape(2, 7), 1e-5
    higher, lower = (face.on_grid(x, y + by).z_x for by in (step, -step))
    np.testing.assert_allclose(face.on_grid(x, y).z_xy, (higher - lower) / (2 * step), atol=1e-8)


@OUTLINES
def test_points_are_moved_onto_the_rim(outline):
    x, y = np.random.default_rng(0).uniform(-15, 15, (2, 2000))
    inside, on_x, on_y = faces.clip_to_rim(outline, x, y)
    depth = outline.depth(x, y)
    assert np.array_equal(inside, depth >= 0) and np.array_equal(on_x[inside], x[inside])
    np.testing.assert_allclose(np.hypot(on_x - x, on_y - y), np.maximum(-depth, 0), atol=1e-12)  # the nearest point
    np.testing.assert_allclose(outline.depth(*faces.rim(outline).T), 0, atol=1e-12)


def areas(mesh):
    """(k, 3) normals of the triangles, as long as their areas (mm²)."""
    return mesh.face_normals * mesh.area_faces[:, None]


@OUTLINES
@pytest.mark.parametrize("up", [True, False])
def test_a_mesh_covers_its_face_and_converges(outline, up):
    face, errors = faces.face(lens().back, outline), []
    for parts in (1, 2):
        mesh, error = faces.face_mesh(face, outline, parts, up)
        normals = areas(mesh)
        assert normals[:, 2].sum() == pytest.approx((1 if up else -1) * outline.area, rel=2e-3)
        assert (np.sum(normals * mesh.vertex_normals[mesh.faces[:, 0]], axis=1) > -1e-15).all()
        assert outline.depth(*mesh.vertices[:, :2].T).min() > -1e-9
        errors.append(error)
    assert errors[1].height < errors[0].height / 3 and errors[1].slope < errors[0].slope / 3


def test_walls_and_plates_close_the_way_beside_a_lens():
    glass = lens()
    front, back = (faces.face(surface, glass.outline) for surface in (glass.front, glass.back))
    wall, plate = faces.wall(front, back, glass.apertures), faces.plate(front, glass.outline)
    assert (np.sum(wall.vertex_normals * wall.vertices, axis=1) > 0).all()
    assert np.abs(plate.vertices[:, :2]).max() == pytest.approx(100 * 10.0)
    assert 2000.0**2 - np.abs(areas(plate)[:, 2]).sum() == pytest.approx(glass.outline.area, rel=1e-6)  # of the hole


@pytest.mark.parametrize("aperture", [Circle(4.0), Rectangle(6.0, 3.0)])
def test_a_plate_of_light_has_the_aperture_s_area(aperture):
    disc = faces.disc(aperture, (1.0, 2.0, 3.0), (0.0, 0.0, 1.0))
    assert areas(disc)[:, 2].sum() == pytest.approx(aperture.area, rel=1e-4)
    for at in "uv":
        values = disc.vertex_attributes[at]
        assert (values.min(), values.max()) == pytest.approx((0.0, 1.0))


def test_an_error_of_a_face_is_that_of_the_worse_and_moves_light():
    """A face turns light by (n - 1) times its angle, a mirror by twice that; 380 mm to the screen."""
    worst = FaceError.worst([FaceError(1e-3, 1e-6), FaceError(1e-6, 1e-5)])
    assert worst == FaceError(1e-3, 1e-5)
    assert worst.shift(lens(), SCREEN) == pytest.approx(1e-5 * 0.49 * 380.0)
    assert worst.shift(MIRROR, SCREEN) == pytest.approx(1e-5 * 2 * 380.0)


@pytest.fixture
def without_mitsuba(monkeypatch):
    monkeypatch.setattr(mitsuba, "_texture", lambda values: values)
    monkeypatch.setattr(mitsuba, "_look_along", lambda place, along: (place, along))


def test_a_slide_of_a_lambertian_point_has_the_view_factor_of_its_square(without_mitsuba, tmp_path):
    """A/√(1+A²) atan(A/√(1+A²)) · 4/π of a square of slopes up to A (Howell, catalogue of view factors, B-4)."""
    source = PointSource((0.5, -1.0, -20.0), profile="lambertian")
    made = mitsuba.lamps((Channel(source, 1.49, weight=1.0),), lens(), tmp_path)
    half = math.tan(math.radians(made["lamp0"]["fov"] / 2))
    assert 11 / 32 < half < 1.1 * 11 / 32  # the farther rim of the lens, 10 + 1 mm off
    root = half / math.sqrt(1 + half**2)
    assert made["slide"].mean() * (2 * half) ** 2 == pytest.approx(4 / math.pi * root * math.atan(root), rel=1e-4)
    assert made["lamp0"]["scale"] * math.pi == pytest.approx(1.0)


def test_a_spot_has_the_intensity_of_its_cone_and_a_beam_its_radiance(without_mitsuba, tmp_path):
    cone = PointSource((0.0, 0.0, 90.0), profile="uniform", half_angle=5.0)
    [spot] = mitsuba.lamps((Channel(cone, 1.49, weight=0.5),), lens(), tmp_path).values()
    solid_angle = 2 * math.pi * (1 - math.cos(math.radians(5.0)))
    assert spot["intensity"]["value"] * solid_angle == pytest.approx(0.5) and spot["to_world"][1][2] < 0  # down
    beam = CollimatedSource(Rectangle(4.0, 5.0), z=0.0)
    [plate] = mitsuba.lamps((Channel(beam, 1.49, weight=1.0),), lens(), tmp_path).values()
    assert plate["emitter"]["radiance"]["value"] == pytest.approx(1 / 20.0) and (tmp_path / "lamp0.ply").exists()


def test_mitsuba_declines_plates_of_light_that_stand_in_the_light():
    """One plate for each direction of the sun, and a plate before a mirror: all dark."""
    beam, glass = CollimatedSource(Rectangle(4.0, 5.0)), lens()
    suns = channels_of(replace(beam, divergence=0.5), lambda nm: glass.index, points=4)
    assert mitsuba.cannot(glass, (Channel(beam, 1.49),)) == ""
    assert "many directions" in mitsuba.cannot(glass, suns)
    assert "a parallel beam that comes down to a mirror" in mitsuba.cannot(MIRROR, (Channel(beam, 1.49),))
