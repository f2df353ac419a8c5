"""The target: its picture, where it lies, how the picture fills it, and how it is seen.

Row 0 of an array is the top, column 0 the left, as a person sees it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag
from scipy.sparse import csr_array

from bstcad.optics.irradiance import Screen
from bstcad.optics.key import Key
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import Vector
from bstcad.optics.receivers import Receiver
from bstcad.scene import picture
from bstcad.scene.blank import LensBlank, Outlined
from bstcad.scene.dotted_keys import PICTURES
from bstcad.scene.errors import SceneError
from bstcad.scene.picture import Box, strips
from bstcad.scene.profile import Profile
from bstcad.scene.schema import COORDINATES, OneOrTwo, Record, from_file, leaving_out

FEWEST = 8  # pixels along a side, unless asked for fewer (which the range of `pixels` refuses)
NARROWEST = 1e-3  # mm, or another unit of the target; a target's side, as an outline's
WITHOUT_GAMMA = ("text", "uniform", "profile")
MOST = 8  # targets of a scene
SEEN = 0.01  # RRMSD between two readings of a picture, from which on it is said which was taken
NEAREST = 1e-3  # mm; planes of two targets that are nearer to each other are one
TINY, FAR = 0.5, 10.0  # mm; in metres no lens is wider than the one, no target further than the other
NARROW = 20.0  # times narrower than the lens: the light of a lens is seldom gathered so far
EDGE_ON = math.sin(math.radians(1.0))  # sine of the angle to a target's plane, below which it has no picture
GRAZED = 8.0  # degrees; a plane seen under less is hardly lit by a lamp (at 10: RRMSD 0.33, at 5: 1.6, at 30: 0.07)
WAYS = {1: "+z", -1: "-z"}


PictureFile = Annotated[
    from_file(picture.Picture, picture.read_picture, "image = 'photo.png'"),
    BeforeValidator(lambda given: picture.from_array(given) if isinstance(given, np.ndarray) else given),
]
Tilt = Annotated[tuple[float, float] | None, AfterValidator(lambda tilt: tilt if tilt and any(tilt) else None)]


# Advice on a wall that the axis runs along, or nearly so.
AIM = (
    "to light a wall beside the lamp, turn the lamp towards its middle: target.z is then the distance to there, and "
    "target.tilt the angle that is left, such as [60.0, 0.0]"
)


class Target(Record):
    """The picture on the plane z, or on one that is turned about its middle, over the rectangle x by y."""

    z: Annotated[float, Key("Plane of the target, or its middle if tilted.", "mm", *COORDINATES, example=1000.0)]
    x: Annotated[tuple[float, float], Key("Ends of the target along x.", "mm", *COORDINATES, example=[-200.0, 200.0])]
    y: Annotated[tuple[float, float], Key("Ends of the target along y.", "mm", *COORDINATES, example=[-200.0, 200.0])]
    tilt: Annotated[Tilt, Key("Tilt about x, then about y.", "degrees", -89.0, 89.0, remedy=AIM)] = None
    pixels: Annotated[OneOrTwo, Key("Pixels along the longer side, or [columns, rows].", "", FEWEST, 4096, example=512)]
    text: Annotated[
        str | None, Key("The picture as letters, centred, over 84 % of the width or 80 % of the height.")
    ] = None
    image: Annotated[
        PictureFile | None, Key("The picture as a file, relative to the scene file.", example="photo.jpg")
    ] = None
    sample: Annotated[Literal[picture.SAMPLES] | None, Key("The picture as one of scikit-image's.")] = None
    uniform: Annotated[Literal[True] | None, Key("No picture: the same irradiance everywhere.")] = None
    profile: Annotated[
        Profile | None, Key("No picture: a shape of light.", example={"shape": "disc", "radius": 6.0})
    ] = None
    gamma: Annotated[
        float | None, Key("Irradiance = number ^ gamma; the file's own if absent.", "", 0.1, 10.0, example=1.0)
    ] = None
    invert: Annotated[bool, Key("Dark for light.", example=True)] = False
    seen_from: Annotated[Literal["lens", "behind"], Key("Side from which the picture is unmirrored.")] = "lens"
    rotate: Annotated[Literal[0, 90, 180, 270], Key("Turn counterclockwise.", "degrees")] = 0
    mirror: Annotated[bool, Key("Left for right, after the turn.")] = False
    fit: Annotated[Literal["crop", "pad", "stretch"], Key("Fit of a picture of other proportions.", example="pad")] = (
        "crop"
    )
    crop: Annotated[
        tuple[float, float, float, float] | None,
        Key(
            "Part of the picture that is shown, [left, top, right, bottom] in parts of its width and height.", "",
            0.0, 1.0, example=[0.1, 0.0, 0.9, 1.0],
        ),
    ] = None  # fmt: skip
    outline: Annotated[Outlined | None, Key("Light falls only inside this outline, which is centred.")] = None
    unreachable: Annotated[
        Literal["dark", "refuse"], Key("What light cannot reach stays dark, or the scene is refused.", example="refuse")
    ] = "dark"
    weight: Annotated[float, Key("Weight of its squared error among all goals.", "", 1e-6, 1e6, example=2.0)] = 1.0

    written = leaving_out(weight=1.0)

    def complaints(self) -> Iterator[str]:
        """Everything that is wrong with the table by itself."""
        given = self._pictures
        if len(given) != 1:
            names = " and ".join(given) or "none"
            yield f"target: needs exactly one of {', '.join(PICTURES)}, but has {names}; keep or add one"
        for axis, (low, high) in (("x", self.x), ("y", self.y)):
            if not low < high:
                yield f"target.{axis}: [{low:g}, {high:g}] is no interval; write the smaller end first"
            if high - low < NARROWEST:
                yield f"target.{axis}: is narrower than {NARROWEST:g} {self.unit}; move its ends apart"
        if self.text is not None and not (self.text.strip() and len(self.text) <= 100):
            yield 'target.text: must have 1 to 100 letters; give for example text = "THU"'
        if self.gamma is not None and given[0] in WITHOUT_GAMMA:
            yield "target.gamma: only an image or a sample has a gamma; remove it"
        if self.crop is not None:
            left, top, right, bottom = self.crop
            if given[0] in WITHOUT_GAMMA:
                yield "target.crop: only an image or a sample has parts; remove it"
            if not (left < right and top < bottom):
                ends = ", ".join(f"{end:g}" for end in self.crop)
                yield f"target.crop: [{ends}] is no part; write left, top, right and bottom, such as [0.1, 0, 0.9, 1]"
        if self.invert and self.uniform:
            yield "target.invert: a uniform target inverted is dark; remove one of the two"
        if self.invert and self.profile:
            yield "target.invert: a profile has no dark and light to change; remove one of the two"
        yield from self._of_profile() if self.profile else ()
        for axis, half, size in zip("xy", self.outline.half_extent if self.outline else (), self.size, strict=False):
            if 2 * half > size:
                yield f"target.outline: is larger than the target along {axis}; make it smaller or widen {axis}"

    def _of_profile(self) -> Iterator[str]:
        """A profile that is larger than the target as it lies, or narrower than a pixel."""
        pixel = (side / n for side, n in zip(self.size, self.columns_rows, strict=True))
        for axis, along, size, least in zip("xy", self._half_profile, self.size, pixel, strict=True):
            if 2 * along > size:
                yield f"target.profile: is larger than the target along {axis}; make it smaller or widen {axis}"
            if along < least:
                fine = f"reaches {along:g} {self.unit} from the middle along {axis}, less than a pixel of {least:.3g}"
                yield f"target.profile: {fine} {self.unit}; make it larger, or ask for more pixels"

    @property
    def _half_profile(self) -> tuple[float, float]:
        """Half the width and height of the profile as it lies, in `unit`."""
        along_x, along_y = self.profile.half_extent
        return (along_y, along_x) if self.rotate in (90, 270) else (along_x, along_y)

    @property
    def _pictures(self) -> list[str]:
        return [name for name in PICTURES if getattr(self, name) is not None]

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, in `unit`."""
        return self.x[1] - self.x[0], self.y[1] - self.y[0]

    @property
    def unit(self) -> str:
        """Unit of x and y, by the receiver."""
        return self.screen.plane.unit

    @property
    def columns_rows(self) -> tuple[int, int]:
        """Pixels along x and along y; FEWEST at least, however narrow the target."""
        if not isinstance(self.pixels, int):
            return self.pixels
        longer = max(self.size)
        return tuple(max(round(self.pixels * side / longer), min(self.pixels, FEWEST)) for side in self.size)

    def fewer_pixels(self, factor: float) -> tuple[int, int]:
        """Columns and rows over a factor: FEWEST at least, and so many that half a profile is no less than a pixel."""
        least = (FEWEST, FEWEST)
        if self.profile is not None:
            sides = zip(self.size, self._half_profile, strict=True)
            least = tuple(max(FEWEST, math.ceil(size / half)) for size, half in sides)
        counts = zip(self.columns_rows, least, strict=True)
        return tuple(min(max(round(n / factor), fewest), max(n, FEWEST)) for n, fewest in counts)

    @property
    def screen(self) -> Screen:
        """The pixels that light falls into."""
        return Screen(self.z, self.x, self.y, self.columns_rows, tilt=self.tilt)

    def irradiance(self) -> np.ndarray:
        """Flux wanted in each pixel, (rows, columns) float64 of sum 1; row 0 = y max, column 0 = x min.

        From the lens, along +z with y up, x grows to the left: there the picture's left column is that of x max.
        """
        seen = drawing(self).light
        flux = seen[:, ::-1] if self.seen_from == "lens" else seen
        if self.outline is not None:
            flux = flux * inside(self.outline, self.columns_rows, self.size)
        if (areas := self.screen.areas) is not None:  # the picture is irradiance
            flux = flux * areas
        total = flux.sum()
        if not total > 0:
            raise SceneError(f"target.{self._pictures[0]}: the picture is all black; give one with some light in it")
        return flux / total

    # ---- its place: complaints, by the receiver that it lies on ----

    def behind(self, lens: LensBlank) -> Iterator[str]:
        """Complain of a target that does not follow the lens along z."""
        if not self.z > (back := lens.back.z):
            place = "behind the lens, whose back" if lens.passes.sense > 0 else "above the mirror, whose face"
            yield f"target.z: the target at z = {self.z:g} is not {place} is at z = {back:g}; move it further along +z"

    def follows(self, words: str, z: float, sense: int) -> Iterator[str]:
        """Complain of a target that does not follow the last element that light meets, at z, along sense · z."""
        if not sense * (self.z - z) > 0:
            where = f"the target at z = {self.z:g} does not follow the {words} at z = {z:g}"
            yield f"target.z: {where} along {WAYS[sense]}, as the light goes; move one of them"

    def clearance(self, lens: LensBlank, highest: float) -> float:
        """Return how far (mm) it passes a lens that reaches up to z = highest (mm); negative: it cuts the lens."""
        return self.screen.plane.clearance(lens.outline, highest)

    def grazed(self, lens: LensBlank) -> Iterator[str]:
        """Doubt a tilted target along which the light of a lamp runs."""
        plane, vertex = self.screen.plane, (0.0, 0.0, lens.back.z)
        if plane.tilt is None:
            return
        sine = -plane.height(vertex) / math.dist(plane.middle, vertex)  # apart, since no target cuts the lens
        if sine < math.sin(math.radians(GRAZED)):
            angle = math.degrees(math.asin(max(sine, -1.0)))
            yield (
                f"target.tilt: seen from the {lens.optic}, the target is {angle:.2g} degrees from edge-on, and hardly "
                f"any {lens.optic} makes a picture there; {AIM}"
            )

    def unfaced(self, lens: LensBlank) -> Iterator[str]:
        """Complain of a target that does not face the lens, cuts it, or comes down to it."""
        screen, plane, back, optic = self.screen, self.screen.plane, lens.back.z, lens.optic
        if plane.is_level:
            return
        key = "target.z" if plane.tilt is None else "target.tilt"
        if plane.tilt is not None and not is_faced(plane, (0.0, 0.0, back)):
            yield f"{key}: the target plane is edge-on to the {optic}, or shows it its rear; turn it less, or move it"
        if not self.clearance(lens, back) > 0:
            less = "" if plane.tilt is None else "turn it less, or "
            yield f"{key}: the target plane cuts into the {optic}; {less}move the target further along +z"
        if plane.tilt is None:
            return
        lowest = min(plane.point(x, y)[2] for x in screen.x for y in screen.y)
        if not lowest > back:
            edge = f"comes down to z = {lowest:.6g}, not beyond the {optic}, whose back is at z = {back:g}"
            yield f"{key}: an edge of the target {edge}; turn it less, make it smaller or move it along +z"

    def metres(self, lens: LensBlank) -> Iterator[str]:
        """Ask where lengths look as if they were in metres."""
        outline, widest = lens.outline, max(self.size)
        name, size = ("radius", outline.radius) if outline.is_round else ("width", outline.width)
        across, question = 2 * max(outline.half_extent), "are these metres? lengths are in mm"
        if across < TINY:
            yield f"lens.outline.{name}: {size:g} mm; {question}"
        elif 0 < self.z <= FAR and self.z - lens.back.z < across / 4:
            yield f"target.z: {self.z:g} mm; {question}"
        elif self.unit == "mm" and widest < min(across / NARROW, FAR):
            yield f"target.x: {self.size[0]:g} mm wide; {question}"

    def remarks(self) -> tuple[str, ...]:
        """A sentence on each thing that happens to the picture and that the scene does not ask for."""
        return drawing(self).remarks


