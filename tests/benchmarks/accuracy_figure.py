"""The pictures of docs/accuracy.md from recorded results: a sweep's plane, with what else was recorded of its scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bstcad.report.drawing import new_figure, png, styled
from bstcad.sweep.results import Calibration, Place, Preset, TableKnob, legend, plane

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 9.6, 8.0  # inches
PEERS = ("caustic_portrait",)  # scenes that Mitsuba's caustic optimisation was run for
MITSUBA = "#b00058"


@dataclass(frozen=True)
class Run:
    """A run as a figure needs it."""

    seconds: float
    rrmsd: float
    rrmsd_noise: float | None = None


@dataclass(frozen=True)
class Recorded:
    """A recorded sweep with what stands beside it, as results.plane draws a sweep."""

    title: str
    calibration: Calibration
    shown: Sequence[Run]  # of which the axes show all
    best: Sequence[Run]
    presets: Sequence[Preset]
    knobs: Sequence[TableKnob]
    history: Sequence[Mapping[str, float]]


def draw(recorded: Mapping[str, Any], scene: str) -> bytes | None:
    """The figure of a scene's sweep as PNG; None: no sweep of it is recorded."""
    found = recorded.get("sweeps", {}).get(scene)
    return png(figure(recorded, scene)) if found else None


@styled
def figure(recorded: Mapping[str, Any], scene: str) -> Figure:
    """The same, not drawn yet."""
    found = recorded["sweeps"][scene]
    drawn = new_figure(WIDTH, HEIGHT)
    axes = drawn.subplots()
    peer = recorded.get("mitsuba", {}).get("points", []) if scene in PEERS else []
    presets = _presets(found, recorded.get("designs", {}).get(scene, {}))
    paper = next((preset for preset in presets if preset.name == "paper"), None)
    presets = [preset for preset in presets if preset is not paper]
    plane(axes, _as_found(found, presets, [*_runs(peer), *([paper] if paper else [])]))
    if paper:
        _paper(axes, paper)
    if peer:
        _mitsuba(axes, peer)
    legend(axes)
    return drawn


def _presets(found: Mapping[str, Any], designs: Mapping[str, Any]) -> list[Preset]:
    """The presets that the sweep ran; the paper's procedure, for which few budgets last, as recorded by itself."""
    paper = [designs["paper"] | {"name": "paper"}] if "paper" in designs else []
    return [Preset(**{name: entry[name] for name in Preset.model_fields}) for entry in [*found["presets"], *paper]]


def _runs(points: Sequence[Mapping[str, Any]]) -> list[Run]:
    return [Run(point["seconds"], point["rrmsd"]) for point in points]


def _as_found(found: Mapping[str, Any], presets: Sequence[Preset], others: Sequence[Run]) -> Recorded:
    """The sweep, with axes that have room for other runs, too."""
    ends = [Run(*pair) for pair in zip(found["range"]["seconds"], found["range"]["rrmsd"], strict=True)]
    return Recorded(
        title=found["title"],
        calibration=Calibration(**found["calibration"]),
        shown=[*ends, *presets, *others],
        best=sorted((Run(**run) for run in found["front"]), key=lambda run: run.seconds),
        presets=presets,
        knobs=[_knob(knob) for knob in found["knobs"] if len(knob["places"]) > 1],
        history=[{"seconds": seconds, "rrmsd": rrmsd} for seconds, rrmsd in found["history"]],
    )


def _paper(axes: Axes, paper: Preset) -> None:
    """The paper's procedure, all of it."""
    axes.plot(paper.seconds, paper.rrmsd, "*", ms=17, color="#ffffff", mec="#111111", mew=1.1, zorder=5)
    axes.annotate("the procedure of Wang et al. 2023", (paper.seconds, paper.rrmsd), (12, -13), ha="right",
                  va="top", textcoords="offset points", weight="bold", zorder=6)  # fmt: skip


def _knob(knob: Mapping[str, Any]) -> TableKnob:
    places = tuple(Place(settings=(), **place) for place in knob["places"])
    return TableKnob(key=knob["key"], title=knob["title"], places=places)


def _mitsuba(axes: Axes, points: Sequence[Mapping[str, Any]]) -> None:
    """Mitsuba's run, each height map judged as our lenses are, on the target's pixels and on its own."""
    seconds = [point["seconds"] for point in points]
    look = {"color": MITSUBA, "lw": 1.8, "zorder": 4}
    axes.plot(seconds, [point["rrmsd"] for point in points], marker="o", ms=4.5,
              label="Mitsuba 3: caustic optimisation, 5 to "
              f"{points[-1]['iterations']} of 1000 iterations", **look)  # fmt: skip
    axes.plot(seconds, [point["rrmsd_coarse"] for point in points], ls=(0, (4, 2)), marker="o", ms=4.5, mfc="white",
              label="the same, on its own 128² pixels", **look)  # fmt: skip
    below = min(point["rrmsd_coarse"] for point in points)
    axes.annotate("Mitsuba 3's caustic optimisation", (seconds[-1], below), (0, -10), textcoords="offset points",
                  color=MITSUBA, weight="bold", ha="right", va="top")  # fmt: skip
