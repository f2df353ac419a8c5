"""Knobs trade accuracy for time: each is a list of settings from little work to much, among them the base.

The base is the scene as it stands.  A sweep turns one knob at a time, then those that go together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from bstcad.scene.quality import PRESETS
from bstcad.scene.scene import Scene

Value = int | float | str | tuple[int, int]
Settings = tuple[tuple[str, Value], ...]  # (dotted key of the scene, value), sorted by key; () is the base

HALF, ROOT = 0.5, 0.5**0.5
NETS = (9, 1025)  # control points a side, least and most
GRIDS = (32, 2048)  # cells a side of a transport, least and most
PIXELS = (8, 4096)  # a side, least and most
ROUNDS = (1, 2, 3, 5, 8)  # of transport and slope fit in stage 1
ADAM = (1 / 8, 1 / 4, 1 / 2, 1.0)  # steps of Wang et al.'s procedure, as shares of the preset's
FURTHER = (2, 3, 4)  # points from the base
MORE_SEEDS = 2  # beside the scene's own


@dataclass(frozen=True)
class Point:
    """One setting of a knob."""

    label: str  # "768"
    settings: Settings


@dataclass(frozen=True)
class Knob:
    """A number or a choice that trades accuracy for time."""

    key: str  # for programs: "tubes"
    title: str  # "Ray tubes a side"
    points: tuple[Point, ...]  # from little work to much
    combines: bool = False  # turns more than one key at a time

    @property
    def base(self) -> int | None:
        """Index of the base among the points; None: the base is no point of it."""
        return next((i for i, point in enumerate(self.points) if not point.settings), None)


def settings(entries: Mapping[str, Value]) -> Settings:
    """Settings in their order."""
    return tuple(sorted(entries.items()))


def with_seed(point: Settings, seed: int) -> Settings:
    """The settings with another seed."""
    return settings({**dict(point), "tailoring.seed": seed})


def words(point: Settings) -> str:
    """Settings as on the command line."""
    changes = (f"{key.removeprefix('tailoring.')} = {as_text(value)}" for key, value in point)
    return ", ".join(changes) or "the scene's own"


def as_text(value: Value) -> str:
    """A value as --set takes it."""
    return f"[{value[0]}, {value[1]}]" if isinstance(value, tuple) else str(value)


def knobs(scene: Scene) -> tuple[Knob, ...]:
    """All knobs of a scene, the one that matters most first."""
    own = scene.lens.back.control_points
    known = scene.tailoring.resolved(own)
    adam = known.method == "adam"

    def shares(name: str, of: Iterable[float], limits: tuple[int, int] = (1, 16_384)) -> tuple[Point, ...]:
        value = getattr(known, name)
        return _numbers(f"tailoring.{name}", value, _within(limits, (round(share * value) for share in of)))

    nets = _within(NETS, (round(share * (own - 1)) + 1 for share in (1 / 4, HALF, 1, 2, 4)))
    tubes = shares("rays", (1 / 4, HALF, ROOT, 1, 1 / ROOT, 2))
    evaluations = shares("stage2_iterations", (1 / 8, 1 / 4, HALF, 1, 2, 4))
    found = (
        Knob("quality", "Quality presets", _choices("tailoring.quality", scene.tailoring.quality, PRESETS)),
        Knob("evaluations", "Evaluations of stage 2", evaluations),
        Knob("tubes", "Rays a side" if adam else "Ray tubes a side", tubes),
        Knob("control_points", "Control points a side", _numbers("lens.back.control_points", own, nets)),
        Knob("adam", "Adam on control points, by rays", tuple(_adam(known.quality == "paper"))),
        Knob("precision", "Precision", _choices("tailoring.precision", known.precision, ("float32", "float64"))),
        Knob("pixels", "Pixels tailored to", tuple(_pixels(*scene.target.columns_rows))),
        Knob("rounds", "Rounds of stage 1", () if adam else _numbers("tailoring.rounds", known.rounds, ROUNDS)),
        Knob("transport_grid", "Transport grid, cells a side", shares("transport_grid", (1 / 4, HALF, 1, 2), GRIDS)),
        Knob("transport_iterations", "Transport iterations", shares("transport_iterations", (1 / 8, 1 / 4, 1, 2))),
        Knob("tubes_evaluations", "Tubes and evaluations together", tuple(_together(
            ("tailoring.rays", known.rays, (HALF, ROOT, 1, 1 / ROOT)),
            ("tailoring.stage2_iterations", known.stage2_iterations, (1 / 4, HALF, 1, 2)))), combines=True),
        Knob("control_points_tubes", "Control points and tubes together", tuple(_together(
            ("lens.back.control_points", own, (1 / 4, HALF, 1, 2)),
            ("tailoring.rays", known.rays, (1 / 4, HALF, 1, 2)))), combines=True),
    )  # fmt: skip
    return tuple(knob for knob in found if len(knob.points) > 1)


def _within(limits: tuple[int, int], values: Iterable[int]) -> list[int]:
    return [value for value in values if limits[0] <= value <= limits[1]]


def _choices(key: str, own: Value, values: Iterable[Value]) -> tuple[Point, ...]:
    return tuple(Point(as_text(v), () if v == own else settings({key: v})) for v in values)


def _numbers(key: str, own: int, values: Iterable[int]) -> tuple[Point, ...]:
    return _choices(key, own, sorted({*values, own}))


def _pixels(columns: int, rows: int) -> Iterator[Point]:
    """Coarser and finer pictures to tailor to; the lens is judged on the base's pixels."""
    for share in (1 / 4, HALF, 1, 2):
        size = round(share * columns), round(share * rows)
        if len(_within(PIXELS, size)) == 2:
            value = size[0] if columns == rows else size
            yield Point(as_text(value), () if share == 1 else settings({"target.pixels": value}))


