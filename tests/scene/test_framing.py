"""Framing: which way round, and how much of the picture."""

import io
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps

from bstcad.optics.outlines import Rectangle
from bstcad.scene import picture
from bstcad.scene.framing import EXIF, Frame, Turn, overlap
from bstcad.scene.picture import Picture
from bstcad.scene.target import Target
from bstcad.scene.tones import Tones

TURNS = [Turn(mirror, quarters) for mirror in (False, True) for quarters in range(4)]
MAP = np.arange(6.0).reshape(2, 3)
F = np.zeros((16, 16), np.uint8)  # stem at the left, bars to the right of it, the upper one longer and at the top
F[2:14, 4:6] = F[2:4, 4:13] = F[7:9, 4:10] = 255


def photo(values, kind="PNG", **options):
    buffer = io.BytesIO()
    Image.fromarray(values).save(buffer, kind, **options)
    return Picture("p.png", buffer.getvalue())


def target(values=F, width=16.0, height=16.0, pixels=16, **more):
    return Target(
        z=1.0, x=(0.0, width), y=(0.0, height), pixels=pixels, gamma=1.0,
        image=values if isinstance(values, Picture) else photo(values), **more,
    )  # fmt: skip


@pytest.mark.parametrize(("first", "second"), list(itertools.product(TURNS, TURNS)))
def test_one_turn_then_another(first, second):
    np.testing.assert_array_equal(first.then(second).of(MAP), second.of(first.of(MAP)))


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_orientation_of_a_camera_is_made_upright(kind, orientation):
    """By Pillow's own transposition, another code path."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = np.random.default_rng(0).integers(0, 2, (4, 6)).repeat(8, 0).repeat(8, 1).astype(np.uint8) * 255
    given = photo(stored, kind, exif=exif)
    upright = np.asarray(ImageOps.exif_transpose(Image.open(io.BytesIO(given.data))).convert("L"))
    rows, columns = np.array(upright.shape) // 8
    found = picture.photograph(given, Frame(int(columns), int(rows), columns, rows), Tones()).light
    np.testing.assert_array_equal(found > 0.5, upright[4::8, 4::8] > 127)
    assert orientation == 1 or EXIF[orientation] != Turn()


def test_from_the_lens_the_left_is_at_x_max():
    """A person who looks along +z with y up has +x at the left."""
    lens, behind = target().irradiance(), target(seen_from="behind").irradiance()
    np.testing.assert_array_equal(behind > 0, F > 0)
    np.testing.assert_array_equal(lens, behind[:, ::-1])
    assert Target(z=1.0, x=(0, 1), y=(0, 1), pixels=8, uniform=True).seen_from == "lens"


@pytest.mark.parametrize("rotate", [0, 90, 180, 270])
@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("seen_from", ["lens", "behind"])
def test_turned_counterclockwise_and_then_mirrored_as_the_person_sees_it(rotate, mirror, seen_from):
    flux = target(rotate=rotate, mirror=mirror, seen_from=seen_from).irradiance()
    seen = flux[:, ::-1] if seen_from == "lens" else flux
    wanted = np.asarray(Image.fromarray(F).rotate(rotate))  # Pillow turns counterclockwise
    np.testing.assert_array_equal(seen > 0, (wanted[:, ::-1] if mirror else wanted) > 0)


def test_a_text_is_turned_too_and_keeps_its_shape():
    """An I of some width on a wide target: turned, it lies, as long in mm as its height allows."""

    def extent(rotate):
        flux = Target(z=1.0, x=(0, 200), y=(0, 100), pixels=200, text="I", rotate=rotate).irradiance()
        flux = flux / flux.max() > 0.5
        rows, columns = (np.count_nonzero(flux.any(axis)) for axis in (1, 0))
        return columns * 200 / flux.shape[1], rows * 100 / flux.shape[0]

    (width, height), (long, high) = extent(0), extent(90)
    assert height == pytest.approx(80, abs=2) and width < height / 2
    assert long == pytest.approx(160, abs=2) and high / long == pytest.approx(width / height, rel=0.07)  # pixels


@pytest.mark.parametrize("seen_from", ["lens", "behind"])
def test_an_inverted_text_is_dark_on_light(seen_from):
    given = dict(z=1.0, x=(0, 1), y=(0, 1), pixels=64, text="F", seen_from=seen_from)
    plain, negative = Target(**given).irradiance(), Target(**given, invert=True).irradiance()
    np.testing.assert_allclose(plain / plain.max() + negative / negative.max(), 1.0, atol=1e-12)


# --- proportions ------------------------------------------------------------------------------------------------------

WIDE = np.zeros((6, 12), np.uint8)
WIDE[:, :3], WIDE[:, 3:9], WIDE[2:4, 5:7] = 50, 100, 255  # strips beside a square with a small one in its middle


def test_cropped_to_the_middle():
    found = target(WIDE, pixels=12)
    middle = WIDE[:, 3:9].repeat(2, 0).repeat(2, 1)
    np.testing.assert_allclose(found.irradiance(), middle[:, ::-1] / middle.sum(), rtol=1e-12)
    assert found.remarks() == (
        "target.fit: the picture is 12 x 6, the target square: cropped to the middle 6 x 6; "
        'fit = "pad" keeps it whole',
    )  # fmt: skip


def test_padded_with_dark():
    found = target(WIDE, pixels=12, fit="pad", seen_from="behind")
    wanted = np.zeros((12, 12))
    wanted[3:9] = WIDE
    np.testing.assert_allclose(found.irradiance(), wanted / wanted.sum(), rtol=1e-12)
    assert "kept whole, with dark strips beside it" in found.remarks()[0]


def test_stretched():
    found = target(WIDE, pixels=12, fit="stretch", seen_from="behind")
    wanted = WIDE.repeat(2, 0)
    np.testing.assert_allclose(found.irradiance(), wanted / wanted.sum(), rtol=1e-12)
    assert "stretched upwards by 1e+02 %" in found.remarks()[0] or "stretched upwards by 100 %" in found.remarks()[0]


@pytest.mark.parametrize("fit", ["crop", "pad", "stretch"])
def test_a_picture_of_the_target_s_proportions_is_left_alone(fit):
    found = target(WIDE, width=100.0, height=50.0, fit=fit)
    assert found.remarks() == ()
    upright = target(np.ascontiguousarray(WIDE.T), width=100.0, height=50.0, fit=fit, rotate=90)
    assert upright.remarks() == ()


def test_a_turned_picture_is_cropped_as_it_is_seen():
    found = target(WIDE, width=50.0, height=100.0, rotate=90)
    assert found.remarks() == ()
    [remark] = target(WIDE, rotate=90).remarks()
    assert "the picture is 6 x 12, the target square: cropped to the middle 6 x 6" in remark


def test_text_and_even_light_have_no_proportions():
    for content in ({"text": "THU"}, {"uniform": True}):
        assert Target(z=1.0, x=(0, 3), y=(0, 1), pixels=16, **content).remarks() == ()


def test_samples_are_fitted_too():
    found = Target(z=1.0, x=(0, 200), y=(0, 100), pixels=16, sample="camera")
    assert "cropped to the middle 512 x 256" in found.remarks()[0]


@settings(deadline=None, max_examples=100)
@given(
    size=st.integers(1, 60), pixels=st.integers(1, 60), start=st.floats(-30, 30), length=st.floats(0.5, 90),
    seed=st.integers(0, 9),
)  # fmt: skip
def test_a_window_keeps_the_light_it_shows(size, pixels, start, length, seed):
    """The integral over the window, by summed areas; dark beyond the picture."""
    values = np.random.default_rng(seed).random(size)
    ends = np.array([start, start + length])
    summed = np.diff(np.interp(ends, np.arange(size + 1), np.concatenate([[0], np.cumsum(values)])))[0]
    found = overlap(size, pixels, *ends) @ values
    assert found.sum() * length / pixels == pytest.approx(summed, abs=1e-9)
    assert found.min() >= 0 and found.max() <= values.max() + 1e-9


def test_an_outline_holds_whichever_way_it_is_seen():
    flux = target(seen_from="lens", outline=Rectangle(8.0, 16.0)).irradiance()
    assert not flux[:, :4].any() and not flux[:, 12:].any() and flux[:, 4:12].any()
