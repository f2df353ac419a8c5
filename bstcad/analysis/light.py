"""The light through a lens: rays to draw, the apertures that light needs, losses at a mount, margins, and blur."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from bstcad.analysis.neglected_effects import difference
from bstcad.analysis.shape import ripple
from bstcad.optics import sampling
from bstcad.optics.channels import Channel, points
from bstcad.optics.emitters import Emitter
from bstcad.optics.interfaces import cross, deflect, intersect
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.measure import IMAGE_PLACES, detail_width, images, tubes_of, tubes_picture
from bstcad.optics.outlines import Circle, Outline, Rectangle
from bstcad.optics.rays import Rays
from bstcad.optics.receivers import Receiver
from bstcad.optics.trace import (
    across,
    clear_window,
    launch_strips,
    to_first_net,
    trace,
    window,
)
from bstcad.optics.unfolding import per_radian, seen_by


def _at_interfaces(rays: Rays, lens: Lens) -> list[Rays]:
    """The rays from the source, and behind each interface of the lens."""
    found = [rays]
    for interface in lens.interfaces:
        found.append(cross(found[-1], interface).rays)
    return found


# --- rays for figures -------------------------------------------------------------------------------------------------

FAN = 15  # rays
LINES = 33  # lines of the ray mapping, each way


def fan(source: Emitter, lens: Lens, plane: Receiver) -> np.ndarray:
    """Polylines (rays, k, 3) in mm in y = 0: source, each surface on the way, the plane; only rays that arrive."""
    half = clear_window(source, lens).width / 2
    x = torch.linspace(-0.98 * half, 0.98 * half, FAN, dtype=torch.float64)
    return _polylines(source.rays(x, torch.zeros_like(x), lens.entrance.z, 1.0), lens, plane)[0]


def bundle(source: Emitter, lens: Lens, plane: Receiver, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Polylines of rays through n x n cells of the light, and the flux (rays,) with which each arrives.

    Each ray carries the flux of its cell; the source's whole flux is 1.
    """
    area = clear_window(source, lens)
    x, y = (p.reshape(-1).to(torch.float64) for p in sampling.grid(area, n))
    return _polylines(source.rays(x, y, lens.entrance.z, area.area / n**2), lens, plane)


def _polylines(rays: Rays, lens: Lens, plane: Receiver) -> tuple[np.ndarray, np.ndarray]:
    """Polylines (rays, k, 3) in mm of the rays that arrive, and their flux there."""
    stops = _at_interfaces(rays, lens)
    stops.append(landed := plane.to(stops[-1]))
    corners = torch.stack([torch.stack([*stop.position[:2], stop.above(0.0)]) for stop in stops])
    arrive = landed.alive & (landed.flux > 0)
    return corners[:, :, arrive].permute(2, 0, 1).numpy(), landed.flux[arrive].numpy()


def ray_map(source: Emitter, lens: Lens, plane: Receiver) -> tuple[np.ndarray, np.ndarray]:
    """A regular grid on the front's vertex plane, and its landing points on the plane: each (k, k, 2) in mm.

    NaN where there is no light or the ray is lost.
    """
    area = clear_window(source, lens)
    line = torch.linspace(-0.499, 0.499, LINES, dtype=torch.float64)
    x, y = torch.meshgrid(line * area.width, line * area.height, indexing="ij")
    landed = trace(source.rays(x, y, lens.entrance.z, 1.0), lens, plane)
    start, end = torch.stack([x, y], dim=-1), landed.position.permute(1, 2, 0).clone()
    lost = ~(landed.alive & (landed.flux > 0))
    start[lost] = end[lost] = torch.nan
    return start.numpy(), end.numpy()


# --- the clear aperture that light needs of each face -----------------------------------------------------------------

NEEDED_RAYS = 513  # a side of the grid of rays
ROUND = 1.01  # light is round if it reaches no farther than this times its half width, and its half height
CORNERS = tuple((u, v) for u in (-1, 0, 1) for v in (-1, 0, 1))  # places on an extended source, in halves of its extent
WHOLE = 0.99  # part of the clear aperture: light that reaches so far fills the face


