"""Several goals at once: pictures on planes behind each other, and a wave; and their common merit.

The merit is the mean over the goals, by their weights w, of RRMSD² of a picture and of the square of the RMS wavefront
error in waves:

    M = (Σ_k w_k RRMSD_k² + w (RMS / λ)²) / (Σ_k w_k + w),

beside the pull on light outside a target and the light that is lost, as TubeMerit has them, in their mean over the
pictures.  The RMS is that of the optical path S of each ray to the wave's plane less the wave's own W there
(wavefront_error.py), without piston.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.channels import Channel, weighted_sum
from bstcad.optics.irradiance import Screen
from bstcad.optics.kernels.reductions import quotient, total
from bstcad.optics.lens import Lens
from bstcad.optics.measure import RayTubes
from bstcad.optics.rays import Rays
from bstcad.optics.sources import Source
from bstcad.optics.trace import behind
from bstcad.optics.tubes import Tubes, arriving
from bstcad.optics.wavefront import NM, Wave
from bstcad.optics.wavefront_error import from_reference

Ways = tuple[Rays, Tensor | None]  # the corners of a sheet behind the lens, and their optical path from the sheet (mm)


@dataclass(frozen=True, eq=False)
class Goal:
    """A picture on a plane."""

    screen: Screen
    target: np.ndarray  # (rows, columns), row 0 = y max, sum 1
    weight: float = 1.0  # of its RRMSD² among all goals


@dataclass(frozen=True, eq=False)
class JointMerit:
    """The merit of several goals, exact for ray tubes; it is differentiable in the heights of all nets."""

    light: RayTubes
    goals: tuple[Goal, ...]
    overshoot: float  # weight of light beyond the border of a target (1 / pixel²)
    wave: Wave | None = None  # of which the tubes' first channel is measured; None: none is asked for

    @classmethod
    def of(
        cls, channels: tuple[Channel, ...], lens: Lens, n: int, goals: Sequence[Goal], overshoot: float,
        wave: Wave | None = None,
    ) -> JointMerit:  # fmt: skip
        """The merit by sheets of n x n tubes launched for `lens`."""
        return cls(RayTubes.launched(_from_source(lens, wave), channels, n), tuple(goals), overshoot, wave)

    @property
    def tubes(self) -> int:
        """The number of tubes in an evaluation."""
        return len(self.goals) * sum(sheet.flux.numel() for sheet in self.light.sheets)

    def landing(self, lens: Lens) -> tuple[Ways, ...]:
        """The corners of each sheet behind the lens."""
        lens, pairs = _from_source(lens, self.wave), zip(self.light.channels, self.light.sheets, strict=True)
        return tuple(_ways(c.source, sheet, c.through(lens), self.wave is not None) for c, sheet in pairs)

    def __call__(self, ways: tuple[Ways, ...]) -> tuple[Tensor, Tensor]:
        """(merit, the largest RRMSD of the light on a target) of the corners behind the lens."""
        whole = sum(goal.weight for goal in self.goals) + (self.wave.weight if self.wave else 0.0)
        merit, worst = 0.0, torch.zeros(())
        pictures = sum(goal.weight for goal in self.goals)
        for goal in self.goals:
            off, beside, rrmsd = self._of_picture(goal, ways)
            merit = merit + goal.weight / whole * off + goal.weight / pictures * beside
            worst = torch.maximum(worst.to(rrmsd), rrmsd)
        if self.wave is not None:
            merit = merit + self.wave.weight / whole * self._of_wave(*ways[0])
        return merit, worst

    def _of_picture(self, goal: Goal, ways: tuple[Ways, ...]) -> tuple[Tensor, Tensor, Tensor]:
        """RRMSD² of one picture; its pull and loss; its RRMSD."""
        channels, sheets = self.light.channels, self.light.sheets
        pairs = [(sheet, goal.screen.plane.land(rays)) for sheet, (rays, _) in zip(sheets, ways, strict=True)]
        target = torch.from_numpy(goal.target).to(pairs[0][0].flux.device)
        flux, size = weighted_sum(channels, (total(sheet.flux) for sheet in sheets)), total(target**2)
        left = weighted_sum(channels, (total(sheet.carried(corners)) for sheet, corners in pairs))
        images, beyond = zip(*(sheet.collect(corners, goal.screen) for sheet, corners in pairs), strict=True)
        image, outside = weighted_sum(channels, images), weighted_sum(channels, beyond)
        arrived = weighted_sum(channels, (total(arriving(sheet.flux, corners)) for sheet, corners in pairs))
        off = total((quotient(image, left) - target) ** 2) / size
        seen = image.detach() / total(image.detach())
        beside = self.overshoot * outside / left + (1 - arrived / flux)
        return off, beside, (total((seen - target) ** 2) / size).sqrt()

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


def _ways(source: Source, sheet: Tubes, lens: Lens, measured: bool) -> Ways:
    """The corners of a sheet behind a lens, whose outline counts in the flux; with the path to there if measured."""
    lens = lens.unbounded()
    rays, path = sheet.coming, None
    for interface in lens.interfaces[lens.freeform[0] :]:
        there = behind(rays, interface)
        if measured and path is None:  # of light from the source: `JointMerit.of` sees to that
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