def is_faced(plane: Receiver, vertex: Vector) -> bool:
    """Is a plane seen from a point at more than EDGE_ON from its edge, and from its front?"""
    return -plane.height(vertex) > EDGE_ON * math.dist(plane.middle, vertex)


@dataclass(frozen=True)
class Drawing:
    """A target's picture as a person sees it who stands where target.seen_from says."""

    light: np.ndarray  # (rows, columns), on any scale
    remarks: tuple[str, ...] = ()


# ---- several ---------------------------------------------------------------------------------------------------------


def distinct(given: Target | tuple[Target, ...]) -> tuple[Target, ...]:
    """All targets of a scene, none of whose images has the name of another image: copies lie in one folder."""
    images: dict[str, bytes] = {}  # by name, as a file system may compare names

    def named(image: picture.Picture) -> picture.Picture:
        return next(one for one in _numbered(image) if images.setdefault(one.name.casefold(), one.data) == image.data)

    def own(target: Target) -> Target:
        image = target.image and named(target.image)
        return target if image == target.image else target.model_copy(update={"image": image})

    return tuple(map(own, given if isinstance(given, tuple) else (given,)))


def _numbered(image: picture.Picture) -> Iterator[picture.Picture]:
    """The image by its own name, photo.jpg, and by photo-2.jpg and so on."""
    yield image
    stem, _, kind = image.name.rpartition(".")
    yield from (replace(image, name=f"{stem[:70]}-{k}.{kind}") for k in range(2, 2 + MOST))