def used(source: Emitter, lens: Lens) -> dict[str, Outline | None]:
    """Smallest circle or rectangle about the axis (mm) that holds all light on each face of the solid that it meets.

    None: the light fills the face's clear aperture.  Only light that gets through all faces counts; of an extended
    source the light of its middle and of the ends of its extent.
    """
    elements = [source]
    if source.extent is not None:
        a, b = source.extent.half_extent
        elements = [source.element(a * u, b * v) for u, v in CORNERS if not (source.extent.is_round and u and v)]
    hits = torch.cat([_hits(element.central, lens) for element in elements], dim=2)
    of_solid, apertures = hits[lens.solid], dict(zip(("front", "back"), lens.apertures, strict=True))
    numbers = {face: list(lens.passes.numbers_of(face)) for face in lens.passes.faces}
    return {face: _patch(torch.cat([*of_solid[k]], dim=1), apertures[face]) for face, k in numbers.items()}


def _hits(source: Emitter, lens: Lens) -> Tensor:
    """x and y (faces, 2, n) (mm) on each face of the rays that get through all faces."""
    area = clear_window(source, lens)
    line = torch.linspace(-0.5, 0.5, NEEDED_RAYS, dtype=torch.float64) * (1 - 1e-9)
    x, y = (p.reshape(-1) for p in torch.meshgrid(line * area.width, line * area.height, indexing="ij"))
    _, *behind = _at_interfaces(source.rays(x, y, lens.entrance.z, 1.0), lens)
    through = behind[-1].alive & (behind[-1].flux > 0)
    return torch.stack([rays.position[:2, through] for rays in behind])


def _patch(hits: Tensor, aperture: Outline) -> Outline | None:
    """Shape that holds the hits (2, n) on a face of that clear aperture."""
    if not hits.numel():
        return Circle(0.0)
    half_x, half_y = (float(part.abs().max()) for part in hits)
    radius = float(torch.hypot(*hits).max())
    patch = Circle(radius) if radius <= ROUND * min(half_x, half_y) else Rectangle(2 * half_x, 2 * half_y)
    a, b = aperture.half_extent
    alike = aperture.is_round or not patch.is_round
    return None if alike and half_x >= WHOLE * a and half_y >= WHOLE * b else patch


# --- the light that a ripple moves ------------------------------------------------------------------------------------


@torch.no_grad()
def rrmsd_of_ripple(channel: Channel, lens: Lens, screen: Screen, face: Literal["front", "back"]) -> float:
    """Return the RRMSD between the pictures of a lens with and without the ripple of a face; 0 without a ripple.

    channel: of a point of the source.  The ripple fades towards the rim, and so does its light; a small one's RRMSD is
    proportional to its height.
    """
    net = getattr(lens, face)
    waves = ripple(net)
    if waves.slope == 0:
        return 0.0
    smooth = replace(lens, **{face: replace(net, heights=net.heights - torch.from_numpy(waves.heights))})
    n = tubes_of(lens, max(screen.shape))
    before, after = (tubes_picture(each, [channel], screen, n).cpu().numpy() for each in (smooth, lens))
    return difference(after, before) / waves.fading


# --- the light that a mount blocks ------------------------------------------------------------------------------------

MOUNT_RAYS = 512  # a side of the grid of rays, shared by all channels
FEWEST = 48  # a side, of one channel


@dataclass(frozen=True)
class MountLosses:
    """Shares of light that a mount blocks."""

    cut: float  # share, missing the clear apertures, of the light that gets through both faces of the uncut lens
    on_flange: float  # share, meeting a wall of the flange's opening, of the light through the clear apertures


