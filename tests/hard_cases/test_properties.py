"""Laws at numbers that nobody chose: hypothesis draws them, the same ones in every run.

Of the scene reader: what is valid is kept and comes back; and of the trace: light is accounted for, hits are hits,
mirrors are kept.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bstcad.optics.lens.interfaces import Refract
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import LEDGER, Screen
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.optics.trace import trace
from bstcad.scene.scene import load
from tests.by_slope import deflect, intersect
from tests.hard_cases.lenses import eps, examples, largest
from tests.lenses import SQUARE, N, places, uniform, wavy
from tests.scenes import DISK
from tests.tracing import simulated, simulated_plain

EPS = eps(torch.float64)
SEEDS = st.integers(0, 2**31)
VALID = {  # a key of templates/disk.toml and what may stand there
    "source.wavelength": st.floats(405.0, 1080.0),
    "lens.index": st.floats(1.3, 2.5),
    "lens.front.z": st.floats(5.0, 19.0),
    "lens.back.z": st.floats(19.6, 400.0),
    "target.z": st.floats(401.0, 1e7),
    "target.pixels": st.integers(8, 96),
    "tailoring.seed": st.integers(0, 2**63 - 1),
    "accept.form": st.floats(1e-12, 1.0),
    "name": st.from_regex(r"[a-z][a-z0-9_-]{0,20}", fullmatch=True),
    "title": st.text(max_size=40).map("a {}".format).filter(str.isprintable),
    "tailoring.quality": st.sampled_from(["draft", "standard", "fine"]),
}
OVERRIDES = st.fixed_dictionaries({}, optional=VALID)


def at(scene, key: str):
    for part in key.split("."):
        scene = getattr(scene, part)
    return scene


@given(OVERRIDES)
@examples(60)
def test_what_is_asked_for_is_kept_and_comes_back(tmp_path_factory, overrides):
    """Any valid value stands in the scene as it was given; and the scene's own file loads to an equal one."""
    scene = load(DISK, {"target.pixels": 16, **overrides})
    for key, value in overrides.items():
        assert at(scene, key) == value
    path = tmp_path_factory.getbasetemp() / "again.toml"
    path.write_text(scene.toml(), encoding="utf-8")
    assert load(path) == scene


DEPTH = st.floats(-1.5, 1.5)
CURVATURE = st.floats(-0.03, 0.03)
SOURCES = st.sampled_from([
    PointSource(), PointSource((0.5, -1.0, 3.0), profile="uniform", half_angle=35.0),
    PointSource((-1.0, 0.25, 0.0), profile="gaussian", half_angle_1e2=25.0), CollimatedSource(Circle(12.0)),
    CollimatedSource(Rectangle(18.0, 12.0), profile="gaussian", radius_1e2=8.0),
])  # fmt: skip
OUTLINES = st.sampled_from([SQUARE, Circle(9.0), Rectangle(18.0, 14.0)])


def lens_with(depth, curvature, outline=SQUARE, ripple=0.03, dtype=torch.float64) -> Lens:
    return Lens.between(Sphere(15.0, curvature), wavy(dtype, m=17, depth=depth, ripple=ripple), outline, N)


@given(SOURCES, DEPTH, CURVATURE, OUTLINES, st.floats(25.0, 3000.0), SEEDS)
@examples(25)
def test_all_light_is_accounted_for(source, depth, curvature, outline, z, seed):
    """The ledger sums to 1 to 1e-12, in both forms; what lands on the screen is the sum of the picture."""
    lens = lens_with(depth, curvature, outline)
    half = 0.3 * z
    screen = Screen(z, (-half, half), (-0.7 * half, half), 24)
    told = [form(source, lens, screen, 48, seed % 1000) for form in (simulated, simulated_plain)]
    for found in told:
        assert sum(found.flux.values()) == pytest.approx(1.0, abs=1e-12)
        assert set(found.flux) == {"on target", "off target", *LEDGER}
        assert all(value >= -1e-12 for value in found.flux.values())
        assert float(found.box.sum()) == pytest.approx(found.flux["on target"], abs=1e-12)
        assert float(found.tent.sum()) <= found.flux["on target"] + found.flux["off target"] + 1e-12
    assert told[0].flux == pytest.approx(told[1].flux, abs=1e-12)


@given(SOURCES, DEPTH, CURVATURE, st.floats(0.0, 0.15), SEEDS)
@examples(40)
def test_a_hit_lies_on_its_face_and_ahead(source, depth, curvature, ripple, seed):
    """Hits at both faces: F = 0 to rounding, the path is forwards, along the ray, inside the outline."""
    x, y = uniform((2, 200), seed, -11.0, 11.0)
    lens = lens_with(depth, curvature, ripple=ripple)
    rays = source.rays_through(x, y, 15.0, 1.0)
    for surface, eta in ((lens.front, (1.0, N)), (lens.back, (N, 1.0))):
        at, z_x, z_y = intersect(surface, rays, lens.outline, Status.VIGNETTED)
        there = at.alive
        h, p, q = surface.relative_sag_and_slope(*at.position[:2])
        assert largest((at.position[2] - h)[there]) <= 64 * 12 * EPS
        assert largest((z_x - p)[there]) <= 64 * EPS and largest((z_y - q)[there]) <= 64 * EPS
        path = ((places(at) - places(rays)) * rays.direction).sum(0)
        assert bool((path[there] >= 0).all()) and bool(lens.outline.contains(*at.position[:2])[there].all())
        beside = torch.linalg.cross(places(at) - places(rays), rays.direction.expand_as(at.position), dim=0)
        assert largest(beside[:, there]) <= 64 * 20 * EPS
        rays = deflect(at, z_x, z_y, Refract(*eta)).rays


@given(DEPTH, CURVATURE, SEEDS, st.sampled_from(["x", "y"]))
@examples(25)
def test_a_mirrored_scene_lands_mirrored(depth, curvature, seed, axis):
    lens = lens_with(depth, curvature)
    k = "xy".index(axis)
    mirrored = lens.with_back(replace(lens.back, heights=lens.back.heights.flip(k).contiguous()))
    points = uniform((2, 100), seed, -8.0, 8.0)
    place = [0.5, -0.75, 1.0]
    landed = trace.trace(PointSource(tuple(place)).rays_through(*points, 15.0, 1.0), lens, LevelPlane(500.0))
    place[k], points[k] = -place[k], -points[k]
    other = trace.trace(PointSource(tuple(place)).rays_through(*points, 15.0, 1.0), mirrored, LevelPlane(500.0))
    assert torch.equal(landed.status, other.status)
    back = other.position.clone()
    back[k] = -back[k]
    lands = landed.alive
    # the mirrored place on the net is another float, of 12 mm; 500 mm of throw by slopes that are known to units
    off = (back - landed.position)[:, lands].abs() / (1 + landed.position[:, lands].abs() ** 2 / 500)
    assert largest(off) <= 500 * 64 * EPS
