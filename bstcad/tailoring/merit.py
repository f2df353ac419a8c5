"""The merit that stages 2 and 3 make least, and their variable, in which it is nearly round.

The merit is the mean over the goals, by their weights w, of RRMSD² of a picture and of the square of the RMS wavefront
error in waves:

    M = (Σ_k w_k RRMSD_k² + w (RMS / λ)²) / (Σ_k w_k + w),

and beside it the mean over the pictures of a pull on light outside of a target and of the light that is lost.  Pixels
give no gradient to light that has left the target; the pull is `overshoot` (1 / pixel²) times the mean square of its
distance from the border in pixels.  Pictures, pulls and losses are sums over the channels of the light; of a source of
some size the light of its middle, blurred (source_image.py).  The RMS is that of the optical path S of each ray to the
wave's plane less the wave's own W there (wavefront_error.py), without piston.

A change δz of the last face moves the light by the throw L times its slope and so changes the irradiance by about
E L Δδz; with dA_t = (e / E) dA_b, e the flux density on the back face, the squared error is

    ∫ δE² dA_t  =  L² ∫ e E (Δδz)² dA_b.

Its Hessian is Δ e E Δ, so in c with δz = Δ^-1 E^-1/2 c it would be the unit matrix for a beam of even e.  The pixels
average out detail finer than they are, which makes a weaker power of Δ better: 0.5 by measurement, since letters gain
by a still weaker one and portraits by a stronger one.  The weight E^-1/2 halves the evaluations that a picture with
dark parts takes.  Δ is diagonal in the cosine transform of the net.

L is no constant near the critical angle: there dθ' = η cos θ / cos θ' dθ grows without bound, and a place of the face
moves its light many times further than most places do.  The weight falls by as much there, and is left alone elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
import scipy.fft
import torch
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.sparse import csr_array
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface, carrier
from bstcad.optics.channels import Channel, weighted_sum
from bstcad.optics.emitters import Emitter
from bstcad.optics.goal import Goal
from bstcad.optics.interfaces import Law
from bstcad.optics.irradiance import Screen
from bstcad.optics.kernels.reductions import elementary, quotient, total
from bstcad.optics.lens import Lens
from bstcad.optics.measure import RayTubes
from bstcad.optics.rays import Landed, Rays
from bstcad.optics.reach import wanted_slopes
from bstcad.optics.receivers import Receiver
from bstcad.optics.trace import behind, through
from bstcad.optics.tubes import Tubes, arriving, rays_to
from bstcad.optics.unfolding import seen_from_last_net
from bstcad.optics.wavefront import NM, Wave
from bstcad.optics.wavefront_error import from_reference
from bstcad.tailoring.source_image import Blur, Spread, blurred, blurs, bordered, unseen

EXPONENT = 0.5  # of the Laplacian
OF_COARSE = 0.75  # the same for coarse cells, which are wider than a pixel
BLUR = 1.0  # pixels; irradiance for the weight
SMOOTH = 1.5  # control points; of the weight's logarithm
MOST = 4.0  # weights are clamped to [1 / MOST, MOST]
FAR, FARTHEST = 3.0, 96.0  # times the median throw: from there on the weight falls with the throw, and no further
STEP = 1e-6  # of the distance to the target: step of the difference quotients of the throw
EVERY = 8  # control points, at one of which the throw is looked at first: few lenses throw that far anywhere


def landing(rays: Landed, aim: Tensor) -> Tensor:
    """Mean of |P_t - P|² over the rays that land (mm²); Wang et al. 2023, Eq. 14, as a mean."""
    lit = rays.alive & (rays.flux > 0)
    miss = (rays.position[0] - aim[0]) ** 2 + (rays.position[1] - aim[1]) ** 2
    return total(torch.where(lit, miss, torch.zeros_like(miss))) / lit.sum()


class Landings(NamedTuple):
    """Where the corners of the tubes get to."""

    on_goals: tuple[tuple[Landed, ...], ...]  # of each goal and sheet
    behind: tuple[Rays, Tensor] | None = None  # of the first sheet behind the lens, and their optical path there (mm)


@dataclass(frozen=True, eq=False)
class Merit:
    """The merit of pictures and of a wave, exact for ray tubes; it is differentiable in the heights of all nets."""

    light: RayTubes  # of a source of some size: that of its middle
    goals: tuple[Goal, ...]
    overshoot: float  # weight of light beyond the border of a target (1 / pixel²)
    wave: Wave | None = None  # of which the tubes' first channel is measured; None: none is asked for
    own: Callable[[Tensor, Tensor], Tensor] | None = None  # of picture and target, in place of RRMSD²
    blurs: tuple[tuple[Blur, ...], ...] = ()  # of each goal and channel; (): the source is a point
    left_out: tuple[Tensor, ...] = ()  # (rows, columns) of each goal's picture, by the images; (): nobody measured it

    @classmethod
    def of(
        cls, channels: Sequence[Channel], lens: Lens, n: int, goals: Sequence[Goal], overshoot: float, *,
        wave: Wave | None = None, own: Callable[[Tensor, Tensor], Tensor] | None = None, spread: Spread | None = None,
        seed: int | None = None,
    ) -> Merit:  # fmt: skip
        """By sheets of n x n tubes launched for `lens`.

        spread: of a source of some size, whose middle's light the channels are.  seed: of the rays by which is measured
        what its images leave out, which takes most of a second a goal; None: nobody does.
        """
        light = RayTubes.launched(_from_source(lens, wave), channels, n)
        merit = cls(light, tuple(goals), overshoot, wave=wave, own=own)
        if spread is None:
            return merit
        exact = lens.plain()
        merit = replace(merit, blurs=tuple(blurs(spread, exact, goal.receiver) for goal in goals))
        if seed is None:
            return merit
        with torch.no_grad():
            seen = [merit.picture(k, landed)[0] for k, landed in enumerate(merit.landing(lens).on_goals)]
        missed = (
            unseen(image, spread.draw, exact, goal.receiver, border=blur.border, seed=seed)
            for image, goal, (blur, *_) in zip(seen, merit.goals, merit.blurs, strict=True)
        )
        return replace(merit, left_out=tuple(missed))

    @property
    def tubes(self) -> int:
        """The number of tubes in an evaluation."""
        return len(self.goals) * sum(sheet.flux.numel() for sheet in self.light.sheets)

    @cached_property
    def targets(self) -> tuple[Tensor, ...]:
        """(rows, columns) the picture of each goal, where the light is; one alone may have any sum."""
        pictures = tuple(torch.from_numpy(goal.picture).to(self.light.sheets[0].flux.device) for goal in self.goals)
        return tuple(picture / total(picture) for picture in pictures) if self._is_one else pictures

    @property
    def _is_one(self) -> bool:
        """Is there one picture, and nothing else?"""
        return len(self.goals) == 1 and self.wave is None

    def landing(self, lens: Lens) -> Landings:
        """Where the corners of each sheet meet the receivers; one receiver alone the kernels take in the same go."""
        if self._is_one:
            return Landings((self.light.landing(lens, self.goals[0].receiver),))
        lens, pairs = _from_source(lens, self.wave), zip(self.light.channels, self.light.sheets, strict=True)
        ways = [_ways(c.source, sheet, c.through(lens), self.wave is not None) for c, sheet in pairs]
        on_goals = tuple(tuple(goal.receiver.plane.land(rays) for rays, _ in ways) for goal in self.goals)
        return Landings(on_goals, None if self.wave is None else ways[0])

    def __call__(self, landings: Landings) -> tuple[Tensor, Tensor]:
        """(merit, the largest RRMSD of the light on a target) of the landed corners."""
        pictures = sum(goal.weight for goal in self.goals)
        whole = pictures + (self.wave.weight if self.wave else 0.0)
        merit, worst = 0.0, torch.zeros(())
        for k, (goal, landed) in enumerate(zip(self.goals, landings.on_goals, strict=True)):
            off, pull, lost, rrmsd = self._of_goal(k, landed)
            if self._is_one:
                return off + pull + lost, rrmsd
            merit = merit + goal.weight / whole * off + goal.weight / pictures * (pull + lost)
            worst = torch.maximum(worst.to(rrmsd), rrmsd)
        if self.wave is not None:
            merit = merit + self.wave.weight / whole * self._of_wave(*landings.behind)
        return merit, worst

    def picture(self, k: int, landed: Sequence[Landed]) -> tuple[Tensor, Tensor]:
        """(picture of a goal, pull on light outside), both over the light that faces and glass leave."""
        channels, screen = self.light.channels, self.goals[k].receiver
        pairs = list(zip(self.light.sheets, landed, strict=True))
        # left of it by faces and glass: darker everywhere is no worse
        left = weighted_sum(channels, (total(sheet.carried(corners)) for sheet, corners in pairs))
        seen = bordered(screen, self.blurs[k][0].border) if self.blurs else screen
        images, beyond = zip(*(sheet.collect(corners, seen) for sheet, corners in pairs), strict=True)
        outside = weighted_sum(channels, beyond)
        if not self.blurs:
            return quotient(weighted_sum(channels, images), left), self.overshoot * outside / left
        smooth = (blurred(one / left, blur) for one, blur in zip(images, self.blurs[k], strict=True))
        return weighted_sum(channels, smooth), self.overshoot * (outside / left)

    def _of_goal(self, k: int, landed: Sequence[Landed]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """RRMSD² of a picture, or what stands in its place; the pull on light outside, the light lost; RRMSD."""
        channels, sheets, target = self.light.channels, self.light.sheets, self.targets[k]
        image, pull = self.picture(k, landed)
        if self.left_out:
            image = image + self.left_out[k]
        size = total(target**2)
        off = total((image - target) ** 2) / size if self.own is None else self.own(image, target)
        pairs = zip(sheets, landed, strict=True)
        arrived = weighted_sum(channels, (total(arriving(sheet.flux, corners)) for sheet, corners in pairs))
        # total reflection has no gradient, but must not be a gain
        lost = 1 - arrived / weighted_sum(channels, (total(sheet.flux) for sheet in sheets))
        shown = image.detach() / total(image.detach())
        return off, pull, lost, (total((shown - target) ** 2) / size).sqrt()

    def _of_wave(self, rays: Rays, path: Tensor) -> Tensor:
        """(RMS / λ)² of the optical path differences without piston, by the flux around each corner."""
        wavelength = self.light.channels[0].source.wavelength
        above = rays.above(self.wave.z)
        way = -above / torch.where(rays.alive, rays.direction[2], torch.ones_like(above))
        x, y = (p + way * d for p, d in zip(rays.position[:2], rays.direction[:2], strict=True))
        held = rays.alive & self.wave.contains(x.detach(), y.detach())
        flux = torch.where(held, _at_corners(self.light.sheets[0].flux), torch.zeros_like(x))
        opd = (path + way - self.wave.path(x, y, wavelength)) / (wavelength * NM)
        opd = torch.where(held, opd, torch.zeros_like(opd))
        share = flux / total(flux)
        piston = total(share * opd).detach()  # the mean makes the sum least: there is no gradient in it
        return total(share * (opd - piston) ** 2)


def _from_source(lens: Lens, wave: Wave | None) -> Lens:
    """The lens, whose tubes begin at the source where paths are to be measured."""
    if wave is None or not lens.freeform[0]:
        return lens
    return replace(lens, shaped=(0, *lens.freeform))


def _ways(source: Emitter, sheet: Tubes, lens: Lens, measured: bool) -> tuple[Rays, Tensor | None]:
    """The corners of a sheet behind a lens, whose outline counts in the flux; with the path to there if measured."""
    lens = lens.unbounded()
    rays, path = sheet.coming, None
    for interface in lens.interfaces[lens.freeform[0] :]:
        there = behind(rays, interface)
        if measured and path is None:  # of light from the source: `Merit.of` sees to that
            index = 1.0 if interface.law.reverses else interface.law.n_in
            path = index * from_reference(source, lens.entrance.z, there, rays.sense)
        elif measured:
            off = torch.stack([*there.position[:2], there.above(rays.z)]) - rays.position
            square = torch.where(there.alive, (off * off).sum(0), torch.ones_like(path))  # no root of zero: no gradient
            path = path + index * torch.sqrt(square)
        if measured and not interface.law.reverses:
            index = interface.law.n_out
        rays = there
    return rays, path


def _at_corners(flux: Tensor) -> Tensor:
    """(m + 1, n + 1) the flux of the tubes (m, n) shared out among their corners."""
    m, n = flux.shape
    shared = flux.new_zeros((m + 1, n + 1))
    for i in (0, 1):
        for j in (0, 1):
            shared[i : m + i, j : n + j] += flux / 4
    return shared


@dataclass(frozen=True)
class SobolevVariable:
    """Heights h (m, n) in mm as a function of c (m, n): h = p C^T (λ^-e · C (w c) C^T) C, e the exponent.

    C is the orthonormal cosine transform; λ_ij = 4 - 2 cos(π i / m) - 2 cos(π j / n) is the Laplacian on the
    net, zero for the piston; p the (mean) pitch in mm.
    """

    weight: Tensor  # (m, n) w, a local step size
    scale: Tensor  # (m, n) p λ^-e

    @classmethod
    def of(cls, surface: BSplineSurface, weight: Tensor, exponent: float = EXPONENT) -> SobolevVariable:
        """For the net of a surface."""
        x, y = map(laplacian, surface.shape)
        energy = x[:, None] + y
        # by numpy, in one thread: torch rounds a power in another way where a thread's share ends
        power = torch.from_numpy(np.power(torch.where(energy > 0, energy, math.inf).numpy(), -exponent))
        scale = math.sqrt(math.prod(surface.pitch)) * power
        return cls(weight.to(surface.heights), scale.to(surface.heights))

    def zero(self) -> Tensor:
        """c of no change."""
        return torch.zeros_like(self.weight)

    def heights(self, c: Tensor) -> Tensor:
        """h of c (mm)."""
        return inverse_cosine(self.scale * cosine(self.weight * c))

    def adjoint(self, g: Tensor) -> Tensor:
        """The transpose of `heights`: from a gradient in the control points to one in c."""
        return self.weight * inverse_cosine(self.scale * cosine(g))


@dataclass(frozen=True)
class CoarseVariable:
    """Heights h (m, n) in mm of a net by the variable of a coarser net over the same face: h = P h'(c) Q^T.

    P (m, m') and Q (n, n') carry a spline to the finer net.  (The long cosines of the finer net itself have no slope at
    its rim, and would make one there by ripples all over it.)
    """

    coarse: SobolevVariable
    along_x: csr_array  # P
    along_y: csr_array  # Q

    @classmethod
    def of(cls, surface: BSplineSurface, coarse: BSplineSurface, weight: Tensor) -> CoarseVariable:
        """For the net of a surface by a coarser one, with the weight at the coarser one's control points."""
        across = (carrier(few, many) for few, many in zip(coarse.shape, surface.shape, strict=True))
        return cls(SobolevVariable.of(coarse, weight, OF_COARSE), *across)

    def zero(self) -> Tensor:
        """c of no change."""
        return self.coarse.zero()

    def heights(self, c: Tensor) -> Tensor:
        """h of c (mm)."""
        return _between(self.along_x, self.coarse.heights(c), self.along_y)

    def adjoint(self, g: Tensor) -> Tensor:
        """The transpose of `heights`: from a gradient in the control points to one in c."""
        return self.coarse.adjoint(_between(self.along_x.T, g, self.along_y.T))


