"""python -m tests.hard_cases.designs_table PAGE: the hard designs from the command line, and their table on a page.

Each in a process of its own, as a user runs it, in the quality given (default: draft).  Seconds are indications.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tests.hard_cases.designs import DESIGNS, SIDE, overrides
from tests.hard_cases.page import between

LIMIT = 600.0  # seconds a design; one that hangs is no row but an error
HEADING = "| design | exit | RRMSD | standard error | efficiency | margin to reflection | thinnest | steepest | time |"


def row(name: str, folder: Path, quality: str) -> tuple[str, list[str]]:
    """One line of the table, and what the report says in words."""
    pictures, design = folder / "pictures", DESIGNS[name]
    pictures.mkdir(exist_ok=True)
    pixels = SIDE if design.picture else 128
    template, changes = overrides(name, pictures, {"lens.back.control_points": 65, "target.pixels": pixels})
    command = [sys.executable, "-m", "bstcad.cli", "generate", str(template), "-o", str(folder / changes["name"])]
    command += ["--quality", quality]
    for key, value in changes.items():
        command += ["--set", f"{key}={_toml(value)}"]
    began = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT)
    seconds = time.perf_counter() - began
    if done.returncode == 2:
        return f"| {name} | 2 | | | | | | | {seconds:.0f} s |", [done.stderr.splitlines()[-1].removeprefix("bstcad: ")]
    if done.returncode not in (0, 1):
        raise SystemExit(f"{name}: exit code {done.returncode}\n{done.stderr[-3000:]}")
    report = json.loads((folder / changes["name"] / "report.json").read_text(encoding="utf-8"))
    shape, margin = report["shape"], report.get("stability", {}).get("tir_margin_deg")
    cells = (
        name, done.returncode, f"{report['rrmsd']:.4f}", f"{report['rrmsd_noise']:.1e}", f"{report['efficiency']:.4f}",
        "" if margin is None else f"{margin:.2f}°", f"{shape['thickness_min']:.2f} mm",
        f"{shape['slope_max_deg']:.1f}°", f"{seconds:.0f} s",
    )  # fmt: skip
    return f"| {' | '.join(map(str, cells))} |", said(report)


def said(report: dict[str, Any]) -> list[str]:
    """What the report says was given up, and which checks failed that this does not cover."""
    failed = [c["name"] for c in report["checks"] if not c["passed"] and not c["name"].startswith("RRMSD")]
    return [*report["given_up"], *(f"Failed: {name}." for name in failed)]


def _toml(value: Any) -> str:
    """A value as --set reads it."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(part)}" for key, part in value.items()) + "}"
    return json.dumps(value)


def main() -> None:
    """Run them and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("--quality", default="draft")
    wanted = parser.parse_args()
    lines, words = [HEADING, "|---|--:|--:|--:|--:|--:|--:|--:|--:|"], []
    with tempfile.TemporaryDirectory() as folder:
        for name in DESIGNS:
            line, spoken = row(name, Path(folder), wanted.quality)
            lines.append(line)
            words.append(f"- {name}: {' '.join(spoken)}")
            print(lines[-1], flush=True)
    content = "\n".join([*lines, "", "What their reports say was given up:", "", *words])
    text = wanted.page.read_text(encoding="utf-8")
    wanted.page.write_text(between(text, "designs", content), encoding="utf-8")


if __name__ == "__main__":
    main()
