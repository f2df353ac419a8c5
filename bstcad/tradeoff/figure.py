"""The picture of a sweep: RRMSD against seconds, a curve a knob, and what nothing beats; or errors alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from bstcad.report.drawing import BLUE, GREY, VERMILION, new_figure, png, styled
from bstcad.report.units import number
from bstcad.tradeoff.findings import Findings
from bstcad.tradeoff.pareto import Turned
from bstcad.tradeoff.runs import NO_PICTURE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, each with a marker of its own, for who sees no colours.
LOOKS = {
    "evaluations": (BLUE, "o", "-"),
    "tubes": (VERMILION, "s", "-"),
    "control_points": ("#009e73", "^", "-"),
    "adam": ("#222222", "x", "--"),
    "precision": ("#cc79a7", "P", "-"),
    "pixels": ("#56b4e9", "D", "-"),
    "rounds": ("#e69f00", "v", "-"),
    "transport_grid": ("#8c6d31", "<", "-"),
    "transport_iterations": ("#7f7f7f", ">", "-"),
    "tubes_evaluations": ("#7b3fa0", "h", ":"),
    "control_points_tubes": ("#3b6e3b", "p", ":"),
}
WIDTH, HEIGHT = 11.0, 7.2  # inches
ROOM = 1.25  # factor left free beyond the outermost points
FAR = 6.0  # factor below all errors to which the standard error is looked for
HISTORY, FRONT, RING = "#b5b5b5", "#f0c80073", "#a87c00"


def draw(found: Findings) -> bytes:
    """The figure as PNG."""
    return png(errors(found) if found.errors_alone else tradeoff(found))


@styled
def tradeoff(found: Findings) -> Figure:
    """RRMSD against seconds; beside it, what the judges are off by; needs a run with a lens."""
    figure = new_figure(WIDTH, HEIGHT)
    if found.judges:
        left, right = figure.subplots(1, 2, width_ratios=(3.2, 1.0))
        _judges(right, found)
        _comparisons(right, found)
    else:
        left = figure.subplots()
    plane(left, found)
    return figure


@styled
def errors(found: Findings) -> Figure:
    """RRMSD of each place of each knob, a line a knob; of runs whose seconds do not compare."""
    rows = [turned for turned in found.turned if turned.places][::-1]
    figure = new_figure(WIDTH, 1.6 + 0.42 * len(rows))
    axes = figure.subplots()
    every = [place.rrmsd for turned in rows for place in turned.places]
    low, high = _room(every)
    axes.set(xscale="log", xlim=(low / ROOM, high * ROOM), ylim=(-0.7, len(rows) - 0.3))
    _plain(axes.xaxis, axes.get_xlim())
    axes.grid(which="major", axis="x")
    axes.set_yticks(range(len(rows)), [turned.knob.title for turned in rows])
    axes.set_xlabel("RRMSD by the reference")
    scene = found.sweep.scene
    axes.set_title(f"What each knob does to the error: {scene.title or scene.name}", pad=12)
    for y, turned in enumerate(rows):
        _row(axes, y, turned)
    if found.base:
        axes.axvline(found.base.rrmsd, color=GREY, lw=0.9, ls=(0, (5, 3)), zorder=1, label="the scene as it stands")
        legend(axes)
    return figure


def _row(axes: Axes, y: int, turned: Turned) -> None:
    """A knob's places on its line, the ends by name."""
    colour, marker, line = LOOKS.get(turned.knob.key, ("#111111", "o", ":"))
    places = sorted(turned.places, key=lambda place: place.rrmsd)
    edge = colour if marker == "x" else "white"
    axes.plot([place.rrmsd for place in places], [y] * len(places), color=colour, marker=marker, ls=line, ms=6, lw=1.0,
              mec=edge, mew=0.8, zorder=3)  # fmt: skip
    ends = ((places[0], -7, "right"), (places[-1], 7, "left"))
    for place, away, side in ends[: len(places)]:
        axes.annotate(place.label, (place.rrmsd, y), (away, 0), textcoords="offset points", ha=side, va="center",
                      fontsize=8, color=colour)  # fmt: skip


def _comparisons(axes: Axes, found: Findings) -> None:
    """One way for another, and by which factors time and error change, below the smaller panel."""
    lines = [entry["short"].replace(": ", ":\n   ") for entry in found.comparisons]
    if lines:
        axes.annotate("\n".join(lines), (-0.35, 0.0), (0, -72), xycoords="axes fraction", textcoords="offset points",
                      va="top", fontsize=8.0, linespacing=1.35, annotation_clip=False)  # fmt: skip


