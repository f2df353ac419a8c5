"""Profiles by closed forms and by quadrature of their own equations."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.integrate import dblquad
from scipy.special import gamma

from bstcad.planning.reduction import QUICK, reduced_scene
from bstcad.scene.errors import SceneError
from bstcad.scene.profile import Profile, corner_area
from bstcad.scene.scene import load

SIZE = 20.0, 16.0  # mm
MADE = {
    "disc": {"shape": "disc", "radius": 6.0},
    "rectangle": {"shape": "rectangle", "width": 8.0, "height": 6.0},
    "soft": {"shape": "rectangle", "width": 8.0, "height": 6.0, "edge": 1.5},
    "gaussian": {"shape": "gaussian", "radius_1e2": 3.0},
    "super_gaussian": {"shape": "super_gaussian", "radius_1e2": 6.0, "order": 10.0},
}
EVEN = {"disc": math.pi * 36.0, "rectangle": 48.0, "soft": 48.0}  # areas (mm²)
THU = "templates/thu.toml"


def made(shape, **more):
    return TypeAdapter(Profile).validate_python(MADE[shape] | more)


@pytest.fixture(scope="module")
def thu():
    return load(THU, {"target.x": [180.0, 200.0], "target.y": [-8.0, 8.0], "target.pixels": 40})


@pytest.mark.parametrize("shape", EVEN)
@pytest.mark.parametrize("pixels", [(8, 8), (33, 27), (512, 500)])
def test_an_even_shape_has_its_area_to_the_last_digits(shape, pixels):
    light = made(shape).light(pixels, SIZE)
    assert light.mean() * SIZE[0] * SIZE[1] == pytest.approx(EVEN[shape], rel=1e-11)
    middle = light[pixels[1] // 2, pixels[0] // 2]
    assert middle == pytest.approx(1.0, abs=1e-12) and light[0, 0] == 0.0


def test_a_disc_has_the_share_of_each_pixel_at_its_rim():
    """Expected values are the integral of its height above each pixel's lower side."""
    columns, rows = 10, 8
    light = made("disc").light((columns, rows), SIZE)
    for row, column in np.ndindex(rows, columns):
        left, top = -10.0 + 2.0 * column, 8.0 - 2.0 * row
        x = left + 2.0 * (np.arange(20000) + 0.5) / 20000
        half = np.sqrt(np.maximum(36.0 - x**2, 0.0))
        high = np.clip(half, top - 2.0, top) - np.clip(-half, top - 2.0, top)
        assert light[row, column] == pytest.approx(high.mean() / 2.0, abs=2e-6)


def test_the_area_of_a_corner_is_a_quarter_disc_beyond_it():
    far = np.array([7.0, -7.0])
    np.testing.assert_allclose(corner_area(far, far[::-1], 6.0), [-9 * math.pi] * 2, rtol=1e-15)
    assert corner_area(np.array(3.0), np.array(2.0), 6.0) == 6.0  # inside, a rectangle


def test_a_soft_edge_falls_linearly_from_one_to_zero():
    """s = 1/2 + (a/2 - x) / e across the edge, so that the mean over a pixel inside it is s at the pixel's centre."""
    light = made("rectangle", width=8.0, height=6.0, edge=2.0).light((80, 64), SIZE)  # pixels of 0.25 mm
    x = np.arange(-40, 40) * 0.25 + 0.125
    np.testing.assert_allclose(light[32], np.clip(0.5 + (4.0 - np.abs(x)) / 2.0, 0.0, 1.0), rtol=0, atol=1e-12)


@pytest.mark.parametrize("order", [2.0, 3.0, 10.0, 40.0, 100.0])
@pytest.mark.parametrize("pixels", [(8, 8), (40, 32), (333, 120)])
def test_a_super_gaussian_has_the_flux_of_its_closed_form(order, pixels):
    """∫ exp(-2 (r/w)^n) 2 pi r dr = (2 pi w² / n) 2^(-2/n) Γ(2/n), all of it inside a target of four widths."""
    w, size = 6.0, (28.0, 28.0) if order > 4 else (70.0, 70.0)
    light = made("super_gaussian", order=order).light(pixels, size)
    wanted = 2 * math.pi * w**2 / order * 2 ** (-2 / order) * gamma(2 / order)
    assert light.mean() * size[0] * size[1] == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize(("order", "place"), [(10.0, (8, 3)), (100.0, (4, 6))])
