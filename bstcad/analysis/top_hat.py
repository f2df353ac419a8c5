"""Figures of a flat-top beam: flatness, uniformity, edge steepness, efficiency.

The terms are those of ISO 13694:2018 as public summaries define them; the text of the standard was not read.  The
summaries are, for all terms, the documentation of BeamProfiler (github.com/wagnojunior/beamprofiler), which names
Bragança and Kim, Opt. Eng. 60, 060801 (2021) as a tutorial; and for the plateau uniformity an article of DataRay
(dataray.com/blogs/dataray-blog/flat-top-beams-and-plateau-uniformity-calculations).

E(x, y) is the irradiance, on any scale, and η a level between 0 and 1.  Pixels above η E_max count as the beam:

E_max             maximum; here of the running median over 3 x 3 pixels, so that neither a hot pixel nor noise
                  determines it.  The median preserves plateaus and straight edges, lowers the peak of a Gaussian of
                  1/e² radius w by 2 to 5 h² / w² of its height (pixels of side h); noise of RMS σ raises E_max by 1.6 σ
A_η               clip-level irradiation area: all pixels of the unfiltered picture with E > η E_max
P_η               clip-level power, ∫ E dA over A_η
f_η = P_η / P     fractional power, P = ∫ E dA over the picture
E_η = P_η / A_η   clip-level average power density
F_η = E_η / E_max                                flatness factor: 1 if uniform
U_η = sqrt(1 / A_η ∫ (E - E_η)² dA) / E_η        beam uniformity, over A_η: 0 if uniform
U_P = ΔE / E_max                                 plateau uniformity, ΔE the full width at half maximum of the peak of
                                                 the histogram of E near E_max: 0 if uniform, 1 without a plateau
s_ηε = (A_ε - A_η) / A_ε, ε < η                  edge steepness: 0 if vertical
efficiency                                       fraction of all light inside a given outline; not in the standard

At η = 0.9 any beam has a flatness of at least 0.9 and, except for pixels brighter than E_max, a uniformity of at most
0.06, so read them with the fractional power, or at a lower η.  Hot pixels count in powers, averages and uniformity.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

FLAT_LEVEL, EDGE_LEVEL = 0.9, 0.1  # default levels η and ε
MEDIAN_PIXELS = 3  # side of the window of the median (pixels)
PLATEAU_LEVEL = 0.5  # level, relative to E_max, above which the peak of the histogram is sought
HISTOGRAM_END = 2.0  # upper end of the histogram, relative to E_max; hot pixels are above it
MAX_BINS = 1000  # largest number of bins up to E_max: the plateau uniformity is resolved to 1 / MAX_BINS


@dataclass(frozen=True)
class TopHat:
    """Figures of one picture; powers in the picture's unit times mm²."""

    eta: float  # level η of the flat part
    epsilon: float  # level ε at the foot of the edge
    maximum: float  # maximum E_max, in the picture's unit
    power: float  # total power P
    clip_level_area: float  # area A_η (mm²)
    clip_level_power: float  # power P_η
    plateau_uniformity: float  # plateau uniformity U_P
    uniformity: float  # uniformity U_η
    edge_steepness: float  # edge steepness s_ηε
    efficiency: float | None = None  # fraction of all light inside the outline; None: no outline was given

    @property
    def fractional_power(self) -> float:
        """Fractional power f_η = P_η / P."""
        return self.clip_level_power / self.power

    @property
    def average(self) -> float:
        """Average irradiance E_η = P_η / A_η, in the picture's unit."""
        return self.clip_level_power / self.clip_level_area

    @property
    def flatness(self) -> float:
        """Flatness factor F_η = E_η / E_max."""
        return self.average / self.maximum


