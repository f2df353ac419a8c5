"""Channels: light as a weighted sum of what one trace can carry.

A channel is one sample of the source at one wavelength: rays of one origin, in media of one index each.  A picture, a
merit and a ledger are sums over channels, E = Σ_k w_k E_k with Σ_k w_k = 1.  A scene without an extended source and
without a spectrum has one channel of weight 1.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from bstcad.optics.lens import Dimming, Lens
from bstcad.optics.sources import Source


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


def weighted_sum(channels: Sequence[Channel], values: Iterable[Any]) -> Any:
    """Σ_k w_k v_k of what each channel gives, tensors or numbers; of a single one it is that, to the last bit."""
    first, *others = (channel.weight * value for channel, value in zip(channels, values, strict=True))
    return sum(others, first)
