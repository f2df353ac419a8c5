"""Tones: numbers become light as their file means them, by the standards' own figures."""

import io
import struct
import zlib

import numpy as np
import pytest
import tifffile  # comes with scikit-image
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageCms

from bstcad.scene import picture
from bstcad.scene.errors import SceneError
from bstcad.scene.framing import Frame
from bstcad.scene.picture import Picture
from bstcad.scene.tones import Tones, from_srgb, to_srgb

RAMP = np.tile(np.arange(16, dtype=np.uint8) * 17, (16, 1))  # 0 … 255 from left to right
SRGB = {0: 0.0, 10: 0.0030352698, 51: 0.0331047666, 128: 0.2158605001, 188: 0.5028864580, 255: 1.0}  # IEC 61966-2-1


def drawn(data, name="p.png", side=16, **tones):
    """The light of a picture file of side x side pixels."""
    return picture.photograph(Picture(name, data), Frame(side, side, 1.0, 1.0), Tones(**tones)).light


def saved(image, kind="PNG", **options):
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def png(values, *chunks):
    """A PNG of 16 bits, (h, w, channels); Pillow writes none in colour.  chunks: (name, body) before the pixels."""
    height, width, channels = values.shape
    raw = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    head = struct.pack(">IIBBBBB", width, height, 16, {1: 0, 2: 4, 3: 2, 4: 6}[channels], 0, 0, 0)
    parts = [(b"IHDR", head), *chunks, (b"IDAT", zlib.compress(raw)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body)) for name, body in parts
    )


def with_chunk(data, name, body):
    """A PNG with one more chunk behind its header."""
    chunk = struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
    return data[:33] + chunk + data[33:]


def test_the_curve_is_that_of_the_standard():
    for number, light in SRGB.items():
        assert from_srgb(np.array(number / 255)) == pytest.approx(light, abs=1e-9)


@given(st.floats(0, 1))
@settings(max_examples=100)
def test_there_and_back(value):
    assert to_srgb(from_srgb(value)) == pytest.approx(value, abs=1e-7)  # the standard's two pieces meet within 1e-7


@pytest.mark.parametrize("kind", ["PNG", "BMP", "TIFF", "WEBP", "JPEG"])
def test_eight_bits_are_srgb(kind):
    image = Image.fromarray(RAMP)
    lossy = {"WEBP": {"lossless": True}, "JPEG": {"quality": 100, "subsampling": 0}}.get(kind, {})
    flat = Image.new("RGB", (16, 16), (188, 188, 188)) if kind == "JPEG" else image
    wanted = np.full((16, 16), SRGB[188]) if kind == "JPEG" else from_srgb(RAMP / 255)
    np.testing.assert_allclose(drawn(saved(flat, kind, **lossy)), wanted, rtol=1e-9)


def test_grey_is_the_mean_of_the_light_of_the_channels():
    """Not the light of their mean."""
    light = drawn(saved(Image.new("RGB", (16, 16), (255, 128, 0))))
    np.testing.assert_allclose(light, (1 + SRGB[128]) / 3, rtol=1e-9)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_are_linear_to_the_last(channels):
    values = np.random.default_rng(0).integers(0, 65536, (16, 16, channels), dtype=np.uint16)
    if channels == 4:
        values[..., 3] = 65535
    colours = values[..., :3] / 65535
    np.testing.assert_allclose(drawn(png(values)), colours.mean(-1), rtol=1e-12)
    negative = from_srgb(1 - to_srgb(colours)).mean(-1)
    np.testing.assert_allclose(drawn(png(values), invert=True), negative, rtol=1e-9)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("compression", [None, "deflate"])
def test_a_tiff_of_sixteen_bits_a_colour_is_linear_to_the_last(order, compression):
    values = np.random.default_rng(0).integers(0, 65536, (16, 16, 3), dtype=np.uint16)
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, values, photometric="rgb", byteorder=order, compression=compression)
    np.testing.assert_allclose(drawn(buffer.getvalue(), "p.tif"), values.mean(-1) / 65535, rtol=1e-12)


def test_floats_are_linear():
    values = np.random.default_rng(0).random((16, 16)).astype(np.float32)
    np.testing.assert_allclose(drawn(saved(Image.fromarray(values), "TIFF"), "p.tif"), values, rtol=1e-7)


