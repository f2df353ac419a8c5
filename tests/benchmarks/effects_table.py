"""The cost of each effect: designs of one scene with each effect alone, in turn with one that has none, as a table.

make effects                    into docs/effects.md, a quarter of an hour
python -m tests.benchmarks.effects_table --runs 1

CPU seconds of whole processes, `bstcad generate` from command to end; each round runs every effect once, so that a
machine that slows down slows all of them, and the median of the ratios within a round counts.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path

from tests import markdown
from tests.benchmarks.cold import ROOT, generate

SCENE = "portrait"
SIZE = ("lens.back.control_points=129", "target.pixels=256", "tailoring.quality=standard", "tailoring.rays=512")
NONE = "none"
EFFECTS = {  # name: settings of the scene
    NONE: (),
    "none, repeated": (),
    "fresnel": ('effects=[{kind="fresnel"}]',),
    "fresnel, coated": ('effects=[{kind="fresnel",coating={index=1.38,thickness=110.0}}]',),
    "absorption": ('effects=[{kind="absorption",coefficient=0.001}]',),
    "ghost": ('effects=[{kind="ghost"}]',),
    "spectrum of three lines": ("lens.material=PMMA", "source.wavelength=[[486.1,1.0],[587.6,1.0],[656.3,1.0]]"),
    "extended source, 16 points": ("source.diameter=0.2", "tailoring.source_points=16"),
    "tilted source": ("source.tilt=[5.0,0.0]",),
    "tilted target": ("target.tilt=[20.0,0.0]",),
}


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
                run = generate(SCENE, Path(folder) / "design", *SIZE, *EFFECTS[name])
                reports[name] = run.report()
            spent[name].append(run.cpu_seconds)
            print(f"{name}: {run.cpu_seconds:.1f} s", flush=True)
    rows = []
    for name in names:
        ratios = [a / b for a, b in zip(spent[name], spent[NONE], strict=True)]
        spread = f" ({min(ratios):.2f}-{max(ratios):.2f})" if wanted.runs > 1 else ""
        ratio = f"{statistics.median(ratios):.2f}{spread}"
        rows.append((name, ratio, f"{statistics.median(spent[name]):.0f}", f"{reports[name]['rrmsd']:.4f}"))
    machine = reports[NONE]["machine"]
    rounds = "One round" if wanted.runs == 1 else f"{wanted.runs} rounds"
    said = f"{rounds} on {machine['processor']}, {machine['cores']} cores."
    head = ("effect", "CPU time, relative to none", "CPU seconds", "RRMSD")
    markdown.write(wanted.output, "<!-- made by make effects -->", f"{said}\n\n{markdown.table(head, rows)}")


if __name__ == "__main__":
    main()
