"""Programs not written here against ray tubes: they agree where the lens is the same, and a wrong one is seen."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad import commands
from bstcad.judges import comparison, faces
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.channels import Channel, channels_of
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.measure import tubes_picture
from bstcad.optics.outlines import Circle, Rectangle, Rounded
from bstcad.optics.sources import Collimated, Point
from bstcad.optics.surfaces import Plane, Sphere, sag
from bstcad.scene.errors import MachineError, SceneError
from tests.conftest import quick_effort

# They come with the extra `judges`, a renderer of 100 MB among them, which `make bench` installs, not the suite.
with_others = pytest.mark.bench

SCREEN = Screen(400.0, (-30.0, 30.0), (-20.0, 20.0), (48, 32))
TILTED = replace(SCREEN, x=(-48.0, -34.0), y=(-34.0, -20.0), pixels=32, tilt=(20.0, -15.0))


def waved(m=33, half=10.0, amplitude=0.05):
    """A back that no symmetry maps onto itself."""
    x = np.linspace(-1, 1, m)
    heights = 0.02 * half * (x[:, None] ** 2 + 1.3 * x**2) + amplitude * np.sin(2 * x[:, None] + 0.5) * np.cos(3 * x)
    return BSplineSurface(20.0, torch.from_numpy(-heights), (-half, half), (-half, half))


def lens(front=None, outline=None, **more):
    return Lens(front or Sphere(12.0, -0.01), waved(), outline or Rectangle(20.0, 20.0), 1.49, **more)


BEAM = Collimated(Rectangle(18.0, 16.0))
TILTED_BEAM = Collimated(Circle(9.0), tilt=(4.0, -6.0), centre=(0.5, -0.3), z=5.0)
APERTURES = Rounded(14.0, 13.0, corner_radius=3.0), Rounded(15.0, 16.0, corner_radius=4.0)
WIDE = replace(SCREEN, x=(-120.0, 90.0), y=(-90.0, 110.0))
LAMP = Point((1.0, -0.5, -20.0), profile="gaussian", half_angle_1e2=14.0)
DECLINED = {"name", "version", "declined"}
CASES = {
    "a beam": (lens(), BEAM, SCREEN),
    "a tilted beam, a round lens, a tilted screen": (lens(Plane(12.0), Circle(8.5)), TILTED_BEAM, TILTED),
    "a gaussian point, a round lens": (lens(outline=Circle(8.5)), LAMP, WIDE),
    "a gaussian point, clear apertures": (lens(clear=APERTURES), LAMP, WIDE),
    "a mirror": (
        lens(Plane(0.0), reflects=True),
        Point((0.5, 1.0, 90.0), profile="uniform", half_angle=5.0),
        replace(SCREEN, x=(-54.0, 60.0), y=(-56.0, 66.0)),
    ),
}


def compared(name, case, rays, **changes):
    glass, source, screen = CASES[case]
    channels = (Channel(source, glass.index),)
    target = tubes_picture(glass, channels, screen, 256).numpy()
    return comparison.compare(name, glass, channels, screen, target, rays=rays, seed=3, **changes)


@with_others
@pytest.mark.parametrize("case", CASES)
def test_batoid_sees_what_ray_tubes_see(case):
    found = compared("batoid", case, 1 << 18)
    assert [check.passed for check in found.checks] == [True, True]
    assert found.noise < 0.05 and found.moved_by < 0.01
    assert found.on_target == pytest.approx(found.on_target_ours, abs=1e-3)


@with_others
@pytest.mark.parametrize("wrong", ["10 µm of astigmatism", "index", "turned"])
def test_a_wrong_lens_is_seen(monkeypatch, wrong):
    from bstcad.judges import batoid

    def other(glass, channels):
        if wrong == "index":
            return glass, [replace(channel, index=channel.index + 0.01) for channel in channels]
        heights, along = glass.back.heights, torch.linspace(-1, 1, glass.back.m, dtype=torch.float64)
        off = 0.005 * (along[:, None] ** 2 - along**2) if wrong != "turned" else heights.T - heights
        return replace(glass, back=replace(glass.back, heights=heights + off)), channels

    trace = batoid.trace
    monkeypatch.setattr(
        batoid, "trace", lambda glass, channels, *given, **how: trace(*other(glass, channels), *given, **how)
    )
    found = compared("batoid", "a beam", 1 << 18)
    assert [check.passed for check in found.checks] == [False, True]
    assert found.facts["agrees"] is False


@with_others
@pytest.mark.parametrize("case", list(CASES)[1:])
def test_mitsuba_sees_what_ray_tubes_see(case):
    found = compared("mitsuba", case, 1 << 18)
    assert [check.passed for check in found.checks] == [True, True]
    assert found.noise < 0.1 and found.moved_by < 0.05
    assert (found.losses == "none") is (case == "a mirror")


@with_others
def test_mitsuba_declines_light_of_many_directions():
    """Its plates, one a direction, would stand in each other's light: all dark, and no picture is better than that."""
    glass, source, screen = CASES["a beam"]
    suns = channels_of(replace(source, divergence=0.5), lambda nm: glass.index, points=4)
    found = comparison.compare("mitsuba", glass, suns, screen, np.ones(screen.shape), rays=1)
    assert "many directions" in found.declined and found.checks == () and set(found.facts) == DECLINED


