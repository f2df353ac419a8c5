"""Pictures: grey irradiance from a file, an array, a sample or letters.

A photograph's pixel values of 8 or 16 bits are sRGB (IEC 61966-2-1): E = c / 12.92 up to c = 0.04045, and
E = ((c + 0.055) / 1.055)^2.4 above it, for a channel c and the irradiance E, both from 0 to 1.  Floats are irradiance.
A statement in the file has priority: cICP, an ICC profile, sRGB or gAMA, in this order, as in PNG.  The grey irradiance
is the mean over the channels.  The first picture of a file with several is read.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import math
import os
import re
import struct
import sys
import threading
import unicodedata
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from PIL import ExifTags, Image, ImageCms, ImageDraw, ImageFile, ImageFont

from bstcad.runs import files
from bstcad.scene.errors import SceneError
from bstcad.scene.schema import FileContent

# File name suffix of the copy, by format; the second line has the formats in a HEIF file.
FORMATS = {"PNG": ".png", "JPEG": ".jpg", "MPO": ".jpg", "TIFF": ".tif", "WEBP": ".webp", "BMP": ".bmp", "GIF": ".gif"}
FORMATS |= {"HEIF": ".heic", "AVIF": ".avif"}
PILLOW_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "GIF")  # formats read by Pillow; an MPO begins with a JPEG
FORMAT_NAMES = "PNG, JPEG, TIFF, WebP, BMP, GIF, HEIC or AVIF"
AVIF = (b"avif", b"avis")  # brands of a HEIF file with pixels in AV1: one picture, a sequence
DESCRIPTION = 270  # tag of the description in a TIFF file
IRRADIANCE = "irradiance"  # description of the file of an array, whose floats are irradiance
MAX_PICTURE_PIXELS = 64_000_000  # largest number of pixels of a picture
MAX_PICTURE_SIDE = 65_535  # largest number of pixels along a side, the limit of JPEG
TILE_WIDTH, TILE_LENGTH = 322, 323  # tags with the size of a TIFF file's tiles, each of which is decoded as a whole
MAX_TILE = 4096**2  # largest number of pixels of a tile; programs write tiles of up to 1024 per side
MAX_PICTURE_SIZE = 400_000_000  # largest file of a picture (bytes): 64 million pixels of three 16-bit channels
MAX_PROFILE_SIZE = 10_000_000  # largest ICC profile that is used (bytes); those of printers have a few millions
STRIP_ROWS = 256  # rows of a picture that are processed at a time
INTEGERS = "16 bits or more and no colour tag: its values are read as sRGB; with gamma = 1, as irradiance"
FLOATS = "floats and no colour tag: they are read as irradiance; with gamma = 2.2, as brightness on a screen"
MAX_BLACK = 8 / 255  # largest pixel value, from 0 to 1, that counts as black in a picture in black on transparency
MAX_GAMMA = 10.0  # largest gamma that is used if a file states it; the smallest is 1 / MAX_GAMMA
LINEAR, PQ, HLG = 8, 16, 18  # transfer characteristics of a cICP chunk (ITU-T H.273)
SWAPPED = {"B": "L", "L": "B", "N": "B" if sys.byteorder == "little" else "L"}  # opposite of each byte order of Pillow
DEVICE = re.compile(r"(?:con|prn|aux|nul|com\d|lpt\d)(?:\..*)?", re.IGNORECASE)  # names of devices on Windows
Sample = Literal["astronaut", "camera"]  # scikit-image's bundled pictures, public domain and CC0
SAMPLES: tuple[str, ...] = get_args(Sample)

# Transposition of a picture for each orientation of the camera, 2 to 8 (EXIF).
TURNS = "FLIP_LEFT_RIGHT ROTATE_180 FLIP_TOP_BOTTOM TRANSPOSE ROTATE_270 TRANSVERSE ROTATE_90"
UPRIGHT = {number: Image.Transpose[name] for number, name in enumerate(TURNS.split(), start=2)}

_DECODING = threading.RLock()  # guards the error stream and the filters of warnings, which all threads share

PixelBox: TypeAlias = tuple[int, int, int, int]  # left, top, right, bottom in whole pixels of a picture
Curve: TypeAlias = Callable[[np.ndarray], np.ndarray]  # function from pixel values to irradiance, both from 0 to 1
Conversion: TypeAlias = Callable[[Image.Image], Image.Image]  # conversion of a picture's colours to sRGB


@dataclass(frozen=True)
class Picture(FileContent):
    """The picture in a file: the unchanged content of the file, and a safe name for its copy."""

    name: str  # safe file name with the suffix of the format
    data: bytes = field(repr=False)  # content of the file

    def __post_init__(self) -> None:
        if self.name != (safe_name(self.name) or "."):
            raise ValueError(f"{self.name!r} is not a safe file name; use safe_name to make one")


def safe_name(text: str) -> str:
    """Return a text as a file name: up to 80 letters, digits, '.', '_' and '-', no '.' or '-' first; may be empty."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()  # é -> e
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", plain.replace("\\", "/").rpartition("/")[2]).lstrip(".-")[:80].rstrip(".")
    return f"_{name}"[:80] if DEVICE.fullmatch(name) else name


