"""The price of accuracy in time, recorded in pieces in docs/accuracy.json and written to docs/accuracy.md and .png.

make accuracy                                         records what is missing or of another version, and writes
python -m tests.benchmarks.accuracy --list            the pieces, how long each takes, and when it was recorded
python -m tests.benchmarks.accuracy --only 'thu-*' mitsuba   records these anew, and writes
python -m tests.benchmarks.accuracy --only            writes alone: seconds

Each piece is a cold run or a sweep of them, one at a time, on a machine with nothing else to do; it is kept as soon as
it has ended, so that a recording that was stopped goes on.  Pieces of many minutes are recorded anew only if they are
named.  The text of the page is accuracy.md.j2.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from functools import cache, partial, reduce
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import torch

from bstcad.designs.folder import read_nominal
from bstcad.figures.drawing import new_figure, png, styled
from bstcad.optics.lens.lens import Lens
from bstcad.optics.trace.measure import measure
from bstcad.planning.cold_run import REFERENCE_EFFORT, round_numbers
from bstcad.planning.prediction import pace
from bstcad.planning.results import draw_legend, draw_runs
from bstcad.runs import environment, files
from bstcad.scene.scene import load
from tests import markdown
from tests.benchmarks import growth
from tests.benchmarks.cold import ROOT, TEMPLATES, generate
from tests.benchmarks.judged_cells import HALF, stated_by_cell
from tests.benchmarks.mitsuba_caustic import control_net

RECORDED, PAGE = ROOT / "docs" / "accuracy.json", ROOT / "docs" / "accuracy.md"
TEXT = Path(__file__).with_name("accuracy.md.j2")
SCENES = {  # template: what it is
    "thu": "Letters, off axis, collimated (example 2 of Wang et al.)",
    "portrait": "Portrait, point source (example 1 of Wang et al.)",
    "off_axis": "Portrait, off axis, collimated",
    "mirror": "Portrait on the wall, by a mirror below a lamp",
    "caustic_portrait": "Portrait, on axis, 300 mm behind the lens (the scene of other programs)",
    "caustic_letters": "Letters, on axis, 300 mm behind the lens (the scene of other programs)",
}
PEER = "caustic_portrait"  # the scene of Mitsuba's caustic optimisation
FIGURES = {PEER: "accuracy.png", "thu": "accuracy-letters.png"}  # names of the figures in docs/, by sweep
QUALITIES = ("draft", "standard", "fine", "paper", "stage 1", "integration")
QUIET = 0.1  # largest fraction of all cores that other programs may take during a recording
BUSY = "; **the machine was busy with other work**: seconds are too long by an unknown factor, CPU seconds by less"
SWEPT = ROOT / "outputs" / "accuracy"  # records of the runs of sweeps, from which one that was stopped goes on
SLOW = {  # qualities that take minutes, and how many
    "thu": {"fine": 2, "paper": 4}, "portrait": {"fine": 2, "paper": 12}, "caustic_portrait": {"paper": 4},
}  # fmt: skip
BESIDE = {  # further rows of a table: changes of a standard design, by scene
    "stage 1": dict.fromkeys(("thu", "portrait"), ("tailoring.stage2_iterations=0",)),
    "integration": {
        "thu": ("tailoring.method=integration",),
        "portrait": ("tailoring.method=integration", "lens.front.optimise=false"),
    },
}
COARSE = 128  # pixels a side of Mitsuba's pictures
SMALLEST = (
    "lens.back.control_points=33", "target.pixels=64", "tailoring.rays=96", "tailoring.transport_grid=64",
    "tailoring.stage1_iterations=2", "tailoring.stage2_iterations=2",
)  # fmt: skip
DIGITS = 5
WATCHED = 3.0  # seconds, for the part of all cores that other programs take

Record = dict[str, Any]


@dataclass(frozen=True)
class Piece:
    """A run to be recorded, and its place in the file."""

    place: tuple[str, ...]
    minutes: float  # about as long as it takes
    record: Callable[[], Record]
    slow: bool = False  # not recorded anew unless it is named

    def find(self, known: Record) -> Record | None:
        """Return the record of a piece."""
        return reduce(lambda at, key: at.get(key, {}), self.place, known) or None

    def keep(self, known: Record, record: Record) -> None:
        """Put a record in its place."""
        reduce(lambda at, key: at.setdefault(key, {}), self.place[:-1], known)[self.place[-1]] = record


class Named(SimpleNamespace):
    """Part of a record with its keys as attributes."""

    @property
    def time_and_error(self):
        """Time (seconds) and RRMSD of a run, as of `planning.cold_run.ColdRun`."""
        return self.seconds, self.rrmsd


def pieces(budget: float, limit: float) -> dict[str, Piece]:
    """All of them by name; budget: seconds of a sweep; limit: seconds of Mitsuba's run."""
    found = {}
    for scene in SCENES:
        for quality, minutes in {"draft": 0.3, "standard": 0.8, **SLOW.get(scene, {})}.items():
            record = partial(designed, scene, quality)
            found[f"{scene}-{quality}"] = Piece(("designs", scene, quality), minutes, record, minutes > 1)
        for row, by_scene in BESIDE.items():
            if scene in by_scene:
                record = partial(designed, scene, "standard", by_scene[scene])
                found[f"{scene}-{row.replace(' ', '-')}"] = Piece(("designs", scene, row), 0.5, record)
    for scene in FIGURES:
        found[f"sweep-{scene}"] = Piece(("sweeps", scene), budget / 60 + 1, partial(swept, scene, budget))
    found["mitsuba"] = Piece(("mitsuba",), limit / 60 + 1, partial(by_mitsuba, limit), slow=True)
    found["growth"] = Piece(("growth",), 3, grown)
    return found


