"""How a lens is held: [mount], none by default; with it a design's folder holds part.step, the lens as a part."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from bstcad.optics.outlines import Outline
from bstcad.optics.surfaces import sag
from bstcad.scene.target import Record

if TYPE_CHECKING:
    from bstcad.scene.wanted import Wanted

MOST_DRAFT = 30.0  # degrees, of a lens's own walls
WEB = 0.1  # mm; the least that is left between a hole and any other edge
PLACES = 720  # along an outline, where two are held against each other


class Round(Record):
    """A circle about the lens's axis."""

    shape: Literal["circle"]
    diameter: float  # mm

    def depth(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """How deep a place lies inside (mm), outside below zero."""
        return self.diameter / 2 - np.hypot(x, y)

    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """x and y (mm) along it."""
        turn = np.arange(PLACES) * 2 * np.pi / PLACES
        return self.diameter / 2 * np.cos(turn), self.diameter / 2 * np.sin(turn)


class Box(Record):
    """A rectangle about the lens's axis, its corners rounded or sharp."""

    shape: Literal["rectangle"]
    width: float  # mm, along x
    height: float  # mm, along y
    corner_radius: float = 0.0  # mm

    def depth(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """How deep a place lies inside (mm), outside below zero."""
        r = self.corner_radius
        a, b = np.abs(x) - (self.width / 2 - r), np.abs(y) - (self.height / 2 - r)
        return r - np.hypot(np.maximum(a, 0.0), np.maximum(b, 0.0)) - np.minimum(np.maximum(a, b), 0.0)

    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """x and y (mm) along it."""
        r, turn = self.corner_radius, np.arange(PLACES) * 2 * np.pi / PLACES
        x, y = np.cos(turn), np.sin(turn)
        flat = np.linspace(-1, 1, PLACES // 4)
        a, b = self.width / 2, self.height / 2
        sides = [(flat * (a - r), 0 * flat + end * b) for end in (-1, 1)]
        sides += [(0 * flat + end * a, flat * (b - r)) for end in (-1, 1)]
        sides.append((np.sign(x) * (a - r) + r * x, np.sign(y) * (b - r) + r * y))
        return tuple(np.concatenate(each) for each in zip(*sides, strict=True))


Shape = Annotated[Round | Box, Field(discriminator="shape")]


class Screws(Record):
    """Holes through the flange, evenly around the axis."""

    count: int
    diameter: float  # mm, of each
    circle: float  # mm, diameter of the circle on which their centres lie
    first: float = 90.0  # degrees from +x towards +y, of one of them

    def holes(self) -> Iterator[tuple[float, float, float]]:
        """x, y and diameter (mm) of each."""
        for k in range(self.count):
            turn = math.radians(self.first + 360.0 * k / self.count)
            yield self.circle / 2 * math.cos(turn), self.circle / 2 * math.sin(turn), self.diameter


class Flange(Record):
    """A plate around the lens, one part with it, from `z` upwards; its lower face, at z, is what it is put down on."""

    outline: Shape
    z: float  # mm, in the scene's frame
    thickness: float  # mm
    screws: Screws | None = None
    holes: tuple[tuple[float, float, float], ...] = ()  # x, y and diameter (mm) of further holes through it
    draft: float = 0.0  # degrees, by which its outer walls lean inwards above
    bevel: float = 0.0  # mm, of the edges of its outer walls, at 45 degrees

    def all_holes(self) -> list[tuple[float, float, float]]:
        """x, y and diameter (mm) of the screws' holes and of the further ones."""
        return [*(self.screws.holes() if self.screws else ()), *self.holes]


class Mount(Record):
    """The lens as a part: what its rim is cut to, a flange, and where the file's origin lies."""

    datum: Literal["source", "front", "flange"] = "source"  # z = 0 of part.step: the scene's; the front's vertex; …
    rim: Shape | None = None  # None: lens.outline
    draft: float = 0.0  # degrees, by which the lens's own walls lean inwards towards the front
    bevel: float = 0.0  # mm along z, taken at 45 degrees off their edge with the front
    flange: Flange | None = None

    def rim_of(self, outline: Outline) -> Round | Box:
        """What the rim of a lens of that outline is in the part."""
        return _whole(outline) if self.rim is None else self.rim


def said(scene: Wanted) -> Iterator[str]:
    """What is wrong with the mount; each complaint is one sentence with a remedy."""
    mount = scene.mount
    if mount is None:
        return
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
        x, y = mount.rim.places()
        if (_inside_lens(scene, x, y) < -1e-9).any():
            yield "mount.rim: reaches beyond lens.outline; make it smaller, or the lens larger"
    if mount.datum == "flange" and mount.flange is None:
        yield 'mount.datum: "flange", but there is no [mount.flange]; add one, or choose "front" or "source"'
    yield from _walls(scene, mount)
    if mount.flange is not None:
        yield from _flange(scene, mount.flange)


def _inside_lens(scene: Wanted, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """How deep places lie inside the lens's outline (mm)."""
    return _whole(scene.lens.outline).depth(x, y)


def _whole(outline: Outline) -> Round | Box:
    if outline.shape == "circle":
        return Round(shape="circle", diameter=2 * outline.radius)
    return Box(shape="rectangle", width=outline.width, height=outline.height)


def _walls(scene: Wanted, mount: Mount) -> Iterator[str]:
    """The lens's own, below its back or its flange, before it is tailored."""
    if not (mount.draft or mount.bevel):
        return
    rim, key = mount.rim_of(scene.lens.outline), "mount.draft" if mount.draft else "mount.bevel"
    front = sag(scene.lens.front.surface, *rim.places())
    top = scene.lens.back.z if mount.flange is None else mount.flange.z
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
    elif not taken < (half := float(rim.depth(np.float64(0.0), np.float64(0.0)))):
        yield f"{key}: draft and bevel take {taken:.3g} mm off {half:g} mm from rim to axis; make them smaller"


def _flange(scene: Wanted, flange: Flange) -> Iterator[str]:
    rim, key = scene.mount.rim_of(scene.lens.outline), "mount.flange"
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
    if not flange.outline.depth(*rim.places()).min() >= web:
        yield f"{key}.outline: does not reach {web:.3g} mm beyond the lens's rim everywhere; make it larger"
        return
    if upper <= scene.lens.front.z or flange.z >= scene.lens.back.z:
        yield (
            f"{key}.z: the flange lies from z = {flange.z:g} to {upper:g} mm and the lens from "
            f"{scene.lens.front.z:g} to {scene.lens.back.z:g} mm before it is tailored; let them meet"
        )
    holes = flange.all_holes()
    for k, (x, y, diameter) in enumerate(holes, start=1):
        at = f"{key}: hole {k}, of {diameter:g} mm at ({x:.4g}, {y:.4g}) mm,"
        if not diameter > 0:
            yield f"{at} has no width; give a diameter above zero"
        elif not flange.outline.depth(x, y) >= diameter / 2 + web:
            yield f"{at} leaves less than {web:.3g} mm to the flange's edge; move it inwards"
        elif not -_depth(rim, x, y) >= diameter / 2 + WEB:
            yield f"{at} leaves less than {WEB:g} mm to the lens's rim; move it outwards"
        for m, (x1, y1, other) in enumerate(holes[: k - 1], start=1):
            if not math.hypot(x - x1, y - y1) >= (diameter + other) / 2 + WEB:
                yield f"{at} leaves less than {WEB:g} mm to hole {m}; move one of them"


def _depth(rim: Round | Box, x: float, y: float) -> float:
    return float(rim.depth(np.float64(x), np.float64(y)))
