"""Parts of the judges that need no external program: meshes, lamps, and the comparison with a judge of our own."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bstcad.judges import comparison, faces, lamps, triangles
from bstcad.judges.faces import Off
from bstcad.judges.protocol import Seen
from bstcad.optics.channels import Channel
from bstcad.optics.measure import tubes_picture
from bstcad.optics.outlines import Circle, Rectangle, Rounded
from bstcad.optics.sources import Collimated, Point
from tests.judges.test_comparison import BEAM, DECLINED, SCREEN, lens

OUTLINES = [Circle(8.5), Rectangle(18.0, 15.0), Rounded(18.0, 15.0, corner_radius=3.0)]
SLOPES = Off(1e-6, 1e-5)  # mm, rad


@pytest.fixture
def judge(monkeypatch):
    """A judge that draws photons from the picture by ray tubes; its attributes may be changed."""

    def trace(glass, channels, screen, rays, seed):
        picture, random = tubes_picture(glass, channels, screen, 256).numpy(), np.random.default_rng(seed)
        return Seen(random.poisson(np.stack([picture] * 2) * rays / 2) / (rays / 2), rays, SLOPES)

    found = SimpleNamespace(cannot=lambda *a: "", light=lambda glass, channels: tuple(channels), trace=trace)
    monkeypatch.setitem(sys.modules, "stand_in", found)
    monkeypatch.setitem(comparison.JUDGES, "numpy", "stand_in")  # a distribution that has a version
    return found


def compared():
    target = tubes_picture(lens(), (Channel(BEAM, 1.49),), SCREEN, 256).numpy()
    return comparison.compare("numpy", lens(), (Channel(BEAM, 1.49),), SCREEN, target, rays=1 << 20, seed=3)


def test_a_judge_of_the_same_light_agrees_within_its_noise(judge):
    found = compared()
    assert found.facts["agrees"] and found.rays == 1 << 20 and found.pixels == (48, 32) and found.losses == "none"
    assert found.over_noise == pytest.approx(1.0, abs=0.3)
    assert found.moved_by == pytest.approx(1e-5 * 0.49 * 380.0 * 0.8, rel=1e-3)  # slope, n - 1, distance, pixels a mm
    assert found.facts.keys().isdisjoint(comparison.PICTURES)


@pytest.mark.parametrize("wrong", ["a turned lens", "lost light", "no light"])
def test_a_wrong_judge_is_seen(judge, wrong):
    honest = judge.trace

    def trace(glass, channels, screen, rays, seed):
        if wrong == "a turned lens":
            glass = replace(glass, back=replace(glass.back, heights=glass.back.heights.T.contiguous()))
        seen = honest(glass, channels, screen, rays, seed)
        return replace(seen, halves=seen.halves * {"lost light": 0.99, "no light": 0.0}.get(wrong, 1.0))

    judge.trace = trace
    wanted = {"a turned lens": [False, True], "lost light": [True, False], "no light": [False, False]}
    found = compared()
    assert [check.passed for check in found.checks] == wanted[wrong] and found.facts["agrees"] is False


def test_a_judge_that_declines_says_why_and_has_no_checks(judge):
    judge.cannot = lambda *a: "it is too dark"
    found = compared()
    assert found.checks == () and set(found.facts) == DECLINED and found.declined == "it is too dark"


@pytest.mark.parametrize("outline", OUTLINES, ids=lambda outline: type(outline).__name__)
def test_points_are_moved_onto_the_rim(outline):
    x, y = np.random.default_rng(0).uniform(-15, 15, (2, 2000))
    inside, on_x, on_y = faces.onto(outline, x, y)
    depth = outline.depth(x, y)
    assert np.array_equal(inside, depth >= 0) and np.array_equal(on_x[inside], x[inside])
    np.testing.assert_allclose(np.hypot(on_x - x, on_y - y), np.maximum(-depth, 0), atol=1e-12)  # the nearest point
    np.testing.assert_allclose(outline.depth(*faces.rim(outline).T), 0, atol=1e-12)


@pytest.mark.parametrize("outline", OUTLINES, ids=lambda outline: type(outline).__name__)
@pytest.mark.parametrize("up", [True, False])
def test_a_mesh_covers_its_face_and_converges(outline, up):
    face, errors = faces.face(lens().back, outline), []
    for parts in (1, 2):
        mesh, off = triangles.of_face(face, outline, parts, up)
        a, b, c = (mesh.corners[mesh.triangles[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a) / 2  # areas
        assert normals[:, 2].sum() == pytest.approx((1 if up else -1) * outline.area, rel=2e-3)
        turned = np.sum(normals * mesh.normals[mesh.triangles[:, 0]], axis=1)
        assert (turned > -1e-15).all() and outline.depth(*mesh.corners[:, :2].T).min() > -1e-9
        errors.append(off)
    assert errors[1].height < errors[0].height / 3 and errors[1].slope < errors[0].slope / 3


def test_walls_and_plates_close_the_way_beside_a_lens():
    glass = lens()
    front, back = (faces.face(surface, glass.outline) for surface in (glass.front, glass.back))
    wall, plate = triangles.wall(front, back, glass.apertures), triangles.plate(front, glass.outline)
    assert (np.sum(wall.normals * wall.corners, axis=1) > 0).all()
    assert np.abs(plate.corners[:, :2]).max() == pytest.approx(100 * 10.0)
    a, b, c = (plate.corners[plate.triangles[:, k]] for k in range(3))
    hole = 2000.0**2 - np.abs(np.cross(b - a, c - a)[:, 2]).sum() / 2
    assert hole == pytest.approx(glass.outline.area, rel=1e-6)


@pytest.mark.parametrize("aperture", [Circle(4.0), Rectangle(6.0, 3.0)])
def test_a_plate_of_light_has_the_aperture_s_area(aperture):
    disc = triangles.disc(aperture, (1.0, 2.0, 3.0), (0.0, 0.0, 1.0))
    a, b, c = (disc.corners[disc.triangles[:, k]] for k in range(3))
    assert np.cross(b - a, c - a)[:, 2].sum() / 2 == pytest.approx(aperture.area, rel=1e-4)
    assert (disc.uv.min(0), disc.uv.max(0)) == (pytest.approx([0, 0]), pytest.approx([1, 1]))


@pytest.fixture
def without_mitsuba(monkeypatch):
    monkeypatch.setattr(lamps, "_texture", lambda values: values)
    monkeypatch.setattr(lamps, "_looking", lambda place, along: (place, along))


def test_a_slide_of_a_lambertian_point_has_the_view_factor_of_its_square(without_mitsuba, tmp_path):
    """A/√(1+A²) atan(A/√(1+A²)) · 4/π of a square of slopes up to A (Howell, catalogue of view factors, B-4)."""
    source = Point((0.5, -1.0, -20.0), profile="lambertian")
    made = lamps.of((Channel(source, 1.49, weight=1.0),), lens(), tmp_path)
    half = math.tan(math.radians(made["lamp0"]["fov"] / 2))
    assert 11 / 32 < half < 1.1 * 11 / 32  # the farther rim of the lens, 10 + 1 mm off
    flux = made["slide"].mean() * (2 * half) ** 2
    root = half / math.sqrt(1 + half**2)
    assert flux == pytest.approx(4 / math.pi * root * math.atan(root), rel=1e-4)
    assert made["lamp0"]["scale"] * math.pi == pytest.approx(1.0)


def test_a_spot_has_the_intensity_of_its_cone_and_a_beam_its_radiance(without_mitsuba, tmp_path):
    cone = Point((0.0, 0.0, 90.0), profile="uniform", half_angle=5.0)
    [spot] = lamps.of((Channel(cone, 1.49, weight=0.5),), lens(), tmp_path).values()
    solid_angle = 2 * math.pi * (1 - math.cos(math.radians(5.0)))
    assert spot["intensity"]["value"] * solid_angle == pytest.approx(0.5) and spot["to_world"][1][2] < 0  # down
    beam = Collimated(Rectangle(4.0, 5.0), z=0.0)
    [plate] = lamps.of((Channel(beam, 1.49, weight=1.0),), lens(), tmp_path).values()
    assert plate["emitter"]["radiance"]["value"] == pytest.approx(1 / 20.0) and (tmp_path / "lamp0.ply").exists()
