"""Pictures: from a file, a sample or a text to what falls into each pixel of the target.

Everywhere: row 0 is y max, column 0 is x min, and a picture fills the rectangle it is given.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import re
import sys
import unicodedata
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont, ImageOps
from scipy.sparse import csr_array

from bstcad import files
from bstcad.optics.outlines import Outline
from bstcad.sentences import SceneError

FORMATS = {"PNG": ".png", "JPEG": ".jpg", "TIFF": ".tif"}  # what is read, and the ending its copy gets
LARGEST = 64_000_000  # pixels of a picture
LONGEST = 65_535  # pixels along a side: as far as JPEG goes
TILE_WIDTH, TILE_LENGTH = 322, 323  # tags of a TIFF file, which is decoded by whole tiles
LARGEST_TILE = 4096**2  # pixels; what programs write has 1024 a side
LARGEST_FILE = 400_000_000  # bytes: 64 million pixels of three 16-bit channels
BRIGHTEST = 1e100  # of a value; more of them might add up to what is not finite
STRIP = 256  # rows of a picture in work at a time
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


def photograph(picture: Picture, columns: int, rows: int, gamma: float | None) -> np.ndarray:
    """Mean linear grey of the picture over each of (rows, columns) equal rectangles."""
    with _decoding(picture.name), _opened(picture.name, picture.data) as image:
        return _average(ImageOps.exif_transpose(image), columns, rows, gamma, picture.name)


def sample(name: str, columns: int, rows: int, gamma: float | None) -> np.ndarray:
    """One of scikit-image's bundled pictures, averaged like a photograph."""
    from skimage import data  # loads a good part of scikit-image: only where a sample is asked for

    return _average(Image.fromarray(getattr(data, name)()), columns, rows, gamma, name)


def letters(text: str, columns: int, rows: int, aspect: float) -> np.ndarray:
    """White bold letters on black, centred, 84 % of the width or 80 % of the height; aspect = width / height (mm)."""
    side = min(4 * max(columns, rows), 4096)  # drawn finer, then averaged: smooth rims
    width = max(round(side * min(aspect, 1.0)), 16)
    height = max(round(side * min(1 / aspect, 1.0)), 16)
    at_100 = _ink(text, 100.0)
    scale = min(0.84 * width / at_100.width, 0.80 * height / at_100.height)
    ink = _ink(text, max(100.0 * scale, 1.0))
    image = Image.new("L", (width, height))
    image.paste(ink, ((width - ink.width) // 2, (height - ink.height) // 2))
    return _average(image, columns, rows, None, text)


def inside(outline: Outline, columns: int, rows: int, width: float, height: float) -> np.ndarray:
    """The share of each pixel that lies inside an outline centred in a width x height rectangle (mm)."""
    fine = max(2048 // max(columns, rows), 4)  # sub-pixels along a pixel's side
    x, y = (
        ((torch.arange(n * fine, dtype=torch.float64) + 0.5) / (n * fine) - 0.5) * size
        for n, size in ((columns, width), (rows, -height))
    )
    high = fine * max(2**20 // (columns * fine * fine), 1)  # about a million sub-pixels at a time
    bands = (outline.contains(x, band[:, None]).numpy() for band in y.split(high))
    return np.concatenate([band.reshape(-1, fine, columns, fine).mean((1, 3)) for band in bands])


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
        image = Image.open(io.BytesIO(data), formats=list(FORMATS))
    except Image.DecompressionBombError:
        raise SceneError(f"target.image: {name!r} has over {LARGEST // 10**6} million pixels; shrink it") from None
    except (OSError, SyntaxError, ValueError):
        raise SceneError(f"target.image: {name!r} is no PNG, JPEG or TIFF picture; save it as one of these") from None
    if image.width * image.height > LARGEST or max(image.size) > LONGEST:
        raise SceneError(
            f"target.image: {name!r} has {image.width} x {image.height} pixels, more than {LARGEST // 10**6} million "
            f"or than {LONGEST} along a side; shrink it"
        )
    if image.format == "TIFF" and (TILE_WIDTH in image.tag_v2 or TILE_LENGTH in image.tag_v2):
        width, height = image.tag_v2.get(TILE_WIDTH, image.width), image.tag_v2.get(TILE_LENGTH, image.height)
        if width * height > LARGEST_TILE:
            raise SceneError(f"target.image: {name!r} has tiles larger than any picture; save it again, or as PNG")
    return image


def _average(image: Image.Image, columns: int, rows: int, gamma: float | None, name: str) -> np.ndarray:
    """Area average of the linear grey, exact for any ratio of the sizes; strip by strip to spare memory."""
    width, height = image.size
    across = _overlap(width, columns)
    strips = (image.crop((0, top, width, min(top + STRIP, height))) for top in range(0, height, STRIP))
    narrow = np.concatenate([(across @ _linear(strip, gamma).T).T for strip in strips])
    if not np.isfinite(narrow).all() or narrow.min() < 0 or narrow.max() > BRIGHTEST:
        raise SceneError(f"target.image: {name!r} has values that are negative or not finite; save it in 8 or 16 bits")
    return _overlap(height, rows) @ narrow


def _linear(image: Image.Image, gamma: float | None) -> np.ndarray:
    """Grey = mean of linear R, G and B, on black where transparent; (height, width), on any scale."""
    if image.mode.startswith(("I", "F")):  # 16 and 32 bits, one channel
        grey = np.asarray(image, dtype=np.float64)
        return grey if gamma is None else (grey / 65535.0) ** gamma
    if "A" in image.getbands() or "transparency" in image.info:
        rgba = np.asarray(image.convert("RGBA"), dtype=np.float64) / 255.0
        rgb = rgba[..., :3] * rgba[..., 3:]
    else:
        rgb = np.asarray(image.convert("RGB"), dtype=np.float64) / 255.0
    return (rgb if gamma is None else rgb**gamma).mean(axis=-1)


def _overlap(size: int, pixels: int) -> csr_array:
    """Averaging matrix (pixels, size): the share of each output pixel that each input pixel covers."""
    cuts = np.union1d(np.arange(size + 1) * pixels, np.arange(pixels + 1) * size)  # both grids, in whole numbers
    return csr_array((np.diff(cuts) / size, (cuts[:-1] // size, cuts[:-1] // pixels)), shape=(pixels, size))


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or ["unreadable"])[0].rstrip(".")
