"""report.json as a record: its fields are the keys of the file.

The record is assembled from a design, its verification and its diagnosis, with remarks.

Records are built from computed values without validation; only `read` validates, by type and range.  A file with an
unknown or missing key, a string instead of a number or a number out of range is refused in one sentence.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import starmap, zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import ConfigDict, FailFast, Field, TypeAdapter, ValidationError
from pydantic_core import from_json, to_json, to_jsonable_python

from bstcad.analysis.cost import lifted, unlit
from bstcad.analysis.etendue import Etendue, etendue
from bstcad.analysis.light import Blur, FinestDetail, finest_detail
from bstcad.analysis.sharp_throw import Making, SharpThrow, sharp_throw
from bstcad.analysis.steepness import Steepness
from bstcad.analysis.top_hat import FlatTop
from bstcad.designs.course import (
    CurvePoint,
    DesignCourse,
    Fraction,
    PrecisionTest,
    Rrmsd,
    Scalar,
    Seconds,
    Size,
    StageRecord,
)
from bstcad.manufacture.measured.form_error import MAP_FILES
from bstcad.manufacture.measured.made_part import MadePart
from bstcad.optics.lens.lens import Lens
from bstcad.optics.receivers.goal import Goal, worst
from bstcad.optics.receivers.irradiance import Screen, rrmsd_of_pictures
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.trace.reach import unreached
from bstcad.report.goal_figures import (
    CellFigures,
    GoalFigures,
    Photometry,
    WavefrontFigures,
    figures_of,
    flat_tops,
    photometry,
)
from bstcad.report.prescription import Order, prescription
from bstcad.report.units import DIGITS, Remark, number, paragraphs, percent
from bstcad.report.units import remarks as written
from bstcad.runs import files
from bstcad.scene.blank import LensBlank
from bstcad.scene.quality import Tailoring
from bstcad.verify.checks import Proof
from bstcad.verify.judges.comparison import Judge
from bstcad.verify.light_limits import LightValue
from bstcad.verify.nominal import DEFAULT_RRMSD_LIMIT, Nominal
from bstcad.verify.verdict import NO_LIMIT, Check, verdict

if TYPE_CHECKING:
    from bstcad.optics.light.emitters import Emitter

MAX_REPORT_BYTES = 20_000_000  # size limit of a report (bytes): room for 300 000 points of the curve
MAX_STRING_LENGTH = 1000  # largest number of characters of a string in a report that is read
STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
LEFT_OUT = {  # LeftOut.kind: name of the effect in the report
    "fresnel": "Fresnel reflection",
    "reflectance": "reflectance below 1",
    "absorption": "absorption in the material",
    "dispersion": "dispersion",
    "source size": "size of the source",
    "ghost": "ghosts (light reflected twice inside the lens)",
    "shadows": "shadows of the source and of the mirror on itself",
    "stray light": "stray light",
    "diffraction": "diffraction",
}
NEGLIGIBLE_CHANGE = 1e-4  # change of flux (as a fraction) or RRMSD below which the report shows NEGLIGIBLE
NEGLIGIBLE_BLUR = 5e-3  # blur (pixels) below which the report shows NEGLIGIBLE
NEGLIGIBLE, UNKNOWN_CHANGE = "≈ 0", "unknown"  # words for a negligible and for an unknown change

# Key of a report that repeats a figure of the worst goal: name of this figure in GoalFigures.
WORST_GOAL_KEYS = {key: key for key in ("rrmsd", "rrmsd_tent", "light_on_target", "efficiency", "leak", "contrast")}
WORST_GOAL_KEYS["rrmsd_noise"] = "rrmsd_standard_error"

# Keys of a report that repeat figures of the worst goal on cells of several sizes; an earlier report has none of them.
CELL_KEYS = ("rrmsd_by_cell", "right_down_to")

Record = TypeVar("Record")


@dataclass(frozen=True)
class LineFigures:
    """Figures of the light of one spectral line alone."""

    wavelength: Size  # vacuum wavelength (nm)
    share: Fraction  # fraction of all light that is in this line
    rrmsd: Rrmsd  # RRMSD of the line's picture against the target


@dataclass(frozen=True)
class LeftOut:
    """An effect that is not simulated, and its estimated change (analysis.neglected_effects.Change)."""

    kind: str  # name of the effect (key of LEFT_OUT), such as "fresnel", "source size" or "stray light"
    flux_change: float | None  # change of the flux on the target, as a fraction; None here and below: unknown
    rrmsd_change: float | None  # RRMSD of a lens that would be perfect without the effect
    blur_pixels: float | None  # diameter of the spot to which the effect spreads a point of the picture (pixels)
    detail: str = ""  # assumption of the estimate, or reason why nothing is known
    simulate_by: str = ""  # line of a scene file that simulates the effect; empty: bstcad cannot simulate it
    assumed: bool = False  # True if `detail` is an assumed example, not a known fact


@dataclass(frozen=True)
class Contents:
    """Content of report.json: one field per key, in the order of the file."""

    __pydantic_config__ = STRICT

    name: str  # name of the design and of its folder
    title: str  # title of the scene
    # verdict, from `passed` and `given_up`; "no limit was asked": all checks passed, no limit on the light in the scene
    verdict: Literal["passed", "passed with remarks", "no limit was asked", "failed"]
    passed: bool  # True if every check passed
    # figures of the light on each target; figures outside this list are for the target with the largest RRMSD
    goals: Annotated[tuple[GoalFigures, ...], Field(min_length=1, max_length=100), FailFast()]
    rrmsd: Rrmsd  # RRMSD of the irradiance against the target, from the flux in each pixel
    rrmsd_tent: Rrmsd | None  # RRMSD with each ray divided among four pixels
    rrmsd_noise: Annotated[float, Field(ge=0, le=1e3)]  # standard error of rrmsd
    light_on_target: Fraction  # fraction of the source's flux on the target
    efficiency: Fraction  # flux on the target, as a fraction of the flux that leaves the last face
    flux: Mapping[str, Fraction]  # flux ledger: fractions of the source's flux by where it goes, with sum 1
    prescription: Mapping[str, Any]  # every surface as it was designed
    seconds_total: Seconds  # time from the command to the verified lens and the pictures of its report
    stages: Annotated[tuple[StageRecord, ...], Field(max_length=100), FailFast()]  # stages in their order
    history: Annotated[tuple[CurvePoint, ...], Field(max_length=1_000_000), FailFast()]  # convergence curve
    checks: Annotated[tuple[Check, ...], Field(max_length=1000), FailFast()]  # checks in their order in the report
    effects: Mapping[str, tuple[str, ...]]  # names of effects under the keys simulated and left_out
    machine: Mapping[str, Scalar]  # processors, memory, threads, device
    versions: Mapping[str, str]  # versions of the libraries, by name
    seed: int  # seed of every random choice
    version: str | None = None  # version of bstcad that wrote the report
    rrmsd_by_cell: Annotated[tuple[CellFigures, ...], Field(max_length=20)] = ()  # RRMSDs by size of the cells
    # side of the smallest cell, in the unit of rrmsd_by_cell, such that on it and on all larger ones the RRMSD is at
    # most 1.5 times that on pixels, or at most 0.03; None: not measured, or no cell is as good
    right_down_to: Size | None = None
    rrmsd_whole: Rrmsd | None = None  # RRMSD against the whole picture; None: light reaches all of it
    # unreachable part of the target, by key: area (fraction of the target), light (fraction of the picture's light) and
    # angle (largest deflection by a face of this index, degrees; None for a mirror).  None: all is reached
    unreachable: Mapping[str, Size | None] | None = None
    # how much of the light of a source of finite size fits into the target, the least of all targets; None: not known
    etendue: Etendue | None = None
    leak: Fraction | None = None  # fraction of the light on the target that is on its dark pixels; None: no dark pixels
    contrast: Size | None = None  # mean irradiance of lit divided by dark pixels; None: no dark pixels, or no leak
    optic: Literal["lens", "mirror"] = "lens"  # kind of the design
    quality: str | None = None  # tailoring.quality of the scene
    # transport map: grid (cells per side), iterations, mass_error, stopped (reason of its end), steep_share
    # (fraction of the light that would need a slope above 70°), steepest_deg (steepest slope it would need).  None: no
    # map
    transport: Mapping[str, Scalar] | None = None
    # number of steps that tailoring skipped, since merit or gradient was not finite; None: unknown
    skipped_steps: Annotated[int, Field(ge=0)] | None = None
    # reason why tailoring ended: evaluations (all used), plateau, accuracy, time, interrupt, or by hand (changed lens)
    stopped: str | None = None
    twins: PrecisionTest | None = None  # comparison of float32 with float64; None: not made
    rrmsd_asked: Size | None = None  # accept.rrmsd of the scene; None: no limit
    rays_traced: int | None = None  # number of rays that measured the light on the target with the largest RRMSD
    shape: Mapping[str, float | None] | None = None  # dimensions (keys: see analysis.shape.describe) and volume (mm³)
    # tir_margin_deg (margin to total internal reflection), newton_slope_min (smallest divisor in Newton's method),
    # curvature_max (1/mm), non_finite (number of values that are not finite)
    stability: Mapping[str, float | int | None] | None = None
    blur: Blur | None = None  # blur by the source's size; None: a point source or parallel light
    finest_detail: FinestDetail | None = None  # finest detail on the target; None: no size of the source
    sharp_throw: SharpThrow | None = None  # longest throw of a sharp picture; None: not known, or no plate
    lines: tuple[LineFigures, ...] = ()  # lines of the spectrum; empty: the source has one wavelength
    picture: tuple[str, ...] = ()  # sentences on how a file was read: first of its pictures, transparency, tones, fit
    given_up: tuple[str, ...] = ()  # text of the remarks
    remarks: tuple[str, ...] = ()  # ids of the remarks, in the order of given_up
    estimates: tuple[LeftOut, ...] = ()  # estimates of effects that are not simulated, the largest first
    # end of the convergence curve: entries of ConvergenceEnd; None: there is no curve
    convergence: Mapping[str, Size | None] | None = None
    # distribution of the remaining error: parts [{name, error, pixels}] (fractions of the squared error and of the
    # pixels), octaves [{frequency (cycles per pixel), period (in the target's unit), error}], outside (fraction of the
    # light behind the last face that misses the target)
    remaining_error: Mapping[str, Any] | None = None
    # bounds on the tailored faces: asked {key of [lens]: value}, at {key: fraction of the area at the bound; None: a
    # thickness at the bound}, tightest {key: position, in words}, both (true: both faces are tailored) or front (true:
    # only the front is); None: the scene has no bounds
    bounds: Mapping[str, Any] | None = None
    judges: tuple[Judge, ...] = ()  # results of other programs (--against)
    # made part, from its point cloud; keys of measured.made_part, such as points, pv, rms, rrmsd_predicted, passed
    measured: Mapping[str, Any] | None = None
    order: Order | None = None  # data with which a machine shop makes the part
    flat_tops: tuple[FlatTop, ...] = ()  # figures of the targets with a flat profile
    wavefront: WavefrontFigures | None = None  # wavefront error; None: no requested wave, or no light on its plane
    photometry: tuple[Photometry, ...] = ()  # absolute figures of each target; empty: the source's flux is not known
    # values of the light that the table [accept] limits: test points, uniformity, cut-off, glare
    values: Annotated[tuple[LightValue, ...], Field(max_length=1000), FailFast()] = ()

    @property
    def worst(self) -> GoalFigures:
        """Figures of the target with the largest RRMSD."""
        return self.goals[worst(goal.rrmsd for goal in self.goals)]

    @property
    def course(self) -> DesignCourse:
        """Course of the design."""
        return DesignCourse(**{entry.name: getattr(self, entry.name) for entry in fields(DesignCourse)})

    @property
    def all_remarks(self) -> tuple[Remark, ...]:
        """Remarks with their ids; an older report has no ids."""
        return tuple(starmap(Remark, zip_longest(self.remarks, self.given_up, fillvalue="")))

    def facts(self) -> dict[str, Any]:
        """Return the entries of report.json as plain values, in their order, without empty ones except KEYS_KEPT."""
        found = {key: value for key, value in plain(self).items() if key in KEYS_KEPT or value not in (None, [])}
        for judge in found.get("judges", ()):
            if not judge["target"]:  # a target has a name only among several
                del judge["target"]
        for goal in found["goals"]:
            for key in CELL_KEYS:
                if goal[key] in (None, []):  # not measured
                    del goal[key]
        return found


ALL_KEYS = tuple(entry.name for entry in fields(Contents))
KEYS = ALL_KEYS[: ALL_KEYS.index("seed") + 1]  # keys of every report.json, in this order
# keys that a report.json has even if the value is null or empty
KEYS_KEPT = {*KEYS, "leak", "contrast", "optic", "twins", "rrmsd_asked", "given_up", "remarks"}
FOUND_BY_DESIGN = ("not-exported",)  # ids of remarks that a verification does not find again


@dataclass(frozen=True)
class Examined:
    """Result of `bstcad verify` for a STEP file without a design."""

    name: str
    title: str
    verdict: str
    passed: bool
    checks: tuple[Check, ...]
    part: Mapping[str, str]  # rows of name and value (prescription.part)
    placement: Mapping[str, Any] | None = None  # position of the lens in the file (Placement.facts); None: not moved
    # fields of Contents, empty without a design
    all_remarks: tuple[Remark, ...] = ()
    bounds: Mapping[str, Any] | None = None


# --- assembled from a design, its verification and its diagnosis ------------------------------------------------------


def contents_of(
    design: Nominal,
    proof: Proof,
    *,
    course: DesignCourse,
    circumstances: Mapping[str, Any],
    simulated: Sequence[str],
    estimates: tuple[LeftOut, ...],
    diagnosis: Mapping[str, Any],
    making: Making,
) -> Contents:
    """Return the contents of report.json.

    circumstances: present version, machine and versions of libraries; those known in `course` have priority.
    simulated: names of the simulated effects.  estimates: effects that are not simulated.  diagnosis: convergence,
    remaining_error and bounds.  making: errors of a made part that spread light.
    """
    scene, goals, source = design.scene, design.goals, design.scene.source
    known = {key: value for key, value in vars(course).items() if value is not None}
    goal, light, figures = goals[proof.worst], proof.light, figures_of(goals, proof.lights)
    stated = figures[proof.worst]
    right = stated.right_down_to or 0.0
    finest = _finest_detail(source, proof, goal.screen, estimates, least=right)
    light_of_centre, image = scene.with_source_scaled(0.0).channels(), finest.source_image if finest else 0.0
    contents = Contents(
        **{**circumstances, **known},
        **diagnosis,
        **{key: getattr(stated, name) for key, name in WORST_GOAL_KEYS.items()},
        **{key: getattr(stated, key) for key in CELL_KEYS},
        name=scene.name,
        title=scene.title,
        verdict=verdict(proof.passed, (), scene.limits_light),
        passed=proof.passed,
        goals=figures,
        flux=light.flux,
        checks=proof.checks,
        prescription=prescription(scene, design.lens, proof.shape),
        effects={
            "simulated": tuple(simulated),
            "left_out": tuple(LEFT_OUT[entry.kind] for entry in estimates),
        },
        seed=scene.tailoring.seed,
        rrmsd_whole=light.rrmsd_whole,
        unreachable=_unreached(goal, design.lens),
        etendue=_least_etendue(design.emitter, proof.lens, goals),
        optic=scene.optic,
        quality=scene.tailoring.quality,
        rrmsd_asked=scene.accept.rrmsd,
        rays_traced=light.rays,
        shape=proof.shape,
        stability=proof.stability,
        blur=proof.blur,
        finest_detail=finest,
        sharp_throw=sharp_throw(light_of_centre, proof.lens, goal.screen, making, source_image=image, least=right),
        picture=scene.picture_remarks(),
        lines=tuple(
            LineFigures(k.wavelength, k.share, rrmsd_of_pictures(goal.picture, k.picture)) for k in proof.lines
        ),
        estimates=estimates,
        flat_tops=tuple(flat_tops(dict(zip(scene.target_keys, scene.targets, strict=True)), proof.lights)),
        wavefront=proof.wavefront and WavefrontFigures.of(proof.wavefront),
        photometry=tuple(photometry(goals, proof, source.luminous_flux, reflection=scene.loses_reflections)),
        values=proof.values,
    )
    found = remarks(
        contents, goals, [each.picture for each in proof.lights], blank=scene.lens, source=source,
        asked=scene.tailoring, mesh_tolerance=None if scene.output.mesh_tolerance else scene.mesh_tolerance,
    )  # fmt: skip
    return _with_remarks(contents, *found)


def _unreached(goal: Goal, lens: Lens) -> dict[str, float | None] | None:
    if goal.reachable is None:
        return None
    return unreached(goal.whole, goal.reachable, lens.passes.largest_deflection(lens.index))


def _least_etendue(source: Emitter, lens: Lens, goals: Sequence[Goal]) -> Etendue | None:
    found = (etendue(source, lens, goal) for goal in goals)
    return min((each for each in found if each is not None), key=lambda each: each.fits, default=None)


def with_part(contents: Contents, part: MadePart, place: str = "") -> Contents:
    """Return the contents with a made part and its checks; place: folder of the part, relative to the report's."""
    measured = part.facts | {"deviation_map": [f"{place}{name}" for name in MAP_FILES]}
    passed, checks = contents.passed and part.facts["passed"], (*contents.checks, *part.checks)
    contents = replace(contents, checks=checks, passed=passed, measured=measured)
    return _with_remarks(contents, *written("remarks.txt.j2", "outliers", share=part.facts["outliers"]["share"]))