def _between(left: csr_array, t: Tensor, right: csr_array) -> Tensor:
    """left t right^T; by scipy, in one thread, whose sums have one order."""
    within = np.ascontiguousarray((left @ t.cpu().numpy()).T)
    return torch.from_numpy(np.ascontiguousarray((right @ within).T)).to(t)


def local_weight(source: Emitter, lens: Lens, target: np.ndarray, screen: Screen, number: int | None = None) -> Tensor:
    """w = (E / mean E)^-1/2 at each control point, E the target's irradiance where its light lands, smoothed.

    1 where the light does not land on the screen.  number: of the interface, which is a net; None: the back.
    """
    number = lens.number_of("back") if number is None else number
    net, onwards = lens.interfaces[number].surface, lens.unbounded().interfaces[number:]
    ends = zip((net.x, net.y), net.shape, strict=True)
    places = (torch.linspace(low, high, count, dtype=torch.float64) for (low, high), count in ends)
    x, y = torch.meshgrid(*places, indexing="ij")
    _, _, at_net = rays_to(source, lens, x=x, y=y, number=number)
    with torch.no_grad():
        landed = through(at_net, onwards, screen.plane)
    column, row = (p.cpu().double().numpy() for p in screen.pixel(*landed.position))
    seen = landed.alive.cpu().numpy() & (column > 0) & (column < screen.columns) & (row > 0) & (row < screen.rows)
    picture = gaussian_filter(target / target.mean(), BLUR)
    irradiance = map_coordinates(picture, [row - 0.5, column - 0.5], order=1, mode="nearest")
    logarithm = np.where(seen, np.log(np.maximum(irradiance, MOST**-4)), 0.0)
    weight = np.clip(np.exp(-0.5 * gaussian_filter(logarithm, SMOOTH)), 1 / MOST, MOST)
    if number == lens.freeform[-1] and onwards[0].law.eta > 1:
        plane = seen_from_last_net(lens, screen.plane)
        farther = _farther(at_net, landed.position, plane, law=onwards[0].law, seen=seen)
        if farther is not None:
            weight = weight / np.exp(gaussian_filter(np.log(farther), SMOOTH))
    return torch.from_numpy(weight)


