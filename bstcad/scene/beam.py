"""Measured beams: the irradiance of a laser beam from the picture of a camera, or from a table.

The background is removed as in ISO 11146-3, and the beam is described by its moments as in ISO 11146-1: centroid,
second-moment widths and rotation.
"""

from __future__ import annotations

import contextlib
import functools
import io
import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Discriminator, Tag

from bstcad.optics.light import collimated
from bstcad.optics.light.collimated import ProfileName
from bstcad.optics.light.profiles import MeasuredProfile, Net, Profile
from bstcad.optics.surfaces.key import Key
from bstcad.optics.surfaces.outlines import STRICT
from bstcad.runs import files
from bstcad.scene import picture
from bstcad.scene.errors import SceneError
from bstcad.scene.picture import Picture
from bstcad.scene.schema import LENGTHS, OneOrTwoWidths, Record, from_file

KEY = "source.profile.image"  # key of the file, for messages
PREFIX = "beam-"  # beginning of the name of the copy
MAX_BEAM_PIXELS = 16_000_000  # largest number of pixels of a picture or of numbers of a table; each takes 25 bytes
MAX_TABLE_LINE = 2_000_000  # largest line of a table (characters), 30 for each of 65 535 numbers
MAX_TABLE_VALUE = 1e100  # largest size of a number of a table, so that sums of squares are finite
MAX_TABLE_SIZE = 50_000_000  # largest table of a beam (bytes)
MIN_SIDE = 5  # smallest number of rows and columns
MAX_NET = 512  # largest number of control points along a side; pictures with more pixels are averaged
CORNER = 0.035  # side of the corners of a picture that show the background, as a fraction of its sides (ISO 11146-3)
NOISE_FACTOR = 3.0  # values below the mean background plus so many standard deviations are background
WIDTHS = 3.0  # side of the rectangle over which moments are taken, in second-moment widths (ISO 11146-1)
MOMENT_ROUNDS = 20  # largest number of moments, each over the rectangle that the last ones gave
SETTLED = 1e-3  # relative change of the widths at which the rectangle has settled


@functools.lru_cache(maxsize=4)
def values_of(image: Picture) -> np.ndarray:
    """Return the irradiance (rows, columns) of a picture or table on any scale, row 0 at the top."""
    if image.name.endswith(".csv"):
        return table(image.data, shown(image))
    with _naming_the_beam(), picture.decoding(image):
        picture.kind_of(image.data, shown(image), MAX_BEAM_PIXELS)  # before the pixels are decoded
        photo = picture.photo(image, gamma=1.0)
        return np.concatenate([photo.light(box) for box in picture.strips((0, 0, *photo.image.size))])


@contextlib.contextmanager
def _naming_the_beam() -> Iterator[None]:
    """Give the errors in the block the key of a beam in place of a target's."""
    try:
        yield
    except SceneError as error:
        raise SceneError(str(error).replace("target.image", KEY)) from None


def read_beam(path: Path) -> Picture:
    """Read the file of a beam, a picture or a table with the suffix .csv; SceneError if it cannot be read."""
    if path.suffix.lower() != ".csv":
        with _naming_the_beam():
            return of_beam(picture.read_picture(path))
    try:
        data = files.contents(path, MAX_TABLE_SIZE)
    except ValueError as error:
        raise SceneError(f"{KEY}: {str(path)!r} cannot be read ({error}); give a path relative to the scene") from None
    return of_beam(Picture(f"{picture.safe_name(path.stem)[:70] or 'beam'}.csv", data))


def of_beam(image: Picture) -> Picture:
    """Return the file with a name for its copy that no picture of a target and no exported file has."""
    return image if image.name.startswith(PREFIX) else replace(image, name=f"{PREFIX}{image.name}"[-80:])


def shown(image: Picture) -> str:
    """Return the name of the file for messages, without that of its copy."""
    return image.name.removeprefix(PREFIX)


