"""Targets: their pixels, which way round the picture lies, and how it fills them."""

import io
import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps

from bstcad.optics.receivers.irradiance import overlap
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.scene.errors import SceneError
from bstcad.scene.picture import Picture
from bstcad.scene.target import Target, drawing, inside, shown_size

F = np.zeros((16, 16), np.uint8)  # stem at the left, bars to the right of it, the upper one longer and at the top
F[2:14, 4:6] = F[2:4, 4:13] = F[7:9, 4:10] = 255


def photo(values, kind="PNG", **options):
    buffer = io.BytesIO()
    Image.fromarray(values).save(buffer, kind, **options)
    return Picture("p.png", buffer.getvalue())


def target(values=None, width=16.0, height=16.0, pixels=16, **more):
    """A target from (0, 0) on, with a picture of linear values."""
    if values is not None:
        more |= {"image": values if isinstance(values, Picture) else photo(values), "gamma": 1.0}
    return Target(z=1.0, x=(0.0, width), y=(0.0, height), pixels=pixels, **more)


@pytest.mark.parametrize(("x", "y", "pixels", "counted"), [
    ((0, 300), (0, 150), 64, (64, 32)),
    ((0, 150), (-20, 280), 64, (32, 64)),
    ((0, 100), (0, 33.3), 100, (100, 33)),
    ((0, 1e4), (0, 1), 512, (512, 8)),  # the limits' least
    ((0, 300), (0, 150), (50, 40), (50, 40)),
])  # fmt: skip
def test_pixels_are_square_unless_both_sides_are_counted(x, y, pixels, counted):
    found = Target(z=1.0, x=x, y=y, pixels=pixels, uniform=True)
    assert found.columns_rows == counted
    assert found.irradiance().shape == counted[::-1]


def test_a_picture_on_a_wide_target_is_that_of_its_pixels():
    """A disc of light has its area and its place, whatever the counts: rows run down, columns to the right."""
    found = Target(z=1.0, x=(10, 310), y=(-50, 100), pixels=(50, 40), uniform=True, outline=Circle(40.0))
    flux, (columns, rows) = found.irradiance(), found.columns_rows
    x, y = 10 + (np.arange(columns) + 0.5) * 6.0, 100 - (np.arange(rows) + 0.5) * 3.75
    assert flux.sum() == pytest.approx(1.0, abs=1e-12) and flux.dtype == np.float64
    assert flux.sum(0) @ x == pytest.approx(160.0) and flux.sum(1) @ y == pytest.approx(25.0)
    assert flux.max() == pytest.approx(6.0 * 3.75 / (math.pi * 40.0**2), rel=1e-3)


