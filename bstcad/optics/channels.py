"""Channels: light as a weighted sum of what one trace can carry.

A channel is one sample of the source at one wavelength: rays of one origin, in media of one index each.  A picture, a
merit and a ledger are sums over channels, E = Σ_k w_k E_k with Σ_k w_k = 1.  A scene without an extended source and
without a spectrum has one channel of weight 1.

The points of an extended source are shared out among its lines, so that n points stay n channels however many lines
there are (at least two a line).  Those of a line lie in pairs opposite each other, one behind the other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from bstcad.optics import sampling
from bstcad.optics.lens import Dimming, Lens
from bstcad.optics.sources import Source

MANY = 8  # pairs of points, from which on a quadratic function does not take most of what halves differ in
SAME = 1e-6  # of its own size: what is left of a function that those before it make up


@dataclass(frozen=True)
class Channel:
    """One source in media of one index each."""

    source: Source  # its whole flux is 1
    index: float  # of the lens at the source's wavelength
    weight: float = 1.0  # part of all light; the weights of all channels sum to 1
    losses: Dimming | None = None  # what faces and glass take of light of its wavelength; None: nothing

    def through(self, lens: Lens) -> Lens:
        """The lens as this channel meets it."""
        same = lens.index == self.index and lens.losses == self.losses
        return lens if same else replace(lens, index=self.index, losses=self.losses)


def channels_of(source: Source, index: Callable[[float], float], points: int, draw: int = 0) -> tuple[Channel, ...]:
    """The channels of a source; index: of the lens, by the wavelength (nm).

    points: of an extended source, at least two; draw: another number, other points.  A point or a parallel beam of one
    line is one channel, with the source itself.
    """
    if source.extent is None:
        simple = source == source.central
        lights = (
            (source if simple else replace(source.central, wavelength=nm), nm, share) for nm, share in source.lines
        )
        return tuple(Channel(light, index(nm), share) for light, nm, share in lights)
    found = []
    for number, (nm, share) in enumerate(source.lines):
        pairs = max(1, round(share * points / 2))
        for x, y in sampling.in_pairs(source.extent, pairs, draw + number):
            found.append(Channel(replace(source.element(x, y), wavelength=nm), index(nm), share / (2 * pairs)))
    return tuple(found)


def merged(channels: Sequence[Channel]) -> tuple[Channel, ...]:
    """The same light with channels that differ in wavelength alone taken together, as at a mirror without losses."""
    alike: dict[Channel, list[Channel]] = {}
    for channel in channels:
        alike.setdefault(replace(channel, source=replace(channel.source, wavelength=0.0), weight=0.0), []).append(
            channel
        )
    return tuple(
        same[0] if len(same) == 1 else replace(same[0], weight=math.fsum(c.weight for c in same))
        for same in alike.values()
    )


def contrast(channels: Sequence[Channel]) -> tuple[float, ...]:
    """σ_k such that the deviation of E = Σ_k w_k E_k from all of the source is no more than about |Σ_k σ_k w_k E_k|.

    Half of the pairs of points of each line against the other half, as for two halves of the rays: with a and b of
    them σ = sqrt(b/a) and -sqrt(a/b).  What halves differ in and the whole is right in, the second moments of the
    places, is taken out of σ, and Σ σ² kept.  Zero in a line with less than two pairs; () if that holds for every line.
    """
    signs = [0.0] * len(channels)
    for members in _lines(channels):
        b = len(members) // 4
        a = len(members) // 2 - b
        halves = [-math.sqrt(a / b) if at // 2 % 2 else math.sqrt(b / a) for at in range(len(members) if b else 0)]
        if a + b >= MANY:
            halves = _without_moments(halves, [channels[k].source.place for k in members])
        for k, sign in zip(members, halves, strict=False):
            signs[k] = sign
    return tuple(signs) if any(signs) else ()


def _without_moments(signs: list[float], places: list[tuple[float, float, float]]) -> list[float]:
    """The signs without the part that a quadratic function of the places has in them (Gram-Schmidt), as long as before.

    Of every such function over the source the sum is exact (sampling.in_pairs).
    """
    middle = [math.fsum(p) / len(places) for p in zip(*places, strict=True)]
    x, y, z = zip(*([p - m for p, m in zip(place, middle, strict=True)] for place in places), strict=True)
    one = [1.0] * len(places)
    basis: list[list[float]] = []
    for left, right in ((one, one), (x, x), (y, y), (z, z), (x, y), (y, z), (z, x)):
        function = [u * v for u, v in zip(left, right, strict=True)]
        rest = _orthogonal(function, basis)
        size = math.sqrt(math.fsum(r * r for r in rest))
        if size > SAME * math.sqrt(math.fsum(f * f for f in function)) > 0:
            basis.append([r / size for r in rest])
    rest = _orthogonal(signs, basis)
    return [r * math.sqrt(len(rest) / math.fsum(q * q for q in rest)) for r in rest]


def _orthogonal(vector: list[float], basis: list[list[float]]) -> list[float]:
    for unit in basis:
        along = math.fsum(v * u for v, u in zip(vector, unit, strict=True))
        vector = [v - along * u for v, u in zip(vector, unit, strict=True)]
    return vector


def places(channels: Sequence[Channel]) -> tuple[int, ...]:
    """For each channel the number of its source among the different ones of its line, from 0 on."""
    numbers = [0] * len(channels)
    for members in _lines(channels):
        known: dict[Source, int] = {}
        for k in members:
            numbers[k] = known.setdefault(channels[k].source, len(known))
    return tuple(numbers)


def points(channels: Sequence[Channel]) -> int:
    """At how many places on the source a line begins, at most; 1 of a simple source."""
    return max(places(channels)) + 1


def _lines(channels: Sequence[Channel]) -> list[list[int]]:
    """Which channels are of one line: of one wavelength and one index."""
    lines: dict[tuple[float, float], list[int]] = {}
    for k, channel in enumerate(channels):
        lines.setdefault((channel.source.wavelength, channel.index), []).append(k)
    return list(lines.values())


def weighted_sum(channels: Sequence[Channel], values: Iterable[Any]) -> Any:
    """Σ_k w_k v_k of what each channel gives, tensors or numbers; of a single one it is that, to the last bit."""
    first, *others = (channel.weight * value for channel, value in zip(channels, values, strict=True))
    return sum(others, first)
