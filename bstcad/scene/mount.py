"""How a lens is held: [mount], none by default; with it a design's folder holds part.step, the lens as a part."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field

from bstcad.optics.key import Key
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Outline, Rectangle, Rounded
from bstcad.optics.surfaces import Surface, sag
from bstcad.scene.blank import LensBlank
from bstcad.scene.fields import COORDINATES, LENGTHS, Record

MOST_DRAFT = 30.0  # degrees, of a lens's own walls
WEB = 0.1  # mm; the least that is left between a hole and any other edge
LAND = 0.1  # mm, and of the wall's height if that is less: so far below the back's rim walls begin to lean
STEPS = 60  # of an iteration that a front of slope 0.5 shortens by half each time
STEEPEST = 0.25  # of a wall and the front: the least that they close on each other, mm a mm of the wall's height
NARROWEST = 1e-3  # of the rim, the least that draft and bevel leave of the front's clear aperture


class Round(Record):
    """A circle about the lens's axis."""

    shape: Annotated[Literal["circle"], Key("A circle about the axis.")]
    diameter: Annotated[float, Key("Diameter.", "mm", *LENGTHS, example=20.0)]

    @property
    def outline(self) -> Circle:
        """The same for light."""
        return Circle(self.diameter / 2)


class Box(Record):
    """A rectangle about the lens's axis, its corners rounded or sharp."""

    shape: Annotated[Literal["rectangle"], Key("A rectangle about the axis.")]
    width: Annotated[float, Key("Extent along x.", "mm", *LENGTHS, example=12.0)]
    height: Annotated[float, Key("Extent along y.", "mm", *LENGTHS, example=12.0)]
    corner_radius: Annotated[float, Key("Radius of the corners; 0 is sharp.", "mm", 0.0, 1e5)] = 0.0

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
    """A plate around the lens, one part with it, from `z` upwards; its lower face, at z, is what it is put down on."""

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
    """The lens as a part: what its rim is cut to, a flange, and where the file's origin lies."""

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
        """What the rim of a lens of that outline is in the part."""
        return _whole(outline) if self.rim is None else self.rim

    def clear(self, lens: Lens) -> tuple[Outline, Outline] | None:
        """The clear apertures that the part leaves of the lens's front and back; None: all of the lens's outline.

        The back ends on the rim.  The front ends where draft and bevel bring the walls to, and its clear aperture is
        the rim less the largest distance by which they move it: below a curved front that distance differs along it.
        """
        if self.rim is None and not (self.draft or self.bevel):
            return None
        rim = self.rim_of(lens.outline).outline
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


def complaints(mount: Mount, lens: LensBlank) -> Iterator[str]:
    """Complaints about a mount that cannot be built around this lens; each is one sentence with a remedy."""
    for key, outline in (("rim", mount.rim), ("flange.outline", mount.flange and mount.flange.outline)):
        if outline is not None and outline.shape == "rectangle":
            most = min(outline.width, outline.height) / 2
            if not 0 <= outline.corner_radius < most:
                yield (
                    f"mount.{key}.corner_radius: {outline.corner_radius:g} mm is not between 0 and {most:g} mm; "
                    "choose a value in between"
                )
                return
    if mount.rim is not None:
        x, y = mount.rim.outline.places()
        if (lens.outline.depth(x, y) < -1e-9).any():
            yield "mount.rim: reaches beyond lens.outline; make it smaller, or the lens larger"
    if mount.datum == "flange" and mount.flange is None:
        yield 'mount.datum: "flange", but there is no [mount.flange]; add one, or choose "front" or "source"'
    yield from _walls(mount, lens)
    if mount.flange is not None:
        yield from _flange(mount, lens)


def _whole(outline: Outline) -> Round | Box:
    if outline.shape == "circle":
        return Round(shape="circle", diameter=2 * outline.radius)
    return Box(shape="rectangle", width=outline.width, height=outline.height)


