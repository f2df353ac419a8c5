"""Errors in how a lens is made, mounted and lit: kinds by name with their effect on a setup, distributions, and trials.

Decentres and tilts are those of a part against all that stays; a lens tilts about its middle, a source about itself,
a screen about its own middle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from scipy.stats import norm

from bstcad.optics.channels import Channel
from bstcad.optics.lens import Lens
from bstcad.optics.media import refractive_index
from bstcad.optics.motion import Motion, turns_alike
from bstcad.optics.sources import Source
from bstcad.optics.surfaces import Sphere
from bstcad.tolerance import face_errors
from bstcad.tolerance.setup import Setup

Apply = Callable[[Setup, float], Setup]  # (as designed, amount) -> as made
SIGMAS = 2.0  # limit of a normal distribution in its standard deviations before the cut at the limit
FRONT = 100  # added to the seeds of the front's form: other fields than the back has
BAND = 20.0  # nm to either side of each line, over which the material's index must be known
# (expansion 1/K, dn/dT 1/K) at room temperature.  PMMA: Baeumer, Handbook of Plastic Optics (2nd ed. 2010), table 5.1;
# N-BK7: Schott's data sheet (α from -30 to 70 °C; Δn_rel/ΔT at 546 nm, 20 to 40 °C).
THERMAL = {"PMMA": (6.5e-5, -1.05e-4), "N-BK7": (7.1e-6, 3.0e-6)}


@dataclass(frozen=True)
class Kind:
    """One kind of error."""

    name: str  # as in scene files: "lens.decentre_x"
    words: str  # as in a report
    unit: str  # of its amounts; "" for a ratio
    apply: Apply


@dataclass(frozen=True)
class Perturbation:
    """One kind of error with its distribution about nominal."""

    kind: Kind
    limit: float  # ± (unit of the kind); of a random field its mean RMS
    distribution: Literal["normal", "uniform", "field"] = "normal"
    cost: float = 1.0  # of holding the limit, relative to the other errors

    @property
    def sigma(self) -> float:
        """Standard deviation.

        normal: cut at its limit, L = a s with a = 2: σ² = s² (1 - 2 a φ(a) / (2 Φ(a) - 1)); field: a mode of a random
        field, normal and not cut.
        """
        cut = 1 - 2 * SIGMAS * norm.pdf(SIGMAS) / (2 * norm.cdf(SIGMAS) - 1)
        ratios = {"uniform": 1 / math.sqrt(3), "field": 1.0, "normal": math.sqrt(cut) / SIGMAS}
        return self.limit * ratios[self.distribution]

    def amounts(self, even: np.ndarray) -> np.ndarray:
        """Amounts from numbers that are even in [0, 1), by the inverse of the distribution."""
        if self.distribution == "uniform":
            return self.limit * (2 * even - 1)
        if self.distribution == "field":
            return self.limit * norm.ppf(np.clip(even, 1e-12, None))
        low = norm.cdf(-SIGMAS)
        return self.limit * (norm.ppf(low + even * (1 - 2 * low)) / SIGMAS)


def trial(perturbations: Sequence[Perturbation], seed: int, number: int) -> np.ndarray:
    """Amounts (n,) of one trial, in the kinds' units; they depend on seed and number alone."""
    return draws(perturbations, np.random.default_rng((seed, number)).random(len(perturbations)))


def trials(perturbations: Sequence[Perturbation], seed: int, count: int) -> np.ndarray:
    """Amounts (count, n) of trials 0 … count - 1."""
    even = np.stack([np.random.default_rng((seed, k)).random(len(perturbations)) for k in range(count)])
    return draws(perturbations, even)


def draws(perturbations: Sequence[Perturbation], even: np.ndarray) -> np.ndarray:
    """Amounts (…, n) from numbers (…, n) that are even in [0, 1)."""
    return np.stack([p.amounts(even[..., k]) for k, p in enumerate(perturbations)], axis=-1)


