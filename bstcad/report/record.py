"""report.json as a record: its fields are the keys of the file, which is read back strictly, by type and range.

It is put together from a design, its proof and its diagnosis, with remarks on them.

Records are built from computed values, without validation; only `read` checks: an unknown key, a missing one,
a string for a number or a number out of range refuse the whole file in one sentence.
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
from typing_extensions import TypedDict

from bstcad.analysis.cost import lifted, unlit
from bstcad.analysis.light import Blur, FinestDetail, finest_detail
from bstcad.analysis.steepness import Steepness
from bstcad.analysis.top_hat import FlatTop
from bstcad.judges.comparison import Judge
from bstcad.measured.form_error import MAP_FILES
from bstcad.measured.made_part import MadePart
from bstcad.optics.goal import Goal, worst
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.reach import unreached
from bstcad.optics.receivers import LevelPlane
from bstcad.report.goal_figures import GoalFigures, Rrmsd, Share, Size, WavefrontFigures, figures_of, flat_tops
from bstcad.report.light_figures import rrmsd
from bstcad.report.prescription import Order, prescription
from bstcad.report.units import DIGITS, Remark, Rows, number, paragraphs, percent, tables
from bstcad.report.units import remarks as written
from bstcad.runs import files
from bstcad.scene.scene import Scene
from bstcad.verify.checks import DEFAULT_RRMSD_LIMIT, Proof
from bstcad.verify.verdict import NO_LIMIT, Check, verdict

if TYPE_CHECKING:
    from bstcad.optics.emitters import Emitter

BY_HAND = "by hand"  # Making.stopped of a lens that was changed after it was designed, or comes from elsewhere
LARGEST = 20_000_000  # bytes of a report; ten thousand evaluations fill one
LONGEST = 1000  # characters of a string in it
STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
LEFT_OUT = {  # LeftOut.kind: in words
    "fresnel": "Fresnel reflection",
    "reflectance": "reflectance below 1",
    "absorption": "absorption in the glass",
    "dispersion": "dispersion",
    "source size": "size of the source",
    "ghost": "ghosts, light reflected twice inside the lens",
    "shadows": "shadows of the source and of the mirror on itself",
    "stray light": "stray light",
    "diffraction": "diffraction",
}
NOTHING = 1e-4  # change of the light, and of RRMSD, below which an effect changes nothing
SHARP = 5e-3  # pixels; a smaller blur is none

# Keys of a report whose figures are those of the worst of its goals, and what they are called there.
OF_WORST = {key: key for key in ("rrmsd", "rrmsd_tent", "light_on_target", "efficiency", "leak", "contrast")}
OF_WORST["rrmsd_noise"] = "rrmsd_standard_error"

Scalar = str | float | int | bool | None
Seconds = Annotated[float, Field(ge=0, le=1e9)]
Record = TypeVar("Record")


@dataclass(frozen=True)
class Stage:
    """One stage of the design."""

    name: str  # such as stage 2
    seconds: Seconds  # wall time
    rrmsd: Rrmsd | None = None  # after it
    cpu_seconds: Seconds | None = None  # seconds of all processors; None: another process had a part in it, or unknown


@dataclass(frozen=True)
class Point:
    """One point of the convergence curve."""

    seconds: Seconds  # since the start
    rrmsd: Rrmsd  # by the tubes of the stage


class PrecisionTest(TypedDict):
    """float32 beside float64 on the scene's own merit, as tailoring.stage2.Comparison has it."""

    control_points: int  # a side
    merit: Size  # relative difference before the first step
    gradient: Size  # relative difference of its norm
    evaluations: int  # evaluations of each precision
    rrmsd_float64: Rrmsd  # after them
    rrmsd_float32: Rrmsd  # after as many evaluations
    heights: Size  # mm; largest difference of a control point


@dataclass(frozen=True)
class Line:
    """The light of one line of a spectrum by itself."""

    wavelength: Size  # nm
    share: Share  # part of all light
    rrmsd: Rrmsd  # RRMSD of its picture against the target


