"""How much work goes into a surface, and how exactly its lens is made, mounted and lit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

from bstcad.optics.key import Key
from bstcad.optics.sides import MIN_SIDE, Sides, as_pair, coarser, side
from bstcad.scene.blank import LensBlank
from bstcad.scene.schema import OneOrTwo, Record

COMMON = {"method": "least-squares", "transport_iterations": 40, "stage1_iterations": 1000, "rounds": 10}
OURS = COMMON | {"overshoot": 0.03, "precision": "float64"}
# The knobs of each quality; a knob set in the scene goes before.
PRESETS: dict[str, dict[str, Any]] = {
    "draft": OURS | {"transport_grid": 256, "rays": 512, "stage2_iterations": 8, "source_points": 16},
    "standard": OURS | {"transport_grid": 512, "rays": 1536, "stage2_iterations": 98, "source_points": 64},
    "fine": OURS | {"transport_grid": 512, "rays": 2048, "stage2_iterations": 300, "source_points": 128},
    "paper": COMMON  # the procedure of Wang et al. 2023: Adam, no penalty
    | {"method": "adam", "overshoot": 0.0, "precision": "float32"}
    | {"transport_grid": 1024, "rays": 1024, "stage2_iterations": 500, "source_points": 64},
}
WHOLE = {  # methods that run to their end and know no bounds, and the key by which a scene asks for another
    "adam": ("the paper's procedure", "tailoring.quality"),
    "integration": ("point-by-point integration", "tailoring.method"),
}
COARSEST_GRID = 64  # cells a side of the transport in stage 1's first rounds: so many cost next to nothing
JUDGE_POINTS = 32  # of an extended source in the pictures and margins of a verification, not in its RRMSD
JUDGE_DRAW = 1 << 12  # the number of their draw; each further line of a spectrum takes the next number


class Tailoring(Record):
    """How much work goes into the surface; a knob that is None takes its quality's value (PRESETS)."""

    quality: Annotated[Literal["draft", "standard", "fine", "paper"], Key("More work, less error.")] = "standard"
    seed: Annotated[int, Key("Seed of every random choice.", "", 0, 2**63 - 1)] = 0
    method: Annotated[
        Literal["least-squares", "adam", "integration"] | None,
        Key(
            "Stage 1: slope maps, the paper's procedure, or point-by-point integration without a stage 2.",
            example="least-squares",
        ),
    ] = None
    levels: Annotated[
        tuple[OneOrTwo, ...] | None,
        Key("Nets, coarse to fine: control points along the longer side, or [x, y].", "", 5, 2049, example=[129, 257]),
    ] = None
    transport_grid: Annotated[int | None, Key("Cells a side of the transport problem.", "", 16, 2049, example=512)] = (
        None
    )
    transport_iterations: Annotated[
        int | None, Key("Iterations of the transport problem.", "", 1, 100_000, example=100)
    ] = None
    rays: Annotated[int | None, Key("Rays or ray tubes along one side of the light.", "", 16, 16_384)] = None
    stage1_iterations: Annotated[
        int | None, Key("Steps a level of the method adam.", "", 0, 1_000_000, example=300)
    ] = None
    rounds: Annotated[
        int | None, Key("The most rounds of transport map and slope fit in stage 1.", "", 1, 100, example=10)
    ] = None
    stage2_iterations: Annotated[int | None, Key("Iterations of stage 2.", "", 0, 1_000_000, example=120)] = None
    overshoot: Annotated[
        float | None, Key("Weight of light outside the target, a pixel^2.", "", 0.0, 1e3, example=0.03)
    ] = None
    source_points: Annotated[
        int | None, Key("Points that tell how wide an extended source's image is.", "", 2, 4096)
    ] = None
    solution: Annotated[
        Literal["convex", "concave"] | None,
        Key("Of two pictures: rays do not cross between them, or all do; chosen if absent.", example="concave"),
    ] = None
    precision: Annotated[
        Literal["float32", "float64"] | None, Key("Numbers that tailoring works with.", example="float64")
    ] = None
    accuracy: Annotated[float | None, Key("RRMSD at which tailoring ends.", "", 1e-6, 10.0, example=0.05)] = None
    max_time: Annotated[
        float | None, Key("Time from command to report; stage 1 runs whole.", "s", 1.0, 1e7, example=60.0)
    ] = None

    @property
    def points_of_source(self) -> int:
        """That stand for an extended source, whatever the net."""
        return self.source_points or PRESETS[self.quality]["source_points"]

    @property
    def side(self) -> int:
        """Control points a side of the square net of as many as the finest of `levels` has; of a resolved one."""
        return side(self.levels[-1])

    def resolved(self, net: Sides) -> Tailoring:
        """The same with every knob set, for a net of so many control points a side, or along x and along y.

        Levels of an oblong net are pairs, with cells of the shape that the net's have.
        If not given: at least two rays a control cell each way (a draft: in all), at most two cells of the transport.
        """
        levels = tuple(level if isinstance(level, tuple) else coarser(net, level) for level in self.levels or ())
        preset = dict(PRESETS[self.quality], levels=levels or coarse_to_fine(net))
        # fewer than two each way leave a checkerboard that no ray sees; a draft's few steps do not get that far
        each_way = 2**0.5 if self.quality == "draft" else 2
        preset["rays"] = max(preset["rays"], math.ceil(each_way * side(net)))
        if (self.method or preset["method"]) == "integration":
            preset["stage2_iterations"] = 0
        if self.quality != "paper":  # no net follows a finer map, which folds in corners
            preset["transport_grid"] = min(preset["transport_grid"], max(2 * (max(as_pair(net)) - 1), COARSEST_GRID))
        given = self.model_dump(exclude_none=True, exclude={"levels"})
        return Tailoring.model_validate(preset | given)

    def complaints(self, lens: LensBlank) -> Iterator[str]:
        """Levels that do not lead to the net, and keys that the method cannot keep to."""
        levels, stated = self.levels, lens.back.control_points is not None
        net = lens.back.net if stated else (levels or (MIN_SIDE,))[-1]
        most = max(as_pair(net))
        if levels is not None and levels[-1:] not in ((net,), (most,)):
            yield f"tailoring.levels: must end with the back's control_points, {most}; add it at the end"
        if any(max(as_pair(coarse)) >= max(as_pair(fine)) for coarse, fine in pairwise(levels or ())):
            yield f"tailoring.levels: {list(levels)} does not grow; list the nets from coarse to fine"
        who, other = WHOLE.get(self.resolved(net).method, ("", ""))
        for name in ("accuracy", "max_time"):
            if who and getattr(self, name) is not None:
                yield f"tailoring.{name}: {who} runs to its end; remove it or choose another {other}"
        if who and lens.bounded_by:
            yield f"lens.{lens.bounded_by[0]}: {who} knows no such bounds; remove it, or choose another {other}"
        if who and lens.front.shaped:
            yield f"lens.front.optimise: {who} finds no freeform front; remove it, or choose another {other}"
        if self.method == "integration" and lens.front.free:
            front = "remove it and give the front as it shall be"
            yield f"lens.front.optimise: {who} finds no front; {front}, or choose another {other}"
        if self.method == "integration" and self.stage2_iterations:
            yield f"tailoring.stage2_iterations: {who} is followed by no stage 2; remove it or choose another {other}"