@cache
def warm_up(scene: str, quality: str) -> None:
    """A small run whose time does not count, so that kernels are compiled and libraries come from memory."""
    with tempfile.TemporaryDirectory() as place:
        generate(scene, Path(place) / scene, f"tailoring.quality={quality}", *SMALLEST)


def designed(scene: str, quality: str, settings: Sequence[str] = ()) -> Record:
    """Return the figures of one design that a table states."""
    warm_up(scene, "paper" if quality == "paper" else "draft")
    with tempfile.TemporaryDirectory() as place:
        run = generate(scene, Path(place) / scene, f"tailoring.quality={quality}", *settings)
        report = run.report()
        lens = read_nominal(Path(place) / scene).lens
        coarse = {"rrmsd_coarse": judged(lens, COARSE)["rrmsd"]} if scene == PEER else {}
    half, half_noise = stated_by_cell(report).get(HALF, (None, None))
    shape, machine = report["shape"], report["machine"]
    radii = [r for r in (shape["radius_min_concave"], shape["radius_min_convex"]) if r is not None]
    return {
        **{name: report[name] for name in ("rrmsd", "rrmsd_noise", "efficiency")},
        "rrmsd_half": half,
        "rrmsd_half_noise": half_noise,
        "seconds": run.seconds,
        "cpu_seconds": run.cpu_seconds,
        "memory_gb": machine["peak_memory_gb"],
        "radius_min": min(radii, default=math.inf),
        "radius_grid": 4,  # times finer than the net
        "octave": shape["slope_energy_top_octave"],
        **coarse,
    }


def judged(lens: Lens, pixels: int) -> Record:
    """Return the RRMSDs by `measure` of a lens for PEER on pixels and on half pixels, and the light on the target."""
    scene = load(TEMPLATES / f"{PEER}.toml", {"target.pixels": pixels})
    light = measure(lens, scene.channels(), scene.target.screen, scene.target.irradiance(), REFERENCE_EFFORT)
    half = {} if light.half is None else {"rrmsd_half": light.half.rrmsd, "rrmsd_half_noise": light.half.standard_error}
    return {"rrmsd": light.rrmsd, "rrmsd_noise": light.standard_error, **half, "on_target": light.flux["on target"]}


def swept(scene: str, budget: float) -> Record:
    """Return the result of `bstcad tradeoff` within a budget of seconds."""
    folder, path = SWEPT / scene, TEMPLATES / f"{scene}.toml"
    command = [sys.executable, "-m", "bstcad.cli", "tradeoff", str(path), "--budget", f"{budget:g}", "-o", str(folder)]
    subprocess.run(command, check=True)
    return as_record(json.loads((folder / "tradeoff.json").read_text(encoding="utf-8")))