def read_picture(path: Path) -> Picture:
    """Read the picture file at `path`; SceneError if it is missing, too large or not a picture."""
    try:
        data = files.contents(path, MAX_PICTURE_SIZE)
    except ValueError as error:
        reason = f"cannot be read ({error})" if os.path.lexists(path) else "not found"
        raise SceneError(f"target.image: {str(path)!r} {reason}; give a path relative to the scene file") from None
    return Picture((safe_name(path.stem)[:70] or "picture") + kind_of(data, path.name), data)


def kind_of(data: bytes, name: str = "the picture", largest: int = MAX_PICTURE_PIXELS) -> str:
    """Return the file name suffix of a picture's format, such as ".png", from its header.

    SceneError if the file is not a picture, or has more than `largest` pixels.
    """
    with decoding(name):
        return FORMATS[str(_open_picture(name, data, largest).format)]


def from_array(values: np.ndarray) -> Picture:
    """Return an array of irradiance (rows, columns) on any scale, row 0 at the top, as a picture.

    The array is stored as a TIFF file of float32 with maximum 1.  SceneError if it is not an irradiance.
    """
    for fault in _array_faults(values):
        raise SceneError(f"target.image: {fault}")
    values, file = values.astype(np.float64), io.BytesIO()
    Image.fromarray((values / values.max()).astype(np.float32)).save(file, "TIFF", description=IRRADIANCE)
    return Picture("array.tif", file.getvalue())


def _array_faults(values: np.ndarray) -> Iterator[str]:
    if values.ndim != 2 or values.size == 0:
        yield f"an array of shape {values.shape} is not a picture; give irradiance of shape (rows, columns)"
    if values.size > MAX_PICTURE_PIXELS or max(values.shape) > MAX_PICTURE_SIDE:
        limit = f"more than {MAX_PICTURE_PIXELS // 10**6} million values, or more than {MAX_PICTURE_SIDE} along a side"
        yield f"an array of shape {values.shape} has {limit}; average neighbouring values"
    if values.dtype.kind not in "buif":
        yield f"an array of {values.dtype} is not a picture; give real numbers"
    if not np.isfinite(values).all():
        yield "the array has values that are not finite; set unknown values to 0"
    if values.min() < 0:
        yield "the array has negative values; give irradiance, with 0 for dark"
    if not values.max() > 0:
        yield "the array is zero everywhere; give an array with some light"


