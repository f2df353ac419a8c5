"""The lens as a part: the tables [part] (title block of a drawing) and [mount], with which bstcad writes part.step."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

import numpy as np
from pydantic import Field

from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.media import medium
from bstcad.optics.lens.passes import BACK, FRONT
from bstcad.optics.surfaces.key import Key
from bstcad.optics.surfaces.outlines import STRICT, Circle, Outline, Rectangle, Rounded
from bstcad.optics.surfaces.surfaces import Surface, sag, sampled
from bstcad.scene.blank import LensBlank
from bstcad.scene.dome_back import RadialBack
from bstcad.scene.schema import COORDINATES, LENGTHS, Record

MAX_DRAFT = 30.0  # degrees; largest draft angle of the walls of a lens
MIN_WEB = 0.1  # mm; smallest width of a flange beside the lens, and of the web between a hole and any other edge
LAND = 0.1  # height of the upright wall below the back's rim: 0.1 mm, or a tenth of a wall lower than 1 mm
ITERATIONS = 60  # iterations to find the end of a bevel or wall; each halves the error on a front of slope 0.5
MIN_CLOSING = 0.25  # smallest rate at which a bevel or a wall with draft nears the front (mm per mm of depth)
MIN_CLEAR_APERTURE = 1e-3  # smallest width of the front's clear aperture after draft and bevel / width of the rim
LENS_COLOUR, MIRROR_COLOUR = "#9ed3f580", "#c8ccd0"  # default colours of a part
MAX_TEXT = 200  # largest number of characters of a text of the title block
COLOUR = re.compile(r"#(?:[0-9a-fA-F]{6}|[0-9a-fA-F]{8})")


PROFILES = {BACK: "surface_profile", FRONT: "front_profile"}  # key of the profile tolerance of each face


@dataclass(frozen=True)
class Part:
    """Entries of the title block of a drawing; None: the default that the key states, or else no entry."""

    number: Annotated[str | None, Key("Number of the part; the scene's name if absent.")] = None
    author: Annotated[str | None, Key("Author of the file.")] = None
    organisation: Annotated[str | None, Key("Organisation of the author.")] = None
    material: Annotated[str | None, Key("Material as the drawing names it; lens.material if absent.")] = None
    density: Annotated[float | None, Key("Density; that of lens.material if absent.", "g/cm³", 1e-3, 30.0)] = None
    colour: Annotated[str | None, Key('Colour "#rrggbb", or "#rrggbbaa" with opacity.', example="#9ed3f580")] = None
    surface_profile: Annotated[float | None, Key("Width of the tolerance zone of the back.", "mm", 1e-6, 10.0)] = None
    front_profile: Annotated[float | None, Key("Width of the tolerance zone of the front.", "mm", 1e-6, 10.0)] = None
    roughness: Annotated[float | None, Key("Maximum roughness Ra of the optical faces.", "nm", 0.01, 1e5)] = None
    coating: Annotated[str | None, Key("Coating of the optical faces, in words.")] = None
    thickness_tolerance: Annotated[float | None, Key("Tolerance (±) of centre thickness.", "mm", 1e-6, 10.0)] = None
    date: Annotated[str | None, Key("Date of the drawing, ISO 8601.")] = None
    schema: Annotated[Literal["AP242", "AP214"], Key("STEP schema; AP214 for old programs.", example="AP214")] = "AP242"

    __pydantic_config__ = STRICT

    @property
    def profiles(self) -> dict[str, float | None]:
        """Widths (mm) of the tolerance zones of the faces, by name; None: none is stated."""
        return {face: getattr(self, key) for face, key in PROFILES.items()}

    def of(self, lens: LensBlank) -> Part:
        """Return the entries with defaults from the lens: material, density and colour."""
        known: dict[str, Any] = {"colour": LENS_COLOUR if lens.passes.enters else MIRROR_COLOUR}
        if lens.material is not None:
            material = medium(lens.material)
            known |= {"material": material.name, "density": material.density}
        return replace(self, **{name: value for name, value in known.items() if getattr(self, name) is None})

    def complaints(self, lens: LensBlank) -> Iterator[str]:
        """Yield the faults of the table, and its conflicts with the lens."""
        for field in fields(self):
            text = getattr(self, field.name)
            if isinstance(text, str) and not (text.strip() and text.isprintable() and len(text) <= MAX_TEXT):
                yield f"part.{field.name}: must be one line of 1 to {MAX_TEXT} printable characters; change it"
        if self.colour is not None and not COLOUR.fullmatch(self.colour):
            yield f'part.colour: {self.colour!r} is not a colour; write "#9ed3f5", or "#9ed3f580" with an opacity'
        if self.density is not None and self.material is None and lens.material is None:
            yield "part.density: a density needs the name of its material; add part.material"
        for key in PROFILES.values():
            if getattr(self, key) is not None and self.schema == "AP214":
                yield f'part.{key}: AP214 cannot contain this tolerance; remove it, or the line schema = "AP214"'
        thickness = lens.back.z - lens.front.z
        if self.thickness_tolerance is not None and not self.thickness_tolerance < thickness:
            large = f"{self.thickness_tolerance:g} mm is not less than the thickness of the blank, {thickness:g} mm"
            yield f"part.thickness_tolerance: {large}; make it smaller"
        if self.date is not None and not _is_date(self.date):
            yield f'part.date: {self.date!r} is not a date in ISO 8601; write it as "2031-05-06"'


def _is_date(text: str) -> bool:
    try:
        return datetime.date.fromisoformat(text).isoformat() == text
    except ValueError:
        return False


class CircleRim(Record):
    """A circle about the axis of the lens."""

    shape: Annotated[Literal["circle"], Key("A circle about the axis.")]
    diameter: Annotated[float, Key("Diameter.", "mm", *LENGTHS, example=20.0)]
    corner_radius: ClassVar[float] = 0.0

    @property
    def outline(self) -> Circle:
        """The circle as an outline of bstcad.optics."""
        return Circle(self.diameter / 2)


class Box(Record):
    """A rectangle about the axis of the lens, with rounded or sharp corners."""

    shape: Annotated[Literal["rectangle"], Key("A rectangle about the axis.")]
    width: Annotated[float, Key("Extent along x.", "mm", *LENGTHS, example=12.0)]
    height: Annotated[float, Key("Extent along y.", "mm", *LENGTHS, example=12.0)]
    corner_radius: Annotated[float, Key("Radius of the corners; 0 is sharp.", "mm", 0.0, 1e5, example=3.0)] = 0.0

    @property
    def outline(self) -> Rectangle:
        """The rectangle as an outline of bstcad.optics."""
        size, r = (self.width, self.height), self.corner_radius
        return Rounded(*size, corner_radius=r) if r else Rectangle(*size)


Shape: TypeAlias = Annotated[CircleRim | Box, Field(discriminator="shape")]


class Screws(Record):
    """Screw holes through the flange, evenly spaced around the axis."""

    count: Annotated[int, Key("Number of holes.", "", 1, 100, example=3)]
    diameter: Annotated[float, Key("Diameter of each hole.", "mm", *LENGTHS, example=3.2)]
    circle: Annotated[float, Key("Diameter of the circle through the centres.", "mm", *LENGTHS, example=34.0)]
    first: Annotated[float, Key("Angle of the first hole, from +x towards +y.", "degrees", -360.0, 360.0)] = 90.0

    def holes(self) -> Iterator[tuple[float, float, float]]:
        """Yield (x, y, diameter) of each hole, mm."""
        for k in range(self.count):
            angle = math.radians(self.first + 360.0 * k / self.count)
            yield self.circle / 2 * math.cos(angle), self.circle / 2 * math.sin(angle), self.diameter


class Flange(Record):
    """A plate around the lens, one piece with it; its lower face, at z, rests on the housing."""

    outline: Annotated[Shape, Key("Outer outline of the plate.", example={"shape": "circle", "diameter": 40.0})]
    z: Annotated[float, Key("Position of the lower face (smaller z) of the plate.", "mm", *COORDINATES, example=15.5)]
    thickness: Annotated[float, Key("Thickness of the plate.", "mm", 1e-2, 1e5, example=1.5)]
    screws: Annotated[Screws | None, Key("Screw holes, evenly spaced around the axis.")] = None
    holes: Annotated[
        tuple[tuple[float, float, float], ...],
        Key("Further holes [x, y, diameter].", "mm", *COORDINATES, example=[[14.0, 0.0, 3.2]]),
    ] = ()
    draft: Annotated[float, Key("Draft of the outer walls; the plate narrows towards +z.", "degrees", 0.0, 45.0)] = 0.0
    bevel: Annotated[float, Key("Height of each of two bevels (45 degrees) of the outer walls.", "mm", 0.0, 1e5)] = 0.0

    def all_holes(self) -> list[tuple[float, float, float]]:
        """Return (x, y, diameter) of the screw holes and of the further holes, mm."""
        return [*(self.screws.holes() if self.screws else ()), *self.holes]


class Mount(Record):
    """The lens as a part: its rim, its flange, and the origin of part.step."""

    datum: Annotated[
        Literal["source", "front", "flange"],
        Key("Origin z = 0 of part.step: the origin of the scene, the vertex of the front or the flange's lower face."),
    ] = "source"
    rim: Annotated[Shape | None, Key("Rim of the lens after cutting; lens.outline if absent.")] = None
    draft: Annotated[float, Key("Draft of the walls; the lens narrows towards -z.", "degrees", 0.0, MAX_DRAFT)] = 0.0
    bevel: Annotated[float, Key("Height of the bevel (45 degrees) between walls and front.", "mm", 0.0, 1e5)] = 0.0
    flange: Annotated[Flange | None, Key("A plate around the lens, one piece with it.")] = None

    def origin(self, front: float) -> float:
        """Return z (mm) in the scene of the origin of part.step; front: z of the front's vertex."""
        if self.datum == "source":
            return 0.0
        if self.datum == "front":
            return front
        assert self.flange is not None  # otherwise `complaints` has refused the scene
        return self.flange.z

    def rim_of(self, outline: Outline) -> CircleRim | Box:
        """Return the rim that a lens with this outline has in the part."""
        if self.rim is not None:
            return self.rim
        if isinstance(outline, Circle):
            return CircleRim(shape="circle", diameter=2 * outline.radius)
        return Box(shape="rectangle", width=outline.width, height=outline.height)

    def clear(self, lens: Lens) -> tuple[Outline, Outline] | None:
        """Return the clear apertures of front and back in the part; None: the whole outline of the lens.

        The back ends on the rim.  Draft and bevel move the edge of the front inwards, by a distance that differs along
        the rim of a curved front.  The front's clear aperture is the rim, moved inwards by the largest distance.
        """
        if self.rim is None and not (self.draft or self.bevel):
            return None
        rim = self.rim_of(lens.outline).outline
        if lens.front.outline is not None:
            return lens.front.outline, rim
        if not (self.draft or self.bevel):
            return rim, rim
        lens = lens.plain()
        return rim.inset(self._inset(rim, lens.front, self.top(lens))), rim

    def top(self, lens: Lens) -> float:
        """Return z (mm) in the scene where draft begins: the flange's lower face, or without a flange `parting`."""
        if self.flange is not None:
            return self.flange.z
        rim = self.rim_of(lens.outline).outline.rim_points()
        return parting(sag(lens.back, *rim), sag(lens.front, *rim))

    def _inset(self, rim: Outline, front: Surface, top: float) -> float:
        """Return the largest distance (mm) by which draft and bevel move the edge of the front inwards.

        From each point of the rim at z = top, a line of the wall goes down to the front, and inwards (direction m) by
        tan(draft) per mm of depth.  A bevel at 45° replaces the line's lower end.  Compare cad.walls.LeaningPiece.ends.
        """
        (x, y), tangent = rim.rim_points(), math.tan(math.radians(self.draft))
        m_x, m_y = rim.inset_direction(x, y)
        largest = (1 - MIN_CLEAR_APERTURE) * min(rim.half_extent)

        def front_at(inwards: np.ndarray) -> np.ndarray:
            return sag(front, x + inwards * m_x, y + inwards * m_y)

        deepest = largest / tangent if tangent else math.inf
        depth = _fixed_point(lambda depth: np.clip(top - front_at(tangent * depth), 0.0, deepest), np.zeros_like(x))
        upper, lower = tangent * (depth - self.bevel), np.full_like(x, self.bevel)
        if self.bevel:
            start = top - (depth - self.bevel)
            lower = _fixed_point(lambda lower: np.clip(start - front_at(upper + lower), 0.0, largest), lower)
        return float(np.clip(upper + lower, 0.0, largest).max())