def test_grey_and_opacity_of_sixteen_bits():
    """Of which Pillow keeps the first byte."""
    values = np.full((16, 16, 2), 65535, np.uint16)
    values[:, :8, 0] = 0x4000
    np.testing.assert_allclose(drawn(png(values))[:, :8], 0x4000 / 65535, rtol=0.01)


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
    data = png(RAMP[..., None].astype(np.uint16) * 257) if deep else saved(Image.fromarray(RAMP))
    for name, body in chunks:
        data = with_chunk(data, name, body)
    value = RAMP / 255
    wanted = value if deep and what == "gAMA of nothing" else from_srgb(value) if exponent is None else value**exponent
    np.testing.assert_allclose(drawn(data), wanted, rtol=1e-4, atol=1e-12)  # 45455 is not quite 1 / 2.2
    np.testing.assert_allclose(drawn(data, gamma=3.0), value**3, rtol=1e-12)  # the scene goes before the file


def test_hdr_numbers_are_refused_unless_gamma_is_given():
    data = with_chunk(saved(Image.fromarray(RAMP)), b"cICP", bytes([9, 16, 0, 1]))
    with pytest.raises(SceneError, match="HDR picture .*; save it in sRGB, or give target.gamma"):
        drawn(data)
    assert drawn(data, gamma=1.0).max() == 1.0


def profile_of(exponent):
    """A grey ICC profile of value ** exponent, the least there is: a header and five tags."""

    def text(tag, body):
        return tag + bytes(4) + body

    white = text(b"XYZ ", struct.pack(">3i", round(0.9642 * 65536), 65536, round(0.8249 * 65536)))
    curve = text(b"curv", struct.pack(">IH", 1, round(exponent * 256))) + bytes(2)
    name = text(b"desc", struct.pack(">I", 5) + b"grey\0" + bytes(4 + 4 + 2 + 1 + 67)) + bytes(3)
    copy = text(b"text", b"none\0") + bytes(3)
    parts = {b"desc": name, b"cprt": copy, b"wtpt": white, b"kTRC": curve}
    place = 128 + 4 + 12 * len(parts)
    table, body = struct.pack(">I", len(parts)), b""
    for tag, part in parts.items():
        table += tag + struct.pack(">II", place + len(body), len(part))
        body += part
    head = struct.pack(
        ">I4sI4s4s4s12x4s4s4x4s4s8xI3i4s44x", place + len(body), b"none", 0x02400000, b"mntr", b"GRAY", b"XYZ ",
        b"acsp", b"APPL", b"none", b"none", 0, round(0.9642 * 65536), 65536, round(0.8249 * 65536), b"none",
    )  # fmt: skip
    return head + table + body


@pytest.mark.parametrize("exponent", [1.0, 1.8])
@pytest.mark.parametrize("deep", [False, True])
def test_an_icc_profile_says_what_its_numbers_mean(exponent, deep):
    if deep:
        body = b"grey\0\0" + zlib.compress(profile_of(exponent))
        data = png(RAMP[..., None].astype(np.uint16) * 257, (b"iCCP", body))
    else:
        data = saved(Image.fromarray(RAMP), icc_profile=profile_of(exponent))
    levels = to_srgb(np.array([0, *drawn(data)[0], 1.0]))[1:-1] * 255
    wanted = to_srgb((RAMP[0] / 255) ** exponent) * 255
    np.testing.assert_allclose(levels, wanted, atol=1.0)  # levels of the 8 bits it goes through


def test_the_profile_of_srgb_changes_nothing_to_speak_of():
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    colours = np.random.default_rng(0).integers(0, 256, (16, 16, 3), dtype=np.uint8)
    plain, told = (drawn(saved(Image.fromarray(colours), **how)) for how in ({}, {"icc_profile": srgb}))
    np.testing.assert_allclose(to_srgb(told) * 255, to_srgb(plain) * 255, atol=1.0)


@pytest.mark.parametrize("junk", [b"junk", b"\0" * 128, profile_of(1.0)[:200]])
def test_a_profile_that_is_none_is_passed_over(junk):
    data = saved(Image.fromarray(RAMP), icc_profile=junk)
    np.testing.assert_allclose(drawn(data), from_srgb(RAMP / 255), rtol=1e-9)


