"""Laws at numbers that nobody chose: hypothesis draws them, the same ones in every run.

Of the spline; of the scene reader (what is valid is kept and comes back, the rest is a sentence); and of the trace:
light is accounted for, hits are hits, mirrors are kept.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bstcad.optics import bspline, trace
from bstcad.optics.interfaces import Refract, deflect, intersect
from bstcad.optics.irradiance import LEDGER, Screen
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.rays import Status
from bstcad.optics.sources import Collimated, Point
from bstcad.optics.surfaces import Sphere
from bstcad.scene.scene import SceneError, load
from tests.hard_cases.lenses import SQUARE, N, eps, examples, largest, places, uniform, wavy
from tests.tracing import simulated, simulated_plain

EPS = eps(torch.float64)
FORMS = (bspline.evaluate, bspline.evaluate_plain)


SIZES = st.integers(5, 60)
SEEDS = st.integers(0, 2**31)
WHERE = st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)), min_size=1, max_size=12)


def on_net(where, m: int) -> tuple[torch.Tensor, torch.Tensor]:
    u, v = torch.tensor(where, dtype=torch.float64).T * (m - 1)
    return u.contiguous(), v.contiguous()


def heights_of(m: int, seed: int) -> torch.Tensor:
    return uniform((m, m), seed, -1.0, 1.0)


@given(SIZES, SEEDS, WHERE, *[st.floats(-3.0, 3.0)] * 4)
@examples(40)
def test_affine_maps_of_the_net_are_those_of_the_surface(m, seed, where, a, b, c, d):
    heights, (u, v) = heights_of(m, seed), on_net(where, m)
    i = torch.arange(m, dtype=torch.float64)
    moved = a * heights + b * i[:, None] / m + c * i / m + d
    for form in FORMS:
        h, h_u, h_v = form(heights, u, v)
        g, g_u, g_v = form(moved, u, v)
        # sums of nine products of numbers up to 12; slopes are differences of them, by 2 per unit of u
        assert largest(g - (a * h + b * u / m + c * v / m + d)) <= 32 * 12 * EPS
        assert largest(g_u - (a * h_u + b / m)) <= 64 * 12 * EPS
        assert largest(g_v - (a * h_v + c / m)) <= 64 * 12 * EPS


@given(SIZES, SEEDS, WHERE, SEEDS)
@examples(40)
def test_a_control_point_moves_its_own_place_only(m, seed, where, which):
    """Locality: three spans each way; elsewhere not a bit changes."""
    heights, (u, v) = heights_of(m, seed), on_net(where, m)
    i, j = which % m, which // m % m
    moved = heights.clone()
    moved[i, j] += 1.0
    first, other = (bspline.basis(p, m)[0] for p in (u, v))
    near = (i >= first) & (i <= first + 2) & (j >= other) & (j <= other + 2)
    for form in FORMS:
        for before, after in zip(form(heights, u, v), form(moved, u, v), strict=True):
            assert torch.equal(before[~near], after[~near])


@given(SIZES, SEEDS, WHERE)
@examples(40)
def test_the_gradient_is_the_transpose(m, seed, where):
    """⟨g, E h⟩ = ⟨Eᵀ g, h⟩ for value and slopes; and both forms give it."""
    heights, (u, v) = heights_of(m, seed).requires_grad_(), on_net(where, m)
    weights = uniform((3, u.numel()), seed + 1, -1.0, 1.0)
    found = []
    for form in FORMS:
        merit = sum((w * t).sum() for w, t in zip(weights, form(heights, u, v), strict=True))
        (g,) = torch.autograd.grad(merit, heights)
        found.append(g)
        # sums of nine products a point, slopes of 2 among them
        assert float(merit.detach() - (g * heights.detach()).sum()) == pytest.approx(0, abs=64 * EPS * u.numel())
    assert largest(found[0] - found[1]) <= 64 * EPS * u.numel()


DISK = Path(__file__).parent.parent.parent / "templates" / "disk.toml"
NUMBERS = {  # a key of templates/disk.toml and what may stand there
    "source.wavelength": st.floats(405.0, 1080.0),
    "lens.index": st.floats(1.3, 2.5),
    "lens.front.z": st.floats(5.0, 19.0),
    "lens.back.z": st.floats(19.6, 400.0),
    "lens.back.control_points": st.integers(5, 2049),
    "lens.outline.width": st.floats(1.0, 200.0),
    "target.z": st.floats(401.0, 1e7),
    "target.pixels": st.integers(8, 96),
    "tailoring.seed": st.integers(0, 2**63 - 1),
    "tailoring.rounds": st.integers(1, 100),
    "tailoring.overshoot": st.floats(0.0, 1e3),
    "accept.rrmsd": st.floats(1e-6, 10.0),
    "accept.form": st.floats(1e-12, 1.0),
}
WORDS = {
    "name": st.from_regex(r"[a-z][a-z0-9_-]{0,20}", fullmatch=True),
    "title": st.text(max_size=40).map("a {}".format).filter(str.isprintable),
    "tailoring.quality": st.sampled_from(["draft", "standard", "fine"]),
}
OVERRIDES = st.fixed_dictionaries({}, optional=NUMBERS | WORDS)


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


@given(OVERRIDES)
@examples(30)
def test_text_on_the_command_line_is_read_as_the_value(overrides):
    """As `--set` hands it over; a title is text whatever it looks like only if it is no TOML value."""
    overrides = {key: value for key, value in overrides.items() if key not in WORDS}
    told = {key: repr(value) for key, value in overrides.items()}
    assert load(DISK, {"target.pixels": "16", **told}) == load(DISK, {"target.pixels": 16, **overrides})


TABLES = ("", "source.", "lens.", "lens.front.", "lens.back.", "lens.outline.", "target.", "target.outline.",
          "tailoring.", "accept.")  # fmt: skip
VALUES = st.one_of(
    st.integers(-(2**40), 2**40), st.floats(allow_nan=False), st.booleans(), st.text(max_size=8),
    st.lists(st.integers(0, 3), max_size=3),
)  # fmt: skip


def is_a_sentence(text: str) -> bool:
    return "\n" not in text and len(text) < 500 and not re.search(r"pydantic|Traceback|validation error", text)


@given(st.sampled_from(TABLES), st.from_regex(r"[a-z][a-z0-9_]{2,12}", fullmatch=True), VALUES)
@examples(80)
def test_an_unknown_key_is_a_sentence_that_names_it(table, key, value):
    known = {"name", "title", "source", "lens", "target", "tailoring", "effects", "accept", "tolerance"}
    key = f"zz{key}" if not table and key in known else key
    try:
        load(DISK, {"target.pixels": 16, table + key: value})
    except SceneError as error:
        assert is_a_sentence(str(error))
        infinite = isinstance(value, float) and not abs(value) < 1e300
        assert (table + key in str(error)) or infinite
        return
    at(load(DISK, {"target.pixels": 16, table + key: value}), table + key)  # it was a key after all


EPS = eps(torch.float64)
SEEDS = st.integers(0, 2**31)
DEPTH = st.floats(-1.5, 1.5)
CURVATURE = st.floats(-0.03, 0.03)
SOURCES = st.sampled_from(
    [
        Point(),
        Point((0.5, -1.0, 3.0), profile="uniform", half_angle=35.0),
        Point((-1.0, 0.25, 0.0), profile="gaussian", half_angle_1e2=25.0),
        Collimated(Circle(12.0)),
        Collimated(Rectangle(18.0, 12.0), profile="gaussian", radius_1e2=8.0),
    ]
)
OUTLINES = st.sampled_from([SQUARE, Circle(9.0), Rectangle(18.0, 14.0)])


def lens_with(depth, curvature, outline=SQUARE, ripple=0.03, dtype=torch.float64) -> Lens:
    return Lens(Sphere(15.0, curvature), wavy(dtype, m=17, depth=depth, ripple=ripple), outline, N)


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
    """At both faces: F = 0 to rounding, the path there is forwards, along the ray, inside the outline."""
    x, y = uniform((2, 200), seed, -11.0, 11.0)
    lens = lens_with(depth, curvature, ripple=ripple)
    rays = source.rays(x, y, 15.0, 1.0)
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
    mirrored = replace(lens, back=replace(lens.back, heights=lens.back.heights.flip(k).contiguous()))
    points = uniform((2, 100), seed, -8.0, 8.0)
    place = [0.5, -0.75, 1.0]
    landed = trace.trace(Point(tuple(place)).rays(*points, 15.0, 1.0), lens, 500.0)
    place[k], points[k] = -place[k], -points[k]
    other = trace.trace(Point(tuple(place)).rays(*points, 15.0, 1.0), mirrored, 500.0)
    assert torch.equal(landed.status, other.status)
    back = other.position.clone()
    back[k] = -back[k]
    lands = landed.alive
    # the mirrored place on the net is another float, of 12 mm; 500 mm of throw by slopes that are known to units
    off = (back - landed.position)[:, lands].abs() / (1 + landed.position[:, lands].abs() ** 2 / 500)
    assert largest(off) <= 500 * 64 * EPS