def test_faces_are_those_of_the_lens():
    """scipy's spline against bstcad's, in the rim's uneven spans too, and between an even grid's lines."""
    back = waved()
    face = faces.face(back, Circle(9.0))
    x, y = faces.scattered(Rectangle(20.0, 20.0), 500, seed=1)
    found = face.at(x, y)
    z, z_x, z_y = (p.numpy() for p in back.sag_and_slope(*map(torch.from_numpy, (x, y))))
    np.testing.assert_allclose(found.z, z, atol=1e-12)
    np.testing.assert_allclose(np.stack([found.z_x, found.z_y]), np.stack([z_x, z_y]), atol=1e-12)
    grid = face.on_grid(*face.lines(1))
    np.testing.assert_allclose(grid.z, sag(back, grid.x, grid.y), atol=1e-12)


@pytest.mark.parametrize(
    "screen", [SCREEN, replace(SCREEN, pixels=(512, 341)), Screen(1.0, (0.0, 7.3), (0.0, 11.1), 300)]
)
def test_coarse_pixels_are_square_and_keep_the_light(screen):
    raster = comparison.coarse(screen)
    across, up = raster.per_mm
    assert across == pytest.approx(up, rel=1e-3) and max(raster.shape) <= comparison.PIXELS
    picture = np.random.default_rng(0).random(screen.shape)
    coarse = comparison.shared(picture, raster.shape)
    assert coarse.shape == raster.shape and coarse.sum() == pytest.approx(picture.sum())
    even = comparison.shared(np.ones(screen.shape), raster.shape)
    np.testing.assert_allclose(even, even.mean())


def test_an_unknown_judge_is_named(tmp_path):
    with pytest.raises(SceneError, match="batiod: is no judge; did you mean 'batoid'?"):
        commands.verify(tmp_path, against=("batiod",))


def test_one_that_is_not_installed_says_how(tmp_path, monkeypatch):
    monkeypatch.setattr(comparison.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MachineError, match=r"pip install 'bstcad\[judges\]'"):
        commands.verify(tmp_path, against=("mitsuba",))


@with_others
def test_a_step_file_by_itself_has_no_light(small_design, tmp_path):
    shutil.copy(small_design.folder / "lens.step", alone := tmp_path / "alone.step")
    with pytest.raises(SceneError, match="give the design's folder"):
        commands.verify(alone, against=("batoid",))


@with_others
def test_the_report_holds_it(small_design, tmp_path, monkeypatch):
    monkeypatch.setattr("bstcad.report.rendering.lens_picture", lambda mesh: None)
    monkeypatch.setattr(comparison, "RAYS", 1 << 18)
    folder = shutil.copytree(small_design.folder, tmp_path / "small")
    report = commands.verify(folder, against=("batoid",), effort=quick_effort()).facts
    [judge] = report["judges"]
    assert report["passed"] and judge["name"] == "batoid" and judge["agrees"]
    assert judge["over_noise"] in [c["value"] for c in report["checks"] if "by batoid against" in c["name"]]
    assert json.loads((folder / "report.json").read_text())["judges"][0]["rays"] == judge["rays"]
    page = (folder / "report.html").read_text()
    assert "Other programs" in page and (folder / "figures" / "judge_batoid.png").exists()
    page = (small_design.folder / "report.html").read_text()  # where nobody asked for it
    assert "judges" not in small_design.report and "Other programs" not in page


def test_the_noise_is_borne_by_the_pixels_that_have_it():
    """All of them for normal noise (to 5 %, the scatter of a fourth moment), one for a single bright pixel."""
    noise = np.random.default_rng(0).normal(size=(128, 128))
    assert comparison._effective_pixels(noise) == pytest.approx(128**2, rel=0.05)
    alone = np.zeros((128, 128))
    assert comparison._effective_pixels(alone) == 128**2
    alone[3, 5] = 1.0
    assert comparison._effective_pixels(alone) == 3.0
