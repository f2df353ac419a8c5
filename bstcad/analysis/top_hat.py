"""The numbers that laser users read of a flat-top beam: flatness, uniformity, edge steepness, and the light in place.

The terms are those of ISO 13694:2018 as public summaries define them; the text of the standard was not read.  The
summaries are, for all terms, the documentation of BeamProfiler (github.com/wagnojunior/beamprofiler), which names
Bragança and Kim, Opt. Eng. 60, 060801 (2021) as a tutorial; and for the plateau uniformity an article of DataRay
(dataray.com/blogs/dataray-blog/flat-top-beams-and-plateau-uniformity-calculations).

E(x, y) is the irradiance, on any scale, and η a level between 0 and 1.  What lies above η E_max counts as the beam:

E_max             maximum; here of the picture's running median over 3 x 3 pixels, so that neither a hot pixel nor the
                  noise of many makes it.  It keeps plateaus and straight edges, takes 2 to 5 h² / w² from the peak of
                  a Gaussian of 1/e² radius w by pixels of a side h, and adds 1.6 σ by noise of σ a pixel
A_η               clip-level irradiation area, of all pixels of the picture itself with E > η E_max
P_η               clip-level power, ∫ E dA over A_η
f_η = P_η / P     fractional power, P = ∫ E dA over the picture
E_η = P_η / A_η   clip-level average power density
F_η = E_η / E_max                                flatness factor: 1 if even
U_η = sqrt(1 / A_η ∫ (E - E_η)² dA) / E_η        beam uniformity, over A_η: 0 if even
U_P = ΔE / E_max                                 plateau uniformity, ΔE the full width at half maximum of the peak that
                                                 the histogram of E has near E_max: 0 if even, 1 without a plateau
s_ηε = (A_ε - A_η) / A_ε, ε < η                  edge steepness: 0 if upright
efficiency                                       share of all light inside the wanted outline; no term of the standard

At η = 0.9 no flatness is below 0.9, nor, but for pixels brighter than E_max, a uniformity above 0.06: read them with
the fractional power, or at a lower η.  Hot pixels count in powers, averages and uniformity.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

FLAT, EDGE = 0.9, 0.1  # η and ε
MEDIAN = 3  # pixels, a side of the median's window
PLATEAU = 0.5  # of E_max, above which the histogram's peak is looked for
HOTTEST = 2.0  # of E_max, as far as the histogram goes; hot pixels lie beyond
FINEST = 1000  # bins up to E_max at most: no plateau uniformity is less than one of them


@dataclass(frozen=True)
class TopHat:
    """The numbers of one picture; powers in the picture's unit times mm²."""

    eta: float  # η, the level of the flat part
    epsilon: float  # ε, the level at the foot of the edge
    maximum: float  # E_max, in the picture's unit
    power: float  # P
    clip_level_area: float  # A_η (mm²)
    clip_level_power: float  # P_η
    plateau_uniformity: float  # U_P
    uniformity: float  # U_η
    edge_steepness: float  # s_ηε
    efficiency: float | None = None  # share of all light inside the wanted outline; None: none was given

    @property
    def fractional_power(self) -> float:
        """f_η = P_η / P."""
        return self.clip_level_power / self.power

    @property
    def average(self) -> float:
        """E_η = P_η / A_η, in the picture's unit."""
        return self.clip_level_power / self.clip_level_area

    @property
    def flatness(self) -> float:
        """F_η = E_η / E_max."""
        return self.average / self.maximum