@contextlib.contextmanager
def decoding(given: Picture | str) -> Iterator[None]:
    """Raise each decoder's error in the block as SceneError on the picture `given` (or its name); silence warnings."""
    name = given if isinstance(given, str) else given.name
    try:
        with _DECODING, warnings.catch_warnings(), _silent():
            warnings.simplefilter("ignore")
            yield
    except SceneError:
        raise
    except Exception as error:  # each decoder has its own: OSError, SyntaxError, ValueError, struct.error, …
        reason = (str(error).splitlines() or ["unreadable"])[0].rstrip(".")
        raise SceneError(f"target.image: {name!r} is damaged ({reason}); save it again as PNG, JPEG or TIFF") from None


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Discard what is written in the block to the error stream of the process, where libtiff writes its messages."""
    try:
        saved, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    except OSError:  # the process has no error stream
        yield
        return
    try:
        if sys.stderr is not None:  # None under pythonw
            sys.stderr.flush()
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)


def _open_picture(name: str, data: bytes, largest: int = MAX_PICTURE_PIXELS) -> ImageFile.ImageFile:
    """Return the picture in `data` with its header read and its pixels not decoded yet; name: for messages."""
    sizes, kinds = [], f"not a {FORMAT_NAMES} picture; save it in one of these formats"
    try:
        if data[4:8] == b"ftyp":  # boxes of a HEIF file, which may show a part of the coded pixels
            if _is_avif(data):
                kinds = "an AVIF picture, which Pillow cannot decode on this machine; save it as PNG or JPEG"
                image = Image.open(io.BytesIO(data), formats=["AVIF"])
            else:
                from pillow_heif import HeifImageFile  # needed for HEIC only

                image = HeifImageFile(io.BytesIO(data))
            sizes = [struct.unpack(">II", size) for size in re.findall(rb"ispe\0{4}(.{8})", data, re.DOTALL)]
        else:
            image = Image.open(io.BytesIO(data), formats=PILLOW_FORMATS)
    except Image.DecompressionBombError:
        raise SceneError(
            f"target.image: {name!r} has more than {MAX_PICTURE_PIXELS // 10**6} million pixels; shrink it"
        ) from None
    except (OSError, SyntaxError, ValueError, KeyError):  # KeyError: Pillow without AVIF
        raise SceneError(f"target.image: {name!r} is {kinds}") from None
    for width, height in (image.size, *sizes):
        if width * height > largest or max(width, height) > MAX_PICTURE_SIDE:
            limit = f"more than {largest // 10**6} million, or more than {MAX_PICTURE_SIDE} along a side"
            raise SceneError(f"target.image: {name!r} has {width} x {height} pixels, {limit}; shrink it")
    if _tags(image).get(TILE_WIDTH, 1) * _tags(image).get(TILE_LENGTH, 1) > MAX_TILE:
        raise SceneError(f"target.image: {name!r} has tiles of more than {MAX_TILE} pixels; save it as PNG")
    return image


def _tags(image: Image.Image) -> Mapping[int, Any]:
    """Return the tags of a TIFF file by number; empty for other files."""
    return getattr(image, "tag_v2", {})


def _is_avif(data: bytes) -> bool:
    """Return True if a HEIF file has a brand of AVIF; its first box: size, "ftyp", brand, version, more brands."""
    end = min(struct.unpack(">I", data[:4])[0], 1024)
    return data[8:12] in AVIF or any(data[at : at + 4] in AVIF for at in range(16, end, 4))


# ---- from numbers to light -------------------------------------------------------------------------------------------


def from_srgb(value: np.ndarray) -> np.ndarray:
    """Return the irradiance of sRGB values, both from 0 to 1."""
    value = np.asarray(value, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0.0) + 0.055) / 1.055) ** 2.4)


def to_srgb(light: np.ndarray) -> np.ndarray:
    """Return the sRGB values with which a screen shows an irradiance, both from 0 to 1."""
    light = np.asarray(light, dtype=np.float64)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0) ** (1 / 2.4) - 0.055)


def power(gamma: float) -> Curve:
    """Return the curve (pixel value) ** gamma."""
    return lambda number: number if gamma == 1 else number**gamma


@dataclass(frozen=True)
class Photo:
    """A decoded picture, upright, with the curve from pixel values to irradiance."""

    name: str  # file name, or name of the sample
    image: Image.Image
    curve: Curve
    profile: Conversion | None = None  # conversion by the picture's ICC profile; None: no conversion
    low: Image.Image | None = None  # second bytes of 16-bit colours; Pillow keeps only the first bytes
    white: float = 1.0  # pixel value of white, for files with neither 8 nor 16 bits
    other_curve: Curve | None = None  # other possible curve of a file of 16 bits or more that states none; else None
    assumed: str = ""  # INTEGERS or FLOATS, which state the assumed curve; "": none is assumed
    several: bool = False  # True if the file has further pictures

    def part(self, box: PixelBox) -> Photo:
        """Return the part of the picture in a box."""
        return replace(self, image=self.image.crop(box), low=self.low and self.low.crop(box))

    def negative(self) -> Photo:
        """Return the negative of the picture."""
        other = self.other_curve and _negative_curve(self.other_curve)
        return replace(self, curve=_negative_curve(self.curve), other_curve=other)

    def light(self, box: PixelBox) -> np.ndarray:
        """Return the grey irradiance (h, w) in a box, from 0 to 1, with transparency as black."""
        numbers, alpha = self.numbers(box)
        if alpha is not None:
            numbers = _as_floats(numbers) * alpha[..., None]
        if numbers.dtype == np.float64:
            return self.curve(numbers).mean(-1)
        maximum = np.iinfo(numbers.dtype).max
        light_of, channels = self.curve(np.arange(maximum + 1.0) / maximum), np.moveaxis(numbers, -1, 0)
        return sum(light_of[channel] for channel in channels) / len(channels)  # .mean(-1) takes three times as long

    def silhouette(self, box: PixelBox) -> np.ndarray:
        """Return the irradiance (h, w) in a box, with the opacity as the pixel values of a grey picture."""
        _, alpha = self.numbers(box)
        assert alpha is not None  # `transparency` has found a logo
        return self.curve(alpha)

    def numbers(self, box: PixelBox) -> tuple[np.ndarray, np.ndarray | None]:
        """Return pixel values (h, w, channels), integers or floats up to 1, and opacity (h, w; or None) in a box."""
        image, low, alpha = self.image.crop(box), self.low and self.low.crop(box), None
        if image.mode.startswith(("I", "F")):
            return self._one_channel(image)
        if image.has_transparency_data:
            rgba = image.convert("RGBA")
            image, alpha = rgba.convert("RGB"), np.asarray(rgba.getchannel("A")) / 255.0
        if self.profile is not None:
            return np.asarray(self.profile(image)), alpha
        if low is not None:
            first, second = (np.asarray(part.convert("RGB")).astype(np.uint16) for part in (image, low))
            return first * np.uint16(256) + second, alpha
        if image.mode in ("1", "L"):
            return np.asarray(image.convert("L"))[..., None], alpha
        return np.asarray(image.convert("RGB")), alpha

    def _one_channel(self, image: Image.Image) -> tuple[np.ndarray, np.ndarray | None]:
        """Return `numbers` for one channel of 16 or 32 bits or floats; a PNG may state one transparent value."""
        values, clear = np.asarray(image), image.info.get("transparency")
        alpha = (values != clear).astype(np.float64) if isinstance(clear, int) else None
        if values.dtype.kind == "u" and values.dtype.itemsize == 2:
            return values.astype(np.uint16)[..., None], alpha
        values = values.astype(np.float64)
        if not (values.min() >= 0 and np.isfinite(values).all()):
            fault = "values that are negative or not finite"
            if image.mode == "I":  # 32 bits, which Pillow reads with a sign
                fault = "values that are negative, or above 2147483647 without a sign"
            raise SceneError(f"target.image: {self.name!r} has {fault}; save it with 8 or 16 bits")
        return values[..., None] / self.white, alpha

    def transparency(self) -> tuple[bool, str]:
        """Return (is_logo, remark): True for a picture in black on transparency; remark on transparent parts, or ""."""
        brightest = clear = opaque = 0.0
        for box in strips((0, 0, *self.image.size)):
            numbers, alpha = self.numbers(box)
            if alpha is None:
                return False, ""
            brightest = max(brightest, float((_as_floats(numbers).max(-1) * alpha).max()))
            clear, opaque = clear + float((1 - alpha).sum()), max(opaque, float(alpha.max()))
        if opaque == 0:
            raise SceneError("target.image: the picture is transparent everywhere; give one with opaque parts")
        if clear == 0:
            return False, ""
        if brightest <= MAX_BLACK:
            return True, "target.image: the picture is black on transparency, and its opaque parts are read as light"
        percent = 100 * clear / math.prod(self.image.size)
        return False, f"target.image: transparency is read as black ({percent:.3g} % of the picture)"


def strips(box: PixelBox) -> Iterator[PixelBox]:
    """Yield strips of STRIP_ROWS rows of a box, from the top; the last strip has the remaining rows."""
    left, top, right, bottom = box
    return ((left, start, right, min(start + STRIP_ROWS, bottom)) for start in range(top, bottom, STRIP_ROWS))


def _as_floats(numbers: np.ndarray) -> np.ndarray:
    return numbers if numbers.dtype == np.float64 else numbers / np.iinfo(numbers.dtype).max


def photo(given: Picture | str, gamma: float | None = None, invert: bool = False) -> Photo:
    """Return the decoded picture of a file, or one of SAMPLES.

    gamma: irradiance = (pixel value) ** gamma; None: as the file states, and for a sample 1, as in other programs.
    invert: return the negative.
    """
    if isinstance(given, str):
        from skimage import data  # loads much of scikit-image, needed for samples only

        curve = power(1.0 if gamma is None else gamma)
        return Photo(given, Image.fromarray(getattr(data, given)()), _negative_curve(curve) if invert else curve)
    file = _open_picture(given.name, given.data)
    deep = file.mode.startswith(("I", "F")) or any(";16" in str(tile[3]) for tile in file.tile)
    file.load()
    low = _second_bytes(file, given.data) if deep else None
    stated = (power(gamma), None) if gamma is not None else _meaning(file, given.data)
    curve, profile = stated or (power(1.0) if file.mode == "F" else from_srgb, None)  # floats are irradiance
    several = getattr(file, "is_animated", False)
    found = Photo(given.name, file, curve, profile, low=low, white=_white(file), several=several)
    if stated is None and deep and _tags(file).get(DESCRIPTION) != IRRADIANCE:
        other, assumed = (from_srgb, FLOATS) if file.mode == "F" else (power(1.0), INTEGERS)
        found = replace(found, other_curve=other, assumed=assumed)
    if (turn := UPRIGHT.get(file.getexif().get(ExifTags.Base.Orientation, 1))) is not None:
        found = replace(found, image=file.transpose(turn), low=low and low.transpose(turn))
    return found.negative() if invert else found


def photo_size(given: Picture | str) -> tuple[int, int]:
    """Return width and height (pixels) of a picture file or a sample, upright."""
    with decoding(given):
        return photo(given).image.size


def _white(image: Image.Image) -> float:
    """Return the pixel value of white: 1 for floats, 65535 for 32-bit integers, but at least the picture's largest."""
    if image.mode not in ("I", "F"):
        return 1.0
    usual, (_, largest) = 65535.0 if image.mode == "I" else 1.0, image.getextrema()
    assert not isinstance(largest, tuple)  # one channel
    return max(usual, float(largest)) if math.isfinite(largest) else usual


