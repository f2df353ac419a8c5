"""Merit functions, and the variable of stage 2, in which they are nearly round.

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
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.fft
import torch
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.sparse import csr_array
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface, carrier
from bstcad.optics.channels import Channel, weighted_sum
from bstcad.optics.interfaces import Law
from bstcad.optics.irradiance import Screen
from bstcad.optics.kernels.reductions import elementary, total
from bstcad.optics.lens import Lens
from bstcad.optics.measure import RayTubes
from bstcad.optics.rays import Landed, Rays
from bstcad.optics.reach import wanted_slopes
from bstcad.optics.receivers import Receiver
from bstcad.optics.sources import Source
from bstcad.optics.trace import through
from bstcad.optics.tubes import arriving, rays_to

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


@dataclass(frozen=True)
class TubeMerit:
    """RRMSD² of the light that falls into each pixel, exact for ray tubes, plus a pull on light outside the target.

    Pixels give no gradient to light that has left the target; the pull is `overshoot` (1 / pixel²) times the mean
    square of its distance from the border in pixels.  Light lost on the way
    adds its share.  Picture, pull and loss are sums over the channels of the light.
    """

    light: RayTubes
    screen: Screen
    target: Tensor  # (rows, columns), sum 1
    overshoot: float
    own: Callable[[Tensor, Tensor], Tensor] | None = None  # of picture and target, in place of RRMSD²

    @classmethod
    def of(
        cls, channels: tuple[Channel, ...], lens: Lens, n: int, screen: Screen, target: Tensor, overshoot: float,
        own: Callable[[Tensor, Tensor], Tensor] | None = None,
    ) -> TubeMerit:  # fmt: skip
        """The merit by sheets of n x n tubes launched for `lens`; the target may have any sum."""
        light = RayTubes.launched(lens, channels, n)
        return cls(light, screen, target=target / total(target), overshoot=overshoot, own=own)

    @property
    def tubes(self) -> int:
        """The number of tubes in an evaluation."""
        return sum(sheet.flux.numel() for sheet in self.light.sheets)

    def landing(self, lens: Lens) -> tuple[Landed, ...]:
        """Where the corners of each sheet meet the screen."""
        return self.light.landing(lens, self.screen)

    def __call__(self, landed: tuple[Landed, ...]) -> tuple[Tensor, Tensor]:
        """(merit, RRMSD of the light on the screen) of the landed corners of each sheet."""
        channels, sheets = self.light.channels, self.light.sheets
        pairs = list(zip(sheets, landed, strict=True))
        flux, size = weighted_sum(channels, (total(sheet.flux) for sheet in sheets)), total(self.target**2)
        # left of it by faces and glass: darker everywhere is no worse
        left = weighted_sum(channels, (total(sheet.carried(corners)) for sheet, corners in pairs))
        images, beyond = zip(*(sheet.collect(corners, self.screen) for sheet, corners in pairs), strict=True)
        image, outside = weighted_sum(channels, images), weighted_sum(channels, beyond)
        if self.own is None:
            off = total((image / left - self.target) ** 2) / size
        else:
            off = self.own(image / left, self.target)
        arrived = weighted_sum(channels, (total(arriving(sheet.flux, corners)) for sheet, corners in pairs))
        lost = 1 - arrived / flux  # total reflection has no gradient, but must not be a gain
        seen = image.detach() / total(image.detach())
        return off + self.overshoot * outside / left + lost, (total((seen - self.target) ** 2) / size).sqrt()


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


def local_weight(source: Source, lens: Lens, target: np.ndarray, screen: Screen, number: int | None = None) -> Tensor:
    """w = (E / mean E)^-1/2 at each control point, E the target's irradiance where its light lands, smoothed.

    1 where the light does not land on the screen.  number: of the interface, which is a net; None: the back.
    """
    number = lens.number_of_back if number is None else number
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
        further = _further(at_net, landed.position, screen.plane, law=onwards[0].law, seen=seen)
        if further is not None:
            weight = weight / np.exp(gaussian_filter(np.log(further), SMOOTH))
    return torch.from_numpy(weight)


def _further(at_net: Rays, aim: Tensor, plane: Receiver, law: Law, seen: np.ndarray) -> np.ndarray | None:
    """(m, m) the throw where it is more than FAR times its median, over that; else 1.  None: 1 everywhere.

    The throw is the largest singular value of ∂t/∂p (mm), p(b, t) the slopes that send light to a place t: the inverse
    of the smallest one of ∂p/∂t.
    """
    for some in (slice(None, None, EVERY), slice(None)):
        rays = replace(at_net, **{key: getattr(at_net, key)[..., some, some] for key in ("position", "direction")})
        t, lit = aim[..., some, some], seen[some, some]
        if not lit.any():
            return None
        step = STEP * torch.sqrt((t**2).sum(0) + plane.throw(at_net.z) ** 2).max()
        here, *there = (
            torch.stack(wanted_slopes(rays, t + step * torch.tensor(way).to(t).view(2, 1, 1), plane, law))
            for way in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
        )
        (a, b), (c, d) = ((p - here) / step for p in there)
        square, det = a * a + b * b + c * c + d * d, a * d - b * c
        largest = (square + torch.sqrt((square * square - 4 * det * det).clamp(min=0))) / 2
        throw = (largest.sqrt() / det.abs().clamp(min=1e-300)).cpu().double().numpy()
        further = np.where(lit, throw / (FAR * np.median(throw[lit])), 1.0).clip(1.0, FARTHEST / FAR)
        if not (further > 1).any():
            return None
    return further


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