def perturbed(setup: Setup, perturbations: Sequence[Perturbation], amounts: Sequence[float]) -> Setup:
    """The setup with these amounts, in the order of the perturbations; shapes before motions."""
    pairs = [(p.kind, float(a)) for p, a in zip(perturbations, amounts, strict=True) if a]
    motions = ("lens.decentre", "lens.tilt", "lens.axial", "lens.clocking", "source.", "screen.")
    for kind, amount in sorted(pairs, key=lambda pair: pair[0].name.startswith(motions)):
        setup = kind.apply(setup, amount)
    return setup


# --- the kinds --------------------------------------------------------------------------------------------------------


def kinds(setup: Setup, material: str | None = None) -> dict[str, Kind]:
    """All errors of a setup that have one amount, but those without effect there or of an unknown material."""
    return {kind.name: kind for part in (_motions(setup), _shapes(setup, material), _lights(setup)) for kind in part}


def _motions(setup: Setup) -> Iterator[Kind]:
    """Shifts along and turns about x, y and z of lens, source and screen."""
    collimated = all(c.source.kind == "collimated" and not c.source.tilted for c in setup.channels)
    round_light = all(turns_alike(channel.source) for channel in setup.channels)
    for part in ("lens", "source", "screen"):
        name = "mirror" if part == "lens" and setup.lens.reflects else part
        for k, axis in enumerate("xy"):
            words = f"decentre of the {name} in {axis}"
            yield Kind(f"{part}.decentre_{axis}", words, "mm", partial(_moved, part, k, False))
        if not (part == "source" and collimated):  # parallel light does not change along the axis
            yield Kind(f"{part}.axial", f"{name} along the axis", "mm", partial(_moved, part, 2, False))
        for k, axis in enumerate("xy"):
            yield Kind(f"{part}.tilt_{axis}", f"tilt of the {name} about {axis}", "deg", partial(_moved, part, k, True))
        if part == "screen" or (part == "lens" and round_light):  # round light hides it, other light cannot be turned
            yield Kind(f"{part}.clocking", f"clocking of the {name}", "deg", partial(_moved, part, 2, True))


def _moved(part: str, axis: int, turns: bool, setup: Setup, by: float) -> Setup:
    amounts = tuple(by if k == axis else 0.0 for k in range(3))
    return setup.moved(part, Motion.of(turn=amounts, about=setup.pivot(part)) if turns else Motion.of(shift=amounts))


def _shapes(setup: Setup, material: str | None) -> Iterator[Kind]:
    """Errors of the lens's shape, glass and temperature, and of the wavelength."""
    refracts = not setup.lens.reflects
    if refracts:
        yield Kind("lens.thickness", "thickness of the lens", "mm", _thicker)
        yield Kind("lens.index", "refractive index", "", _denser)
        yield Kind("lens.front_power", "sag of the front at its rim", "mm", _front_power)
    optic = "lens" if refracts else "mirror"
    yield Kind("lens.scale", f"scale of the {optic} (shrinkage)", "", lambda s, by: s.with_lens_scaled(1 + by))
    if material in THERMAL and refracts:
        yield Kind("temperature", f"temperature of the lens ({material})", "K", partial(_warmer, material))
    if material is not None and refracts and _disperses(material, setup):
        yield Kind("wavelength", "wavelength of the light", "nm", partial(_redder, material))


def _thicker(setup: Setup, by: float) -> Setup:
    back = setup.lens.back
    return replace(setup, lens=replace(setup.lens, back=back.moved(back.z + by)))


def _denser(setup: Setup, by: float) -> Setup:
    return setup.with_indices(lambda n: n + by)