def test_a_profile_of_other_channels_is_passed_over():
    data = saved(Image.fromarray(RAMP).convert("RGB"), icc_profile=profile_of(1.0))
    np.testing.assert_allclose(drawn(data), from_srgb(RAMP / 255), rtol=1e-9)


def test_inverted_is_the_negative_that_is_seen():
    np.testing.assert_allclose(drawn(saved(Image.fromarray(RAMP)), invert=True), from_srgb(1 - RAMP / 255), atol=1e-12)
    once = Image.fromarray(255 - RAMP)
    np.testing.assert_allclose(drawn(saved(once), invert=True), drawn(saved(Image.fromarray(RAMP))), atol=1e-12)


def test_a_cmyk_jpeg_has_its_white_bright_and_its_ink_dark():
    image = Image.new("CMYK", (16, 16), (0, 0, 0, 0))
    image.paste((0, 0, 0, 255), (0, 0, 16, 8))
    light = drawn(saved(image, "JPEG", quality=95), "p.jpg")
    assert light[8:].min() > 0.95 and light[:7].max() < 0.02


@pytest.mark.parametrize("name", picture.SAMPLES)
def test_samples_are_linear_unless_gamma_is_given(name):
    from skimage import data

    values = getattr(data, name)().astype(float).reshape(512, 512, -1) / 255
    frame = Frame(512, 512, 1.0, 1.0)
    np.testing.assert_allclose(picture.sample(name, frame, Tones()).light, values.mean(-1), rtol=1e-12)
    np.testing.assert_allclose(picture.sample(name, frame, Tones(2.0)).light, (values**2).mean(-1), rtol=1e-12)


# --- transparency -----------------------------------------------------------------------------------------------------


def logo(colour, ground=(0, 0, 0, 0), mode="RGBA"):
    """An L of one colour, transparent around it."""
    image = Image.new("RGBA", (16, 16), ground)
    image.paste(colour, (2, 2, 6, 14))
    image.paste(colour, (2, 10, 14, 14))
    return image.convert(mode)


INK = np.asarray(logo((0, 0, 0, 255)))[..., 3] > 0


def told(image, **tones):
    given = Picture("p.png", saved(image))
    found = picture.photograph(given, Frame(16, 16, 1.0, 1.0), Tones(**tones))
    return found.light, found.remarks


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
@pytest.mark.parametrize("colour", [(0, 0, 0, 255), (5, 5, 5, 255)])
def test_a_black_logo_on_transparency_is_light_and_says_so(mode, colour):
    light, remarks = told(logo(colour, mode=mode))
    np.testing.assert_array_equal(light, INK)
    assert len(remarks) == 1 and "what is opaque is taken as light" in remarks[0]
    np.testing.assert_array_equal(told(logo(colour, mode=mode), invert=True)[0], ~INK)


def test_a_palette_s_black_logo_is_light():
    image = Image.new("P", (16, 16), 0)
    image.putpalette([255, 255, 255, 0, 0, 0])
    image.putdata(INK.astype(np.uint8).ravel().tolist())
    light = drawn(saved(image, transparency=0))
    np.testing.assert_array_equal(light, INK)


def test_a_logo_of_sixteen_bits_with_a_transparent_number_is_light():
    values = np.where(INK, 0, 65535).astype(np.uint16)[..., None]
    data = png(values, (b"tRNS", struct.pack(">H", 65535)))
    np.testing.assert_array_equal(drawn(data), INK)


def test_a_logo_with_tones_of_its_own_stands_before_black():
    light, remarks = told(logo((255, 255, 255, 255)))
    np.testing.assert_array_equal(light, INK)
    assert remarks == (f"target.image: transparency is taken as black ({100 * (~INK).mean():.3g} % of the picture)",)


def test_half_transparent_white_is_the_tone_that_is_seen_before_black():
    light, _ = told(Image.new("RGBA", (16, 16), (255, 255, 255, 128)))
    np.testing.assert_allclose(light, SRGB[128], rtol=1e-9)


def test_an_opaque_picture_has_no_remark():
    assert told(logo((90, 0, 0, 255), ground=(0, 0, 0, 255)))[1] == ()


def test_a_picture_that_is_transparent_everywhere_gets_a_sentence_that_says_so():
    with pytest.raises(SceneError, match="target.image: the picture is transparent everywhere; give one"):
        told(Image.new("RGBA", (16, 16), (255, 255, 255, 0)))
