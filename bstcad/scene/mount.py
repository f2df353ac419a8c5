"""The lens as a part: its title block, [part], and how it is held, [mount]; with the latter there is part.step."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from bstcad.optics.key import Key
from bstcad.optics.lens import Lens
from bstcad.optics.media import medium
from bstcad.optics.outlines import STRICT, Circle, Outline, Rectangle, Rounded
from bstcad.optics.surfaces import Surface, sag, sampled
from bstcad.scene.blank import LensBlank
from bstcad.scene.schema import COORDINATES, LENGTHS, Record

MOST_DRAFT = 30.0  # degrees, of a lens's own walls
WEB = 0.1  # mm; the least that is left between a hole and any other edge
LAND = 0.1  # mm, and of the wall's height if that is less: so far below the back's rim walls begin to lean
STEPS = 60  # of an iteration that a front of slope 0.5 shortens by half each time
STEEPEST = 0.25  # of a wall and the front: the least that they close on each other, mm a mm of the wall's height
NARROWEST = 1e-3  # of the rim, the least that draft and bevel leave of the front's clear aperture
GLASS, METAL = "#9ed3f580", "#c8ccd0"  # colours of a lens and of a mirror
LONGEST = 200  # characters of a text of the title block
COLOUR = re.compile(r"#(?:[0-9a-fA-F]{6}|[0-9a-fA-F]{8})")


@dataclass(frozen=True)
class Part:
    """A part as a drawing's title block tells it; None: the file does not say."""

    number: Annotated[str | None, Key("Number of the part; the scene's name if absent.")] = None
    author: Annotated[str | None, Key("Author of the file.")] = None
    organisation: Annotated[str | None, Key("Organisation of the author.")] = None
    material: Annotated[str | None, Key("Material as the drawing names it; lens.material if absent.")] = None
    density: Annotated[float | None, Key("Density; that of lens.material if absent.", "g/cm³", 1e-3, 30.0)] = None
    colour: Annotated[
        str | None, Key('"#rrggbb", or "#rrggbbaa" with the opacity; pale blue or grey if absent.', example="#9ed3f580")
    ] = None
    surface_profile: Annotated[float | None, Key("Full tolerance zone of the back's profile.", "mm", 1e-6, 10.0)] = None
    front_profile: Annotated[float | None, Key("Full tolerance zone of the front's profile.", "mm", 1e-6, 10.0)] = None
    roughness: Annotated[float | None, Key("Greatest Ra of the optical faces.", "nm", 0.01, 1e5)] = None
    coating: Annotated[str | None, Key("Coating of the optical faces in words.")] = None
    thickness_tolerance: Annotated[float | None, Key("Tolerance (+-) of the centre thickness.", "mm", 1e-6, 10.0)] = (
        None
    )
    date: Annotated[str | None, Key("Date of the drawing, ISO 8601.")] = None
    schema: Annotated[
        Literal["AP242", "AP214"], Key("Schema of lens.step; AP214 for older programs.", example="AP214")
    ] = "AP242"

    __pydantic_config__ = STRICT

    def of(self, lens: LensBlank) -> Part:
        """The same, completed by the lens: its material with the density, a colour."""
        known: dict[str, str | float | None] = {"colour": GLASS if lens.passes.enters else METAL}
        if lens.material is not None:
            its = medium(lens.material)
            known |= {"material": its.name, "density": its.density}
        return replace(self, **{name: value for name, value in known.items() if getattr(self, name) is None})

    def complaints(self, lens: LensBlank) -> Iterator[str]:
        """Everything that is wrong with the table by itself, or for this lens."""
        for field in fields(self):
            text = getattr(self, field.name)
            if isinstance(text, str) and not (text.strip() and text.isprintable() and len(text) <= LONGEST):
                yield f"part.{field.name}: must be one line of 1 to {LONGEST} characters that can be printed; change it"
        if self.colour is not None and not COLOUR.fullmatch(self.colour):
            yield f'part.colour: {self.colour!r} is no colour; write it as "#9ed3f5", or "#9ed3f580" to see through'
        if self.density is not None and self.material is None and lens.material is None:
            yield "part.density: is of no material; add part.material, in words"
        for key in ("surface_profile", "front_profile"):
            if getattr(self, key) is not None and self.schema == "AP214":
                yield f'part.{key}: is not written in AP214; remove it, or the line schema = "AP214"'
        thickness = lens.back.z - lens.front.z
        if self.thickness_tolerance is not None and not self.thickness_tolerance < thickness:
            thick = f"the lens is {thickness:g} mm thick before it is tailored"
            yield f"part.thickness_tolerance: {self.thickness_tolerance:g} mm, and {thick}; give less"
        if self.date is not None and not _is_date(self.date):
            yield f'part.date: {self.date!r} is no date of ISO 8601; write it as "2031-05-06"'


