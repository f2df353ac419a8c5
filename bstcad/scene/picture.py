"""Pictures: from a file, an array, a sample or letters to grey light.

A photograph's numbers are sRGB (IEC 61966-2-1): E = c / 12.92 up to c = 0.04045 and ((c + 0.055) / 1.055)^2.4 above it,
for a channel c and the irradiance E, both from 0 to 1; of 16 bits as of 8.  Floats are irradiance itself.  Before
either goes the file's own statement: cICP, an ICC profile, sRGB or gAMA, in this order, as PNG has it.  Grey is the
mean of the channels' light.  Of a file of several pictures the first is read.
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
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageCms, ImageDraw, ImageFont

from bstcad.runs import files
from bstcad.scene.errors import SceneError
from bstcad.scene.schema import FileContent

FORMATS = {  # that are read, and the ending of a copy
    "PNG": ".png", "JPEG": ".jpg", "MPO": ".jpg", "TIFF": ".tif", "WEBP": ".webp", "BMP": ".bmp", "GIF": ".gif",
    "HEIF": ".heic", "AVIF": ".avif",
}  # fmt: skip
OPENED = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "GIF")  # formats read by Pillow; an MPO is a JPEG with others behind
KINDS = "PNG, JPEG, TIFF, WebP, BMP, GIF, HEIC or AVIF"
AVIF = (b"avif", b"avis")  # brands of a HEIF file whose pixels are coded as AV1: one picture, a sequence
DESCRIPTION = 270  # tag of a TIFF file
IRRADIANCE = "irradiance"  # the description of an array's file: its floats are meant to be light
LARGEST = 64_000_000  # pixels of a picture
LONGEST = 65_535  # pixels along a side: as far as JPEG goes
TILE_WIDTH, TILE_LENGTH = 322, 323  # tags of a TIFF file, which is decoded by whole tiles
LARGEST_TILE = 4096**2  # pixels; programs write tiles of up to 1024 a side
LARGEST_FILE = 400_000_000  # bytes: 64 million pixels of three 16-bit channels
LARGEST_PROFILE = 10_000_000  # bytes; printers' profiles have a few millions
STRIP = 256  # rows of a picture in work at a time
WHOLE = "16 bits or more and no colour tag: its numbers are taken as sRGB; gamma = 1 takes them as light"
FLOATS = "floats and no colour tag: they are taken as light; gamma = 2.2 takes them as a screen does"
BLACK = 8 / 255  # of all that is opaque: a logo for a white ground, of which the transparency is the picture
STEEPEST_GAMMA = 10.0  # an exponent beyond it, or below its inverse, is a mistake in the file
LINEAR, PQ, HLG = 8, 16, 18  # transfer characteristics of a cICP chunk (ITU-T H.273)
SWAPPED = {"B": "L", "L": "B", "N": "B" if sys.byteorder == "little" else "L"}  # orders of the bytes of a number
DEVICE = re.compile(r"(?:con|prn|aux|nul|com\d|lpt\d)(?:\..*)?", re.IGNORECASE)  # no names of files on Windows
SAMPLES = ("astronaut", "camera")  # scikit-image's bundled pictures, public domain and CC0

UPRIGHT = {  # by a camera's orientation
    2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_270, 7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}  # fmt: skip

_DECODING = threading.RLock()  # the error stream and the filters of warnings are the process's

Box = tuple[int, int, int, int]  # whole pixels of a picture: left, top, right, bottom
Curve = Callable[[np.ndarray], np.ndarray]  # from numbers to irradiance, both from 0 to 1


@dataclass(frozen=True)
class Picture(FileContent):
    """A picture file as it is."""

    name: str  # safe basename, ending as the format wants it
    data: bytes = field(repr=False)

    def __post_init__(self) -> None:
        if self.name != (safe_name(self.name) or "."):
            raise ValueError(f"{self.name!r} is no plain file name; give a Picture the one that safe_name makes of it")


def safe_name(text: str) -> str:
    """A file name of letters, digits, '.', '_' and '-' that does not start with '.'; may come out empty."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()  # é -> e
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", plain.replace("\\", "/").rpartition("/")[2]).lstrip(".-")[:80].rstrip(".")
    return f"_{name}"[:80] if DEVICE.fullmatch(name) else name