def _walls(mount: Mount, lens: LensBlank) -> Iterator[str]:
    """The lens's own, below its back or its flange, before it is tailored."""
    if not (mount.draft or mount.bevel):
        return
    rim, key = mount.rim_of(lens.outline), "mount.draft" if mount.draft else "mount.bevel"
    front = sag(lens.front.surface, *rim.outline.places())
    top = lens.back.z if mount.flange is None else mount.flange.z
    if not front.max() < top:
        where = f"z = {top:g} mm, and the front's rim comes up to {front.max():.4g} mm"
        if mount.flange is None:
            yield f"{key}: there is no wall below the back at {where}; move the back up, or leave draft and bevel out"
        else:
            yield (
                f"{key}: it is of the lens's own walls, below its flange at {where}; move the flange up, or give "
                "mount.flange.draft and mount.flange.bevel instead"
            )
        return
    yield from _too_steep(mount, lens, rim.outline)
    if not mount.bevel < top - front.max():
        yield f"mount.bevel: {mount.bevel:g} mm off a wall of {top - front.max():.4g} mm leaves none; make it smaller"
        return
    taken = mount.bevel + (top - front.min()) * math.tan(math.radians(mount.draft))
    corner = getattr(rim, "corner_radius", 0.0)
    if 0 < corner <= taken:
        yield (
            f"mount.rim.corner_radius: {corner:g} mm, of which draft and bevel take {taken:.3g} mm; make it larger, "
            "or 0"
        )
    elif not taken < (half := min(rim.outline.half_extent)):
        yield f"{key}: draft and bevel take {taken:.3g} mm off {half:g} mm from rim to axis; make them smaller"


def _too_steep(mount: Mount, lens: LensBlank, rim: Outline) -> Iterator[str]:
    """A front that falls inwards nearly as steeply as bevel or draft: the wall would meet it far inside, or never."""
    x, y = rim.places()
    m_x, m_y = rim.inwards(x, y)
    _, *slopes = lens.front.surface.plain().sag_and_slope(torch.from_numpy(x), torch.from_numpy(y))
    falls = -float((slopes[0].numpy() * m_x + slopes[1].numpy() * m_y).min())
    for key, tangent in (("bevel", bool(mount.bevel)), ("draft", math.tan(math.radians(mount.draft)))):
        if not 1 - tangent * falls > STEEPEST:
            yield (
                f"mount.{key}: inwards from the rim the front falls by {falls:.3g} mm a mm, too steeply for a wall "
                "that leans to meet it; make it smaller, leave it out, or flatten the front"
            )
            return


def _flange(mount: Mount, lens: LensBlank) -> Iterator[str]:
    flange, rim, key = mount.flange, mount.rim_of(lens.outline), "mount.flange"
    upper, lean = flange.z + flange.thickness, flange.thickness * math.tan(math.radians(flange.draft))
    if not 2 * flange.bevel < flange.thickness:
        yield f"{key}.bevel: {flange.bevel:g} mm off {flange.thickness:g} mm, twice, leaves no wall; make it smaller"
        return
    web = WEB + flange.bevel + lean
    corner = getattr(flange.outline, "corner_radius", 0.0)
    if 0 < corner <= flange.bevel + lean:
        yield (
            f"{key}.outline.corner_radius: {corner:g} mm, of which bevel and draft take {flange.bevel + lean:.3g} mm; "
            "make it larger, or 0"
        )
        return
    if not flange.outline.outline.depth(*rim.outline.places()).min() >= web:
        yield f"{key}.outline: does not reach {web:.3g} mm beyond the lens's rim everywhere; make it larger"
        return
    front = lens.front.z if lens.front.free else sag(lens.front.surface, *rim.outline.places())
    low, high = float(np.min(front)), float(np.max(front))
    if upper <= high or flange.z >= lens.back.z:
        yield (
            f"{key}.z: the flange lies from z = {flange.z:g} to {upper:g} mm and the lens from "
            f"{high:.6g} to {lens.back.z:g} mm before it is tailored; let them meet"
        )
    elif low <= flange.z <= high and not lens.front.surface.level and not lens.front.free:
        yield (
            f"{key}.z: the flange's lower face, z = {flange.z:g} mm, cuts the rim of the front, which runs from z = "
            f"{low:.6g} to {high:.6g} mm; put it below or above that"
        )
    holes = flange.all_holes()
    for k, (x, y, diameter) in enumerate(holes, start=1):
        at = f"{key}: hole {k}, of {diameter:g} mm at ({x:.4g}, {y:.4g}) mm,"
        if not diameter > 0:
            yield f"{at} has no width; give a diameter above zero"
        elif not flange.outline.outline.depth(x, y) >= diameter / 2 + web:
            yield f"{at} leaves less than {web:.3g} mm to the flange's edge; move it inwards"
        elif not -rim.outline.depth(x, y) >= diameter / 2 + WEB:
            yield f"{at} leaves less than {WEB:g} mm to the lens's rim; move it outwards"
        for m, (x1, y1, other) in enumerate(holes[: k - 1], start=1):
            if not math.hypot(x - x1, y - y1) >= (diameter + other) / 2 + WEB:
                yield f"{at} leaves less than {WEB:g} mm to hole {m}; move one of them"