def with_failures(contents: Contents, failures: Mapping[str, str]) -> Contents:
    """Return the contents with a remark on each kind of output.export that is not possible, for the stated reason."""
    return _with_remarks(contents, *written("remarks.txt.j2", "failures", failures=failures))


def with_earlier_remarks(contents: Contents, path: Path) -> Contents:
    """Return the contents with the remarks of an earlier report.json that only the design itself can find."""
    try:
        earlier = read(path).all_remarks
    except ValueError:
        return contents
    return _with_remarks(contents, *(remark for remark in earlier if remark.id in FOUND_BY_DESIGN))


def _with_remarks(contents: Contents, *more: Remark) -> Contents:
    """Return the contents with more remarks, and the verdict that follows from them."""
    every, limited = (*contents.all_remarks, *more), contents.verdict != NO_LIMIT
    ids, texts = (tuple(part) for part in zip(*every, strict=True)) if every else ((), ())
    return replace(contents, given_up=texts, remarks=ids, verdict=verdict(contents.passed, texts, limited))


def _finest_detail(
    source: Emitter, proof: Proof, screen: Screen, estimates: tuple[LeftOut, ...], least: float
) -> FinestDetail | None:
    """Return the finest detail by the size of the source, else in `estimates`; None: no size is known.

    least: as in `finest_detail`.
    """
    if proof.blur:
        of = ", ".join(f"source.{key} = {size}" for key, size in extent(source))
        return finest_detail(proof.blur.pixels, proof.lens, screen, of, least=least)
    for entry in estimates:
        if entry.kind == "source size" and entry.blur_pixels is not None:
            known = {"of": entry.detail, "assumed": entry.assumed}
            return finest_detail(entry.blur_pixels, proof.lens, screen, **known, least=least)
    return None