def read_picture(path: Path) -> Picture:
    """The picture file at `path`; SceneError if it is missing, huge or no picture."""
    try:
        data = files.contents(path, LARGEST_FILE)
    except ValueError as error:
        reason = f"cannot be read ({error})" if os.path.lexists(path) else "not found"
        raise SceneError(f"target.image: {str(path)!r} {reason}; give a path relative to the scene file") from None
    with decoding(path.name):
        return Picture((safe_name(path.stem)[:70] or "picture") + FORMATS[_opened(path.name, data).format], data)


def kind_of(data: bytes) -> str:
    """How the name of a picture file ends, by its content: ".png"; SceneError if it is no picture, or a huge one."""
    with decoding("the picture"):
        return FORMATS[_opened("the picture", data).format]


def from_array(values: np.ndarray) -> Picture:
    """A picture of linear irradiance, on any scale: (rows, columns), row 0 at the top; SceneError if it is none.

    Kept as a TIFF file of float32, brightest value 1, so that it travels with its design.
    """
    for fault in _faults(values):
        raise SceneError(f"target.image: {fault}")
    values, file = values.astype(np.float64), io.BytesIO()
    Image.fromarray((values / values.max()).astype(np.float32)).save(file, "TIFF", description=IRRADIANCE)
    return Picture("array.tif", file.getvalue())


def _faults(values: np.ndarray) -> Iterator[str]:
    """Sentences on an array that is no irradiance."""
    if values.ndim != 2 or values.size == 0:
        yield f"an array of shape {values.shape} is no picture; give one of shape (rows, columns), of irradiance"
    if values.size > LARGEST or max(values.shape) > LONGEST:
        most = f"more than {LARGEST // 10**6} million values or than {LONGEST} along a side"
        yield f"an array of shape {values.shape} has {most}; average neighbours"
    if values.dtype.kind not in "buif":
        yield f"an array of {values.dtype} is no picture; give real numbers"
    if not np.isfinite(values).all():
        yield "the array has values that are not finite; put 0 where nothing is known"
    if values.min() < 0:
        yield "the array has negative values; give irradiance, 0 where it is dark"
    if not values.max() > 0:
        yield "the array is all zero; give one with some light in it"


@contextlib.contextmanager
def decoding(name: str) -> Iterator[None]:
    """All errors of the decoders become one sentence, and their warnings are silenced."""
    try:
        with _DECODING, warnings.catch_warnings(), _silent():
            warnings.simplefilter("ignore")
            yield
    except SceneError:
        raise
    except Exception as error:  # OSError, SyntaxError, ValueError, struct.error, … as each decoder likes
        reason = (str(error).splitlines() or ["unreadable"])[0].rstrip(".")
        raise SceneError(f"target.image: {name!r} is damaged ({reason}); save it again as PNG, JPEG or TIFF") from None


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Close the process's error stream, to which libtiff writes its complaints, past Python's."""
    try:
        kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    except OSError:  # there is no such stream
        yield
        return
    try:
        if sys.stderr is not None:  # as under pythonw
            sys.stderr.flush()
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _opened(name: str, data: bytes) -> Image.Image:
    """The picture's header; its pixels are not decoded yet."""
    sizes, kinds = [], f"no {KINDS} picture; save it as one of these"
    try:
        if data[4:8] == b"ftyp":  # boxes, as of a telephone's HEIC picture, which may show a part of the coded pixels
            if _is_avif(data):
                kinds = "an AVIF picture that cannot be decoded here; save it as PNG or JPEG"
                image = Image.open(io.BytesIO(data), formats=["AVIF"])
            else:
                from pillow_heif import HeifImageFile  # only where there is one

                image = HeifImageFile(io.BytesIO(data))
            sizes = [struct.unpack(">II", size) for size in re.findall(rb"ispe\0{4}(.{8})", data, re.DOTALL)]
        else:
            image = Image.open(io.BytesIO(data), formats=OPENED)
    except Image.DecompressionBombError:
        raise SceneError(f"target.image: {name!r} has over {LARGEST // 10**6} million pixels; shrink it") from None
    except (OSError, SyntaxError, ValueError, KeyError):  # KeyError: a Pillow that knows no AVIF
        raise SceneError(f"target.image: {name!r} is {kinds}") from None
    for width, height in (image.size, *sizes):
        if width * height > LARGEST or max(width, height) > LONGEST:
            most = f"more than {LARGEST // 10**6} million or than {LONGEST} along a side"
            raise SceneError(f"target.image: {name!r} has {width} x {height} pixels, {most}; shrink it")
    if image.format == "TIFF" and image.tag_v2.get(TILE_WIDTH, 1) * image.tag_v2.get(TILE_LENGTH, 1) > LARGEST_TILE:
        raise SceneError(f"target.image: {name!r} has tiles larger than any picture; save it again, or as PNG")
    return image


