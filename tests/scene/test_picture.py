"""Pictures: light is conserved and lands in the right pixel, whatever the file."""

import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pillow_heif
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from bstcad.optics.outlines import Circle, Rectangle
from bstcad.scene import picture
from bstcad.scene.errors import SceneError
from bstcad.scene.framing import Frame, inside, overlap
from bstcad.scene.picture import Picture, letters, read_picture, safe_name
from bstcad.scene.tones import Tones


def photograph(given, pixels, gamma=1.0, fit="stretch"):
    """The light of a picture on a square of so many pixels; its numbers are linear unless gamma says otherwise."""
    return picture.photograph(given, Frame(pixels, pixels, 1.0, 1.0, fit), Tones(gamma)).light


def lettered(text, pixels, aspect):
    return letters(text, Frame(pixels, pixels, aspect, 1.0))


def encoded(values, kind="PNG", mode=None, **options):
    """A picture file of an array."""
    image, buffer = Image.fromarray(np.asarray(values)), io.BytesIO()
    (image.convert(mode) if mode else image).save(buffer, kind, **options)
    return Picture("p.png", buffer.getvalue())


@settings(deadline=None, max_examples=60)
@given(size=st.integers(1, 200), pixels=st.integers(1, 200), seed=st.integers(0, 99))
def test_averaging_keeps_the_mean_and_constants(size, pixels, seed):
    values = np.random.default_rng(seed).random(size)
    averaged = overlap(size, pixels) @ values
    assert averaged.mean() == pytest.approx(values.mean(), rel=1e-12)
    assert overlap(size, pixels) @ np.ones(size) == pytest.approx(1.0, abs=1e-12)
    assert averaged.min() >= values.min() - 1e-12


def test_averaging_by_a_whole_factor_is_the_block_mean():
    values = np.random.default_rng(0).integers(0, 256, (60, 90), dtype=np.uint8)
    blocks = values.reshape(15, 4, 15, 6).mean((1, 3)) / 255
    np.testing.assert_allclose(photograph(encoded(values), 15), blocks, rtol=1e-12)


def test_a_picture_of_the_right_size_is_taken_as_it_is():
    values = np.random.default_rng(0).integers(0, 256, (16, 16), dtype=np.uint8)
    np.testing.assert_allclose(photograph(encoded(values), 16), values / 255.0, rtol=1e-15)


def test_rows_run_down_and_columns_to_the_right():
    values = np.zeros((8, 8), np.uint8)
    values[0, 7] = 255  # the top right corner: y max, x max
    assert np.argwhere(photograph(encoded(values), 8)).tolist() == [[0, 7]]


def test_grey_is_the_mean_of_the_channels():
    values = np.zeros((8, 8, 3), np.uint8)
    values[..., 1] = 255
    np.testing.assert_allclose(photograph(encoded(values), 8), 1 / 3, rtol=1e-12)


def test_transparency_is_composited_on_black():
    values = np.full((8, 8, 4), 255, np.uint8)
    values[..., 3] = 51  # a fifth
    np.testing.assert_allclose(photograph(encoded(values), 8), 0.2, rtol=1e-12)


def test_a_palette_with_a_transparent_colour_is_composited_on_black():
    image = Image.new("P", (8, 8), 0)
    image.putpalette([255, 255, 255, 0, 0, 255])
    image.paste(1, (0, 0, 8, 4))
    buffer = io.BytesIO()
    image.save(buffer, "PNG", transparency=0)
    grey = photograph(Picture("p.png", buffer.getvalue()), 8)
    np.testing.assert_allclose(grey[:4], 1 / 3, rtol=1e-12)
    assert not grey[4:].any()


def test_gamma_goes_before_averaging():
    values = np.zeros((8, 8), np.uint8)
    values[:, ::2] = 255
    values[:, 1::2] = 128
    expected = (1 + (128 / 255) ** 2.2) / 2
    np.testing.assert_allclose(photograph(encoded(values), 4, 2.2), expected, rtol=1e-12)


