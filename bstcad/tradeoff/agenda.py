"""In which order the runs of a sweep come: what matters most first, so that any budget is well spent."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from bstcad.scene.scene import Scene
from bstcad.tradeoff.knobs import Knob, Settings, with_seed
from bstcad.tradeoff.runs import Record

FURTHER = (2, 3, 4)  # places from the base
MORE_SEEDS = 2  # beside the scene's own
Find = Callable[[Settings], Record | None]


def seeds(scene: Scene) -> tuple[int, ...]:
    """Other seeds than the scene's."""
    return tuple(scene.tailoring.seed + 1 + i for i in range(MORE_SEEDS))


def agenda(scene: Scene, knobs: Sequence[Knob], find: Find) -> list[Settings]:
    """All runs, the most important first; which of them need more seeds is known once it was measured."""
    return list(dict.fromkeys(_in_order(scene, {knob.key: knob for knob in knobs}, find)))


def _in_order(scene: Scene, knobs: Mapping[str, Knob], find: Find) -> Iterator[Settings]:
    presets = {point.label: point.settings for point in knobs["quality"].points}
    probe = {method: other for method, (_, other) in probes(scene, knobs).items()}
    paper = presets.get("paper", ())  # minutes: it comes last
    single = [knob for knob in knobs.values() if not knob.combines and knob.key != "quality"]
    both = [knob for knob in knobs.values() if knob.combines]
    yield presets.get("draft", ())
    yield ()
    yield presets.get("standard", ())
    yield from _at(single, -1, paper)
    yield probe.get("least-squares", ())
    yield from _at(both, -1, paper)
    yield from _at(single, +1, paper)
    yield presets.get("fine", ())
    yield from _at(both, +1, paper)
    yield probe.get("adam", ())
    yield from (point for away in FURTHER for point in _at(single, -away, paper))
    yield from (point for away in FURTHER for sign in (+1, -1) for point in _at((*single, *both), sign * away, paper))
    yield from _seeded(scene, knobs, find)
    yield paper


def _at(knobs: Sequence[Knob], away: int, paper: Settings) -> Iterator[Settings]:
    """The places of some knobs so far from the base, where there are any; of one without a base so far from its start.

    Of such a knob the first place counts as the base's neighbour with less work, the next as that with more.
    """
    for knob in knobs:
        start = knob.base if knob.base is not None else 1 if away == -1 else 0 if away > 0 else -1
        index = start + away
        if 0 <= index < len(knob.points) and knob.points[index].settings != paper:
            yield knob.points[index].settings


def probes(scene: Scene, knobs: Mapping[str, Knob]) -> dict[str, tuple[Settings, Settings]]:
    """For each method a cheap run, and the same with another seed: do they end with the same lens?"""
    presets = {point.label: point.settings for point in knobs["quality"].points}
    quick = {"least-squares": presets["draft"]} if "draft" in presets else {}
    if "adam" in knobs:
        quick["adam"] = knobs["adam"].points[0].settings
    other = seeds(scene)[0]
    return {method: (point, with_seed(point, other)) for method, point in quick.items()}


def touched(scene: Scene, knobs: Sequence[Knob], find: Find) -> dict[str, bool | None]:
    """For each method whether the seed matters; None: that was not measured."""
    found: dict[str, bool | None] = {}
    for method, pair in probes(scene, {knob.key: knob for knob in knobs}).items():
        one, other = map(find, pair)
        found[method] = one.net != other.net if one and other and one.done and other.done else None
    return found


def method_of(scene: Scene, point: Settings) -> str:
    """The method of a run."""
    changes = dict(point)
    own = changes.get("tailoring.quality", scene.tailoring.quality)
    given = changes.get("tailoring.method", scene.tailoring.method)
    return given or ("adam" if own == "paper" else "least-squares")


def _seeded(scene: Scene, knobs: Mapping[str, Knob], find: Find) -> Iterator[Settings]:
    """More seeds for what was run and what they matter for, the quickest first."""
    matter = touched(scene, list(knobs.values()), find)
    ran = {point.settings: find(point.settings) for knob in knobs.values() for point in knob.points}
    done = sorted((record.seconds, point) for point, record in ran.items() if record is not None and record.done)
    for seed in seeds(scene):
        yield from (with_seed(point, seed) for _, point in done if matter.get(method_of(scene, point)))