@dataclass(frozen=True)
class Making:
    """How a lens was designed; None: nothing is known, as of a design whose earlier report is gone."""

    seconds_total: Seconds = 0.0  # to the verified lens
    stages: tuple[Stage, ...] = ()
    history: tuple[Point, ...] = ()
    machine: Mapping[str, Scalar] | None = None
    versions: Mapping[str, str] | None = None  # versions of the libraries
    # grid, iterations, mass error, reason to stop, and of analysis.steepness the share and the steepest slope (degrees)
    transport: Mapping[str, Scalar] | None = None
    skipped_steps: int | None = None  # left out because their gradient was not finite
    stopped: str | None = None  # the reason why tailoring ended
    twins: PrecisionTest | None = None

    def followed_by(self, *last: Stage) -> Making:
        """The same with these stages last, instead of any of their names before."""
        names = [stage.name for stage in last]
        again = sum(stage.seconds for stage in self.stages if stage.name in names)
        seconds = self.seconds_total - again + sum(stage.seconds for stage in last)
        stages = (*(stage for stage in self.stages if stage.name not in names), *last)
        return replace(self, stages=stages, seconds_total=seconds)


@dataclass(frozen=True)
class LeftOut:
    """An effect that is not simulated, and its change (analysis.neglected_effects.Change); None: not known."""

    kind: str  # a word of LEFT_OUT
    flux_change: float | None  # change of the flux, as a part of 1
    rrmsd_change: float | None  # absolute
    blur_pixels: float | None  # full width on the target
    detail: str = ""  # the assumption of the estimate, or why nothing is known
    simulate_by: str = ""  # the line of a scene file that has it simulated; nothing: bstcad does not
    assumed: bool = False  # is its size an example which neither the scene nor nature states?


@dataclass(frozen=True)
class Contents:
    """All of report.json: a field a key, in its order."""

    __pydantic_config__ = STRICT

    name: str  # name of the design and of its folder
    title: str  # title of the scene
    # see passed and given_up; "no limit was asked": every check passed, and the scene sets no limit on the light
    verdict: Literal["passed", "passed with remarks", "no limit was asked", "failed"]
    passed: bool  # every check
    # figures of the light on each target; those outside of this list are of the target with the largest RRMSD
    goals: Annotated[tuple[GoalFigures, ...], Field(min_length=1, max_length=100), FailFast()]
    rrmsd: Rrmsd  # RRMSD of the irradiance against the target, by the flux into each pixel
    rrmsd_tent: Rrmsd | None  # by linear binning
    rrmsd_noise: Annotated[float, Field(ge=0, le=1e3)]  # standard error of rrmsd
    light_on_target: Share  # part of the source's flux
    efficiency: Share  # flux on the target over flux that leaves the back face
    flux: Mapping[str, Share]  # where the source's flux goes; sums to 1
    prescription: Mapping[str, Any]  # every surface as it was designed
    seconds_total: Seconds  # from the command to the verified lens
    stages: Annotated[tuple[Stage, ...], Field(max_length=100), FailFast()]  # in their order
    history: Annotated[tuple[Point, ...], Field(max_length=1_000_000), FailFast()]  # the convergence curve
    checks: Annotated[tuple[Check, ...], Field(max_length=1000), FailFast()]  # in their order in the report
    effects: Mapping[str, tuple[str, ...]]  # simulated, left_out
    machine: Mapping[str, Scalar]  # processors, memory, threads, device
    versions: Mapping[str, str]  # versions of the libraries, by name
    seed: int  # seed of every random choice
    version: str | None = None  # version of bstcad, which wrote it
    rrmsd_whole: Rrmsd | None = None  # against the whole picture, of which light can reach a part; None: it reaches all
    # what light cannot reach: area (of the target, as a part of it), light (of the picture), angle (degrees by which a
    # face of the index turns light before it reflects it; None: of a mirror); None: nothing
    unreachable: Mapping[str, Size | None] | None = None
    leak: Share | None = None  # part of the target's light that is on its dark pixels; None: no dark
    contrast: Size | None = None  # mean irradiance of the lit pixels over that of the dark ones; None: or without leak
    optic: Literal["lens", "mirror"] = "lens"  # the kind of the design
    quality: str | None = None  # tailoring.quality
    # grid, iterations, mass error, reason to stop, and of analysis.steepness the share and the steepest slope (degrees)
    transport: Mapping[str, Scalar] | None = None
    skipped_steps: Annotated[int, Field(ge=0)] | None = None  # steps left out since their gradient was not finite
    stopped: str | None = None  # the reason why tailoring ended
    twins: PrecisionTest | None = None  # None: there was no time for it
    rrmsd_asked: Size | None = None  # None: the scene asks for none
    rays_traced: int | None = None  # by the proof, in all
    shape: Mapping[str, float | None] | None = None  # thickness, radii (mm), slope (degrees), volume (mm³) …
    # margins: to total reflection (degrees), of Newton's method, largest curvature (1/mm), values that are not finite
    stability: Mapping[str, float | int | None] | None = None
    blur: Blur | None = None  # by the source's size; None: it has no size
    finest_detail: FinestDetail | None = None  # how wide a point of the picture becomes
    lines: tuple[Line, ...] = ()  # lines of a spectrum; none: it has one line
    picture: tuple[str, ...] = ()  # sentences on how the picture was read: first of several, tones, transparency, fit
    given_up: tuple[str, ...] = ()  # remarks: sentences on wishes of the scene that the design does not fulfil
    remarks: tuple[str, ...] = ()  # the id of each of these sentences
    estimates: tuple[LeftOut, ...] = ()  # changes by effects that are not simulated, the largest first
    # the end of the convergence curve, as analysis.cost.ConvergenceEnd has it; None: there is no curve
    convergence: Mapping[str, Size | None] | None = None
    # where the error sits: parts [{name, error, pixels}] (parts of the squared error, and of the pixels), octaves
    # [{frequency (cycles a pixel), period (in the target's unit), error}],
    # outside (part of the light beside the target)
    remaining_error: Mapping[str, Any] | None = None
    # the bounds on the tailored faces: asked {key of [lens]: value}, at {key: part of the faces that is at the bound;
    # None: of a thickness that is}, tightest {key: place, in words}, both or front (true where not the back alone is
    # tailored); None: none is asked
    bounds: Mapping[str, Any] | None = None
    judges: tuple[Judge, ...] = ()  # by --against
    # a made part by its cloud, as measured.made_part has it: points, alignment, pv, rms, rrmsd_predicted, passed …
    measured: Mapping[str, Any] | None = None
    order: Order | None = None  # for a machine shop
    flat_tops: tuple[FlatTop, ...] = ()  # figures of the targets with a flat profile
    wavefront: WavefrontFigures | None = None  # None: none is asked for, or no light comes to where it is stated

    @property
    def worst(self) -> GoalFigures:
        """The figures of the target with the largest RRMSD."""
        return self.goals[worst(goal.rrmsd for goal in self.goals)]

    @property
    def making(self) -> Making:
        """How the lens was designed."""
        return Making(**{entry.name: getattr(self, entry.name) for entry in fields(Making)})

    @property
    def remarked(self) -> tuple[Remark, ...]:
        """The remarks with their ids, which an older report lacks."""
        return tuple(starmap(Remark, zip_longest(self.remarks, self.given_up, fillvalue="")))

    def facts(self) -> dict[str, Any]:
        """The entries of report.json as plain values, in their order; those that are not known are no keys."""
        found = {key: value for key, value in plain(self).items() if key in STATED or value not in (None, [])}
        for judge in found.get("judges", ()):
            if not judge["target"]:  # which judges name where there are several
                del judge["target"]
        return found