@pytest.mark.parametrize("kind", ["PNG", "TIFF"])
def test_sixteen_bits_are_kept(kind):
    values = np.arange(64 * 64, dtype=np.uint16).reshape(64, 64) * 16 + 1
    grey = photograph(encoded(values, kind), 64)
    np.testing.assert_allclose(grey / grey.sum(), values / values.sum(dtype=float), rtol=1e-12)


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "I", "F"])
def test_every_mode_is_read(mode):
    values = np.zeros((16, 16), np.uint8)
    values[4:8, 4:8] = 255
    kind = "TIFF" if mode in ("CMYK", "F", "I") else "PNG"
    grey = photograph(encoded(values, kind, mode), 16)
    np.testing.assert_array_equal(grey > grey.max() / 2, values > 0)


SHAPE = np.zeros((32, 32), np.uint8)  # no mirror image of itself
SHAPE[4:12, 4:8] = SHAPE[4:8, 4:24] = SHAPE[20:28, 16:28] = 255


def in_file(tmp_path, kind):
    """SHAPE in a file of this kind, named as something else: the content decides."""
    image, path = Image.fromarray(SHAPE).convert("RGB"), tmp_path / "shape.jpg"
    if kind == "HEIC":
        pillow_heif.from_pillow(image).save(path, quality=90)
    elif kind == "MPO":  # what telephones call a JPEG: another picture behind the first
        image.save(path, "MPO", save_all=True, append_images=[Image.new("RGB", (32, 32))], quality=95)
    elif kind == "moving WebP":
        image.save(path, "WEBP", save_all=True, append_images=[Image.new("RGB", (32, 32), (9, 9, 9))], lossless=True)
    else:
        image.save(path, kind, **({"lossless": True} if kind == "WEBP" else {}))
    return path


KINDS = {"BMP": ".bmp", "WEBP": ".webp", "moving WebP": ".webp", "HEIC": ".heic", "MPO": ".jpg", "JPEG": ".jpg"}


@pytest.mark.parametrize("kind", KINDS)
def test_what_cameras_and_programs_write_is_read(tmp_path, kind):
    found = read_picture(in_file(tmp_path, kind))
    assert found.name == f"shape{KINDS[kind]}"
    light = photograph(found, 32, None)
    np.testing.assert_array_equal(light > 0.4, SHAPE > 0)
    assert light[SHAPE > 0].min() > 0.8 and light[SHAPE == 0].max() < 0.1


def test_heic_loads_its_library_only_where_one_is_read(tmp_path):
    """By a process of its own; the others of this suite may have loaded it."""
    Image.fromarray(SHAPE).save(tmp_path / "a.png")
    heic = in_file(tmp_path, "HEIC")
    code = (
        "import sys; from pathlib import Path; from bstcad.scene.picture import read_picture\n"
        f"for path in ({str(tmp_path / 'a.png')!r}, {str(heic)!r}):\n"
        "    read_picture(Path(path)); print('pillow_heif' in sys.modules)"
    )
    house = Path(__file__).parent.parent.parent
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=house)
    assert done.stdout.split() == ["False", "True"], done.stderr


@pytest.mark.parametrize("value", [np.nan, -1.0, np.inf])
def test_values_that_are_no_light_are_refused(value):
    values = np.ones((8, 8), np.float32)
    values[3, 3] = value
    with pytest.raises(SceneError, match="negative or not finite"):
        photograph(encoded(values, "TIFF"), 8)


def test_values_whose_powers_would_overflow_are_taken_as_parts_of_the_largest():
    """3e38 ** 9 is no number; white is the largest value where that is more than 1."""
    values = np.full((8, 8), 3e38, np.float32)
    values[:4] = 1.5e38
    light = photograph(encoded(values, "TIFF"), 8, 9.0)
    np.testing.assert_allclose(light[:4], light[4:] / 2**9, rtol=1e-6)


