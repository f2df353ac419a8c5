"""Pictures: from a file, a sample or letters to what falls into each pixel of the target.

Files are read within bounds, whatever they hold; what their numbers mean is in tones, how they lie in framing.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import re
import struct
import sys
import unicodedata
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageDraw, ImageFont

from bstcad.runs import files
from bstcad.scene.errors import SceneError
from bstcad.scene.framing import EXIF, Box, Frame, Turn, Window, average, strips
from bstcad.scene.tones import Meaning, Tones, light, meaning_of, numbers

FORMATS = {  # what is read, and the ending its copy gets
    "PNG": ".png", "JPEG": ".jpg", "MPO": ".jpg", "TIFF": ".tif", "WEBP": ".webp", "BMP": ".bmp", "HEIF": ".heic",
}  # fmt: skip
OPENED = ("PNG", "JPEG", "TIFF", "WEBP", "BMP")  # by Pillow itself; an MPO is a JPEG with others behind it
KINDS = "PNG, JPEG, TIFF, WebP, BMP or HEIC"
LARGEST = 64_000_000  # pixels of a picture
LONGEST = 65_535  # pixels along a side: as far as JPEG goes
TILE_WIDTH, TILE_LENGTH = 322, 323  # tags of a TIFF file, which is decoded by whole tiles
LARGEST_TILE = 4096**2  # pixels; what programs write has 1024 a side
LARGEST_FILE = 400_000_000  # bytes: 64 million pixels of three 16-bit channels
BLACK = 8 / 255  # of all that is opaque: a logo for a white ground, of which the transparency is the picture
SWAPPED = {"B": "L", "L": "B", "N": "B" if sys.byteorder == "little" else "L"}  # orders of the bytes of a number
DEVICE = re.compile(r"(?:con|prn|aux|nul|com\d|lpt\d)(?:\..*)?", re.IGNORECASE)  # what Windows takes for none of a file
SAMPLES = ("astronaut", "camera")  # scikit-image's bundled pictures, public domain and CC0


@dataclass(frozen=True)
class Picture:
    """A picture file as it is: the scene keeps it whole, so a design can be repeated from its own folder."""

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
    with _decoding(path.name), _opened(path.name, data) as image:
        return Picture((safe_name(path.stem)[:70] or "picture") + FORMATS[image.format], data)


def from_array(values: np.ndarray) -> Picture:
    """A picture of linear irradiance, on any scale: (rows, columns), row 0 at the top; SceneError if it is none.

    Kept as a TIFF file of float32, brightest value 1, so that it travels with its design.
    """
    if values.ndim != 2 or values.size == 0:
        raise SceneError(
            f"target.image: an array of shape {values.shape} is no picture; give one of shape (rows, columns), "
            "its values the irradiance wanted (of a colour picture for example the mean over its channels)"
        )
    if values.size > LARGEST or max(values.shape) > LONGEST:
        raise SceneError(
            f"target.image: an array of shape {values.shape} has more than {LARGEST // 10**6} million values or than "
            f"{LONGEST} along a side; average neighbours"
        )
    if values.dtype.kind not in "buif":
        raise SceneError(f"target.image: an array of {values.dtype} is no picture; give real numbers")
    values = values.astype(np.float64)
    if not np.isfinite(values).all():
        raise SceneError("target.image: the array has values that are not finite; put 0 where nothing is known")
    if values.min() < 0:
        raise SceneError("target.image: the array has negative values; give irradiance, 0 where it is dark")
    if not values.max() > 0:
        raise SceneError("target.image: the array is all zero; give one with some light in it")
    file = io.BytesIO()
    Image.fromarray((values / values.max()).astype(np.float32)).save(file, "TIFF")
    return Picture("array.tif", file.getvalue())


@dataclass(frozen=True)
class Drawing:
    """A picture as light."""

    light: np.ndarray  # (rows, columns), on any scale, as a person sees it: row 0 the top, column 0 the left
    remarks: tuple[str, ...] = ()  # a sentence on each thing done to it that the scene does not ask for


def photograph(picture: Picture, frame: Frame, tones: Tones) -> Drawing:
    """Mean grey light of the picture over each pixel of the frame, in the tones that the file means."""
    with _decoding(picture.name), _opened(picture.name, picture.data) as image:
        deep = image.mode.startswith(("I", "F")) or any(";16" in str(tile[3]) for tile in image.tile)
        image.load()
        photo = _Photo(picture.name, image, _second_bytes(image, picture.data) if deep else None)
        turn = EXIF.get(image.getexif().get(ExifTags.Base.Orientation), Turn())
        return _drawn(photo, meaning_of(image, picture.data, deep, tones), frame, turn.then(frame.turn))


def sample(name: str, frame: Frame, tones: Tones) -> Drawing:
    """One of scikit-image's bundled pictures, like a photograph; but its numbers are irradiance unless gamma is given.

    They are for comparison with the paper and with other programs, which take them so.
    """
    from skimage import data  # loads a good part of scikit-image: only where a sample is asked for

    image = Image.fromarray(getattr(data, name)())
    meaning = meaning_of(image, b"", False, replace(tones, gamma=1.0 if tones.gamma is None else tones.gamma))
    return _drawn(_Photo(name, image), meaning, frame, frame.turn)


@dataclass(frozen=True)
class _Photo:
    """A decoded picture."""

    name: str
    image: Image.Image
    low: Image.Image | None = None  # the second bytes of its colours, if those have 16 bits

    def numbers(self, box: Box, meaning: Meaning) -> tuple[np.ndarray, np.ndarray | None]:
        """Of a part of it: numbers and opacity."""
        found, alpha = numbers(self.image.crop(box), self.low and self.low.crop(box), meaning)
        if found.dtype == np.float64 and not found.min() >= 0:
            raise self.no_light()
        return found, alpha

    def no_light(self) -> SceneError:
        """What is said of numbers that no light has."""
        return SceneError(
            f"target.image: {self.name!r} has values that are negative or not finite; save it in 8 or 16 bits"
        )


def _drawn(photo: _Photo, meaning: Meaning, frame: Frame, turn: Turn) -> Drawing:
    """The light of a picture that `turn` puts upright and then turns as the scene asks."""
    size = photo.image.size
    lying = frame.lying() if turn.lays_down else frame
    ghost, transparent = _transparency(photo, meaning)

    def of(box: Box) -> np.ndarray:
        found, alpha = photo.numbers(box, meaning)
        return light(np.ones(found.shape) if ghost else found, alpha, meaning.curve)

    grey = average(of, size, lying.window(*size), lying)
    if not np.isfinite(grey).all():
        raise photo.no_light()
    framed = frame.remark(*(reversed(size) if turn.lays_down else size))
    return Drawing(turn.of(grey), tuple(filter(None, (transparent, framed))))


def _transparency(photo: _Photo, meaning: Meaning) -> tuple[bool, str]:
    """Is all that a picture shows in its transparency, and what is to be said of that, or of its transparent parts?"""
    width, height = photo.image.size
    most, clear, opaque = 0.0, 0.0, 0.0
    for box in strips(0, 0, width, height):
        found, alpha = photo.numbers(box, meaning)
        if alpha is None:
            return False, ""
        scale = 1.0 if found.dtype == np.float64 else np.iinfo(found.dtype).max
        most = max(most, float((found.max(-1) / scale * alpha).max()))
        clear, opaque = clear + float((1 - alpha).sum()), max(opaque, float(alpha.max()))
    share = clear / (width * height)
    if opaque == 0:
        raise SceneError("target.image: the picture is transparent everywhere; give one with something opaque in it")
    if share == 0:
        return False, ""
    if most <= BLACK:
        return True, "target.image: all that is opaque is black, on transparency: what is opaque is taken as light"
    return False, f"target.image: transparency is taken as black ({100 * share:.3g} % of the picture)"


@contextlib.contextmanager
def _decoding(name: str) -> Iterator[None]:
    """Whatever a damaged file does to the decoders is one sentence, and they say nothing themselves."""
    try:
        with warnings.catch_warnings(), _silent():
            warnings.simplefilter("ignore")
            yield
    except SceneError:
        raise
    except Exception as error:  # OSError, SyntaxError, ValueError, struct.error, … as each decoder likes
        raise SceneError(
            f"target.image: {name!r} is damaged ({_first_line(error)}); save it again as PNG, JPEG or TIFF"
        ) from None


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """libtiff writes what it dislikes to the process's error stream, past Python's."""
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
    try:
        image = _heic(data) if data[4:8] == b"ftyp" else Image.open(io.BytesIO(data), formats=OPENED)
    except Image.DecompressionBombError:
        raise SceneError(f"target.image: {name!r} has over {LARGEST // 10**6} million pixels; shrink it") from None
    except (OSError, SyntaxError, ValueError):
        raise SceneError(f"target.image: {name!r} is no {KINDS} picture; save it as one of these") from None
    for width, height in (image.size, *(_coded(data) if image.format == "HEIF" else ())):
        if width * height > LARGEST or max(width, height) > LONGEST:
            raise SceneError(
                f"target.image: {name!r} has {width} x {height} pixels, more than {LARGEST // 10**6} million "
                f"or than {LONGEST} along a side; shrink it"
            )
    if image.format == "TIFF" and (TILE_WIDTH in image.tag_v2 or TILE_LENGTH in image.tag_v2):
        width, height = image.tag_v2.get(TILE_WIDTH, image.width), image.tag_v2.get(TILE_LENGTH, image.height)
        if width * height > LARGEST_TILE:
            raise SceneError(f"target.image: {name!r} has tiles larger than any picture; save it again, or as PNG")
    return image


def _heic(data: bytes) -> Image.Image:
    """A telephone's HEIC picture, of which the header is read."""
    from pillow_heif import HeifImageFile  # only where there is one

    return HeifImageFile(io.BytesIO(data))


