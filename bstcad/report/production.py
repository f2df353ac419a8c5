"""Page that a production engineer signs: asked, designed, tolerated, measured, corrected and expected, round by round.

production.html of a design's folder shows the entries of report.json, tolerance.json and compensation.json of each
round, without a figure of its own.  It loads nothing, and prints on one sheet.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bstcad.report.units import environment
from bstcad.runs import files

PAGE, ROUNDS, FIGURES, FIGURE = "production.html", "compensated", "compensation.json", "correction.png"
SIGNATURES = "Cut by", "Measured by", "Released by"


def rounds_in(folder: Path) -> list[dict[str, Any]]:
    """Return the figures of each round of a design's folder, in order, with its `place` and its figure as base64."""
    found: list[dict[str, Any]] = []
    while (place := folder / ROUNDS / f"round-{len(found) + 1}").is_dir():
        figures = _entries(place / FIGURES)
        if figures is None:
            break
        picture = place / FIGURE
        drawn = base64.b64encode(picture.read_bytes()).decode() if picture.is_file() else ""
        found.append(figures | {"place": f"{ROUNDS}/{place.name}", "picture": drawn})
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
    """Write production.html to a design's folder, from its files; None if it has no report."""
    report = _entries(folder / "report.json")
    if report is None:
        return None
    step = folder / "lens.step"
    digest = hashlib.sha256(step.read_bytes()).hexdigest() if step.is_file() else "unknown"
    page = production_page(report, rounds_in(folder), _entries(folder / "tolerance.json"), digest)
    files.put(folder / PAGE, page.encode())
    return folder / PAGE


def _entries(path: Path) -> dict[str, Any] | None:
    """Return the entries of a JSON file; None if it is missing or damaged."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None
