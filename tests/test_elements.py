"""Windows and mirrors around a lens: their faces, where a lens sees a target by way of them, and a design with both."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import bstcad
from bstcad.figures.figure_jobs import side_view
from bstcad.figures.light_figures import View
from bstcad.manufacture.tolerance.perturbations import Setup
from bstcad.optics.lens.interfaces import Interface, Refract
from bstcad.optics.lens.media import refractive_index
from bstcad.optics.receivers.receivers import LevelPlane, TiltedPlane
from bstcad.optics.surfaces.motion import Motion
from bstcad.optics.surfaces.rays import Rays, Status
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.surfaces.tilted import TiltedSurface
from bstcad.optics.trace.trace import across
from bstcad.optics.trace.unfolding import image, image_screen
from bstcad.scene.elements import Mirror, Window, interfaces
from bstcad.scene.errors import SceneError
from bstcad.tailoring import slope_map
from bstcad.verify import step_checks
from bstcad.verify.judges.comparison import JudgeEffort, compare
from tests import suite
from tests.conftest import quick_effort
from tests.scenes import DISK, designed

ROUND = {"shape": "circle", "radius": 300.0}
WINDOW = {
    "kind": "window",
    "z": 5.0,
    "thickness": 3.0,
    "material": "N-BK7",
    "outline": {"shape": "circle", "radius": 20.0},
}
FOLD = {"kind": "mirror", "z": 250.0, "tilt": [0.0, 20.0], "outline": {"shape": "circle", "radius": 150.0}}
FOLDED = {  # the light goes on along (-sin 40°, 0, -cos 40°): as far from the lens as without the mirror
    "before": [WINDOW], "behind": [FOLD], "target.z": 58.0, "target.x": [-310.0, -10.0], "target.y": [-150.0, 150.0],
    "target.tilt": [0.0, 40.0], "target.outline": {"shape": "circle", "radius": 140.0},
}  # fmt: skip
SMALL = {
    "lens.back.control_points": 33, "target.pixels": 48, "tailoring.quality": "draft", "tailoring.rays": 256,
    "tailoring.transport_grid": 64, "tailoring.levels": None, "accept.rrmsd": 0.1,
}  # fmt: skip


def random_rays(n=400, sense=1, z=0.0):
    """Rays that go within 0.3 rad of the axis, along +z or -z."""
    draw = np.random.default_rng(5)
    way = np.stack([*draw.uniform(-0.3, 0.3, (2, n)), np.full(n, float(sense))])
    start = np.stack([*draw.uniform(-8, 8, (2, n)), np.zeros(n)])
    way, start = torch.from_numpy(way / np.linalg.norm(way, axis=0)), torch.from_numpy(start)
    return Rays(start, way, torch.ones(n, dtype=torch.float64), torch.zeros(n, dtype=torch.uint8), z=z, sense=sense)


def made(kind, **keys):
    outline = bstcad.Circle(300.0)
    return (Window if kind == "window" else Mirror)(kind=kind, outline=outline, **keys)


# --- faces ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bend", [0.0, 0.004, -0.004])
@pytest.mark.parametrize("sense", [1, -1])
def test_rays_meet_a_tilted_face_on_its_equation(bend, sense):
    """c |p - V|² = 2 N · (p - V) at the end p of the way along the ray, and the height and slopes are those of p."""
    tilt = Motion.of(turn=(12.0, -20.0, 0.0), about=(1.0, 2.0, 30.0), shift=(3.0, -1.0, 0.5))
    face = TiltedSurface.of(Sphere(30.0, bend)).moved_by(tilt)
    rays = random_rays(sense=sense, z=0.0 if sense > 0 else 60.0)
    [first] = interfaces([made("mirror", z=30.0)], sense, 587.6)
    at = across(rays, (replace(first, surface=face),))
    assert bool(at.alive.all())
    p = torch.stack([*at.position[:2], at.above(0.0)]).numpy()
    off, n = p - np.array(face.vertex)[:, None], np.array(face.unit_normal)
    assert np.abs(bend * (off**2).sum(0) - 2 * n @ off).max() < 1e-12
    h, z_x, z_y = (t.numpy() for t in face.relative_sag_and_slope(*at.position[:2]))
    normal = n[:, None] - bend * off
    assert np.allclose(h, off[2] - 0, atol=1e-12) and np.allclose(z_x, -normal[0] / normal[2], atol=1e-13)
    assert np.allclose(z_y, -normal[1] / normal[2], atol=1e-13)


@pytest.mark.parametrize("surface", [Plane(3.0), Sphere(3.0, 0.01)])
def test_a_face_on_the_axis_is_the_plane_or_the_sphere(surface):
    x, y = torch.meshgrid(*[torch.linspace(-9, 9, 7, dtype=torch.float64)] * 2, indexing="ij")
    for ours, theirs in zip(TiltedSurface.of(surface).sag_and_slope(x, y), surface.sag_and_slope(x, y), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-14)


# --- where the lens sees the target -----------------------------------------------------------------------------------


@pytest.mark.parametrize("plane", [LevelPlane(20.0), TiltedPlane((-40.0, 5.0, 30.0), (5.0, 35.0))])
def test_light_by_way_of_a_mirror_lands_where_straight_light_meets_the_image(plane):
    behind = interfaces([made("mirror", z=60.0, tilt=(4.0, 10.0))], 1, 587.6)
    rays = random_rays()
    folded, straight = plane.land(across(rays, behind)), image(behind, plane).land(rays)
    assert bool(folded.alive.all()) and bool(straight.alive.all())
    torch.testing.assert_close(folded.position, straight.position, rtol=0, atol=1e-11)


def test_a_level_mirror_has_a_level_image():
    behind = interfaces([made("mirror", z=60.0)], 1, 587.6)
    assert image(behind, LevelPlane(20.0)) == LevelPlane(100.0)
    assert image((), LevelPlane(20.0)) == LevelPlane(20.0)


@pytest.mark.parametrize("folds", [0, 1])
def test_a_plate_brings_the_image_nearer(folds):
    """The image moves by t (1 - 1 / n) to first order in the angle, on either side of a mirror."""
    plate = {"z": 20.0, "thickness": 6.0, "index": 1.5}
    elements = [made("mirror", z=90.0)] * folds + [made("window", **plate)]
    behind = interfaces(elements, 1, 587.6)
    z = -10.0 if folds else 80.0
    away = 180.0 - z if folds else z
    assert image(behind, LevelPlane(z)).z == pytest.approx(away - 2.0, abs=1e-12)
    rays = random_rays()
    rays = replace(
        rays, direction=torch.nn.functional.normalize(rays.direction * torch.tensor([[0.01], [0.01], [1.0]]), dim=0)
    )
    real, seen = (LevelPlane(z).land(across(rays, behind)), image(behind, LevelPlane(z)).land(rays))
    torch.testing.assert_close(real.position, seen.position, rtol=0, atol=1e-6)


NEAR, LEVEL, LEANING = LevelPlane(14.0), LevelPlane(60.0), TiltedPlane((-40.0, 5.0, 70.0), (5.0, 35.0))


@pytest.mark.parametrize(
    "plane, window", [(NEAR, ()), (LEVEL, ()), (LEANING, ()), (LEVEL, ("window",)), (LEANING, ("window",))]
)
def test_light_out_of_the_glass_lands_where_it_is_sent(plane, window):
    """Through a flat back, of a plane that is near in less air than glass, and past a window to first order."""
    back = Interface(Plane(10.0), bstcad.Circle(300.0), Refract(1.5, 1.0), Status.VIGNETTED)
    behind = (back, *interfaces([made(kind, z=30.0, thickness=0.01, index=1.5) for kind in window], 1, 587.6))
    rays = random_rays(z=2.0)
    x, y = torch.from_numpy(np.random.default_rng(1).uniform(-40, 0, (2, 400)))
    sent = replace(rays, direction=image(behind, plane).vector_to(rays, torch.stack([x, y])))
    landed = plane.land(across(sent, behind))
    torch.testing.assert_close(landed.position, torch.stack([x, y]), rtol=0, atol=1e-2 if window else 1e-9)


# --- scenes -----------------------------------------------------------------------------------------------------------

WRONG = {
    "z of an element": ({"before": [WINDOW | {"z": 16.0}]}, r"lens\.front\.z: .*must follow the window.*\+z"),
    "before the source": ({"before": [WINDOW | {"z": -9.0}]}, r"before\[0\]\.z: .*must follow the source"),
    "order of two": ({"behind": [FOLD | {"tilt": None}, WINDOW | {"z": 300.0}]}, r"behind\[1\]\.z: .* along -z"),
    "target behind a mirror": ({"behind": [FOLD]}, r"target\.z: the target at z = 500 must follow the mirror.* -z"),
    "neither index nor material": ({"before": [WINDOW | {"material": None}]}, r"before\[0\]: needs exactly one of"),
    "curved behind": ({"behind": [FOLD | {"curvature": 0.001}], "target.z": 60.0}, r"behind\[0\]\.curvature: behind"),
    "too curved": ({"before": [WINDOW | {"curvature": [0.2, 0.0]}]}, r"before\[0\]\.curvature: the sphere ends"),
    "too thin": ({"before": [WINDOW | {"curvature": [0.02, -0.02]}]}, r"before\[0\]\.curvature: the faces.*cross"),
    "edge-on": (FOLDED | {"target.tilt": [0.0, -60.0]}, r"target\.tilt: seen from the lens.*edge-on"),
    "steep": ({"behind": [FOLD | {"tilt": [0.0, 50.0]}]}, r"behind\[0\]\.tilt.*40"),
    "unknown key": ({"before": [WINDOW | {"coating": 1.0}]}, r"before\[0\]\.coating"),
    "wavefront": (FOLDED | {"wavefront": {"kind": "plane", "z": 60.0}}, r"wavefront: .*mirror in \[\[behind\]\]"),
}  # fmt: skip


@pytest.mark.parametrize("fault", WRONG)
def test_a_wrong_element_is_refused_by_its_key(fault):
    changes, said = WRONG[fault]
    with pytest.raises(SceneError, match=said):
        bstcad.load(DISK).changed(changes)


def test_a_scene_keeps_its_elements_and_one_without_them_names_none():
    scene = bstcad.load(DISK)
    assert "before" not in scene.toml() and "behind" not in scene.toml() and scene.channels()[0].around is None
    folded = scene.changed(FOLDED)
    assert folded.changed({}) == folded and "[[before]]" in folded.toml()
    assert folded.changed({"behind[0].outline.diameter": 80.0}).behind[0].outline.radius == 40.0
    red, blue = folded.changed({"source.wavelength": [[486.1, 1.0], [656.3, 1.0]], "lens.material": "PMMA"}).channels()
    assert red.around[0][0].law.n_out < blue.around[0][0].law.n_out or red.index > blue.index


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of a design through a window, by way of a fold mirror."""
    place = tmp_path_factory.mktemp("elements") / "folded"
    designed(bstcad.load(DISK).changed(SMALL | FOLDED), quick_effort(), place)
    return place