def test_a_cut_file_is_refused():
    noise = np.random.default_rng(0).integers(0, 256, (64, 64), dtype=np.uint8)
    whole = encoded(noise)
    with pytest.raises(SceneError, match="is damaged"):
        photograph(Picture("p.png", whole.data[: len(whole.data) // 2]), 64)


def test_other_formats_are_refused(tmp_path):
    path = tmp_path / "p.gif"
    Image.new("L", (8, 8), 255).save(path)
    with pytest.raises(SceneError, match="no PNG, JPEG, TIFF, WebP, BMP or HEIC picture"):
        read_picture(path)


@pytest.mark.parametrize("side", [8001, 20_000])  # over our own limit; over the limit of Pillow itself
def test_a_huge_picture_is_refused_before_it_is_decoded(tmp_path, side):
    path = tmp_path / "p.png"
    Image.new("1", (side, side)).save(path)
    with pytest.raises(SceneError, match="shrink it"):
        read_picture(path)


def test_letters_fill_the_width_and_stand_in_the_middle():
    flux = lettered("THU", 512, 1.0)
    columns, rows = np.flatnonzero(flux.max(0) > 0.5), np.flatnonzero(flux.max(1) > 0.5)
    assert 0.80 < (columns[-1] - columns[0] + 1) / 512 < 0.86
    assert columns[0] + columns[-1] == pytest.approx(511, abs=2)
    assert rows[0] + rows[-1] == pytest.approx(511, abs=2)
    stems = np.diff((flux[210] > 0.5).astype(int)) == 1  # T has one, H and U have two each
    assert np.count_nonzero(stems) == 5


def test_letters_are_upright_on_a_wide_target():
    """The same letters on twice the width: half as wide in pixels, so that they keep their shape in mm."""
    square, wide = lettered("I", 256, 1.0), lettered("I", 256, 2.0)
    extent = [np.count_nonzero(f.max(0) > 0.5) / np.count_nonzero(f.max(1) > 0.5) for f in (square, wide)]
    assert extent[0] / extent[1] == pytest.approx(2.0, rel=0.05)


def test_several_lines_fit():
    flux = lettered("one\ntwo", 128, 1.0)
    assert not flux[0].any() and not flux[-1].any() and not flux[:, 0].any() and not flux[:, -1].any()


def test_a_letter_the_font_lacks_is_refused():
    with pytest.raises(SceneError, match="the font has no letter '林'"):
        lettered("林", 64, 1.0)


@pytest.mark.parametrize("outline", [Circle(30.0), Rectangle(31.0, 47.0)])
@pytest.mark.parametrize("pixels", [16, 100])
def test_an_outline_lets_its_area_through(outline, pixels):
    share = inside(outline, pixels, pixels, 80.0, 60.0)
    assert share.mean() * 80 * 60 == pytest.approx(outline.area, rel=2e-3)  # sub-pixels at the rim
    np.testing.assert_array_equal(share, share[::-1, ::-1])
    assert share[pixels // 2, pixels // 2] == 1.0 and share[0, 0] == 0.0


@pytest.mark.parametrize(
    ("text", "safe"),
    [
        ("thu", "thu"),
        ("../../etc/passwd", "passwd"),
        ("C:\\lens", "lens"),
        (".hidden", "hidden"),
        ("my lens (2)", "my-lens-2-"),
        ("Übergröße", "Ubergroe"),
        ("../..", ""),
        ("a\0b\nc", "a-b-c"),
    ],
)
def test_names_are_made_safe(text, safe):
    assert safe_name(text) == safe


@given(st.text(max_size=200))
def test_a_safe_name_stays_in_its_folder(text):
    safe = safe_name(text)
    assert "/" not in safe and "\\" not in safe and not safe.startswith(".") and len(safe) <= 80
    assert safe_name(safe) == safe
