"""The target: its picture, its position, the fit of the picture, and the side from which it is seen.

Row 0 of a picture is its top and column 0 its left, as a viewer sees it; `Target.irradiance` orders columns by x.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeAlias

import numpy as np
import torch
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag

from bstcad.optics.receivers.directions import Angles, Directions
from bstcad.optics.receivers.goal import interpolated
from bstcad.optics.receivers.irradiance import Screen, overlap
from bstcad.optics.receivers.receivers import PlaneReceiver
from bstcad.optics.surfaces.key import Key
from bstcad.optics.surfaces.outlines import Circle, Outline
from bstcad.optics.surfaces.rays import Vector
from bstcad.scene import picture
from bstcad.scene.blank import LensBlank, Outlined
from bstcad.scene.dotted_keys import PICTURE_KEYS
from bstcad.scene.errors import SceneError
from bstcad.scene.lamp import IntensityFile, read_intensity
from bstcad.scene.picture import Picture, PixelBox, strips
from bstcad.scene.profile import Pixels, Profile, Size
from bstcad.scene.schema import COORDINATES, OneOrTwo, Record, from_file, leaving_out

MIN_PIXELS = 8  # smallest number of pixels along a side of a target
MIN_EXTENT = 1e-3  # smallest side of a target, mm or another unit of its receiver
HALF_TURN = 180.0  # degrees
FAR_Z = 1e8  # z (mm) of a target over directions, which has no position
WITHOUT_GAMMA = ("text", "uniform", "profile", "intensity")  # picture keys that allow no gamma and no crop
MAX_TARGETS = 8  # largest number of targets of a scene
NOTICEABLE = 0.01  # RRMSD between two readings of a picture above which a remark states the reading
PLANE_DISTANCE = 1e-3  # mm; smallest distance between the planes of two targets
LARGEST_IN_METRES, FARTHEST_IN_METRES = 0.5, 10.0  # m; largest plausible width of a lens, and z or width of a target
MAX_REDUCTION = 20.0  # largest plausible ratio of the width of a lens to the width of its target
TEXT_SAMPLES = 4096  # samples along the longer side of a text, averaged over the pixels
SAMPLES_PER_PIXEL = 4  # samples of an intensity file along each side of a pixel
EDGE_ON = math.sin(math.radians(1.0))  # sine of the smallest angle between the line of sight and a target's plane
GRAZING_VIEW = 8.0  # degrees; a flatter view of a target gets a warning (RRMSD 0.07 at 30, 0.33 at 10, 1.6 at 5)
DIRECTIONS = {1: "+z", -1: "-z"}

PictureFile = Annotated[
    Picture,
    *from_file(Picture, picture.read_picture, "image = 'photo.png'"),
    BeforeValidator(lambda given: picture.from_array(given) if isinstance(given, np.ndarray) else given),
]
Crop: TypeAlias = tuple[float, float, float, float]  # left, top, right, bottom as fractions of width and height
Tilt = Annotated[tuple[float, float] | None, AfterValidator(lambda tilt: tilt if tilt and any(tilt) else None)]
# Remedy for a wall that is nearly parallel to the axis.
AIM = (
    "to light a wall beside the lamp, turn the lamp towards the centre of the picture; then target.z is the distance "
    "to this centre, and target.tilt the remaining angle, such as [60.0, 0.0]"
)


class Target(Record):
    """The picture over the rectangle x by y on the plane z, or on a plane tilted about the centre of the rectangle."""

    kind: Annotated[Literal["plane"], Key("Irradiance of a plane.")] = "plane"
    z: Annotated[float, Key("Position of the target; if tilted, of its centre.", "mm", *COORDINATES, example=1000.0)]
    x: Annotated[tuple[float, float], Key("Ends of the target along x.", "mm", *COORDINATES, example=[-200.0, 200.0])]
    y: Annotated[tuple[float, float], Key("Ends of the target along y.", "mm", *COORDINATES, example=[-200.0, 200.0])]
    tilt: Annotated[Tilt, Key("Tilt about x, then about y.", "degrees", -89.0, 89.0, remedy=AIM)] = None
    pixels: Annotated[OneOrTwo, Key("Pixels on the longer side or [columns, rows].", "", MIN_PIXELS, 4096, example=512)]
    text: Annotated[str | None, Key("Text as the picture, centred, as large as fits with a margin.")] = None
    image: Annotated[PictureFile | None, Key("Picture file, relative to the scene file.", example="photo.jpg")] = None
    sample: Annotated[picture.Sample | None, Key("Sample picture of scikit-image.")] = None
    uniform: Annotated[Literal[True] | None, Key("Uniform irradiance instead of a picture.")] = None
    profile: Annotated[
        Profile | None, Key("Irradiance of this shape instead of a picture.", example={"shape": "disc", "radius": 6.0})
    ] = None
    gamma: Annotated[
        float | None, Key("Irradiance = value^gamma; the file's profile or sRGB if absent.", "", 0.1, 10.0, example=1.0)
    ] = None
    invert: Annotated[bool, Key("Negative of the picture.", example=True)] = False
    seen_from: Annotated[Literal["lens", "behind"], Key("Side from which the picture is seen as in its file.")] = "lens"
    rotate: Annotated[Literal[0, 90, 180, 270], Key("Rotation of the picture, counterclockwise.", "degrees")] = 0
    mirror: Annotated[bool, Key("Exchange left and right, after the rotation.")] = False
    fit: Annotated[Literal["crop", "pad", "stretch"], Key("What to do if proportions differ.", example="pad")] = "crop"
    crop: Annotated[
        Crop | None, Key("Part used: fractions [left, top, right, bottom].", "", 0.0, 1.0, example=[0.1, 0.0, 0.9, 1.0])
    ] = None
    outline: Annotated[Outlined | None, Key("Outline around the target's centre; the picture is dark outside.")] = None
    unreachable: Annotated[Literal["dark", "refuse"], Key("Parts that light cannot reach: dark, or refused.")] = "dark"
    weight: Annotated[float, Key("Weight of its squared error among the targets.", "", 1e-6, 1e6, example=2.0)] = 1.0

    written = leaving_out(kind="plane", weight=1.0)
    picture_keys: ClassVar[tuple[str, ...]] = tuple(key for key in PICTURE_KEYS if key != "intensity")

    def complaints(self) -> Iterator[str]:
        """Yield the faults of the table [target], each as "key: sentence"."""
        given = self._pictures
        if len(given) != 1:
            names = " and ".join(given) or "none"
            yield f"target: needs exactly one of {', '.join(self.picture_keys)}, and has {names}; give exactly one"
        for axis, (low, high) in (("x", self.x), ("y", self.y)):
            if not low < high:
                yield f"target.{axis}: [{low:g}, {high:g}] is not an interval; write the smaller end first"
            if high - low < MIN_EXTENT:
                yield f"target.{axis}: is narrower than {MIN_EXTENT:g} {self.unit}; make it wider"
        if self.text is not None and not (self.text.strip() and len(self.text) <= 100):
            yield 'target.text: must have 1 to 100 letters; give for example text = "THU"'
        if self.gamma is not None and given[0] in WITHOUT_GAMMA:
            yield "target.gamma: only an image or a sample has a gamma; remove it"
        if self.crop is not None:
            left, top, right, bottom = self.crop
            if given[0] in WITHOUT_GAMMA:
                yield "target.crop: only an image or a sample can be cropped; remove it"
            if not (left < right and top < bottom):
                ends = ", ".join(f"{end:g}" for end in self.crop)
                yield f"target.crop: [{ends}] is empty; write left, top, right and bottom, such as [0.1, 0, 0.9, 1]"
        if self.invert and self.uniform:
            yield "target.invert: the negative of a uniform target is dark; remove this key"
        if self.invert and self.profile:
            yield "target.invert: a profile has no negative; remove this key"
        yield from self._profile_complaints() if self.profile else ()
        for axis, half, size in zip("xy", self.outline.half_extent if self.outline else (), self.size, strict=False):
            if 2 * half > size:
                yield f"target.outline: is larger than the target along {axis}; make it smaller, or widen target.{axis}"

    def _profile_complaints(self) -> Iterator[str]:
        """Yield complaints about a profile larger than the target, or narrower than two pixels, or about its edge."""
        edge, narrow = getattr(self.profile, "edge", 0.0), 2 * min(getattr(self.profile, "half_extent", (0.0, 0.0)))
        if edge > narrow - edge:
            yield f"target.profile.edge: {edge:g} is wider than the rectangle, {narrow - edge:g}; make it narrower"
        pixels = (side / n for side, n in zip(self.size, self.columns_rows, strict=True))
        for axis, half, size, pixel in zip("xy", self._half_profile, self.size, pixels, strict=True):
            if 2 * half > size:
                yield f"target.profile: is larger than the target along {axis}; make it smaller, or widen target.{axis}"
            if half < pixel:
                fine = f"half its width along {axis}, {half:g} {self.unit}, is less than a pixel of {pixel:.3g}"
                yield f"target.profile: {fine} {self.unit}; make it larger, or set more target.pixels"

    @property
    def _half_profile(self) -> tuple[float, float]:
        """Half the width and height of the rotated profile, in `unit`; infinite without a profile."""
        along_x, along_y = self.profile.half_extent if self.profile else (math.inf, math.inf)
        return (along_y, along_x) if self.rotate in (90, 270) else (along_x, along_y)

    @property
    def _pictures(self) -> list[str]:
        return [name for name in self.picture_keys if getattr(self, name) is not None]

    @property
    def photo(self) -> Picture | str | None:
        """Picture file, or name of a sample; None for other pictures."""
        return self.sample if self.image is None else self.image

    def as_rotated(self, shown: Pixels) -> Pixels:
        """Return the width and height `shown` of a picture after the target's rotation."""
        return shown[::-1] if self.rotate in (90, 270) else shown

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the target, in `unit`."""
        return self.x[1] - self.x[0], self.y[1] - self.y[0]

    @property
    def unit(self) -> str:
        """Unit of x and y, which the receiver states."""
        return self.screen.receiver.unit

    @property
    def columns_rows(self) -> tuple[int, int]:
        """Pixels along x and along y, at least MIN_PIXELS for a narrow target."""
        if not isinstance(self.pixels, int):
            return self.pixels
        longer, total = max(self.size), self.pixels
        columns, rows = (max(round(total * side / longer), min(total, MIN_PIXELS)) for side in self.size)
        return columns, rows

    def fewer_pixels(self, factor: float) -> tuple[int, int]:
        """Return columns and rows divided by a factor, at least MIN_PIXELS and one per half width of the profile."""
        sides = zip(self.columns_rows, self.size, self._half_profile, strict=True)
        minimum = ((n, max(MIN_PIXELS, math.ceil(size / half))) for n, size, half in sides)
        columns, rows = (min(max(round(n / factor), fewest), max(n, MIN_PIXELS)) for n, fewest in minimum)
        return columns, rows

    @property
    def screen(self) -> Screen:
        """The receiver with its pixels."""
        return Screen(self.z, self.x, self.y, self.columns_rows, tilt=self.tilt)

    def irradiance(self, cells: int = 1) -> np.ndarray:
        """Return the required flux per cell, (rows, columns) float64 of sum 1; row 0 is y max, column 0 is x min.

        Seen from the lens, along +z with y up, x increases to the left: the last column (x max) is on the left there.
        cells: number of cells along each side of a pixel; a photograph is interpolated (`interpolated`), other pictures
        are drawn anew.  An array of cells is shared: nobody may write to it.
        """
        return self._drawn_flux(1) if cells == 1 else _flux_on_cells(self, cells)

    def _drawn_flux(self, cells: int) -> np.ndarray:
        seen = drawing(self, cells).light
        flux = seen[:, ::-1] if self.seen_from == "lens" else seen
        screen = self.screen.divided(cells)
        if self.outline is not None:
            flux = flux * inside(self.outline, (screen.columns, screen.rows), self.size)
        if (areas := screen.areas) is not None:  # flux is irradiance times area
            flux = flux * areas
        total = flux.sum()
        if not total > 0:
            raise SceneError(f"target.{self._pictures[0]}: the picture is black everywhere; give one with some light")
        return flux / total

    # ---- complaints on the position, by the receiver of the target ----

    def behind(self, lens: LensBlank) -> Iterator[str]:
        """Yield complaints about a target that does not follow the lens along z."""
        if not self.z > (back := lens.back.z):
            behind = "behind the lens, whose back" if lens.passes.sense > 0 else "above the mirror, whose face"
            yield f"target.z: the target at z = {self.z:g} is not {behind} is at z = {back:g}; move it further along +z"

    def follows(self, words: str, z: float, sense: int) -> Iterator[str]:
        """Yield complaints about a target that does not follow an element (words: name) at z (mm) along sense · z."""
        if not sense * (self.z - z) > 0:
            where = f"the target at z = {self.z:g} must follow the {words} at z = {z:g}"
            yield f"target.z: {where} along {DIRECTIONS[sense]}, as the light travels; move one of them"

    def clearance(self, lens: LensBlank, highest: float) -> float:
        """Return the gap (mm) from a lens that ends at z = highest (mm) to the target's receiver; < 0: they overlap."""
        return self.screen.receiver.clearance(lens.outline, highest)

    def grazed(self, lens: LensBlank) -> Iterator[str]:
        """Yield a warning about a tilted target that is nearly edge-on, seen from the lens."""
        receiver, vertex = self.screen.receiver, (0.0, 0.0, lens.back.z)
        if receiver.tilt is None or not isinstance(receiver, PlaneReceiver):
            return
        sine = -receiver.height(vertex) / math.dist(receiver.middle, vertex)  # the plane misses the lens: not zero
        if sine < math.sin(math.radians(GRAZING_VIEW)):
            angle = math.degrees(math.asin(max(sine, -1.0)))
            yield (
                f"target.tilt: seen from the {lens.optic}, the target is only {angle:.2g} degrees from edge-on, and "
                f"the picture will be poor; {AIM}"
            )

    def unfaced(self, lens: LensBlank) -> Iterator[str]:
        """Yield complaints about a target that does not face the lens, cuts the lens, or reaches down to the lens."""
        screen, receiver, back, optic = self.screen, self.screen.receiver, lens.back.z, lens.optic
        if receiver.is_level:
            return
        tilted = receiver if receiver.tilt is not None and isinstance(receiver, PlaneReceiver) else None
        key, less = ("target.tilt", "tilt it less, or ") if tilted else ("target.z", "")
        if tilted and not is_faced(tilted, (0.0, 0.0, back)):
            yield f"{key}: seen from the {optic}, the target is edge-on or turned away; tilt it less, or move it"
        if not self.clearance(lens, back) > 0:
            yield f"{key}: the plane of the target cuts the {optic}; {less}move the target further along +z"
        if tilted is None:
            return
        lowest = min(receiver.point(x, y)[2] for x in screen.x for y in screen.y)
        if not lowest > back:
            edge = f"is at z = {lowest:.6g}, not behind the back of the {optic} at z = {back:g}"
            yield f"{key}: an edge of the target {edge}; tilt it less, make it smaller, or move it along +z"

    def metres(self, lens: LensBlank) -> Iterator[str]:
        """Yield a question on the first length that looks like metres, if there is one."""
        outline, widest = lens.outline, max(self.size)
        name, size = ("radius", outline.radius) if isinstance(outline, Circle) else ("width", outline.width)
        across, question = 2 * max(outline.half_extent), "are these metres? lengths are in mm"
        if across < LARGEST_IN_METRES:
            yield f"lens.outline.{name}: {size:g} mm; {question}"
        elif 0 < self.z <= FARTHEST_IN_METRES and self.z - lens.back.z < across / 4:
            yield f"target.z: {self.z:g} mm; {question}"
        elif self.unit == "mm" and widest < min(across / MAX_REDUCTION, FARTHEST_IN_METRES):
            yield f"target.x: {self.size[0]:g} mm wide; {question}"

    def remarks(self) -> tuple[str, ...]:
        """Return a sentence on each change of the picture that the scene does not state."""
        return drawing(self).remarks


