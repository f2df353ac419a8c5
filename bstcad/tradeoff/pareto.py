"""What the points of a sweep say: which nothing beats, what halving the error costs, where a knob stops paying.

Between two points of seconds t and error e the price of halving is the factor k = 2^(ln(t2/t1) / ln(e1/e2)): what the
time is multiplied by if the error goes on falling as it does from the one to the other.  Random rays, whose noise falls
as the root of their number, have k = 4; a step that costs more is dearer than that.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from bstcad.tradeoff.knobs import Knob, Settings, with_seed
from bstcad.tradeoff.runs import HERE, Record

SAME_TIME, SAME_ERROR = 1.08, 1.02  # factors below which nobody can tell: two runs alike differ by so much
PAYS = 4.0  # most that halving the error may cost: the price of random rays
FEWEST = 3  # runs that a price of halving is claimed from: two make a line whatever they are
MUCH = 2**0.5  # factor by which a step is to lower the error before it says what halving it costs


@dataclass(frozen=True)
class Place:
    """One place of a knob, over all its seeds: the medians, and the range of the error."""

    label: str
    settings: Settings
    seconds: float | None  # None: those of the runs do not compare
    rrmsd: float
    lowest: float
    highest: float
    seeds: int


@dataclass(frozen=True)
class Step:
    """From one place of a knob to the next one that was run, with more work."""

    before: Place
    after: Place
    halving: float | None  # k; None: the error does not fall

    @property
    def gain(self) -> float:
        """What the error is divided by."""
        return self.before.rrmsd / self.after.rrmsd

    @property
    def free(self) -> bool:
        """Does the error fall for no time that could be told?"""
        return self.halving is not None and self.after.seconds <= SAME_TIME * self.before.seconds

    @property
    def pays(self) -> bool:
        """Is it worth its time?"""
        return self.halving is not None and self.halving <= PAYS


@dataclass(frozen=True)
class Turned:
    """What turning a knob comes to."""

    knob: Knob
    places: tuple[Place, ...]  # that were run, from little work to much
    steps: tuple[Step, ...]
    to_base: Step | None  # the one that ends at the base
    from_base: Step | None  # the one that starts there
    stops_after: str | None  # label of the last place that pays; None: fewer than two places were run
    says: str  # that in words


def halving(t1: float, e1: float, t2: float, e2: float) -> float | None:
    """k of a step from time t1 and error e1 to t2 and e2; None: the error does not fall."""
    if not e2 * SAME_ERROR <= e1:
        return None
    return max(2.0 ** min(math.log(t2 / t1) / math.log(e1 / e2), 1000.0), 1.0)


def comparable(records: Iterable[Record]) -> list[Record]:
    """Those whose seconds compare: of this machine, on which one ran after the other."""
    return [record for record in records if record.done and record.where == HERE]


def front(records: Iterable[Record]) -> list[Record]:
    """The runs that none beats in both time and error, the quickest first."""
    found: list[Record] = []
    for record in sorted(comparable(records), key=lambda r: (r.seconds, r.rrmsd)):
        if not found or record.rrmsd < found[-1].rrmsd:
            found.append(record)
    return found


def along(front: Sequence[Record]) -> float | None:
    """k of the line through ln t and ln e of the front, by least squares; None: fewer than FEWEST runs, or no slope."""
    if len(front) < FEWEST:
        return None
    logs = [(math.log(record.rrmsd), math.log(record.seconds)) for record in front]
    e, t = (statistics.fmean(part) for part in zip(*logs, strict=True))
    across = sum((x - e) ** 2 for x, _ in logs)
    return 2.0 ** -(sum((x - e) * (y - t) for x, y in logs) / across) if across > 0 else None


def time_for(front: Sequence[Record], rrmsd: float) -> float | None:
    """Seconds after which the front has come to that error, between its points by the power law; None: never."""
    if not front or rrmsd < front[-1].rrmsd:
        return None
    for one, other in zip(front, front[1:], strict=False):
        if one.rrmsd >= rrmsd >= other.rrmsd:
            part = math.log(one.rrmsd / rrmsd) / math.log(one.rrmsd / other.rrmsd)
            return one.seconds * (other.seconds / one.seconds) ** part
    return front[0].seconds


def turned(knob: Knob, records: Mapping[Settings, Record], seeds: Sequence[int]) -> Turned:
    """What a knob came to; records: those whose times compare; seeds: beside the scene's own."""
    places = _places(knob, records, seeds)
    pairs = zip(places, places[1:], strict=False)
    steps = tuple(Step(a, b, halving(a.seconds, a.rrmsd, b.seconds, b.rrmsd)) for a, b in pairs)
    to_base = next((step for step in steps if not step.after.settings), None)
    from_base = next((step for step in steps if not step.before.settings), None)
    stops = _stops(places)
    return Turned(knob, places, steps, to_base, from_base, stops and stops.label, _says(knob, steps, stops))