def _fixed_point(step: Callable[[np.ndarray], np.ndarray], values: np.ndarray) -> np.ndarray:
    """Return the values after ITERATIONS steps; steps that would change no bit are omitted."""
    for _ in range(ITERATIONS):
        if np.array_equal(following := step(values), values):
            break
        values = following
    return values


def as_cut(lens: Lens, mount: Mount | None) -> Lens:
    """Return the lens cut to the rim that its mount states, or else the lens as it is."""
    return lens if mount is None or mount.rim is None else replace(lens, outline=mount.rim.outline)


def parting(back: np.ndarray, front: np.ndarray) -> float:
    """Return z (mm) of the plane below the back's rim where draft begins without a flange.

    back, front: z (mm) of points of the rims of back and front.
    """
    low, high = back.min(), front.max()
    return float(low - min(LAND, LAND * (low - high)))


# ---- complaints: each relies on the absence of earlier faults --------------------------------------------------------


def complaints(mount: Mount, lens: LensBlank) -> Iterator[str]:
    """Yield the faults of a mount that can be found before the lens is tailored, each as a sentence."""
    for key, shape in (("rim", mount.rim), ("flange.outline", mount.flange.outline if mount.flange else None)):
        if shape is not None and not shape.corner_radius < (half := min(shape.outline.half_extent)):
            size = f"{shape.corner_radius:g} mm is not less than {half:g} mm, half the width"
            yield f"mount.{key}.corner_radius: {size}; make it smaller"
    if (dome := lens.dome) is not None:
        yield from _dome_complaints(mount, dome)
    rim = mount.rim_of(lens.outline)
    if (lens.outline.depth(*rim.outline.rim_points()) < -1e-9).any():
        yield "mount.rim: extends past lens.outline; make it smaller, or the lens larger"
    if (own := lens.front.outline) and not _depth(rim, 0.0, 0.0) > own.radius:
        yield f"mount.rim: cuts the front, whose outline is {own.words}; make the rim larger"
    if mount.datum == "flange" and mount.flange is None:
        yield 'mount.datum: "flange" needs a [mount.flange]; add that table, or choose "front" or "source"'
    if mount.draft or mount.bevel:
        yield from _wall_complaints(mount, lens, rim)
    if mount.flange is not None:
        yield from _flange_complaints(mount.flange, lens, rim)


