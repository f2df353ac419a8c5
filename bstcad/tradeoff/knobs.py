"""What is swept: knobs, each a list of settings from little work to much, one of which is the scene as it stands.

One knob at a time is turned from the base, which is the scene with its own quality; then those that go together.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from bstcad.scene.quality import PRESETS, Tailoring
from bstcad.scene.scene import Scene

Value = int | float | str | tuple[int, int]
Settings = tuple[tuple[str, Value], ...]  # dotted keys of the scene, sorted, and what they are set to; () is the base

HALF, ROOT = 0.5, 0.5**0.5
LARGEST_NET = 1025  # control points a side
SMALLEST_NET = 9
GRIDS = (32, 2048)  # cells a side of a transport that is worth a try
ROUNDS = (1, 2, 3, 5, 8)  # of transport and slope fit in stage 1
ADAM = (1 / 8, 1 / 4, 1 / 2, 1.0)  # steps of Wang et al.'s procedure, as shares of those in quality.py


@dataclass(frozen=True)
class Point:
    """One place of a knob."""

    label: str  # "768"
    settings: Settings


@dataclass(frozen=True)
class Knob:
    """Something that trades accuracy for time."""

    key: str  # for programs: "tubes"
    title: str  # "Ray tubes a side"
    points: tuple[Point, ...]  # from little work to much
    combines: bool = False  # turns more than one thing at a time

    @property
    def base(self) -> int | None:
        """Which of its points is the base; None: it has another start."""
        return next((i for i, point in enumerate(self.points) if not point.settings), None)


def knobs(scene: Scene) -> tuple[Knob, ...]:
    """All that can be turned for a scene, what matters most first."""
    known = scene.tailoring.resolved(scene.lens.back.control_points)
    adam = known.method == "adam"
    found = [
        _quality(scene.tailoring.quality),
        _scaled("evaluations", "Evaluations of stage 2", known, "stage2_iterations", (1 / 8, 1 / 4, HALF, 1, 2, 4)),
        _scaled("tubes", "Rays a side" if adam else "Ray tubes a side", known, "rays",
                (1 / 4, HALF, ROOT, 1, 1 / ROOT, 2)),
        _net(scene),
        _adam(known),
        _precision(known),
        _pixels(scene),
        None if adam else _listed("rounds", "Rounds of stage 1", known, "rounds", ROUNDS),
        _scaled("transport_grid", "Transport grid, cells a side", known, "transport_grid", (1 / 4, HALF, 1, 2), GRIDS),
        _scaled("transport_iterations", "Transport iterations", known, "transport_iterations", (1 / 8, 1 / 4, 1, 2)),
        _together("tubes_evaluations", "Tubes and evaluations together", scene, known,
                  ((HALF, 1 / 4, 1), (ROOT, HALF, 1), (1, 1, 1), (1 / ROOT, 2, 1))),
        _together("control_points_tubes", "Control points and tubes together", scene, known,
                  ((1 / 4, 1, 1 / 4), (HALF, 1, HALF), (1, 1, 1), (2, 1, 2))),
    ]  # fmt: skip
    return tuple(knob for knob in found if knob is not None and len(knob.points) > 1)


def settings(entries: Iterable[tuple[str, Value]]) -> Settings:
    """Settings in their one order."""
    return tuple(sorted(entries))


def with_seed(point: Settings, seed: int) -> Settings:
    """The same with another seed."""
    return settings({**dict(point), "tailoring.seed": seed}.items())


def words(point: Settings) -> str:
    """Settings as on the command line; the base has none."""
    return (
        ", ".join(f"{key.removeprefix('tailoring.')} = {as_text(value)}" for key, value in point) or "the scene's own"
    )


def as_text(value: Value) -> str:
    """A value as --set takes it."""
    return f"[{value[0]}, {value[1]}]" if isinstance(value, tuple) else str(value)


def _quality(own: str) -> Knob:
    points = (Point(name, () if name == own else settings([("tailoring.quality", name)])) for name in PRESETS)
    return Knob("quality", "Quality presets", tuple(points))


def _listed(key: str, title: str, known: Tailoring, name: str, values: Iterable[Value]) -> Knob:
    """A knob of [tailoring] that takes these values, and that of the base."""
    own = getattr(known, name)
    places = sorted({*values, own})
    points = (Point(f"{v}", () if v == own else settings([(f"tailoring.{name}", v)])) for v in places)
    return Knob(key, title, tuple(points))


def _scaled(
    key: str, title: str, known: Tailoring, name: str, shares: Iterable[float], room: tuple[int, int] = (1, 16_384)
) -> Knob:
    """The same, of such shares of the base's value, in so much room."""
    own, (least, most) = getattr(known, name), room
    return _listed(key, title, known, name, {v for s in shares if least <= (v := round(s * own)) <= most})


