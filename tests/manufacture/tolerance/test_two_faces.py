"""One face against the other, form of either face, and what they do to the wavefront: as paraxial optics says."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import LinearNDInterpolator

from bstcad.cad import step_writing
from bstcad.manufacture.tolerance import study
from bstcad.manufacture.tolerance.grades import graded_table, perturbations
from bstcad.manufacture.tolerance.perturbations import (
    Perturbation,
    Setup,
    as_net,
    form_error,
    inside_outline,
    kinds,
    perturb,
    random_field,
)
from bstcad.manufacture.tolerance.study import Wavefronts
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import MIRROR
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.light.wavefront import PlaneWave, SphericalWave, ZernikeWave
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.motion import Motion
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace.wavefront_error import exit_pupil, move_pupil
from bstcad.scene.errors import SceneError
from bstcad.scene.quality import Tolerance
from tests.lenses import net

N, LINE, BACK, SEEN = 1.5, 500.0, 12.0, 40.0  # index, nm, vertex of the back, plane of the wave (mm)


def lit(front, back=None, light=None):
    """A lens of 24 x 24 mm in a parallel beam, before a screen 100 mm from the origin."""
    lens = Lens.between(front, back or net(None, BACK, 65, 12.5), Rectangle(24.0, 24.0), N)
    light = light or CollimatedSource(Circle(3.0), z=0.0, wavelength=LINE)
    return Setup(lens, (Channel(light, N),), Screen(100.0, (-8.0, 8.0), (-8.0, 8.0), (64, 64)))


def bowl():
    """A net of a bent face, 1/mm² of it of third order, vertex off its plane."""
    return net(lambda x, y: 0.3 + 0.01 * x**2 + 0.006 * y**2 + 2e-4 * x**2 * y, BACK, 65, 12.5)


def seen(setup, n=64):
    """The light behind the lens, in the room."""
    (channel,) = setup.channels
    pupil = exit_pupil(channel.source, channel.through(setup.lens), SEEN, n)
    return pupil if setup.lens_motion is None else move_pupil(pupil, setup.lens_motion, SEEN)


def leans(setup):
    """Mean angles (rad) of the light towards +x and +y."""
    pupil = seen(setup, 512)  # so many, since they do not lie evenly about the middle of a decentred beam
    return [float(pupil.direction[k][pupil.alive].mean()) for k in (0, 1)]


def direction_at(pupil, places, k):
    """Direction cosine of the light at places of the plane, interpolated between rays."""
    x, y, direction = (p[pupil.alive].numpy() for p in (pupil.x, pupil.y, pupil.direction[k]))
    return LinearNDInterpolator(np.stack([x, y], axis=1), direction)(places)


# ---- wedge and decentre ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("axis", "other", "sign"), [("x", 1, 1), ("y", 0, -1)])
def test_a_wedge_turns_light_by_n_less_one_times_the_wedge(axis, other, sign):
    """Towards its thick side: sin(δ + α) = n sin α."""
    wedge = math.radians(0.1)
    found = leans(kinds(lit(Plane(8.0)))[f"lens.wedge_{axis}"].apply(lit(Plane(8.0)), 0.1))
    assert found[other] == pytest.approx(sign * math.sin(math.asin(N * math.sin(wedge)) - wedge), rel=1e-9)
    assert found[other] == pytest.approx(sign * (N - 1) * wedge, rel=1e-5) and abs(found[1 - other]) < 1e-12


@pytest.mark.parametrize("axis", "xy")
def test_a_wedge_turns_the_back_about_its_vertex(axis):
    before = lit(Sphere(2.0, 0.02), bowl())
    after = kinds(before)[f"lens.wedge_{axis}"].apply(before, 0.1)
    assert after.lens.front == before.lens.front and after.screen == before.screen and after.lens_motion is None
    x, y = torch.meshgrid(*[torch.linspace(-11, 11, 23, dtype=torch.float64)] * 2, indexing="ij")
    points = torch.stack([x, y, before.lens.back.sag_and_slope(x, y)[0]]).reshape(3, -1).T.tolist()
    vertex = (0.0, 0.0, before.lens.back.from_vertex().z)
    motion = Motion.of(turn=(0.1, 0.0, 0.0) if axis == "x" else (0.0, 0.1, 0.0), about=vertex)
    x, y, z = torch.tensor([motion.point(p) for p in points], dtype=torch.float64).T
    off = after.lens.back.sag_and_slope(x, y)[0] - z
    assert float(off.abs().max()) < 1e-6  # mm, of a face that moves by 20 µm at its rim


@pytest.mark.parametrize("axis", [0, 1])
def test_a_decentred_front_tilts_light_by_its_power_times_the_decentre(axis):
    curvature, by = 0.02, 0.05
    setup = lit(Sphere(8.0, curvature), light=CollimatedSource(Circle(0.5), z=0.0, wavelength=LINE))
    setup = replace(setup, screen=Screen(100.0, (-0.4, 0.4), (-0.4, 0.4), (64, 64)))  # the spot is 0.1 mm wide
    moved = kinds(setup)[f"front.decentre_{'xy'[axis]}"].apply(setup, by)
    found, power = leans(moved), (N - 1) * curvature
    assert found[axis] == pytest.approx(power * by, rel=2e-3) and abs(found[1 - axis]) < 1e-9
    picture = moved.picture(513)
    places = (np.arange(64) - 31.5) / 80
    sums = picture.sum(0) if axis == 0 else picture[::-1].sum(1)
    thin = power * by * (100.0 - BACK + (BACK - 8.0) / N)  # along the glass the light leans by power · by / n
    assert float(sums @ places / sums.sum()) == pytest.approx(thin, rel=5e-3)


def test_a_decentred_front_is_that_front_elsewhere():
    """The front's net moves, and the back behind it stays."""
    setup = lit(Sphere(2.0, 0.02), bowl(), light=CollimatedSource(Circle(8.0), z=0.0, wavelength=LINE))
    net = as_net(setup.lens.front, setup.lens.outline)
    x, y = (tuple(end + by for end in side) for side, by in ((net.x, 0.05), (net.y, 0.0)))
    wanted = seen(replace(setup, lens=setup.lens.with_front(replace(net, x=x, y=y))))
    nominal, places = seen(setup), np.random.default_rng(2).uniform(-3, 3, (200, 2))
    for front in (setup.lens.front, net):  # a freeform front, too
        start = replace(setup, lens=setup.lens.with_front(front))
        found = seen(kinds(start)["front.decentre_x"].apply(start, 0.05))
        for k in (0, 1):
            off = direction_at(found, places, k) - direction_at(wanted, places, k)
            assert np.abs(off).max() < 5e-6 < 0.01 * np.abs(direction_at(nominal, places, k)).max()
            moves = np.abs(direction_at(nominal, places, k) - direction_at(wanted, places, k)).max()
            assert k == 1 or moves > 4e-4