def _is_date(text: str) -> bool:
    try:
        return datetime.date.fromisoformat(text).isoformat() == text
    except ValueError:
        return False


class Round(Record):
    """A circle about the lens's axis."""

    shape: Annotated[Literal["circle"], Key("A circle about the axis.")]
    diameter: Annotated[float, Key("Diameter.", "mm", *LENGTHS, example=20.0)]
    corner_radius: ClassVar[float] = 0.0

    @property
    def outline(self) -> Circle:
        """The same for light."""
        return Circle(self.diameter / 2)


class Box(Record):
    """A rectangle about the lens's axis, its corners rounded or sharp."""

    shape: Annotated[Literal["rectangle"], Key("A rectangle about the axis.")]
    width: Annotated[float, Key("Extent along x.", "mm", *LENGTHS, example=12.0)]
    height: Annotated[float, Key("Extent along y.", "mm", *LENGTHS, example=12.0)]
    corner_radius: Annotated[float, Key("Radius of the corners; 0 is sharp.", "mm", 0.0, 1e5, example=3.0)] = 0.0

    @property
    def outline(self) -> Rectangle:
        """The same for light."""
        size, r = (self.width, self.height), self.corner_radius
        return Rounded(*size, corner_radius=r) if r else Rectangle(*size)


Shape = Annotated[Round | Box, Field(discriminator="shape")]


class Screws(Record):
    """Holes through the flange, evenly around the axis."""

    count: Annotated[int, Key("Number of holes.", "", 1, 100, example=3)]
    diameter: Annotated[float, Key("Diameter of each hole.", "mm", *LENGTHS, example=3.2)]
    circle: Annotated[float, Key("Diameter of the circle through their centres.", "mm", *LENGTHS, example=34.0)]
    first: Annotated[float, Key("Angle of a hole from +x towards +y.", "degrees", -360.0, 360.0)] = 90.0

    def holes(self) -> Iterator[tuple[float, float, float]]:
        """x, y and diameter (mm) of each."""
        for k in range(self.count):
            turn = math.radians(self.first + 360.0 * k / self.count)
            yield self.circle / 2 * math.cos(turn), self.circle / 2 * math.sin(turn), self.diameter


class Flange(Record):
    """A plate around the lens, one part with it, from `z` upwards; its lower face, at z, rests on the housing."""

    outline: Annotated[Shape, Key("Outer rim of the plate.", example={"shape": "circle", "diameter": 40.0})]
    z: Annotated[float, Key("Lower face of the plate.", "mm", *COORDINATES, example=15.5)]
    thickness: Annotated[float, Key("Thickness of the plate.", "mm", 1e-2, 1e5, example=1.5)]
    screws: Annotated[Screws | None, Key("Holes evenly around the axis.")] = None
    holes: Annotated[
        tuple[tuple[float, float, float], ...],
        Key("Further holes [x, y, diameter].", "mm", *COORDINATES, example=[[14.0, 0.0, 3.2]]),
    ] = ()
    draft: Annotated[float, Key("Angle by which its outer walls lean inwards above.", "degrees", 0.0, 45.0)] = 0.0
    bevel: Annotated[float, Key("Bevel of the edges of its outer walls at 45 degrees.", "mm", 0.0, 1e5)] = 0.0

    def all_holes(self) -> list[tuple[float, float, float]]:
        """x, y and diameter (mm) of the screws' holes and of the further ones."""
        return [*(self.screws.holes() if self.screws else ()), *self.holes]


