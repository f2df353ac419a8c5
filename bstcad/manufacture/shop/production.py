"""Page that a production engineer signs: asked, designed, tolerated, measured, corrected and expected, round by round.

production.html of a design's folder shows the entries of report.json, tolerance.json and compensation.json of each
round, without a figure of its own.  It loads nothing, and prints on one sheet.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from bstcad.designs.course import Rrmsd, Size
from bstcad.manufacture.tolerance import tolerances
from bstcad.report import record
from bstcad.report.units import environment
from bstcad.runs import files

PAGE, ROUNDS, FIGURES, FIGURE = "production.html", "compensated", "compensation.json", "correction.png"
ROUND_REMEDY = "remove the folder of this round and the later ones to begin again from the round before"
SIGNATURES = "Cut by", "Measured by", "Released by"


@dataclass(frozen=True)
class DeviationFigures:
    """Sizes of a deviation over the face, along z."""

    __pydantic_config__ = record.STRICT
    pv_mm: Size  # peak to valley (mm)
    rms_mm: Size  # RMS (mm)


@dataclass(frozen=True)
class CloudFigures:
    """Cloud of points that was measured for a round."""

    __pydantic_config__ = record.STRICT
    file: str  # name of the file
    sha256: str  # SHA-256 of the file, by which a cloud that was used before is recognised
    points: int  # number of points


@dataclass(frozen=True)
class RoundLight:
    """RRMSD of the picture: of the design, with the deviation measured, and with the one expected to remain."""

    __pydantic_config__ = record.STRICT
    design: Rrmsd  # RRMSD of the design
    measured: Rrmsd  # RRMSD with the deviation measured
    expected: Rrmsd  # RRMSD with the deviation expected to remain
    expected_by_form: Rrmsd | None = None  # RRMSD expected after a correction by form


@dataclass(frozen=True)
class RoundFigures:
    """Contents of compensation.json, of which each number is finite."""

    __pydantic_config__ = record.STRICT
    round: int  # number of the round, from 1
    parts: int  # number of parts that were measured for this round
    clouds: tuple[CloudFigures, ...]  # clouds of the parts
    gain: Size  # fraction of the deviation that is corrected
    filter: str  # kind of the low pass
    cutoff_mm: Size  # cutoff wavelength of the low pass (mm)
    deviation: DeviationFigures  # mean deviation of the parts from the design
    correction: DeviationFigures  # change of the back
    expected_deviation: DeviationFigures  # deviation expected to remain
    by: Literal["form", "light"]  # light: of long waves, only what changes the picture is corrected
    volume_mm3: Size  # volume of the correction (mm³)
    volume_by_form_mm3: Size  # volume of a correction of the whole form (mm³)
    may_stay: DeviationFigures | None  # deviation that a correction by light leaves; None: by form
    standard_error_mm: Size  # standard error of the measured deviation (mm RMS)
    noise_mm: Size  # noise of the measured points (mm RMS)
    rrmsd: RoundLight  # RRMSDs of the picture


def read_round(place: Path) -> RoundFigures:
    """Return the figures of a round from its folder; ValueError, in one sentence, if they are missing or damaged."""
    return record.read_as(RoundFigures, place / FIGURES, ROUND_REMEDY)


def rounds_in(folder: Path) -> list[dict[str, Any]]:
    """Return the figures of each round of a design's folder, in order, with its `place` and its figure as base64.

    ValueError, in one sentence, for a round whose figures are damaged.
    """
    found: list[dict[str, Any]] = []
    while (place := folder / ROUNDS / f"round-{len(found) + 1}").is_dir():
        picture = place / FIGURE
        drawn = base64.b64encode(picture.read_bytes()).decode() if picture.is_file() else ""
        found.append(record.plain(read_round(place)) | {"place": f"{ROUNDS}/{place.name}", "picture": drawn})
    return found


def production_page(
    report: Mapping[str, Any], rounds: Sequence[Mapping[str, Any]], study: Mapping[str, Any] | None, digest: str
) -> str:
    """Return the page; report: report.json; rounds: of `rounds_in`; study: tolerance.json; digest: of lens.step."""
    asked = [check for check in report["checks"] if check.get("limit") is not None]
    failed = [check for check in asked if not check["passed"]]
    template = environment().get_template("production.html.j2")
    return template.render(
        report=report, rounds=rounds, study=study, digest=digest, failed=failed, asked=len(asked),
        signatures=SIGNATURES,
    )  # fmt: skip


def write_production_page(folder: Path) -> Path | None:
    """Write production.html to a design's folder, from its files; None if it has no valid report."""
    try:
        report = record.read(folder / "report.json").facts()
    except ValueError:
        return None
    try:
        study = tolerances.read(folder / "tolerance.json").facts()
    except ValueError:
        study = None
    step = folder / "lens.step"
    digest = hashlib.sha256(step.read_bytes()).hexdigest() if step.is_file() else "unknown"
    page = production_page(report, rounds_in(folder), study, digest)
    files.put(folder / PAGE, page.encode())
    return folder / PAGE