ALL = tuple(entry.name for entry in fields(Contents))
KEYS = ALL[: ALL.index("seed") + 1]  # keys of every report.json, in this order
# keys though nothing is known
STATED = {*KEYS, "leak", "contrast", "optic", "twins", "rrmsd_asked", "given_up", "remarks"}


@dataclass(frozen=True)
class Examined:
    """`bstcad verify` of a STEP file by itself."""

    name: str
    title: str
    verdict: str
    passed: bool
    checks: tuple[Check, ...]
    part: Mapping[str, str]  # rows of name and value (prescription.part)
    placement: Mapping[str, Any] | None = None  # where the lens lies in the file (Placement.facts); None: unmoved
    remarked: tuple[Remark, ...] = ()  # these as in Contents: nothing is known without a design
    bounds: Mapping[str, Any] | None = None


# --- put together from a design, its proof and its diagnosis ----------------------------------------------------------


def contents_of(
    scene: Scene, lens: Lens, goals: Sequence[Goal], proof: Proof, *, making: Making,
    circumstances: Mapping[str, Any], estimates: tuple[LeftOut, ...], diagnosis: Mapping[str, Any],
) -> Contents:  # fmt: skip
    """The contents of report.json.

    lens: as designed.  circumstances: version, machine and versions of libraries now, which those of its making
    precede.  estimates: of the effects that are left out.  diagnosis: convergence, remaining_error and bounds.
    """
    known = {key: value for key, value in vars(making).items() if value is not None}
    goal, light, figures = goals[proof.worst], proof.light, figures_of(goals, proof.lights)
    contents = Contents(
        **{**circumstances, **known},
        **diagnosis,
        **{key: getattr(figures[proof.worst], name) for key, name in OF_WORST.items()},
        name=scene.name,
        title=scene.title,
        verdict=verdict(proof.passed, (), scene.limits_light),
        passed=proof.passed,
        goals=figures,
        flux=light.flux,
        checks=proof.checks,
        prescription=prescription(scene, lens, proof.shape),
        effects={
            "simulated": tuple(what for what, _ in simulated(scene)),
            "left_out": tuple(LEFT_OUT[entry.kind] for entry in estimates),
        },
        seed=scene.tailoring.seed,
        rrmsd_whole=light.rrmsd_whole,
        unreachable=_unreached(scene, goal),
        optic=scene.optic,
        quality=scene.tailoring.quality,
        rrmsd_asked=scene.accept.rrmsd,
        rays_traced=light.rays,
        shape=proof.shape,
        stability=proof.stability,
        blur=proof.blur,
        finest_detail=_finest_detail(scene, proof, goal.receiver, estimates),
        picture=scene.picture_remarks(),
        lines=tuple(Line(line.wavelength, line.share, rrmsd(goal.picture, line.picture)) for line in proof.lines),
        estimates=estimates,
        flat_tops=tuple(flat_tops(scene, proof)),
        wavefront=proof.wavefront and WavefrontFigures.of(proof.wavefront),
    )
    return _remarked(contents, *remarks(contents, scene, goals, [each.picture for each in proof.lights]))


