"""Two freeform faces and several goals: their merit, the light behind the lens, and small designs."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import bstcad
from bstcad.designs import pipeline
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.wavefront import PlaneWave, SphericalWave, ZernikeWave
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.measure import rrmsds_by_rays
from bstcad.optics.trace.tubes import collect
from bstcad.optics.trace.wavefront_error import wavefront_error
from bstcad.scene.errors import SceneError
from bstcad.tailoring import light_behind
from bstcad.tailoring.driver import Hooks, Parameters
from bstcad.tailoring.merit import Merit
from tests import suite
from tests.conftest import quick_effort
from tests.efforts import LITTLE, designed_quickly
from tests.lenses import SQUARE, rough

N = 1.5
BEAM = CollimatedSource(aperture=Rectangle(16.0, 16.0), wavelength=600.0)
NEAR, FAR = Screen(30.0, (-9.0, 9.0), (-9.0, 9.0), 24), Screen(60.0, (-9.0, 9.0), (-9.0, 9.0), 24)
WAVES = {
    "plane": PlaneWave(30.0), "sphere": SphericalWave((0.0, 0.0, 400.0), 30.0),
    "zernike": ZernikeWave((0.0, 0.0, 0.0, 2.0, 1.0), 8.0, 30.0),
}  # fmt: skip


def bumpy(m=17):
    return Lens.between(rough(0.02, 1, 0.0, m, 14.0), rough(0.02, 2, 8.0, half=14.0), SQUARE, N, tailored=(0, 1))


def picture(seed):
    light = 1.0 + np.random.default_rng(seed).random((24, 24))
    return light / light.sum()


def goals_of(weights):
    return [Goal(f"target[{k}]", s, picture(k), w) for k, (s, w) in enumerate(zip((NEAR, FAR), weights, strict=True))]


def merit_of(lens, source=BEAM, wave=None, n=40, weights=(1.0, 2.0)):
    return Merit.of((Channel(source, N),), lens, n, goals_of(weights), 0.03, wave=wave)


def test_a_goal_twice_is_the_goal_once():
    """Kernels end at the receiver, or behind the lens."""
    lens, goal = bumpy(), Goal("target", NEAR, picture(0), 5.0)
    once, twice = (Merit.of((Channel(BEAM, N),), lens, 40, goals, 0.03) for goals in ([goal], [goal, goal]))
    for value, other in zip(once(once.landing(lens)), twice(twice.landing(lens)), strict=True):
        assert float(value) == pytest.approx(float(other), rel=1e-12)


def test_the_waves_term_is_the_measured_error():
    lens, wave = bumpy(), WAVES["zernike"]
    merit = merit_of(lens, wave=wave, n=256)
    term = float(merit._wavefront_error(*merit.landing(lens).behind))
    assert term**0.5 == pytest.approx(wavefront_error(BEAM, lens, wave, 512).without_piston.rms, rel=0.01)


# ---- the light behind the lens ---------------------------------------------------------------------------------------


def shown(light, screen):
    """The picture on a screen, by the quads of the light."""
    there = torch.from_numpy(np.stack(light.positions_on(screen.receiver)))
    flux = torch.from_numpy(np.ascontiguousarray(light.picture[::-1].T))
    return collect(screen.pixels_of(there), flux, screen.shape)[0].numpy()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_even_light_between_squares_is_affine(sign):
    far = Screen(630.0, (-18.0, 18.0), (-18.0, 18.0), 24)  # far off: there the cost is nearly quadratic
    even = np.full((24, 24), 1 / 576)
    light = light_behind.between_targets((NEAR, even), (far, even), 64, sign=sign)
    x, y, _ = light.position
    for place, across in ((x, light.direction[0]), (y, light.direction[1])):
        assert np.abs(600.0 * across / light.direction[2] - (sign * 2 - 1) * place).max() < 0.1


@pytest.mark.parametrize(
    ("sign", "sharper", "tilt"),
    [(1.0, "near", None), (1.0, "far", (10.0, -15.0)), (-1.0, "near", (10.0, -15.0)), (-1.0, "far", None)],
)
def test_the_light_makes_both_pictures(sign, sharper, tilt):
    """Followed from the near plane to the far one or against its way: from the picture of less contrast."""
    near = Screen(30.0, (-9.0, 9.0), (-9.0, 9.0), 64, tilt=tilt)
    far = Screen(90.0, (-9.0, 9.0), (-9.0, 9.0), 64)
    x, y = np.meshgrid(np.linspace(-1, 1, 64), np.linspace(-1, 1, 64))
    waves = (1.2 + np.sin(3 * x), 2.0 + np.cos(4 * y + x))
    first, second = (p / p.sum() for p in (waves if sharper == "near" else waves[::-1]))
    light = light_behind.between_targets((near, first), (far, second), 128, sign=sign)
    assert np.abs((light.direction**2).sum(0) - 1).max() < 1e-12 and light.direction[2].min() > 0.8
    assert light.crossed_fraction(Plane(29.0)) == 0  # the order of its rays is that of their places near by
    for screen, wanted in ((near, first), (far, second)):
        off = (shown(light, screen) - wanted)[2:-2, 2:-2]  # light of the outermost cells lands a little beside
        assert np.sqrt((off**2).sum() / (wanted**2).sum()) < 0.05


@pytest.mark.parametrize(("sign", "place"), [(1.0, "far"), (-1.0, "near")])
def test_bright_letters_and_a_grey_picture_are_both_shown(sign, place):
    """The light of a few bright pixels makes all of the other picture, and that of no ray between them is lost."""
    near, far = Screen(30.0, (-9.0, 9.0), (-9.0, 9.0), 64), Screen(90.0, (-6.0, 6.0), (-6.0, 6.0), 64)
    letters = np.zeros((64, 64))
    letters[16:48, 8:20] = letters[16:48, 40:52] = 1.0
    grey = 1.5 + np.sin(6 * np.linspace(-1, 1, 64)) * np.ones((64, 1))
    letters, grey = letters / letters.sum(), grey / grey.sum()
    if place == "far":
        near, far = far, near
    goals = sorted(((near, letters), (far, grey)), key=lambda goal: goal[0].z)
    light = light_behind.between_targets(*goals, 128, sign=sign)
    assert light.crossed_fraction(Plane(29.0)) == 0
    assert np.abs(shown(light, near) - letters).max() < 1e-12  # no light in the black gap
    off, wanted = (p.reshape(16, 4, 16, 4).sum((1, 3)) for p in (shown(light, far) - grey, grey))
    assert np.sqrt((off**2).sum() / (wanted**2).sum()) < 0.03


def test_directions_in_a_gap_change_evenly_from_the_one_side_to_the_other():
    """Two patches of light, which arrive in the wrong order of their rays too."""
    x, y = np.meshgrid(np.linspace(-8, 8, 32), np.linspace(-8, 8, 32), indexing="ij")
    x[:16] -= 4.0
    x[16:] += 4.0
    a = np.where(x < 0, 0.1, -0.1)
    direction = np.stack([a, np.zeros_like(a), np.sqrt(1 - a * a)])
    light = light_behind.LightBehind(np.stack([x, y, np.zeros_like(x)]), direction, np.ones((31, 31)) / 961)
    where = [torch.from_numpy(p) for p in np.meshgrid(np.linspace(-3, 3, 32), np.linspace(-5, 5, 32), indexing="ij")]
    edge = 4.0 + 8 / 31
    for rays in (light, light.reversed()):
        found = rays.directions_at(Plane(0.0), *where)
        assert float((found[0] / found[2] + 0.1 / edge * where[0] / 0.99**0.5).abs().max()) < 1e-9


@pytest.mark.parametrize(
    ("wave", "screen"),
    [
        (WAVES["sphere"], NEAR),  # converges to a focus far behind the target
        (SphericalWave((0.0, 0.0, -20.0), 40.0), Screen(200.0, (-60.0, 60.0), (-60.0, 60.0), 24)),  # diverges from one
    ],
    ids=["converging", "diverging"],
)
def test_light_of_a_spherical_wave_goes_through_its_focus(wave, screen):
    light = light_behind.light_of_wave(screen, picture(0), wave, wavelength=600.0, parts=1)
    focus = np.array(wave.focus).reshape(3, 1, 1)
    path = (focus[2] - light.position[2]) / light.direction[2]
    assert np.abs(light.position + path * light.direction - focus).max() < 1e-9 and light.direction[2].min() > 0


def test_crossings_before_the_target_are_removed():
    near, far = Screen(60.0, (-9.0, 9.0), (-9.0, 9.0), 48), Screen(70.0, (-9.0, 9.0), (-9.0, 9.0), 48)
    dark = np.full((48, 48), 0.02)
    dark[:, :24] = 1.0
    light = light_behind.between_targets((near, dark[:, ::-1] / dark.sum()), (far, dark / dark.sum()), 64)
    back = Plane(0.0)
    assert light.crossed_fraction(back) > 0.05
    assert light_behind.without_crossings(light, near, back, 64).crossed_fraction(back) < 1e-3
    assert light_behind.without_crossings(light, near, Plane(59.9), 64) is light


# ---- small designs ---------------------------------------------------------------------------------------------------

TWO = {
    "name": "two", "source": {"kind": "collimated", "wavelength": 600.0, "aperture": {"shape": "rectangle",
    "width": 20.0, "height": 20.0}}, "lens": {"index": 1.5, "outline": {"shape": "rectangle", "width": 21.0,
    "height": 21.0}, "front": {"kind": "bspline", "z": 0.0, "optimise": True, "control_points": 33},
    "back": {"kind": "bspline", "z": 10.0, "control_points": 49}},
    "target": {"z": 30.0, "x": [-10.0, 10.0], "y": [-10.0, 10.0], "pixels": 32, "uniform": True},
    "tailoring": {"quality": "draft", "rays": 128, "stage2_iterations": 24, "transport_grid": 64},
}  # fmt: skip


def waves_of(phase):
    x, y = np.meshgrid(np.linspace(-1, 1, 32), np.linspace(-1, 1, 32))
    return 1.0 + 0.3 * np.sin(4 * x + phase) * np.cos(3 * y - phase)


def scene_of(tmp_path, **more):
    import tomli_w

    path = tmp_path / "scene.toml"
    path.write_text(tomli_w.dumps(TWO | more))
    return bstcad.load(path)


def test_two_pictures_are_met_together(tmp_path):
    first = TWO["target"]
    scene = scene_of(tmp_path, target=[first, first | {"z": 80.0}])
    scene = scene.changed({"target[0].image": waves_of(0.0), "target[1].image": waves_of(1.5)})
    said = []
    made = pipeline.design(
        scene, hooks=Hooks(progress=lambda *told: said.append(told[3])), options=pipeline.DesignOptions(effort=LITTLE)
    )
    assert [net.shape for net in made.lens.nets] == [(33, 33), (49, 49)]
    assert max(rrmsds_by_rays(made.lens, scene.channels(), scene.goals, quick_effort())) < 0.03
    assert any("convex solution" in text for text in said)


@suite.in_turn(1, 2)
def test_a_front_alone_makes_a_picture(tmp_path):
    scene = scene_of(tmp_path, lens=TWO["lens"] | {"back": TWO["lens"]["back"] | {"optimise": False}})
    scene = scene.changed({"target.image": waves_of(0.0), "target.z": 60.0})
    made = designed_quickly(scene.changed({"tailoring.stage2_iterations": 10}))
    assert not made.lens.back.heights.any() and made.lens.tailored_numbers == (0,)
    assert rrmsds_by_rays(made.lens, scene.channels(), scene.goals, quick_effort())[0] < 0.1


# ---- faults of scenes ------------------------------------------------------------------------------------------------


def test_a_wave_whose_rays_cross_before_the_target_is_refused():
    wave = ZernikeWave((0.0, 0.0, 0.0, -300.0), 8.0, 30.0)
    with pytest.raises(SceneError, match=r"^wavefront\.z: .*z = 30"):
        screen = Screen(400.0, (-9.0, 9.0), (-9.0, 9.0), 8)
        light_behind.light_of_wave(screen, picture(0), wave, wavelength=600.0, parts=1)


def test_targets_that_cut_through_each_other_are_refused(tmp_path):
    first = TWO["target"]
    with pytest.raises(SceneError, match=r"^target\[1\]\.z: "):
        scene_of(tmp_path, target=[first, first | {"z": 32.0, "tilt": [0.0, 30.0]}])


def test_the_move_of_a_back_that_is_given_is_kept():
    """A front alone is tailored, and the back makes way for it."""
    lens = replace(bumpy(), tailored=(0,))
    moved = lens.with_back(lens.back.moved(9.5))
    assert Parameters.of(moved).apply_to(lens).back.z == 9.5