def test_a_super_gaussian_has_the_mean_over_each_pixel(order, place):
    light = made("super_gaussian", order=order).light((20, 16), SIZE)  # of 1 mm a side
    row, column = place
    left, top = -10.0 + column, 8.0 - row

    def e(y, x):
        return math.exp(-2 * (math.hypot(x, y) / 6.0) ** order)

    mean, _ = dblquad(e, left, left + 1.0, top - 1.0, top, epsabs=1e-11, epsrel=1e-11)
    assert light[row, column] == pytest.approx(mean, abs=1e-9)


def test_of_order_2_it_is_a_gaussian():
    one = made("gaussian", radius_1e2=4.0).light((40, 32), SIZE)
    other = made("super_gaussian", radius_1e2=4.0, order=2.0).light((40, 32), SIZE)
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)
    assert one[16, 20] == pytest.approx(1.0 - 2 * (0.25**2 + 0.25**2) * (4 / 3) / 16, rel=1e-2)  # about 1 - 2 r² / w²


@pytest.mark.parametrize("shape", MADE)
def test_a_target_holds_a_profile_and_its_file_does(shape, thu, tmp_path):
    scene = thu.changed({"target.profile": MADE[shape]})
    assert scene.target.text is None and scene.target.irradiance().sum() == pytest.approx(1.0, abs=1e-12)
    (tmp_path / "scene.toml").write_text(scene.toml())
    assert load(tmp_path / "scene.toml") == scene == thu.changed({"target.profile": scene.target.profile})
    assert scene.changed({"target.text": "THU"}).target.profile is None  # of alternatives the other goes
    flux = scene.target.irradiance()
    if shape in EVEN:
        assert flux.max() == pytest.approx(20.0 * 16.0 / (40 * 32) / EVEN[shape], rel=1e-11)


def test_a_rectangle_is_turned_with_its_picture(thu):
    level, turned = (
        thu.changed({"target.profile": MADE["rectangle"], "target.rotate": rotate}).target.irradiance() > 0
        for rotate in (0, 90)
    )
    assert [light.any(axis).sum() for light in (level, turned) for axis in (0, 1)] == [16, 12, 12, 16]


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"target.profile": {"shape": "disk", "radius": 6.0}}, "target.profile.shape: 'disk' is not possible; did you"),
    ({"target.profile": {"shape": "disc"}}, "target.profile.radius: missing; add for example radius = 6.0"),
    ({"target.profile": {"shape": "disc", "radius": 8.5}}, "target.profile: is larger than the target along y; make"),
    ({"target.profile": {"shape": "rectangle", "width": 18.0, "height": 6.0}, "target.rotate": 90},
     "target.profile: is larger than the target along y"),
    ({"target.profile": {"shape": "gaussian", "radius_1e2": 0.4}},
     "target.profile: half its width along x, 0.4 mm, is less than a pixel of 0.5 mm"),
    ({"target.profile": MADE["disc"], "target.gamma": 2.0}, "target.gamma: only an image or a sample has a gamma"),
    ({"target.profile": MADE["disc"], "target.invert": True}, "target.invert: a profile"),
])  # fmt: skip
def test_a_wrong_profile_is_one_sentence(thu, changes, sentence):
    with pytest.raises(SceneError, match="^" + re.escape(sentence)) as refused:
        thu.changed(changes)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("rotate", [0, 90])
def test_a_coarser_picture_still_shows_a_narrow_profile(thu, rotate):
    """A preview and a pilot of a plan have fewer pixels, which are no reason to refuse the scene."""
    thin = {"shape": "rectangle", "width": 12.0, "height": 0.5}
    scene = thu.changed({"target.profile": thin, "target.rotate": rotate, "target.pixels": 400})
    fewer = scene.target.fewer_pixels(50.0)
    assert scene.changed({"target.pixels": fewer}).target.irradiance().sum() == pytest.approx(1)
    assert max(fewer) < 400 and min(fewer) == 8 and thu.target.fewer_pixels(4.0) == (10, 8)
    assert reduced_scene(scene, replace(QUICK, pixels=10)).target.columns_rows == scene.target.fewer_pixels(40.0)