def extent(source: Emitter) -> Iterator[tuple[str, str]]:
    """Yield the keys that give a source a size, each with the size in words."""
    for key, size, unit in source.sizes():
        values = f"[{size[0]:g}, {size[1]:g}]" if isinstance(size, tuple) else f"{size:g}"
        yield key, f"{values} {unit}"


# --- remarks ----------------------------------------------------------------------------------------------------------
# A remark states, with a figure, an unfulfilled request of the scene, a loss or a doubt, even if no check judges it.


def remarks(
    report: Contents, goals: Sequence[Goal], irradiances: Sequence[np.ndarray], *, blank: LensBlank, source: Emitter,
    asked: Tailoring, mesh_tolerance: float | None,
) -> list[Remark]:  # fmt: skip
    """Return remarks, the most important first.

    irradiances: one per goal, normalised to the sum of its picture.  blank, asked: [lens] and [tailoring] of the scene.
    mesh_tolerance: usual tolerance of the mesh (mm); None: the scene states one, which a check judges.
    """
    allowed = DEFAULT_RRMSD_LIMIT if report.rrmsd_asked is None else report.rrmsd_asked
    pairs = list(zip(goals, irradiances, strict=True))
    dark = {goal.words: unlit(goal.picture, found, goal.screen) for goal, found in pairs}
    bright = {goal.words: lifted(goal.picture, found) for goal, found in pairs}
    given = {"report": report, "blank": blank, "source": source, "asked": asked, "mesh_tolerance": mesh_tolerance}
    return written("remarks.txt.j2", "remarks", allowed=allowed, names=LEFT_OUT, unlit=dark, lifted=bright, **given)


