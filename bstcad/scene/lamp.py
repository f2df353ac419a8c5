"""Lamps of a scene: points and small sources whose radiant intensity, or whose rays, may come from a file."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from bstcad.optics.light import point
from bstcad.optics.light.measured_rays import MeasuredRays, RayFacts, RayOrder
from bstcad.optics.light.profiles import MeasuredProfile, Net, Profile
from bstcad.optics.surfaces.key import Key
from bstcad.optics.surfaces.outlines import STRICT
from bstcad.photometry import intensity_files, ray_files, tm25
from bstcad.photometry.intensity import Intensity, Luminaire, PhotometricError
from bstcad.photometry.ray_model import RayModel, model_of, rays_of_lines
from bstcad.photometry.ray_set import RaySet
from bstcad.runs import files
from bstcad.scene.picture import safe_name
from bstcad.scene.schema import FileContent, OneOrTwoWidths, from_file

PREFIXES = ("lamp-", "wanted-", "rays-")  # beginnings of the names of copies: of a lamp, of a target, of rays
MAX_FILE_SIZE = 100_000_000  # largest intensity file (bytes)
MAX_RAYS_SIZE = 400_000_000  # largest ray file (bytes) that is copied whole; of a larger one, random rays are copied
COPIED_RAYS = 5_000_000  # number of random rays that are copied of a larger file
MIN_RAYS = 1000  # smallest number of rays of a file; fewer cannot judge a lens
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
        return shown(self.name)

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


@dataclass(frozen=True)
class RayFile(FileContent, MeasuredRays):
    """The rays of a file and their model: the content of the file, and a safe name for its copy."""

    name: str
    data: bytes = field(repr=False)
    notes: tuple[str, ...] = ()  # sentences on the copying of a part of a larger file

    def __getstate__(self) -> dict[str, Any]:
        """Return the content alone: what follows from it is several times as large."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @functools.cached_property
    def rays(self) -> RaySet:
        """Positions (mm), directions and powers of the rays."""
        try:
            return ray_files.read(self.name, self.data)
        except PhotometricError as fault:
            raise ValueError(f"{self.shown!r} {fault}") from None

    @functools.cached_property
    def model(self) -> RayModel:
        """Even disc or rectangle of points for which a lens is tailored."""
        rays = self.rays
        try:
            return model_of(rays)
        except ValueError as fault:
            raise ValueError(f"{self.shown!r} {fault}") from None

    @property
    def facts(self) -> RayFacts:
        """Facts of the model."""
        return self.model.facts

    @property
    def shown(self) -> str:
        """Name of the file for messages, without the prefix of its copy."""
        return shown(self.name)

    @property
    def words(self) -> str:
        """Name, number of rays, flux and model of the file."""
        rays = self.rays
        return f"{len(rays.power)} rays of {self.shown}, {rays.flux:.5g} {rays.unit}, tailored as {self.model.words}"

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on readings that the file does not state plainly."""
        return (*self.notes, *self.rays.remarks)

    def scaled(self, share: float) -> MeasuredRays:
        """Return the model with its extent multiplied by `share`; the whole extent has the rays as well."""
        return self if share == 1 else self.model.scaled(share)

    def rays_of(self, line: int) -> RayOrder:
        """Return the rays of a spectral line in random order."""
        return self._orders[line]

    @functools.cached_property
    def _orders(self) -> tuple[RayOrder, ...]:
        return tuple(RayOrder.of(self.rays, chosen) for chosen in rays_of_lines(self.rays))


def shown(name: str) -> str:
    """Return the name of a file without the prefix of its copy."""
    return next((name.removeprefix(each) for each in PREFIXES if name.startswith(each)), name)


def read_rays(path: Path) -> RayFile:
    """Read a file of rays; ValueError, without the key, if it is missing or damaged."""
    try:
        state = path.stat()
        return _rays_of(path, state.st_size, state.st_mtime_ns)
    except PhotometricError as fault:
        raise ValueError(f"{path.name!r} {fault}") from None
    except OSError as error:
        why = f"cannot be read ({error.strerror})"
        raise ValueError(f"{str(path)!r} {why}; give a path relative to the scene file") from None


@functools.lru_cache(maxsize=1)  # a page reads the scene at each change, and a file may take seconds
def _rays_of(path: Path, size: int, changed: int) -> RayFile:
    """Return the rays of a file of this size (bytes), last changed at this time (ns)."""
    name = _copied(path, "rays-")
    if path.is_file() and size > MAX_RAYS_SIZE:
        found = _part_of(path, f"{Path(name).stem}.tm25ray")
    else:
        try:
            found = RayFile(name, files.contents(path, MAX_RAYS_SIZE))
        except ValueError as error:
            remedy = "give a path relative to the scene file"
            raise ValueError(f"{str(path)!r} cannot be read ({error}); {remedy}") from None
    if (count := len(found.rays)) < MIN_RAYS:
        raise PhotometricError(f"has {count} rays, and a lens is judged by at least {MIN_RAYS}; give a larger file")
    _ = found.model
    return found


def _part_of(path: Path, name: str) -> RayFile:
    """Return random rays of a file that is too large for a copy, as a TM-25 file of this name."""
    rays = ray_files.read(path.name, path)
    if rays.unit == "lm" and isinstance(rays.wavelength, np.ndarray):
        both = "wavelengths beside luminous flux, which the smaller copy cannot have"
        raise PhotometricError(f"has more than {MAX_RAYS_SIZE / 1e6:.0f} MB and {both}; write a file with fewer rays")
    some = rays.drawn(COPIED_RAYS)
    note = f"The file has {len(rays)} rays; {len(some)} random ones are copied and stand for them."
    return RayFile(name, tm25.write(some, Luminaire(rays.name)), notes=(note, *rays.remarks))


def _copied(path: Path, prefix: str) -> str:
    """Return the name of the copy of a file, with this prefix, so that no other file of a scene has it."""
    stem = safe_name(path.stem)[:60]
    return (stem if stem.startswith(prefix) else f"{prefix}{stem}") + path.suffix.lower()


def read_intensity(path: Path, prefix: str) -> IntensityFile:
    """Read an intensity file; ValueError, without the key, if it is missing, too large or damaged.

    prefix: beginning of the name of the copy, so that no other file of a scene has this name.
    """
    try:
        data = files.contents(path, MAX_FILE_SIZE)
    except ValueError as error:
        raise ValueError(f"{str(path)!r} cannot be read ({error}); give a path relative to the scene file") from None
    found = IntensityFile(_copied(path, prefix), data)
    _ = found.table
    return found


@dataclass(frozen=True)
class Point(point.PointSource):
    """A point, disc or rectangle of a scene, whose intensity may come from a file, or a file of rays."""

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
    rays: Annotated[
        Annotated[RayFile, *from_file(RayFile, read_rays, "rays = 'led.tm25ray'")] | None,
        Key("Rays of a lamp from a file (.tm25ray, .dat, .sdf, .ray); they judge the lens.", example="led.tm25ray"),
    ] = None

    __pydantic_config__ = STRICT
