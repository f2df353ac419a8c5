"""The table [accept]: limits of the checks in the report, among them test points and values of the light."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, Literal

from pydantic import Field, model_serializer

from bstcad.optics.light.emitters import Emitter
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.key import Key
from bstcad.scene.schema import COORDINATES, LENGTHS, Record
from bstcad.scene.target import MAX_TARGETS, Target

CUT_OFF_STEP = 0.1  # degrees; step of a cut-off over directions if the scene states none (UN Regulation No. 112)
MAX_POINTS = 200  # largest number of test points of a scene
MIN_RADIUS = 0.5  # smallest radius of a disc for a mean, in pixels
LIMITS = (0.0, 1e12)  # range of limits of the light

TargetNumber = Annotated[int, Key("Number of the target, counted from 0.", "", 0, MAX_TARGETS - 1, example=0)]


class PointLimit(Record):
    """A test point: the mean of the light over a disc has to be within limits."""

    name: Annotated[str, Field(max_length=60), Key("Name of the point; its number if absent.", example="B50L")] = ""
    at: Annotated[
        tuple[float, float],
        Key("Position [x, y] on the target: mm, or over directions degrees.", "", *COORDINATES, example=[0.0, 0.0]),
    ]
    target: TargetNumber = 0
    least: Annotated[float | None, Key("Smallest value allowed, in `unit`.", "", *LIMITS, example=0.5)] = None
    most: Annotated[float | None, Key("Largest value allowed, in `unit`.", "", *LIMITS, example=1.5)] = None
    unit: Annotated[
        Literal["relative", "lx", "cd"],
        Key("Unit: relative to the mean over the target's lit pixels, lx on planes, cd over directions."),
    ] = "relative"
    radius: Annotated[
        float | None, Key("Radius of the disc in mm or degrees; one pixel if absent.", "", *LENGTHS, example=1.0)
    ] = None


class Uniformity(Record):
    """Uniformity of the light over the even part of a target, its brightest pixels, from means over discs."""

    target: TargetNumber = 0
    min_to_mean: Annotated[
        float | None, Key("Least ratio of the smallest to the mean light of the even part.", "", 0.0, 1.0, example=0.4)
    ] = None
    min_to_max: Annotated[
        float | None,
        Key("Least ratio of the smallest to the largest light of the even part.", "", 0.0, 1.0, example=0.2),
    ] = None
    radius: Annotated[float | None, Key("Radius of the discs in mm or degrees; one pixel if absent.", "", *LENGTHS)] = (
        None
    )


class CutOff(Record):
    """Sharpness of a cut-off, the largest log10 E(y) - log10 E(y + step) along a vertical line."""

    target: TargetNumber = 0
    at: Annotated[
        float, Key("Position x of the vertical line, in mm or degrees.", "", *COORDINATES, example=2.5)
    ]  # fmt: skip
    step: Annotated[
        float | None,
        Key("Step of y in mm or degrees; 0.1 degrees if absent, on planes one pixel.", "", *LENGTHS, example=0.1),
    ] = None
    least: Annotated[float | None, Key("Smallest sharpness allowed.", "", 0.0, 100.0, example=0.13)] = None
    most: Annotated[float | None, Key("Largest sharpness allowed.", "", 0.0, 100.0, example=0.4)] = None


class Accept(Record):
    """Limits of the checks in the report; with None the check only states its value."""

    rrmsd: Annotated[
        float | None, Key("Maximum RRMSD of light on the pixels of a target.", "", 1e-6, 10.0, of_light=True)
    ] = None
    rrmsd_half: Annotated[
        float | None,
        Key("Maximum RRMSD of light on a target, on half pixels.", "", 1e-6, 10.0, example=0.1, of_light=True),
    ] = None
    form: Annotated[float, Key("Maximum deviation of lens.step from the tailored faces.", "mm", 1e-12, 1.0)] = 1e-6
    efficiency: Annotated[
        float | None, Key("Minimum flux on target / flux behind the lens.", "", 0.0, 1.0, example=0.9, of_light=True)
    ] = None
    light_on_target: Annotated[
        float | None, Key("Minimum flux on the target / flux that meets the lens.", "", 0.0, 1.0, of_light=True)
    ] = None
    leak: Annotated[
        float | None, Key("Maximum flux on dark pixels / flux on the target.", "", 0.0, 1.0, of_light=True)
    ] = None
    decentre: Annotated[float | None, Key("Maximum decentre of a measured part.", "mm", 1e-6, 1e3)] = None
    wavefront: Annotated[
        float | None, Key("Maximum RMS wavefront error, in waves.", "", 1e-9, 1e6, example=0.1, of_light=True)
    ] = None
    point: Annotated[
        tuple[PointLimit, ...],
        Field(max_length=MAX_POINTS),
        Key("Test points, each with limits of the light: [[accept.point]] tables.", of_light=True),
    ] = ()
    uniformity: Annotated[
        Uniformity | None,
        Key("Limits of the uniformity over the even part of a target, without soft edges.", of_light=True),
    ] = None
    cut_off: Annotated[
        CutOff | None, Key("Limits of the sharpness of a cut-off along a vertical line.", of_light=True)
    ] = None
    glare: Annotated[
        tuple[float, float, float] | None,
        Key("Maxima at 70, 80, 90 degrees.", "cd/klm", 0.0, 1e6, example=[350.0, 100.0, 10.0], of_light=True),
    ] = None

    @model_serializer(mode="wrap")
    def _written(self, handler: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        """Return the table without an empty list of points, as in earlier scenes."""
        return {name: value for name, value in handler(self).items() if value or name != "point"}

    @property
    def limits_light(self) -> bool:
        """True if a key limits the light."""
        for name, field in Accept.model_fields.items():
            marked = any(isinstance(key, Key) and key.of_light for key in field.metadata)
            if marked and getattr(self, name) not in (None, ()):
                return True
        return False

    def complaints(self, targets: Sequence[Target], source: Emitter) -> Iterator[str]:
        """Yield complaints about limits that do not apply to these targets, or need a luminous flux."""
        for k, point in enumerate(self.point):
            yield from _limit_complaints(f"accept.point[{k}]", point, ("least", "most"), targets)
            yield from _point_complaints(f"accept.point[{k}]", point, targets, source)
        if self.uniformity is not None:
            yield from _limit_complaints("accept.uniformity", self.uniformity, ("min_to_mean", "min_to_max"), targets)
            if self.uniformity.target < len(targets):
                yield from _radius_complaints(
                    "accept.uniformity", self.uniformity.radius, targets[self.uniformity.target]
                )
        if self.cut_off is not None:
            yield from _limit_complaints("accept.cut_off", self.cut_off, ("least", "most"), targets)
            if self.cut_off.target < len(targets):
                yield from _cut_off_complaints(self.cut_off, targets[self.cut_off.target])


def _limit_complaints(key: str, table: Any, names: Sequence[str], targets: Sequence[Target]) -> Iterator[str]:
    """Yield complaints about a table without limits, with crossed limits, or of a target that the scene lacks."""
    first, second = (getattr(table, name) for name in names)
    if first is None and second is None:
        yield f"{key}: has no limit; give {names[0]}, {names[1]} or both"
    if "most" in names and first is not None and second is not None and first > second:
        yield f"{key}.least: {first:g} is larger than most = {second:g}; exchange them"
    if table.target >= len(targets):
        yield f"{key}.target: the scene has no target[{table.target}]; its targets are counted from 0"


def _point_complaints(key: str, point: PointLimit, targets: Sequence[Target], source: Emitter) -> Iterator[str]:
    """Yield complaints about a point beside its target, or whose unit does not apply."""
    if not point.name.isprintable():  # the terminal prints it
        yield f"{key}.name: must be one line of printable characters; shorten it"
    if point.target >= len(targets):
        return
    target = targets[point.target]
    for value, axis, (low, high) in zip(point.at, "xy", (target.x, target.y), strict=True):
        if not low <= value <= high:
            beside = f"{axis} = {value:g} is outside of the target, {low:g} to {high:g} {target.unit}"
            yield f"{key}.at: {beside}; move the point, or widen target.{axis}"
    if point.unit not in (own := ("relative", target.screen.receiver.photometric_unit)):
        units = " or ".join(f'"{unit}"' for unit in own if unit)
        yield f"{key}.unit: the light on this target is not measured in {point.unit}; write {units}"
    if point.unit != "relative" and source.luminous_flux is None:
        yield f'{key}.unit: {point.unit} needs the flux of the source; set source.lumens, or unit = "relative"'
    yield from _radius_complaints(key, point.radius, target)


def _radius_complaints(key: str, radius: float | None, target: Target) -> Iterator[str]:
    """Yield a complaint about a disc that is smaller than a pixel of the target, or larger than the target."""
    if radius is not None and radius > (most := math.hypot(*target.size)):
        yield f"{key}.radius: {radius:g} {target.unit} is more than the target's diagonal, {most:.3g}; make it smaller"
    if radius is not None and radius < (least := MIN_RADIUS * pixel_size(target.screen)):
        small = f"{radius:g} {target.unit} is less than {MIN_RADIUS:g} pixels, {least:.3g} {target.unit}"
        yield f"{key}.radius: {small}; make it larger, or set more target.pixels"


def _cut_off_complaints(cut_off: CutOff, target: Target) -> Iterator[str]:
    """Yield complaints about a line beside the target, or a step that the pixels do not resolve."""
    (left, right), (low, high) = target.x, target.y
    if not left <= cut_off.at <= right:
        beside = f"{cut_off.at:g} is outside of the target, {left:g} to {right:g} {target.unit}"
        yield f"accept.cut_off.at: {beside}; move the line, or widen target.x"
    pixel, step = (high - low) / target.columns_rows[1], step_of(cut_off, target.screen)
    if step < pixel * (1 - 1e-9):
        coarse = f"a step of {step:g} {target.unit} is less than a pixel of {pixel:.3g} {target.unit}"
        yield f"accept.cut_off.step: {coarse}; set more target.pixels, or a larger step"
    if step > (high - low) / 2:
        yield f"accept.cut_off.step: {step:g} {target.unit} is more than half of the target; make it smaller"


def pixel_size(screen: Screen) -> float:
    """Return the longer side of a screen's pixels, in its unit."""
    (left, right), (low, high) = screen.x, screen.y
    return max((right - left) / screen.columns, (high - low) / screen.rows)


def step_of(cut_off: CutOff, screen: Screen) -> float:
    """Return the step of a cut-off in the screen's unit."""
    if cut_off.step is not None:
        return cut_off.step
    return CUT_OFF_STEP if screen.receiver.unit == "degrees" else (screen.y[1] - screen.y[0]) / screen.rows