def coarse_to_fine(net: Sides) -> tuple[Sides, ...]:
    """Nets of 33, 129 and 513 control points (along the longer side) as far as clearly coarser, then the net itself."""
    most = max(as_pair(net))
    return (*(coarser(net, m) for m in (33, 129, 513) if 1.5 * m < most), net)


# ---- [[tolerance]]: none by default; a later table goes before an earlier one ---------------------------------------

# An error, or several that begin so: "lens.decentre" is those in x and in y.
Name = Literal[
    "lens.decentre", "lens.decentre_x", "lens.decentre_y", "lens.axial",
    "lens.tilt", "lens.tilt_x", "lens.tilt_y", "lens.clocking",
    "lens.thickness", "lens.index", "lens.front_power", "lens.scale", "temperature",
    "back.form", "back.ripple", "front.form",
    "front.decentre", "front.decentre_x", "front.decentre_y", "lens.wedge", "lens.wedge_x", "lens.wedge_y",
    "source.decentre", "source.decentre_x", "source.decentre_y", "source.axial",
    "source.tilt", "source.tilt_x", "source.tilt_y", "source.angle", "source.size", "wavelength",
    "screen.decentre", "screen.decentre_x", "screen.decentre_y", "screen.axial",
    "screen.tilt", "screen.tilt_x", "screen.tilt_y", "screen.clocking",
]  # fmt: skip
FORM, RIPPLE = ("back.form", "front.form"), ("back.ripple",)
OF_FACES = {"correlation_length": FORM, "period": RIPPLE, "pattern": RIPPLE}  # keys that only these have
OF_TWO_FACES = ("front.", "lens.wedge")  # errors of a lens that refracts at two faces; only off where they are named
NONE = "none"  # a grade: cannot be off