def _farther(at_net: Rays, aim: Tensor, plane: Receiver, law: Law, seen: np.ndarray) -> np.ndarray | None:
    """(m, m) the throw where it is more than FAR times its median, over that; else 1.  None: 1 everywhere.

    The throw is the largest singular value of ∂t/∂p (mm), p(b, t) the slopes that send light to a place t: the inverse
    of the smallest one of ∂p/∂t.
    """
    for some in (slice(None, None, EVERY), slice(None)):
        rays = replace(at_net, **{key: getattr(at_net, key)[..., some, some] for key in ("position", "direction")})
        t, lit = aim[..., some, some], seen[some, some]
        if not lit.any():
            return None
        step = STEP * torch.sqrt((t**2).sum(0) + plane.per_radian(at_net.z) ** 2).max()
        here, *there = (
            torch.stack(wanted_slopes(rays, t + step * torch.tensor(way).to(t).view(2, 1, 1), plane, law))
            for way in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
        )
        (a, b), (c, d) = ((p - here) / step for p in there)
        square, det = a * a + b * b + c * c + d * d, a * d - b * c
        largest = (square + torch.sqrt((square * square - 4 * det * det).clamp(min=0))) / 2
        throw = (largest.sqrt() / det.abs().clamp(min=1e-300)).cpu().double().numpy()
        farther = np.where(lit, throw / (FAR * np.median(throw[lit])), 1.0).clip(1.0, FARTHEST / FAR)
        if not (farther > 1).any():
            return None
    return farther


