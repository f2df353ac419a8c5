"""The effort of tailoring, [tailoring], and the tolerances of a lens, [[tolerance]]."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

from bstcad.optics.surfaces.key import Key
from bstcad.optics.surfaces.sides import MIN_SIDE, Sides, as_pair, coarser, side
from bstcad.scene.blank import LensBlank
from bstcad.scene.schema import NET_SIZES, OneOrTwo, Record
from bstcad.tailoring.settings import COARSEST_GRID, Method, Precision, Settings, Solution

COMMON_PRESET = {"method": "least-squares", "transport_iterations": 40, "stage1_iterations": 1000, "rounds": 10}
OWN_PRESET = COMMON_PRESET | {"overshoot": 0.03, "precision": "float64"}  # settings of bstcad's own qualities
# Settings of each quality; a setting that the scene states has priority.
PRESETS: dict[str, dict[str, Any]] = {
    "draft": OWN_PRESET | {"transport_grid": 256, "rays": 512, "stage2_iterations": 12, "source_points": 16},
    "standard": OWN_PRESET | {"transport_grid": 512, "rays": 1536, "stage2_iterations": 98, "source_points": 64},
    "fine": OWN_PRESET | {"transport_grid": 512, "rays": 2048, "stage2_iterations": 300, "source_points": 128},
    "paper": COMMON_PRESET  # the procedure of Wang et al. 2023: Adam, no penalty
    | {"method": "adam", "overshoot": 0.0, "precision": "float32"}
    | {"transport_grid": 1024, "rays": 1024, "stage2_iterations": 500, "source_points": 64},
}
BASELINES = {  # method without limits of time, accuracy or shape: (name in messages, key that selects another one)
    "adam": ("the paper's procedure", "tailoring.quality"),
    "integration": ("point-by-point integration", "tailoring.method"),
}
VERIFICATION_POINTS = 32  # points of an extended source in a verification; the RRMSD uses random points instead
VERIFICATION_SET = 1 << 12  # number of the set of these points; each further spectral line has the next number


class Tailoring(Record):
    """The effort of tailoring; a setting that is None has the value of PRESETS[quality], if any (see `resolved`)."""

    quality: Annotated[
        Literal["draft", "standard", "fine", "paper"], Key("Effort: fast to accurate, or paper (Wang et al. 2023).")
    ] = "standard"
    seed: Annotated[int, Key("Seed of all random numbers.", "", 0, 2**63 - 1)] = 0
    method: Annotated[
        Method | None,
        Key("Method: least squares, adam (paper) or integration; that of quality if absent.", example="least-squares"),
    ] = None
    levels: Annotated[
        tuple[OneOrTwo, ...] | None, Key("Control points per side, coarse to fine.", "", *NET_SIZES, example=[129, 257])
    ] = None
    transport_grid: Annotated[int | None, Key("Cells per side of the transport map.", "", 16, 2049, example=512)] = None
    transport_iterations: Annotated[
        int | None, Key("Maximum number of iterations of the transport map.", "", 1, 100_000, example=100)
    ] = None
    rays: Annotated[int | None, Key("Flux tubes (method adam: rays) per side of their grid.", "", 16, 16_384)] = None
    stage1_iterations: Annotated[
        int | None, Key("Steps of stage 1 for each net, with method adam.", "", 0, 1_000_000, example=300)
    ] = None
    rounds: Annotated[int | None, Key("Maximum rounds of map and slope fit in stage 1.", "", 1, 100, example=10)] = None
    stage2_iterations: Annotated[
        int | None, Key("Maximum number of evaluations of the merit in stage 2 or 3.", "", 0, 1_000_000, example=120)
    ] = None
    overshoot: Annotated[
        float | None, Key("Weight of light beside the target, per pixel² of distance.", "", 0.0, 1e3, example=0.03)
    ] = None
    source_points: Annotated[int | None, Key("Number of points that represent an extended source.", "", 2, 4096)] = None
    solution: Annotated[
        Solution | None,
        Key("For two faces and two targets: no rays (convex) or all (concave) cross between them.", example="concave"),
    ] = None
    precision: Annotated[Precision | None, Key("Precision in tailoring.", example="float64")] = None
    accuracy: Annotated[float | None, Key("RRMSD on pixels at which tailoring ends.", "", 1e-6, 10.0, example=0.05)] = (
        None
    )
    max_time: Annotated[
        float | None, Key("Maximum time, report included; stage 1 is always completed.", "s", 1.0, 1e7, example=60.0)
    ] = None

    @property
    def points_of_source(self) -> int:
        """Number of points that represent an extended source."""
        return self.source_points or PRESETS[self.quality]["source_points"]

    @property
    def chosen_method(self) -> str:
        """Method that the scene states, or else the method of its quality."""
        return self.method or PRESETS[self.quality]["method"]

    def resolved(self, net: Sides) -> Settings:
        """Return the settings with all values set; net: control points per side of the back, or along x and along y.

        Levels of an oblong net become pairs with its proportions.  Defaults: at least two rays per cell of the net
        along x and along y (draft: √2); the transport grid of PRESETS, reduced to twice the net's cells per side, but
        not below COARSEST_GRID (paper: not reduced).
        """
        levels = tuple(level if isinstance(level, tuple) else coarser(net, level) for level in self.levels or ())
        preset = dict(PRESETS[self.quality], levels=levels or coarse_to_fine(net))
        # With fewer than two rays per cell and direction a checkerboard grows in the net, slowly enough for a draft.
        rays_per_cell = 2**0.5 if self.quality == "draft" else 2
        preset["rays"] = max(preset["rays"], math.ceil(rays_per_cell * side(net)))
        if self.method == "integration":
            preset["stage2_iterations"] = 0
        if self.quality != "paper":  # a finer map has folds in corners, which a net cannot follow
            preset["transport_grid"] = min(preset["transport_grid"], max(2 * (max(as_pair(net)) - 1), COARSEST_GRID))
        given = self.model_dump(exclude_none=True, exclude={"levels", "quality"})
        return Settings(**preset | given)

    def complaints(self, lens: LensBlank) -> Iterator[str]:
        """Yield the faults: levels that do not rise to those of the net, and keys that the method does not support."""
        levels, stated = self.levels or (), lens.back.control_points is not None
        net = lens.back.net if stated else (levels or (MIN_SIDE,))[-1]
        points = max(as_pair(net))
        if self.levels is not None and levels[-1:] not in ((net,), (points,)):
            yield f"tailoring.levels: must end with lens.back.control_points, {points}; add it at the end"
        if any(max(as_pair(coarse)) >= max(as_pair(fine)) for coarse, fine in pairwise(levels)):
            yield f"tailoring.levels: {list(levels)} does not increase; list the nets from coarse to fine"
        who, other = BASELINES.get(self.chosen_method, ("", ""))
        for name in ("accuracy", "max_time"):
            if who and getattr(self, name) is not None:
                yield f"tailoring.{name}: {who} cannot end early; remove this key, or choose another {other}"
        if who and lens.bounded_by:
            yield f"lens.{lens.bounded_by[0]}: {who} has no such bounds; remove this key, or choose another {other}"
        if who and lens.front.is_tailored:
            yield f"lens.front.optimise: {who} cannot tailor the front; remove this key, or choose another {other}"
        if self.method == "integration" and lens.front.free:
            fixed = "remove this key and give the final front"
            yield f"lens.front.optimise: {who} cannot optimise a front; {fixed}, or choose another {other}"
        if self.method == "integration" and self.stage2_iterations:
            yield f"tailoring.stage2_iterations: {who} has no stage 2; remove this key, or choose another {other}"


def coarse_to_fine(net: Sides) -> tuple[Sides, ...]:
    """Return nets of 33, 129 and 513 control points on the longer side (those below 2/3 of net's), then `net`."""
    points = max(as_pair(net))
    return (*(coarser(net, m) for m in (33, 129, 513) if 1.5 * m < points), net)


# ---- [[tolerance]]: none by default; a later table replaces values of an earlier one ---------------------------------

# Names of errors; "lens.decentre" means both lens.decentre_x and lens.decentre_y, and so on.
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
FACE_ERRORS = {"correlation_length": FORM, "period": RIPPLE, "pattern": RIPPLE}  # key -> errors that can have this key
FINISH_KEYS = ("layer_height", "smoothing_length", "roughness", "roughness_length")  # keys of tables without a name
GRADE_NAMES = (  # grades of manufacture, which manufacture/tolerance/grades.py defines
    "moulded", "diamond-turned", "precise", "milled-polished", "milled-sanded", "resin-printed", "resin-printed-coated",
)  # fmt: skip
TWO_FACE_ERRORS = (  # errors of one face relative to the other, which are zero unless a [[tolerance]] names them
    "front.form", "front.decentre", "front.decentre_x", "front.decentre_y",
    "lens.wedge", "lens.wedge_x", "lens.wedge_y",
)  # fmt: skip
NONE = "none"  # grade of an error that is always zero


class Tolerance(Record):
    """The tolerance of one error or several; a key that is None has the value of an earlier table or of the grade."""

    name: Annotated[Name | None, Key("Name of the error (lens.decentre: along x and y); all errors if absent.")] = None
    grade: Annotated[
        Literal[
            "moulded",
            "diamond-turned",
            "precise",
            "milled-polished",
            "milled-sanded",
            "resin-printed",
            "resin-printed-coated",
            "none",
        ]
        | None,
        Key("Grade of manufacture; none: error is 0."),
    ] = None
    limit: Annotated[float | None, Key("Limit (±) in the error's unit; form and ripple: RMS.", "", 1e-12, 1e4)] = None
    distribution: Annotated[
        Literal["normal", "uniform"] | None, Key("Distribution; normal: truncated at ±2 σ, and 2 σ is the limit.")
    ] = None
    cost: Annotated[float | None, Key("Relative cost of keeping the limit; 1 if absent.", "", 1e-6, 1e6)] = None
    correlation_length: Annotated[float | None, Key("Correlation length of a form error.", "mm", 1e-3, 1e4)] = None
    period: Annotated[float | None, Key("Period of a ripple.", "mm", 1e-3, 1e4, example=0.02)] = None
    pattern: Annotated[Literal["raster", "spiral"] | None, Key("Pattern of the tool marks.", example="spiral")] = None
    layer_height: Annotated[
        float | None, Key("Height of the layers of a print (plan --made).", "mm", 1e-4, 1.0, example=0.05)
    ] = None
    smoothing_length: Annotated[
        float | None,
        Key("Standard deviation of the Gaussian by which a finish smooths layers.", "mm", 1e-4, 10.0, example=0.5),
    ] = None
    roughness: Annotated[
        float | None, Key("Roughness Ra between layers and tool marks.", "nm", 0.0, 1e5, example=20.0)
    ] = None
    roughness_length: Annotated[
        float | None, Key("Correlation length of the roughness.", "mm", 1e-4, 10.0, example=0.02)
    ] = None

    def covers(self, error: str) -> bool:
        """Return True if the table covers this error; one on lens.tilt, or without a name, covers lens.tilt_x."""
        return self.name is None or error == self.name or error.startswith(f"{self.name}_")

    @property
    def stated(self) -> dict[str, Any]:
        """Keys of the table that are set, with their values, without the name."""
        return self.model_dump(exclude={"name"}, exclude_none=True)


def settings_of(tables: Sequence[Tolerance], error: str) -> dict[str, Any]:
    """Return the keys and values for an error from all tables on it; a later grade replaces a limit, and vice versa."""
    merged: dict[str, Any] = {}
    for stated in (table.stated for table in tables if table.covers(error)):
        for one, other in (("grade", "limit"), ("limit", "grade")):
            if one in stated:
                merged.pop(other, None)
        merged |= stated
    return merged


def tolerance_complaints(tables: Sequence[Tolerance]) -> Iterator[str]:
    """Yield the faults of the tables [[tolerance]], each as "key: sentence"."""
    for k, table in enumerate(tables):
        where, stated = f"tolerance[{k}]", table.stated
        if not stated:
            yield f"{where}: the table has no setting; add a limit or a grade"
        if "limit" in stated and "grade" in stated:
            yield f"{where}: has both a limit and a grade; give one of them"
        if "limit" in stated and table.name is None:
            yield f'{where}.limit: {table.limit:g} needs the name of an error; add for example name = "lens.decentre"'
        for key, names in FACE_ERRORS.items():
            if key in stated and table.name not in names:
                yield f"{where}.{key}: this key is for {' and '.join(names)} only; remove it, or change the name"
        for key in FINISH_KEYS:
            if key in stated and table.name is not None:
                yield f"{where}.{key}: this key states the finish of the part; write it into a table without a name"
        if "distribution" in stated and table.name in FORM:
            yield f"{where}.distribution: a form error is always normally distributed; remove this key"