def _dome_complaints(mount: Mount, dome: RadialBack) -> Iterator[str]:
    """Yield complaints about a mount of a dome, whose rim and wall stay as they are and whose light leaves sideways."""
    can = "a dome can have mount.datum and mount.flange"
    for key in (key for key in ("rim", "draft", "bevel") if getattr(mount, key)):
        yield f"mount.{key}: a dome keeps its own rim and its low wall; remove this key; {can}"
    if (flange := mount.flange) is None:
        return
    rim, upper = dome.rim_z, flange.z + flange.thickness
    if not upper < rim:
        above = f"the flange reaches z = {upper:g} mm and the rim of the dome lies at about z = {rim:.4g} mm"
        yield f"mount.flange.thickness: {above}, where light leaves; make the flange thinner, or move it down"


def _wall_complaints(mount: Mount, lens: LensBlank, rim: CircleRim | Box) -> Iterator[str]:
    """Yield complaints about draft and bevel of the lens's own walls, below its back or its flange."""
    key, tangent = "mount.draft" if mount.draft else "mount.bevel", math.tan(math.radians(mount.draft))
    top, above, remedy = lens.back.z, "back", "move the back up"
    if mount.flange is not None:
        top, above, remedy = mount.flange.z, "flange", "move the flange up, or set draft and bevel of mount.flange"
    front = sag(lens.front.surface, *rim.outline.rim_points())
    wall = top - front.max()
    if not wall > 0:
        level = f"the {above} is at z = {top:g} mm, and the rim of the front reaches z = {front.max():.4g} mm"
        yield f"{key}: no wall is left below the {above}, as {level}; {remedy}"
    descent = _steepest_descent(lens.front.surface, rim.outline)
    for name, slope in (("bevel", bool(mount.bevel)), ("draft", tangent)):
        if not 1 - slope * descent > MIN_CLOSING:
            steep = f"inwards from the rim the front descends by {descent:.3g} mm per mm, too steeply for this {name}"
            yield f"mount.{name}: {steep}; make it smaller, remove it, or flatten the front"
    if not mount.bevel < wall:
        yield f"mount.bevel: {mount.bevel:g} mm leaves nothing of a wall of {wall:.4g} mm; make it smaller"
    taken, half = mount.bevel + (top - front.min()) * tangent, min(rim.outline.half_extent)
    yield from _corner_complaints("mount.rim", rim, taken)
    inradius = _depth(rim, 0.0, 0.0)
    if (own := lens.front.outline) and not inradius - taken > own.radius:
        gap = f"only {inradius - own.radius:.3g} mm lie between the rim and the front, {own.words}"
        yield f"{key}: draft and bevel remove {taken:.3g} mm, and {gap}; make them smaller"
    if not taken < half:
        yield f"{key}: draft and bevel remove {taken:.3g} mm, and the axis is {half:g} mm away; make them smaller"