def top_hat(
    picture: np.ndarray, pixel: tuple[float, float], wanted: np.ndarray | None = None, *,
    eta: float = FLAT_LEVEL, epsilon: float = EDGE_LEVEL, on_picture: float = 1.0,
) -> TopHat:  # fmt: skip
    """Return the figures of a picture (rows, columns): irradiance, or flux per pixel, on any scale.

    pixel: width and height of a pixel (mm).  wanted: fraction of each pixel inside the outline, (rows, columns), for
    the efficiency on_picture Σ wanted E / Σ E; on_picture: fraction of all light that is in the picture.  Noise of mean
    zero may make pixels negative.  ValueError if a value is not finite, without light, or unless 0 < epsilon < eta < 1.
    """
    if not 0 < epsilon < eta < 1:
        raise ValueError(f"epsilon = {epsilon:g} and eta = {eta:g} are not possible levels; give 0 < epsilon < eta < 1")
    e = np.asarray(picture, dtype=np.float64)
    if not np.isfinite(e).all():
        raise ValueError("the picture has values that are not finite; give 0 for unknown pixels")
    maximum, light = _maximum(e), float(e.sum())
    if not (maximum > 0 and light > 0):
        raise ValueError("the picture has no light, or no 3 x 3 pixels with five lit; give more light or more pixels")
    area = pixel[0] * pixel[1]
    flat, foot = e[e > eta * maximum], int((e > epsilon * maximum).sum())
    return TopHat(
        eta, epsilon, maximum, power=light * area, clip_level_area=flat.size * area,
        clip_level_power=float(flat.sum()) * area, plateau_uniformity=plateau_uniformity(e, maximum),
        uniformity=float(flat.std() / flat.mean()), edge_steepness=(foot - flat.size) / foot,
        efficiency=None if wanted is None else float((wanted * e).sum()) / light * on_picture,
    )  # fmt: skip


def _maximum(e: np.ndarray) -> float:
    """Return E_max, the largest median of 3 x 3 pixels; the picture continues with its border values."""
    from scipy.ndimage import median_filter  # loaded only when needed

    return float(median_filter(e, MEDIAN_PIXELS, mode="nearest").max())


def plateau_uniformity(e: np.ndarray, maximum: float) -> float:
    """Return U_P = ΔE / E_max, at most 1, by the histogram of the irradiance e (of any shape); maximum: E_max.

    The width of the bins is that of Freedman and Diaconis (1981) for the n pixels above E_max / 2, 2 IQR n^-1/3, and at
    least E_max / MAX_BINS.  From the fullest bin above E_max / 2 the half maximum is sought on each side, interpolated
    between the centres of bins.  Without a plateau the counts rise towards E = 0, to which the peak extends.
    """
    upper = e[e > PLATEAU_LEVEL * maximum]
    low, high = np.quantile(upper, (0.25, 0.75))
    width = max(2 * (high - low) / np.cbrt(upper.size), maximum / MAX_BINS)
    up = np.ceil((min(float(upper.max()), HISTOGRAM_END * maximum) - maximum) / width)
    edges = maximum + width * np.arange(0.5 - np.ceil(maximum / width), up + 1.0)  # E_max is at the centre of a bin
    count, _ = np.histogram(e[e > 0], edges)
    middle = (edges[1:] + edges[:-1]) / 2
    peak = int(np.where(middle > PLATEAU_LEVEL * maximum, count, -1).argmax())
    below, above = (_half_width(side, count[peak] / 2) for side in (count[peak::-1], count[peak:]))
    return float(min((below + above) * width / maximum, 1.0))


def _half_width(count: np.ndarray, half: float) -> float:
    """Return the number of bins, interpolated, from the first to where the count falls to `half`."""
    count = np.append(count, 0)
    k = int((count < half).argmax())
    return k - (half - count[k]) / (count[k - 1] - count[k])


@dataclass(frozen=True)
class FlatTop:
    """Figures of the light on a target with a flat profile, as in the report; levels relative to the maximum."""

    key: str  # key of the target: target, target[0], …
    uniformity: float  # U_0.9: RMS deviation divided by the mean, where the light is above 0.9; 0 if uniform
    plateau_uniformity: float  # U_P: width of the histogram's peak, divided by the maximum; 0 if uniform
    flatness: float  # F_0.9: mean divided by maximum, where the light is above 0.9; 1 if uniform
    fractional_power: float  # f_0.9: fraction of the light on the target that is above 0.9
    edge_steepness: float  # s: fraction of the area above 0.1 that is not above 0.9; 0 if vertical
    efficiency: float  # fraction of the source's flux inside the profile (super-Gaussian: where this exceeds 0.9)

    @classmethod
    def of(
        cls, key: str, picture: np.ndarray, pixel: tuple[float, float], inside: np.ndarray, on_picture: float
    ) -> FlatTop:
        """Return a picture's figures; inside: fraction of each pixel in the profile; others: as in `top_hat`."""
        found = top_hat(picture, pixel, inside, on_picture=on_picture)
        return cls(key, **{each.name: float(getattr(found, each.name)) for each in fields(cls) if each.name != "key"})