def _net(scene: Scene) -> Knob:
    """Nets of 2^k times as many spans: 129, 257, 513, 1025."""
    own = scene.lens.back.control_points
    points = [_of_net(m, own) for m in sorted({own, *_nets(own)})]
    return Knob("control_points", "Control points a side", tuple(points))


def _nets(own: int) -> Iterator[int]:
    for share in (1 / 4, HALF, 2, 4):
        if SMALLEST_NET <= (m := round(share * (own - 1)) + 1) <= LARGEST_NET:
            yield m


def _of_net(m: int, own: int) -> Point:
    return Point(str(m), () if m == own else settings([("lens.back.control_points", m)]))


def _pixels(scene: Scene) -> Knob:
    """A lens tailored to a coarser or a finer picture; it is judged by that of the base."""
    columns, rows = scene.target.columns_rows
    points = []
    for share in (1 / 4, HALF, 1, 2):
        size = round(share * columns), round(share * rows)
        if min(size) < 8 or max(size) > 4096:
            continue
        value = size[0] if columns == rows else size
        points.append(Point(as_text(value), () if share == 1 else settings([("target.pixels", value)])))
    return Knob("pixels", "Pixels tailored to", tuple(points))


def _precision(known: Tailoring) -> Knob:
    points = (
        Point(name, () if name == known.precision else settings([("tailoring.precision", name)]))
        for name in ("float32", "float64")
    )
    return Knob("precision", "Precision", tuple(points))


def _adam(known: Tailoring) -> Knob:
    """Wang et al.'s procedure with fewer steps than it has; its last point is the preset."""
    preset, own = PRESETS["paper"], known.quality == "paper"
    points = []
    for share in ADAM:
        steps = {name: round(share * preset[name]) for name in ("stage1_iterations", "stage2_iterations")}
        entries = {} if own else {"tailoring.quality": "paper"}
        entries |= {f"tailoring.{name}": count for name, count in steps.items()} if share < 1 else {}
        points.append(Point(f"{steps['stage1_iterations']} + {steps['stage2_iterations']}", settings(entries.items())))
    return Knob("adam", "Adam on control points, by rays", tuple(points))


def _together(
    key: str, title: str, scene: Scene, known: Tailoring, shares: Iterable[tuple[float, float, float]]
) -> Knob | None:
    """Tubes, evaluations and control points as such shares of the base's, in one go."""
    own, points = scene.lens.back.control_points, []
    for tubes, evaluations, net in shares:
        entries: dict[str, Value] = {}
        m = round(net * (own - 1)) + 1
        if not SMALLEST_NET <= m <= LARGEST_NET:
            continue
        if net != 1:
            entries["lens.back.control_points"] = m
        if tubes != 1:
            entries["tailoring.rays"] = round(tubes * known.rays)
        if evaluations != 1:
            entries["tailoring.stage2_iterations"] = max(1, round(evaluations * known.stage2_iterations))
        label = " × ".join(
            str(number)
            for number, turned in (
                (m, key.startswith("control")),
                (round(tubes * known.rays), True),
                (max(1, round(evaluations * known.stage2_iterations)), "evaluations" in key),
            )
            if turned
        )
        points.append(Point(label, settings(entries.items())))
    return Knob(key, title, tuple(points), combines=True)
