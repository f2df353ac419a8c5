"""batch.json and batch.csv: how each design of a batch went, for programs, and for the batch that goes on.

batch.json: version, of bstcad; designs, those of the last batch first, in the order of its scenes, then those of
earlier ones in the same folder that have a lens; each with the entries of Row.  batch.csv has a line a design; its
columns are those of COLUMNS.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import bstcad
from bstcad import files
from bstcad.verify.verdict import VERDICTS, Check

REFUSED, BROKEN, STOPPED = "refused", "broken", "not done"
LARGEST = 100_000_000  # bytes of batch.json
COLUMNS = (
    "scene", "name", "status", "rrmsd", "rrmsd_noise", "leak", "light_on_target", "checks_failed", "seconds", "report",
    "where", "reason",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """How a design went."""

    scene: str  # the file, as it was named
    name: str = ""  # of the scene; the design's folder has it too
    status: str = STOPPED  # its verdict (verify.verdict.VERDICTS), REFUSED, BROKEN or STOPPED
    rrmsd: float | None = None
    rrmsd_noise: float | None = None
    leak: float | None = None  # part of the light on the target that falls where it wants none
    light_on_target: float | None = None  # part of what the source sends out
    checks_failed: tuple[str, ...] = ()  # by name
    seconds: float = 0.0  # to the verified lens
    report: str = ""  # report.html, from the batch's folder
    where: str = ""  # "here", or the address of a worker
    reason: str = ""  # why there is no lens, in a sentence
    key: str = ""  # hash of the scene with all it names, and version of bstcad
    design: str = ""  # SHA-256 of design.npz

    @property
    def finished(self) -> bool:
        """Is there a lens?"""
        return self.status in VERDICTS

    def stands(self, folder: Path) -> bool:
        """Does the batch's folder hold this very design?"""
        return self.finished and design_in(folder / self.name) == self.design


def design_in(folder: Path) -> str:
    """SHA-256 of the design in a folder; "" if there is none."""
    try:
        data = files.contents(folder / "design.npz", files.LARGEST)
    except ValueError:
        return ""
    return hashlib.sha256(data).hexdigest() if (folder / "report.json").is_file() else ""


def row_of(row: Row, folder: Path) -> Row:
    """The row with what report.json says of the design that the batch's folder now holds."""
    facts = json.loads((folder / row.name / "report.json").read_text(encoding="utf-8"))
    told = asdict(row) | {
        "status": facts["verdict"],
        "checks_failed": tuple(check["name"] for check in facts["checks"] if not check["passed"]),
        "seconds": facts["seconds_total"],
        "report": f"{row.name}/report.html",
        "design": design_in(folder / row.name),
    }
    return Row(**told | {key: facts[key] for key in ("rrmsd", "rrmsd_noise", "leak", "light_on_target")})


def checks(row: Row, folder: Path) -> tuple[Check, ...]:
    """The checks of the design that the batch's folder holds."""
    facts = json.loads((folder / row.name / "report.json").read_text(encoding="utf-8"))
    return tuple(Check(**check) for check in facts["checks"])


def write(rows: Sequence[Row], folder: Path) -> None:
    """Both files."""
    told = {"version": bstcad.__version__, "designs": [asdict(row) for row in rows]}
    text = json.dumps(told, ensure_ascii=False, indent=1)
    files.put(folder / "batch.json", f"{text}\n".encode())
    table = io.StringIO()
    lines = csv.writer(table, lineterminator="\n")
    lines.writerow(COLUMNS)
    for row in rows:
        cells = asdict(row) | {"checks_failed": "; ".join(row.checks_failed), "seconds": f"{row.seconds:.1f}"}
        lines.writerow(["" if cells[name] is None else cells[name] for name in COLUMNS])
    files.put(folder / "batch.csv", table.getvalue().encode())


def read(folder: Path) -> list[Row]:
    """What earlier batches in a folder have told; nothing if that cannot be read."""
    known = {entry.name for entry in fields(Row)}
    try:
        told = json.loads(files.contents(folder / "batch.json", LARGEST))["designs"]
        return [Row(**row | {"checks_failed": tuple(row["checks_failed"])}) for row in told if row.keys() == known]
    except (ValueError, KeyError, TypeError, AttributeError):
        return []