def too_steep(found: Steepness) -> list[str]:
    """Return the remark on light that needs slopes above 70°; empty for at most 0.1 % of the target's light."""
    sent = {"steep_share": found.share, "steepest_deg": found.steepest}
    return [remark.text for remark in written("remarks.txt.j2", "steep", sent=sent)]


def bounds(found: Mapping[str, Any] | None) -> str:
    """Return a sentence on the bounds on faces ([lens] tool_radius, …) and where they are reached; "" for none."""
    return "".join(paragraphs("remarks.txt.j2", "bounds", found=found))


# --- files ------------------------------------------------------------------------------------------------------------


def read(path: Path) -> Contents:
    """Read a report.json; ValueError (one sentence) if it is missing, damaged or from another program."""
    return read_as(Contents, path, "run bstcad verify to write it again")


def read_course(path: Path) -> DesignCourse:
    """Read the course of the design from a report.json; an empty record if the file is missing or damaged."""
    try:
        return read(path).course
    except ValueError:
        return DesignCourse()


def read_as(kind: type[Record], path: Path, remedy: str) -> Record:
    """Read a record of this kind from a JSON file; ValueError, which ends with `remedy`, if it is not valid."""
    try:
        return of_json(files.contents(path, MAX_REPORT_BYTES), kind)
    except ValueError as error:
        raise ValueError(f"{path}: cannot be read ({error}); {remedy}") from None