def _is_avif(data: bytes) -> bool:
    """Do the brands of a HEIF file say AVIF?  They stand in its first box: size, "ftyp", major brand, version, more."""
    end = min(struct.unpack(">I", data[:4])[0], 1024)
    return data[8:12] in AVIF or any(data[at : at + 4] in AVIF for at in range(16, end, 4))


# ---- from numbers to light -------------------------------------------------------------------------------------------


def from_srgb(value: np.ndarray) -> np.ndarray:
    """Irradiance of sRGB numbers from 0 to 1."""
    value = np.asarray(value, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0.0) + 0.055) / 1.055) ** 2.4)


def to_srgb(light: np.ndarray) -> np.ndarray:
    """sRGB numbers of irradiance from 0 to 1, with which a screen shows it."""
    light = np.asarray(light, dtype=np.float64)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0) ** (1 / 2.4) - 0.055)


def power(gamma: float) -> Curve:
    """number ** gamma."""
    return lambda number: number if gamma == 1 else number**gamma


@dataclass(frozen=True)
class Photo:
    """A decoded picture, upright, and how its numbers become light."""

    name: str
    image: Image.Image
    curve: Curve
    profile: Callable[[Image.Image], Image.Image] | None = None  # from the picture's colours to sRGB
    low: Image.Image | None = None  # the second bytes of colours of 16 bits, of which Pillow keeps the first
    white: float = 1.0  # of numbers that have neither 8 nor 16 bits
    other_curve: Curve | None = None  # another curve that an untagged file of uncommon depth may follow
    assumed: str = ""  # a sentence on the curve that was taken in its place
    several: bool = False  # does the file hold further pictures?

    def part(self, box: Box) -> Photo:
        """Return a part of the picture as a picture."""
        return replace(self, image=self.image.crop(box), low=self.low and self.low.crop(box))

    def light(self, box: Box) -> np.ndarray:
        """Grey irradiance (h, w) of a part, from 0 to 1; transparent parts stand before black."""
        numbers, alpha = self.numbers(box)
        if alpha is not None:
            numbers = _as_floats(numbers) * alpha[..., None]
        if numbers.dtype == np.float64:
            return self.curve(numbers).mean(-1)
        most = np.iinfo(numbers.dtype).max
        light_of, channels = self.curve(np.arange(most + 1.0) / most), np.moveaxis(numbers, -1, 0)
        return sum(light_of[channel] for channel in channels) / len(channels)  # .mean(-1) takes three times as long

    def silhouette(self, box: Box) -> np.ndarray:
        """The light of a part if all that is opaque were white."""
        return self.curve(self.numbers(box)[1])

    def numbers(self, box: Box) -> tuple[np.ndarray, np.ndarray | None]:
        """(h, w, channels) integers of their type's range, or floats from 0 to 1; (h, w) opacity from 0 to 1."""
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
        """Of 16 or 32 bits, or floats; a PNG may name one number that is transparent."""
        values, clear = np.asarray(image), image.info.get("transparency")
        alpha = (values != clear).astype(np.float64) if isinstance(clear, int) else None
        if values.dtype.kind == "u" and values.dtype.itemsize == 2:
            return values.astype(np.uint16)[..., None], alpha
        values = values.astype(np.float64)
        if not (values.min() >= 0 and np.isfinite(values).all()):
            fault = "values that are negative or not finite"
            raise SceneError(f"target.image: {self.name!r} has {fault}; save it in 8 or 16 bits")
        return values[..., None] / self.white, alpha

    def transparency(self) -> tuple[bool, str]:
        """Is all of the picture in its transparency, as a black logo's is?  And a remark on transparent parts."""
        brightest = clear = opaque = 0.0
        for box in strips((0, 0, *self.image.size)):
            numbers, alpha = self.numbers(box)
            if alpha is None:
                return False, ""
            brightest = max(brightest, float((_as_floats(numbers).max(-1) * alpha).max()))
            clear, opaque = clear + float((1 - alpha).sum()), max(opaque, float(alpha.max()))
        if opaque == 0:
            raise SceneError("target.image: the picture is transparent everywhere; give one with something opaque")
        if clear == 0:
            return False, ""
        if brightest <= BLACK:
            return True, "target.image: all that is opaque is black, on transparency: what is opaque is taken as light"
        share = 100 * clear / math.prod(self.image.size)
        return False, f"target.image: transparency is taken as black ({share:.3g} % of the picture)"