class Tolerance(Record):
    """The errors of one name; None: an earlier table, or the grade, holds."""

    name: Annotated[Name | None, Key("The error, or the errors that begin so; all if absent.")] = None
    grade: Annotated[
        Literal["moulded", "diamond-turned", "precise", "none"] | None, Key("The limit of that grade; none: never off.")
    ] = None
    limit: Annotated[
        float | None,
        Key("Limit (+-) in the error's unit; of ripple the most RMS, of form the RMS over all lenses.", "", 1e-12, 1e4),
    ] = None
    distribution: Annotated[
        Literal["normal", "uniform"] | None, Key("normal is cut at the limit, two standard deviations.")
    ] = None
    cost: Annotated[float | None, Key("Cost of holding the limit, relative to the other errors.", "", 1e-6, 1e6)] = None
    correlation_length: Annotated[float | None, Key("Correlation length of a form error.", "mm", 1e-3, 1e4)] = None
    period: Annotated[float | None, Key("Period of a ripple.", "mm", 1e-3, 1e4, example=0.02)] = None
    pattern: Annotated[
        Literal["raster", "spiral"] | None, Key("Marks of the tool that make the ripple.", example="spiral")
    ] = None

    def covers(self, error: str) -> bool:
        """Is it of this error?"""
        return self.name is None or error == self.name or error.startswith(f"{self.name}_")

    @property
    def stated(self) -> dict[str, Any]:
        """The keys that are given, without the name."""
        return self.model_dump(exclude={"name"}, exclude_none=True)


def settings_of(tables: Sequence[Tolerance], error: str) -> dict[str, Any]:
    """The keys that all tables give of an error; of a grade and a limit the later."""
    merged: dict[str, Any] = {}
    for stated in (table.stated for table in tables if table.covers(error)):
        for one, other in (("grade", "limit"), ("limit", "grade")):
            if one in stated:
                merged.pop(other, None)
        merged |= stated
    return merged


def tolerance_complaints(tables: Sequence[Tolerance]) -> Iterator[str]:
    """Everything that is wrong with the tables by themselves."""
    for k, table in enumerate(tables):
        where, stated = f"tolerance[{k}]", table.stated
        if not stated:
            yield f"{where}: says nothing of its errors; add a limit or a grade"
        if "limit" in stated and "grade" in stated:
            yield f"{where}: has both a limit and a grade; give one of them"
        if "limit" in stated and table.name is None:
            yield f'{where}.limit: {table.limit:g} holds for no one error; add which, such as name = "lens.decentre"'
        for key, names in OF_FACES.items():
            if key in stated and table.name not in names:
                yield f"{where}.{key}: is for {' and '.join(names)}; remove it or change the name"
        if "distribution" in stated and table.name in FORM:
            yield f"{where}.distribution: a form error is a random field, and its amounts are normal; remove it"