class AngularTarget(Target):
    """The radiant intensity over a rectangle of two angles; for a file, row 0 of the picture is y max as on a plane."""

    kind: Annotated[  # type: ignore[assignment]  # each kind of target has a tag of its own
        Literal["intensity"], Key("Radiant intensity over directions, x and y in degrees.")
    ]
    z: Annotated[float, Key("Not used: directions have no position.", "mm", *COORDINATES)] = FAR_Z
    x: Annotated[
        tuple[float, float],
        Key("Ends of the target along x, as angles.", "degrees", -180.0, 180.0, example=[-30.0, 30.0]),
    ]
    y: Annotated[
        tuple[float, float],
        Key("Ends of the target along y, as angles.", "degrees", -180.0, 180.0, example=[-30.0, 30.0]),
    ]
    angles: Annotated[
        Angles,
        Key(
            "Coordinates: C angle from the axis, A horizontal angle and elevation, B angles to the side and upwards.",
            example="A",
        ),
    ] = "C"
    intensity: Annotated[
        Annotated[
            IntensityFile,
            *from_file(IntensityFile, partial(read_intensity, prefix="wanted-"), "intensity = 'wanted.ldt'"),
        ]
        | None,
        Key("Intensity to be reached, from a file (.ies, .ldt, .csv).", example="wanted.ldt"),
    ] = None

    outline: Annotated[Outlined | None, Key("Outline in angles; the picture is dark outside.")] = None
    profile: Annotated[
        Profile | None, Key("Intensity of this shape, its lengths in degrees, instead of a picture.")
    ] = None

    written = leaving_out(z=FAR_Z, weight=1.0)
    picture_keys = PICTURE_KEYS

    @property
    def screen(self) -> Screen:
        """The receiver with its pixels."""
        return Screen(0.0, self.x, self.y, self.columns_rows, surface=Directions(self.angles))

    def complaints(self) -> Iterator[str]:
        """Yield the faults of the table, each as "key: sentence"."""
        for key, given in (("z", self.z != FAR_Z), ("tilt", self.tilt is not None)):
            if given:
                yield f"target.{key}: directions have no {'position' if key == 'z' else key}; remove this key"
        changed = {
            "seen_from": self.seen_from != "lens",
            "rotate": self.rotate != 0,
            "mirror": self.mirror,
            "invert": self.invert,
        }
        for key in changed if self.intensity is not None else ():
            if changed[key]:
                yield f"target.{key}: the file of an intensity has an orientation of its own; remove this key"
        if self.angles == "C" and math.hypot(*(max(map(abs, ends)) for ends in (self.x, self.y))) > HALF_TURN:
            yield f"target.x: a corner of the target is more than {HALF_TURN:g} degrees from the axis; make it smaller"
        limits = {"C": (180.0, 180.0), "A": (180.0, 90.0), "B": (90.0, 180.0)}[self.angles]
        for axis, ends, limit in zip("xy", (self.x, self.y), limits, strict=True):
            if max(map(abs, ends)) > limit:
                yield f"target.{axis}: an angle is beyond {limit:g} degrees; make the target smaller"
        yield from super().complaints()

    def behind(self, lens: LensBlank) -> Iterator[str]:
        """Yield nothing: directions have no position."""
        yield from ()

    def metres(self, lens: LensBlank) -> Iterator[str]:
        """Yield nothing: angles are no lengths."""
        yield from ()

    def unfaced(self, lens: LensBlank) -> Iterator[str]:
        """Yield nothing: every lens faces all directions."""
        yield from ()

    def light_of_file(self, cells: int = 1) -> np.ndarray:
        """Return the means of the file's intensity over cells (rows, columns); row 0 is y max, column 0 is x min.

        cells: number of cells along each side of a pixel.  The means are those of samples, SAMPLES_PER_PIXEL or more
        along each side of a pixel.
        """
        assert self.intensity is not None
        (left, right), (low, high) = self.x, self.y
        parts = math.ceil(SAMPLES_PER_PIXEL / cells)  # samples along each side of a cell
        columns, rows = (n * cells * parts for n in self.columns_rows)
        x = left + (np.arange(columns) + 0.5) * (right - left) / columns
        y = high - (np.arange(rows) + 0.5) * (high - low) / rows
        values = self.intensity.table.at(*Directions(self.angles).direction(*np.meshgrid(x, y)))
        return values.reshape(rows // parts, parts, columns // parts, parts).mean((1, 3))


def is_faced(plane: PlaneReceiver, vertex: Vector) -> bool:
    """Return True if the line from `vertex` (mm) to the plane's middle meets its front at more than 1° (EDGE_ON)."""
    return -plane.height(vertex) > EDGE_ON * math.dist(plane.middle, vertex)


@dataclass(frozen=True)
class Drawing:
    """A target's picture as a viewer at target.seen_from sees it."""

    light: np.ndarray  # irradiance, (rows, columns), on any scale
    remarks: tuple[str, ...] = ()  # sentences on changes of the picture


# ---- several targets -------------------------------------------------------------------------------------------------


def with_distinct_names(given: Target | tuple[Target, ...]) -> tuple[Target, ...]:
    """Return all targets of a scene, with a different file name for each image, since the copies are in one folder."""
    images: dict[str, bytes] = {}  # contents by name in lower case, as a file system may compare names

    def distinct(image: Picture) -> Picture:
        return next(one for one in _numbered(image) if images.setdefault(one.name.casefold(), one.data) == image.data)

    def own(target: Target) -> Target:
        image = target.image and distinct(target.image)
        return target if image == target.image else target.model_copy(update={"image": image})

    return tuple(map(own, given if isinstance(given, tuple) else (given,)))


def _numbered(image: Picture) -> Iterator[Picture]:
    """Yield the image with its own name, photo.jpg, then with photo-2.jpg and so on."""
    yield image
    stem, _, kind = image.name.rpartition(".")
    yield from (replace(image, name=f"{stem[:70]}-{k}.{kind}") for k in range(2, 2 + MAX_TARGETS))


def numbered(name: str, k: int) -> str:
    """Return the name of an array of design.npz or of a figure for target[k]: name, name_2, name_3, …"""
    return name if k == 0 else f"{name}_{k + 1}"


def coplanar_complaints(targets: tuple[Target, ...]) -> Iterator[str]:
    """Yield complaints about targets that lie in the plane of an earlier target or cross it."""
    for k, target in enumerate(targets):
        for i, earlier in enumerate(targets[:k]):
            if _in_one_plane(target.screen, earlier.screen):
                plane = f"the target is in the plane of target[{i}]"
                yield f"target[{k}].z: {plane}; move one of them along z, or combine both pictures in one"
            elif _cuts(target.screen, earlier.screen) and _cuts(earlier.screen, target.screen):
                yield f"target[{k}].z: the target cuts target[{i}]; move one of them along z, or tilt one of them less"


def _in_one_plane(one: Screen, other: Screen) -> bool:
    """Return True if the corners of each screen are in the other's plane; receivers other than planes must be equal."""
    heights = _corner_heights(one, other) + _corner_heights(other, one)
    return max(map(abs, heights)) < PLANE_DISTANCE if heights else one.receiver == other.receiver


def _cuts(screen: Screen, other: Screen) -> bool:
    """Return True if the screen has corners on each side of the other's plane."""
    heights = _corner_heights(screen, other)
    return bool(heights) and min(heights) < 0 < max(heights)


def _corner_heights(screen: Screen, other: Screen) -> list[float]:
    """Return the heights (mm) of the screen's corners above the other's plane; none if a receiver is not a plane."""
    receiver, own = other.receiver, screen.receiver
    if not (isinstance(receiver, PlaneReceiver) and isinstance(own, PlaneReceiver)):
        return []
    return [receiver.height(own.point(x, y)) for x in screen.x for y in screen.y]


def kind(given: Any) -> str:
    """Return the record of a target's table, or of a record, by its kind; an unknown kind is returned itself."""
    named = given.get("kind", "plane") if isinstance(given, dict) else getattr(given, "kind", "plane")
    return {"plane": "Target", "intensity": "AngularTarget"}.get(named, str(named))


if TYPE_CHECKING:
    Targets: TypeAlias = tuple[Target, ...]
else:
    OneTarget = Annotated[
        Annotated[Target, Tag("Target")] | Annotated[AngularTarget, Tag("AngularTarget")],
        Discriminator(kind),
    ]
    Targets = Annotated[  # one table of a file, or a list of them; validated to a tuple
        Annotated[OneTarget, Tag("table")]
        | Annotated[tuple[OneTarget, ...], Tag("list"), Field(min_length=1, max_length=MAX_TARGETS)],
        Discriminator(lambda given: "list" if isinstance(given, list | tuple) else "table"),
        AfterValidator(with_distinct_names),
    ]


# ---- the drawn picture -----------------------------------------------------------------------------------------------


# Keys that do not change the drawing, with the values that all targets have in the cache.
IRRELEVANT = {"z": 0.0, "tilt": None, "weight": 1.0, "outline": None, "seen_from": "lens", "unreachable": "dark"}


def drawing(target: Target, cells: int = 1) -> Drawing:
    """Return the irradiance of a target's picture in each cell, not yet cut to its outline, and remarks on it.

    cells: number of cells along each side of a pixel.
    """
    alike = target.model_copy(update=IRRELEVANT)
    return _drawing(alike) if cells == 1 else _draw(alike, cells)


@functools.lru_cache(maxsize=4)  # a photograph takes half a second, and is needed for the check and for the design
def _drawing(target: Target) -> Drawing:
    return _draw(target, 1)


@functools.lru_cache(maxsize=4)  # 34 MB for 2048 cells per side; the rounds of a design and its proof need two sizes
def _flux_on_cells(target: Target, cells: int) -> np.ndarray:
    return np.asfortranarray(target._drawn_flux(cells))  # stored by columns, as `tubes.collect` makes pictures


def _draw(target: Target, cells: int) -> Drawing:
    if cells > 1 and target.photo is not None:
        whole = _drawing(target)
        return replace(whole, light=cells**2 * interpolated(whole.light, cells))
    columns, rows = (n * cells for n in target.columns_rows)
    pixels, size, remarks = (columns, rows), target.size, [""]
    if target.rotate in (90, 270):  # the light is rotated at the end
        pixels, size = pixels[::-1], size[::-1]
    if target.text is not None:
        ink = _ink(target.text, pixels, size)
        light = 1.0 - ink if target.invert else ink
    elif (given := target.photo) is not None:
        with picture.decoding(given):
            light, remarks = _photo_light(target, given, pixels, size)
    elif target.profile is not None:
        light = target.profile.light(pixels, size)
    elif isinstance(target, AngularTarget) and target.intensity is not None:
        light = target.light_of_file(cells)[:, ::-1]  # columns in the order that a viewer at the lens sees
    else:
        light = np.ones(pixels[::-1])
    light = np.rot90(light, target.rotate // 90)
    return Drawing(light[:, ::-1] if target.mirror else light, tuple(filter(None, remarks)))


def _photo_light(target: Target, given: Picture | str, pixels: Pixels, size: Size) -> tuple[np.ndarray, list[str]]:
    """Return the irradiance (rows, columns) of photo `given` over `pixels`, before the rotation, and remarks on it."""
    photo = picture.photo(given, target.gamma, target.invert)
    if target.crop is not None:
        photo = photo.part(crop_box(photo.image.size, target.crop))
    is_logo, transparent = photo.transparency()
    part = window(shown := photo.image.size, size, target.fit)
    light = average(photo.silhouette if is_logo else photo.light, shown, part, pixels)
    several = "target.image: the file has several pictures; the first one is used" if photo.several else ""
    assumed = "" if is_logo else _curve_remark(photo, light, part, pixels)
    return light, [several, transparent, assumed, _fit_remark(target.as_rotated(shown), target)]


def _curve_remark(photo: picture.Photo, light: np.ndarray, part: Window, pixels: Pixels) -> str:
    """Return a remark on the assumed curve if the other curve changes the light by an RRMSD > NOTICEABLE; else ""."""
    if photo.other_curve is None:
        return ""
    other = average(replace(photo, curve=photo.other_curve).light, photo.image.size, part, pixels)
    if not (light.sum() > 0 and other.sum() > 0):
        return ""
    rrmsd = float(np.linalg.norm(other * (light.sum() / other.sum()) - light) / np.linalg.norm(light))
    remark = f"target.image: the file has {photo.assumed} (RRMSD between both readings: {rrmsd:.2g})"
    return remark if rrmsd > NOTICEABLE else ""


def _ink(text: str, pixels: Pixels, size: Size) -> np.ndarray:
    """Return the fraction of ink per pixel (rows, columns) of a text, centred in an area of `size` (width, height).

    A text is always drawn with TEXT_SAMPLES, so that means over pixels are the means of their cells: a font draws
    letters of another size with slightly other proportions (RRMSD 0.03 of 512 pixels).
    """
    aspect = size[0] / size[1]
    width, height = (max(round(TEXT_SAMPLES * min(part, 1.0)), 16) for part in (aspect, 1 / aspect))
    image = _letters(text, width, height)
    whole = (0.0, 0.0, width, height)
    return average(lambda box: np.asarray(image.crop(box)) / 255.0, image.size, whole, pixels)


_letters = functools.lru_cache(maxsize=1)(picture.letters)  # 16 MB; drawn once for pixels and cells


# ---- fit of a picture to the target ----------------------------------------------------------------------------------


def crop_box(shown: Pixels, crop: Crop | None) -> PixelBox:
    """Return the pixels (left, top, right, bottom) of the cropped part of a picture (width, height), at least one."""
    if crop is None:
        return 0, 0, *shown
    left, top = (min(round(start * side), side - 1) for start, side in zip(crop[:2], shown, strict=True))
    right, bottom = (round(stop * side) for stop, side in zip(crop[2:], shown, strict=True))
    return left, top, max(right, left + 1), max(bottom, top + 1)


def shown_size(target: Target) -> Pixels | None:
    """Return width and height (pixels) of a target's photo, cropped and rotated; None if it has no photo."""
    if target.photo is None:
        return None
    left, top, right, bottom = crop_box(picture.photo_size(target.photo), target.crop)
    return target.as_rotated((right - left, bottom - top))


Window = tuple[float, float, float, float]  # left, top, right, bottom in pixels of a picture; may extend outside it


def window(shown: Pixels, size: Size, fit: str) -> Window:
    """Return the part of a picture (width, height in pixels) that fills a target of this size (width, height).

    fit "stretch" returns the whole picture, "crop" its central part; "pad" extends outside it.  A difference below one
    pixel is ignored.
    """
    width, height = shown
    across, down = height * size[0] / size[1], width * size[1] / size[0]
    wide = width >= across  # True if the picture is wider than the target, in proportion
    if fit == "stretch" or abs(width - across if wide else height - down) < 1:
        return 0.0, 0.0, width, height
    if wide == (fit == "crop"):
        return (width - across) / 2, 0.0, (width + across) / 2, height
    return 0.0, (height - down) / 2, width, (height + down) / 2


def _fit_remark(shown: Pixels, target: Target) -> str:
    """Return a remark on the fit of a picture to a target; "" if the proportions agree."""
    (width, height), size, fit = shown, target.size, target.fit
    left, top, right, bottom = window(shown, size, fit)
    form = "square" if size[0] == size[1] else f"{size[0]:g} x {size[1]:g} {target.unit}"
    stretched = (width * size[1]) / (height * size[0])
    if (right - left, bottom - top) != shown and fit == "pad":
        done = 'shown whole, with dark strips beside it; fit = "crop" fills the target'
    elif (right - left, bottom - top) != shown:
        done = f'cropped to the central {right - left:.0f} x {bottom - top:.0f} pixels; fit = "pad" shows it whole'
    elif fit == "stretch" and abs(stretched - 1) * max(width, height) >= 1:
        along, percent = "upwards" if stretched > 1 else "sideways", 100 * (max(stretched, 1 / stretched) - 1)
        done = f'stretched {along} by {percent:.2g} %; fit = "crop" keeps its proportions'
    else:
        return ""
    return f"target.fit: the target is {form}, so the picture of {width} x {height} is {done}"


def average(light: Callable[[PixelBox], np.ndarray], size: Pixels, window: Window, pixels: Pixels) -> np.ndarray:
    """Return the exact means (rows, columns) of a picture, dark outside its edges, over the pixels of a window.

    light: function that returns the values in a box.  size: of the picture, read in strips.  pixels: of the window.
    """
    left, top = (max(int(start), 0) for start in window[:2])
    right, bottom = (min(math.ceil(stop), side) for stop, side in zip(window[2:], size, strict=True))
    across = overlap(right - left, pixels[0], window[0] - left, window[2] - left)
    down = overlap(bottom - top, pixels[1], window[1] - top, window[3] - top)
    parts = (light(box) for box in strips((left, top, right, bottom)))
    return down @ np.concatenate([(across @ part.T).T for part in parts])


@functools.lru_cache(maxsize=4)  # 30 ms a call; each change of a scene, its check and its design draw the same outline
def inside(outline: Outline, pixels: Pixels, size: Size) -> np.ndarray:
    """Return the fraction of each pixel (rows, columns) of a rectangle of this size inside an outline centred in it.

    The array is shared: nobody may write to it.
    """
    columns, rows = pixels
    fine = max(2048 // max(pixels), 4)  # sub-pixels along the side of a pixel
    x, y = (
        ((torch.arange(n * fine, dtype=torch.float64) + 0.5) / (n * fine) - 0.5) * along
        for n, along in ((columns, size[0]), (rows, -size[1]))
    )
    high = fine * max(2**20 // (columns * fine * fine), 1)  # about a million sub-pixels at a time
    bands = (outline.contains(x, band[:, None]).numpy() for band in y.split(high))
    found = np.concatenate([band.reshape(-1, fine, columns, fine).mean((1, 3)) for band in bands])
    found.flags.writeable = False
    return found