def _adam(own: bool) -> Iterator[Point]:
    """Wang et al.'s procedure with fewer steps; the last point is the preset."""
    for share in ADAM:
        steps = {name: round(share * PRESETS["paper"][name]) for name in ("stage1_iterations", "stage2_iterations")}
        fewer = {f"tailoring.{name}": count for name, count in steps.items()} if share < 1 else {}
        label = f"{steps['stage1_iterations']} + {steps['stage2_iterations']}"
        yield Point(label, settings(({} if own else {"tailoring.quality": "paper"}) | fewer))


def _together(*turned: tuple[str, int, Sequence[float]]) -> Iterator[Point]:
    """Two keys in step: (key, the base's value, shares of that)."""
    for shares in zip(*(shares for _, _, shares in turned), strict=True):
        values = {}
        for (key, own, _), share in zip(turned, shares, strict=True):
            net = key.endswith("control_points")  # of which the spans are scaled
            values[key] = own if share == 1 else round(share * (own - net)) + net
        if len(_within(NETS, [values.get("lens.back.control_points", NETS[0])])):
            changed = {key: max(1, values[key]) for key, own, _ in turned if values[key] != own}
            yield Point(" × ".join(str(max(1, value)) for value in values.values()), settings(changed))


# --- in which order -------------------------------------------------------------------------------------------------


class Outcome(Protocol):
    """A run, as far as the order of the runs depends on it."""

    seconds: float
    net: str

    @property
    def done(self) -> bool:
        """Is there a lens?"""


Find = Callable[[Settings], Outcome | None]  # the run with these settings; None: there is none so far


def run_order(scene: Scene, knobs: Sequence[Knob], find: Find) -> list[Settings]:
    """All runs, the most important first, so that any budget is well spent.

    Presets, neighbours of the base, further points, other seeds where the seed matters, the paper's procedure.
    """
    by_key = {knob.key: knob for knob in knobs}
    return list(dict.fromkeys(_in_order(scene, by_key, find)))


def _in_order(scene: Scene, knobs: Mapping[str, Knob], find: Find) -> Iterator[Settings]:
    presets, other = _presets(knobs), {method: pair[1] for method, pair in _probes(scene, knobs).items()}
    single = [knob for knob in knobs.values() if not knob.combines and knob.key != "quality"]
    both = [knob for knob in knobs.values() if knob.combines]
    paper = presets.get("paper", ())  # minutes

    def around(turned: Iterable[Knob], away: int) -> list[Settings]:
        return [point for knob in turned for point in _neighbour(knob, away) if point != paper]

    yield presets.get("draft", ())
    yield from ((), presets.get("standard", ()))
    yield from around(single, -1)
    yield other.get("least-squares", ())
    yield from (*around(both, -1), *around(single, +1), presets.get("fine", ()), *around(both, +1))
    yield other.get("adam", ())
    yield from (point for away in FURTHER for point in around(single, -away))
    yield from (point for away in FURTHER for sign in (+1, -1) for point in around((*single, *both), sign * away))
    yield from _seeded(scene, knobs, find)
    yield paper


def _presets(knobs: Mapping[str, Knob]) -> dict[str, Settings]:
    return {point.label: point.settings for point in knobs["quality"].points}


def _neighbour(knob: Knob, away: int) -> Iterator[Settings]:
    """The point so far from the base, if there is one.

    Of a knob without the base the first point stands for the neighbour with less work, the second for more.
    """
    start = knob.base if knob.base is not None else 1 if away == -1 else 0 if away > 0 else -1
    if 0 <= start + away < len(knob.points):
        yield knob.points[start + away].settings


def seeds(scene: Scene) -> tuple[int, ...]:
    """Seeds that are tried beside the scene's own."""
    return tuple(scene.tailoring.seed + 1 + i for i in range(MORE_SEEDS))


def _probes(scene: Scene, knobs: Mapping[str, Knob]) -> dict[str, tuple[Settings, Settings]]:
    """By method a cheap run, and the same run with another seed."""
    quick = {"least-squares": _presets(knobs)["draft"]} if "draft" in _presets(knobs) else {}
    if "adam" in knobs:
        quick["adam"] = knobs["adam"].points[0].settings
    return {method: (point, with_seed(point, seeds(scene)[0])) for method, point in quick.items()}


def seed_matters(scene: Scene, knobs: Sequence[Knob], find: Find) -> dict[str, bool | None]:
    """By method: does another seed give another lens?  None: not measured."""
    matters: dict[str, bool | None] = {}
    for method, pair in _probes(scene, {knob.key: knob for knob in knobs}).items():
        first, second = map(find, pair)
        matters[method] = first.net != second.net if first and second and first.done and second.done else None
    return matters


def _seeded(scene: Scene, knobs: Mapping[str, Knob], find: Find) -> Iterator[Settings]:
    """More seeds of the runs that the seed matters for, the quickest first."""
    matters = seed_matters(scene, list(knobs.values()), find)
    ran = {point.settings: find(point.settings) for knob in knobs.values() for point in knob.points}
    done = sorted((run.seconds, point) for point, run in ran.items() if run is not None and run.done)
    for seed in seeds(scene):
        yield from (with_seed(point, seed) for _, point in done if matters.get(_method(scene, point)))


def _method(scene: Scene, point: Settings) -> str:
    changes = dict(point)
    quality = changes.get("tailoring.quality", scene.tailoring.quality)
    given = changes.get("tailoring.method", scene.tailoring.method)
    return given or ("adam" if quality == "paper" else "least-squares")