class Mount(Record):
    """The lens as a part: its rim, a flange, and where the file's origin lies."""

    datum: Annotated[
        Literal["source", "front", "flange"],
        Key("Origin z = 0 of part.step: the scene's, the front's vertex or the flange's lower face."),
    ] = "source"
    rim: Annotated[Shape | None, Key("Rim that the lens is cut to; lens.outline if absent.")] = None
    draft: Annotated[float, Key("Angle by which the lens's walls lean inwards.", "degrees", 0.0, MOST_DRAFT)] = 0.0
    bevel: Annotated[float, Key("Bevel at 45 degrees of the edge of walls and front.", "mm", 0.0, 1e5)] = 0.0
    flange: Annotated[Flange | None, Key("A plate around the lens, one part with it.")] = None

    def origin(self, front: float) -> float:
        """z in the scene's frame (mm) that is 0 in part.step; front: of the front's vertex."""
        if self.datum == "source":
            return 0.0
        return front if self.datum == "front" else self.flange.z

    def rim_of(self, outline: Outline) -> Round | Box:
        """The rim, in the part, of a lens of that outline."""
        if self.rim is not None:
            return self.rim
        if outline.is_round:
            return Round(shape="circle", diameter=2 * outline.radius)
        return Box(shape="rectangle", width=outline.width, height=outline.height)

    def clear(self, lens: Lens) -> tuple[Outline, Outline] | None:
        """The clear apertures that the part leaves of the lens's front and back; None: all of the lens's outline.

        The back ends on the rim.  The front ends where draft and bevel bring the walls to, and its clear aperture is
        the rim less the largest distance by which they move it: below a curved front that distance differs along it.
        """
        if self.rim is None and not (self.draft or self.bevel):
            return None
        rim = self.rim_of(lens.outline).outline
        if lens.front.outline is not None:
            return lens.front.outline, rim
        if not (self.draft or self.bevel):
            return rim, rim
        lens = lens.plain()
        return rim.inset(self._taken(rim, lens.front, self.top(lens))), rim

    def top(self, lens: Lens) -> float:
        """z (scene's frame, mm) from which the lens's walls lean: the flange's lower face, or below the back's rim."""
        if self.flange is not None:
            return self.flange.z
        return parting(lens.back, lens.front, *self.rim_of(lens.outline).outline.places())

    def _taken(self, rim: Outline, front: Surface, top: float) -> float:
        """The largest distance (mm) by which walls that begin at z = top have moved inwards where they meet the front.

        A wall's line from (p, top) goes down to the front, inwards along m by tan(draft) a mm of depth; the bevel takes
        its last mm off at 45 degrees: cad.walls.LeaningPiece.ends, by iteration, since the front differs little over m.
        """
        (x, y), tangent = rim.places(), math.tan(math.radians(self.draft))
        m_x, m_y = rim.inwards(x, y)
        most = (1 - NARROWEST) * min(rim.half_extent)

        def front_at(inwards: np.ndarray) -> np.ndarray:
            return sag(front, x + inwards * m_x, y + inwards * m_y)

        depth, more = np.zeros_like(x), np.full_like(x, self.bevel)
        for _ in range(STEPS):
            depth = np.clip(top - front_at(tangent * depth), 0.0, most / tangent if tangent else math.inf)
        upper = tangent * (depth - self.bevel)
        for _ in range(STEPS if self.bevel else 0):
            more = np.clip(top - (depth - self.bevel) - front_at(upper + more), 0.0, most)
        return float(np.clip(upper + more, 0.0, most).max())


def as_cut(lens: Lens, mount: Mount | None) -> Lens:
    """The lens within the rim that its mount cuts it to."""
    return lens if mount is None or mount.rim is None else replace(lens, outline=mount.rim.outline)


def parting(back: Surface, front: Surface, x: np.ndarray, y: np.ndarray) -> float:
    """z (mm) of the plane from which the walls of a lens without a flange lean, by places (mm) all along its rim."""
    low, high = sag(back, x, y).min(), sag(front, x, y).max()
    return float(low - min(LAND, LAND * (low - high)))


# ---- complaints: the first one counts, and those behind it rely on its absence ---------------------------------------


def complaints(mount: Mount, lens: LensBlank) -> Iterator[str]:
    """Everything that keeps a mount from being built around this lens before it is tailored."""
    for key, shape in (("rim", mount.rim), ("flange.outline", mount.flange and mount.flange.outline)):
        if shape is not None and not shape.corner_radius < (half := min(shape.outline.half_extent)):
            size = f"{shape.corner_radius:g} mm is not between 0 and {half:g} mm"
            yield f"mount.{key}.corner_radius: {size}; choose a value in between"
    rim = mount.rim_of(lens.outline)
    if (lens.outline.depth(*rim.outline.places()) < -1e-9).any():
        yield "mount.rim: reaches beyond lens.outline; make it smaller, or the lens larger"
    if (own := lens.front.outline) and not _inradius(rim) > own.radius:
        yield f"mount.rim: cuts the front, whose own outline is {own.words}; make the rim larger"
    if mount.datum == "flange" and mount.flange is None:
        yield 'mount.datum: "flange", but there is no [mount.flange]; add one, or choose "front" or "source"'
    if mount.draft or mount.bevel:
        yield from _walls(mount, lens, rim)
    if mount.flange is not None:
        yield from _flange(mount.flange, lens, rim)


