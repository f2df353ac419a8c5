"""tolerance.json as a record, its section of report.html and its table for the terminal.

bstcad.manufacture.tolerance computes the study.  A trial is one random draw of all errors.  Its superposed picture is
the design's picture plus the change by each error, traced alone; its full trace is the picture with all errors
together.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field
from typing_extensions import TypedDict

from bstcad.designs.course import Fraction, Rrmsd, Size
from bstcad.report.record import STRICT, plain, read_as
from bstcad.report.report import BEGIN, END, base64_images
from bstcad.report.units import about, amount, environment, paragraphs, percent
from bstcad.runs import files

if TYPE_CHECKING:
    from rich.console import Group

MAX_PAGE_BYTES = 30_000_000  # largest report.html that is read (bytes)
MAX_PICTURE_BYTES = 1_000_000  # largest picture of a study that is read (bytes)
PNG = b"\x89PNG\r\n\x1a\n"
FIGURES = ("tolerance_trials", "tolerance_worst")  # names of the study's pictures: figures/NAME.png
MAX_DISAGREEMENT = 0.1, 0.03  # largest Disagreement of trusted superposed pictures: 95th percentile, median
MIN_FRACTION = 1e-3  # errors with a smaller fraction of the mean square change of the pictures are in a second table
WIDEST = 10.0  # largest factor by which the search for the loosest tolerances widens an error
MAX_NAMED_ERRORS = 3  # largest number of errors that are named per trial

Yield = tuple[Fraction, Fraction, Fraction]  # lower bound, estimate and upper bound of the yield (95 % Wilson interval)
Count = Annotated[int, Field(ge=1, le=1_000_000_000)]
Width = Annotated[float, Field(gt=0, le=1e6)]
Spread = TypedDict("Spread", {"5 %": Size, "50 %": Size, "95 %": Size})  # percentiles of RRMSD, or waves RMS
Disagreement = TypedDict("Disagreement", {"median": Size, "95 %": Size})  # relative errors of superposed RRMSD or RMS


# grades whose layers, tool marks or roughness a maker finishes
FINISHED_GRADES = ("milled-polished", "milled-sanded", "resin-printed", "resin-printed-coated")


@dataclass(frozen=True)
class Grade:
    """Grade of manufacture that gives the default widths of the errors."""

    name: str  # name of the grade, such as "moulded"; "none": only errors that the scene names
    words: str  # description of the grade

    @property
    def has_finish(self) -> bool:
        """True for a grade of a maker, whose layers or roughness change the picture."""
        return self.name in FINISHED_GRADES


@dataclass(frozen=True)
class Sensitivity:
    """Sensitivity to one error of manufacture, mounting or illumination."""

    # name of the error, such as lens.tilt_x; a form error is three fields, such as back.form_0, back.form_1 and
    # back.form_2; the report states the root of the sum of the squares of their widths
    name: str
    words: str  # description of the error
    unit: str  # unit of limit and sigma
    limit: Width  # width ±, in `unit`; of a field: standard deviation of its amplitude, the stated limit divided by √3
    # normal and uniform: inside the limit; field: a random field of normally distributed amplitude, without a bound
    distribution: Literal["normal", "uniform", "field"]
    cost: Width  # relative cost of the limit (default 1)
    sigma: Width  # standard deviation, in `unit`
    rrmsd_change: float  # change of RRMSD by one sigma; with several targets, on the target that changes most
    share: Fraction  # part of this error in the mean square change that all errors cause in all pictures
    wavefront_change: float | None = None  # change of the RMS wavefront error by one sigma (waves); None: no wave


@dataclass(frozen=True)
class Trial:
    """Trial that was traced in full."""

    number: Annotated[int, Field(ge=0)]  # number of the trial, as in bstcad tolerance --trial
    rrmsd: Size  # RRMSD of the lens of the trial
    amounts: Mapping[str, float]  # amount of each error, in its unit


@dataclass(frozen=True)
class Inverse:
    """Loosest tolerances for a requested yield, computed with superposed pictures."""

    wanted: Fraction  # requested yield
    passed: Annotated[Yield, Field(alias="yield")]  # yield of new trials with `limits`
    limits: Mapping[str, Width]  # width of each error, as Sensitivity.limit


@dataclass(frozen=True)
class TargetStudy:
    """Results on one of several targets; all targets have the same trials."""

    key: str  # target[0], target[1], …
    where: str  # position of the receiver, in words
    rrmsd: Rrmsd  # RRMSD of the design on this target
    passed: Annotated[Yield, Field(alias="yield")]  # yield on this target alone, by superposed pictures
    passed_full: Annotated[Yield, Field(alias="yield_full")]  # yield of the trials traced in full
    # yield of the same trials with the screen at its best position, see rrmsd_adjusted
    passed_adjusted: Annotated[Yield, Field(alias="yield_adjusted")]
    rrmsd_trials: Spread  # RRMSD of the trials by superposed pictures
    rrmsd_full: Spread  # RRMSD of the trials traced in full
    rrmsd_adjusted: Spread  # RRMSD of these trials by superposed pictures, this screen at its best position
    model_off: Disagreement  # disagreement of superposed pictures with full traces
    # sensitivities to the errors on this target, the largest change of the RRMSD first
    sensitivities: Annotated[tuple[Sensitivity, ...], Field(max_length=1000)]


@dataclass(frozen=True)
class WavefrontStudy:
    """Results on the wavefront in the trials of the study: RMS error in waves, with piston and tilt removed."""

    rms: Size  # RMS error of the design
    rms_trials: Spread  # RMS error of the trials by superposed wavefronts
    rms_full: Spread  # RMS error of the trials traced in full
    model_off: Disagreement  # disagreement of superposed wavefronts with full traces
    limit: Size | None = None  # accept.wavefront; None: no limit
    # yield by superposed wavefronts: fraction of the trials within `limit`; None: no limit
    passed: Annotated[Yield | None, Field(alias="yield")] = None
    passed_full: Annotated[Yield | None, Field(alias="yield_full")] = None  # yield of the trials traced in full


@dataclass(frozen=True)
class Tolerances:
    """Content of tolerance.json: one field per key, in the order of the file.

    Fields named `passed…` have the keys `yield…`.
    """

    __pydantic_config__ = STRICT

    name: str  # name of the design
    version: str  # version of bstcad
    grade: Grade  # grade of all tolerances that the scene does not state
    seed: Annotated[int, Field(ge=0)]  # seed of the trials
    tubes: Count  # flux tubes per side, for each channel
    limit: Rrmsd  # largest RRMSD of a lens that passes
    rrmsd: Rrmsd  # RRMSD of the design; here and below each RRMSD of a lens is the largest over the targets
    trials: Count  # number of trials by superposed pictures: sums of the changes that single errors cause
    full_trials: Count  # number of trials that are traced in full, with all errors together
    # yield by superposed pictures: lenses within `limit` on all targets and within the limit of the wavefront
    passed: Annotated[Yield, Field(alias="yield")]
    passed_full: Annotated[Yield, Field(alias="yield_full")]  # yield of the trials traced in full
    # yield of the same trials with the screen at its best position, see rrmsd_adjusted
    passed_adjusted: Annotated[Yield, Field(alias="yield_adjusted")]
    rrmsd_trials: Spread  # RRMSD of the trials by superposed pictures
    rrmsd_full: Spread  # RRMSD of the trials traced in full
    rrmsd_adjusted: Spread  # RRMSD of the fully traced trials by superposed pictures, the screen at its best position
    model_off: Disagreement  # disagreement of superposed pictures with full traces
    # sensitivities to the errors, the largest change of the RRMSD first
    sensitivities: Annotated[tuple[Sensitivity, ...], Field(max_length=1000)]
    worst: Annotated[tuple[Trial, ...], Field(max_length=100)]  # worst of the fully traced trials
    inverse: Inverse | None = None  # loosest tolerances for a requested yield; None: no yield was requested
    # results on each target; None: there is one target
    targets: Annotated[tuple[TargetStudy, ...], Field(max_length=100)] | None = None
    wavefront: WavefrontStudy | None = None  # results on the wavefront; None: the scene has no [wavefront]

    def facts(self) -> dict[str, Any]:
        """Return the entries of tolerance.json as plain values, in their order."""
        return _file_keys(plain(self))

    @property
    def trusted(self) -> bool:
        """True if superposed pictures, and wavefronts if limited, agree with full traces within MAX_DISAGREEMENT."""
        limited = self.wavefront is not None and self.wavefront.limit is not None
        found = (self.model_off, self.wavefront.model_off) if limited else (self.model_off,)
        return all(each["95 %"] <= MAX_DISAGREEMENT[0] and each["median"] <= MAX_DISAGREEMENT[1] for each in found)

    @property
    def loosest(self) -> Mapping[str, float]:
        """Loosest width ± by name of the error, in its unit; empty if no yield was requested."""
        return {} if self.inverse is None else self.inverse.limits


def _file_keys(value: Any) -> Any:
    """Return a value from `plain` with "yield" in place of "passed" in its keys, without entries that are None."""
    if isinstance(value, dict):
        return {key.replace("passed", "yield"): _file_keys(part) for key, part in value.items() if part is not None}
    return list(map(_file_keys, value)) if isinstance(value, list) else value


def read(path: Path) -> Tolerances:
    """Read a tolerance.json; ValueError (one sentence) if it is damaged or from another program."""
    return read_as(Tolerances, path, "run bstcad tolerance to write it again")


def write(found: Tolerances, path: Path) -> None:
    """Write tolerance.json."""
    files.put(path, (json.dumps(found.facts(), ensure_ascii=False, indent=1) + "\n").encode())


# --- report.html ------------------------------------------------------------------------------------------------------


def section(found: Tolerances, pictures: Mapping[str, bytes], optic: str) -> str:
    """Return the HTML section on a study; pictures: PNG bytes by the names in FIGURES; optic: lens or mirror."""
    return environment().get_template("tolerances.html.j2").render(
        study=found, errors=errors(found), worst_errors=worst_errors, little=MIN_FRACTION, widest=WIDEST, optic=optic,
        pictures=base64_images({key: picture for key, picture in pictures.items() if key in FIGURES}),
    )  # fmt: skip


def of_folder(folder: Path, optic: str) -> str:
    """Return `section` on the study in a design's folder; "" if tolerance.json is unreadable; optic: lens or mirror."""
    try:
        found = read(folder / "tolerance.json")
    except ValueError:
        return ""
    pictures = {}
    for key in FIGURES:
        with contextlib.suppress(OSError, ValueError):
            picture = files.contents(folder / "figures" / f"{key}.png", MAX_PICTURE_BYTES)
            if picture.startswith(PNG):
                pictures[key] = picture
    return section(found, pictures, optic)


