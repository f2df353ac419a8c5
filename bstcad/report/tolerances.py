"""tolerance.json as a record, and its words: in a section of report.html and in a table for the terminal.

The study itself stands in bstcad.tolerance.
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

from bstcad.report.record import STRICT, Rrmsd, Share, Size, plain, read_as
from bstcad.report.report import BEGIN, END, encoded
from bstcad.report.units import about, amount, environment, paragraphs, percent
from bstcad.runs import files

if TYPE_CHECKING:
    from rich.console import Group

LARGEST = 30_000_000  # bytes of a page
LARGEST_PICTURE = 1_000_000  # bytes
PNG = b"\x89PNG\r\n\x1a\n"
FIGURES = ("tolerance_trials", "tolerance_worst")  # names of its pictures
LOOSE = 0.1, 0.03  # 95 % and median of the model against full traces, beyond which the full traces' yield counts
LITTLE = 1e-3  # of the picture's change by all errors: smaller shares are listed apart
WIDEST = 10.0  # times its width, up to which the search for the loosest tolerances lets an error go
MOST = 3  # errors that are named of a trial

Yield = tuple[Share, Share, Share]  # 95 % interval of Wilson about the likely one: low, likely, high
Count = Annotated[int, Field(ge=1, le=1_000_000_000)]
Width = Annotated[float, Field(gt=0, le=1e6)]
Spread = TypedDict("Spread", {"5 %": Size, "50 %": Size, "95 %": Size})  # percentiles of RRMSD
Disagreement = TypedDict("Disagreement", {"median": Size, "95 %": Size})  # relative


@dataclass(frozen=True)
class Grade:
    """The grade from which the widths of the errors start."""

    name: str  # moulded, diamond-turned or precise; none: only errors that the scene names
    words: str  # what the grade stands for


@dataclass(frozen=True)
class Sensitivity:
    """One error of how the lens is made, mounted or lit."""

    # of the error, such as lens.tilt_x; form is three fields, such as back.form_0, back.form_1 and back.form_2, which
    # the report shows as the root of the sum of their squares
    name: str
    words: str  # the error in words
    unit: str  # of limit and sigma
    limit: Width  # ±, in its unit; of each field of a form error its standard deviation, the stated limit over √3
    # normal and uniform: within the limit; field: a random field of normal amount, without a bound
    distribution: Literal["normal", "uniform", "field"]
    cost: Width  # of holding the limit, beside the others' 1
    sigma: Width  # standard deviation
    rrmsd_change: float  # by one sigma; of several targets, of that which it changes most
    share: Share  # of the mean square that all errors add to the picture; of several targets, to all pictures
    wavefront_change: float | None = None  # of the RMS wavefront error (waves) by one sigma; None: no wave is wanted


@dataclass(frozen=True)
class Trial:
    """A fully traced trial."""

    number: Annotated[int, Field(ge=0)]  # for --trial
    rrmsd: Size  # of that lens
    amounts: Mapping[str, float]  # of each error, in the unit of its kind


@dataclass(frozen=True)
class Inverse:
    """The loosest tolerances that bring about a wanted yield, by superposed pictures."""

    wanted: Share  # the yield asked for
    passed: Annotated[Yield, Field(alias="yield")]  # by trials of its own
    limits: Mapping[str, Width]  # of each error, as the limit of a sensitivity


@dataclass(frozen=True)
class TargetStudy:
    """One of several targets by itself, in the same trials."""

    key: str  # by which sentences call it: target[0], target[1], …
    where: str  # place of its receiver, in words
    rrmsd: Rrmsd  # of the design there
    passed: Annotated[Yield, Field(alias="yield")]  # lenses that keep to the limit on this target
    passed_full: Annotated[Yield, Field(alias="yield_full")]  # of those that were traced in full
    passed_adjusted: Annotated[Yield, Field(alias="yield_adjusted")]  # of these, with this screen adjusted
    rrmsd_trials: Spread  # of the trials by superposed pictures
    rrmsd_full: Spread  # of the trials traced in full
    rrmsd_adjusted: Spread  # of these, with this screen shifted, focused, tilted and turned to fit
    model_off: Disagreement  # of the model and the full traces
    sensitivities: Annotated[tuple[Sensitivity, ...], Field(max_length=1000)]  # on this target, the worst first


@dataclass(frozen=True)
class WavefrontStudy:
    """The wavefront in the same trials: RMS of its error in waves, piston and tilt removed."""

    rms: Size  # of the design
    rms_trials: Spread  # of the trials by superposed wavefronts
    rms_full: Spread  # of the trials traced in full
    model_off: Disagreement  # of the model and the full traces
    limit: Size | None = None  # accept.wavefront; None: it asks for none
    # lenses that keep to the limit, by superposed wavefronts
    passed: Annotated[Yield | None, Field(alias="yield")] = None
    passed_full: Annotated[Yield | None, Field(alias="yield_full")] = None  # of those that were traced in full


@dataclass(frozen=True)
class Tolerances:
    """All of tolerance.json: a field a key, in its order; `passed…` are its keys `yield…`."""

    __pydantic_config__ = STRICT

    name: str  # of the design
    version: str  # of bstcad
    grade: Grade  # of all tolerances that the scene does not state
    seed: Annotated[int, Field(ge=0)]  # of the trials
    tubes: Count  # a side, a channel
    limit: Rrmsd  # the RRMSD at which a lens passes
    rrmsd: Rrmsd  # of the design; of several targets here and below the worst one's, lens by lens
    trials: Count  # by the model of superposed pictures
    full_trials: Count  # of them by full traces
    # the yield by superposed pictures: lenses that keep to the limit on all targets, and to that of the wavefront
    passed: Annotated[Yield, Field(alias="yield")]
    passed_full: Annotated[Yield, Field(alias="yield_full")]  # the yield of the lenses that were traced in full
    passed_adjusted: Annotated[Yield, Field(alias="yield_adjusted")]  # of the full trials, with the screen adjusted
    rrmsd_trials: Spread  # of the trials by superposed pictures
    rrmsd_full: Spread  # of the trials traced in full
    rrmsd_adjusted: Spread  # of the full trials, with the screen shifted, focused, tilted and turned to fit
    model_off: Disagreement  # of the model and the full traces
    sensitivities: Annotated[tuple[Sensitivity, ...], Field(max_length=1000)]  # the worst first
    worst: Annotated[tuple[Trial, ...], Field(max_length=100)]  # of the fully traced trials
    inverse: Inverse | None = None  # None: it was not asked for
    targets: Annotated[tuple[TargetStudy, ...], Field(max_length=100)] | None = None  # None: there is one
    wavefront: WavefrontStudy | None = None  # None: the scene asks for no wave

    def facts(self) -> dict[str, Any]:
        """The entries of tolerance.json as plain values, in their order."""
        return _known(plain(self))

    @property
    def trusted(self) -> bool:
        """Do superposed pictures, and wavefronts that a limit is held to, stand up to the full traces?"""
        judged = self.wavefront is not None and self.wavefront.limit is not None
        offs = (self.model_off, self.wavefront.model_off) if judged else (self.model_off,)
        return all(off["95 %"] <= LOOSE[0] and off["median"] <= LOOSE[1] for off in offs)

    @property
    def loosest(self) -> Mapping[str, float]:
        """The loosest ± by error; nothing if they were not asked for."""
        return {} if self.inverse is None else self.inverse.limits


def _known(value: Any) -> Any:
    """The same by the keys of the file, without those that are not known."""
    if isinstance(value, dict):
        return {key.replace("passed", "yield"): _known(part) for key, part in value.items() if part is not None}
    return list(map(_known, value)) if isinstance(value, list) else value


def read(path: Path) -> Tolerances:
    """The record of a tolerance.json; ValueError, a sentence, if it is damaged or of another program."""
    return read_as(Tolerances, path, "bstcad tolerance writes it anew")


def write(found: Tolerances, path: Path) -> None:
    """Write tolerance.json."""
    files.put(path, (json.dumps(found.facts(), ensure_ascii=False, indent=1) + "\n").encode())


# --- report.html ------------------------------------------------------------------------------------------------------


def section(found: Tolerances, pictures: Mapping[str, bytes], optic: str) -> str:
    """HTML of a study; pictures: PNG bytes by FIGURES."""
    return environment().get_template("tolerances.html.j2").render(
        study=found, errors=errors(found), worst_errors=worst_errors, little=LITTLE, widest=WIDEST, optic=optic,
        pictures=encoded({key: picture for key, picture in pictures.items() if key in FIGURES}),
    )  # fmt: skip


def of_folder(folder: Path, optic: str) -> str:
    """The section of a design's folder; nothing where there is no tolerance.json, or none of ours."""
    try:
        found = read(folder / "tolerance.json")
    except ValueError:
        return ""
    pictures = {}
    for key in FIGURES:
        with contextlib.suppress(OSError, ValueError):
            picture = files.contents(folder / "figures" / f"{key}.png", LARGEST_PICTURE)
            if picture.startswith(PNG):
                pictures[key] = picture
    return section(found, pictures, optic)