@suite.in_turn(0, 3)
def test_a_design_with_a_window_and_a_fold_mirror_is_proved(folder):
    report = json.loads((folder / "report.json").read_text())
    assert report["passed"] and report["rrmsd"] < 0.05 and report["efficiency"] > 0.98
    assert math.fsum(report["flux"].values()) == pytest.approx(1, abs=1e-12)
    assert report["flux"]["stopped beside a window or mirror"] < 1e-6
    simulated = " ".join(report["effects"]["simulated"])
    assert "a window before the lens, without loss" in simulated and "a mirror behind the lens" in simulated
    again = bstcad.open(folder)
    assert again.lens.tailored_numbers == (3,) and len(again.lens.interfaces) == 5
    assert again.report.prescription["behind"][0]["tilt"] == [0.0, 20.0]


@suite.in_turn(0, 3)
def test_rays_in_space_draw_its_picture(folder):
    """The lens as it was read back; the window and the mirror here, by Snell's law and d - 2 (d · N) N."""
    scene = bstcad.load(folder / "scene.toml")
    lens = step_checks.lens(folder / "lens.step", scene.index)
    half = lens.outline.half_extent[0]
    line = half * ((torch.arange(700, dtype=torch.float64) + 0.5) / 350 - 1)
    x, y = (p.reshape(-1) for p in torch.meshgrid(line, line, indexing="ij"))
    start = torch.stack([x, y, torch.full_like(x, 15.0)]) * 0.55  # through the plane z = 8.25, behind the window
    n = refractive_index("N-BK7", 587.6)
    sine = torch.linspace(0, 0.9, 4001, dtype=torch.float64)  # of the angle to the axis: r = (d - t) tan θ + t tan θ'
    inner = torch.sqrt(1 - (sine / n) ** 2)
    radius = (8.25 - 3.0) * sine / torch.sqrt(1 - sine**2) + 3.0 * (sine / n) / inner
    r = torch.hypot(start[0], start[1])
    s = torch.from_numpy(np.interp(r.numpy(), radius.numpy(), sine.numpy()))
    way = torch.stack([s * start[0] / r, s * start[1] / r, torch.sqrt(1 - s**2)])
    slope = torch.from_numpy(
        np.gradient(radius.numpy() ** 2, sine.numpy() ** 2)
    )  # dΩ cos θ = π d(sin²) of a lambertian
    flux = 1 / torch.from_numpy(np.interp(s.numpy(), sine.numpy(), slope.numpy()))
    rays = Rays(
        torch.stack([start[0], start[1], torch.zeros_like(r)]),
        way,
        flux,
        torch.zeros(len(r), dtype=torch.uint8),
        z=8.25,
    )
    rays = across(rays, lens.interfaces)
    alive = rays.alive.numpy()
    p, d = torch.stack([*rays.position[:2], rays.above(0.0)]).numpy()[:, alive], rays.direction.numpy()[:, alive]
    (sin, cos), v = (np.sin(np.radians(20.0)), np.cos(np.radians(20.0))), np.array([0.0, 0.0, 250.0])
    normal = np.array([sin, 0.0, cos])
    p = p + (normal @ (v[:, None] - p)) / (normal @ d) * d
    d = d - 2 * (normal @ d) * normal[:, None]
    (a, b), target = np.radians(scene.target.tilt), scene.target
    across_it, middle = (
        np.array([np.sin(b), 0.0, np.cos(b)]),
        np.array([sum(target.x) / 2, sum(target.y) / 2, target.z]),
    )
    p = p + (across_it @ (middle[:, None] - p)) / (across_it @ d) * d - middle[:, None]
    u, w = p[0] * np.cos(b) - p[2] * np.sin(b) + middle[0], p[1] + middle[1]
    assert a == 0
    picture, _, _ = np.histogram2d(
        w, u, bins=target.columns_rows[::-1], range=(target.y, target.x), weights=flux.numpy()[alive]
    )
    wanted = target.irradiance()
    picture = picture[::-1] * (wanted.sum() / picture.sum())
    assert np.linalg.norm(picture - wanted) / np.linalg.norm(wanted) < 0.06