def test_a_lens_decentred_beyond_its_net_is_a_part(setup, tmp_path):
    """The net reaches two spans past the rim, and grows where it has to go further; inside no height changes."""
    lens = kinds(setup)["front.decentre_x"].apply(setup, -0.8).lens
    assert lens.back.shape == (33 + 2, 33) and lens.back.pitch == pytest.approx(setup.lens.back.pitch)
    x, y = torch.meshgrid(*[torch.linspace(-3, 3, 61, dtype=torch.float64)] * 2, indexing="ij")
    off = lens.back.sag_and_slope(x, y)[0] - setup.lens.back.sag_and_slope(x - 0.8, y)[0]
    assert float(off.abs().max()) < 1e-12
    step_writing.write_lens(lens, tmp_path / "trial.step", "trial")
    assert (tmp_path / "trial.step").stat().st_size > 10_000
    form = Perturbation(form_error(setup.lens, 2.5, 0), 1e-4, "field")  # of the net that it was
    errors = (Perturbation(kinds(setup)["front.decentre_x"], 1.0), form)
    assert perturb(setup, errors, [0.8, 1e-4]).lens.back.shape == (35, 33)


# ---- form of either face, and the wavefront --------------------------------------------------------------------------


def waves(setup, kind, wave=PlaneWave(SEEN)):  # noqa: B008
    return Wavefronts(setup, (Perturbation(kind, 1.0),), wave, LINE, rays=64)


def test_form_of_either_face_shifts_the_wavefront_by_n_less_one_times_it():
    """Sooner where the front stands higher, later where the back does; what it shifts is the form without a plane."""
    flat = net(None, 8.0, 65, 12.5)
    setup, by = lit(flat, light=CollimatedSource(Circle(8.0), z=0.0, wavelength=LINE)), 1e-5  # mm: 1e-2 waves
    front, back = form_error(setup.lens, 6.0, 0, "front"), form_error(setup.lens, 6.0, 100, "back")  # one field
    sooner, later = (waves(setup, kind).vector([by]) for kind in (front, back))
    assert np.linalg.norm(sooner + later) < 2e-3 * np.linalg.norm(later)
    pupil = seen(setup)
    field = random_field(flat, 6.0, 100, inside_outline(setup.lens.outline, flat))
    bent = replace(flat, heights=torch.from_numpy(by * field))
    x, y = (p[pupil.alive] for p in (pupil.x, pupil.y))
    form = bent.relative_sag_and_slope(x, y)[0].numpy()
    plane = np.stack([np.ones(len(x)), x.numpy(), y.numpy()], axis=1)
    form -= plane @ np.linalg.lstsq(plane, form, rcond=None)[0]
    wanted = np.zeros(pupil.alive.shape)
    wanted[pupil.alive.numpy()] = (N - 1) * form / (LINE * 1e-6) / math.sqrt(len(x))
    assert np.linalg.norm(later - wanted.ravel()) < 2e-3 * np.linalg.norm(wanted)


