"""Pictures: numbers become light as their file means them, by the standards' own figures; light is conserved."""

import io
import struct
import zlib

import numpy as np
import pillow_heif
import pytest
import tifffile  # comes with scikit-image
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageCms

from bstcad.scene import picture
from bstcad.scene.errors import SceneError
from bstcad.scene.picture import Picture, from_srgb, read_picture, safe_name, to_srgb
from bstcad.scene.target import Target, drawing

RAMP = np.tile(np.arange(16, dtype=np.uint8) * 17, (16, 1))  # 0 … 255 from left to right
SRGB = {0: 0.0, 10: 0.0030352698, 51: 0.0331047666, 128: 0.2158605001, 188: 0.5028864580, 255: 1.0}  # IEC 61966-2-1
RANDOM = np.random.default_rng(0)


def drawn(image, pixels=16, name="p.png", **more):
    """The drawing of a picture, its file or its bytes on a square of so many pixels."""
    given = image if isinstance(image, Picture) else Picture(name, image)
    return drawing(Target(z=1.0, x=(0.0, 1.0), y=(0.0, 1.0), pixels=pixels, image=given, fit="stretch", **more))


def light(image, pixels=16, name="p.png", **more):
    return drawn(image, pixels, name, **more).light


def saved(image, kind="PNG", mode=None, **options):
    """The bytes of a picture file of an image, or of an array."""
    image = image if isinstance(image, Image.Image) else Image.fromarray(np.asarray(image))
    buffer = io.BytesIO()
    (image.convert(mode) if mode else image).save(buffer, kind, **options)
    return buffer.getvalue()