@dataclass(frozen=True)
class Spectrum:
    """Heights h (m, n) of a net as a function of the Sobolev variable c: h = C^T (c · scale) C; Σ c² is mean |∇h|²."""

    energy: Tensor  # (m, n) slope energy of each cosine (1/mm²), zero for the piston
    scale: Tensor  # (m, n) sqrt(m n / energy), zero for the piston

    @classmethod
    def of(cls, surface: BSplineSurface) -> Spectrum:
        """For the net of a surface."""
        x, y = (laplacian(count) / pitch**2 for count, pitch in zip(surface.shape, surface.pitch, strict=True))
        energy = x[:, None] + y
        scale = math.sqrt(energy.numel()) * torch.where(energy > 0, energy, math.inf) ** -0.5
        return cls(energy.to(surface.heights), scale.to(surface.heights))

    def heights(self, c: Tensor) -> Tensor:
        """h of c (mm)."""
        return inverse_cosine(c * self.scale)

    def adjoint(self, g: Tensor) -> Tensor:
        """The transpose of `heights`: from a gradient in the control points to one in c."""
        return cosine(g) * self.scale


def laplacian(m: int) -> Tensor:
    """(m,) 2 - 2 cos(π i / m): the factor of each cosine under the second difference along one axis."""
    return 2 - 2 * elementary(torch.cos, math.pi * torch.arange(m, dtype=torch.float64) / m)


def cosine(t: Tensor) -> Tensor:
    """The orthonormal cosine transform (type II) along both axes."""
    if t.device.type == "cpu":
        return torch.from_numpy(scipy.fft.dctn(t.numpy(), norm="ortho", workers=torch.get_num_threads()))
    x, y = (_matrix(count).to(t) for count in t.shape)
    return x @ t @ y.T


def inverse_cosine(t: Tensor) -> Tensor:
    """The inverse of `cosine`, which is its transpose."""
    if t.device.type == "cpu":
        return torch.from_numpy(scipy.fft.idctn(t.numpy(), norm="ortho", workers=torch.get_num_threads()))
    x, y = (_matrix(count).to(t) for count in t.shape)
    return x.T @ t @ y


@lru_cache(maxsize=4)
def _matrix(m: int) -> Tensor:
    return torch.from_numpy(scipy.fft.dct(np.eye(m), axis=0, norm="ortho"))
