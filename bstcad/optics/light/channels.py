"""Channels: the light as a weighted sum of parts, each of which is traced separately.

A channel is one sample point of the source at one wavelength, with the index of each medium at this wavelength.
Irradiance and flux ledger are sums over channels, E = Σ_k w_k E_k with Σ_k w_k = 1; RRMSD is computed from the sum.
A scene without an extended source and without a spectrum has one channel of weight 1.

The sample points of an extended source are divided among its spectral lines: n points give about n channels.  In
`channels_of` each line has at least two points, in pairs that are symmetric about the centre.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from bstcad.optics.lens.interfaces import Interface
from bstcad.optics.lens.lens import Lens, LensLosses
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.surfaces import sampling


@dataclass(frozen=True)
class Channel:
    """Simple source at one wavelength, with the index and the losses of the lens at this wavelength."""

    source: Emitter  # simple source of flux 1
    index: float  # refractive index of the lens at the wavelength of the channel
    weight: float = 1.0  # fraction of the flux in this channel; the weights of all channels sum to 1
    losses: LensLosses | None = None  # losses at faces and in glass at this wavelength; None: no losses
    # interfaces (before, behind) the lens at this wavelength; None: the interfaces of the lens itself
    around: tuple[tuple[Interface, ...], tuple[Interface, ...]] | None = None

    def through(self, lens: Lens) -> Lens:
        """Return the lens with the index, the losses and the surrounding interfaces of this channel."""
        before, behind = self.around or (lens.before, lens.behind)
        if (lens.index, lens.losses, lens.before, lens.behind) == (self.index, self.losses, before, behind):
            return lens
        return replace(lens, index=self.index, losses=self.losses, before=before, behind=behind)


@dataclass(frozen=True)
class SourceSampler:
    """Samples of a source: its channels for a set of rays, by (number of points of an extended source, seed)."""

    sample: Callable[[int, int], Sequence[Channel]]
    largest_side: int | None = None  # rays per side that a set can have, as a file has no more; None: any number

    def __call__(self, points: int, seed: int) -> Sequence[Channel]:
        """Return the channels."""
        return self.sample(points, seed)


def channels_of(source: Emitter, index: Callable[[float], float], points: int, number: int = 0) -> tuple[Channel, ...]:
    """Return the channels of a source; index(nm) is the refractive index of the lens.

    points: number of sample points of an extended source, all lines together, but at least two per line.  number:
    number of the set of points.  A point or parallel beam of one wavelength gives one channel, with `source` itself.
    """
    extent = source.extent
    if extent is None:
        central, lines = source.central, source.lines
        lights = (source if source == central else replace(central, wavelength=nm) for nm, _ in lines)
        return tuple(Channel(light, index(nm), fraction) for light, (nm, fraction) in zip(lights, lines, strict=True))

    def points_of(fraction: float, k: int) -> list[tuple[float, float]]:
        return sampling.point_pairs(extent, max(1, round(fraction * points / 2)), number + k)

    return _sample_extent(source, index, points_of)


def drawn_channels(source: Emitter, index: Callable[[float], float], points: int, seed: int) -> tuple[Channel, ...]:
    """Return channels at random points of an extended source; the mean of their pictures over many seeds is unbiased.

    points: number of sample points of all lines together, at least one per line (sampling.shifted_lattice).
    """
    extent = source.extent
    assert extent is not None  # a simple source has no points to sample

    def points_of(fraction: float, k: int) -> list[tuple[float, float]]:
        return sampling.shifted_lattice(extent, max(1, round(fraction * points)), (seed << 8) + k)

    return _sample_extent(source, index, points_of)


@dataclass(frozen=True, eq=False)
class GivenChannels:
    """Channels of the rays of a file, one for each spectral line, from a part that the seed selects."""

    source: Emitter
    index: Callable[[float], float]

    def __call__(self, seed: int) -> tuple[Channel, ...]:
        """Return the channels."""
        numbered = enumerate(self.source.lines)
        bundles = ((self.source.bundle(k, seed), nm, fraction) for k, (nm, fraction) in numbered)
        return tuple(Channel(bundle, self.index(nm), fraction) for bundle, nm, fraction in bundles if bundle)

    @property
    def largest_side(self) -> int:
        """Number n for which n x n rays of each line are about all rays of a part."""
        return max(channel.source.largest_side for channel in self(0))


def given_channels(source: Emitter, index: Callable[[float], float]) -> GivenChannels | None:
    """Return the channels of the rays of a file; None: a source without such rays."""
    return None if source.bundle(0) is None else GivenChannels(source, index)


def _sample_extent(source: Emitter, index: Callable[[float], float], points_of: Callable) -> tuple[Channel, ...]:
    """Return channels that divide the flux of each line equally among points_of(fraction of the flux, line number)."""
    elements = []
    for number, (nm, fraction) in enumerate(source.lines):
        points, n = points_of(fraction, number), index(nm)
        lights = (replace(source.element(x, y), wavelength=nm) for x, y in points)
        elements += [Channel(light, n, fraction / len(points)) for light in lights]
    return tuple(elements)


def merge_wavelengths(channels: Sequence[Channel]) -> tuple[Channel, ...]:
    """Merge channels that differ only in wavelength, which a mirror without losses reflects alike."""
    alike: dict[Channel, list[Channel]] = {}
    for channel in channels:
        key = replace(channel, source=replace(channel.source, wavelength=0.0), weight=0.0)
        alike.setdefault(key, []).append(channel)
    return tuple(replace(same[0], weight=math.fsum(c.weight for c in same)) for same in alike.values())


def source_numbers(channels: Sequence[Channel]) -> tuple[int, ...]:
    """Return for each channel the number, from 0, of its source among the different sources of its line."""
    numbers = [0] * len(channels)
    for members in _lines(channels):
        known: dict[Emitter, int] = {}
        for k in members:
            numbers[k] = known.setdefault(channels[k].source, len(known))
    return tuple(numbers)


def points_per_line(channels: Sequence[Channel]) -> int:
    """Return the largest number of sample points of a line; 1 for a simple source."""
    return max(source_numbers(channels)) + 1


def _lines(channels: Sequence[Channel]) -> list[list[int]]:
    """Return the numbers of the channels of each line: channels of one wavelength and one index."""
    lines: dict[tuple[float, float], list[int]] = {}
    for k, channel in enumerate(channels):
        lines.setdefault((channel.source.main_wavelength, channel.index), []).append(k)
    return list(lines.values())


def weighted_sum(channels: Sequence[Channel], values: Iterable[Any]) -> Any:
    """Return Σ_k w_k v_k of values v_k (tensors or numbers), one per channel; exactly v_1 if there is one channel."""
    pairs = zip(channels, values, strict=True)
    first, *others = (value if channel.weight == 1 else channel.weight * value for channel, value in pairs)
    return sum(others, first)