def _coded(data: bytes) -> Iterator[tuple[int, int]]:
    """The sizes (boxes ispe) of a HEIC file's pictures and tiles as they are coded, of which it may show a part."""
    return (struct.unpack(">II", found[1]) for found in re.finditer(rb"ispe\0{4}(.{8})", data, re.DOTALL))


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


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or ["unreadable"])[0].rstrip(".")


def letters(text: str, frame: Frame) -> np.ndarray:
    """(rows, columns) share of ink, centred, 84 % of the frame's width or 80 % of its height."""
    frame, turn = frame.lying() if frame.turn.lays_down else frame, frame.turn
    aspect = frame.width / frame.height
    side = min(4 * max(frame.columns, frame.rows), 4096)  # drawn finer, then averaged: smooth rims
    width = max(round(side * min(aspect, 1.0)), 16)
    height = max(round(side * min(1 / aspect, 1.0)), 16)
    at_100 = _ink(text, 100.0)
    scale = min(0.84 * width / at_100.width, 0.80 * height / at_100.height)
    ink = _ink(text, max(100.0 * scale, 1.0))
    image = Image.new("L", (width, height))
    image.paste(ink, ((width - ink.width) // 2, (height - ink.height) // 2))
    whole = Window(0.0, 0.0, width, height)
    return turn.of(average(lambda box: np.asarray(image.crop(box)) / 255.0, image.size, whole, frame))


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
    font = ImageFont.truetype(str(Path(package, "mpl-data", "fonts", "ttf", "DejaVuSans-Bold.ttf")), size)
    absent = bytes(font.getmask("\uffff"))  # the box that stands for letters a font does not have
    for letter in sorted(set(text) - {"\n"}):
        if not letter.splitlines()[0] or bytes(font.getmask(letter)) == absent:  # a break of lines, other than ours
            raise SceneError(f"target.text: the font has no letter {letter!r}; give the text as an image instead")
    return font
