"""What accuracy costs in time: the full-size scenes in several qualities, each in a process of its own, as a table.

make table                      into docs/accuracy.md, half an hour or so: the paper's procedure is slow
python tests/benchmarks/accuracy_table.py --scenes thu --qualities draft standard --output table.md
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
SCENES = {  # template: what it is
    "thu": "Letters, off axis, collimated (example 2)",
    "portrait": "Portrait, point source (example 1)",
    "off_axis": "Portrait, off axis, collimated",
    "mirror": "Portrait on the wall, by a mirror below a lamp",
    "caustic_portrait": "Portrait, on axis, 100 mm (the peers' case)",
    "caustic_letters": "Letters, on axis, 100 mm (the peers' case)",
}
QUALITIES = ("draft", "standard", "fine", "paper")
WITH_PAPER = ("thu", "portrait")  # its two examples; it takes ten minutes each, so the others go without
COLUMNS = ("quality", "RRMSD", "noise floor", "efficiency", "seconds", "memory (GB)", "min. radius (mm)", "octave")


def run(scene: str, quality: str, folder: Path, *settings: str) -> dict:
    """The report of one cold run of the command line, and how long the command took."""
    command = [sys.executable, "-m", "bstcad.cli", "generate", str(ROOT / "templates" / f"{scene}.toml")]
    began = time.perf_counter()
    options = ["--quality", quality, "-o", str(folder), *(word for s in settings for word in ("--set", s))]
    done = subprocess.run([*command, *options], capture_output=True, text=True)
    seconds = time.perf_counter() - began
    if not (folder / "report.json").is_file():
        raise SystemExit(f"{scene}, {quality}: exit {done.returncode}\n{done.stderr[-2000:]}")
    return json.loads((folder / "report.json").read_text()) | {"command_seconds": seconds}


def row(quality: str, report: dict) -> list[str]:
    """One line of the table."""
    shape = report["shape"]
    radii = [r for r in (shape["radius_min_concave"], shape["radius_min_convex"]) if r is not None]
    return [
        quality, f"{report['rrmsd']:.4f}", f"{report['rrmsd_noise']:.4f}", f"{report['efficiency']:.4f}",
        f"{report['command_seconds']:.0f}", f"{report['machine']['peak_memory_gb']:.2f}",
        f"{min(radii, default=math.inf):.3f}", f"{shape['slope_energy_top_octave']:.4f}",
    ]  # fmt: skip


def table(rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [COLUMNS, ["---", *["--:"] * (len(COLUMNS) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main() -> None:
    """Run, and write the table after each scene, so that nothing is lost on the way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--qualities", nargs="+", choices=QUALITIES, help="default: all for the paper's examples")
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "accuracy.md")
    wanted = parser.parse_args()
    parts = []
    for scene in wanted.scenes:
        rows = []
        for quality in wanted.qualities or (QUALITIES if scene in WITH_PAPER else QUALITIES[:2]):
            with tempfile.TemporaryDirectory() as folder:
                report = run(scene, quality, Path(folder) / scene)
            rows.append(row(quality, report))
            print(scene, *rows[-1], flush=True)
            here = f"## {SCENES[scene]}: `templates/{scene}.toml`\n\n{table(rows)}\n"
            wanted.output.write_text("\n".join([HEAD.format(**where(report)), *parts, here]), encoding="utf-8")
        parts.append(here)


def where(report: dict) -> dict[str, str]:
    """The machine and the versions, in words."""
    machine, versions = report["machine"], report["versions"]
    return {
        "machine": f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gb']:.0f} GB",
        "versions": ", ".join(f"{name} {versions[name]}" for name in ("python", "torch", "numba", "cadquery")),
    }


HEAD = """# What accuracy costs in time

Made by `make table`, each line by one cold run of `bstcad generate`, one after the other.

- RRMSD: box pixels, 512 x 512, through the geometry re-read from the written STEP file; its noise floor beside it.
- seconds: from the command to its end, imports included.  Seconds of this machine, {machine}; compare ratios.
- memory: the most that bstcad's two processes held, up to the end of the proof, as a sum.
- min. radius: the smaller of the smallest concave and the smallest convex radius of the back.
- octave: slope energy in the highest octave of the control net, as a part of all: ripple would show here.
- paper: the procedure of Wang et al. 2023, Adam on raw control points; the others are bstcad's.

{versions}
"""

if __name__ == "__main__":
    main()