def chunk(name, body):
    """A chunk of a PNG."""
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def png(values, *chunks):
    """A PNG of 16 bits, (h, w, channels); Pillow writes none in colour.  chunks: (name, body) before the pixels."""
    height, width, channels = values.shape
    raw = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    head = struct.pack(">IIBBBBB", width, height, 16, {1: 0, 2: 4, 3: 2, 4: 6}[channels], 0, 0, 0)
    parts = [(b"IHDR", head), *chunks, (b"IDAT", zlib.compress(raw)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


def with_chunk(data, name, body):
    """A PNG with one more chunk behind its header."""
    return data[:33] + chunk(name, body) + data[33:]


# ---- tones -----------------------------------------------------------------------------------------------------------


@given(st.floats(0, 1))
@settings(max_examples=100)
def test_the_curve_is_that_of_the_standard_and_has_an_inverse(value):
    assert [float(from_srgb(n / 255)) for n in SRGB] == pytest.approx([*SRGB.values()], abs=1e-9)
    assert to_srgb(from_srgb(value)) == pytest.approx(value, abs=1e-7)  # the standard's two pieces meet within 1e-7


@pytest.mark.parametrize("kind", ["PNG", "BMP", "TIFF", "WEBP", "JPEG"])
def test_eight_bits_are_srgb(kind):
    lossy = {"WEBP": {"lossless": True}, "JPEG": {"quality": 100, "subsampling": 0}}.get(kind, {})
    flat = np.full((16, 16, 3), 188, np.uint8) if kind == "JPEG" else RAMP
    wanted = np.full((16, 16), SRGB[188]) if kind == "JPEG" else from_srgb(RAMP / 255)
    np.testing.assert_allclose(light(saved(flat, kind, **lossy)), wanted, rtol=1e-9)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_are_srgb_to_the_last_as_eight_bits_are(channels):
    values = RANDOM.integers(0, 65536, (16, 16, channels), dtype=np.uint16)
    if channels == 4:
        values[..., 3] = 65535
    colours = values[..., :3] / 65535
    np.testing.assert_allclose(light(png(values)), from_srgb(colours).mean(-1), rtol=1e-12)
    np.testing.assert_allclose(light(png(values), gamma=1.0), colours.mean(-1), rtol=1e-12)
    negative = from_srgb(1 - colours).mean(-1)
    np.testing.assert_allclose(light(png(values), invert=True), negative, rtol=1e-6, atol=1e-9)  # 1e-12 of its tones
    copy = np.tile(RAMP[..., None], channels)
    copy[..., 3:] = 255
    grey = copy[..., 0] if channels == 1 else copy  # the same picture in 16 bits, and in 8
    np.testing.assert_allclose(light(png(copy.astype(np.uint16) * 257)), light(saved(grey)), rtol=1e-12)


@pytest.mark.parametrize(("order", "compression"), [("<", None), (">", None), ("<", "deflate"), (">", "deflate")])
def test_a_tiff_of_sixteen_bits_a_colour_is_srgb_to_the_last(order, compression):
    values, buffer = RANDOM.integers(0, 65536, (16, 16, 3), dtype=np.uint16), io.BytesIO()
    tifffile.imwrite(buffer, values, photometric="rgb", byteorder=order, compression=compression)
    np.testing.assert_allclose(light(buffer.getvalue(), name="p.tif"), from_srgb(values / 65535).mean(-1), rtol=1e-12)


def test_floats_are_linear_and_grey_with_opacity_of_sixteen_bits_has_eight():
    values = RANDOM.random((16, 16)).astype(np.float32)
    np.testing.assert_allclose(light(saved(values, "TIFF"), name="p.tif"), values, rtol=1e-7)
    values = np.full((16, 16, 2), 65535, np.uint16)
    values[:, :8, 0] = 0x4000
    np.testing.assert_allclose(light(png(values))[:, :8], from_srgb(0x4000 / 65535), rtol=0.02)


def test_it_is_said_which_curve_was_taken_where_that_changes_the_light():
    """1 % of the light is the bound; a file that states its colours, and one of our own arrays, leaves nothing open."""
    deep = RAMP.astype(np.uint16)[..., None] * 257
    [remark] = drawn(png(deep)).remarks
    off = np.linalg.norm(from_srgb(RAMP / 255) * RAMP.mean() / from_srgb(RAMP / 255).mean() - RAMP)
    assert remark.startswith("target.image: the file has 16 bits or more and no colour tag: its values are")
    other = off * from_srgb(RAMP / 255).mean() / RAMP.mean() / np.linalg.norm(from_srgb(RAMP / 255))
    assert f"(RRMSD between both readings: {other:.2g})" in remark
    [remark] = drawn(saved((RAMP / 255).astype(np.float32), "TIFF"), name="p.tif").remarks
    assert "the file has floats and no colour tag: they are read as irradiance; with gamma = 2.2" in remark
    stated = with_chunk(png(deep), b"sRGB", b"\0"), png(deep, (b"gAMA", struct.pack(">I", 100_000))), saved(RAMP)
    white = png(np.where(RAMP > 99, 65535, 0).astype(np.uint16)[..., None])  # black and white are alike by both
    for silent in (*stated, white, picture.from_array(RAMP / 255)):
        assert drawn(silent).remarks == ()
    assert drawn(png(deep), gamma=1.0).remarks == ()


SAID = {  # chunks of a PNG of eight bits: the exponent they mean, None for sRGB
    "gAMA 1": ([(b"gAMA", struct.pack(">I", 100_000))], 1.0),
    "gAMA 1 / 2.2": ([(b"gAMA", struct.pack(">I", 45_455))], 2.2),
    "gAMA of nothing": ([(b"gAMA", struct.pack(">I", 0))], None),
    "sRGB before gAMA": ([(b"gAMA", struct.pack(">I", 100_000)), (b"sRGB", b"\0")], None),
    "cICP, linear": ([(b"cICP", bytes([1, 8, 0, 1]))], 1.0),
    "cICP, sRGB, before gAMA": ([(b"cICP", bytes([1, 13, 0, 1])), (b"gAMA", struct.pack(">I", 100_000))], None),
}


@pytest.mark.parametrize("what", SAID)
@pytest.mark.parametrize("deep", [False, True])
def test_a_png_says_what_its_numbers_mean(what, deep):
    chunks, exponent = SAID[what]
    data = png(RAMP[..., None].astype(np.uint16) * 257) if deep else saved(RAMP)
    for name, body in chunks:
        data = with_chunk(data, name, body)
    value = RAMP / 255
    wanted = from_srgb(value) if exponent is None else value**exponent
    np.testing.assert_allclose(light(data), wanted, rtol=1e-4, atol=1e-12)  # 45455 is not quite 1 / 2.2
    np.testing.assert_allclose(light(data, gamma=3.0), value**3, rtol=1e-12)  # the scene goes before the file


def test_hdr_numbers_are_refused_unless_gamma_is_given():
    data = with_chunk(saved(RAMP), b"cICP", bytes([9, 16, 0, 1]))
    with pytest.raises(SceneError, match="HDR picture .*; save it in sRGB"):
        light(data)
    assert light(data, gamma=1.0).max() == 1.0


def profile_of(exponent):
    """A grey ICC profile of value ** exponent, the least there is: a header and four tags."""
    white = struct.pack(">3i", round(0.9642 * 65536), 65536, round(0.8249 * 65536))
    parts = {
        b"desc": b"desc" + bytes(4) + struct.pack(">I", 5) + b"grey\0" + bytes(4 + 4 + 2 + 1 + 67 + 3),
        b"cprt": b"text" + bytes(4) + b"none\0" + bytes(3),
        b"wtpt": b"XYZ " + bytes(4) + white,
        b"kTRC": b"curv" + bytes(4) + struct.pack(">IH", 1, round(exponent * 256)) + bytes(2),
    }
    place = 128 + 4 + 12 * len(parts)
    table, body = struct.pack(">I", len(parts)), b""
    for tag, part in parts.items():
        table += tag + struct.pack(">II", place + len(body), len(part))
        body += part
    head = struct.pack(
        ">I4sI4s4s4s12x4s4s4x4s4s8xI", place + len(body), b"none", 0x02400000, b"mntr", b"GRAY", b"XYZ ",
        b"acsp", b"APPL", b"none", b"none", 0,
    )  # fmt: skip
    return head + white + b"none" + bytes(44) + table + body


@pytest.mark.parametrize("exponent", [1.0, 1.8])
@pytest.mark.parametrize("deep", [False, True])
def test_an_icc_profile_says_what_its_numbers_mean(exponent, deep):
    body = b"grey\0\0" + zlib.compress(profile_of(exponent))
    deep_png = png(RAMP[..., None].astype(np.uint16) * 257, (b"iCCP", body))
    data = deep_png if deep else saved(RAMP, icc_profile=profile_of(exponent))
    levels, wanted = to_srgb(light(data)[0]) * 255, to_srgb((RAMP[0] / 255) ** exponent) * 255
    np.testing.assert_allclose(levels, wanted, atol=1.0)  # levels of the 8 bits it goes through


@pytest.mark.parametrize("mode, profile, off", [
    ("L", b"junk", 0), ("L", profile_of(1.0)[:200], 0), ("RGB", profile_of(1.0), 0),
    ("RGB", ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(), 1),
])  # fmt: skip
def test_a_profile_that_is_none_or_of_other_channels_or_of_srgb_changes_nothing(mode, profile, off):
    found = to_srgb(light(saved(RAMP, mode=mode, icc_profile=profile))) * 255
    np.testing.assert_allclose(found, RAMP, atol=off + 1e-4)


def test_a_cmyk_jpeg_has_its_white_bright_and_its_ink_dark():
    image = Image.new("CMYK", (16, 16), (0, 0, 0, 0))
    image.paste((0, 0, 0, 255), (0, 0, 16, 8))
    found = light(saved(image, "JPEG", quality=95), name="p.jpg")
    assert found[8:].min() > 0.95 and found[:7].max() < 0.02


@pytest.mark.parametrize("name", picture.SAMPLES)
def test_samples_are_linear_unless_gamma_is_given(name):
    from skimage import data

    values = getattr(data, name)().astype(float).reshape(512, 512, -1) / 255
    for gamma in (None, 2.0):
        target = Target(z=1.0, x=(0.0, 1.0), y=(0.0, 1.0), pixels=512, sample=name, gamma=gamma)
        np.testing.assert_allclose(drawing(target).light, (values ** (gamma or 1.0)).mean(-1), rtol=1e-12)


def test_gamma_goes_before_averaging_and_grey_is_the_mean_of_the_light_of_the_channels():
    found = light(saved(Image.new("RGB", (16, 16), (255, 128, 0))))
    np.testing.assert_allclose(found, (1 + SRGB[128]) / 3, rtol=1e-9)
    values = np.tile(np.array([255, 128], np.uint8), (16, 8))
    np.testing.assert_allclose(light(saved(values), 8, gamma=2.2), (1 + (128 / 255) ** 2.2) / 2, rtol=1e-12)


# ---- files -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "I", "F"])
def test_every_mode_is_read(mode):
    values = np.zeros((16, 16), np.uint8)
    values[4:8, 4:8] = 255
    grey = light(saved(values, "TIFF" if mode in ("CMYK", "F", "I") else "PNG", mode), gamma=1.0)
    np.testing.assert_array_equal(grey > grey.max() / 2, values > 0)


SHAPE = np.zeros((32, 32), np.uint8)  # no mirror image of itself
SHAPE[4:12, 4:8] = SHAPE[4:8, 4:24] = SHAPE[20:28, 16:28] = 255
KINDS = {"BMP": ".bmp", "WEBP": ".webp", "HEIC": ".heic", "AVIF": ".avif", "JPEG": ".jpg", "GIF": ".gif"}
SEVERAL = {"MPO": ".jpg", "WEBP": ".webp", "PNG": ".png", "TIFF": ".tif", "GIF": ".gif"}


def in_file(tmp_path, kind):
    """SHAPE in a file of this kind, named as something else: the content decides."""
    image, path = Image.fromarray(SHAPE).convert("RGB"), tmp_path / "shape.jpg"
    if kind == "HEIC":
        pillow_heif.from_pillow(image).save(path, quality=90)
    else:
        image.save(path, kind, **({"lossless": True} if kind == "WEBP" else {}))
    return path


@pytest.mark.parametrize("kind", SEVERAL)
def test_the_first_of_several_pictures_is_taken_and_that_is_said(tmp_path, kind):
    """A telephone's JPEG with another behind it (MPO), pages of a TIFF file, moving pictures."""
    image, path = Image.fromarray(SHAPE).convert("RGB"), tmp_path / "shape.jpg"
    how = {"MPO": {"quality": 95}, "WEBP": {"lossless": True}}.get(kind, {})
    image.save(path, kind, save_all=True, append_images=[Image.new("RGB", (32, 32), (9, 99, 9))], **how)
    found = read_picture(path)
    assert found.name == f"shape{SEVERAL[kind]}"
    np.testing.assert_array_equal(light(found, 32) > 0.4, SHAPE > 0)
    assert drawn(found, 32).remarks == ("target.image: the file has several pictures; the first one is used",)


@pytest.mark.parametrize("kind", KINDS)
def test_what_cameras_and_programs_write_is_read(tmp_path, kind):
    found = read_picture(in_file(tmp_path, kind))
    assert found.name == f"shape{KINDS[kind]}"
    grey = light(found, 32)
    np.testing.assert_array_equal(grey > 0.4, SHAPE > 0)
    assert grey[SHAPE > 0].min() > 0.8 and grey[SHAPE == 0].max() < 0.1 and drawn(found, 32).remarks == ()


@pytest.mark.parametrize("value", [np.nan, -1.0, np.inf])
def test_values_that_are_no_light_are_refused_and_others_are_parts_of_the_largest(value):
    """3e38 ** 9 is no number; white is the largest value where that is more than 1."""
    values = np.full((8, 8), 3e38, np.float32)
    values[:4] = 1.5e38
    found = light(saved(values, "TIFF"), 8, gamma=9.0)
    np.testing.assert_allclose(found[:4], found[4:] / 2**9, rtol=1e-6)
    values[3, 3] = value
    with pytest.raises(SceneError, match="negative or not finite"):
        light(saved(values, "TIFF"), 8)


def test_whole_numbers_of_32_bits_are_refused_by_their_sign_or_size():
    """Pillow reads numbers without a sign as if they had one."""
    values = np.full((8, 8), 7, np.int32)
    assert light(saved(values, "TIFF"), 8).max() > 0
    for value in (-1, np.array(3_000_000_000, np.uint32).astype(np.int32)):
        values[3, 3] = value
        with pytest.raises(SceneError, match=r"negative, or above 2147483647 without a sign; save it"):
            light(saved(values, "TIFF"), 8)


@pytest.mark.parametrize("side", [8001, 20_000])  # over our own limit; over the limit of Pillow itself
def test_files_that_are_damaged_or_huge_or_of_another_kind_are_refused(tmp_path, side):
    whole, path = saved(RANDOM.integers(0, 256, (64, 64), dtype=np.uint8)), tmp_path / "p.ppm"
    with pytest.raises(SceneError, match="is damaged"):
        light(whole[: len(whole) // 2], 64)
    Image.new("L", (8, 8), 255).save(path)
    with pytest.raises(SceneError, match="not a PNG, JPEG, TIFF, WebP, BMP, GIF, HEIC or AVIF picture"):
        read_picture(path)
    Image.new("1", (side, side)).save(path, "PNG")
    with pytest.raises(SceneError, match="shrink it"):
        read_picture(path)


NAMES = {"C:\\lens": "lens", ".hidden": "hidden", "my lens (2)": "my-lens-2-", "Übergröße": "Ubergroe", "../..": ""}


@given(st.text(max_size=200))
def test_a_safe_name_stays_in_its_folder(text):
    safe = safe_name(text)
    assert "/" not in safe and "\\" not in safe and not safe.startswith(".") and len(safe) <= 80
    assert safe_name(safe) == safe and [safe_name(name) for name in NAMES] == [*NAMES.values()]


# ---- transparency ----------------------------------------------------------------------------------------------------


def logo(colour, ground=(0, 0, 0, 0), mode="RGBA"):
    """An L of one colour, transparent around it."""
    image = Image.new("RGBA", (16, 16), ground)
    image.paste(colour, (2, 2, 6, 14))
    image.paste(colour, (2, 10, 14, 14))
    return image.convert(mode)


INK = np.asarray(logo((0, 0, 0, 255)))[..., 3] > 0


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
@pytest.mark.parametrize("colour", [(0, 0, 0, 255), (5, 5, 5, 255)])
def test_a_black_logo_on_transparency_is_light_and_says_so(mode, colour):
    data = saved(logo(colour, mode=mode))
    found = drawn(data)
    np.testing.assert_array_equal(found.light, INK)
    assert len(found.remarks) == 1 and "opaque parts are read as light" in found.remarks[0]
    np.testing.assert_array_equal(light(data, invert=True), ~INK)


def test_a_logo_of_a_palette_or_of_sixteen_bits_with_a_transparent_number_is_light():
    image = Image.new("P", (16, 16), 0)
    image.putpalette([255, 255, 255, 0, 0, 0])
    image.putdata(INK.astype(np.uint8).ravel().tolist())
    values = np.where(INK, 0, 65535).astype(np.uint16)[..., None]
    for data in (saved(image, transparency=0), png(values, (b"tRNS", struct.pack(">H", 65535)))):
        np.testing.assert_array_equal(light(data), INK)


def test_a_picture_with_tones_of_its_own_stands_before_black():
    found = drawn(saved(logo((255, 255, 255, 255))))
    np.testing.assert_array_equal(found.light, INK)
    share = 100 * (~INK).mean()
    assert found.remarks == (f"target.image: transparency is read as black ({share:.3g} % of the picture)",)
    half = saved(Image.new("RGBA", (16, 16), (255, 255, 255, 128)))
    np.testing.assert_allclose(light(half), SRGB[128], rtol=1e-9)
    assert drawn(saved(logo((90, 0, 0, 255), ground=(0, 0, 0, 255)))).remarks == ()
    with pytest.raises(SceneError, match="target.image: the picture is transparent everywhere; give one"):
        drawn(saved(Image.new("RGBA", (16, 16), (255, 255, 255, 0))))