def plane(axes: Axes, found: Findings) -> None:
    """Time and error of all runs."""
    _axes(axes, found)
    _floor(axes, found)
    if found.history:
        axes.plot(*zip(*found.history, strict=True), color=HISTORY, lw=0.9, zorder=1,
                  label="along the base's run (warm)")  # fmt: skip
    for turned in found.turned:
        if turned.knob.key in LOOKS and (len(turned.places) > 1 or turned.knob.base is None) and turned.places:
            _curve(axes, turned)
    _front(axes, found)
    _presets(axes, found)
    _failed(axes, found)
    legend(axes)


def _axes(axes: Axes, found: Findings) -> None:
    """Both logarithmic, with plain numbers; above, the time in units of the calibration kernel."""
    records = found.compared.values()
    times = [*(r.seconds for r in records), *(r.seconds for r in found.failed if r.seconds > 1)]
    axes.set(xscale="log", yscale="log", xlim=_room(times), ylim=_heights(found))
    _plain(axes.xaxis, axes.get_xlim())
    _plain(axes.yaxis, axes.get_ylim())
    axes.grid(which="major")
    axes.set_xlabel("seconds, the whole command in a cold process")
    axes.set_ylabel("RRMSD by the reference")
    scene = found.sweep.scene
    axes.set_title(f"What accuracy costs in time: {scene.title or scene.name}", pad=12)
    unit = found.calibration["seconds"]
    if unit:
        above = axes.secondary_xaxis("top", functions=(lambda t: t / unit, lambda u: u * unit))
        _plain(above.xaxis, tuple(limit / unit for limit in axes.get_xlim()))
        above.set_xlabel(f"units of the calibration kernel, {1000 * unit:.0f} ms here")
        above.spines["top"].set_visible(True)


def _plain(axis, limits: tuple[float, float]) -> None:
    """Ticks at 1, 2 and 5 times the powers of ten, or closer where that leaves few, in plain numbers."""
    for digits in ((1, 2, 5), (1, 1.5, 2, 3, 4, 5, 7), (1, 1.2, 1.4, 1.6, 1.8, 2, 2.5, 3, 3.5, 4, 4.5, 5, 6, 7, 8, 9)):
        decades = range(math.floor(math.log10(limits[0])), math.ceil(math.log10(limits[1])) + 1)
        ticks = [d * 10.0**k for k in decades for d in digits if limits[0] <= d * 10.0**k <= limits[1]]
        if len(ticks) >= 4:
            break
    axis.set_ticks(ticks, [number(tick) for tick in ticks])
    axis.set_ticks([], minor=True)


def _room(values: Sequence[float]) -> tuple[float, float]:
    return min(values) / ROOM, max(values) * ROOM


def _heights(found: Findings) -> tuple[float, float]:
    """Of the error axis: all that is better than no picture, and the standard error where it is near."""
    errors = [record.rrmsd for record in found.compared.values()]
    low, high = _room([error for error in errors if error < NO_PICTURE] or errors)
    floors = [floor for _, floor in _floors(found)]
    return max(min([low, *(floor / ROOM for floor in floors)]), low / FAR), high


def _floors(found: Findings) -> list[tuple[float, float]]:
    """(seconds, standard error) of the runs of the front."""
    return [(r.seconds, r.rrmsd_noise) for r in found.front if r.rrmsd_noise and math.isfinite(r.rrmsd_noise)]


def _floor(axes: Axes, found: Findings) -> None:
    """The standard error of the reference for the runs of the front; below it nothing can be told."""
    points = _floors(found)
    if not points:
        return
    (left, right), bottom = axes.get_xlim(), axes.get_ylim()[0]
    times = [left, *(seconds for seconds, _ in points), right]
    floors = [points[0][1], *(floor for _, floor in points), points[-1][1]]
    axes.fill_between(times, floors, bottom, color="#ececec", lw=0, zorder=0)  # what lies lower is cut off
    axes.plot(times, floors, color=GREY, lw=0.9, ls=(0, (5, 3)), zorder=1)
    seen = floors[-1] > 1.1 * bottom
    said = "standard error of the reference" + ("" if seen else f": {number(floors[-1])}, further down")
    axes.annotate(said, (right, floors[-1] if seen else bottom), (-6, -4 if seen else 4), textcoords="offset points",
                  ha="right", va="top" if seen else "bottom", color=GREY, fontsize=8)  # fmt: skip


def _curve(axes: Axes, turned: Turned) -> None:
    """One knob: its places in their order, the base's as part of them; bars from seed to seed."""
    colour, marker, line = LOOKS[turned.knob.key]
    places = turned.places
    seconds, errors = [p.seconds for p in places], [p.rrmsd for p in places]
    axes.plot(seconds, errors, color=colour, marker=marker, ls=line, ms=5, lw=1.2, mec="white" if marker != "x" else
              colour, mew=0.5 if marker != "x" else 1.4, label=_name(turned), zorder=3)  # fmt: skip
    top = axes.get_ylim()[1]
    for place in places:
        if place.rrmsd > top:
            axes.annotate(f"↑ {number(place.rrmsd)}", (place.seconds, top), (0, -14), textcoords="offset points",
                          ha="center", va="top", color=colour, fontsize=8)  # fmt: skip
    spread = [p for p in places if p.seeds > 1]
    if spread:
        bars = [[p.rrmsd - p.lowest for p in spread], [p.highest - p.rrmsd for p in spread]]
        axes.errorbar([p.seconds for p in spread], [p.rrmsd for p in spread], bars, fmt="none", ecolor=colour, lw=1.0,
                      capsize=2, zorder=3)  # fmt: skip