def as_record(facts: Record) -> Record:
    """The parts of tradeoff.json that figure and page show."""
    ran = [run for run in facts["runs"] if run["status"] == "done"]
    seen = ("label", "seconds", "rrmsd")
    kept = ("title", "budget_seconds", "spent_seconds", "calibration", "reference", "presets", "front_halving")
    return {
        **{name: facts[name] for name in kept},
        "runs": len(ran),
        "range": {key: [end(run[key] for run in ran) for end in (min, max)] for key in ("seconds", "rrmsd")},
        "front": [{name: run[name] for name in ("seconds", "rrmsd", "rrmsd_noise")} for run in ran if run["on_front"]],
        "failed": [{"seconds": run["seconds"], "reason": run["reason"]} for run in facts["runs"]
                   if run["status"] == "failed"],
        "not_run": sum(run["status"].startswith("not run") for run in facts["runs"]),
        "knobs": [{"key": knob["key"], "title": knob["title"],
                   "places": [{name: place[name] for name in seen} for place in knob["places"]]}
                  for knob in facts["knobs"]],
        "history": [[point["seconds"], point["rrmsd"]] for point in facts["history"]],
    }  # fmt: skip


def by_mitsuba(limit: float) -> Record:
    """Mitsuba's caustic optimisation in a cold process, its height maps judged as our lenses are."""
    import mitsuba

    with tempfile.TemporaryDirectory() as place:
        heights = Path(place) / "heights.npz"
        module = "tests.benchmarks.mitsuba_caustic"
        command = [sys.executable, "-m", module, str(TEMPLATES / f"{PEER}.toml"), str(heights), "--limit", f"{limit:g}"]
        subprocess.run(command, check=True, cwd=ROOT)
        found = np.load(heights)
        maps = found["heights"].astype(np.float64)
    points = []
    for k, z in enumerate(maps):
        lens = with_heights(z)
        whole, coarse = judged(lens, 512), judged(lens, COARSE)
        stamp = {name: found[name][k].item() for name in ("iterations", "seconds", "cpu_seconds")}
        points.append(stamp | whole | {"rrmsd_coarse": coarse["rrmsd"]})
    own = dict(zip(("rrmsd", "rrmsd_noise"), found["own"].tolist(), strict=True))
    return {"mitsuba": mitsuba.__version__, "limit_seconds": limit, "points": points, "own": own}


def with_heights(heights: np.ndarray) -> Lens:
    """The lens of PEER whose exit face is Mitsuba's mesh of heights (n, n) in mm, y along the first axis."""
    net = control_net(heights)
    flat = load(TEMPLATES / f"{PEER}.toml").flat_lens(len(net))
    half = flat.outline.half_extent[0] * (1 + 1 / (len(heights) - 1))  # the net reaches half a pitch beyond the mesh
    return flat.with_back(replace(flat.back, heights=torch.from_numpy(net.T.copy()), x=(-half, half), y=(-half, half)))


def grown() -> Record:
    """Return the growth of the cost of each stage."""
    return {"series": [growth.facts(series, growth.measured(series)) for series in growth.SERIES]}


@cache
def circumstances() -> Record:
    """When, on what, and with what."""
    told = environment.circumstances("cpu")
    machine, versions = told["machine"], told["versions"]
    return {
        "date": datetime.date.today().isoformat(),
        "version": environment.version(),
        "machine": f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gb']:.0f} GB",
        "versions": ", ".join(f"{name} {versions[name]}" for name in ("python", "torch", "numba", "cadquery")),
    }


def known(path: Path) -> dict[str, Any]:
    """The results that are recorded in a file."""
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def put(path: Path, recorded: Mapping[str, Any]) -> None:
    """Keep results in a file, numbers to DIGITS."""
    files.put(path, (json.dumps(round_numbers(recorded, DIGITS), ensure_ascii=False, indent=1) + "\n").encode())


