"""Errors in how a lens is made, mounted and lit: kinds by name with their effect on a setup, distributions, and trials.

A setup is traced in the lens's own frame.  Decentres and tilts are those of a part against all that stays; a lens tilts
about its middle, a source about itself, a screen about its own middle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
import torch
from scipy import fft
from scipy.ndimage import fourier_gaussian
from scipy.stats import norm

from bstcad.optics.bspline import BSplineSurface, interpolated
from bstcad.optics.channels import Channel
from bstcad.optics.emitters import Emitter
from bstcad.optics.interfaces import Interface
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.measure import tubes_picture
from bstcad.optics.media import refractive_index
from bstcad.optics.motion import Motion
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import Vector
from bstcad.optics.sides import in_words
from bstcad.optics.surfaces import Surface
from bstcad.optics.tilted import Tilted
from bstcad.scene.errors import SceneError

# --- the setup --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Setup:
    """Lens, light and screen to be traced; lengths in mm."""

    lens: Lens
    channels: tuple[Channel, ...]
    screen: Screen
    placed: Motion | None = None  # of the lens in the room, where a wanted wave stays; None: it is where it was

    def pivot(self, part: str) -> Vector:
        """Point about which a part ("lens", "source", "screen") tilts.

        Of the lens half way between its faces' vertices (of a mirror in air the vertex), of the source the weighted
        mean of its points or the middle of its aperture, of the screen its middle.
        """
        if part == "screen":
            return self.screen.middle
        if part == "lens":
            back = float(self.lens.back.plain().from_vertex().z)
            return 0.0, 0.0, (self.lens.front.z + back) / 2 if "front" in self.lens.passes.faces else back
        points = [channel.source.starts(self.lens.entrance.z) for channel in self.channels]
        mean = np.average(points, axis=0, weights=[channel.weight for channel in self.channels])
        return tuple(mean.tolist())

    def picture(self, tubes: int) -> np.ndarray:
        """(rows, columns) flux in each pixel of the screen, row 0 = y max, by tubes x tubes a channel."""
        return tubes_picture(self.lens, self.channels, self.screen, tubes, over_the_back=True).cpu().numpy()

    def moved(self, part: str, motion: Motion) -> Setup:
        """With its lens, source or screen moved; seen from a moved lens, all else moves the other way."""
        if part == "lens":
            around = self.moved("source", motion.inverse).moved("screen", motion.inverse)._with_elements(motion.inverse)
            return replace(around, placed=motion if self.placed is None else self.placed.after(motion))
        if part == "screen":
            return replace(self, screen=self.screen.moved(motion))
        try:
            return self.with_sources(lambda source: source.moved(motion, self.lens.entrance.z))
        except NotImplementedError as error:  # an emitter of one's own
            raise SceneError(f"tolerance: {error}, or name errors with which it stays where it is") from None

    def _with_elements(self, motion: Motion) -> Setup:
        """With the faces of windows and mirrors around the lens moved; their rims stay about the axis of the lens."""
        if not (self.lens.before or self.lens.behind):
            return self

        def moved(interfaces: tuple[Interface, ...]) -> tuple[Interface, ...]:
            return tuple(replace(i, surface=Tilted.of(i.surface).moved_by(motion)) for i in interfaces)

        lens = replace(self.lens, before=moved(self.lens.before), behind=moved(self.lens.behind))
        own = ((c, c.around and (moved(c.around[0]), moved(c.around[1]))) for c in self.channels)
        return replace(self, lens=lens, channels=tuple(replace(c, around=around) for c, around in own))

    def with_sources(self, change: Callable[[Emitter], Emitter]) -> Setup:
        """With each channel's source changed."""
        return replace(self, channels=tuple(replace(c, source=change(c.source)) for c in self.channels))

    def with_indices(self, change: Callable[[float], float]) -> Setup:
        """With each refractive index of the lens changed."""
        channels = tuple(replace(c, index=change(c.index)) for c in self.channels)
        return replace(self, lens=replace(self.lens, index=change(self.lens.index)), channels=channels)

    def with_lens_scaled(self, factor: float) -> Setup:
        """With its lens larger by a factor about its pivot."""
        lens, (_, _, about) = self.lens, self.pivot("lens")
        faces = {"front": lens.front.scaled(factor, about), "back": lens.back.scaled(factor, about)}
        clear = lens.clear and tuple(aperture.scaled(factor) for aperture in lens.clear)
        return replace(self, lens=replace(lens, outline=lens.outline.scaled(factor), clear=clear, **faces))


