"""The merit function of stages 2 and 3, and the variables that condition it (`Spectrum` conditions the slope fit).

The merit is the weighted mean of RRMSD² of each picture goal and the squared RMS wavefront error in waves:

    M = (Σ_k w_k RRMSD_k² + w (RMS / λ)²) / (Σ_k w_k + w),    RRMSD_k² = Σ_ij |E^s_ij - E_ij|² / Σ_ij E_ij².

All pixels have the same weight, lit or not.  The target E has the sum 1.  The picture E^s is divided by the flux that
is left after losses at faces and in the glass, so that these losses do not change the merit, but light beside the
target does.  (Reports scale both pictures to the sum 1.)

Two terms are added, averaged over the pictures: a penalty on light outside the target, and the fraction of the light in
tubes that do not reach the receiver (total internal reflection).  Light outside the target changes no pixel and so has
no gradient; the penalty is `overshoot` (1 / pixel²) times the mean over all light of the squared distance outside the
border (in pixels; for a source of finite size, the border of the picture with its margin).  Pictures and both terms are
sums over the channels of the light.  For a source of finite size the picture is that of its centre, blurred
(source_image.py).  The wavefront error of a ray is its optical path to the plane of the wave minus the path required
there (`Wave.path`), without piston.

The Hessian: let e be the flux density on the last face, and E the irradiance of the target where its light lands.  A
change δz of the face moves this light by L ∇δz, where L = |∂t/∂p| (mm) is the leverage, the change of the landing
point t per change of the slope p (for small angles the distance times n - 1), and so changes E by about E L Δδz.
The light of an area dA_b of the face falls on the area dA_t = (e / E) dA_b of the target, so that the squared error is

    ∫ δE² dA_t  =  ∫ (E L Δδz)² (e / E) dA_b  =  L² ∫ e E (Δδz)² dA_b.

As a quadratic form in δz this is the operator Δ e E Δ.  In the variable c with δz = Δ^-1 E^-1/2 c it becomes e, a
constant for a uniform beam.  Detail finer than a pixel does not change the merit, so the true Hessian grows more slowly
with frequency, and falls again for the shortest waves.  `SobolevVariable` therefore has a smaller power, q = 0.5, which
ends at waves of four control points, δz = (Δ^-2 + Δ_0^-2)^(q/2) E^-1/2 c.  (Measured Rayleigh quotients of the Hessian
for Δ^-q alone, by eigenvalue of Δ on the net: 0.1 at 0.02, 0.4 at 0.35, 0.8 at 1.4, 0.6 at 3 and 0.2 at 5.5 for a
portrait; 0.4, 1.1, 0.8, 0.2 and 0.04 for letters.)  The weight E^-1/2 halves the number of evaluations for pictures
with dark parts.  Δ is diagonal in the cosine transform of the net.

Near the critical angle L is not constant: dθ' = η cos θ / cos θ' dθ grows without bound, and some points of the face
move their light many times further than most.  Where L is above three times its median, the weight of the last net is
divided by L / (3 median L).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.fft
import torch
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.sparse import csr_array
from torch import Tensor

from bstcad.optics.lens.interfaces import Law, Refract
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK
from bstcad.optics.light.channels import Channel, weighted_sum
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.light.wavefront import MM_PER_NM, Wave
from bstcad.optics.numerics.reductions import elementary, quotient, total
from bstcad.optics.receivers.goal import SUM_ROUNDING, Goal
from bstcad.optics.receivers.irradiance import CellTarget, picture_error
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces.bspline import BSplineSurface, resampling_matrix
from bstcad.optics.surfaces.rays import Landed, Rays
from bstcad.optics.trace.measure import RayTubes
from bstcad.optics.trace.reach import wanted_slopes
from bstcad.optics.trace.trace import behind, through
from bstcad.optics.trace.tubes import Tubes, arriving_flux, rays_to
from bstcad.optics.trace.unfolding import image_from_last_net
from bstcad.optics.trace.wavefront_error import path_from_reference
from bstcad.tailoring.folds import Folds
from bstcad.tailoring.source_image import (
    BlurOperator,
    ErrorRays,
    ExtendedSource,
    blur_error,
    blurred,
    blurs,
    with_border,
)

LAPLACIAN_POWER = 0.5  # power of the Laplacian in `SobolevVariable`
FOUR_POINTS = 2.0  # eigenvalue of the Laplacian for waves of four control points along one axis, 2 - 2 cos(π / 2)
COARSE_LAPLACIAN_POWER = 0.75  # power of the Laplacian in `CoarseVariable`, whose net has about one cell per pixel
TARGET_BLUR = 1.0  # standard deviation (pixels) of the blur of the target before the local weight is computed
WEIGHT_SMOOTHING = 1.5  # standard deviation (control points) of the smoothing of the weight's logarithm
MAX_WEIGHT_POINTS = 513  # largest number of points per side at which the local weight is computed; linear between
MAX_LOCAL_WEIGHT = 2.8  # largest local weight; the smallest is 1 / MAX_LOCAL_WEIGHT, before division by the leverage
# Range of the leverage / median in which the weight is proportional to 1 / leverage.
MIN_LEVERAGE, MAX_LEVERAGE = 3.0, 96.0
LEVERAGE_STEP = 1e-6  # shift of target points t / their largest distance from the lens, for quotients of p(b, t)
LEVERAGE_STRIDE = 8  # every 8th control point is checked first, since few lenses have a large leverage anywhere


def mean_square_miss(rays: Landed, aim: Tensor) -> Tensor:
    """Return the mean of |P_t - P|² over rays that land at P with the aim P_t (a sum in Wang et al. 2023, Eq. 14)."""
    lit = rays.alive & (rays.flux > 0)
    miss = (rays.position[0] - aim[0]) ** 2 + (rays.position[1] - aim[1]) ** 2
    return total(torch.where(lit, miss, torch.zeros_like(miss))) / lit.sum()


PictureError = Callable[[Tensor, Tensor], Tensor]  # error (0-d) of a picture (rows, columns) relative to a target


class Landings(NamedTuple):
    """Rays through the corners of the tubes, traced to the goals."""

    on_goals: tuple[tuple[Landed, ...], ...]  # landing points for each goal and sheet
    behind: tuple[Rays, Tensor] | None = None  # rays of the first sheet behind the lens, and their optical path (mm)


@dataclass(frozen=True, eq=False)
class Merit:
    """Merit of pictures and of a wavefront, exact for flux tubes, and differentiable in the heights of all nets."""

    light: RayTubes  # flux tubes of a point source, or of the centre of an extended source
    goals: tuple[Goal, ...]
    overshoot: float  # weight of light outside the border of a target (1 / pixel²)
    wave: Wave | None = None  # wavefront goal, rated with the first channel; None: no such goal
    picture_error: PictureError | None = None  # error to minimise; None: RRMSD²
    blurs: tuple[tuple[BlurOperator, ...], ...] = ()  # blur by goal and channel; (): the source is a point
    blur_errors: tuple[Tensor, ...] = ()  # error of each blurred picture, (rows, columns); (): not measured
    folds: tuple[Folds | None, ...] = ()  # penalty on folds by goal; None: its light may fold
    shares: tuple[float, ...] = (1.0,)  # shares of the errors on pixels and on ever smaller cells: `CellTarget.of`

    @classmethod
    def of(
        cls, channels: Sequence[Channel], lens: Lens, n: int, goals: Sequence[Goal], overshoot: float,
        wave: Wave | None = None,
    ) -> Merit:  # fmt: skip
        """Make the merit for a point source, with sheets of n x n tubes launched for `lens`, one per channel."""
        light = RayTubes.launched(_from_source(lens, wave), channels, n)
        return cls(light, tuple(goals), overshoot, wave=wave)

    def with_blur(self, source: ExtendedSource, lens: Lens, rays: ErrorRays | None = None, seed: int = 0) -> Merit:
        """Return the merit for a source of finite size; the channels of this merit are the light of its centre.

        rays, seed: of the measurement of the error of the blur, in almost a second per goal; None: no measurement.
        """
        exact = lens.plain()
        merit = replace(self, blurs=tuple(blurs(source, exact, goal.screen) for goal in self.goals))
        if rays is None:
            return merit
        with torch.no_grad():
            images = [merit.picture(k, landed)[0] for k, landed in enumerate(merit.landing(lens).on_goals)]
        errors = (
            blur_error(image, source.sampler, exact, goal.screen, border=blur.border, seed=seed, effort=rays)
            for image, goal, (blur, *_) in zip(images, merit.goals, merit.blurs, strict=True)
        )
        return replace(merit, blur_errors=tuple(errors))

    @property
    def tubes(self) -> int:
        """Number of tubes of an evaluation; each counts once per target."""
        return len(self.goals) * sum(sheet.flux.numel() for sheet in self.light.sheets)

    @cached_property
    def targets(self) -> tuple[CellTarget, ...]:
        """Target pictures on cells, one per goal, on the light's device; that of an only goal has the sum 1."""
        pictures = [torch.as_tensor(goal.picture, device=self.light.sheets[0].flux.device) for goal in self.goals]
        if self._is_one and abs(float(total(pictures[0])) - 1) > SUM_ROUNDING:
            pictures = [picture / total(picture) for picture in pictures]
        return tuple(CellTarget.of(picture, self.shares) for picture in pictures)

    @property
    def _is_one(self) -> bool:
        """True if there is one picture and no wavefront goal."""
        return len(self.goals) == 1 and self.wave is None

    def landing(self, lens: Lens) -> Landings:
        """Trace the corners of each sheet to the receivers."""
        planes = [goal.screen.receiver for goal in self.goals]
        if self.wave is None:
            return Landings(self.light.landings(lens, planes))
        lens, pairs = _from_source(lens, self.wave), zip(self.light.channels, self.light.sheets, strict=True)
        traced = [_traced_corners(c.source, sheet, c.through(lens)) for c, sheet in pairs]
        return Landings(tuple(tuple(plane.land(rays) for rays, _ in traced) for plane in planes), traced[0])

    def __call__(self, landings: Landings) -> tuple[Tensor, Tensor]:
        """Return the merit of the landed corners, and the largest RRMSD of the pictures, each scaled to the sum 1."""
        pictures = sum(goal.weight for goal in self.goals)
        weights = pictures + (self.wave.weight if self.wave else 0.0)
        merit, worst = torch.zeros(()), torch.zeros(())
        for k, (goal, landed) in enumerate(zip(self.goals, landings.on_goals, strict=True)):
            error, penalty, lost, rrmsd = self._goal_terms(k, landed)
            if self._is_one:
                return error + penalty + lost, rrmsd
            merit = merit + goal.weight / weights * error + goal.weight / pictures * (penalty + lost)
            worst = torch.maximum(worst.to(rrmsd), rrmsd)
        if self.wave is not None and landings.behind is not None:
            merit = merit + self.wave.weight / weights * self._wavefront_error(*landings.behind)
        return merit, worst

    def picture(self, k: int, landed: Sequence[Landed]) -> tuple[Tensor, Tensor, Tensor]:
        """Return (picture of goal k, flux by which it has to be divided, penalty on light outside the picture).

        This flux is the transmitted flux, or 1 if the picture is already divided.
        """
        channels, screen = self.light.channels, self.goals[k].screen
        pairs = list(zip(self.light.sheets, landed, strict=True))
        # flux after the losses at faces and in the glass, so that they do not change the merit
        flux = weighted_sum(channels, (total(sheet.transmitted_flux(corners)) for sheet, corners in pairs))
        wider = with_border(screen, self.blurs[k][0].border) if self.blurs else screen
        images, penalties = zip(*(sheet.collect(corners, wider) for sheet, corners in pairs), strict=True)
        outside = weighted_sum(channels, penalties)
        if not self.blurs:
            return weighted_sum(channels, images), flux, self.overshoot * outside / flux
        smooth = (blurred(image / flux, blur) for image, blur in zip(images, self.blurs[k], strict=True))
        return weighted_sum(channels, smooth), torch.ones_like(flux), self.overshoot * (outside / flux)

    def _goal_terms(self, k: int, landed: Sequence[Landed]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return (squared error or `picture_error`, penalty, fraction lost, RRMSD of the scaled picture) of goal k."""
        channels, sheets, target = self.light.channels, self.light.sheets, self.targets[k]
        image, flux, penalty = self.picture(k, landed)
        if self.blur_errors:
            image = image + self.blur_errors[k]
        error, rrmsd = picture_error(image, flux, target)
        if self.folds and (folds := self.folds[k]) is not None:
            penalty = penalty + folds(channels, landed)
        if self.picture_error is not None:
            error = self.picture_error(quotient(image, flux), target.picture)
        pairs = zip(sheets, landed, strict=True)
        arrived = weighted_sum(channels, (total(arriving_flux(sheet.flux, corners)) for sheet, corners in pairs))
        # the lost light has no gradient, but without this term a lens that loses light could have a lower merit
        lost = 1 - arrived / weighted_sum(channels, (total(sheet.flux) for sheet in sheets))
        return error, penalty, lost, rrmsd

    def _wavefront_error(self, rays: Rays, path: Tensor) -> Tensor:
        """Return (RMS / λ)² of the optical path differences without piston, weighted by the flux around each corner."""
        wave, wavelength = self.wave, self.light.channels[0].source.main_wavelength
        assert wave is not None, "a merit without a wavefront goal has no wavefront error"
        above = rays.above(wave.z)
        further = -above / torch.where(rays.alive, rays.direction[2], torch.ones_like(above))
        x, y = (p + further * d for p, d in zip(rays.position[:2], rays.direction[:2], strict=True))
        inside = rays.alive & wave.contains(x.detach(), y.detach())
        flux = torch.where(inside, _corner_flux(self.light.sheets[0].flux), torch.zeros_like(x))
        opd = (path + further - wave.path(x, y, wavelength)) / (wavelength * MM_PER_NM)
        opd = torch.where(inside, opd, torch.zeros_like(opd))
        weight = flux / total(flux)
        piston = total(weight * opd).detach()  # no gradient: the mean minimises the sum
        return total(weight * (opd - piston) ** 2)


def _from_source(lens: Lens, wave: Wave | None) -> Lens:
    """Return the lens; for a wavefront goal interface 0 is tailored first, since paths need tubes that start there."""
    if wave is None or lens.tailored_numbers[0] == 0:
        return lens
    return replace(lens, tailored=(0, *lens.tailored_numbers))


def _traced_corners(source: Emitter, sheet: Tubes, lens: Lens) -> tuple[Rays, Tensor]:
    """Trace the corners of a sheet that starts at interface 0; return rays and optical path (mm) behind the lens."""
    first, *others = lens.unbounded().interfaces
    rays, law = behind(sheet.rays, first), first.law
    index = law.n_in if isinstance(law, Refract) else 1.0  # refractive index before the next interface
    path = index * path_from_reference(source, lens.entrance.z, rays, sheet.rays.sense)
    for before, interface in pairwise((first, *others)):
        index = before.law.n_out if isinstance(before.law, Refract) else index
        refracted = behind(rays, interface)
        step = torch.stack([*refracted.position[:2], refracted.above(rays.z)]) - rays.position
        square = torch.where(refracted.alive, (step * step).sum(0), torch.ones_like(path))  # sqrt(0) has no gradient
        path, rays = path + index * torch.sqrt(square), refracted
    return rays, path


def _corner_flux(flux: Tensor) -> Tensor:
    """Return the flux at the tube corners, (m + 1, n + 1): a quarter of the flux of each tube, (m, n), per corner."""
    m, n = flux.shape
    shared = flux.new_zeros((m + 1, n + 1))
    for i in (0, 1):
        for j in (0, 1):
            shared[i : m + i, j : n + j] += flux / 4
    return shared


@dataclass(frozen=True)
class SobolevVariable:
    """Sobolev variable c (m, n): the changes (mm) of a net's heights are h (m, n) = p C^T (f(λ) · C (w c) C^T) C.

    C is the cosine transform (`cosine`), p the geometric mean spacing of control points (mm), w the local weight,
    f(λ) = (λ^-2 + λ_0^-2)^(q/2), q the exponent.  λ_ij, sums of values of `laplacian` for both axes, are eigenvalues of
    the negative Laplacian; f(λ_00) is 0.  f is λ^-q for long waves, and about λ_0^-q for waves of λ above λ_0.
    """

    weight: Tensor  # local weight w, (m, n)
    scale: Tensor  # p f(λ), (m, n)

    @classmethod
    def of(
        cls, surface: BSplineSurface, weight: Tensor, exponent: float = LAPLACIAN_POWER, level: float = math.inf,
        precision: torch.dtype | None = None,
    ) -> SobolevVariable:  # fmt: skip
        """Make the variable for the net of a surface; exponent: q; level: λ_0.

        precision: of c; None: that of the heights.  Changes of heights in float32 have a relative error of 1e-7, far
        less than what a step of a search leaves to be corrected, and take half the time.
        """
        like = surface.heights.to(precision or surface.heights.dtype)
        x, y = map(laplacian, surface.shape)
        energy = (x[:, None] + y).numpy()
        # numpy, since the rounding of torch's powers depends on how the work is divided among threads
        inverse = np.divide(1.0, energy, out=np.zeros_like(energy), where=energy > 0)
        power = np.where(energy > 0, np.power(inverse**2 + level**-2.0, exponent / 2), 0.0)
        scale = math.sqrt(math.prod(surface.pitch)) * torch.from_numpy(power)
        return cls(weight.to(like), scale.to(like))

    def zero(self) -> Tensor:
        """Return c = 0, no change of the heights."""
        return torch.zeros_like(self.weight)

    def heights(self, c: Tensor) -> Tensor:
        """Return the changes h (mm) of the heights at c."""
        return inverse_cosine(self.scale * cosine(self.weight * c))

    def adjoint(self, g: Tensor) -> Tensor:
        """Apply the transpose of `heights`: turn g, the gradient in the net's heights, into the gradient in c."""
        return self.weight * inverse_cosine(self.scale * cosine(g.to(self.scale)))


@dataclass(frozen=True)
class CoarseVariable:
    """Changes h (m, n) of a net's heights (mm) as a function of the variable c of a coarser net: h = P h'(c) Q^T.

    P (m, m') and Q (n, n') fit the finer net to the spline of h' (m', n') by least squares (bspline.resample).
    (A cosine has zero slope at the rim.  With the cosines of the finer net, a slope of the surface there needs many of
    them, which ripple all over the net; the few cosines of the coarser net ripple less.)
    """

    coarse: SobolevVariable  # variable of the coarser net
    along_x: csr_array  # matrix P
    along_y: csr_array  # matrix Q

    @classmethod
    def of(
        cls, surface: BSplineSurface, coarse: BSplineSurface, weight: Tensor, precision: torch.dtype | None = None
    ) -> CoarseVariable:
        """Make the variable for the net of `surface`; weight: local weight w (m', n') of the variable of `coarse`.

        precision: as in `SobolevVariable.of`.
        """
        across = (resampling_matrix(few, many) for few, many in zip(coarse.shape, surface.shape, strict=True))
        return cls(SobolevVariable.of(coarse, weight, COARSE_LAPLACIAN_POWER, precision=precision), *across)

    def zero(self) -> Tensor:
        """Return c = 0, no change of the heights."""
        return self.coarse.zero()

    def heights(self, c: Tensor) -> Tensor:
        """Return the changes h (mm) of the heights at c."""
        return _apply_both(self.along_x, self.coarse.heights(c), self.along_y)

    def adjoint(self, g: Tensor) -> Tensor:
        """Apply the transpose of `heights`: turn g, the gradient in the net's heights, into the gradient in c."""
        return self.coarse.adjoint(_apply_both(self.along_x.T, g, self.along_y.T))


def _apply_both(left: csr_array, t: Tensor, right: csr_array) -> Tensor:
    """Return the product left t right^T by scipy, whose single thread sums in a fixed order."""
    within = np.ascontiguousarray((left @ t.cpu().numpy()).T)
    return torch.from_numpy(np.ascontiguousarray((right @ within).T)).to(t)


def local_weight(source: Emitter, lens: Lens, goals: Sequence[Goal], number: int | None = None) -> Tensor:
    """Return the weight w = (E / mean E)^-1/2 at each control point (m, n), smoothed and clamped.

    E is the irradiance of the target where light from the control point lands; before smoothing, w = 1 for light that
    misses the screen.  On the last net, if light leaves the glass there, the weight is divided by `_excess_leverage`.
    For several goals w is the geometric mean.  number: index of the freeform interface in the lens; None: the back.
    """
    number = lens.number_of(BACK) if number is None else number
    net, onwards = lens.interfaces[number].net, lens.unbounded().interfaces[number:]
    few = [min(m, MAX_WEIGHT_POINTS) for m in net.shape]
    x, y = torch.meshgrid(*_even_axes(net, few), indexing="ij")
    _, _, at_net = rays_to(source, lens, x=x, y=y, number=number)
    with torch.no_grad():
        landings = through(at_net, onwards, [goal.screen.receiver for goal in goals])
    first, *others = (
        torch.from_numpy(_spread(_weight_for(goal, lens, number, at_net=at_net, landed=landed), net.shape))
        for goal, landed in zip(goals, landings, strict=True)
    )
    if not others:
        return first
    logarithm = sum((elementary(torch.log, w) for w in others), elementary(torch.log, first))
    return elementary(torch.exp, logarithm / len(goals))


def _weight_for(goal: Goal, lens: Lens, number: int, *, at_net: Rays, landed: Landed) -> np.ndarray:
    """Return the weight (k, l) for one goal; at_net, landed: rays (k, l) through even points, at net and receiver."""
    screen, interface = goal.screen, lens.interfaces[number]
    sides = zip(at_net.status.shape, interface.net.shape, strict=True)
    smooth = partial(gaussian_filter, sigma=[WEIGHT_SMOOTHING * (k - 1) / (m - 1) for k, m in sides])
    column, row = (p.cpu().double().numpy() for p in screen.pixel(*landed.position))
    on_screen = landed.alive.cpu().numpy() & (column > 0) & (column < screen.columns) & (row > 0) & (row < screen.rows)
    picture = gaussian_filter(goal.picture / goal.picture.mean(), TARGET_BLUR)
    irradiance = map_coordinates(picture, [row - 0.5, column - 0.5], order=1, mode="nearest")
    logarithm = np.where(on_screen, np.log(np.maximum(irradiance, MAX_LOCAL_WEIGHT**-4)), 0.0)
    weight = np.exp(-0.5 * smooth(logarithm)).clip(1 / MAX_LOCAL_WEIGHT, MAX_LOCAL_WEIGHT)
    if number == lens.tailored_numbers[-1] and interface.law.eta > 1:
        receiver = image_from_last_net(lens, screen.receiver)
        leverage = _excess_leverage(at_net, landed.position, receiver, law=interface.law, on_screen=on_screen)
        if leverage is not None:
            weight = weight / np.exp(smooth(np.log(leverage)))
    return weight


def control_point_axes(net: BSplineSurface) -> tuple[Tensor, Tensor]:
    """Return x (m,) and y (n,) of the control points of a net (m, n), evenly spaced (mm)."""
    return _even_axes(net, net.shape)


def _even_axes(net: BSplineSurface, sides: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return x and y (mm) of evenly spaced points, from the first to the last control point; sides: their numbers."""
    x, y = (torch.linspace(*ends, m, dtype=torch.float64) for ends, m in zip((net.x, net.y), sides, strict=True))
    return x, y


def _spread(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return values (k, l) at evenly spaced points interpolated linearly to `shape` points of the same extent."""
    if values.shape == shape:
        return values
    at = np.meshgrid(*(np.linspace(0, k - 1, m) for k, m in zip(values.shape, shape, strict=True)), indexing="ij")
    return map_coordinates(values, at, order=1, mode="nearest")


def _excess_leverage(
    at_net: Rays, aim: Tensor, receiver: Receiver, law: Law, on_screen: np.ndarray
) -> np.ndarray | None:
    """Return leverage / (MIN_LEVERAGE times its median), raised to at least 1, (m, n); None if it is 1 everywhere.

    The leverage is the largest singular value of ∂t/∂p, the inverse of the smallest one of ∂p/∂t; p(b, t) are the
    slopes that send light from b (`at_net`) to the target point t (`aim`).  on_screen: mask (m, n) of counted points.
    """
    for some in (slice(None, None, LEVERAGE_STRIDE), slice(None)):
        rays = replace(at_net, **{key: getattr(at_net, key)[..., some, some] for key in ("position", "direction")})
        t, lit = aim[..., some, some], on_screen[some, some]
        if not lit.any():
            return None
        step = LEVERAGE_STEP * torch.sqrt((t**2).sum(0) + receiver.per_radian(at_net.z) ** 2).max()
        centre, *shifted = (
            torch.stack(wanted_slopes(rays, t + step * torch.tensor(way).to(t).view(2, 1, 1), receiver, law))
            for way in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
        )
        (a, b), (c, d) = ((p - centre) / step for p in shifted)
        square, det = a * a + b * b + c * c + d * d, a * d - b * c
        largest = (square + torch.sqrt((square * square - 4 * det * det).clamp(min=0))) / 2
        leverage = (largest.sqrt() / det.abs().clamp(min=1e-300)).cpu().double().numpy()
        relative = np.where(lit, leverage / (MIN_LEVERAGE * np.median(leverage[lit])), 1.0)
        farther = relative.clip(1.0, MAX_LEVERAGE / MIN_LEVERAGE)
        if not (farther > 1).any():
            return None
    return farther


@dataclass(frozen=True)
class Spectrum:
    """Variable c of the slope fit: height changes h = inverse cosine transform of c · scale, with Σ c² = mean |∇h|²."""

    energy: Tensor  # slope energy of each cosine (1/mm²), (m, n), zero for the piston
    scale: Tensor  # sqrt(m n / energy), (m, n), zero for the piston

    @classmethod
    def of(cls, surface: BSplineSurface) -> Spectrum:
        """Make the variable for the net of a surface."""
        x, y = (laplacian(count) / pitch**2 for count, pitch in zip(surface.shape, surface.pitch, strict=True))
        energy = x[:, None] + y
        scale = math.sqrt(energy.numel()) * torch.where(energy > 0, energy, math.inf) ** -0.5
        return cls(energy.to(surface.heights), scale.to(surface.heights))

    def heights(self, c: Tensor) -> Tensor:
        """Return the changes h (mm) of the heights at c."""
        return inverse_cosine(c * self.scale)

    def adjoint(self, g: Tensor) -> Tensor:
        """Apply the transpose of `heights`: turn g, the gradient in the net's heights, into the gradient in c."""
        return cosine(g) * self.scale


# Product of the prime factors of sizes whose Fourier transform is fast.
SMALL_PRIMES = math.prod((2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43))


@lru_cache
def _period(m: int) -> int:
    """Return the length, in control points, of the half wave that fits once into a net of m points: m, or m - 1.

    The cosines at point k are cos(π i (k + 1/2) / m), a transform of type II, or cos(π i k / (m - 1)), of type I, for
    speed if m has a large prime factor: for 769 points, type II takes three to four times as long.
    """
    is_fast, is_fast_less_one = (pow(SMALL_PRIMES, 64, count) == 0 for count in (m, m - 1))
    return m - 1 if is_fast_less_one and not is_fast else m


def laplacian(m: int) -> Tensor:
    """Return 2 - 2 cos(π i / p), (m,), p of `_period`: the eigenvalues of the negative second difference on an axis."""
    return 2 - 2 * elementary(torch.cos, math.pi * torch.arange(m, dtype=torch.float64) / _period(m))


def cosine(t: Tensor) -> Tensor:
    """Apply the transpose of `inverse_cosine`."""
    if t.device.type == "cpu":
        return torch.from_numpy(_cosine(_cosine(t.numpy(), axis=0), axis=1))
    x, y = (_matrix(count).to(t) for count in t.shape)
    return x @ t @ y.T


def inverse_cosine(t: Tensor) -> Tensor:
    """Return the sum (m, n) of cosines along both axes with the amplitudes t (m, n).

    Along an axis of type II (`_period`) the cosines are orthonormal.  Orthonormal cosines of type I are smaller by √2
    at both ends; these are not, since a sum of long waves has to be smooth.
    """
    if t.device.type == "cpu":
        return torch.from_numpy(_inverse_cosine(_inverse_cosine(t.numpy(), axis=0), axis=1))
    x, y = (_matrix(count).to(t) for count in t.shape)
    return x.T @ t @ y


def _cosine(t: np.ndarray, axis: int) -> np.ndarray:
    kind = _kind(t, axis)
    if kind == 1:
        t = t.copy()
        _raise_ends(t, axis)
    return scipy.fft.dct(t, kind, axis=axis, norm="ortho", workers=torch.get_num_threads())


def _inverse_cosine(t: np.ndarray, axis: int) -> np.ndarray:
    kind = _kind(t, axis)
    sums = scipy.fft.idct(t, kind, axis=axis, norm="ortho", workers=torch.get_num_threads())
    if kind == 1:
        _raise_ends(sums, axis)
    return sums


def _kind(t: np.ndarray, axis: int) -> int:
    return 2 if _period(t.shape[axis]) == t.shape[axis] else 1


def _raise_ends(t: np.ndarray, axis: int) -> None:
    """Multiply the first and the last values along an axis by √2, in place."""
    np.moveaxis(t, axis, 0)[[0, -1]] *= math.sqrt(2)


@lru_cache(maxsize=4)
def _matrix(m: int) -> Tensor:
    return torch.from_numpy(_cosine(np.eye(m), axis=0))