@torch.no_grad()
def mount_losses(lens: Lens, channels: Sequence[Channel], flange: tuple[float, float] | None = None) -> MountLosses:
    """Losses of a lens with clear apertures.  flange: z (mm) of both ends of its opening; None without a flange."""
    uncut = passing = blocked = 0.0
    n = max(FEWEST, math.ceil(MOUNT_RAYS / math.sqrt(len(channels))))
    for channel in channels:
        own = replace(channel.through(lens), losses=None)
        bare = replace(own, clear=None)
        area = window(channel.source, bare)
        x, y = sampling.grid(area, n)
        rays = channel.source.rays(x, y, own.entrance.z, channel.weight * area.area / n**2)
        solid = slice(own.solid.start, own.solid.stop + 1)  # the light before, in and behind it
        whole, through = _at_interfaces(rays, bare)[solid][-1], _at_interfaces(rays, own)[solid]
        out = through[-1]
        uncut += float(whole.flux[whole.alive].sum())
        passing += float(out.flux[out.alive].sum())
        if flange is not None:
            blocked += float(out.flux[out.alive & _meets(through, own.apertures[1], flange)].sum())
    return MountLosses(1 - passing / uncut if uncut else 0.0, blocked / passing if passing else 0.0)


def _meets(rays: Sequence[Rays], rim: Outline, planes: Iterable[float]) -> Tensor:
    """Is a ray outside the rim on one of the planes, before the first face or behind the last?"""
    first, (coming, *_, leaving) = rays[1], rays
    beyond = torch.zeros_like(leaving.alive)
    for z in planes:
        for at, end in ((coming, first), (leaving, None)):
            way = -at.above(z) / torch.where(at.direction[2] == 0, torch.full_like(at.flux, 1e-300), at.direction[2])
            x, y, _ = at.position + way * at.direction
            between = (way > 0) if end is None else (way > 0) & (at.sense * end.above(z) > 0)
            beyond |= between & ~rim.contains(x, y)
    return beyond


# --- margins of the trace ---------------------------------------------------------------------------------------------

MARGIN_RAYS = 512  # a side of the window


@dataclass(frozen=True)
class Margins:
    """The worst of all rays that carry light to the back face."""

    tir_margin_deg: float | None  # critical angle minus angle of incidence (degrees), < 0: reflected; None: no such ray
    newton_slope_min: float | None  # |F'(t)| at a tailored face, the denominator of Newton's step; 1 head on, 0 grazing
    non_finite: int  # count of control points, hits and landings that are not finite


@torch.no_grad()
def margins(channels: Sequence[Channel], lens: Lens, screen: Screen, seed: int, n: int = MARGIN_RAYS) -> Margins:
    """Margins over n x n stratified rays a channel; the k points of an extended source share n x n rays.

    cos θ = (d_z - d_x z_x - d_y z_y) / sqrt(1 + z_x² + z_y²) where light leaves the glass, total reflection at
    sin θ = 1 / n; F(t) = z(t) - sag(x(t), y(t)), F' = d_z - d_x z_x - d_y z_y at each face from the first net on.
    """
    margin, slope, n = math.inf, math.inf, math.ceil(n / math.sqrt(points(channels)))
    wrong = sum(int((~torch.isfinite(net.heights)).sum()) for net in lens.nets)
    for channel in channels:
        through = channel.through(lens)
        for rays in launch_strips(channel.source, through, n, seed):
            rays = to_first_net(rays, through)
            for face in through.interfaces[through.freeform[0] : through.solid.stop]:
                met, z_x, z_y = intersect(face.surface, rays, face.outline, face.status_if_missed)
                dx, dy, dz = met.direction
                along = met.sense * (dz - dx * z_x - dy * z_y)
                meets = met.alive & (met.flux > 0)
                wrong += int((~torch.isfinite(met.position)).any(0)[meets].sum())
                if bool(meets.any()):
                    slope = min(slope, float(along.abs()[meets].min()))
                if bool(meets.any()) and face.law.eta > 1:
                    cosine = (along / torch.sqrt(1 + z_x * z_x + z_y * z_y))[meets].clamp(-1.0, 1.0)
                    critical = math.degrees(math.asin(1.0 / face.law.eta))
                    margin = min(margin, critical - float(torch.rad2deg(torch.arccos(cosine)).max()))
                rays = deflect(met, z_x, z_y, face.law, level=face.surface.level).rays
            landed = screen.plane.land(across(rays, through.behind))
            wrong += int((~torch.isfinite(landed.position)).any(0)[landed.alive].sum())
    return Margins(None if math.isinf(margin) else margin, None if math.isinf(slope) else slope, wrong)