def strips(box: Box) -> Iterator[Box]:
    """A box in parts of a few rows each, from the top."""
    left, top, right, bottom = box
    return ((left, start, right, min(start + STRIP, bottom)) for start in range(top, bottom, STRIP))


def _as_floats(numbers: np.ndarray) -> np.ndarray:
    return numbers if numbers.dtype == np.float64 else numbers / np.iinfo(numbers.dtype).max


def photo(given: Picture | str, gamma: float | None = None, invert: bool = False) -> Photo:
    """A decoded picture file, or one of SAMPLES; irradiance = number ** gamma; invert: dark for light, as seen.

    Without gamma a file's numbers mean what the file says; those of a sample are irradiance, for comparison with the
    paper and with other programs, which take them so.
    """
    if isinstance(given, str):
        from skimage import data  # loads a good part of scikit-image: only where a sample is asked for

        curve = power(1.0 if gamma is None else gamma)
        return Photo(given, Image.fromarray(getattr(data, given)()), _inverted(curve) if invert else curve)
    image = _opened(given.name, given.data)
    deep = image.mode.startswith(("I", "F")) or any(";16" in str(tile[3]) for tile in image.tile)
    image.load()
    low, white = _second_bytes(image, given.data) if deep else None, _white(image)
    turned = UPRIGHT.get(image.getexif().get(ExifTags.Base.Orientation))
    stated = (power(gamma), None) if gamma is not None else _meaning(image, given.data)
    curve, profile = stated or (power(1.0) if image.mode == "F" else from_srgb, None)  # floats are light
    other, assumed, several = None, "", bool(getattr(image, "is_animated", False))
    if stated is None and deep and getattr(image, "tag_v2", {}).get(DESCRIPTION) != IRRADIANCE:
        other = from_srgb if image.mode == "F" else power(1.0)
        assumed = FLOATS if image.mode == "F" else WHOLE
    if turned is not None:
        image, low = image.transpose(turned), low and low.transpose(turned)
    curve, other = (_inverted(each) if invert and each else each for each in (curve, other))
    return Photo(
        given.name, image, curve, profile=profile, low=low, white=white, other_curve=other, assumed=assumed,
        several=several,
    )  # fmt: skip


def photo_size(given: Picture | str) -> tuple[int, int]:
    """Return width and height (pixels) of a picture file or a sample, upright."""
    with decoding(getattr(given, "name", given)):
        return photo(given).image.size


def _white(image: Image.Image) -> float:
    """The number of white: of floats 1, of 32 bits 65535, or the largest number where that is more."""
    if image.mode not in ("I", "F"):
        return 1.0
    usual, most = 65535.0 if image.mode == "I" else 1.0, float(image.getextrema()[1])
    return max(usual, most) if math.isfinite(most) else usual


def _inverted(curve: Curve) -> Curve:
    """The light of the negative: the tone t becomes 1 - t, and tones are sRGB in every file."""
    return lambda number: from_srgb(np.round(1.0 - to_srgb(np.clip(curve(number), 0.0, 1.0)), 12))  # 1 ends at 0


def _second_bytes(image: Image.Image, data: bytes) -> Image.Image | None:
    """The second bytes of colours of 16 bits, as a picture; None where those have no colours.

    Pillow keeps the first ones; told that the bytes of the file are in the other order, it keeps the second.
    """
    if image.mode not in ("RGB", "RGBA"):
        return None
    other = Image.open(io.BytesIO(data), formats=["PNG", "TIFF"])
    for place, tile in enumerate(other.tile):
        layout, *more = tile.args if isinstance(tile.args, tuple) else (tile.args,)
        if not re.fullmatch(r"RGB[AX]?;16[BLN]", layout):
            return None
        swapped = layout[:-1] + SWAPPED[layout[-1]]
        other.tile[place] = tile._replace(args=(swapped, *more) if more else swapped)
    other.load()
    return other