@pytest.mark.bench  # batoid and mitsuba come with the extra `judges`
def test_batoid_traces_them_too(folder):
    again = bstcad.open(folder)
    scene = again.scene
    found = compare(
        "batoid", again.lens, scene.verification_channels(), *scene.goals, effort=JudgeEffort(100_000), seed=1
    )
    assert found.judge.agrees, found.judge


@pytest.mark.bench
def test_mitsuba_says_that_it_knows_none_of_them(folder):
    again = bstcad.open(folder)
    said = compare("mitsuba", again.lens, again.scene.channels(), *again.scene.goals, effort=JudgeEffort(1))
    assert "windows or mirrors" in said.judge.declined


@suite.in_turn(0, 3)
def test_the_side_view_draws_their_faces(folder):
    again = bstcad.open(folder)
    rays = np.zeros((1, 7, 3))
    drawn = [line for axes in side_view(again.lens, rays, [again.scene.target.screen]).axes for line in axes.lines]
    assert sum(line.get_gid() == "element" for line in drawn) == 2 * 3


@suite.in_turn(0, 3)
def test_figures_say_that_a_folded_target_is_seen_in_the_mirror(folder):
    """Light comes back along -z: from behind the target, looking towards the lens, x would grow to the left."""
    scene = bstcad.open(folder).scene
    views = [View.of(scene.changed({"target.seen_from": side})) for side in ("lens", "behind")]
    assert all("fold mirror" in view.words for view in views)
    assert ["grows to the left" in view.words for view in views] == [True, False]
    assert not View.of(scene.changed({"behind": [], "target.z": 500.0, "target.tilt": None})).folded