def table(data: bytes, name: str) -> np.ndarray:
    """Return the numbers of a table, (rows, columns), separated by comma, semicolon or space; # begins a remark."""
    refused = (
        f"{KEY}: {name!r} is not a table of numbers up to {MAX_TABLE_VALUE:g}; give rows of as many numbers each, "
        f"at least {MIN_SIDE} x {MIN_SIDE}, at most {MAX_BEAM_PIXELS // 10**6} million, all finite"
    )
    text, values, columns = io.TextIOWrapper(io.BytesIO(data), "utf-8-sig"), array("d"), 0
    try:
        while line := text.readline(MAX_TABLE_LINE + 1):
            if len(line) > MAX_TABLE_LINE:
                raise ValueError
            row = line.partition("#")[0].replace(";", " ").replace(",", " ").split()
            columns = columns or len(row)
            if row and (len(row) != columns or columns < MIN_SIDE or len(values) + columns > MAX_BEAM_PIXELS):
                raise ValueError
            values.extend(map(float, row))
    except ValueError:
        raise SceneError(refused) from None
    found = np.array(values).reshape(-1, max(columns, 1))
    if len(found) < MIN_SIDE or not np.abs(found).max() <= MAX_TABLE_VALUE:
        raise SceneError(refused)
    return found


@dataclass(frozen=True)
class Moments:
    """Centroid and widths of a beam in the plane of its picture, x to the right and y upwards, from its centre (mm)."""

    centre: tuple[float, float]
    widths: tuple[float, float]  # second-moment widths along the two axes, four standard deviations each
    rotate: float  # angle of the first axis from x towards y, degrees

    @property
    def words(self) -> str:
        """Widths and rotation in words."""
        across, along = self.widths
        return f"{across:.4g} × {along:.4g} mm (second-moment widths), first axis at {self.rotate + 0.0:.3g}°"


def background(values: np.ndarray) -> tuple[float, float]:
    """Return mean and standard deviation of the values in the four corners of a picture (ISO 11146-3)."""
    rows, columns = (max(round(CORNER * side), 1) for side in values.shape)
    corners = [
        part[:, span] for part in (values[:rows], values[-rows:]) for span in (slice(columns), slice(-columns, None))
    ]
    each = np.concatenate([corner.ravel() for corner in corners])
    return float(each.mean()), float(each.std())


def lit(values: np.ndarray) -> np.ndarray:
    """Return the irradiance above the background; zero where it is not above the noise of the background."""
    mean, deviation = background(values)
    return np.where(values > mean + NOISE_FACTOR * deviation, values - mean, 0.0)


def moments(light: np.ndarray, width: float) -> Moments:
    """Return the moments of an irradiance (rows, columns), row 0 at the top; width: of the picture (mm).

    σ_x² = Σ E (x - x̄)² / Σ E, σ_y² and σ_xy likewise; the axes are those of this tensor, and the widths four times the
    roots of its eigenvalues.  They are taken inside a rectangle of three widths about the centroid (ISO 11146-1).
    """
    rows, columns = light.shape
    pitch = width / columns
    x, y = (np.arange(columns) - (columns - 1) / 2) * pitch, ((rows - 1) / 2 - np.arange(rows)) * pitch
    inside, last = light, (math.inf, math.inf)
    for _ in range(MOMENT_ROUNDS):
        across, up, whole = inside.sum(0), inside.sum(1), inside.sum()
        c_x, c_y = float(across @ x / whole), float(up @ y / whole)
        xx, yy = float(across @ (x - c_x) ** 2 / whole), float(up @ (y - c_y) ** 2 / whole)
        xy = float((y - c_y) @ inside @ (x - c_x) / whole)
        sides = 4 * math.sqrt(xx), 4 * math.sqrt(yy)
        if all(abs(side - before) <= SETTLED * side for side, before in zip(sides, last, strict=True)):
            break
        last, half = sides, [max(WIDTHS * side / 2, pitch) for side in sides]
        near = np.ix_(np.abs(y - c_y) <= half[1], np.abs(x - c_x) <= half[0])
        inside = np.zeros_like(light)
        inside[near] = light[near]
    value, axis = np.linalg.eigh([[xx, xy], [xy, yy]])
    first = axis[:, 0] if abs(axis[0, 0]) >= abs(axis[0, 1]) else axis[:, 1]  # the axis closest to x
    large = 0 if first is axis[:, 0] or np.array_equal(first, axis[:, 0]) else 1
    widths = 4 * math.sqrt(max(value[large], 0.0)), 4 * math.sqrt(max(value[1 - large], 0.0))
    angle = math.degrees(math.atan2(first[1], first[0]))
    return Moments((c_x, c_y), widths, (angle + 90) % 180 - 90)