def _walls(mount: Mount, lens: LensBlank, rim: Round | Box) -> Iterator[str]:
    """Draft and bevel of the lens's own walls, below its back or its flange."""
    key, tangent = "mount.draft" if mount.draft else "mount.bevel", math.tan(math.radians(mount.draft))
    top, below, remedy = lens.back.z, "back", "move the back up"
    if mount.flange is not None:
        top, below, remedy = mount.flange.z, "flange", "move the flange up, or give draft and bevel of mount.flange"
    front = sag(lens.front.surface, *rim.outline.places())
    wall = top - front.max()
    if not wall > 0:
        where = f"below its {below} at z = {top:g} mm, and the front's rim comes up to {front.max():.4g} mm"
        yield f"{key}: it is of the lens's own walls, {where}; {remedy}"
    falls = _fall(lens.front.surface, rim.outline)
    for name, slope in (("bevel", bool(mount.bevel)), ("draft", tangent)):
        if not 1 - slope * falls > STEEPEST:
            steep = f"inwards from the rim the front falls by {falls:.3g} mm a mm, too steeply for a wall that leans"
            yield f"mount.{name}: {steep} to meet it; make it smaller, leave it out, or flatten the front"
    if not mount.bevel < wall:
        yield f"mount.bevel: {mount.bevel:g} mm off a wall of {wall:.4g} mm leaves none; make it smaller"
    taken, half = mount.bevel + (top - front.min()) * tangent, min(rim.outline.half_extent)
    yield from _corner("mount.rim", rim, taken)
    if (own := lens.front.outline) and not _inradius(rim) - taken > own.radius:
        beside = f"the front, {own.words}, ends {_inradius(rim) - own.radius:.3g} mm from the rim"
        yield f"{key}: draft and bevel take {taken:.3g} mm there, and {beside}; make them smaller"
    if not taken < half:
        yield f"{key}: draft and bevel take {taken:.3g} mm off {half:g} mm from rim to axis; make them smaller"


def _inradius(shape: Round | Box) -> float:
    """The radius of the largest circle about the axis inside it (mm)."""
    return float(shape.outline.depth(np.zeros(1), np.zeros(1))[0])


def _fall(front: Surface, rim: Outline) -> float:
    """The steepest descent of a front inwards from the rim (mm a mm)."""
    x, y = rim.places()
    m_x, m_y = rim.inwards(x, y)
    _, z_x, z_y = sampled(front, x, y)
    return -float((z_x * m_x + z_y * m_y).min())


def _corner(key: str, shape: Round | Box, taken: float) -> Iterator[str]:
    """Corners whose radius draft and bevel take off; taken: the depth (mm) that both take off the walls."""
    if 0 < shape.corner_radius <= taken:
        size = f"{shape.corner_radius:g} mm, of which draft and bevel take {taken:.3g} mm"
        yield f"{key}.corner_radius: {size}; make it larger, or 0"


def _flange(flange: Flange, lens: LensBlank, rim: Round | Box) -> Iterator[str]:
    """A flange that does not hold together, does not meet the lens, or whose holes do not fit."""
    key, upper = "mount.flange", flange.z + flange.thickness
    taken = flange.bevel + flange.thickness * math.tan(math.radians(flange.draft))
    if not 2 * flange.bevel < flange.thickness:
        yield f"{key}.bevel: {flange.bevel:g} mm off {flange.thickness:g} mm, twice, leaves no wall; make it smaller"
    yield from _corner(f"{key}.outline", flange.outline, taken)
    if not flange.outline.outline.depth(*rim.outline.places()).min() >= WEB + taken:
        yield f"{key}.outline: does not reach {WEB + taken:.3g} mm beyond the lens's rim everywhere; make it larger"
    front = lens.front.z if lens.front.free else sag(lens.front.surface, *rim.outline.places())
    low, high = float(np.min(front)), float(np.max(front))
    if upper <= high or flange.z >= lens.back.z:
        lies = f"from z = {flange.z:g} to {upper:g} mm and the lens from {high:.6g} to {lens.back.z:g} mm"
        yield f"{key}.z: the flange lies {lies} before it is tailored; let them meet"
    if low <= flange.z <= high and not lens.front.surface.around.level and not lens.front.free:
        cuts = f"z = {flange.z:g} mm, cuts the rim of the front, which runs from z = {low:.6g} to {high:.6g} mm"
        yield f"{key}.z: the flange's lower face, {cuts}; put it below or above that"
    holes = flange.all_holes()
    for k, (x, y, diameter) in enumerate(holes, start=1):
        at = f"{key}: hole {k}, of {diameter:g} mm at ({x:.4g}, {y:.4g}) mm,"
        if not diameter > 0:
            yield f"{at} has no width; give a diameter above zero"
        if not flange.outline.outline.depth(x, y) >= diameter / 2 + WEB + taken:
            yield f"{at} leaves less than {WEB + taken:.3g} mm to the flange's edge; move it inwards"
        if not -rim.outline.depth(x, y) >= diameter / 2 + WEB:
            yield f"{at} leaves less than {WEB:g} mm to the lens's rim; move it outwards"
        for m, (x1, y1, other) in enumerate(holes[: k - 1], start=1):
            if not math.hypot(x - x1, y - y1) >= (diameter + other) / 2 + WEB:
                yield f"{at} leaves less than {WEB:g} mm to hole {m}; move one of them"