def put_into(page: Path, section: str) -> bytes | None:
    """The page with this section instead of an earlier one; None for a page that has no place for it."""
    try:
        text = files.contents(page, LARGEST).decode("utf-8")
    except (OSError, ValueError):
        return None
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    return f"{before}{begin}\n{section}{end}{after}".encode() if begin and end else None


def errors(found: Tolerances) -> list[dict[str, Any]]:
    """The rows of the errors, the worst first: words, width, distribution, change, share, part, loosest.

    The fields that a form error is mixed of are one error: their changes add up, and their widths do as squares.
    """
    groups: dict[str, list[Sensitivity]] = {}
    for item in found.sensitivities:
        name = item.name.rpartition("_")[0] if item.distribution == "field" else item.name
        groups.setdefault(name, []).append(item)
    return sorted((_error(items, found.loosest) for items in groups.values()), key=lambda row: -row["part"])


def _error(items: Sequence[Sensitivity], loosest: Mapping[str, float]) -> dict[str, Any]:
    first, part, change = items[0], *(math.fsum(getattr(i, key) for i in items) for key in ("share", "rrmsd_change"))
    waves = [item.wavefront_change for item in items if item.wavefront_change is not None]
    words, loose = first.words.partition(" (draw")[0], [loosest[item.name] for item in items if item.name in loosest]
    widest = WIDEST * math.hypot(*(item.limit for item in items))  # which the search does not exceed
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
    """The errors that add most to the picture of a trial."""
    known = {item.name: item for item in found.sensitivities if item.name in trial.amounts}

    def added(item: Sensitivity) -> float:
        return abs(trial.amounts[item.name] / item.sigma) * math.sqrt(max(item.share, 0.0))

    first = sorted(known.values(), key=added, reverse=True)[:MOST]
    return "; ".join(f"{item.words} {amount(trial.amounts[item.name], item.unit, signed=True)}" for item in first)


# --- terminal ---------------------------------------------------------------------------------------------------------


def summary(found: Tolerances) -> Group:
    """The table of errors and the sentences, for `rich.print`."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    columns = {"words": "error", "width": "±", "change": "RRMSD by 1 σ", "share": "share"}
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