def of_json(data: bytes | str, kind: type[Record] = Contents) -> Record:
    """Parse a record of this kind from JSON; ValueError names the first entry that is not valid."""
    try:
        found = _adapter(kind).validate_json(_upgraded(data))
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False, include_context=False)[0]
        entry = ".".join(map(str, first["loc"]))  # keys of a damaged file may have characters that steer a terminal
        raise ValueError(files.one_line(": ".join(filter(None, (entry, first["msg"]))))) from None
    if not _is_valid(plain(found)):
        long = f"a text in it has more than {MAX_STRING_LENGTH} characters, or characters that do not print"
        raise ValueError(f"{long}, or a number is not finite")
    return found


def _upgraded(data: bytes | str) -> bytes | str:
    """Return a report.json or tolerance.json of an earlier version with the present keys.

    An earlier file may have a key `limits`, may keep the first of several targets separately, and has z instead of
    `where` as the position of a target.
    """
    try:
        facts = from_json(data)
        facts.pop("limits", None)
        for goal in (*facts.get("goals", ()), *(facts.get("targets") or ())):
            if "z" in goal:
                goal["where"] = LevelPlane(goal.pop("z")).position_text()
        if "goals" in facts or "prescription" not in facts:
            return to_json(facts)
        prescribed, measured = facts["prescription"], facts.get("measured") or {}
        prescribed["targets"] = [prescribed.pop("target"), *prescribed.pop("further_targets", ())]
        place = LevelPlane(prescribed["targets"][0]["z"]).position_text()
        alone = {"key": "target", "where": place, "weight": 1.0} | {
            name: facts.get(key) for key, name in WORST_GOAL_KEYS.items()
        }
        goals = facts["goals"] = facts.pop("targets", [alone])
        stated = goals[worst(goal["rrmsd"] for goal in goals)]
        facts |= {key: stated[name] for key, name in WORST_GOAL_KEYS.items()}
        if measured:
            predicted = {key: measured.get(key) for key in ("rrmsd_predicted", "rrmsd_high")}
            measured["goals"] = measured.pop("targets", [{"key": "target"} | predicted])
        return to_json(facts)
    except (
        AttributeError,
        KeyError,
        OverflowError,
        TypeError,
        ValueError,
    ):  # not a report: the caller reports the error
        return data