def top_hat(
    picture: np.ndarray, pixel: tuple[float, float], wanted: np.ndarray | None = None, *,
    eta: float = FLAT, epsilon: float = EDGE, on_picture: float = 1.0,
) -> TopHat:  # fmt: skip
    """The numbers of a picture (rows, columns): irradiance, or flux a pixel, on any scale.

    pixel: its width and height (mm).  wanted: the share of each pixel inside the wanted outline, shaped like the
    picture, for the efficiency Σ wanted E / Σ E times on_picture, the share of all light that the picture holds.
    Noise of mean zero may make pixels negative.  ValueError if a number is not finite, or if there is no light.
    """
    if not 0 < epsilon < eta < 1:
        raise ValueError(f"levels {epsilon:g} and {eta:g} are no foot and flat part; give 0 < epsilon < eta < 1")
    e = np.asarray(picture, dtype=np.float64)
    if not np.isfinite(e).all():
        raise ValueError("the picture has values that are not finite; put 0 where nothing is known")
    maximum, light = _maximum(e), float(e.sum())
    if not (maximum > 0 and light > 0):
        raise ValueError("the picture has no light, or none that fills five of 3 x 3 pixels; give more light or pixels")
    area = pixel[0] * pixel[1]
    flat, foot = e[e > eta * maximum], int((e > epsilon * maximum).sum())
    return TopHat(
        eta, epsilon, maximum, power=light * area, clip_level_area=flat.size * area,
        clip_level_power=float(flat.sum()) * area, plateau_uniformity=plateau_uniformity(e, maximum),
        uniformity=float(flat.std() / flat.mean()), edge_steepness=(foot - flat.size) / foot,
        efficiency=None if wanted is None else float((wanted * e).sum()) / light * on_picture,
    )  # fmt: skip


def _maximum(e: np.ndarray) -> float:
    """E_max: the largest median of 3 x 3 pixels; beyond the border the picture goes on as at the border."""
    from scipy.ndimage import median_filter  # which a mere import of bstcad need not load

    return float(median_filter(e, MEDIAN, mode="nearest").max())


def plateau_uniformity(e: np.ndarray, maximum: float) -> float:
    """U_P = ΔE / E_max by the histogram of irradiance E (any shape), 1 at most.

    Bins are as wide as Freedman and Diaconis (1981) have it for the pixels above E_max / 2, n of them:
    2 IQR n^-1/3, no finer than E_max / FINEST.  From the highest bin above E_max / 2 the half maximum is looked for on
    either side, between the middles of two bins.  Without a plateau the pixels grow in number down to E = 0.
    """
    upper = e[e > PLATEAU * maximum]
    low, high = np.quantile(upper, (0.25, 0.75))
    width = max(2 * (high - low) / np.cbrt(upper.size), maximum / FINEST)
    up = np.ceil((min(float(upper.max()), HOTTEST * maximum) - maximum) / width)
    edges = maximum + width * np.arange(0.5 - np.ceil(maximum / width), up + 1.0)  # E_max in the middle of a bin
    count, _ = np.histogram(e[e > 0], edges)
    middle = (edges[1:] + edges[:-1]) / 2
    peak = int(np.where(middle > PLATEAU * maximum, count, -1).argmax())
    below, above = (_half_width(side, count[peak] / 2) for side in (count[peak::-1], count[peak:]))
    return float(min((below + above) * width / maximum, 1.0))


def _half_width(count: np.ndarray, half: float) -> float:
    """Bins from the first to where the count falls to `half`; past the last bin there is nothing."""
    count = np.append(count, 0)
    k = int((count < half).argmax())
    return k - (half - count[k]) / (count[k - 1] - count[k])


@dataclass(frozen=True)
class FlatTop:
    """The light on a target whose profile is flat, as a report has it: levels are parts of the maximum."""

    key: str  # target, target[0], …
    uniformity: float  # U_0.9: RMS deviation over the mean, where the light is above 0.9; 0: even
    plateau_uniformity: float  # U_P: width of the histogram's peak over the maximum; 0: even
    flatness: float  # F_0.9: mean over maximum, where the light is above 0.9; 1: even
    fractional_power: float  # f_0.9: of the light on the target, above 0.9
    edge_steepness: float  # s: part of the area above 0.1 that is not above 0.9; 0: upright
    efficiency: float  # of the source's flux, inside the profile; of a super-Gaussian, where it asks for 0.9 or more

    @classmethod
    def of(
        cls, key: str, picture: np.ndarray, pixel: tuple[float, float], inside: np.ndarray, on_picture: float
    ) -> FlatTop:
        """Of a picture whose pixels are so wide and high (mm); inside: their shares within the profile."""
        found = top_hat(picture, pixel, inside, on_picture=on_picture)
        return cls(key, **{each.name: float(getattr(found, each.name)) for each in fields(cls) if each.name != "key"})
