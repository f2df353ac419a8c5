"""What report.json holds, as a record whose fields are its keys; and the Report that scripts are given of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from bstcad.report.units import number, percent
from bstcad.verify.verdict import Check

BY_HAND = "by hand"  # Making.stopped of a lens that was changed after it was designed, or is somebody's own
Scalar = str | float | int | bool | None


@dataclass(frozen=True)
class Stage:
    """How one stage of the work went."""

    name: str
    seconds: float
    rrmsd: float | None = None  # after it
    cpu_seconds: float | None = None  # of all processors; None: another process had a part in it, or unknown


@dataclass(frozen=True)
class Point:
    """One point of the way down."""

    seconds: float  # since the start
    rrmsd: float


@dataclass(frozen=True)
class Twins:
    """What float32 makes of the scene, beside float64; as tailoring.precision.Comparison has it."""

    control_points: int  # a side
    merit: float  # relative difference before the first step
    gradient: float  # the same, of its norm
    evaluations: int  # of each
    rrmsd_float64: float  # after them
    rrmsd_float32: float
    heights: float  # mm; largest difference of a control point


@dataclass(frozen=True)
class Line:
    """The light of one line of a spectrum by itself."""

    wavelength: float  # nm
    share: float  # of all light
    rrmsd: float  # of its picture against the target


@dataclass(frozen=True)
class Making:
    """How a lens came about; None is what nobody told, as of a design whose earlier report is gone."""

    seconds_total: float = 0.0  # to the verified lens
    stages: tuple[Stage, ...] = ()
    history: tuple[Point, ...] = ()
    machine: Mapping[str, Scalar] | None = None
    versions: Mapping[str, str] | None = None  # of the libraries
    transport: Mapping[str, Scalar] | None = None  # grid, iterations, mass error, what stopped it
    skipped_steps: int | None = None  # left out because their gradient was not finite
    stopped: str | None = None  # what ended tailoring
    twins: Twins | None = None

    def followed_by(self, *last: Stage) -> Making:
        """The same with these stages last, instead of any of their names before."""
        names = [stage.name for stage in last]
        again = sum(stage.seconds for stage in self.stages if stage.name in names)
        seconds = self.seconds_total - again + sum(stage.seconds for stage in last)
        stages = (*(stage for stage in self.stages if stage.name not in names), *last)
        return replace(self, stages=stages, seconds_total=seconds)


@dataclass(frozen=True)
class LeftOut:
    """An effect that is left out, and its change (analysis.neglected_effects.Change); None where that is not known."""

    kind: str  # a word of report.vocabulary.LEFT_OUT
    flux_change: float | None  # of 1
    rrmsd_change: float | None
    blur_pixels: float | None
    detail: str = ""  # what was reckoned with, or why nothing is known
    simulate_by: str = ""  # what in a scene file has it simulated; nothing: bstcad does not
    assumed: bool = False  # is that, how large it is, an example which neither the scene nor nature states?


@dataclass(frozen=True)
class Judge:
    """What a program not written here makes of the lens, beside what bstcad makes of it; as judges.comparison has it.

    None, from `by` on, of one that could not serve.
    """

    name: str
    version: str
    declined: str = ""  # why it could not serve
    by: str | None = None  # how, where it has a choice
    rays: int | None = None
    pixels: tuple[int, int] | None = None  # columns, rows
    losses: str | None = None  # what light loses in both pictures: "none" or "Fresnel"
    rrmsd: float | None = None  # of its picture against the target
    rrmsd_ours: float | None = None  # of bstcad's, of the same light on the same pixels
    difference: float | None = None  # of the two pictures, as a part of the target
    noise: float | None = None  # of that difference
    over_noise: float | None = None
    limit: float | None = None
    agrees: bool | None = None
    on_target: float | None = None  # part of the source's light, as it has it
    on_target_ours: float | None = None
    heights_off: float | None = None  # mm, RMS: its faces against those of the file
    slopes_off: float | None = None  # rad, RMS
    moved_by: float | None = None  # pixels, by which that moves light
    seconds: float | None = None


@dataclass(frozen=True)
class Contents:
    """All of report.json: a field a key, in its order."""

    name: str
    title: str
    verdict: str  # of verify.verdict.VERDICTS
    passed: bool  # every check
    rrmsd: float  # of the irradiance against the target, by the flux into each pixel
    rrmsd_tent: float | None  # the same by linear binning
    rrmsd_noise: float  # standard error of rrmsd
    light_on_target: float  # part of what the source sends out
    efficiency: float  # flux on the target over flux that leaves the back face
    flux: Mapping[str, float]  # where the source's flux goes; sums to 1
    prescription: Mapping[str, Any]  # every surface as it was designed
    seconds_total: float
    stages: tuple[Stage, ...]
    history: tuple[Point, ...]
    checks: tuple[Check, ...]
    effects: Mapping[str, tuple[str, ...]]  # simulated, left_out
    machine: Mapping[str, Scalar]
    versions: Mapping[str, str]
    seed: int
    version: str | None = None  # of bstcad, which wrote it
    leak: float | None = None  # of the light on the target, on its dark pixels (optics.irradiance.Leak); None: none is
    contrast: float | None = None  # mean irradiance of the lit pixels over that of the dark ones; None: or without leak
    optic: str = "lens"  # or "mirror"
    quality: str | None = None  # one of UNTOLD that is None was not told, and is no key of the file
    transport: Mapping[str, Scalar] | None = None
    skipped_steps: int | None = None
    stopped: str | None = None
    twins: Twins | None = None  # None: there was no time for them
    rrmsd_asked: float | None = None  # None: the scene asks for none
    rays_traced: int | None = None
    shape: Mapping[str, float | None] | None = None  # thickness, radii (mm), slope (degrees), volume (mm³) …
    stability: Mapping[str, float | int | None] | None = None
    # width of the source's image on the target (mm, pixels), RRMSD of the target blurred by it; None: it has no size
    blur: Mapping[str, float] | None = None
    # how wide a point of the picture becomes, as analysis.blur.FinestDetail has it: width, source_image, pixel,
    # distance, nearer_distance, nearer_width (mm), of (which size of the source), assumed (not stated by the scene?)
    finest_detail: Mapping[str, Any] | None = None
    lines: tuple[Line, ...] | None = None  # of a spectrum; None: it has one
    given_up: tuple[str, ...] = ()  # what was asked and is not so, in a sentence each
    estimates: tuple[LeftOut, ...] = ()  # what the effects left out would change, the largest change first
    # the end of the convergence curve: rrmsd, last_tenth_seconds, last_tenth (a part of the time), power, fit, halving
    # (times the time, for half of the error), as analysis.cost.Ending has them; None: there is no curve
    convergence: Mapping[str, float | None] | None = None
    # where the error sits: parts [{name, error, pixels}] (parts of the squared error, and of the pixels), octaves
    # [{frequency (cycles a pixel), period (mm), error}], outside (part of the light beside the target)
    remaining_error: Mapping[str, Any] | None = None
    # what limits the design, what matters most first: {by, rrmsd (times what it is, after one step of it), figures,
    # because}, as analysis.cost.Limit has them
    limits: tuple[Mapping[str, Any], ...] = ()
    # the bounds on the back: asked {key of [lens]: value}, at (part of the back that is at each), rrmsd and rrmsd_freed
    # (of the design, and of the same tailored on without them, by the same tubes); None: none is asked
    bounds: Mapping[str, Any] | None = None
    judges: tuple[Judge, ...] = ()  # other programs, where somebody asked for them
    # a made part by its cloud, as measured.made_part has it: points, alignment, pv, rms, rrmsd_predicted, passed …
    measured: Mapping[str, Any] | None = None
    # what a shop is sent and told, as report.order.Order has it: file, sha256, size, volume, mass, datum …
    order: Mapping[str, Any] | None = None

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Contents:
        """The record of these entries; ValueError, naming the key, for one that is missing."""
        missing = [key for key in KEYS if key not in facts]
        if missing:
            raise ValueError(f"report: {', '.join(map(repr, missing))} missing; every report.json has them")
        known = {key: facts[key] for key in ALL if key in facts}
        rows = {key: tuple(kind(**row) for row in known[key]) for key, kind in ROWS.items()}
        twins, lines = known.get("twins"), known.get("lines")
        estimates = tuple(LeftOut(**entry) for entry in known.get("estimates", ()))  # which older reports have none of
        known |= {"lines": tuple(Line(**line) for line in lines) if lines else None, "estimates": estimates}
        known |= {"limits": tuple(known.get("limits", ()))}
        known |= {"judges": tuple(Judge(**entry) for entry in known.get("judges", ()))}
        known |= rows | {"twins": Twins(**twins) if twins else None, "given_up": tuple(known.get("given_up", ()))}
        return cls(**known)

    def facts(self) -> dict[str, Any]:
        """The entries of report.json, in their order."""
        entries = {name: getattr(self, name) for name in ALL}
        rows = {key: [asdict(row) for row in entries[key]] for key in ROWS}
        entries["estimates"] = [asdict(entry) for entry in self.estimates] or None
        entries["limits"] = list(self.limits) or None
        entries["judges"] = [asdict(judge) for judge in self.judges] or None
        entries |= {"lines": self.lines and [asdict(line) for line in self.lines]}
        entries |= rows | {"twins": self.twins and asdict(self.twins), "given_up": list(self.given_up)}
        return {key: value for key, value in entries.items() if value is not None or key not in UNTOLD}


ALL = tuple(entry.name for entry in fields(Contents))
KEYS = ALL[: ALL.index("seed") + 1]  # of every report.json, in this order; what a report holds beyond them follows
UNTOLD = {
    "version", "quality", "transport", "skipped_steps", "stopped", "rays_traced", "shape", "stability", "blur",
    "finest_detail", "lines", "estimates", "convergence", "remaining_error", "limits", "bounds", "judges", "measured",
    "order",
}  # fmt: skip
ROWS = {"stages": Stage, "history": Point, "checks": Check}


@dataclass(frozen=True)
class Examined:
    """What is to be said of a STEP file by itself."""

    name: str
    title: str
    verdict: str
    passed: bool
    checks: tuple[Check, ...]
    part: Mapping[str, str]  # what there is to know of the part

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Examined:
        """The record of these entries."""
        return cls(**{**facts, "checks": tuple(Check(**check) for check in facts["checks"])})

    def facts(self) -> dict[str, Any]:
        """Its entries as plain values."""
        return asdict(self) | {"checks": [asdict(check) for check in self.checks]}


def read(facts: Mapping[str, Any]) -> Contents | Examined:
    """The record of what `bstcad verify` tells, of a design or of a STEP file by itself."""
    return Examined.of(facts) if "part" in facts else Contents.of(facts)


@dataclass(frozen=True, eq=False)
class Report:
    """What the files of a design are worth, traced through the geometry re-read from lens.step."""

    name: str
    verdict: str  # "passed", "passed with remarks" or "failed"
    passed: bool  # every check
    rrmsd: float  # of the irradiance against the target, by the flux into each pixel
    rrmsd_tent: float  # the same by linear binning
    rrmsd_noise: float  # standard error of rrmsd
    light_on_target: float  # part of what the source sends out
    efficiency: float  # flux on the target over flux that leaves the back face
    leak: float | None  # part of the light on the target that falls where it wants none; None: it is dark nowhere
    contrast: float | None  # mean irradiance of its lit pixels over that of its dark ones; None: or there is no leak
    flux: Mapping[str, float]  # where the source's flux goes; sums to 1
    given_up: tuple[str, ...]  # what was asked and is not so, in a sentence each
    checks: tuple[Check, ...]
    prescription: Mapping[str, Any]  # every surface as it was designed: vertex, radius, curvature, glass …
    shape: Mapping[str, float | None]  # thickness, radii (mm), slope (degrees), volume (mm³) …
    seconds_total: float  # to the verified lens
    irradiance: np.ndarray = field(repr=False)  # (rows, columns), row 0 = y max, with the target's sum
    facts: Mapping[str, Any] = field(repr=False)  # all of report.json
    # the made part that this verification was given: facts, outliers (n, 3), irradiance as predicted, and deviation,
    # whose x, y and form (rows y, columns x; mm, + out of the glass, NaN outside) are the deviation map; None: none
    measured: Any = field(default=None, repr=False)

    @classmethod
    def of(cls, contents: Contents, irradiance: np.ndarray, part: Any = None) -> Report:
        """What of a report a script asks for first; part: the bstcad.measured.made_part.MadePart, if there is one."""
        shared = {entry.name for entry in fields(cls)} & set(ALL) - {"measured"}
        same = {name: getattr(contents, name) for name in shared}
        return cls(**same, irradiance=irradiance, facts=contents.facts(), measured=part)

    def __repr__(self) -> str:
        """The verdict and the two figures that matter most; then each remark and each check that failed."""
        failed = [f"{check.name} ({check.where})" if check.where else check.name for check in self.checks
                  if not check.passed]  # fmt: skip
        return "\n  ".join(
            [
                f"Report {self.name!r}: {self.verdict}, RRMSD {number(self.rrmsd)}, "
                f"{percent(self.light_on_target)} of the source's light is on the target",
                *(f"failed: {name}" for name in failed),
                *(f"given up: {sentence}" for sentence in self.given_up),
            ]
        )