def _negative_curve(curve: Curve) -> Curve:
    """Return the curve of the negative: the sRGB tone t becomes 1 - t."""
    return lambda number: from_srgb(np.round(1.0 - to_srgb(np.clip(curve(number), 0.0, 1.0)), 12))  # exact 0 for 1


def _second_bytes(image: Image.Image, data: bytes) -> Image.Image | None:
    """Return a picture of the second bytes of colours of 16 bits, from its file `data`; None if it has no such colours.

    Pillow keeps the first byte.  With the opposite byte order in its decoder, it keeps the second byte.
    """
    if image.mode not in ("RGB", "RGBA"):
        return None
    other = Image.open(io.BytesIO(data), formats=["PNG", "TIFF"])
    for number, tile in enumerate(other.tile):
        layout, *more = tile.args if isinstance(tile.args, tuple) else (tile.args,)
        if not re.fullmatch(r"RGB[AX]?;16[BLN]", layout):
            return None
        swapped = layout[:-1] + SWAPPED[layout[-1]]
        other.tile[number] = tile._replace(args=(swapped, *more) if more else swapped)
    other.load()
    return other


def _meaning(image: Image.Image, data: bytes) -> tuple[Curve, Conversion | None] | None:
    """Return (curve, profile or None) as the file `data` of a picture states them; None if it states neither."""
    header = data.partition(b"IDAT")[0] if image.format == "PNG" else b""
    if transfer := re.search(rb"\x00\x00\x00\x04cICP.(.)", header, re.DOTALL):
        if transfer[1][0] in (PQ, HLG):
            raise SceneError("target.image: the file is an HDR picture (PQ or HLG); save it in sRGB, or set gamma")
        return (power(1.0) if transfer[1][0] == LINEAR else from_srgb), None
    profile = _profile(image)
    if profile is not None and image.mode.startswith(("I", "F")):
        return _grey_curve(profile), None
    if profile is not None or "srgb" in image.info:
        return from_srgb, profile
    encoded = image.info.get("gamma")
    if isinstance(encoded, float) and 1 / MAX_GAMMA <= encoded <= MAX_GAMMA:
        return power(1 / encoded), None
    return None