def _meaning(image: Image.Image, data: bytes) -> tuple[Curve, Callable | None] | None:
    """The curve and the colour profile that the file states; None: it states none."""
    transfer = (
        re.search(rb"\x00\x00\x00\x04cICP.(.)", data.partition(b"IDAT")[0], re.DOTALL)
        if image.format == "PNG"
        else None
    )
    if transfer is not None:
        if transfer[1][0] in (PQ, HLG):
            raise SceneError("target.image: it is an HDR picture (PQ or HLG); save it in sRGB, or give target.gamma")
        return (power(1.0) if transfer[1][0] == LINEAR else from_srgb), None
    profile = _profile(image)
    if profile is not None and image.mode.startswith(("I", "F")):
        return _grey_curve(profile), None
    if profile is not None or "srgb" in image.info:
        return from_srgb, profile
    encoded = image.info.get("gamma")
    if isinstance(encoded, float) and 1 / STEEPEST_GAMMA <= encoded <= STEEPEST_GAMMA:
        return power(1 / encoded), None
    return None


def _profile(image: Image.Image) -> Callable[[Image.Image], Image.Image] | None:
    """From the picture's colours to sRGB by its ICC profile; None without a usable profile."""
    data = image.info.get("icc_profile")
    if not isinstance(data, bytes) or not 0 < len(data) <= LARGEST_PROFILE:
        return None
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(data))
        mode = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}[profile.profile.xcolor_space.strip()]
        transform = ImageCms.buildTransform(profile, ImageCms.createProfile("sRGB"), mode, "RGB")
    except (ImageCms.PyCMSError, OSError, KeyError, ValueError, TypeError):
        return None
    if (mode == "CMYK") != (image.mode == "CMYK") or (mode == "L" and image.mode not in ("1", "L", "LA", "I;16", "F")):
        return None
    return lambda part: ImageCms.applyTransform(part if part.mode == mode else part.convert(mode), transform)


def _grey_curve(profile: Callable[[Image.Image], Image.Image]) -> Curve:
    """The grey irradiance by a profile, for numbers finer than its own 8 bits."""
    ramp = Image.fromarray(np.arange(256, dtype=np.uint8)[None])
    seen = from_srgb(np.asarray(profile(ramp)) / 255.0).mean(-1)[0]
    return lambda number: np.interp(number, np.arange(256) / 255.0, seen)


# ---- letters ---------------------------------------------------------------------------------------------------------


def letters(text: str, width: int, height: int) -> Image.Image:
    """A text in a picture of that size (mode L), centred, over 84 % of the width or 80 % of the height."""
    at_100 = _ink(text, 100.0)
    scale = min(0.84 * width / at_100.width, 0.80 * height / at_100.height)
    ink = _ink(text, max(100.0 * scale, 1.0))
    image = Image.new("L", (width, height))
    image.paste(ink, ((width - ink.width) // 2, (height - ink.height) // 2))
    return image


def _ink(text: str, size: float) -> Image.Image:
    """The letters alone, cut where their ink ends (a font's own box has empty margins)."""
    font = _font(size, text)
    left, top, right, bottom = ImageDraw.Draw(Image.new("L", (1, 1))).textbbox((0, 0), text, font=font, align="center")
    image = Image.new("L", (int(right - left) + 8, int(bottom - top) + 8))
    ImageDraw.Draw(image).text((4 - left, 4 - top), text, fill=255, font=font, align="center")
    if image.getbbox() is None:
        raise SceneError("target.text: its letters leave no ink; give others")
    return image.crop(image.getbbox())


def _font(size: float, text: str) -> ImageFont.FreeTypeFont:
    """DejaVu Sans Bold, found among matplotlib's files without importing matplotlib."""
    [package] = importlib.util.find_spec("matplotlib").submodule_search_locations
    font = ImageFont.truetype(f"{package}/mpl-data/fonts/ttf/DejaVuSans-Bold.ttf", size)
    absent = bytes(font.getmask("\uffff"))  # the box that stands for letters a font does not have
    for letter in sorted(set(text) - {"\n"}):
        if not letter.splitlines()[0] or bytes(font.getmask(letter)) == absent:  # a break of lines, other than ours
            raise SceneError(f"target.text: the font has no letter {letter!r}; give the text as an image instead")
    return font