def write(recorded: Mapping[str, Any]) -> None:
    """Write the page and its figures."""
    for scene, name in FIGURES.items():
        if scene in recorded["sweeps"]:
            files.put(PAGE.with_name(name), png(figure(recorded, scene)))
    files.put(PAGE, page(recorded).encode())


def pace_now() -> float:
    """Return the pace of the machine, measured at each call."""
    pace.cache_clear()
    return pace()


def at_usual_speed(recorded: Mapping[str, Any]) -> Record:
    """Return the designs with times divided by the median pace of their machine on that day, where known.

    The speed of a virtual machine changes from minute to minute, so the pace beside a single run is less certain.
    """
    paces = _paces(_entries(recorded))

    def corrected(design: Record) -> Record:
        times = {name: design[name] for name in ("seconds", "cpu_seconds") if design[name] is not None}
        usual = float(np.median(paces.get(_circumstances(design), [1.0])))
        return design | {name: time / usual for name, time in times.items()}

    return {scene: {quality: corrected(found) for quality, found in entries.items()}
            for scene, entries in recorded["designs"].items()}  # fmt: skip


def _entries(recorded: Mapping[str, Any]) -> list[Record]:
    every = [entry for scene in recorded["designs"].values() for entry in scene.values()]
    return [*every, *recorded["sweeps"].values(), recorded["mitsuba"], recorded["growth"]]


def _paces(entries: Sequence[Record]) -> dict[tuple[str, str, str, str, bool], list[float]]:
    """Return the paces, ascending, of the records of each day, machine and version."""
    found: dict[tuple[str, str, str, str, bool], list[float]] = {}
    for entry in entries:
        if "pace" in entry["recorded"]:
            found.setdefault(_circumstances(entry), []).append(entry["recorded"]["pace"])
    return {key: sorted(each) for key, each in found.items()}


def page(recorded: Mapping[str, Any]) -> str:
    """Return the page, each record marked by its day and a letter for its machine and versions."""
    every = _entries(recorded)
    paces = _paces(every)
    recorded = {**recorded, "designs": at_usual_speed(recorded)}
    circumstances = sorted({_circumstances(entry) for entry in every})
    marks = {each: f"{each[0]} ({chr(ord('a') + k)})" for k, each in enumerate(circumstances)}
    names = ("date", "version", "machine", "versions", "busy")
    return markdown.page(
        TEXT, recorded, mark=lambda record: marks[_circumstances(record)], halving=halving, busy=BUSY, peer=PEER,
        records={mark: dict(zip(names, each, strict=True)) | {"paces": paces.get(each, [])}
                 for each, mark in marks.items()}, qualities=QUALITIES,
        scenes=SCENES, figures=FIGURES,
    )  # fmt: skip


def _circumstances(record: Mapping[str, Any]) -> tuple[str, str, str, str, bool]:
    found = record["recorded"]
    busy = (found.get("others") or 0.0) > QUIET
    return found["date"], found["version"], found["machine"], found["versions"], busy


def halving(points: Sequence[Mapping[str, Any]]) -> Sequence[Mapping[str, Any]]:
    """Return the last point of a run, and those that had half the iterations of the one after."""
    chosen = [points[-1]]
    for point in reversed(points):
        if 2 * point["iterations"] <= chosen[-1]["iterations"]:
            chosen.append(point)
    return chosen[::-1]