def _unreached(scene: Scene, goal: Goal) -> dict[str, float | None] | None:
    if goal.reachable is None:
        return None
    return unreached(goal.whole, goal.reachable, scene.lens.passes.largest_turn(scene.index))


def with_part(contents: Contents, part: MadePart, place: str = "") -> Contents:
    """The contents with a made part, whose checks join the verdict; place: path of its folder from the report's."""
    measured = part.facts | {"deviation_map": [f"{place}{name}" for name in MAP_FILES]}
    passed, checks = contents.passed and part.facts["passed"], (*contents.checks, *part.checks)
    contents = replace(contents, checks=checks, passed=passed, measured=measured)
    return _remarked(contents, *written("remarks.txt.j2", "outliers", share=part.facts["outliers"]["share"]))


def _remarked(contents: Contents, *more: Remark) -> Contents:
    """The contents with more remarks, and the verdict that follows."""
    every, asked = (*contents.remarked, *more), contents.verdict != NO_LIMIT
    ids, texts = (tuple(part) for part in zip(*every, strict=True)) if every else ((), ())
    return replace(contents, given_up=texts, remarks=ids, verdict=verdict(contents.passed, texts, asked))


def _finest_detail(
    scene: Scene, proof: Proof, screen: Screen, estimates: tuple[LeftOut, ...]
) -> FinestDetail | None:  # fmt: skip
    """The detail that the source allows: of the scene's size, or of the size that the estimates assume of a point."""
    if proof.blur:
        of = ", ".join(f"source.{key} = {size}" for key, size in extent(scene.source))
        return finest_detail(proof.blur.pixels, proof.lens, screen, of)
    for entry in estimates:
        if entry.kind == "source size" and entry.blur_pixels is not None:
            return finest_detail(entry.blur_pixels, proof.lens, screen, of=entry.detail, assumed=entry.assumed)
    return None


def simulated(scene: Scene) -> Rows:
    """The physics that is simulated for a scene: words, and the key of the scene that asks for it."""
    return tables("simulated.txt.j2", scene=scene, extent=list(extent(scene.source)), names=LEFT_OUT)["simulated"]


def extent(source: Emitter) -> Iterator[tuple[str, str]]:
    """The keys that give a source a size, each with the size in words."""
    yield from ((key, f"{size:g} {unit}") for key, size, unit in source.sizes())


# --- remarks ----------------------------------------------------------------------------------------------------------
# A remark is a sentence with its figure for each wish of the scene that a design does not fulfil, checked or not.  A
# lens may be right to the last nanometre and still lose light, or be thicker than drawn, because the scene left no
# other way; who reads only "passed" or "failed" should not have to search the tables for that.