class MeasuredBeam(Record, MeasuredProfile):
    """The irradiance of a beam from a file.

    The irradiance is a quadratic B-spline whose control points are the pixels' values above the background, in
    averages of so many pixels that no side has more than 512.  Its second moments exceed the pixels' by a quarter of
    the square of their pitch (the variance of the quadratic B-spline).
    """

    image: Annotated[
        Picture,
        *from_file(Picture, read_beam, "image = 'beam.tif'"),
        Key(
            "Picture of the beam, whose values are irradiance, or a table (.csv), row 0 at the top.", example="beam.tif"
        ),
    ]
    width: Annotated[float, Key("Width of the whole picture in the beam.", "mm", *LENGTHS, example=12.0)]
    origin: Annotated[
        Literal["centroid", "picture"],
        Key("Place of the picture on source.centre: its centroid, or its centre.", example="picture"),
    ] = "centroid"
    subtract: Annotated[bool, Key("Whether to subtract the background that the corners show.", example=False)] = True

    @property
    def light(self) -> np.ndarray:
        """Irradiance above the background (rows, columns), row 0 at the top."""
        return _light(self.image, self.subtract)

    @property
    def law(self) -> Profile:
        """The irradiance as a spline."""
        return _law(self.image, self.subtract, self.width, origin=self.origin)

    @property
    def moments(self) -> Moments:
        """Centroid, widths and rotation."""
        return moments(self.light, self.width)

    @property
    def words(self) -> str:
        """Name of the file and the moments in words."""
        c_x, c_y = self.moments.centre
        return f"measured beam {shown(self.image)}, {self.moments.words}, centroid at ({c_x:.3g}, {c_y:.3g}) mm"


@functools.lru_cache(maxsize=4)
def _light(image: Picture, subtract: bool) -> np.ndarray:
    values = values_of(image)
    found = lit(values) if subtract else np.maximum(values, 0.0)
    if not found.max() > 0:
        raise SceneError(f"{KEY}: {shown(image)!r} shows no light above its background")
    return found


@functools.lru_cache(maxsize=4)
def _law(image: Picture, subtract: bool, width: float, origin: str) -> Profile:
    light = _light(image, subtract)
    centre = moments(light, width).centre if origin == "centroid" else (0.0, 0.0)
    rows, columns = light.shape
    several = math.ceil(max(rows, columns) / MAX_NET)
    rest = columns % several, rows % several  # pixels on the right and below that are left out
    rows, columns = rows // several, columns // several
    if min(rows, columns) < MIN_SIDE:
        raise SceneError(f"{KEY}: {shown(image)!r} has fewer than {MIN_SIDE} rows or columns; give a larger picture")
    mean = light[: rows * several, : columns * several].reshape(rows, several, columns, several).mean((1, 3))
    pitch = width / light.shape[1] * several
    pixel = width / light.shape[1]
    middle = -rest[0] / 2 * pixel - centre[0], rest[1] / 2 * pixel - centre[1]
    half_u, half_v = ((side - 1) / 2 * pitch for side in (columns, rows))
    u, v = (middle[0] - half_u, middle[0] + half_u), (middle[1] - half_v, middle[1] + half_v)
    return Profile(net=Net(mean[::-1].T, u, v))


@dataclass(frozen=True)
class Collimated(collimated.CollimatedSource):
    """Parallel light of a scene, whose profile may be measured."""

    profile: Annotated[
        Annotated[ProfileName, Tag("name")] | Annotated[MeasuredBeam, Tag("measured")],
        Discriminator(lambda given: "name" if isinstance(given, str) else "measured"),
        Key("Irradiance over the aperture, or a measured beam."),
    ] = "uniform"
    radius_1e2: Annotated[
        OneOrTwoWidths | None,
        Key("Radius at which the profile is 1/e² of its peak; two: along x, along y.", "mm", 1e-3, 1e6, example=8.0),
    ] = None
    divergence: Annotated[
        OneOrTwoWidths | None,
        Key("Full angle of the cone of rays, simulated; two: along x, along y.", "degrees", 0.0, 179.0, example=0.53),
    ] = None

    __pydantic_config__ = STRICT
