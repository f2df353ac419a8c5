"""python -m tests.hard_cases.designs_table PAGE: the hard designs from the command line, and their table on a page.

Each in a process of its own, as a user runs it, in the quality given (default: draft).  Seconds are indications.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from tests import markdown
from tests.benchmarks.cold import generate
from tests.hard_cases.designs import DESIGNS, SIDE, overrides

HEAD = (
    "design", "exit", "RRMSD", "standard error", "efficiency", "margin to reflection", "thinnest", "steepest", "time",
)  # fmt: skip


def designed(name: str, folder: Path, quality: str) -> tuple[list[str], str]:
    """A row of the table, and what the report says in words."""
    pictures, design = folder / "pictures", DESIGNS[name]
    pictures.mkdir(exist_ok=True)
    pixels = SIDE if design.picture else 128
    sizes = {"lens.back.control_points": 65, "target.pixels": pixels, "tailoring.quality": quality}
    changes = overrides(name, pictures, sizes)[1]
    run = generate(design.template, folder / changes["name"], *(f"{k}={as_toml(v)}" for k, v in changes.items()))
    time = f"{run.seconds:.0f} s"
    if run.code == 2:
        return [name, "2", *[""] * 6, time], run.said.splitlines()[-1].removeprefix("bstcad: ")
    report = run.report()
    shape, margin = report["shape"], report.get("stability", {}).get("tir_margin_deg")
    failed = [c["name"] for c in report["checks"] if not c["passed"] and not c["name"].startswith("RRMSD")]
    said = " ".join([*report["given_up"], *(f"Failed: {name}." for name in failed)])
    return [
        name, str(run.code), f"{report['rrmsd']:.4f}", f"{report['rrmsd_noise']:.1e}", f"{report['efficiency']:.4f}",
        "" if margin is None else f"{margin:.2f}°", f"{shape['thickness_min']:.2f} mm",
        f"{shape['slope_max_deg']:.1f}°", time,
    ], said  # fmt: skip


def as_toml(value: Any) -> str:
    """A value as --set reads it."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {as_toml(part)}" for key, part in value.items()) + "}"
    return json.dumps(value)


def main() -> None:
    """Run them and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("--quality", default="draft")
    wanted = parser.parse_args()
    rows, words = [], []
    with tempfile.TemporaryDirectory() as folder:
        for name in DESIGNS:
            cells, said = designed(name, Path(folder), wanted.quality)
            rows.append(cells)
            words.append(f"- {name}: {said}")
            print(markdown.row(cells), flush=True)
    content = [markdown.table(HEAD, rows), "", "What their reports say was given up:", "", *words]
    markdown.write(wanted.page, "<!-- figures: designs -->", "\n".join(content))


if __name__ == "__main__":
    main()
