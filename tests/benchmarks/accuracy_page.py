"""docs/accuracy.md and its figures from recorded results: all of its text, so that none is edited by hand."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from types import SimpleNamespace as Named
from typing import Any

from bstcad.report.drawing import new_figure, png, styled
from bstcad.sweep.results import legend, plane
from tests import markdown
from tests.benchmarks.growth import SERIES

SCENES = {  # template: what it is
    "thu": "Letters, off axis, collimated (example 2)",
    "portrait": "Portrait, point source (example 1)",
    "off_axis": "Portrait, off axis, collimated",
    "mirror": "Portrait on the wall, by a mirror below a lamp",
    "caustic_portrait": "Portrait, on axis, 100 mm (the peers' case)",
    "caustic_letters": "Letters, on axis, 100 mm (the peers' case)",
}
PEER = "caustic_portrait"
FIGURES = {"caustic_portrait": "accuracy.png", "thu": "accuracy-letters.png"}
WIDTH, HEIGHT = 9.6, 8.0  # inches
COLUMNS = ("quality", "RRMSD", "standard error", "efficiency", "seconds", "CPU seconds", "memory (GB)",
           "min. radius (mm)", "octave", "recorded")  # fmt: skip
CELLS = {
    "rrmsd": ".4f", "rrmsd_noise": ".4f", "efficiency": ".4f", "seconds": ".0f", "cpu_seconds": ".0f",
    "memory_gb": ".2f", "radius_min": ".3f", "octave": ".4f",
}  # fmt: skip
QUALITIES = ("draft", "standard", "fine", "paper", "stage 1", "integration")
KNOB = ("knob", "from", "to", "RRMSD from", "to", "seconds from", "to", "where it stops paying")
COST = ("stage", "by", "sizes", "CPU seconds", "a", "last", "memory (MB)", "a")
UNKNOWN = "–"
QUIET = 0.1  # of all cores: what other programs may take while something is recorded
BUSY = "; **the machine was busy with other work**: seconds are too long by an unknown factor, CPU seconds by less"

HEAD = """# What accuracy costs in time

Made by `make accuracy` from the results recorded in [accuracy.json](accuracy.json); nothing here is written by hand.

- RRMSD: the relative RMS deviation of the irradiance from the target, by the flux that falls into each of 512 x
  512 pixels. One judge for all, `bstcad.measure`: independent sets of stratified rays, whose noise has no part in
  the figure, with its standard error. What was recorded before 2026-11-22 was judged by ray tubes: those figures are
  3 to 5 % too low on nets of 513 points and more, and the column of the standard error holds the tubes' noise floor.
- seconds: on the clock, of the whole command in a cold process, imports included, kernels compiled before. They
  are of the machine and the day of the last column (below); compare ratios.
- CPU seconds: of all threads and processes.
"""

PEERS = """## Mitsuba 3's caustic optimisation