@suite.in_turn(0, 3)
def test_a_lens_that_is_moved_leaves_them_where_they_are(folder):
    """The lens and, against it, all else: a picture of the lens moved is that of the rest moved the other way."""
    again = bstcad.open(folder)
    scene = again.scene
    setup = Setup(again.lens, scene.channels(), scene.target.screen)
    motion = Motion.of(shift=(0.3, -0.2, 0.4), turn=(0.5, -0.3, 0.0), about=(0.0, 0.0, 17.0))
    moved = setup.moved("lens", motion)
    [(_, [mirror])] = [channel.around for channel in moved.channels]
    assert mirror.surface == moved.lens.behind[0].surface
    assert motion.point(mirror.surface.vertex) == pytest.approx((0.0, 0.0, 250.0), abs=1e-12)
    back = moved.moved("lens", motion.inverse)
    assert np.abs(back.picture(64) - setup.picture(64)).max() < 1e-9
    assert np.abs(moved.picture(64) - setup.picture(64)).max() > 1e-5


def test_a_screen_of_an_image_is_the_screen_where_nothing_is_behind():
    scene = bstcad.load(DISK)
    assert image_screen(scene.flat_lens(9), screen := scene.target.screen) is screen


@pytest.mark.parametrize("place", ["before", "behind"])
def test_an_element_that_is_narrower_than_a_cell_is_named(place):
    z = {"before": (1.0, 5.0, 9.0), "behind": (60.0, 70.0, 80.0)}[place]
    wide, narrow = ({"shape": "circle", "radius": radius} for radius in (30.0, 0.001))
    elements = [WINDOW | {"z": at, "outline": rim} for at, rim in zip(z, (wide, narrow, wide), strict=True)]
    lens = bstcad.load(DISK, {place: elements}).flat_lens(33)
    with pytest.raises(SceneError, match=rf"^{place}\[1\]\.outline: is 0\.002 mm wide, .*; make it wider"):
        slope_map.light_density(np.zeros((4, 4)), 8.0, lens)
    with pytest.raises(SceneError, match=r"lens\.outline less oblong"):
        slope_map.light_density(np.zeros((4, 4)), 8.0)
