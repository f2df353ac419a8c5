"""RRMSD on cells of each size by the independent judge (independent.py), beside the RRMSD that report.json states.

python -m tests.benchmarks.independent FOLDER …       prints both for each folder of a design

Here bstcad draws the targets on cells smaller than pixels, for the judge and for those who call it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bstcad.designs.folder import read_nominal
from tests.benchmarks import independent

HALF = 0.5  # side of half a pixel (pixels)


def finer_targets(folder: Path) -> list[dict[int, np.ndarray]]:
    """Draw each target of a design on 2 x 2 and 4 x 4 cells of each pixel; none of a photograph, which is interpolated.

    A photograph that an outline or the reach of the lens cuts is drawn, too, since the cut is sharp at every scale.
    """
    nominal = read_nominal(folder)
    scene = nominal.scene
    return [
        {} if target.photo is not None and target.outline is None and goal.reachable is None
        else {k: goal.on_cells(k).picture for k in (2, 4)}
        for target, goal in zip(scene.targets, nominal.goals, strict=True)
    ]  # fmt: skip


def stated_by_cell(report: Mapping[str, Any], number: int = 0) -> dict[float, tuple[float, float]]:
    """Return {side of a cell in pixels: (RRMSD, standard error)} of a goal; older reports have pixels alone."""
    goal = report["goals"][number]
    found = {row["pixels"]: (row["rrmsd"], row["standard_error"]) for row in goal.get("rrmsd_by_cell", ())}
    return found | {1.0: (goal["rrmsd"], goal["rrmsd_standard_error"])}


def main() -> None:
    """Judge the folders of the command line, each target of each of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="folder of a design")
    parser.add_argument("--points", type=int, default=independent.POINTS, help="points of each of 8 scramblings")
    asked = parser.parse_args()
    for folder in asked.folders:
        report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        for number, drawn in enumerate(finer_targets(folder)):
            try:
                found = independent.judge(folder, points=asked.points, number=number, finer_targets=drawn)
            except independent.Declined as reason:
                print(f"{folder.name}: not judged: {reason}", flush=True)
                continue
            print(f"{folder.name}, {report['goals'][number]['key']}: {found.rays / 1e6:.1f} million rays", flush=True)
            stated = stated_by_cell(report, number)
            for size, (rrmsd, error) in found.by_cell.items():
                beside = "not stated" if size not in stated else "stated {:.5f} ± {:.5f}".format(*stated[size])
                print(f"  cells of {size:4g} pixels: RRMSD {rrmsd:.5f} ± {error:.5f}   {beside}", flush=True)