# --- blur by an extended source ---------------------------------------------------------------------------------------

REACH = 2.5  # times the wider of lens and picture: the nearest target for a plate a tenth as thick as wide
WORTH = 0.9  # part of the width that a nearer target has to come below, or the report does not name it


@dataclass(frozen=True)
class Blur:
    """The source's image on the target, a mean over the lens, weighted by flux.

    No lens shows detail much finer than the image; but a lens may overlay many such images, so that their sum is nearer
    to the target than the blurred target is.
    """

    width: float  # diameter of the even disc with the same rms distance from the centroid, in `unit`
    pixels: float  # the width in pixels
    rrmsd: float  # between the target and the target convolved with the mean image
    unit: str = "mm"  # unit of the receiver


def blur(
    channels: Sequence[Channel], lens: Lens, screen: Screen, target: np.ndarray, n: int = IMAGE_PLACES
) -> Blur | None:
    """The blur by a source whose points are the channels, at its first line; None for a point source.

    None, too, where none of its light gets through the lens, so that there is no image.
    """
    if points(channels) == 1:
        return None
    found = images(channels, lens, screen, n)
    if not found.flux.any():
        return None
    width = found.width()
    return Blur(width * _pixel(screen), width, found.deviation(target), screen.plane.unit)


@dataclass(frozen=True)
class FinestDetail:
    """The least width of a point of the picture, whatever the lens: the source's image, sampled by pixels.

    w = √(D² + 4/3 p²), where D is the diameter of the source's image and p the side of a pixel
    (optics.measure.detail_width).  D is proportional to the distance L from the lens to the target: D = 2 L
    tan(δ / 2) for parallel light of divergence δ through a thin plate, D = d L / l for a source of diameter d at the
    distance l before it.  On a target at L' it is D L' / L.  The limit by the net of control points is not included.
    """

    width: float  # w, in `unit`
    source_image: float  # D, in `unit`
    pixel: float  # p, in `unit`
    distance: float  # mm; L
    nearer_distance: float | None  # mm; L' of a nearer target that a lens can light with the same picture; None: no L'
    nearer_width: float | None  # w on that target, in `unit`
    of: str  # the size of the source: its key in the scene, or an assumption
    assumed: bool  # the scene does not state the size
    unit: str = "mm"  # unit of the receiver


def finest_detail(source_image: float, lens: Lens, screen: Screen, of: str, assumed: bool = False) -> FinestDetail:
    """The finest detail on a target where the image of a source of the size `of` is `source_image` pixels wide."""
    distance, pixel = abs(seen_by(lens, screen).throw(lens.back.z)), _pixel(screen)
    grows = distance == abs(per_radian(lens, screen))  # with the distance; an image over angles keeps its width
    sizes = (*(2 * half for half in lens.outline.half_extent), *(high - low for low, high in (screen.x, screen.y)))
    nearer, image = REACH * max(sizes), source_image * pixel
    here, there = (detail_width(image * share, pixel) for share in (1.0, nearer / distance))
    worth = there < WORTH * here and grows and not lens.behind
    return FinestDetail(
        here, image, pixel, distance, nearer_distance=nearer if worth else None, nearer_width=there if worth else None,
        of=of, assumed=assumed, unit=screen.plane.unit,
    )  # fmt: skip


def _pixel(screen: Screen) -> float:
    """The side of a pixel, of a square of its area, in the unit of the receiver."""
    return 1 / math.sqrt(math.prod(screen.per_unit))