def remarks(report: Contents, scene: Scene, goals: Sequence[Goal], irradiances: Sequence[np.ndarray]) -> list[Remark]:
    """Remarks on a report, by the irradiance on each target, of its picture's sum; the most important first."""
    allowed = DEFAULT_RRMSD_LIMIT if report.rrmsd_asked is None else report.rrmsd_asked
    pairs = list(zip(goals, irradiances, strict=True))
    return written(
        "remarks.txt.j2", "remarks", report=report, scene=scene, allowed=allowed, names=LEFT_OUT,
        unlit={goal.words: unlit(goal.picture, found, goal.receiver) for goal, found in pairs},
        lifted={goal.words: lifted(goal.picture, found) for goal, found in pairs},
    )  # fmt: skip


def too_steep(found: Steepness) -> list[str]:
    """The light that would need a steeper face than a height over a plane carries; nothing if hardly any does."""
    sent = {"steep_share": found.share, "steepest_deg": found.steepest}
    return [remark.text for remark in written("remarks.txt.j2", "steep", sent=sent)]


def bounds(found: Mapping[str, Any] | None) -> str:
    """The bounds on faces ([lens] tool_radius, max_slope, thicknesses), and which are met where."""
    return "".join(paragraphs("remarks.txt.j2", "bounds", found=found))


# --- from and to a file -----------------------------------------------------------------------------------------------


def read(path: Path) -> Contents:
    """The record of a report.json; ValueError, a sentence, if there is none, or it is damaged or of another program."""
    return read_as(Contents, path, "bstcad verify writes it anew")


def making(path: Path) -> Making:
    """The making of the lens of a report.json; an empty one if the file is gone or damaged."""
    try:
        return read(path).making
    except ValueError:
        return Making()


def read_as(kind: type[Record], path: Path, remedy: str) -> Record:
    """The record of this kind in a JSON file; ValueError, one sentence."""
    try:
        return of_json(files.contents(path, LARGEST), kind)
    except ValueError as error:
        raise ValueError(f"{path}: cannot be read ({error}); {remedy}") from None


def of_json(data: bytes | str, kind: type[Record] = Contents) -> Record:
    """The record of this kind in JSON; ValueError names the first entry that does not fit."""
    try:
        found = _adapter(kind).validate_json(_renewed(data))
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False, include_context=False)[0]
        raise ValueError(": ".join(filter(None, (".".join(map(str, first["loc"])), first["msg"])))) from None
    if not _legible(plain(found)):
        raise ValueError("it holds text that is no line of a report")
    return found


def _renewed(data: bytes | str) -> bytes | str:
    """A report.json or tolerance.json with the keys of today.

    One of before may have estimates of what limits the design, may tell the first of several targets apart, and has z
    for the places of targets.
    """
    try:
        facts = from_json(data)
        facts.pop("limits", None)
        for goal in (*facts.get("goals", ()), *(facts.get("targets") or ())):
            if "z" in goal:
                goal["where"] = LevelPlane(goal.pop("z")).where()
        if "goals" in facts or "prescription" not in facts:
            return to_json(facts)
        prescribed, measured = facts["prescription"], facts.get("measured") or {}
        prescribed["targets"] = [prescribed.pop("target"), *prescribed.pop("further_targets", ())]
        place = LevelPlane(prescribed["targets"][0]["z"]).where()
        alone = {"key": "target", "where": place, "weight": 1.0} | {
            name: facts.get(key) for key, name in OF_WORST.items()
        }
        goals = facts["goals"] = facts.pop("targets", [alone])
        stated = goals[worst(goal["rrmsd"] for goal in goals)]
        facts |= {key: stated[name] for key, name in OF_WORST.items()}
        if measured:
            predicted = {key: measured.get(key) for key in ("rrmsd_predicted", "rrmsd_high")}
            measured["goals"] = measured.pop("targets", [{"key": "target"} | predicted])
        return to_json(facts)
    except (AttributeError, KeyError, TypeError, ValueError):  # no report: that is for the caller to say
        return data


@cache
def _adapter(kind: type[Record]) -> TypeAdapter[Record]:
    return TypeAdapter(kind)


def _legible(value: Any) -> bool:
    """Is every string in it short and printable, so that it steers no terminal?  A scene's own text may have lines."""
    if isinstance(value, str):
        return len(value) <= LONGEST and value.isprintable()
    if isinstance(value, dict):
        return all(_legible(key) and (key == "prescription" or _legible(part)) for key, part in value.items())
    return not isinstance(value, list) or all(map(_legible, value))