def _name(turned: Turned) -> str:
    """A knob and how far it was turned."""
    places = turned.places
    span = f"{places[0].label} to {places[-1].label}" if len(places) > 1 else places[0].label
    return f"{turned.knob.title}: {span}"


def _front(axes: Axes, found: Findings) -> None:
    """The runs that none beats, each in a ring, on the staircase above which all others lie."""
    if not found.front:
        return
    times, errors = zip(*((r.seconds, r.rrmsd) for r in found.front), strict=True)
    axes.step(times, errors, where="post", color=FRONT, lw=5.5, zorder=2, label="Pareto front",
              marker="o", ms=18, mfc="none", mec=RING, mew=1.6, solid_joinstyle="round",
              solid_capstyle="round")  # fmt: skip


def _presets(axes: Axes, found: Findings) -> None:
    """The presets, large and by name."""
    line = sorted((record.seconds, record.rrmsd) for name, record in found.presets.items() if name != "paper")
    if len(line) > 1:
        axes.plot(*zip(*line, strict=True), color="#111111", lw=0.9, ls=(0, (1, 2)), zorder=4, label="bstcad's presets")
    for name, record in found.presets.items():
        axes.plot(record.seconds, record.rrmsd, "*", ms=17, color="#ffffff", mec="#111111", mew=1.1, zorder=5)
        axes.annotate(name, (record.seconds, record.rrmsd), (9, 8), textcoords="offset points", weight="bold",
                      fontsize=10, zorder=6, bbox={"fc": "white", "alpha": 0.7, "lw": 0, "pad": 0.8})  # fmt: skip


def _failed(axes: Axes, found: Findings) -> None:
    """Runs that came to no lens: crosses along the top, where they ended."""
    low, _ = axes.get_xlim()
    for index, record in enumerate(found.failed):
        seconds = max(record.seconds, low * 1.05)
        axes.plot(seconds, 0.975, "X", transform=axes.get_xaxis_transform(), color="#b00020", ms=8, mec="white",
                  mew=0.6, clip_on=False, zorder=6, label="failed" if index == 0 else None)  # fmt: skip
        axes.annotate(found.labels.get(record.settings, ""), (seconds, 0.975), (6, 0), textcoords="offset points",
                      xycoords=axes.get_xaxis_transform(), fontsize=7.5, color="#b00020", va="center")  # fmt: skip


def legend(axes: Axes) -> None:
    """Below the picture, in columns, of what has a name."""
    if not axes.get_legend_handles_labels()[0]:
        return
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=2, fontsize=8.2, handlelength=2.6,
                columnspacing=1.6)  # fmt: skip


def _judges(axes: Axes, found: Findings) -> None:
    """Ray tubes and rays as judges of the base's lens."""
    looks = {"tubes": (VERMILION, "s", "ray tubes"), "rays": (BLUE, "o", "stratified rays")}
    for judge, (colour, marker, name) in looks.items():
        of = [entry for entry in found.judges if entry.judge == judge and entry.error > 1e-9]
        if not of:
            continue
        axes.plot([e.seconds for e in of], [e.error for e in of], color=colour, marker=marker, ms=5, label=name)
        beside = {"xytext": (-5, -5), "ha": "right", "va": "top"} if judge == "tubes" else {"xytext": (5, 4)}
        for entry in of:
            axes.annotate(f"{entry.a_side}²", (entry.seconds, entry.error), textcoords="offset points", fontsize=7.5,
                          color=colour, **beside)  # fmt: skip
    shown = [entry for entry in found.judges if entry.error > 1e-9]
    times, errors = [e.seconds for e in shown], [e.error for e in shown]
    axes.set(xscale="log", yscale="log", xlim=(min(times) / 2.2, max(times) * 2.2), ylim=_room(errors))
    _plain(axes.xaxis, axes.get_xlim())
    _plain(axes.yaxis, axes.get_ylim())
    axes.grid(which="major")
    axes.set_xlabel("seconds of one picture (warm)")
    axes.set_ylabel("RMS error of the picture")
    axes.set_title("What the judges are off by", pad=12)
    axes.legend(loc="upper center", bbox_to_anchor=(0.4, -0.11), ncols=2, columnspacing=1.0, handlelength=1.5)
