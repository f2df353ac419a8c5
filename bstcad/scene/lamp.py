"""Lamps of a scene: points and small sources whose radiant intensity may come from a photometric file."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np

from bstcad.optics import point
from bstcad.optics.key import Key
from bstcad.optics.outlines import STRICT
from bstcad.optics.profiles import MeasuredProfile, Net, Profile
from bstcad.photometry import intensity_files
from bstcad.photometry.intensity import Intensity, PhotometricError
from bstcad.runs import files
from bstcad.scene.picture import safe_name
from bstcad.scene.schema import FileContent, OneOrTwoWidths, from_file

PREFIXES = ("lamp-", "wanted-")  # beginnings of the names of copies: of a lamp, of a target
MAX_FILE_SIZE = 100_000_000  # largest intensity file (bytes)
NET_SIDES = 257, 513, 1025  # control points per side, for tables of wider and narrower spacing
POINTS_PER_SPACING = 4.0  # control points per spacing of the table's angles, if NET_SIDES allow it
HALF_SPACE = 90.0  # degrees
MARGIN = 1.02  # extent of the net relative to the light's, so that its rim is dark


@dataclass(frozen=True)
class IntensityFile(FileContent, MeasuredProfile):
    """The radiant intensity of a photometric file: the unchanged content, and a safe name for its copy."""

    name: str
    data: bytes = field(repr=False)

    @functools.cached_property
    def table(self) -> Intensity:
        """Intensities over directions."""
        try:
            return intensity_files.read(self.name, self.data)
        except PhotometricError as fault:
            raise ValueError(f"{self.shown!r} {fault}") from None

    @property
    def shown(self) -> str:
        """Name of the file for messages, without the prefix of its copy."""
        return next((self.name.removeprefix(each) for each in PREFIXES if self.name.startswith(each)), self.name)

    @functools.cached_property
    def law(self) -> Profile:
        """Intensity (cd) as a B-spline over stereographic coordinates, whose control points are values of the table.

        tan(θ / 2) is nearly even in angle over the half space.  The spline smooths by 0.35 spacings of its net.
        """
        table = self.table
        half = MARGIN * math.tan(math.radians(min(table.half_angle, HALF_SPACE)) / 2)
        wanted = POINTS_PER_SPACING * 4 * half / math.radians(max(table.spacing, 1e-3))
        side = next((side for side in NET_SIDES if side >= wanted), NET_SIDES[-1])
        u, v = np.meshgrid(*2 * (np.linspace(-half, half, side),), indexing="ij")
        r2 = u * u + v * v  # tan²(θ / 2); sin θ = 2 t / (1 + t²), cos θ = (1 - t²) / (1 + t²)
        values = table.at(2 * u / (1 + r2), 2 * v / (1 + r2), (1 - r2) / (1 + r2))
        values = np.where(r2 <= 1, values, 0.0)  # light behind the plane across the axis goes to no lens
        return Profile(net=Net(values, (-half, half), (-half, half)), stereographic=True, whole=table.lumens)

    @property
    def lumens(self) -> float:
        """Luminous flux of the table, its integral over all directions (lm)."""
        return self.table.lumens

    @property
    def half_angle(self) -> float:
        """Largest angle from the axis (degrees) with light."""
        return self.table.half_angle

    @property
    def words(self) -> str:
        """Name of the file and its flux."""
        return f"intensity of {self.shown}, {self.lumens:.5g} lm"


def read_intensity(path: Path, prefix: str) -> IntensityFile:
    """Read an intensity file; ValueError, without the key, if it is missing, too large or damaged.

    prefix: beginning of the name of the copy, so that no other file of a scene has this name.
    """
    try:
        data = files.contents(path, MAX_FILE_SIZE)
    except ValueError as error:
        raise ValueError(f"{str(path)!r} cannot be read ({error}); give a path relative to the scene file") from None
    stem = safe_name(path.stem)[:60]
    found = IntensityFile((stem if stem.startswith(prefix) else f"{prefix}{stem}") + path.suffix.lower(), data)
    _ = found.table
    return found


@dataclass(frozen=True)
class Point(point.Point):
    """A point, disc or rectangle of a scene, whose intensity may come from a file."""

    half_angle_1e2: Annotated[
        OneOrTwoWidths | None,
        Key(
            "Angle at which a gaussian profile's irradiance on a plane is 1/e² of its peak; two: towards x, towards y.",
            "degrees", 1e-3, 89.0,
        ),
    ] = None  # fmt: skip
    intensity: Annotated[
        Annotated[
            IntensityFile, *from_file(IntensityFile, partial(read_intensity, prefix="lamp-"), "intensity = 'led.ies'")
        ]
        | None,
        Key("Intensity over directions from a file (.ies, .ldt, .csv), in place of a profile.", example="led.ies"),
    ] = None

    __pydantic_config__ = STRICT