@cache
def _adapter(kind: type[Record]) -> TypeAdapter[Record]:
    return TypeAdapter(kind)


def _is_valid(value: Any, any_text: bool = False) -> bool:
    """Return True if numbers are finite, and strings outside the prescription short and unable to control a terminal.

    any_text: True inside the prescription.
    """
    if isinstance(value, str):
        return any_text or (len(value) <= MAX_STRING_LENGTH and value.isprintable())
    if isinstance(value, dict):
        parts = ((key, _is_valid(part, any_text or key == "prescription")) for key, part in value.items())
        return all(valid and _is_valid(key, any_text) for key, valid in parts)
    if isinstance(value, list):
        return all(_is_valid(part, any_text) for part in value)
    return not isinstance(value, float) or math.isfinite(value)


def plain(value: Any) -> Any:
    """Return a record as dicts, lists, strings, bools, ints, floats and None."""
    return to_jsonable_python(value, fallback=lambda numbers: numbers.tolist(), inf_nan_mode="constants")


def write_json(report: Contents, path: str | Path) -> None:
    """Write report.json: one record per line, rounded by `_rounded`; ValueError names a number that is not finite."""
    lines = ",\n".join(f"  {_line(key)}: {_block(_rounded(value, key))}" for key, value in report.facts().items())
    files.put(Path(path), f"{{\n{lines}\n}}\n".encode())