def put_into(page: Path, section: str) -> bytes | None:
    """Return the report.html `page` with `section` between BEGIN and END; None if `page` is unreadable or lacks one."""
    try:
        text = files.contents(page, MAX_PAGE_BYTES).decode("utf-8")
    except (OSError, ValueError):
        return None
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    return f"{before}{begin}\n{section}{end}{after}".encode() if begin and end else None


def errors(found: Tolerances) -> list[dict[str, Any]]:
    """Return the rows of the table of errors as dicts with the keys of `_error`, the largest fraction first.

    The fields of a form error are one row, with the sum of their changes, and with their widths added in quadrature.
    """
    groups: dict[str, list[Sensitivity]] = {}
    for item in found.sensitivities:
        name = item.name.rpartition("_")[0] if item.distribution == "field" else item.name
        groups.setdefault(name, []).append(item)
    return sorted((_error(items, found.loosest) for items in groups.values()), key=lambda row: -row["part"])


def _error(items: Sequence[Sensitivity], loosest: Mapping[str, float]) -> dict[str, Any]:
    first, part, change = items[0], *(math.fsum(getattr(i, key) for i in items) for key in ("share", "rrmsd_change"))
    waves = [item.wavefront_change for item in items if item.wavefront_change is not None]
    words, loose = first.words.partition(" (sample")[0], [loosest[item.name] for item in items if item.name in loosest]
    widest = WIDEST * math.hypot(*(item.limit for item in items))  # limit of the search
    at_least = "≥ " if math.isclose(math.hypot(*loose), widest) else ""
    return {
        "words": words[:1].upper() + words[1:],
        "width": amount(math.hypot(*(item.limit for item in items)), first.unit),
        "distribution": "random field" if first.distribution == "field" else first.distribution,
        "change": _signed(change),
        "wavefront": _signed(math.fsum(waves)) if waves else "",
        "share": percent(part),
        "part": part,
        "loosest": at_least + amount(math.hypot(*loose), first.unit) if loose else "",
    }