def numbered(name: str, k: int) -> str:
    """An array of design.npz or a figure of target[k]: name for the first of several, name_2 for the second."""
    return name if k == 0 else f"{name}_{k + 1}"


def coplanar(targets: tuple[Target, ...]) -> Iterator[str]:
    """Targets in the plane of an earlier one, or that cut through it."""
    for k, target in enumerate(targets):
        for i, earlier in enumerate(targets[:k]):
            if _in_one_plane(target.screen, earlier.screen):
                yield (
                    f"target[{k}].z: lies in the plane of target[{i}]; move one of them along z, or put what both "
                    "show into one picture"
                )
            elif _cuts(target.screen, earlier.screen) and _cuts(earlier.screen, target.screen):
                yield f"target[{k}].z: cuts through target[{i}]; move one of them along z, or turn it less"


def _in_one_plane(one: Screen, other: Screen) -> bool:
    """Do the corners of each lie in the other's plane?  Receivers of another form are one if they are equal."""
    if one.plane.frame is None or other.plane.frame is None:
        return one.plane == other.plane
    return max(map(abs, (*_off(one, other), *_off(other, one)))) < NEAREST


def _cuts(screen: Screen, other: Screen) -> bool:
    """Do its corners lie on both sides of the other's plane?"""
    if screen.plane.frame is None or other.plane.frame is None:
        return False
    off = _off(screen, other)
    return min(off) < 0 < max(off)