def plain(value: Any) -> Any:
    """A record as dicts, lists, text, bools, ints, floats and None."""
    return to_jsonable_python(value, fallback=lambda numbers: numbers.tolist(), inf_nan_mode="constants")


def write_json(report: Contents, path: str | Path) -> None:
    """Write report.json: one record a line, numbers to 12 digits; ValueError names a number that is not finite."""
    lines = ",\n".join(f"  {_line(key)}: {_block(_rounded(value, key))}" for key, value in report.facts().items())
    files.put(Path(path), f"{{\n{lines}\n}}\n".encode())


def _rounded(value: Any, where: str) -> Any:
    """Floats to DIGITS, but for the prescription, which keeps the designed numbers; `where`: in the report."""
    if isinstance(value, dict):
        return {key: _rounded(part, f"{where}.{key}") for key, part in value.items()}
    if isinstance(value, list):
        return [_rounded(part, f"{where}[{i}]") for i, part in enumerate(value)]
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        remedy = "a report holds finite numbers, and null for what was not measured"
        raise ValueError(f"report: {where!r} is {value}; {remedy}")
    return value if where.startswith("prescription.") else float(f"{value:.{DIGITS}g}")


def _line(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _block(value: Any) -> str:
    """JSON of a top-level value: a line for each entry of a dict and for each record of a list."""
    if isinstance(value, dict) and value:
        return "{\n" + ",\n".join(f"    {_line(key)}: {_line(part)}" for key, part in value.items()) + "\n  }"
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "[\n" + ",\n".join(f"    {_line(part)}" for part in value) + "\n  ]"
    return _line(value)


# --- for scripts ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class Report:
    """The worth of a design's files, traced through the geometry re-read from lens.step.

    Every key of report.json is an attribute, such as `rrmsd`, `checks` or `flux` (fields of Contents); `facts` are all
    of them as plain values.
    """

    contents: Contents
    irradiances: tuple[np.ndarray, ...]  # on each target (rows, columns), row 0 = y max, with the target's sum
    # the made part that this verification was given: facts, outliers (n, 3), irradiances as predicted, and deviation,
    # whose x, y and form (rows y, columns x; mm, + out of the glass, NaN outside) are the deviation map; None: none
    measured: Any = None
    notes: tuple[str, ...] = ()  # sentences on the exported files, which stand in their sidecars, too

    @property
    def irradiance(self) -> np.ndarray:
        """On the target with the largest RRMSD."""
        return self.irradiances[worst(goal.rrmsd for goal in self.contents.goals)]

    @property
    def facts(self) -> dict[str, Any]:
        """All of report.json."""
        return self.contents.facts()

    def __getattr__(self, key: str) -> Any:
        """A field of the record."""
        if key.startswith("_") or key == "contents":  # which copying and unpickling ask for too early
            raise AttributeError(key)
        return getattr(self.contents, key)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *vars(self.contents)})

    def __repr__(self) -> str:
        """The verdict and the two figures that matter most; then each remark and each check that failed."""
        failed = (check for check in self.checks if not check.passed)
        return "\n  ".join(
            [
                f"Report {self.name!r}: {self.verdict}, RRMSD {rrmsds(self.contents)}, "
                f"{percent(self.light_on_target)} of the source's light is on {self.worst.words}",
                *(f"failed: {check.name}" + (f" ({check.where})" if check.where else "") for check in failed),
                *(f"given up: {sentence}" for sentence in self.given_up),
            ]
        )


def rrmsds(report: Contents) -> str:
    """The RRMSD on each target, in their order."""
    return ", ".join(number(each.rrmsd) for each in report.goals)


def changes(entry: LeftOut) -> tuple[str, str, str]:
    """The change of the light on the target, of RRMSD and of blur by an effect; a dash for nothing, "?": not known."""
    flux, rrmsd, blur = entry.flux_change, entry.rrmsd_change, entry.blur_pixels
    if rrmsd is None:
        return "?", "?", "?"
    return (
        f"{'+' if flux > 0 else '−'}{percent(min(abs(flux), 1.0))}" if abs(flux) >= NOTHING else "—",
        number(rrmsd) if rrmsd >= NOTHING else "—",
        f"{number(blur)} pixels" if blur >= SHARP else "—",
    )