def _signed(change: float) -> str:
    return f"{'+' if change > 0 else ''}{about(change)}"


def worst_errors(found: Tolerances, trial: Trial) -> str:
    """Return the errors that change the picture of a trial most, with their amounts, in words."""
    known = {item.name: item for item in found.sensitivities if item.name in trial.amounts}

    def added(item: Sensitivity) -> float:
        return abs(trial.amounts[item.name] / item.sigma) * math.sqrt(max(item.share, 0.0))

    first = sorted(known.values(), key=added, reverse=True)[:MAX_NAMED_ERRORS]
    return "; ".join(f"{item.words} {amount(trial.amounts[item.name], item.unit, signed=True)}" for item in first)


# --- terminal ---------------------------------------------------------------------------------------------------------


def summary(found: Tolerances) -> Group:
    """Return the table of errors and the sentences on the study, for `rich.print`."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    columns = {"words": "error", "width": "±", "change": "RRMSD on pixels by 1 σ", "share": "fraction"}
    if found.wavefront:
        columns["wavefront"] = "waves by 1 σ"
    if found.loosest:
        columns["loosest"] = "loosest ±"
    table = Table(title=Text(f"Tolerances of {found.name}: {found.grade.words}"), title_justify="left")
    for heading in columns.values():
        table.add_column(heading, justify="left" if heading == "error" else "right")
    for row in errors(found):
        table.add_row(*(Text(row[key]) for key in columns))
    return Group(table, *map(Text, paragraphs("study.txt.j2", "sentences", study=found, widest=WIDEST)))