@pytest.mark.parametrize("outline", [Circle(30.0), Rectangle(31.0, 47.0)])
@pytest.mark.parametrize("pixels", [16, 100])
def test_an_outline_lets_its_area_through(outline, pixels):
    share = inside(outline, (pixels, pixels), (80.0, 60.0))
    assert share.mean() * 80 * 60 == pytest.approx(outline.area, rel=2e-3)  # sub-pixels at the rim
    np.testing.assert_array_equal(share, share[::-1, ::-1])
    assert share[pixels // 2, pixels // 2] == 1.0 and share[0, 0] == 0.0


# ---- which way round -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_orientation_of_a_camera_is_made_upright(kind, orientation):
    """Pillow's own transposition gives the same."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = np.random.default_rng(0).integers(0, 2, (16, 24)).repeat(4, 0).repeat(4, 1).astype(np.uint8) * 255
    given = photo(stored, kind, exif=exif)
    upright = np.asarray(ImageOps.exif_transpose(Image.open(io.BytesIO(given.data))).convert("L"))
    rows, columns = (int(side) // 4 for side in upright.shape)
    found = drawing(target(given, columns, rows, pixels=(columns, rows))).light
    np.testing.assert_array_equal(found > 0.5, upright[2::4, 2::4] > 127)


@pytest.mark.parametrize("rotate", [0, 90, 180, 270])
@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("seen_from", ["lens", "behind"])
def test_turned_counterclockwise_and_then_mirrored_as_the_person_sees_it(rotate, mirror, seen_from):
    """A person at the lens looks along +z with y up and has +x at the left."""
    flux = target(F, rotate=rotate, mirror=mirror, seen_from=seen_from).irradiance()
    seen = flux[:, ::-1] if seen_from == "lens" else flux
    wanted = np.asarray(Image.fromarray(F).rotate(rotate))  # Pillow turns counterclockwise
    np.testing.assert_array_equal(seen > 0, (wanted[:, ::-1] if mirror else wanted) > 0)
    flux = target(F, rotate=rotate, seen_from=seen_from, outline=Rectangle(8.0, 16.0)).irradiance()
    assert not flux[:, :4].any() and not flux[:, 12:].any() and flux[:, 4:12].any()


# ---- letters ---------------------------------------------------------------------------------------------------------


def lettered(text, pixels, width=1.0, height=1.0, **more):
    """The light of a text on a target of so many columns and rows."""
    return drawing(target(None, width, height, pixels=(pixels, pixels), text=text, **more)).light


def test_letters_fill_the_width_and_stand_in_the_middle():
    flux = lettered("THU", 512)
    columns, rows = np.flatnonzero(flux.max(0) > 0.5), np.flatnonzero(flux.max(1) > 0.5)
    assert 0.80 < (columns[-1] - columns[0] + 1) / 512 < 0.86
    assert columns[0] + columns[-1] == pytest.approx(511, abs=2)
    assert rows[0] + rows[-1] == pytest.approx(511, abs=2)
    stems = np.diff((flux[210] > 0.5).astype(int)) == 1  # T has one, H and U have two each
    assert np.count_nonzero(stems) == 5
    flux = lettered("one\ntwo", 128)
    assert not flux[0].any() and not flux[-1].any() and not flux[:, 0].any() and not flux[:, -1].any()
    np.testing.assert_allclose(lettered("F", 64) + lettered("F", 64, invert=True), 1.0, atol=1e-12)
    with pytest.raises(SceneError, match="the font has no letter '林'"):
        lettered("林", 64)


def test_a_text_is_turned_too_and_keeps_its_shape():
    """An I on a wide target: as high in mm as it would be on a square one; turned, it lies."""

    def extent(rotate):
        flux = lettered("I", 200, 200.0, 100.0, rotate=rotate) > 0.5
        return np.count_nonzero(flux.any(0)), np.count_nonzero(flux.any(1)) / 2

    (width, height), (long, high) = extent(0), extent(90)
    assert height == pytest.approx(80, abs=2) and width < height / 2
    assert long == pytest.approx(160, abs=2) and high / long == pytest.approx(width / height, rel=0.07)  # pixels


# ---- proportions -----------------------------------------------------------------------------------------------------

WIDE = np.zeros((6, 12), np.uint8)
WIDE[:, :3], WIDE[:, 3:9], WIDE[2:4, 5:7] = 50, 100, 255  # strips beside a square with a small one in its middle
PADDED = np.pad(WIDE, ((3, 3), (0, 0)))


@pytest.mark.parametrize(("fit", "shown", "remark"), [
    ("crop", WIDE[:, 3:9].repeat(2, 0).repeat(2, 1), 'cropped to the central 6 x 6 pixels; fit = "pad" shows it whole'),
    ("pad", PADDED, 'shown whole, with dark strips beside it; fit = "crop" fills the target'),
    ("stretch", WIDE.repeat(2, 0), 'stretched upwards by 1e+02 %; fit = "crop" keeps its proportions'),
])  # fmt: skip
def test_a_picture_of_other_proportions_is_fitted(fit, shown, remark):
    found = target(WIDE, pixels=12, fit=fit)
    np.testing.assert_allclose(found.irradiance(), shown[:, ::-1] / shown.sum(), rtol=1e-12)
    assert found.remarks() == (f"target.fit: the target is square, so the picture of 12 x 6 is {remark}",)


@pytest.mark.parametrize("fit", ["crop", "pad", "stretch"])
def test_a_picture_of_the_target_s_proportions_is_left_alone(fit):
    upright = np.ascontiguousarray(WIDE.T)
    for found in (target(WIDE, 100.0, 50.0, fit=fit), target(upright, 100.0, 50.0, fit=fit, rotate=90)):
        assert found.remarks() == ()


def test_what_is_turned_or_a_sample_is_fitted_too_and_text_and_even_light_have_no_proportions():
    [remark] = target(WIDE, rotate=90).remarks()
    assert "the picture of 6 x 12 is cropped to the central 6 x 6" in remark
    assert "cropped to the central 512 x 256" in target(None, 200.0, 100.0, sample="camera").remarks()[0]
    for content in ({"text": "THU"}, {"uniform": True}):
        assert target(None, 3.0, 1.0, **content).remarks() == ()


@settings(deadline=None, max_examples=100)
@given(
    size=st.integers(1, 60), pixels=st.integers(1, 60), start=st.floats(-30, 30), length=st.floats(0.5, 90),
    seed=st.integers(0, 9),
)  # fmt: skip
def test_a_window_keeps_the_light_it_shows(size, pixels, start, length, seed):
    """The integral over the window, by summed areas; dark beyond the picture, and even light stays even."""
    values = np.random.default_rng(seed).random(size)
    ends = np.array([start, start + length])
    summed = np.diff(np.interp(ends, np.arange(size + 1), np.concatenate([[0], np.cumsum(values)])))[0]
    found = overlap(size, pixels, *ends) @ values
    assert found.sum() * length / pixels == pytest.approx(summed, abs=1e-9)
    assert found.min() >= 0 and found.max() <= values.max() + 1e-9
    assert overlap(size, pixels) @ np.ones(size) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("rotate", [0, 90])
def test_a_crop_is_the_picture_of_that_part_alone(rotate):
    """Whole pixels of the file, upright; `fit` then sees the part as the picture."""
    whole = np.add.outer(np.arange(40.0), np.arange(60.0)) + 1.0
    given = {"z": 100.0, "x": (-20.0, 20.0), "y": (-30.0, 30.0), "pixels": 30, "gamma": 1.0, "rotate": rotate}
    by_crop = Target(**given, image=whole, crop=(0.25, 0.1, 0.751, 0.9))
    by_hand = Target(**given, image=whole[4:36, 15:45])
    assert by_crop.irradiance() == pytest.approx(by_hand.irradiance(), rel=1e-6)
    assert shown_size(by_crop) == shown_size(by_hand) == ((30, 32) if rotate == 0 else (32, 30))
    assert by_crop.remarks() == by_hand.remarks() != ()
    assert Target(**given, image=whole, crop=(0, 0, 1, 1)).irradiance() == pytest.approx(
        Target(**given, image=whole).irradiance(), rel=1e-12
    )


@pytest.mark.parametrize(("given", "sentence"), [
    ({"uniform": True, "crop": (0.0, 0.0, 1.0, 0.5)}, "target.crop: only an image or a sample can be cropped"),
    ({"sample": "astronaut", "crop": (0.5, 0.0, 0.5, 1.0)}, r"target.crop: \[0.5, 0, 0.5, 1\] is empty"),
])  # fmt: skip
def test_a_crop_of_nothing_is_refused(given, sentence):
    target = Target(z=100.0, x=(-20.0, 20.0), y=(-30.0, 30.0), pixels=30, **given)
    assert re.match(sentence, next(target.complaints()))