def _off(screen: Screen, other: Screen) -> list[float]:
    """How far (mm) its corners lie before the other's plane."""
    return [other.plane.height(screen.plane.point(x, y)) for x in screen.x for y in screen.y]


Targets = Annotated[  # of a file: one table, or a list of them
    Annotated[Target, Tag("table")] | Annotated[tuple[Target, ...], Tag("list"), Field(min_length=1, max_length=MOST)],
    Discriminator(lambda given: "list" if isinstance(given, list | tuple) else "table"),
    AfterValidator(distinct),
]


# ---- what is drawn ---------------------------------------------------------------------------------------------------


ELSEWHERE = {"z": 0.0, "tilt": None, "weight": 1.0, "outline": None, "seen_from": "lens", "unreachable": "dark"}


def drawing(target: Target) -> Drawing:
    """The light of a target's picture in each pixel, before its outline, and remarks on that."""
    return _drawing(target.model_copy(update=ELSEWHERE))  # the same wherever it falls


@functools.lru_cache(maxsize=4)  # a photograph takes half a second, and is asked for when it is read and when used
def _drawing(target: Target) -> Drawing:
    pixels, size, remarks = target.columns_rows, target.size, ()
    if lies := target.rotate in (90, 270):  # the light is turned once it is made
        pixels, size = pixels[::-1], size[::-1]
    if target.text is not None:
        ink = _ink(target.text, pixels, size)
        light = 1.0 - ink if target.invert else ink
    elif target.uniform:
        light = np.ones(pixels[::-1])
    elif target.profile is not None:
        light = target.profile.light(pixels, size)
    else:
        given = target.sample if target.image is None else target.image
        with picture.decoding(getattr(given, "name", given)):
            photo = picture.photo(given, target.gamma, target.invert)
            if target.crop is not None:
                photo = photo.part(cropped(photo.image.size, target.crop))
            is_logo, transparent = photo.transparency()
            part = window(shown := photo.image.size, size, target.fit)
            light = average(photo.silhouette if is_logo else photo.light, shown, part, pixels)
            assumed = "" if is_logo else _assumed(photo, light, part, pixels)
        remarks = (
            "target.image: the file holds several pictures; the first is taken" if photo.several else "",
            transparent,
            assumed,
            _fitted(shown[::-1] if lies else shown, target),
        )
    light = np.rot90(light, target.rotate // 90)
    return Drawing(light[:, ::-1] if target.mirror else light, tuple(filter(None, remarks)))


def _assumed(photo: picture.Photo, light: np.ndarray, part: Window, pixels: tuple[int, int]) -> str:
    """A remark on the curve of a file that states none, if the other one changes the light by more than SEEN; or ""."""
    if photo.other_curve is None:
        return ""
    other = average(replace(photo, curve=photo.other_curve).light, photo.image.size, part, pixels)
    if not (light.sum() > 0 and other.sum() > 0):
        return ""
    off = float(np.linalg.norm(other * (light.sum() / other.sum()) - light) / np.linalg.norm(light))
    return f"target.image: the file has {photo.assumed} (an RRMSD of {off:.2g} apart)" if off > SEEN else ""


def _ink(text: str, pixels: tuple[int, int], size: tuple[float, float]) -> np.ndarray:
    """(rows, columns) share of ink of a text over a size (width, height)."""
    aspect, side = size[0] / size[1], min(4 * max(pixels), 4096)  # drawn finer, then averaged: smooth rims
    width, height = max(round(side * min(aspect, 1.0)), 16), max(round(side * min(1 / aspect, 1.0)), 16)
    image = picture.letters(text, width, height)
    whole = (0.0, 0.0, width, height)
    return average(lambda box: np.asarray(image.crop(box)) / 255.0, image.size, whole, pixels)


# ---- how a picture fills the target ----------------------------------------------------------------------------------


def cropped(shown: tuple[int, int], crop: tuple[float, float, float, float] | None) -> Box:
    """Return the whole pixels (left, top, right, bottom) of a part of a picture (width, height), one at least."""
    if crop is None:
        return 0, 0, *shown
    left, top = (min(round(start * most), most - 1) for start, most in zip(crop[:2], shown, strict=True))
    right, bottom = (round(stop * most) for stop, most in zip(crop[2:], shown, strict=True))
    return left, top, max(right, left + 1), max(bottom, top + 1)


def shown_size(target: Target) -> tuple[int, int] | None:
    """Return width and height (pixels) of a target's photo as it is shown, cropped and turned; None: it has none."""
    given = target.sample if target.image is None else target.image
    if given is None:
        return None
    left, top, right, bottom = cropped(picture.photo_size(given), target.crop)
    width, height = right - left, bottom - top
    return (height, width) if target.rotate in (90, 270) else (width, height)


Window = tuple[float, float, float, float]  # a part of a picture in its pixels, as a Box; it may reach beyond


def window(shown: tuple[int, int], size: tuple[float, float], fit: str) -> Window:
    """The part of a picture (width, height in pixels) that fills a target of a size: its middle, or more than all.

    Less than a pixel in excess is no other proportion.
    """
    width, height = shown
    across, down = height * size[0] / size[1], width * size[1] / size[0]
    wide = width >= across  # for the target; then the height is `across` targets wide
    if fit == "stretch" or abs(width - across if wide else height - down) < 1:
        return 0.0, 0.0, width, height
    if wide == (fit == "crop"):
        return (width - across) / 2, 0.0, (width + across) / 2, height
    return 0.0, (height - down) / 2, width, (height + down) / 2


def _fitted(shown: tuple[int, int], target: Target) -> str:
    """A remark on what `fit` does to a picture on a target; "" if it does nothing."""
    (width, height), size, fit = shown, target.size, target.fit
    left, top, right, bottom = window(shown, size, fit)
    form = "square" if size[0] == size[1] else f"{size[0]:g} x {size[1]:g} {target.unit}"
    stretched = (width * size[1]) / (height * size[0])
    if (right - left, bottom - top) != shown and fit == "pad":
        done = 'kept whole, with dark strips beside it; fit = "crop" fills the target'
    elif (right - left, bottom - top) != shown:
        done = f'cropped to the middle {right - left:.0f} x {bottom - top:.0f}; fit = "pad" keeps it whole'
    elif fit == "stretch" and abs(stretched - 1) * max(width, height) >= 1:
        along, more = "upwards" if stretched > 1 else "sideways", 100 * (max(stretched, 1 / stretched) - 1)
        done = f'stretched {along} by {more:.2g} %; fit = "crop" keeps its proportions'
    else:
        return ""
    return f"target.fit: the picture is {width} x {height}, the target {form}: {done}"


def average(
    light: Callable[[Box], np.ndarray], size: tuple[int, int], window: Window, pixels: tuple[int, int]
) -> np.ndarray:
    """(rows, columns) means of a picture of `size` over equal parts of a window, dark beyond the picture.

    Exact for any ratio of the sizes; strip by strip to spare memory: `light` gives a box's values.
    """
    left, top = (max(int(start), 0) for start in window[:2])
    right, bottom = (min(math.ceil(stop), most) for stop, most in zip(window[2:], size, strict=True))
    across = overlap(right - left, pixels[0], window[0] - left, window[2] - left)
    down = overlap(bottom - top, pixels[1], window[1] - top, window[3] - top)
    parts = (light(box) for box in strips((left, top, right, bottom)))
    return down @ np.concatenate([(across @ part.T).T for part in parts])


def overlap(size: int, pixels: int, start: float = 0.0, stop: float | None = None) -> csr_array:
    """Averaging matrix (pixels, size): the share of each of the pixels from start to stop that each input covers."""
    stop = size if stop is None else stop
    edges = start + np.arange(pixels + 1) * (stop - start) / pixels
    edges[-1] = stop
    cuts = np.union1d(np.arange(size + 1), np.clip(edges, 0, size))
    cuts = cuts[(cuts >= start) & (cuts <= stop)]
    middle = (cuts[1:] + cuts[:-1]) / 2
    to = np.clip(((middle - start) * pixels / (stop - start)).astype(int), 0, pixels - 1)
    of = np.clip(middle.astype(int), 0, size - 1)
    return csr_array((np.diff(cuts) * pixels / (stop - start), (to, of)), shape=(pixels, size))


def inside(outline: Outline, pixels: tuple[int, int], size: tuple[float, float]) -> np.ndarray:
    """The share of each pixel (columns, rows) that lies inside an outline centred in a rectangle of a size."""
    columns, rows = pixels
    fine = max(2048 // max(pixels), 4)  # sub-pixels along a pixel's side
    x, y = (
        ((torch.arange(n * fine, dtype=torch.float64) + 0.5) / (n * fine) - 0.5) * along
        for n, along in ((columns, size[0]), (rows, -size[1]))
    )
    high = fine * max(2**20 // (columns * fine * fine), 1)  # about a million sub-pixels at a time
    bands = (outline.contains(x, band[:, None]).numpy() for band in y.split(high))
    return np.concatenate([band.reshape(-1, fine, columns, fine).mean((1, 3)) for band in bands])
