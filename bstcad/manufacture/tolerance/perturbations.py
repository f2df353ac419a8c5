"""Errors of manufacture, alignment and illumination: their effect on a setup, their distributions, and random trials.

A setup is traced in the frame of the lens.  Decentres and tilts move one part relative to all others.  A lens tilts
about its centre, a source about its position, and a screen about its centre (`Setup.pivot`).
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

from bstcad.optics.lens.interfaces import Interface
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.media import refractive_index
from bstcad.optics.lens.passes import BACK, FRONT
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.bspline import BSplineSurface, interpolating_net, is_net
from bstcad.optics.surfaces.motion import Motion, along_axis
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.rays import Vector
from bstcad.optics.surfaces.sides import size_text
from bstcad.optics.surfaces.surfaces import Surface
from bstcad.optics.surfaces.tilted import TiltedSurface
from bstcad.optics.trace.measure import tubes_picture
from bstcad.scene.errors import SceneError

# --- the setup --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Setup:
    """Lens, light and screen; lengths in mm, in the frame of the lens."""

    lens: Lens
    channels: tuple[Channel, ...]  # light of the source
    screen: Screen  # plane and pixels of the target
    lens_motion: Motion | None = None  # motion of the lens in the room, where the wave is fixed; None: not moved

    def pivot(self, part: str) -> Vector:
        """Return the point about which a part ("lens", "source", "screen") tilts.

        Lens: midpoint of the vertices of its faces; mirror in air: its vertex.  Source: weighted mean of its points,
        or the centre of its aperture.  Screen: its centre.
        """
        if part == "screen":
            return self.screen.middle
        if part == "lens":
            back = self.lens.back_net.plain().vertex_z
            return 0.0, 0.0, (self.lens.front.z + back) / 2 if FRONT in self.lens.passes.faces else back
        points = [channel.source.start_point(self.lens.entrance.z) for channel in self.channels]
        mean = np.average(points, axis=0, weights=[channel.weight for channel in self.channels])
        return tuple(mean.tolist())

    def picture(self, tubes: int) -> np.ndarray:
        """Return the flux in each pixel (rows, columns), row 0 = y max; tubes: flux tubes per side and channel."""
        return tubes_picture(self.lens, self.channels, self.screen, tubes, over_the_back=True).cpu().numpy()

    def moved(self, part: str, motion: Motion) -> Setup:
        """Return the setup with a part moved.  In the frame of a moved lens, all other parts move inversely."""
        if part == "lens":
            around = self.moved("source", motion.inverse).moved("screen", motion.inverse)._with_elements(motion.inverse)
            return replace(around, lens_motion=motion if self.lens_motion is None else self.lens_motion.after(motion))
        if part == "screen":
            return replace(self, screen=self.screen.moved(motion))
        try:
            return self.with_sources(lambda source: source.moved(motion, self.lens.entrance.z))
        except NotImplementedError as error:  # a user-defined emitter
            raise SceneError(f"tolerance: {error}, or name only errors that do not move the source") from None

    def _with_elements(self, motion: Motion) -> Setup:
        """Return the setup with the faces of windows and mirrors moved; their rims stay about the axis of the lens."""
        if not (self.lens.before or self.lens.behind):
            return self

        def moved(interfaces: tuple[Interface, ...]) -> tuple[Interface, ...]:
            return tuple(replace(i, surface=TiltedSurface.of(i.surface).moved_by(motion)) for i in interfaces)

        lens = replace(self.lens, before=moved(self.lens.before), behind=moved(self.lens.behind))
        own = ((c, c.around and (moved(c.around[0]), moved(c.around[1]))) for c in self.channels)
        return replace(self, lens=lens, channels=tuple(replace(c, around=around) for c, around in own))

    def with_sources(self, change: Callable[[Emitter], Emitter]) -> Setup:
        """Return the setup with the source of each channel changed."""
        return replace(self, channels=tuple(replace(c, source=change(c.source)) for c in self.channels))

    def with_indices(self, change: Callable[[float], float]) -> Setup:
        """Return the setup with each refractive index of the lens changed."""
        channels = tuple(replace(c, index=change(c.index)) for c in self.channels)
        return replace(self, lens=replace(self.lens, index=change(self.lens.index)), channels=channels)

    def with_lens_scaled(self, factor: float) -> Setup:
        """Return the setup with its lens scaled by a factor about the pivot of the lens."""
        lens, (_, _, about) = self.lens, self.pivot("lens")
        for face in lens.faces:
            lens = lens.with_surface(face.name, face.surface.scaled(factor, about))
        clear = lens.clear and [aperture.scaled(factor) for aperture in lens.clear]
        return replace(self, lens=replace(lens, outline=lens.outline.scaled(factor)).with_clear(clear))


# --- distributions and trials -----------------------------------------------------------------------------------------

CUTOFF_SIGMAS = 2.0  # limit of a truncated normal distribution / standard deviation before truncation


@dataclass(frozen=True)
class Kind:
    """One kind of error."""

    name: str  # name in scene files, such as "lens.decentre_x"
    words: str  # name in reports
    unit: str  # unit of its amounts; "" for a ratio
    apply: Callable[[Setup, float], Setup]  # function (setup, amount) -> setup with this error added
    moves: bool = False  # True if a part moves; errors of shape act before motions


@dataclass(frozen=True)
class Perturbation:
    """One kind of error with its distribution about zero."""

    kind: Kind
    limit: float  # limit (±) in the unit of the kind; for a random field, standard deviation of its amount
    distribution: Literal["normal", "uniform", "field"] = "normal"
    cost: float = 1.0  # cost of keeping the limit, relative to the other errors

    @property
    def sigma(self) -> float:
        """Standard deviation σ, in the unit of the kind.

        normal: standard deviation s before truncation at the limit L = a s, a = CUTOFF_SIGMAS; after it,
        σ² = s² (1 - 2 a φ(a) / (2 Φ(a) - 1)).  field: one mode of a random field, normal and not truncated.
        """
        cut = 1 - 2 * CUTOFF_SIGMAS * norm.pdf(CUTOFF_SIGMAS) / (2 * norm.cdf(CUTOFF_SIGMAS) - 1)
        ratios = {"uniform": 1 / math.sqrt(3), "field": 1.0, "normal": math.sqrt(cut) / CUTOFF_SIGMAS}
        return self.limit * ratios[self.distribution]

    def amounts(self, uniform: np.ndarray) -> np.ndarray:
        """Return amounts from uniform numbers in [0, 1), by the inverse of the cumulative distribution."""
        if self.distribution == "uniform":
            return self.limit * (2 * uniform - 1)
        if self.distribution == "field":
            return self.limit * norm.ppf(np.clip(uniform, 1e-12, None))
        low = norm.cdf(-CUTOFF_SIGMAS)
        return self.limit * (norm.ppf(low + uniform * (1 - 2 * low)) / CUTOFF_SIGMAS)


def trials(perturbations: Sequence[Perturbation], seed: int, numbers: Iterable[int]) -> np.ndarray:
    """Return the amounts (trials, n) of numbered trials, in the units of the kinds, from seed and number alone."""
    uniform = [np.random.default_rng((seed, number)).random(len(perturbations)) for number in numbers]
    return draws(perturbations, np.stack(uniform))


def draws(perturbations: Sequence[Perturbation], uniform: np.ndarray) -> np.ndarray:
    """Return amounts (…, n) from uniform numbers (…, n) in [0, 1)."""
    return np.stack([p.amounts(uniform[..., k]) for k, p in enumerate(perturbations)], axis=-1)


def perturb(setup: Setup, perturbations: Sequence[Perturbation], amounts: Sequence[float]) -> Setup:
    """Apply amounts (n,), in the order of the perturbations, to a setup; errors of shape come before motions."""
    pairs = [(p.kind, float(a)) for p, a in zip(perturbations, amounts, strict=True) if a]
    for kind, amount in sorted(pairs, key=lambda pair: pair[0].moves):
        setup = kind.apply(setup, amount)
    return setup


# --- the kinds with one amount ----------------------------------------------------------------------------------------

INDEX_MARGIN = 20.0  # distance (nm) from a spectral line within which the index must be known for a wavelength error
# Thermal expansion (1/K) and dn/dT (1/K) at room temperature.
# PMMA: Baeumer, Handbook of Plastic Optics (2nd ed. 2010), table 5.1.
# N-BK7: Schott's data sheet (α from -30 to 70 °C; Δn_rel/ΔT at 546 nm, 20 to 40 °C).
THERMAL_COEFFICIENTS = {"PMMA": (6.5e-5, -1.05e-4), "N-BK7": (7.1e-6, 3.0e-6)}
MOTIONS = (  # (error, words, axis, True for a rotation)
    ("decentre_x", "decentre of the {} in x", 0, False),
    ("decentre_y", "decentre of the {} in y", 1, False),
    ("axial", "{} along the axis", 2, False),
    ("tilt_x", "tilt of the {} about x", 0, True),
    ("tilt_y", "tilt of the {} about y", 1, True),
    ("clocking", "clocking of the {}", 2, True),
)


def kinds(setup: Setup, material: str | None = None) -> dict[str, Kind]:
    """Return all kinds of error by name, except form, ripple, and kinds whose effect is zero or cannot be computed."""
    every_kind = (*_motions(setup), *_shapes(setup, material), *_lights(setup), *_alignments(setup.lens))
    return {kind.name: kind for kind in every_kind}


def _motions(setup: Setup) -> Iterator[Kind]:
    sources, without_effect = [channel.source for channel in setup.channels], {"source.clocking"}
    if setup.screen.receiver.goniometer:  # directions, which a shift does not change
        without_effect |= {"screen.decentre_x", "screen.decentre_y", "screen.axial"}
    if all(source.is_shift_invariant for source in sources):
        without_effect.add("source.axial")  # a shift of collimated light along the axis has no effect
    if not all(source.is_rotation_invariant for source in sources):
        without_effect.add("lens.clocking")  # `Emitter.moved` cannot rotate light without rotational symmetry
    for part in ("lens", "source", "screen"):
        name = setup.lens.passes.optic if part == "lens" else part
        for error, words, axis, turns in MOTIONS:
            if f"{part}.{error}" not in without_effect:
                move = partial(_move_part, part, axis, turns)
                yield Kind(f"{part}.{error}", words.format(name), "deg" if turns else "mm", move, moves=True)


def _move_part(part: str, axis: int, turns: bool, setup: Setup, by: float) -> Setup:
    amounts = along_axis(axis, by)
    return setup.moved(part, Motion.of(turn=amounts, about=setup.pivot(part)) if turns else Motion.of(shift=amounts))


def _shapes(setup: Setup, material: str | None) -> Iterator[Kind]:
    optic, refracts = setup.lens.passes.optic, setup.lens.passes.enters
    if refracts:
        yield Kind("lens.thickness", f"thickness of the {optic}", "mm", _change_thickness)
        yield Kind("lens.index", "refractive index", "", lambda s, by: s.with_indices(lambda n: n + by))
        if setup.lens.shares_outline:  # the front of another lens is nearly vertical at its rim
            yield Kind("lens.front_power", "sag of the front at its rim", "mm", _change_front_power)
    yield Kind("lens.scale", f"scale of the {optic} (shrinkage)", "", lambda s, by: s.with_lens_scaled(1 + by))
    if material in THERMAL_COEFFICIENTS and refracts:
        warm = partial(_change_temperature, material)
        yield Kind("temperature", f"temperature of the {optic} ({material})", "K", warm)
    if material is not None and refracts and _disperses(material, setup):
        yield Kind("wavelength", "wavelength of the light", "nm", partial(_change_wavelength, material))


def _change_thickness(setup: Setup, by: float) -> Setup:
    back = setup.lens.back
    return replace(setup, lens=setup.lens.with_back(back.moved(back.z + by)))


def _change_front_power(setup: Setup, by: float) -> Setup:
    """Raise the rim of the front by `by` (mm): curvature c + 2 by / R², R the largest distance from the axis."""
    front = setup.lens.front
    rim2 = sum(p * p for p in (front.outline or setup.lens.outline).farthest)
    return replace(setup, lens=setup.lens.with_front(front.bent(2 * by / rim2)))


def _change_temperature(material: str, setup: Setup, by: float) -> Setup:
    expansion, of_index = THERMAL_COEFFICIENTS[material]
    return setup.with_lens_scaled(1 + expansion * by).with_indices(lambda n: n + of_index * by)


def _disperses(material: str, setup: Setup) -> bool:
    """Return True if the index of the material is known within INDEX_MARGIN of each spectral line."""
    try:
        for nm in {channel.source.main_wavelength for channel in setup.channels}:
            refractive_index(material, nm - INDEX_MARGIN), refractive_index(material, nm + INDEX_MARGIN)
    except ValueError:
        return False
    return True


def _change_wavelength(material: str, setup: Setup, by: float) -> Setup:
    """Add an amount (nm) to the wavelength of each line; losses at faces and in the glass do not change."""

    def change(channel: Channel) -> Channel:
        nm = channel.source.main_wavelength
        more = refractive_index(material, nm + by) - refractive_index(material, nm)
        return replace(channel, index=channel.index + more)

    return replace(setup, channels=tuple(map(change, setup.channels)))


def _lights(setup: Setup) -> Iterator[Kind]:
    sources = [channel.source for channel in setup.channels]
    if any(source.with_wider_cone(0.0) for source in sources):
        yield Kind("source.angle", "width of the source's cone, relative", "", _change_cone, moves=True)
    extended = len({source.place for source in sources}) > 1
    if extended and all(source.moved_away(0.0, source.place) for source in sources):
        yield Kind("source.size", "size of the source, relative", "", _change_size, moves=True)


def _change_cone(setup: Setup, by: float) -> Setup:
    return setup.with_sources(lambda source: source.with_wider_cone(by) or source)


def _change_size(setup: Setup, by: float) -> Setup:
    return setup.with_sources(lambda source: source.moved_away(by, setup.pivot("source")) or source)


# --- one face against the other ---------------------------------------------------------------------------------------


def _alignments(lens: Lens) -> Iterator[Kind]:
    """Yield the wedge between two refracting faces, and the decentre of a front that is not plane."""
    for axis, name in enumerate("xy" if FRONT in lens.passes.faces else ""):
        words = f"wedge of the {lens.passes.optic}: tilt of its back about {name} relative to the front"
        yield Kind(f"lens.wedge_{name}", words, "deg", partial(_tilt_back, axis))
        if not lens.front.level:
            words = f"decentre of the front in {name} relative to the back"
            yield Kind(f"front.decentre_{name}", words, "mm", partial(_decentre_front, axis), moves=True)


def _decentre_front(axis: int, setup: Setup, by: float) -> Setup:
    """Shift the front and the rim of the lens by `by` mm along an axis (0: x, 1: y); the back stays fixed in the room.

    A lens is traced in the frame of its front.  Therefore the back is shifted inversely, and the whole lens moves with
    the front.
    """
    lens = setup.lens
    back = lens.back_net.shifted(axis, -by, lens.outline.half_extent[axis])
    return replace(setup, lens=lens.with_back(back)).moved("lens", Motion.of(shift=along_axis(axis, by)))


def _tilt_back(axis: int, setup: Setup, by: float) -> Setup:
    """Rotate the back by `by` degrees about an axis (0: x, 1: y) through its vertex; all other parts stay fixed."""
    return replace(setup, lens=setup.lens.with_back(setup.lens.back_net.tilted(axis, by)))


# --- errors of the form of a face, as heights of its control net ------------------------------------------------------
# A spline whose control points have the values of a field differs from the field by about (pitch / correlation
# length)². A field must therefore be smooth over a few control cells.  On a dome a field is added to the distances from
# the centre; lengths are those on the sphere before tailoring, where control cells are smaller towards the rim.

FRONT_SEED_OFFSET = 100  # offset of the seeds for the form of the front, so that its fields differ from the back's
FACE_NET = 513  # control points per side of the net that replaces a plane or a conic with a form error
FACE_MARGIN = 6  # number of control points of the FACE_NET net outside a round outline, on each side
FACE_REACH = 1.03  # radius / rim radius up to which the net follows the face: its level part must not affect the rim
FIELD_WAVES = 512  # number of plane waves in a random field on a curved chart
CELLS_PER_PERIOD = 4.0  # minimum number of control cells in a correlation length or a period


def form_error(lens: Lens, correlation_length: float, seed: int, face: str = BACK) -> Kind:
    """Return a random field on the back or the front as a kind of error; amounts are the RMS of the field (mm)."""
    net, outline = _net(lens, face)
    seed_of_face = seed + FRONT_SEED_OFFSET * (face == FRONT)
    field = random_field(net, correlation_length, seed_of_face, inside_outline(outline, net))
    words = f"form of the {face}, correlated over {correlation_length:.3g} mm (sample {seed})"
    return Kind(f"{face}.form_{seed}", words, "mm RMS", partial(_add_form, face, field))


def ripple(lens: Lens, period: float, pattern: Literal["raster", "spiral"]) -> Kind:
    """Return tool marks sin(2π s / period) on the back as a kind of error; amounts are the RMS of the marks (mm).

    s is x for a raster, and the distance from the axis for the spiral of a diamond tool, which is almost a set of
    circles.  On a dome both are lengths of arcs.  Raises ValueError if the net is too coarse for the period (mm).
    """
    back = lens.back_net
    _require_resolution(back, period, "a ripple's period")
    along_x, from_axis = back.chart.arcs(*(p.numpy() for p in back.places))
    s = along_x if pattern == "raster" else from_axis
    field = _normalise(np.sin(2 * np.pi * s / period), inside_outline(lens.outline, back))
    words = f"{pattern} ripple of the back, period {period:g} mm"
    return Kind("back.ripple", words, "mm RMS", partial(_add_form, BACK, field))


def random_field(surface: BSplineSurface, correlation_length: float, seed: int, where: np.ndarray) -> np.ndarray:
    """Return a Gaussian random field (m, n), RMS 1 and mean 0 over `where`, covariance exp(-(r / correlation_length)²).

    White noise is smoothed with a Gaussian of standard deviation correlation_length (mm) / 2; the covariance is wider
    by √2.  On a dome r is the length of the chord.  Raises ValueError if the net is too coarse.
    """
    _require_resolution(surface, correlation_length, "a correlation length")
    if not surface.chart.flat:
        return _normalise(_field_of_waves(surface, correlation_length, seed), where)
    cells = [correlation_length / 2 / pitch for pitch in surface.pitch]
    margin = [int(np.ceil(4 * c)) for c in cells]
    shape = [m + 2 * k for m, k in zip(surface.shape, margin, strict=True)]  # the margin avoids effects of the boundary
    noise = fft.rfftn(np.random.default_rng(seed).standard_normal(shape))
    noise = fft.irfftn(fourier_gaussian(noise, cells, n=shape[-1]), shape)  # 20 times as fast as gaussian_filter
    inner = tuple(slice(k, k + m) for k, m in zip(margin, surface.shape, strict=True))
    return _normalise(noise[inner], where)


def _field_of_waves(surface: BSplineSurface, correlation_length: float, seed: int) -> np.ndarray:
    """Return a random field (m, n), a sum of waves cos(k · p + φ) at the points p of the chart's surface h = 0.

    Wave vectors k with the standard deviation √2 / correlation_length in each component give the covariance
    exp(-(r / correlation_length)²), r the length of the chord (Rahimi and Recht 2007, "Random features").
    """
    chance = np.random.default_rng(seed)
    waves = math.sqrt(2) / correlation_length * chance.standard_normal((FIELD_WAVES, 3))
    x, y = surface.places
    points, field = surface.chart.point(x, y, torch.zeros_like(x)).numpy(), np.zeros(surface.shape)
    for (k_x, k_y, k_z), phase in zip(waves.tolist(), (2 * np.pi * chance.random(FIELD_WAVES)).tolist(), strict=True):
        field += np.cos(k_x * points[0] + k_y * points[1] + k_z * points[2] + phase)
    return field


def inside_outline(outline: Outline, net: BSplineSurface) -> np.ndarray:
    """Return a mask (m, n) of the control points of a face inside the outline."""
    return outline.contains(*net.places).numpy()


def as_net(face: Surface, outline: Outline) -> BSplineSurface:
    """Convert a plane, a sphere or a conic into a net of FACE_NET control points per side; return a net unchanged.

    The net interpolates the face at each control point.  A uniform spline approximates a curve poorly in its end spans.
    For a round outline these spans lie outside the rim, where the net becomes level; for a rectangle, along its sides.
    """
    if is_net(face):
        return face
    wide = (FACE_NET - 1) / (FACE_NET - 1 - 2 * FACE_MARGIN) if outline.is_round else 1.0
    half_x, half_y = (half * wide for half in outline.half_extent)
    heights = torch.zeros((FACE_NET, FACE_NET), dtype=torch.float64)
    level = BSplineSurface(face.z, heights, (-half_x, half_x), (-half_y, half_y))
    x, y = level.places
    rim, r = math.hypot(*outline.farthest), torch.hypot(x, y)
    edge = torch.full((1,), FACE_REACH * rim, dtype=torch.float64)
    rim = FACE_REACH * rim if bool(face.reaches(edge, torch.zeros_like(edge))) else rim
    inwards = (rim / r.clamp(min=rim)).clamp(max=1.0)
    sag = face.sag_and_slope(inwards * x, inwards * y)[0] - face.z
    return replace(level, heights=torch.from_numpy(interpolating_net(sag.numpy())))


def _add_form(face: str, field: np.ndarray, setup: Setup, by: float) -> Setup:
    net, _ = _net(setup.lens, face)
    changed = _add_heights(net, by * field)
    lens = setup.lens.with_surface(face, changed)
    clear = setup.lens.clear if setup.lens.face(face).surface.outline is None else setup.lens.apertures
    return replace(setup, lens=lens.with_clear(clear))


def _net(lens: Lens, face: str) -> tuple[BSplineSurface, Outline]:
    """Return the optical part of a face as a net, and the outline of this part."""
    surface = lens.face(face).surface
    outline = surface.outline or lens.outline
    return as_net(surface.optical, outline), outline


def _add_heights(net: BSplineSurface, heights: np.ndarray) -> BSplineSurface:
    return replace(net, heights=net.heights + torch.from_numpy(heights).to(net.heights))


def _require_resolution(surface: BSplineSurface, length: float, words: str) -> None:
    least = CELLS_PER_PERIOD * max(surface.pitch)
    if length < least:
        raise ValueError(
            f"{words} of {length:g} mm is too fine for {size_text(surface.shape)} control points, which can represent "
            f"{least:.3g} mm or more; give a longer one, or more control points if this face is a net"
        )


def _normalise(field: np.ndarray, where: np.ndarray) -> np.ndarray:
    field = field - field[where].mean()
    return field / np.sqrt(np.mean(field[where] ** 2))
