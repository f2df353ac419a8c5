"""What each effect costs: designs of one scene with each effect alone, in turn with one that has none, as a table.

make effects                    into docs/effects.md, a quarter of an hour
python tests/benchmarks/effects_table.py --runs 1 --output table.md

CPU seconds of whole processes, `bstcad generate` from command to end; each round runs every effect once, so that a
machine that slows down slows all of them, and the median of the ratios within a round counts.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
SCENE = ROOT / "templates" / "portrait.toml"
SIZE = ("lens.back.control_points=129", "target.pixels=256", "tailoring.quality=standard", "tailoring.rays=512")
NONE = "none"
EFFECTS = {  # name: settings of the scene
    NONE: (),
    "none, once more": (),
    "fresnel": ('effects=[{kind="fresnel"}]',),
    "fresnel, coated": ('effects=[{kind="fresnel",coating={index=1.38,thickness=110.0}}]',),
    "absorption": ('effects=[{kind="absorption",coefficient=0.001}]',),
    "ghost": ('effects=[{kind="ghost"}]',),
    "spectrum of three lines": ("lens.material=PMMA", "source.wavelength=[[486.1,1.0],[587.6,1.0],[656.3,1.0]]"),
    "extended source, 16 points": ("source.diameter=0.2", "tailoring.source_points=16"),
    "tilted source": ("source.tilt=[5.0,0.0]",),
    "tilted target": ("target.tilt=[20.0,0.0]",),
}


def cpu_seconds(settings: tuple[str, ...], folder: Path) -> tuple[float, dict]:
    """CPU seconds of one cold run with all its processes, and its report."""
    command = [sys.executable, "-m", "bstcad.cli", "generate", str(SCENE)]
    options = ["-o", str(folder), *(word for setting in (*SIZE, *settings) for word in ("--set", setting))]
    before = os.times()
    done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
    after = os.times()
    if not (folder / "report.json").is_file():
        raise SystemExit(f"{settings}: exit {done.returncode}\n{done.stderr[-2000:]}")
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    return spent, json.loads((folder / "report.json").read_text())


def main() -> None:
    """Run, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--only", nargs="+", choices=EFFECTS, help="beside none")
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "effects.md")
    wanted = parser.parse_args()
    names = [name for name in EFFECTS if name == NONE or wanted.only is None or name in wanted.only]
    spent: dict[str, list[float]] = {name: [] for name in names}
    reports: dict[str, dict] = {}
    for _ in range(wanted.runs):
        for name in names:
            with tempfile.TemporaryDirectory() as folder:
                seconds, reports[name] = cpu_seconds(EFFECTS[name], Path(folder) / "design")
            spent[name].append(seconds)
            print(f"{name}: {seconds:.1f} s", flush=True)
    lines = ["| effect | CPU time over that without | CPU seconds | RRMSD |", "| --- | --: | --: | --: |"]
    for name in names:
        ratios = [a / b for a, b in zip(spent[name], spent[NONE], strict=True)]
        spread = f" ({min(ratios):.2f}-{max(ratios):.2f})" if wanted.runs > 1 else ""
        lines.append(
            f"| {name} | {statistics.median(ratios):.2f}{spread} | "
            f"{statistics.median(spent[name]):.0f} | {reports[name]['rrmsd']:.4f} |"
        )
    page = wanted.output.read_text(encoding="utf-8") if wanted.output.exists() else f"{BEGIN}\n{END}\n"
    head, tail = page[: page.index(BEGIN)], page[page.index(END) :]
    machine = reports[NONE]["machine"]
    rounds = "One round" if wanted.runs == 1 else f"{wanted.runs} rounds"
    said = f"{rounds} on {machine['processor']}, {machine['cores']} cores."
    wanted.output.write_text("\n".join([f"{head}{BEGIN}", said, "", *lines, "", tail]), encoding="utf-8")


BEGIN, END = "<!-- made by make effects -->", "<!-- end -->"

if __name__ == "__main__":
    main()