def test_superposed_wavefronts_stand_up_to_full_traces():
    """A plate has a plane wave as its light: form errors of both faces add up as squares do."""
    setup = lit(Plane(8.0), light=CollimatedSource(Circle(8.0), z=0.0, wavelength=LINE))
    forms = [form_error(setup.lens, 6.0, seed, face) for seed, face in ((0, "back"), (1, "back"), (0, "front"))]
    errors = (*(Perturbation(kind, 1e-4, "field") for kind in forms), Perturbation(kinds(setup)["lens.wedge_x"], 0.1))
    goal = Wavefronts(setup, errors, PlaneWave(SEEN), LINE, rays=64)
    assert goal.design_rms < 1e-9
    found = study.study(goal, 0.1, goal.design_rms, study.StudySettings(seed=3, trials=2000, full=5))
    assert found.disagreement.max() < 5e-3
    changes = {s.name: s.rrmsd_change for s in found.sensitivities}
    assert changes["lens.wedge_x"] < 1e-3 * changes["back.form_0"]  # tilts the wave, and tilt is removed
    whole = sum(change**2 for change in changes.values())
    assert np.mean(found.linear**2) == pytest.approx(whole, rel=0.1)
    assert np.array_equal(found.adjusted, found.linear[:5])  # no screen mends a wave


WAVES = [PlaneWave(SEEN), SphericalWave((0.3, 0.0, 150.0), SEEN), ZernikeWave((0.0, 0.0, 0.0, 0.4), 6.0, SEEN)]


@pytest.mark.parametrize("wave", WAVES, ids=lambda wave: wave.kind)
def test_the_wanted_wave_stays_in_the_room(wave):
    """Lens and light moved together are where a wave that is moved alike sees no difference."""
    point = PointSource((0.5, 0.0, -60.0), profile="uniform", half_angle=5.0, wavelength=LINE)
    setup, motion = lit(Sphere(2.0, 0.02), bowl(), light=point), Motion.of(shift=(0.2, -0.1, 0.0))
    moved = setup.moved("lens", motion).moved("source", motion)
    there = {"sphere": {"focus": (0.5, -0.1, 150.0)}, "zernike": {"centre": (0.2, -0.1)}}.get(wave.kind, {})
    kind = kinds(setup)["lens.index"]
    before, after = waves(setup, kind, wave), waves(moved, kind, replace(wave, **there))
    assert moved.lens_motion is not None
    np.testing.assert_allclose(
        after.vector([0.0]), before.vector([0.0]), rtol=0, atol=1e-6 * np.linalg.norm(before.vector([0.0]))
    )
    assert before.design_rms == pytest.approx(np.linalg.norm(before.vector([0.0])), rel=0.02)


def test_motions_follow_each_other():
    one, two = Motion.of((0.1, 0.2, 0.3), (1, 2, 3), about=(4, 5, 6)), Motion.of(turn=(5, 1, 2), about=(1, 1, 1))
    place = (7.0, -8.0, 9.0)
    assert two.after(one).point(place) == pytest.approx(two.point(one.point(place)), abs=1e-12)
    assert one.after(None) is one


# ---- as tables of a scene --------------------------------------------------------------------------------------------

NAMED = (
    Tolerance(name="lens.wedge", limit=0.02),
    Tolerance(name="front.decentre", grade="precise", cost=2.0),
    Tolerance(name="lens.wedge_y", grade="moulded"),
)


def test_one_face_against_the_other_is_off_only_where_a_table_names_it(setup):
    plain, found = (
        {p.kind.name: p for p in perturbations(setup, graded_table(table), "PMMA")} for table in ((), NAMED)
    )
    assert found.keys() - plain.keys() == {
        f"{kind}_{axis}" for kind in ("lens.wedge", "front.decentre") for axis in "xy"
    }
    assert [name for name in found if name in plain] == list(plain)
    assert (found["lens.wedge_x"].limit, found["lens.wedge_y"].limit) == (0.02, 0.1)
    assert (found["front.decentre_x"].limit, found["front.decentre_y"].cost) == (0.005, 2.0)
    assert (found["lens.wedge_x"].kind.unit, found["front.decentre_x"].kind.unit) == ("deg", "mm")


@pytest.mark.parametrize("name", ["lens.wedge_x", "front.form"])
def test_a_mirror_has_no_second_face(setup, name):
    mirror = replace(setup, lens=replace(setup.lens, passes=MIRROR))
    with pytest.raises(SceneError, match=rf"tolerance\[0\].name: '{name}' "):
        perturbations(mirror, graded_table((Tolerance(name=name, limit=1e-3),)))
    assert perturbations(mirror, graded_table((Tolerance(name=name, grade="none"),)))


def test_a_plane_front_is_not_decentred():
    with pytest.raises(SceneError, match=r"tolerance\[0\].name: 'front.decentre' "):
        perturbations(lit(Plane(8.0)), graded_table(NAMED[1:2]))
