"""Predictions of fourteen scenes that were kept out of the fit, against what cold runs of them took and came to.

Every scene of prediction_scenes.py is designed by a cold `bstcad generate`, one after the other.

make prediction     runs the scenes of the fit and these anew, fits, and writes docs/prediction.md and its figure: about
                    an hour on a quiet machine with two cores
python -m tests.benchmarks.prediction_figure --recorded     the same from the runs on record
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from bstcad.folder import scene_files
from bstcad.sweep.cold_run import SMALLEST, SMALLEST_PIXELS, Units, rounded, units
from bstcad.sweep.estimates import coarse_lens
from bstcad.sweep.plan import QUALITIES, fitted, outlook
from tests import markdown
from tests.benchmarks import prediction_fit
from tests.benchmarks.cold import ROOT, generate
from tests.benchmarks.prediction_scenes import CASES, Case

KEYS = {"seconds": "seconds", "rrmsd": "RRMSD", "memory_gb": "memory (GB)"}
ASKED = {"seconds": (1.3, 1.5), "rrmsd": (1.3, 1.5)}  # median, nine of ten
DOCS = ROOT / "docs"
HERE = Path(__file__).parent
RECORDS = {"fit": HERE / "prediction_fit.json", "kept out": HERE / "prediction_kept_out.json"}


def run(case: Case, quality: str, **smaller: Any) -> dict[str, Any]:
    """What one cold run takes and comes to, and what the calibration took before and after it, on average."""
    before = units()
    with tempfile.TemporaryDirectory() as place:
        for name, data in scene_files(case.scene(quality).changed(smaller)).items():
            (Path(place) / name).write_bytes(data)
        ran = generate(Path(place) / "scene.toml", Path(place) / f"{case.name}, {quality}")
        report = ran.report()
    after = units()
    unit = Units((before.tubes + after.tubes) / 2, (before.serial + after.serial) / 2)
    return {
        "name": case.name, "quality": quality, "seconds": ran.seconds, "cpu_seconds": ran.cpu_seconds,
        "memory_gb": report["machine"]["peak_memory_gb"], "rrmsd": report["rrmsd"], "noise": report["rrmsd_noise"],
        "rays": report["rays_traced"], "units": asdict(unit),
        "stages": [[stage["name"], stage["seconds"]] for stage in report["stages"]],
    }  # fmt: skip


def recorded(which: str) -> list[dict[str, Any]]:
    """The runs on record."""
    return json.loads(RECORDS[which].read_text(encoding="utf-8"))["runs"]


def keep(which: str, found: Sequence[Mapping[str, Any]]) -> None:
    """A record, a line a run."""
    lines = ",\n".join("  " + json.dumps(rounded(each, 4), ensure_ascii=False) for each in found)
    RECORDS[which].write_text(f'{{"runs": [\n{lines}\n]}}\n', encoding="utf-8")


def runs(which: str, again: bool) -> Iterator[dict[str, Any]]:
    """Every run of a set, those on record as they are unless all are to be done again; kept as they come."""
    known = {} if again else {(r["name"], r["quality"]): r for r in recorded(which)}
    done = []
    for case in CASES[which]:
        for quality in case.qualities:
            done.append(known.get((case.name, quality)) or run(case, quality))
            keep(which, done)
            yield done[-1]


def predicted(run: Mapping[str, Any]) -> dict[str, Any]:
    """What is predicted for a run by the calibration that was made beside it."""
    [case] = (case for case in CASES["kept out"] if case.name == run["name"])
    scene = case.scene(run["quality"])
    ahead = outlook(scene, coarse_lens(scene), lambda: Units(**run["units"]))
    return {key: list(ends) for key, ends in ahead["predicted"][run["quality"]].items()}


def factors(found: Sequence[Mapping[str, Any]], key: str) -> np.ndarray:
    """By what factor what is likely is off, 1 or more, the least first."""
    ratio = np.array([run["predicted"][key][1] / run[key] for run in found])
    return np.sort(np.maximum(ratio, 1 / ratio))


def median_and_nine(found: Sequence[Mapping[str, Any]], key: str) -> tuple[float, float]:
    """The median factor, and the one that nine of ten keep to."""
    sorted_factors = factors(found, key)
    return float(np.median(sorted_factors)), float(sorted_factors[int(np.ceil(0.9 * len(found))) - 1])


def draw(found: Sequence[Mapping[str, Any]]) -> None:
    """docs/prediction.png."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    figure = Figure(figsize=(9, 4.4), layout="constrained")
    for axes, (key, (median, most)) in zip(figure.subplots(1, 2), ASKED.items(), strict=True):
        ends = np.array([run["predicted"][key] for run in found]).T
        taken = np.array([run[key] for run in found])
        line = np.array([min(taken.min(), ends[0].min()) / 1.2, max(taken.max(), ends[2].max()) * 1.2])
        for factor, shade in ((most, "0.93"), (median, "0.86")):
            axes.fill_between(line, line / factor, line * factor, color=shade, lw=0, label=f"within {factor:g}")
        axes.plot(line, line, color="0.5", lw=1)
        for quality, marker in zip(QUALITIES, "os^", strict=True):
            own = np.array([run["quality"] == quality for run in found])
            bars = np.abs(ends[[0, 2]] - ends[1])[:, own]
            axes.errorbar(taken[own], ends[1][own], bars, fmt=marker, ms=5, lw=1, capsize=2, label=quality)
        axes.set(xscale="log", yscale="log", xlim=line, ylim=line, aspect="equal")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5) if line[1] < 30 * line[0] else (1,)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_locator(NullLocator())
        axes.set(xlabel=f"{KEYS[key]}, found", ylabel=f"{KEYS[key]}, predicted")
        axes.legend(frameon=False, loc="upper left")
    figure.savefig(DOCS / "prediction.png", dpi=110)