# --- distributions and trials -----------------------------------------------------------------------------------------

SIGMAS = 2.0  # limit of a normal distribution in its standard deviations before the cut at the limit


@dataclass(frozen=True)
class Kind:
    """One kind of error."""

    name: str  # as in scene files: "lens.decentre_x"
    words: str  # as in a report
    unit: str  # of its amounts; "" for a ratio
    apply: Callable[[Setup, float], Setup]  # (as designed, amount) -> as made


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


def trials(perturbations: Sequence[Perturbation], seed: int, numbers: Iterable[int]) -> np.ndarray:
    """Amounts (trials, n) of the trials of these numbers, in the kinds' units; they depend on seed and number alone."""
    even = [np.random.default_rng((seed, number)).random(len(perturbations)) for number in numbers]
    return draws(perturbations, np.stack(even))


def draws(perturbations: Sequence[Perturbation], even: np.ndarray) -> np.ndarray:
    """Amounts (…, n) from numbers (…, n) that are even in [0, 1)."""
    return np.stack([p.amounts(even[..., k]) for k, p in enumerate(perturbations)], axis=-1)


def perturbed(setup: Setup, perturbations: Sequence[Perturbation], amounts: Sequence[float]) -> Setup:
    """The setup with these amounts, in the order of the perturbations; shapes before motions, also of a face."""
    pairs = [(p.kind, float(a)) for p, a in zip(perturbations, amounts, strict=True) if a]
    motions = ("lens.decentre", "lens.tilt", "lens.axial", "lens.clocking", "source.", "screen.", "front.decentre")
    for kind, amount in sorted(pairs, key=lambda pair: pair[0].name.startswith(motions)):
        setup = kind.apply(setup, amount)
    return setup


# --- the kinds with one amount ----------------------------------------------------------------------------------------

BAND = 20.0  # nm to either side of each line, over which the material's index must be known
# (expansion 1/K, dn/dT 1/K) at room temperature.  PMMA: Baeumer, Handbook of Plastic Optics (2nd ed. 2010), table 5.1;
# N-BK7: Schott's data sheet (α from -30 to 70 °C; Δn_rel/ΔT at 546 nm, 20 to 40 °C).
THERMAL = {"PMMA": (6.5e-5, -1.05e-4), "N-BK7": (7.1e-6, 3.0e-6)}
MOTIONS = (  # error, words, axis, is it a turn?
    ("decentre_x", "decentre of the {} in x", 0, False),
    ("decentre_y", "decentre of the {} in y", 1, False),
    ("axial", "{} along the axis", 2, False),
    ("tilt_x", "tilt of the {} about x", 0, True),
    ("tilt_y", "tilt of the {} about y", 1, True),
    ("clocking", "clocking of the {}", 2, True),
)


def kinds(setup: Setup, material: str | None = None) -> dict[str, Kind]:
    """All errors of a setup that have one amount, but those without effect there or of an unknown material."""
    found = (*_motions(setup), *_shapes(setup, material), *_lights(setup), *_alignments(setup.lens))
    return {kind.name: kind for kind in found}


def _motions(setup: Setup) -> Iterator[Kind]:
    """Shifts along and turns about x, y and z of lens, source and screen."""
    sources, hidden = [channel.source for channel in setup.channels], {"source.clocking"}
    if all(source.shifts_alike for source in sources):
        hidden.add("source.axial")  # parallel light does not change along the axis
    if not all(source.turns_alike for source in sources):
        hidden.add("lens.clocking")  # round light hides that of the source; other light cannot be turned
    for part in ("lens", "source", "screen"):
        name = setup.lens.passes.optic if part == "lens" else part
        for error, words, axis, turns in MOTIONS:
            if f"{part}.{error}" not in hidden:
                moves = partial(_moved, part, axis, turns)
                yield Kind(f"{part}.{error}", words.format(name), "deg" if turns else "mm", moves)