def by_error(knob: Knob, records: Mapping[Settings, Record], seeds: Sequence[int]) -> Turned:
    """What a knob came to where seconds do not compare: errors, without steps and their prices."""
    places = tuple(replace(place, seconds=None) for place in _places(knob, records, seeds))
    return Turned(knob, places, (), None, None, None, _least(places))


def onward(turned: Turned) -> list[Step]:
    """From the base to each place of the knob with more work that was run."""
    base = next((i for i, place in enumerate(turned.places) if not place.settings), None)
    if base is None:
        return []
    start, further = turned.places[base], turned.places[base + 1 :]
    return [Step(start, at, halving(start.seconds, start.rrmsd, at.seconds, at.rrmsd)) for at in further]


def _places(knob: Knob, records: Mapping[Settings, Record], seeds: Sequence[int]) -> tuple[Place, ...]:
    return tuple(filter(None, (_place(point.label, point.settings, records, seeds) for point in knob.points)))


def _place(label: str, point: Settings, records: Mapping[Settings, Record], seeds: Sequence[int]) -> Place | None:
    """The medians over the seeds that were run; None: there is no lens."""
    wanted = (point, *(with_seed(point, seed) for seed in seeds))
    found = [records[each] for each in wanted if each in records and records[each].done]
    if not found:
        return None
    errors = [record.rrmsd for record in found]
    seconds = statistics.median(record.seconds for record in found)
    return Place(label, point, seconds, statistics.median(errors), min(errors), max(errors), len(found))


def _stops(places: Sequence[Place]) -> Place | None:
    """The place after which the knob no longer pays: the last one whose time is well spent from the one before it.

    Places between the two, where the error does not fall or not enough, are passed over.
    """
    if len(places) < 2:
        return None
    last = places[0]
    for place in places[1:]:
        k = halving(last.seconds, last.rrmsd, place.seconds, place.rrmsd)
        if k is not None and k <= PAYS:
            last = place
    return last


def _least(places: Sequence[Place]) -> str:
    """Which place has the least error, in words."""
    if len(places) < 2:
        return "fewer than two of its places were run"
    best, worst = (pick(places, key=lambda place: place.rrmsd) for pick in (min, max))
    if worst.rrmsd <= SAME_ERROR * best.rrmsd:
        return "changes nothing"
    return f"least error at {best.label}: × {best.rrmsd / worst.rrmsd:.2g} of that at {worst.label}"


def _same(step: Step) -> bool:
    """Nothing to be told changes."""
    errors = step.before.rrmsd, step.after.rrmsd
    return step.after.seconds <= SAME_TIME * step.before.seconds and max(errors) <= SAME_ERROR * min(errors)


def _says(knob: Knob, steps: Sequence[Step], stops: Place | None) -> str:
    """Where a knob stops paying, in words."""
    if stops is None:
        return "fewer than two of its places were run"
    left = [step for step in steps if step.before == stops]
    if not left:
        return f"pays up to {stops.label}, the most that was tried"
    step = left[0]
    start = f"pays up to {stops.label}" if stops != steps[0].before else f"{stops.label}, the least tried, will do"
    if step.halving is not None and len(steps) + 1 < FEWEST:
        took = step.after.seconds / step.before.seconds
        less = f"{step.after.label} has × {1 / step.gain:.2g} of the error of {step.before.label}"
        return f"{less} in × {took:.2g} of its time; two places give no price of halving"
    if step.halving is not None:
        return f"{start}; on to {step.after.label} halving costs {times(step.halving)}"
    if _same(step):
        return f"{start}; on to {step.after.label} changes nothing"
    worse = step.after.rrmsd > SAME_ERROR * step.before.rrmsd
    return f"{start}; on to {step.after.label} the error {'rises' if worse else 'does not fall'}"


def times(k: float) -> str:
    """A factor on the time, for people: × 2.3, × 38, over × 1000; without a line break in it."""
    size = "1000" if k > 1000 else f"{k:.0f}" if k >= 10 else f"{k:.2g}" if k >= 1.05 else "1"
    return f"{'over ' if k > 1000 else ''}×\u00a0{size}"
