"""Finish of a face: layers, their smoothing, tool marks and roughness; light traced through layers and tool marks.

A face that is printed in layers of height h along z has terraces of width w = h / |∇z| along its gradient.  Resin,
polishing or a coat that smooths the terraces like a Gaussian G of standard deviation ℓ leaves, at the distance t from
the edge of a terrace, the slope h Σ_k G(t - k w) along the gradient, whose mean is |∇z|.  Wide terraces (w >> ℓ) are
flat, and narrow ones (w << ℓ) have the slope of the design.  Terraces are finer than the pixels of a picture in most
faces, and where they lie is not known.  A picture is therefore the mean over PHASES phases of the terraces; at each
phase the slope is a smooth function on the face, so that flux tubes (tubes.py) trace it without noise.  Tool marks
sin(2π x / period) add the slope of a sine along x in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from bstcad.optics.lens.interfaces import Interface, Normal, cross, intersect, leave
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel
from bstcad.optics.numerics.reductions import elementary
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces.bspline import BSplineSurface, is_net
from bstcad.optics.surfaces.rays import Landed, Rays
from bstcad.optics.surfaces.surfaces import Surface
from bstcad.optics.trace.tubes import launch_tubes

PHASES = 32  # number of phases between the middle of a terrace and its edge; the slope is even in the phase
LAYER_STRIDES, MARK_STRIDES = (1, 7, 3), (5, 11, 13)  # phase / number of the phase, by face: odd, so all phases occur
MIN_PHASES = 4  # number of phases for each of many points of a source, which together have all phases
SERIES_WIDTH = 2.5  # width of a terrace / ℓ below which a Fourier series is summed, and above which Gaussians
MAX_WIDTH = 1e3  # largest width of a terrace / ℓ that is distinguished
MIN_WIDTH = 1e-2  # smallest width of a terrace / ℓ that is distinguished
MIN_SMOOTHING_CELLS = 0.2  # smallest ℓ / pitch of a net at which the heights of the net are filtered
SPREAD = 4  # half width of a Gaussian filter, in standard deviations


@dataclass(frozen=True)
class Finish:
    """Layers, smoothing, tool marks and roughness of a face."""

    roughness: float = 0.0  # arithmetic mean roughness Ra, nm
    roughness_length: float = 0.02  # correlation length of the roughness, mm: covariance σ² exp(-(r / length)²)
    layer_height: float | None = None  # height of the layers along z, mm; None: the face is not made in layers
    smoothing_length: float = 0.0  # standard deviation ℓ of the Gaussian that smooths the face, mm
    ripple: float = 0.0  # tool marks along x, mm RMS
    period: float = 1.0  # period of the tool marks, mm

    @property
    def rms_roughness(self) -> float:
        """RMS roughness σ (nm) of normally distributed heights: σ = sqrt(π / 2) Ra."""
        return math.sqrt(math.pi / 2) * self.roughness

    @property
    def is_marked(self) -> bool:
        """True if the face has layers or tool marks."""
        return self.layer_height is not None or self.ripple > 0

    def normal(self, normal: Normal, phase: float, mark_phase: float) -> Normal:
        """Return the normal of the finished face from the normal of the design, at phases (0 to 1) of its marks.

        Layers multiply the slopes -n_x / n_z and -n_y / n_z by `slope_ratio`.  Tool marks √2 ripple sin(2π x / period)
        add 2π √2 ripple / period cos(2π mark_phase) to the slope along x.
        """
        n_x, n_y, n_z = normal
        if self.layer_height is not None:
            slope = torch.sqrt(n_x * n_x + n_y * n_y).clamp(min=1e-30)
            ratio = slope_ratio(self.layer_height * n_z / (slope * max(self.smoothing_length, 1e-9)), phase)
            n_x, n_y = n_x * ratio, n_y * ratio
        if self.ripple > 0:
            along = 2 * math.pi * math.sqrt(2) * self.ripple / self.period * math.cos(2 * math.pi * mark_phase)
            n_x = n_x - along * n_z
        return n_x, n_y, n_z

    def smoothed(self, surface: Surface) -> Surface:
        """Return a net whose heights are convolved with the Gaussian of the smoothing length; other surfaces unchanged.

        Heights continue past the edge of the net by point reflection.  On a dome the distances from its centre are
        convolved.
        """
        if not is_net(surface):
            return surface
        net: BSplineSurface = surface
        cells = [self.smoothing_length / pitch for pitch in net.pitch]
        if max(cells) < MIN_SMOOTHING_CELLS:
            return surface
        margin = [min(math.ceil(SPREAD * c), m - 1) for c, m in zip(cells, net.shape, strict=True)]
        wide = np.pad(net.heights.cpu().numpy(), [(k, k) for k in margin], "reflect", reflect_type="odd")
        wide = gaussian_filter(wide, cells, truncate=SPREAD, mode="nearest")
        inner = wide[margin[0] : -margin[0] or None, margin[1] : -margin[1] or None]
        return replace(net, heights=torch.from_numpy(np.ascontiguousarray(inner)).to(net.heights))

    def smoothed_lens(self, lens: Lens) -> Lens:
        """Return the lens with the faces that light meets smoothed, except faces z = const."""
        for face in lens.optical_faces:
            if is_net(face.surface):
                lens = lens.with_surface(face.name, self.smoothed(face.surface))
        return lens


def slope_ratio(width: Tensor, phase: float) -> Tensor:
    """Return slope / slope of the design on a smoothed terrace, q = (width / √2π) Σ_k exp(-((phase - k) width)² / 2).

    width: width of the terrace / ℓ.  phase: distance from an edge / width of the terrace, 0 to 1.  For narrow terraces
    the equal Fourier series q = 1 + 2 Σ_n exp(-2 (π n / width)²) cos(2π n phase) is summed.
    """
    width = width.clamp(MIN_WIDTH, MAX_WIDTH)
    square = width * width
    series, gaussians = torch.ones_like(width), torch.zeros_like(width)
    for n in (1, 2, 3):
        decay = elementary(torch.exp, -2 * (math.pi * n) ** 2 / square)
        series = series + 2 * math.cos(2 * math.pi * n * phase) * decay
    for k in (-1, 0, 1, 2):
        gaussians = gaussians + elementary(torch.exp, -((phase - k) ** 2) / 2 * square)
    return torch.where(width < SERIES_WIDTH, series, width / math.sqrt(2 * math.pi) * gaussians)


@torch.no_grad()
def finished_pictures(
    lens: Lens, channels: Sequence[Channel], screens: Sequence[Screen], finish: Finish, tubes: int
) -> list[list[Tensor]]:
    """Return flux per pixel (rows, columns) / flux of the channel: for each channel a list with one for each screen.

    Each is the mean over the phases of layers and tool marks, by `tubes` x `tubes` flux tubes.  Roughness scatters no
    light here.  Faces z = const have no finish.  Of many channels each has a part of the phases.
    """
    lens = finish.smoothed_lens(lens)
    lens = lens.with_tailored(*lens.passes.faces)  # tubes start before the first face
    count = min(PHASES, max(MIN_PHASES, PHASES // len(channels))) if finish.is_marked else 1
    planes = [screen.receiver for screen in screens]
    found = []
    for k, channel in enumerate(channels):
        through = channel.through(lens)
        sheet = launch_tubes(channel.source, through, tubes)
        sums = [torch.zeros(screen.shape, dtype=torch.float64) for screen in screens]
        numbers = [(k + j * PHASES // count) % PHASES for j in range(count)]
        for landed in _landings(sheet.rays, through, planes, finish, numbers=numbers):
            for j, (screen, corners) in enumerate(zip(screens, landed, strict=True)):
                sums[j] = sums[j] + sheet.collect(corners, screen)[0].cpu().clamp(min=0) / count
        found.append(sums)
    return found


def _landings(
    rays: Rays, lens: Lens, planes: Sequence[Receiver], finish: Finish, numbers: Sequence[int]
) -> Iterator[tuple[Landed, ...]]:
    """Yield where rays before the first face land on each plane, for each number of a phase."""
    first, faces = lens.tailored_numbers[0], lens.unbounded().interfaces
    finished = [k for k in range(first, len(faces)) if finish.is_marked and _is_finished(lens, k)]
    start = finished[0] if finished else len(faces)
    for face in faces[first:start]:
        rays = cross(rays, face).rays
    met = [_meet(rays, face) for face in faces[start : start + 1]]  # rays at the faces, equal for all phases
    for number in numbers:
        light = rays
        for k, face in enumerate(faces[start:]):
            at, normal = _meet(light, face) if k else met[0]
            if start + k in finished:
                phases = (_phase(number * strides[k % len(strides)]) for strides in (LAYER_STRIDES, MARK_STRIDES))
                normal = finish.normal(normal, *phases)
            light = leave(light, face, at, normal).rays
        yield tuple(plane.land(light) for plane in planes)


def _is_finished(lens: Lens, k: int) -> bool:
    """Return True if interface k is a face of the solid other than a plane z = const."""
    return lens.solid.start <= k < lens.solid.stop and not lens.interfaces[k].surface.level


def _meet(rays: Rays, face: Interface) -> tuple[Rays, Normal]:
    return intersect(face.surface, rays, face.outline, face.status_if_missed)


def _phase(number: int) -> float:
    """Return the phase of a number: the middle of one of PHASES intervals from the edge (0) to the middle (1/2)."""
    return (number % PHASES + 0.5) / (2 * PHASES)