def _profile(image: Image.Image) -> Conversion | None:
    """Return the conversion of the picture's colours to sRGB by its ICC profile; None without a usable profile."""
    data = image.info.get("icc_profile")
    if not isinstance(data, bytes) or not 0 < len(data) <= MAX_PROFILE_SIZE:
        return None
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(data))
        mode = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}[profile.profile.xcolor_space.strip()]
        transform = ImageCms.buildTransform(profile, ImageCms.createProfile("sRGB"), mode, "RGB")
    except (ImageCms.PyCMSError, OSError, KeyError, ValueError, TypeError):
        return None
    if (mode == "CMYK") != (image.mode == "CMYK") or (mode == "L" and image.mode not in ("1", "L", "LA", "I;16", "F")):
        return None
    return lambda part: transform.apply(part if part.mode == mode else part.convert(mode))


def _grey_curve(profile: Conversion) -> Curve:
    """Return the curve of a grey profile: its values for 8-bit pixels, interpolated for finer pixel values."""
    ramp = Image.fromarray(np.arange(256, dtype=np.uint8)[None])
    seen = from_srgb(np.asarray(profile(ramp)) / 255.0).mean(-1)[0]
    return lambda number: np.interp(number, np.arange(256) / 255.0, seen)


# ---- letters ---------------------------------------------------------------------------------------------------------