{figure}An open program that makes caustics by differentiable rendering is the tutorial [Caustics
optimization](https://mitsuba.readthedocs.io/en/stable/src/inverse_rendering/caustics_optimization.html) of
Mitsuba 3 (here {mitsuba}, from PyPI). `tests/benchmarks/mitsuba_caustic.py` does what it does at its settings,
on the scene `templates/caustic_portrait.toml`: a height map of 512 x 512 points that grows from 32 x 32, a
particle tracer with 64 photons a pixel (32 for the gradient) on 128 x 128 pixels, Adam at 3e-5 for 1000
iterations, heights within a hundredth of half the plate (0.5 mm). Index, distance and width of the picture are
ours (the tutorial's plate stands 3.5 of its widths from the screen, ours 3), and so is the picture. The
tutorial shows 38 ms an iteration, on a machine that it does not name; here it ran on two threads of a CPU
(`llvm_ad_rgb`, with libLLVM 19), as everything else did.

Its height maps are judged as our lenses are, as a spline surface whose slopes at the vertices of the mesh are
the vertex normals by which Mitsuba refracts: by that its last one has {coarse:.3f} on 128 x 128 pixels; by
Mitsuba's own particle tracer, with 67 million photons and a box filter, {own:.3f}, with {noise:.3f} of noise.
Mitsuba never sees more than 128 x 128 pixels, so that its lens, and ours, which was made for 512 x 512, are
judged on both.

{table}

{said}
"""

SWEEP = """## {title}

{figure}`bstcad tradeoff templates/{scene}.toml --budget {budget}` ran {runs} designs, each a cold process, with
one knob turned at a time and then with those that go together; {not_run} more did not fit into the budget.
Judge: {what}. Calibration kernel: {kernel} ms, the second axis.  Recorded {mark}.

{knobs}

{comparisons}
"""

GROWTH = """## How the cost grows

CPU seconds of each stage while one thing grows and all else stays, fitted by CPU ~ N^a; N counts what grows
(cells, tubes, control points and pixels by their squares), so that 1 is linear. From the first size to the last
it grows by a factor between {range}.
`a` is over the whole range, where constant parts pull it down; `last` is of the last step alone. Memory is what
a stage holds at its peak over what was held before. `make bench` holds exponents, last steps and memory to
bounds (`tests/benchmarks/test_cost_growth.py`), never seconds.  Recorded {mark}.

{rows}

What the algorithms say:

{reasons}
"""

TABLES = """## All scenes

- memory: the most that bstcad's two processes held, up to the end of the proof, as a sum.
- min. radius: the smaller of the smallest concave and the smallest convex radius of the back, on a grid four times
  finer than its net; after ≤, at the middles of knot spans alone, which was all that reports said then.
- octave: slope energy in the highest octave of the control net, as a part of all: ripple would show here.
- paper: the procedure of Wang et al. 2023, Adam on raw control points; the others are bstcad's.  RRMSD is through the
  geometry re-read from the written STEP file.
- stage 1: standard without stage 2.  integration: what the paper compares its tailoring with, a surface integrated
  point by point from the paper's map and not optimised (`tailoring.method = "integration"`, all else as in standard);
  the portrait's front, which it cannot find, is flat.
"""

def page(recorded: Mapping[str, Any], beside: Collection[str]) -> str:
    """The whole page; beside: names of the files in docs/, of which it shows those that are there."""
    records = _records(recorded)
    marks = {key: f"{key[0]} ({chr(ord('a') + k)})" for k, key in enumerate(records)}
    parts = [HEAD]
    sweeps = recorded.get("sweeps", {})
    if "mitsuba" in recorded:
        parts.append(_peers(recorded, beside, marks))
    parts += [_sweep(scene, found, beside, marks[_key(found)]) for scene, found in sweeps.items()]
    if "growth" in recorded:
        parts.append(_growth(recorded["growth"]["series"], marks[_key(recorded["growth"])]))
    parts += [TABLES, *_tables(recorded.get("designs", {}), marks), _machines(records, marks)]
    return "\n".join(parts)


def _key(record: Mapping[str, Any]) -> tuple[str, ...]:
    """When, on what and with what, and whether the machine had other work."""
    found = record["recorded"]
    busy = BUSY if (found.get("others") or 0.0) > QUIET else ""
    return *(found[name] for name in ("date", "version", "machine", "versions")), busy


def _records(recorded: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """When and on what, each once, in the order of the dates."""
    every = [entry for scene in recorded.get("designs", {}).values() for entry in scene.values()]
    every += [*recorded.get("sweeps", {}).values(), *(recorded[n] for n in ("mitsuba", "growth") if n in recorded)]
    return sorted({_key(entry) for entry in every})


def _shown(value: float | None, form: str) -> str:
    return UNKNOWN if value is None else format(value, form)


def _figure(scene: str, what: str, beside: Collection[str]) -> str:
    return f"![{what}]({FIGURES[scene]})\n\n" if FIGURES[scene] in beside else ""


def _tables(designs: Mapping[str, Any], marks: Mapping[tuple[str, ...], str]) -> Iterator[str]:
    """A table a scene."""
    for scene, title in SCENES.items():
        rows = [(quality, designs[scene][quality]) for quality in QUALITIES if quality in designs.get(scene, {})]
        if not rows:
            continue
        lines = []
        for quality, found in rows:
            told = [_shown(found.get(name), form) for name, form in CELLS.items()]
            if "radius_grid" not in found:
                told[6] = f"≤ {told[6]}"
            lines.append([quality, *told, marks[_key(found)]])
        yield f"### {title}: `templates/{scene}.toml`\n\n{markdown.table(COLUMNS, lines, words=('recorded',))}\n"


def _machines(records: Sequence[tuple[str, ...]], marks: Mapping[tuple[str, ...], str]) -> str:
    lines = [f"- {marks[key]}: bstcad {key[1]}; {key[2]}; {key[3]}{key[4]}" for key in records]
    return "\n".join(["## Recorded", "", *lines]) + "\n"


def _peers(recorded: Mapping[str, Any], beside: Collection[str], marks: Mapping[tuple[str, ...], str]) -> str:
    """Mitsuba beside our qualities and the paper's procedure on the same scene."""
    found = recorded["mitsuba"]
    last = found["points"][-1]
    ours = recorded.get("designs", {}).get(PEER, {})
    rows = []
    for quality in (q for q in QUALITIES if q in ours):
        name = "the paper's procedure" if quality == "paper" else f"bstcad, {quality}"
        rows.append((name, ours[quality] | {"on_target": ours[quality]["efficiency"]}, marks[_key(ours[quality])]))
    for point in _some(found["points"]):
        rows.append((f"Mitsuba, {point['iterations']} iterations", point, marks[_key(found)]))
    shown = {"rrmsd": ".3f", "rrmsd_coarse": ".3f", "on_target": ".3f", "seconds": ".0f", "cpu_seconds": ".0f"}
    table = markdown.table(
        ("", "RRMSD, 512²", "RRMSD, 128²", "light on the target", "seconds", "CPU seconds", "recorded"),
        ([name, *(_shown(entry.get(key), form) for key, form in shown.items()), mark] for name, entry, mark in rows),
        words=("recorded",),
    )
    return PEERS.format(
        figure=_figure(PEER, "RRMSD against seconds for the peers' case: bstcad's knobs and presets, the procedure of "
                       "Wang et al., and Mitsuba 3's caustic optimisation", beside),
        mitsuba=found["mitsuba"], table=table, said=_said(found["points"], found["limit_seconds"], ours),
        coarse=last["rrmsd_coarse"], own=found["own"]["rrmsd"], noise=found["own"]["rrmsd_noise"],
    )  # fmt: skip


def _some(points: Sequence[Mapping[str, Any]]) -> Sequence[Mapping[str, Any]]:
    """The last of a run, and those that had half the iterations of the one after."""
    chosen = [points[-1]]
    for point in reversed(points):
        if 2 * point["iterations"] <= chosen[-1]["iterations"]:
            chosen.append(point)
    return chosen[::-1]


def _said(points: Sequence[Mapping[str, Any]], limit: float, ours: Mapping[str, Any]) -> str:
    """How far Mitsuba came, and in what time we were there; right after its map doubles its error is larger."""
    last, best = points[-1], min(points, key=lambda point: point["rrmsd"])
    cut = "" if last["iterations"] >= 1000 else (
        f"Its run was ended after {limit:.0f} s; what its schedule has later (twice the photons and half the rate from "
        "iteration 700, and again from 900) is cut off.\n"
    )  # fmt: skip
    said = (
        f"{cut}Its best is {best['rrmsd']:.3f} ({best['rrmsd_coarse']:.3f} on its own pixels), after "
        f"{best['seconds']:.0f} s, at {last['cpu_seconds'] / last['iterations']:.1f} CPU seconds an iteration; just "
        "after its map has doubled, each texel in four, its error is larger.\n"
    )  # fmt: skip
    quick = ours.get("draft")
    if not quick:
        return said.strip()
    return (
        f"{said}bstcad's draft reaches {quick['rrmsd']:.3f} in {quick['seconds']:.0f} s, writing and proof of the STEP "
        "file included.\nThe tutorial writes no solid."
    )  # fmt: skip


def _sweep(scene: str, found: Mapping[str, Any], beside: Collection[str], mark: str) -> str:
    """Each knob's ends, and where it stops paying."""
    rows = []
    for knob in found["knobs"]:
        places = knob["places"]
        if len(places) < 2 or knob["key"] == "quality":
            continue
        one, other = places[0], places[-1]
        rows.append([
            knob["title"], one["label"], other["label"], f"{one['rrmsd']:.4f}", f"{other['rrmsd']:.4f}",
            f"{one['seconds']:.1f}", f"{other['seconds']:.1f}", knob.get("says", ""),
        ])  # fmt: skip
    said = [f"- {text}." for text in found.get("comparisons", ())]
    if found["front_halving"]:
        said.insert(0, f"- Along the Pareto front halving the error takes × {found['front_halving']:.2g} of the time.")
    shown = scene != PEER  # that one stands above, with Mitsuba's
    return SWEEP.format(
        title=f"The knobs: {found['title']}", scene=scene, budget=f"{found['budget_seconds']:.0f}", runs=found["runs"],
        figure=_figure(scene, "RRMSD against seconds, one curve a knob", beside) if shown else "",
        not_run=found["not_run"] or "none", what=found["reference"]["what"],
        kernel=f"{1000 * found['calibration']['seconds']:.0f}",
        knobs=markdown.table(KNOB, rows, words=KNOB[-1:]), comparisons="\n".join(said),
        mark=mark,
    )  # fmt: skip


def _growth(series: Sequence[Mapping[str, Any]], mark: str) -> str:
    """Costs as recorded, with what is known of the algorithms now."""
    why = {(each.stage, each.driver): each.why for each in SERIES}
    rows, reasons, ranges = [], [], {}
    for entry in series:
        power = "²" if entry["power"] == 2 else ""
        low, high = entry["sizes"][0], entry["sizes"][-1]
        memory, grows = entry["memory_mb"], entry["memory_exponent"]
        rows.append([
            entry["stage"], entry["driver"], f"{low}{power} to {high}{power}",
            f"{entry['cpu_seconds'][0]:.2g} to {entry['cpu_seconds'][-1]:.2g}", f"{entry['exponent']:.2f}",
            f"{entry['last_exponent']:.2f}",
            UNKNOWN if None in memory else f"{memory[0]:.0f} to {memory[-1]:.0f}", _shown(grows, ".2f"),
        ])  # fmt: skip
        ranges[(high / low) ** entry["power"]] = entry["driver"]
        key = entry["stage"], entry["driver"]
        if key in why:
            reasons.append(f"- {entry['stage']}, {entry['driver']}: {why[key]}.")
    least, most = min(ranges), max(ranges)
    said = f"{least:.0f} ({ranges[least]}) and {most:.0f}"
    return GROWTH.format(
        rows=markdown.table(COST, rows, words=COST[:2]), reasons="\n".join(reasons), range=said, mark=mark
    )


# ---- the figures: a sweep's plane, with what else was recorded of its scene ------------------------------------------


def draw(recorded: Mapping[str, Any], scene: str) -> bytes | None:
    """The figure of a scene's sweep as PNG; None: no sweep of it is recorded."""
    return png(figure(recorded, scene)) if scene in recorded.get("sweeps", {}) else None


@styled
def figure(recorded: Mapping[str, Any], scene: str) -> Any:
    """The same, not drawn yet: the sweep as results.plane draws a Table, with room for the paper's and Mitsuba's."""
    sweep = _named(recorded["sweeps"][scene])
    points = _named(recorded.get("mitsuba", {}).get("points", [])) if scene == PEER else []
    paper = recorded.get("designs", {}).get(scene, {}).get("paper")  # by itself: few budgets last for it
    papers = [*(preset for preset in sweep.presets if preset.name == "paper"), *([_named(paper)] if paper else [])][:1]
    sweep.presets = [preset for preset in sweep.presets if preset.name != "paper"]
    ends = [Named(seconds=s, rrmsd=e) for s, e in zip(sweep.range.seconds, sweep.range.rrmsd, strict=True)]
    sweep.best = sorted(sweep.front, key=lambda run: run.seconds)
    sweep.knobs = [knob for knob in sweep.knobs if len(knob.places) > 1]
    tried = [place for knob in sweep.knobs for place in knob.places]
    sweep.shown = [*ends, *sweep.presets, *points, *papers, *tried]
    sweep.history = [{"seconds": seconds, "rrmsd": rrmsd} for seconds, rrmsd in sweep.history]
    drawn = new_figure(WIDTH, HEIGHT)
    axes = drawn.subplots()
    plane(axes, sweep)
    for design in papers:
        axes.plot(design.seconds, design.rrmsd, "*", ms=17, color="#ffffff", mec="#111111", mew=1.1, zorder=5)
        axes.annotate("the procedure of Wang et al. 2023", (design.seconds, design.rrmsd), (12, -13), ha="right",
                      va="top", textcoords="offset points", weight="bold", zorder=6)  # fmt: skip
    if points:
        _mitsuba(axes, points)
    legend(axes)
    return drawn


def _named(record: Any) -> Any:
    """A record of JSON whose keys are attributes."""
    return json.loads(json.dumps(record), object_hook=lambda entry: Named(**entry))


def _mitsuba(axes: Any, points: Sequence[Any]) -> None:
    """Mitsuba's run, each height map judged as our lenses are, on the target's pixels and on its own."""
    seconds, coarse = [point.seconds for point in points], [point.rrmsd_coarse for point in points]
    look = {"color": "#b00058", "lw": 1.8, "zorder": 4, "marker": "o", "ms": 4.5}
    reached = f"5 to {points[-1].iterations} of 1000 iterations"
    axes.plot(seconds, [point.rrmsd for point in points], label=f"Mitsuba 3: caustic optimisation, {reached}", **look)
    axes.plot(seconds, coarse, ls=(0, (4, 2)), mfc="white", label="the same, on its own 128² pixels", **look)
    axes.annotate("Mitsuba 3's caustic optimisation", (seconds[-1], min(coarse)), (0, -10), ha="right", va="top",
                  textcoords="offset points", color=look["color"], weight="bold")  # fmt: skip