def _moved(part: str, axis: int, turns: bool, setup: Setup, by: float) -> Setup:
    amounts = tuple(by if k == axis else 0.0 for k in range(3))
    return setup.moved(part, Motion.of(turn=amounts, about=setup.pivot(part)) if turns else Motion.of(shift=amounts))


def _shapes(setup: Setup, material: str | None) -> Iterator[Kind]:
    """Errors of the lens's shape, glass and temperature, and of the wavelength."""
    optic, refracts = setup.lens.passes.optic, setup.lens.passes.enters
    if refracts:
        yield Kind("lens.thickness", f"thickness of the {optic}", "mm", _thicker)
        yield Kind("lens.index", "refractive index", "", lambda setup, by: setup.with_indices(lambda n: n + by))
        yield Kind("lens.front_power", "sag of the front at its rim", "mm", _front_power)
    yield Kind("lens.scale", f"scale of the {optic} (shrinkage)", "", lambda s, by: s.with_lens_scaled(1 + by))
    if material in THERMAL and refracts:
        yield Kind("temperature", f"temperature of the {optic} ({material})", "K", partial(_warmer, material))
    if material is not None and refracts and _disperses(material, setup):
        yield Kind("wavelength", "wavelength of the light", "nm", partial(_redder, material))


def _thicker(setup: Setup, by: float) -> Setup:
    back = setup.lens.back
    return replace(setup, lens=replace(setup.lens, back=back.moved(back.z + by)))


def _front_power(setup: Setup, by: float) -> Setup:
    """A front whose rim stands higher by so much (mm): c + 2 by / R², R the farthest from the axis."""
    front = setup.lens.front
    rim2 = sum(p * p for p in (front.outline or setup.lens.outline).farthest)
    return replace(setup, lens=replace(setup.lens, front=front.bent(2 * by / rim2)))


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

    return replace(setup, channels=tuple(map(change, setup.channels)))


def _lights(setup: Setup) -> Iterator[Kind]:
    """Errors of the cone and of the size of point sources."""
    sources = [channel.source for channel in setup.channels]
    if any(source.wider(0.0) for source in sources):
        yield Kind("source.angle", "width of the source's cone, relative", "", _wider)
    if len({source.place for source in sources}) > 1 and all(source.larger(0.0, source.place) for source in sources):
        yield Kind("source.size", "size of the source, relative", "", _larger)


def _wider(setup: Setup, by: float) -> Setup:
    return setup.with_sources(lambda source: source.wider(by))


def _larger(setup: Setup, by: float) -> Setup:
    return setup.with_sources(lambda source: source.larger(by, setup.pivot("source")))


# --- one face against the other ---------------------------------------------------------------------------------------


def _alignments(lens: Lens) -> Iterator[Kind]:
    """Wedge of the two faces that light meets, and decentre of the front, which of a plane does nothing."""
    for axis, name in enumerate("xy" if "front" in lens.passes.faces else ""):
        words = f"wedge of the {lens.passes.optic}, the tilt of its back about {name} to the front"
        yield Kind(f"lens.wedge_{name}", words, "deg", partial(_wedged, axis))
        if not lens.front.level:
            words = f"decentre of the front in {name} to the back"
            yield Kind(f"front.decentre_{name}", words, "mm", partial(_front_decentred, axis))