def _front_power(setup: Setup, by: float) -> Setup:
    """A front whose rim stands higher by so much (mm): c + 2 by / R², R the farthest from the axis."""
    front, rim2 = setup.lens.front, sum(p * p for p in setup.lens.outline.farthest)
    if front.curvature is None:
        x, y = (np.linspace(*side, front.m) for side in (front.x, front.y))
        bent = face_errors.higher(front, by * (x[:, None] ** 2 + y[None, :] ** 2) / rim2)
    else:
        curvature = front.curvature + 2 * by / rim2
        bent = front.with_parameters(curvature=curvature) if front.curvature else Sphere(front.z, curvature)
    return replace(setup, lens=replace(setup.lens, front=bent))


def _warmer(material: str, setup: Setup, by: float) -> Setup:
    expansion, of_index = THERMAL[material]
    return setup.with_lens_scaled(1 + expansion * by).with_indices(lambda n: n + of_index * by)


def _disperses(material: str, setup: Setup) -> bool:
    """Is the material's index known around each line of the light?"""
    try:
        for nm in {channel.source.wavelength for channel in setup.channels}:
            refractive_index(material, nm - BAND), refractive_index(material, nm + BAND)
    except ValueError:
        return False
    return True


def _redder(material: str, setup: Setup, by: float) -> Setup:
    """Every line of the light longer by so much (nm); losses at faces and in the glass stay."""

    def change(channel: Channel) -> Channel:
        nm = channel.source.wavelength
        more = refractive_index(material, nm + by) - refractive_index(material, nm)
        return replace(channel, index=channel.index + more)

    return replace(setup, channels=tuple(change(channel) for channel in setup.channels))


def _lights(setup: Setup) -> Iterator[Kind]:
    """Errors of the cone and of the size of point sources."""
    sources = [channel.source for channel in setup.channels]
    if any(source.kind == "point" and (source.half_angle_1e2 or source.half_angle) for source in sources):
        yield Kind("source.angle", "width of the source's cone, relative", "", _wider)
    if len({source.place for source in sources}) > 1 and all(source.kind == "point" for source in sources):
        yield Kind("source.size", "size of the source, relative", "", _larger)


def _wider(setup: Setup, by: float) -> Setup:
    def change(source: Source) -> Source:
        name = "half_angle_1e2" if source.half_angle_1e2 else "half_angle"
        angle = math.radians(getattr(source, name))
        return replace(source, **{name: math.degrees(math.atan((1 + by) * math.tan(angle)))})

    return setup.with_sources(change)


def _larger(setup: Setup, by: float) -> Setup:
    middle = np.array(setup.pivot("source"))

    def change(source: Source) -> Source:
        return replace(source, position=tuple((middle + (1 + by) * (np.array(source.position) - middle)).tolist()))

    return setup.with_sources(change)


def form_error(lens: Lens, correlation_length: float, seed: int, face: str = "back") -> Kind:
    """A random field on the back or the front; amounts are its RMS (mm)."""
    front = face == "front"
    net = face_errors.as_net(lens.front, lens.outline) if front else lens.back
    field = face_errors.random_field(net, correlation_length, seed + FRONT * front, face_errors.inside(lens, net))
    words = f"form of the {face}, correlated over {correlation_length:.3g} mm (draw {seed})"
    return Kind(f"{face}.form_{seed}", words, "mm RMS", partial(_front_raised if front else _raised, field))


def ripple(lens: Lens, period: float, pattern: str) -> Kind:
    """Tool marks on the back; amounts are their RMS (mm)."""
    field = face_errors.ripple(lens.back, period, pattern, face_errors.inside(lens, lens.back))
    return Kind("back.ripple", f"{pattern} ripple of the back, period {period:g} mm", "mm RMS", partial(_raised, field))


def _front_raised(field: np.ndarray, setup: Setup, by: float) -> Setup:
    net = face_errors.as_net(setup.lens.front, setup.lens.outline)
    return replace(setup, lens=replace(setup.lens, front=face_errors.higher(net, by * field)))


def _raised(field: np.ndarray, setup: Setup, by: float) -> Setup:
    return replace(setup, lens=face_errors.raised(setup.lens, by * field))