def page(found: Sequence[Mapping[str, Any]]) -> str:
    """docs/prediction.md."""
    head = ["scene", "quality", *(words for key in KEYS.values() for words in (f"{key}, predicted", "found"))]
    rows = []
    for each in found:
        rows.append([each["name"], each["quality"]])
        for key in KEYS:
            low, likely, high = (f"{value:.2g}" for value in each["predicted"][key])
            rows[-1] += [f"{likely} ({low} to {high})", f"{each[key]:.2g}"]
    said = "; ".join("{}: {:.2f} and {:.2f}".format(KEYS[key], *median_and_nine(found, key)) for key in KEYS)
    fine = sum(run["quality"] == "fine" for run in recorded("fit"))
    return HEAD.format(
        count=len(found), said=said, table=markdown.table(head, rows, ("quality",)), far=farthest(found), fine=fine
    )


def farthest(found: Sequence[Mapping[str, Any]]) -> str:
    """The scene whose RRMSD, and the one whose seconds are farthest from what was predicted."""
    said = []
    for key in ASKED:
        ratios = [run["predicted"][key][1] / run[key] for run in found]
        worst = int(np.argmax(np.abs(np.log(ratios))))
        said.append(f"{found[worst]['name']} in {KEYS[key]}, predicted x {ratios[worst]:.2f}")
    return "; ".join(said)


HEAD = """# What is predicted, and what is found

Made by `make prediction`, which runs the scenes of the fit and, one after the other, each of {count} scenes that were
kept out of it (`tests/benchmarks/prediction_scenes.py`: other pictures, texts and geometries; points, beams and sources
of some size; lenses and mirrors, near and far, 129 to 1025 control points) by a cold `bstcad generate`.  `bstcad plan`
predicts before.

- seconds: amounts of work (ray tubes times evaluations, control points, pixels, transport …), each with a price in
  units of a calibration that takes three seconds or so: an evaluation of 1024 x 1024 ray tubes on all processors, and
  text and transforms on one.  The prices were fitted stage by stage.
- RRMSD: the result of pilots, designs of the same scene by the same steps at a quarter of its size or so (a half in
  drafts), less the smaller they are, a part of the detail of the picture that they do not see, and half of the blur by
  a source of some size that they do not see.  Two constants a quality; `fine` goes by the pilot of standard, of which
  it has a share that was fitted on {fine} designs.
- memory: the most that both processes hold, as a sum.
- In brackets: what nine of ten designs keep to, of those of the fit and of these, whichever is more.

Median factor between predicted and found, and the factor that nine of ten keep to: {said}.

![Predicted against found, seconds and RRMSD](prediction.png)

{table}

Farthest off: {far}.  A run on a busy machine takes longer than its calibration says.
"""


def main() -> None:
    """Run, fit, predict, compare; everything is kept as it comes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recorded", action="store_true", help="take the runs on record where there are some")
    again = not parser.parse_args().recorded
    if again:
        smallest = SMALLEST | {"target.pixels": SMALLEST_PIXELS}
        run(CASES["fit"][0], "draft", **smallest)  # does not count: kernels are compiled, libraries come from the disk
    prediction_fit.write(prediction_fit.fit(list(runs("fit", again))))
    fitted.cache_clear()
    found = []
    for each in runs("kept out", again):
        found.append(each | {"predicted": predicted(each)})
        likely = {key: f"{found[-1]['predicted'][key][1]:.3g} / {each[key]:.3g}" for key in KEYS}
        print(each["name"], each["quality"], likely, flush=True)
    found = widened(found)
    keep("kept out", found)
    (DOCS / "prediction.md").write_text(page(found), encoding="utf-8")
    draw(found)
    for key in KEYS:
        print(key, "median {:.2f}, nine of ten {:.2f}".format(*median_and_nine(found, key)))


def widened(found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The same with intervals that nine of ten keep to here too; what is likely stays as it was fitted."""
    constants = dict(fitted())
    constants["within"] = {k: max(least, median_and_nine(found, k)[1]) for k, least in constants["within"].items()}
    prediction_fit.write(constants)
    fitted.cache_clear()
    kept = fitted()["within"]
    return [
        each | {"predicted": {key: [each["predicted"][key][1] * part for part in (1 / factor, 1, factor)]
                              for key, factor in kept.items()}}
        for each in found
    ]  # fmt: skip


if __name__ == "__main__":
    main()