def _depth(shape: CircleRim | Box, x: float, y: float) -> float:
    """Return the distance (mm) of a point (x, y) inside the shape from the shape's edge; negative outside."""
    return float(shape.outline.depth(np.array(x), np.array(y)))


def _steepest_descent(front: Surface, rim: Outline) -> float:
    """Return the steepest descent (mm per mm) of a front at the rim in the direction inwards; negative if it rises."""
    x, y = rim.rim_points()
    m_x, m_y = rim.inset_direction(x, y)
    _, z_x, z_y = sampled(front, x, y)
    return -float((z_x * m_x + z_y * m_y).min())


def _corner_complaints(key: str, shape: CircleRim | Box, taken: float) -> Iterator[str]:
    """Yield complaints about a corner radius not above `taken`, the width (mm) that draft and bevel remove."""
    if 0 < shape.corner_radius <= taken:
        size = f"{shape.corner_radius:g} mm is too small, as draft and bevel remove {taken:.3g} mm"
        yield f"{key}.corner_radius: {size}; make it larger, or 0"


def _flange_complaints(flange: Flange, lens: LensBlank, rim: CircleRim | Box) -> Iterator[str]:
    """Yield complaints: a flange too thin for its bevels, or above or below the lens's wall; holes that do not fit."""
    key, upper = "mount.flange", flange.z + flange.thickness
    taken = flange.bevel + flange.thickness * math.tan(math.radians(flange.draft))
    if not 2 * flange.bevel < flange.thickness:
        two = f"two bevels of {flange.bevel:g} mm leave no wall of a plate {flange.thickness:g} mm thick"
        yield f"{key}.bevel: {two}; make it smaller"
    yield from _corner_complaints(f"{key}.outline", flange.outline, taken)
    if not flange.outline.outline.depth(*rim.outline.rim_points()).min() >= MIN_WEB + taken:
        yield f"{key}.outline: must extend {MIN_WEB + taken:.3g} mm past the rim of the lens everywhere; make it larger"
    front = lens.front.z if lens.front.free else sag(lens.front.surface, *rim.outline.rim_points())
    low, high = float(np.min(front)), float(np.max(front))
    if upper <= high or flange.z >= lens.back.z:
        extents = f"the flange is from z = {flange.z:g} to {upper:g} mm, the wall from {high:.6g} to {lens.back.z:g} mm"
        yield f"{key}.z: {extents}, and they do not overlap; move the flange to the wall"
    if low <= flange.z <= high and not lens.front.surface.around.level and not lens.front.free:
        cuts = f"z = {flange.z:g} mm, cuts the rim of the front, between z = {low:.6g} and {high:.6g} mm"
        yield f"{key}.z: the lower face, {cuts}; move the flange below or above the rim"
    holes = flange.all_holes()
    for k, (x, y, diameter) in enumerate(holes, start=1):
        hole = f"{key}: hole {k}, of {diameter:g} mm at ({x:.4g}, {y:.4g}) mm,"
        if not diameter > 0:
            yield f"{hole} has no width; give a diameter above zero"
        if not _depth(flange.outline, x, y) >= diameter / 2 + MIN_WEB + taken:
            yield f"{hole} is less than {MIN_WEB + taken:.3g} mm from the flange's edge; move it inwards"
        if not -_depth(rim, x, y) >= diameter / 2 + MIN_WEB:
            yield f"{hole} is less than {MIN_WEB:g} mm from the lens's rim; move it outwards"
        for m, (x1, y1, other) in enumerate(holes[: k - 1], start=1):
            if not math.hypot(x - x1, y - y1) >= (diameter + other) / 2 + MIN_WEB:
                yield f"{hole} is less than {MIN_WEB:g} mm from hole {m}; move one of them"