def _front_decentred(axis: int, setup: Setup, by: float) -> Setup:
    """With the front shifted, and the lens's rim with it; the back stays in the room.

    A lens is traced in the frame of its front, so its back shifts the other way and the whole lens with the front.
    The net grows, straight on, by as many control points as it takes to reach the rim: inside, the face stays as it is.
    """
    back, side = setup.lens.back, "xy"[axis]
    (low, high), pitch = getattr(back, side), back.pitch[axis]
    short = setup.lens.outline.half_extent[axis] + abs(by) - min(-low, high)
    more = max(0, math.ceil(short / pitch))
    heights = np.pad(back.heights, [(more * (k == axis),) * 2 for k in (0, 1)], "reflect", reflect_type="odd")
    ends = low - more * pitch - by, high + more * pitch - by
    stays = replace(back, heights=torch.from_numpy(heights), **{side: ends})
    shift = tuple(by if k == axis else 0.0 for k in range(3))
    return replace(setup, lens=setup.lens.with_back(stays)).moved("lens", Motion.of(shift=shift))


def _wedged(axis: int, setup: Setup, by: float) -> Setup:
    """With the back turned about its vertex v; front, rim and all else stay.

    A point p = v + (x, y, ζ) of the turned face was at v + q, q = Rᵀ (p - v), before.  There the face lies as high as
    its tangent plane over (x, y) says, which is off by curvature · (turn · sag)², 1 nm at a tenth of a degree:
    q_z = h - h_v + ∇h · ((q_x, q_y) - (x, y)), linear in ζ.
    """
    back = setup.lens.back
    turn = Motion.of(turn=tuple(by if k == axis else 0.0 for k in range(3))).inverse.rotation.tolist()
    x, y = _points(back)
    h, h_x, h_y = back.relative_sag_and_slope(x, y)
    vertex = float(back.from_vertex().z) - back.z
    level = [row[0] * x + row[1] * y for row in turn]  # q of ζ = 0
    rise = h - vertex + h_x * (level[0] - x) + h_y * (level[1] - y) - level[2]
    along = turn[2][2] - h_x * turn[0][2] - h_y * turn[1][2]
    return replace(setup, lens=setup.lens.with_back(_higher(back, (vertex + rise / along - h).numpy())))


# --- errors of the form of a face, as heights of its control net ------------------------------------------------------
# Control points with the values of a field make its spline but for (pitch / length)², so a field must be smooth over a
# few control cells.

FRONT = 100  # added to the seeds of the front's form: other fields than the back has
FACE = 513  # control points a side of the net of a plane or a conic with a form error
SPARE = 6  # of these control points on each side of a round outline, beyond the rim
BEYOND = 1.03  # of the rim's radius: such a net follows its face up to there, which is far enough not to matter inside
SMOOTH = 4.0  # control cells in a correlation length or a period, at least


def form_error(lens: Lens, correlation_length: float, seed: int, face: str = "back") -> Kind:
    """A random field on the back or the front; amounts are its RMS (mm)."""
    net, outline = _net(lens, face)
    field = random_field(net, correlation_length, seed + FRONT * (face == "front"), inside(outline, net))
    words = f"form of the {face}, correlated over {correlation_length:.3g} mm (draw {seed})"
    return Kind(f"{face}.form_{seed}", words, "mm RMS", partial(_raised, face, field))


def ripple(lens: Lens, period: float, pattern: Literal["raster", "spiral"]) -> Kind:
    """Tool marks sin(2π s / period) on the back; amounts are their RMS (mm).

    s is x for a raster, the distance from the axis for the spiral of a diamond tool, whose turns are nearly circles.
    period (mm).  ValueError if the net is too coarse for it.
    """
    _resolved(lens.back, period, "a ripple's period")
    x, y = (np.linspace(*side, m) for side, m in zip((lens.back.x, lens.back.y), lens.back.shape, strict=True))
    s = np.broadcast_to(x[:, None], (len(x), len(y))) if pattern == "raster" else np.hypot(x[:, None], y[None, :])
    field = _of_rms_one(np.sin(2 * np.pi * s / period), inside(lens.outline, lens.back))
    words = f"{pattern} ripple of the back, period {period:g} mm"
    return Kind("back.ripple", words, "mm RMS", partial(_raised, "back", field))


