"""Channels: light as a weighted sum of parts that one trace each can carry.

A channel is one sample of the source at one wavelength: rays of one origin, in media of one index each.  A picture, a
merit and a ledger are sums over channels, E = Σ_k w_k E_k with Σ_k w_k = 1.  A scene without an extended source and
without a spectrum has one channel of weight 1.

The points of an extended source are shared out among its lines, so that n points stay n channels however many lines
there are (at least two a line).  The points of a line come in pairs, opposite each other about the middle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from bstcad.optics import sampling
from bstcad.optics.emitters import Emitter
from bstcad.optics.interfaces import Interface
from bstcad.optics.lens import Dimming, Lens


@dataclass(frozen=True)
class Channel:
    """One source in media of one index each."""

    source: Emitter  # its whole flux is 1
    index: float  # refractive index of the lens at the source's wavelength
    weight: float = 1.0  # part of all light; the weights of all channels sum to 1
    losses: Dimming | None = None  # losses at faces and in glass at its wavelength; None: there are none
    # interfaces before and behind the lens at its wavelength; None: those that the lens has
    around: tuple[tuple[Interface, ...], tuple[Interface, ...]] | None = None

    def through(self, lens: Lens) -> Lens:
        """The lens as this channel meets it."""
        before, behind = self.around or (lens.before, lens.behind)
        own = {"index": self.index, "losses": self.losses, "before": before, "behind": behind}
        return lens if all(getattr(lens, name) == value for name, value in own.items()) else replace(lens, **own)


def channels_of(source: Emitter, index: Callable[[float], float], points: int, draw: int = 0) -> tuple[Channel, ...]:
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
    return _elements(
        source, index, lambda share, k: sampling.in_pairs(source.extent, max(1, round(share * points / 2)), draw + k)
    )


def drawn_channels(source: Emitter, index: Callable[[float], float], points: int, seed: int) -> tuple[Channel, ...]:
    """The channels of an extended source at points drawn at random: pictures by them have its picture as their mean.

    points: of all lines together, at least one a line (sampling.scattered).
    """
    return _elements(
        source,
        index,
        lambda share, k: sampling.scattered(source.extent, max(1, round(share * points)), (seed << 8) + k),
    )


def _elements(source: Emitter, index: Callable[[float], float], places_of: Callable) -> tuple[Channel, ...]:
    """The light of each line shared evenly among points of the extent: places_of the line's share and its number."""
    elements = []
    for number, (nm, share) in enumerate(source.lines):
        places, n = places_of(share, number), index(nm)
        lights = (replace(source.element(x, y), wavelength=nm) for x, y in places)
        elements += [Channel(light, n, share / len(places)) for light in lights]
    return tuple(elements)


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


def places(channels: Sequence[Channel]) -> tuple[int, ...]:
    """For each channel the number of its source among the different ones of its line, from 0 on."""
    numbers = [0] * len(channels)
    for members in _lines(channels):
        known: dict[Emitter, int] = {}
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
    """Σ_k w_k v_k of one value a channel, tensors or numbers; a single channel's value keeps its bits."""
    first, *others = (channel.weight * value for channel, value in zip(channels, values, strict=True))
    return sum(others, first)