def _rounded(value: Any, where: str) -> Any:
    """Round floats to DIGITS digits, except in the prescription, which keeps all.  where: path of the value."""
    if isinstance(value, dict):
        return {key: _rounded(part, f"{where}.{key}") for key, part in value.items()}
    if isinstance(value, list):
        return [_rounded(part, f"{where}[{i}]") for i, part in enumerate(value)]
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        remedy = "a report needs finite numbers, or null for a value that was not measured"
        raise ValueError(f"report: {where!r} is {value}; {remedy}")
    return value if where.startswith("prescription.") else float(f"{value:.{DIGITS}g}")


def _line(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _block(value: Any) -> str:
    """Return JSON of a top-level value: one line per entry of a dict and per record of a list."""
    if isinstance(value, dict) and value:
        return "{\n" + ",\n".join(f"    {_line(key)}: {_line(part)}" for key, part in value.items()) + "\n  }"
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "[\n" + ",\n".join(f"    {_line(part)}" for part in value) + "\n  ]"
    return _line(value)


# --- for scripts ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class Report:
    """Result of a verification, traced through the geometry of lens.step or, with a mount, of part.step.

    Every key of report.json is an attribute, such as `rrmsd` (a field of Contents); `facts` has all as plain values.
    """

    contents: Contents
    irradiances: tuple[np.ndarray, ...]  # irradiance (rows, columns) on each target, row 0 = y max, sum of the target
    # made part of this verification: facts, outliers (n, 3), predicted irradiances, and the deviation map with x, y and
    # form (rows y, columns x; mm, + out of the glass, NaN outside); None: no part was measured
    measured: Any = None
    notes: tuple[str, ...] = ()  # sentences on the exported files, also in their sidecar files

    @property
    def irradiance(self) -> np.ndarray:
        """Irradiance on the target with the largest RRMSD (rows, columns)."""
        return self.irradiances[worst(goal.rrmsd for goal in self.contents.goals)]

    @property
    def facts(self) -> dict[str, Any]:
        """Entries of report.json as plain values."""
        return self.contents.facts()

    def __getattr__(self, key: str) -> Any:
        if key.startswith("_") or key == "contents":  # copying and unpickling request these before they exist
            raise AttributeError(key)
        return getattr(self.contents, key)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *vars(self.contents)})

    def __repr__(self) -> str:
        """Return the verdict, RRMSD and light on the target; then each failed check and each remark."""
        failed = (check for check in self.checks if not check.passed)
        return "\n  ".join(
            [
                f"Report {self.name!r}: {self.verdict}, RRMSD {rrmsds(self.contents)} on pixels, "
                f"{percent(self.light_on_target)} of the source's light is on {self.worst.words}",
                *(f"failed: {check.name}" + (f" ({check.where})" if check.where else "") for check in failed),
                *(f"remark: {sentence}" for sentence in self.given_up),
            ]
        )


def rrmsds(report: Contents) -> str:
    """Return the RRMSD on each target, in the order of the scene."""
    return ", ".join(number(each.rrmsd) for each in report.goals)


def changes(entry: LeftOut) -> tuple[str, str, str]:
    """Return in words the changes that an effect causes: flux on the target, RRMSD and blur."""
    flux, rrmsd, blur = entry.flux_change, entry.rrmsd_change, entry.blur_pixels
    if rrmsd is None:
        return UNKNOWN_CHANGE, UNKNOWN_CHANGE, UNKNOWN_CHANGE
    return (
        f"{'+' if flux > 0 else '−'}{percent(min(abs(flux), 1.0))}" if abs(flux) >= NEGLIGIBLE_CHANGE else NEGLIGIBLE,
        number(rrmsd) if rrmsd >= NEGLIGIBLE_CHANGE else NEGLIGIBLE,
        f"{number(round(blur, 2))} pixels" if blur >= NEGLIGIBLE_BLUR else NEGLIGIBLE,
    )