@styled
def figure(recorded: Mapping[str, Any], scene: str) -> Any:
    """Draw a sweep as `results.draw_runs` draws a Table, with room for the paper's procedure and Mitsuba's run."""
    sweep = _named(recorded["sweeps"][scene])
    points = _named(recorded["mitsuba"]["points"]) if scene == PEER else []
    paper = at_usual_speed(recorded)[scene].get("paper")  # by itself: few budgets last for it
    single = [_named(paper)] if paper else []
    papers = [*(preset for preset in sweep.presets if preset.name == "paper"), *single][:1]
    sweep.presets = [preset for preset in sweep.presets if preset.name != "paper"]
    ends = [Named(seconds=s, rrmsd=e) for s, e in zip(sweep.range.seconds, sweep.range.rrmsd, strict=True)]
    sweep.front_runs = sorted(sweep.front, key=lambda run: run.seconds)
    sweep.knobs = [knob for knob in sweep.knobs if len(knob.places) > 1]
    tried = [place for knob in sweep.knobs for place in knob.places]
    sweep.plotted = [*ends, *sweep.presets, *points, *papers, *tried]
    sweep.history = [{"seconds": seconds, "rrmsd": rrmsd} for seconds, rrmsd in sweep.history]
    drawn = new_figure(9.6, 8.0)
    axes = drawn.subplots()
    draw_runs(axes, sweep)
    axes.set_ylabel("RRMSD on pixels, by the reference")
    for design in papers:
        axes.plot(design.seconds, design.rrmsd, "*", ms=17, color="#ffffff", mec="#111111", mew=1.1, zorder=5)
        axes.annotate("the procedure of Wang et al. 2023", (design.seconds, design.rrmsd), (12, -13), ha="right",
                      va="top", textcoords="offset points", weight="bold", zorder=6)  # fmt: skip
    if points:  # each height map judged as our lenses are, on the target's pixels and on its own
        seconds, coarse = [point.seconds for point in points], [point.rrmsd_coarse for point in points]
        look = {"color": "#b00058", "lw": 1.8, "zorder": 4, "marker": "o", "ms": 4.5}
        reached = f"5 to {points[-1].iterations} of 1000 iterations"
        label = f"Mitsuba 3: caustic optimisation, {reached}"
        axes.plot(seconds, [point.rrmsd for point in points], label=label, **look)
        axes.plot(seconds, coarse, ls=(0, (4, 2)), mfc="white", label="the same, on its own 128² pixels", **look)
        axes.annotate("Mitsuba 3's caustic optimisation", (seconds[-1], min(coarse)), (0, -10), ha="right", va="top",
                      textcoords="offset points", color=look["color"], weight="bold")  # fmt: skip
    draw_legend(axes)
    return drawn


def _named(record: Any) -> Any:
    """A record of JSON whose keys are attributes."""
    return json.loads(json.dumps(record), object_hook=lambda entry: Named(**entry))


def wanted(all_pieces: Mapping[str, Piece], only: Sequence[str] | None, recorded: Mapping[str, Any]) -> list[str]:
    """Names of the pieces to be recorded."""
    if only is not None:
        unknown = [pattern for pattern in only if not any(fnmatch(name, pattern) for name in all_pieces)]
        if unknown:
            raise SystemExit(f"no piece is called {', '.join(unknown)}; --list shows them")
        return [name for name in all_pieces if any(fnmatch(name, pattern) for pattern in only)]
    version = circumstances()["version"]
    found = {name: piece.find(recorded) for name, piece in all_pieces.items()}
    return [
        name for name, record in found.items()
        if record is None or (record["recorded"]["version"] != version and not all_pieces[name].slow)
    ]  # fmt: skip


def main() -> None:
    """Record, and write after each piece, so that nothing is lost on the way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", help="names of pieces, * for any letters; without a name: write alone")
    parser.add_argument("--list", action="store_true", help="the pieces")
    parser.add_argument("--budget", type=float, default=600.0, help="seconds of a sweep")
    parser.add_argument("--limit", type=float, default=600.0, help="seconds of Mitsuba's run")
    asked = parser.parse_args()
    all_pieces, recorded = pieces(asked.budget, asked.limit), known(RECORDED)
    if asked.list:
        for name, piece in all_pieces.items():
            found = piece.find(recorded)
            when = f"{found['recorded']['date']}, {found['recorded']['version']}" if found else "not recorded"
            print(f"{name:28} {piece.minutes:5.1f} min   {when}")
        return
    for name in wanted(all_pieces, asked.only, recorded):
        print(f"recording {name}, about {all_pieces[name].minutes:.1f} min", flush=True)
        when, before = circumstances() | {"others": round(psutil.cpu_percent(WATCHED) / 100, 2)}, pace_now()
        record = all_pieces[name].record()
        record |= {"recorded": when | {"pace": (before + pace_now()) / 2}}
        recorded = known(RECORDED)
        all_pieces[name].keep(recorded, record)
        put(RECORDED, recorded)
        write(known(RECORDED))  # the page states the digits that are kept
    write(known(RECORDED))


if __name__ == "__main__":
    main()