def random_field(surface: BSplineSurface, correlation_length: float, seed: int, where: np.ndarray) -> np.ndarray:
    """(m, n) a Gaussian random field of RMS 1 and mean 0 over `where`, of covariance exp(-(r / correlation_length)²).

    White noise drawn with the seed, smoothed by a Gaussian of standard deviation correlation_length (mm) / 2; the
    covariance is wider by √2.  ValueError if the net is too coarse for it.
    """
    _resolved(surface, correlation_length, "a correlation length")
    cells = [correlation_length / 2 / pitch for pitch in surface.pitch]
    margin = [int(np.ceil(4 * c)) for c in cells]
    shape = [m + 2 * k for m, k in zip(surface.shape, margin, strict=True)]  # without an effect of borders
    noise = fft.rfftn(np.random.default_rng(seed).standard_normal(shape))
    noise = fft.irfftn(fourier_gaussian(noise, cells, n=shape[-1]), shape)  # 20 times as fast as gaussian_filter
    inner = tuple(slice(k, k + m) for k, m in zip(margin, surface.shape, strict=True))
    return _of_rms_one(noise[inner], where)


def inside(outline: Outline, net: BSplineSurface) -> np.ndarray:
    """(m, n) True for control points of a face inside the outline."""
    return outline.contains(*_points(net)).numpy()


def as_net(face: Surface, outline: Outline) -> BSplineSurface:
    """A plane, a sphere or a conic as a net of FACE control points a side; a net as it is.

    It interpolates the face over each control point.  In its end spans a spline of uniform control points follows a
    curve poorly: of a disc they lie beyond the rim, where the net becomes level; of a rectangle they lie at its sides.
    """
    if face.is_net:
        return face
    wide = (FACE - 1) / (FACE - 1 - 2 * SPARE) if outline.is_round else 1.0
    half_x, half_y = (half * wide for half in outline.half_extent)
    level = BSplineSurface(face.z, torch.zeros((FACE, FACE), dtype=torch.float64), (-half_x, half_x), (-half_y, half_y))
    x, y = _points(level)
    rim, r = math.hypot(*outline.farthest), torch.hypot(x, y)
    there = torch.full((1,), BEYOND * rim, dtype=torch.float64)
    rim = BEYOND * rim if bool(face.reaches(there, torch.zeros_like(there))) else rim
    inwards = (rim / r.clamp(min=rim)).clamp(max=1.0)
    sag = face.sag_and_slope(inwards * x, inwards * y)[0] - face.z
    return replace(level, heights=torch.from_numpy(interpolated(sag.numpy())))


def _raised(face: str, field: np.ndarray, setup: Setup, by: float) -> Setup:
    net, _ = _net(setup.lens, face)
    own = {"clear": setup.lens.apertures} if getattr(setup.lens, face).outline is not None else {}
    return replace(setup, lens=replace(setup.lens, **{face: _higher(net, by * field)}, **own))


def _net(lens: Lens, face: str) -> tuple[BSplineSurface, Outline]:
    """The optical part of a face as a net, and its outline."""
    surface = getattr(lens, face)
    outline = surface.outline or lens.outline
    return as_net(surface.optical, outline), outline


def _higher(net: BSplineSurface, heights: np.ndarray) -> BSplineSurface:
    return replace(net, heights=net.heights + torch.from_numpy(heights).to(net.heights))


def _points(net: BSplineSurface) -> tuple[torch.Tensor, torch.Tensor]:
    """(m, n) x and y of the control points (mm)."""
    ends = zip((net.x, net.y), net.shape, strict=True)
    x, y = (torch.linspace(*side, m, dtype=torch.float64) for side, m in ends)
    return torch.meshgrid(x, y, indexing="ij")


def _resolved(surface: BSplineSurface, length: float, words: str) -> None:
    least = SMOOTH * max(surface.pitch)
    if length < least:
        raise ValueError(
            f"{words} of {length:g} mm is too fine for {in_words(surface.shape)} control points, which carry "
            f"{least:.3g} mm and more; give a longer one, or a lens of more control points"
        )


def _of_rms_one(field: np.ndarray, where: np.ndarray) -> np.ndarray:
    field = field - field[where].mean()
    return field / np.sqrt(np.mean(field[where] ** 2))
