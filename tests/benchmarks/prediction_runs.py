"""The scenes of prediction_scenes.py, each designed by a cold `bstcad generate`, one after the other.

make prediction     runs them anew, fits, and draws docs/prediction.png (prediction_figure.py)
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bstcad.folder import scene_files
from bstcad.sweep.cold_run import SMALLEST, Units, rounded, units
from tests.benchmarks.prediction_scenes import FIT, KEPT_OUT, Case

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
RECORDS = {"fit": HERE / "prediction_fit.json", "kept out": HERE / "prediction_kept_out.json"}
CASES = {"fit": FIT, "kept out": KEPT_OUT}


def run(case: Case, quality: str, **smaller: Any) -> dict[str, Any]:
    """What one cold run takes and comes to, and what the calibration took before and after it, on average."""
    before = units()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for name, data in scene_files(case.scene(quality).changed(smaller)).items():
            (folder / name).write_bytes(data)
        command = [sys.executable, "-m", "bstcad.cli", "generate", str(folder / "scene.toml"), "-o", str(folder / "d")]
        paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        with (folder / "said").open("wb") as said:
            began = time.perf_counter()
            child = subprocess.Popen(command, stdout=said, stderr=said, env={**os.environ, "PYTHONPATH": paths})
            _, status, spent = os.wait4(child.pid, 0)
            seconds = time.perf_counter() - began
        child.returncode = os.waitstatus_to_exitcode(status)
        if not (folder / "d" / "report.json").is_file():
            raise SystemExit(f"{case.name}, {quality}: {(folder / 'said').read_text()[-2000:]}")
        report = json.loads((folder / "d" / "report.json").read_text(encoding="utf-8"))
    after = units()
    unit = Units((before.tubes + after.tubes) / 2, (before.serial + after.serial) / 2)
    return {
        "name": case.name, "quality": quality, "seconds": seconds, "cpu_seconds": spent.ru_utime + spent.ru_stime,
        "memory_gb": report["machine"]["peak_memory_gb"], "rrmsd": report["rrmsd"], "noise": report["rrmsd_noise"],
        "rays": report["rays_traced"], "units": asdict(unit),
        "stages": [[stage["name"], stage["seconds"]] for stage in report["stages"]],
    }  # fmt: skip


def warm_up() -> None:
    """A small run that does not count: kernels are compiled, libraries come from the disk."""
    run(FIT[0], "draft", **SMALLEST)


def recorded(which: str) -> list[dict[str, Any]]:
    """The runs on record."""
    path = RECORDS[which]
    return json.loads(path.read_text(encoding="utf-8"))["runs"] if path.is_file() else []


def runs(which: str, again: bool) -> Iterator[dict[str, Any]]:
    """Every run of a set, those on record as they are unless all are to be done again; kept as they come."""
    known = {} if again else {(r["name"], r["quality"]): r for r in recorded(which)}
    done = []
    for case, quality in wanted(CASES[which]):
        found = known.get((case.name, quality)) or run(case, quality)
        done.append(found)
        RECORDS[which].write_text(text(done), encoding="utf-8")
        yield found


def wanted(cases: Iterable[Case]) -> Iterator[tuple[Case, str]]:
    """Each scene in each of its qualities."""
    return ((case, quality) for case in cases for quality in case.qualities)


def text(found: list[dict[str, Any]]) -> str:
    """A record, a line a run."""
    lines = ",\n".join("  " + json.dumps(rounded(each, 4), ensure_ascii=False) for each in found)
    return f'{{"runs": [\n{lines}\n]}}\n'