CHECKED_SIZE = 100.0  # size (pixels) at which missing letters are recognised; letters of 4,000 pixels take 0.1 s


def letters(text: str, width: int, height: int) -> Image.Image:
    """Draw a text centred in a picture of this size (pixels), filling 84 % of the width or 80 % of the height."""
    at_100 = _ink(text, 100.0)
    scale = min(0.84 * width / at_100.width, 0.80 * height / at_100.height)
    ink = _ink(text, max(100.0 * scale, 1.0))
    image = Image.new("L", (width, height))
    image.paste(ink, ((width - ink.width) // 2, (height - ink.height) // 2))
    return image


def _ink(text: str, size: float) -> Image.Image:
    """Draw a text of this font size (pixels), cropped to its ink (the box of a font has empty margins)."""
    font = _font(size, text)
    left, top, right, bottom = ImageDraw.Draw(Image.new("L", (1, 1))).textbbox((0, 0), text, font=font, align="center")
    image = Image.new("L", (int(right - left) + 8, int(bottom - top) + 8))
    ImageDraw.Draw(image).text((4 - left, 4 - top), text, fill=255, font=font, align="center")
    if image.getbbox() is None:
        raise SceneError("target.text: the text has no visible characters; give another text")
    return image.crop(image.getbbox())


def _font(size: float, text: str) -> ImageFont.FreeTypeFont:
    """Return DejaVu Sans Bold of a size (pixels) from matplotlib's files; SceneError if it lacks a letter of `text`."""
    spec = importlib.util.find_spec("matplotlib")
    assert spec is not None and spec.submodule_search_locations  # bstcad requires this package
    path = f"{spec.submodule_search_locations[0]}/mpl-data/fonts/ttf/DejaVuSans-Bold.ttf"
    small = ImageFont.truetype(path, CHECKED_SIZE)
    absent = bytes(small.getmask("\uffff"))  # box that a font draws for a letter that it does not have
    for letter in sorted(set(text) - {"\n"}):
        if not letter.splitlines()[0] or bytes(small.getmask(letter)) == absent:  # includes other line breaks than \n
            raise SceneError(f"target.text: the font has no letter {letter!r}; give the text as an image instead")
    return ImageFont.truetype(path, size)
