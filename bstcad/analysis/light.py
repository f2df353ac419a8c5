"""Light through a lens: rays for plots, clear apertures, ripple, losses at a mount, margins of the trace, blur."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bstcad.analysis.neglected_effects import difference
from bstcad.analysis.shape import ripple
from bstcad.optics.lens.interfaces import cross, deflect, intersect
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel, points_per_line
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.bspline import require_net
from bstcad.optics.surfaces.outlines import Circle, Outline, Rectangle
from bstcad.optics.surfaces.rays import Rays
from bstcad.optics.trace.measure import tubes_of, tubes_picture
from bstcad.optics.trace.source_images import IMAGE_POINTS_PER_SIDE, detail_width, images
from bstcad.optics.trace.trace import across, clear_window, launch_strips, to_first_net, trace, window
from bstcad.optics.trace.unfolding import image_from_lens, per_radian


def _at_interfaces(rays: Rays, lens: Lens) -> list[Rays]:
    """Return the rays from the source, and those behind each interface of the lens."""
    stops = [rays]
    for interface in lens.interfaces:
        stops.append(cross(stops[-1], interface).rays)
    return stops


# --- rays for plots ---------------------------------------------------------------------------------------------------

FAN_RAYS = 15  # number of rays in `fan`
GRID_LINES = 33  # number of grid lines in each direction in `ray_map`


def fan(source: Emitter, lens: Lens, receiver: Receiver) -> np.ndarray:
    """Return polylines (rays, points, 3) in mm from source to receiver, via (x, 0) on the first vertex plane."""
    half = clear_window(source, lens).width / 2
    x = torch.linspace(-0.98 * half, 0.98 * half, FAN_RAYS, dtype=torch.float64)
    return _polylines(source.rays_through(x, torch.zeros_like(x), lens.entrance.z, 1.0), lens, receiver)[0]


def bundle(source: Emitter, lens: Lens, receiver: Receiver, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return polylines (rays, points, 3), mm, of one ray per cell of n x n cells of the beam, and the flux on arrival.

    Each ray starts with the flux of its cell; the total flux of the source is 1.  Rays that do not arrive are omitted.
    """
    area = clear_window(source, lens)
    x, y = (p.reshape(-1).to(torch.float64) for p in sampling.grid(area, n))
    return _polylines(source.rays_through(x, y, lens.entrance.z, area.area / n**2), lens, receiver)


def _polylines(rays: Rays, lens: Lens, receiver: Receiver) -> tuple[np.ndarray, np.ndarray]:
    """Return polylines (rays, points, 3) in mm of the rays that arrive at the receiver, and their flux there."""
    stops = _at_interfaces(rays, lens)
    stops.append(landed := receiver.to(stops[-1]))
    corners = torch.stack([torch.stack([*stop.position[:2], stop.above(0.0)]) for stop in stops])
    arrive = landed.alive & (landed.flux > 0)
    return corners[:, :, arrive].permute(2, 0, 1).numpy(), landed.flux[arrive].numpy()


def ray_map(source: Emitter, lens: Lens, receiver: Receiver) -> tuple[np.ndarray, np.ndarray]:
    """Return (start, end): grid points on the first surface's vertex plane, and where their rays meet the receiver.

    (GRID_LINES, GRID_LINES, 2) each, start in mm, end in its unit; NaN where light is absent or lost.
    """
    area = clear_window(source, lens)
    line = torch.linspace(-0.499, 0.499, GRID_LINES, dtype=torch.float64)
    x, y = torch.meshgrid(line * area.width, line * area.height, indexing="ij")
    landed = trace(source.rays_through(x, y, lens.entrance.z, 1.0), lens, receiver)
    start, end = torch.stack([x, y], dim=-1), landed.position.permute(1, 2, 0).clone()
    lost = ~(landed.alive & (landed.flux > 0))
    start[lost] = end[lost] = torch.nan
    return start.numpy(), end.numpy()


# --- clear apertures needed -------------------------------------------------------------------------------------------

NEEDED_RAYS = 513  # rays per side for `needed_apertures`
ROUND_RATIO = 1.01  # largest ratio of radius to smaller half side at which a patch of light counts as round
EXTENT_POINTS = tuple((u, v) for u in (-1, 0, 1) for v in (-1, 0, 1))  # points of an extended source, in half extents
FULL_APERTURE = 0.99  # smallest ratio of the extent of the light to the clear aperture at which light fills the face


def needed_apertures(source: Emitter, lens: Lens) -> dict[str, Outline | None]:
    """Return the clear aperture (mm) needed on each face: the smallest centred circle or rectangle with all light.

    None: the light fills the clear aperture of the face.  Only light that passes all faces counts.  An extended source
    is represented by its centre and the ends of its extent.
    """
    elements = [source]
    if source.extent is not None:
        a, b = source.extent.half_extent
        elements = [source.element(a * u, b * v) for u, v in EXTENT_POINTS if not (source.extent.is_round and u and v)]
    hits = torch.cat([_hits(element.central, lens) for element in elements], dim=2)
    of_solid, apertures = hits[lens.solid], dict(zip((face.name for face in lens.faces), lens.apertures, strict=True))
    numbers = {face: list(lens.passes.numbers_of(face)) for face in lens.passes.faces}
    return {face: _aperture(torch.cat([*of_solid[k]], dim=1), apertures[face]) for face, k in numbers.items()}


def _hits(source: Emitter, lens: Lens) -> Tensor:
    """Return x and y (interfaces, 2, n) mm, on each interface, of the rays that pass all faces."""
    area = clear_window(source, lens)
    line = torch.linspace(-0.5, 0.5, NEEDED_RAYS, dtype=torch.float64) * (1 - 1e-9)
    x, y = (p.reshape(-1) for p in torch.meshgrid(line * area.width, line * area.height, indexing="ij"))
    _, *behind = _at_interfaces(source.rays_through(x, y, lens.entrance.z, 1.0), lens)
    through = behind[-1].alive & (behind[-1].flux > 0)
    return torch.stack([rays.position[:2, through] for rays in behind])


def _aperture(hits: Tensor, aperture: Outline) -> Outline | None:
    """Return the smallest outline with all `hits` (2, n) of a face, in mm; None if they fill its clear `aperture`."""
    if not hits.numel():
        return Circle(0.0)
    half_x, half_y = (float(part.abs().max()) for part in hits)
    radius = float(torch.hypot(*hits).max())
    patch = Circle(radius) if radius <= ROUND_RATIO * min(half_x, half_y) else Rectangle(2 * half_x, 2 * half_y)
    a, b = aperture.half_extent
    alike = aperture.is_round or not patch.is_round
    return None if alike and half_x >= FULL_APERTURE * a and half_y >= FULL_APERTURE * b else patch


# --- light displaced by a ripple --------------------------------------------------------------------------------------


@torch.no_grad()
def rrmsd_of_ripple(channel: Channel, lens: Lens, screen: Screen, face: str) -> float:
    """Return the RRMSD between the pictures of a lens with and without the ripple of a face; 0 without a ripple.

    channel: light of one point of the source.  The ripple that is removed (`Ripple.heights`) fades towards the rim.
    The RRMSD, which is proportional to the height of a small ripple, is therefore divided by `Ripple.fading`.
    """
    net = require_net(lens.face(face).surface)
    waves = ripple(net)
    if waves.slope == 0:
        return 0.0
    smooth = lens.with_surface(face, replace(net, heights=net.heights - torch.from_numpy(waves.heights)))
    n = tubes_of(lens, max(screen.shape))
    before, after = (tubes_picture(each, [channel], screen, n).cpu().numpy() for each in (smooth, lens))
    return difference(after, before) / waves.fading


# --- light blocked by a mount -----------------------------------------------------------------------------------------

MOUNT_RAYS = 512  # rays per side for `mount_losses`; each of c channels gets MOUNT_RAYS / √c
MIN_MOUNT_RAYS = 48  # smallest number of rays per side for one channel


@dataclass(frozen=True)
class MountLosses:
    """Fractions of the light that a mount blocks."""

    cut: float  # fraction of the light through the two faces of the uncut lens that misses the clear apertures
    on_flange: float  # fraction of the light through the clear apertures that meets a wall of the flange's opening


@torch.no_grad()
def mount_losses(lens: Lens, channels: Sequence[Channel], flange: tuple[float, float] | None = None) -> MountLosses:
    """Return the losses of a lens at its mount; flange: z (mm) of the two ends of its opening; None: no flange."""
    uncut = passing = blocked = 0.0
    n = max(MIN_MOUNT_RAYS, math.ceil(MOUNT_RAYS / math.sqrt(len(channels))))
    rim = lens.back.opening(lens.apertures[1])
    for channel in channels:
        own = replace(channel.through(lens), losses=None)
        bare = own.with_clear(None)
        area = window(channel.source, bare)
        x, y = sampling.grid(area, n)
        rays = channel.source.rays_through(x, y, own.entrance.z, channel.weight * area.area / n**2)
        solid = slice(own.solid.start, own.solid.stop + 1)  # rays before, in and behind the solid
        whole, through = _at_interfaces(rays, bare)[solid][-1], _at_interfaces(rays, own)[solid]
        out = through[-1]
        uncut += float(whole.flux[whole.alive].sum())
        passing += float(out.flux[out.alive].sum())
        if flange is not None:
            blocked += float(out.flux[out.alive & _misses_opening(through, rim, flange)].sum())
    return MountLosses(1 - passing / uncut if uncut else 0.0, blocked / passing if passing else 0.0)


def _misses_opening(rays: Sequence[Rays], rim: Outline, planes: Iterable[float]) -> Tensor:
    """Return True for rays that cross a plane z = const outside the rim, before the first face or behind the last.

    rays: those before the solid, then those behind each of its faces.  planes: z (mm) of these planes.
    """
    first, (coming, *_, leaving) = rays[1], rays
    outside = torch.zeros_like(leaving.alive)
    for z in planes:
        for at, end in ((coming, first), (leaving, None)):
            path = -at.above(z) / torch.where(at.direction[2] == 0, torch.full_like(at.flux, 1e-300), at.direction[2])
            x, y, _ = at.position + path * at.direction
            between = (path > 0) if end is None else (path > 0) & (at.sense * end.above(z) > 0)
            outside |= between & ~rim.contains(x, y)
    return outside


# --- margins of the trace ---------------------------------------------------------------------------------------------

MARGIN_RAYS = 512  # rays per side for `margins`


@dataclass(frozen=True)
class Margins:
    """Worst cases of a trace through the faces from the first control net on, among all rays that carry light."""

    tir_margin_deg: float | None  # critical angle minus angle of incidence (degrees), < 0: reflected; None: no ray
    newton_slope_min: float | None  # smallest |F'(t)| from the first net on, Newton's divisor; 0: grazing; None: no ray
    non_finite: int  # number of control points, hits and landing points that are not finite


@torch.no_grad()
def margins(channels: Sequence[Channel], lens: Lens, screen: Screen, seed: int, n: int = MARGIN_RAYS) -> Margins:
    """Return the margins over n x n stratified rays per spectral line, shared among the points of an extended source.

    Where light of direction d leaves the glass, cos θ = (d_z - d_x z_x - d_y z_y) / sqrt(1 + z_x² + z_y²) for its angle
    of incidence θ; it is totally reflected if sin θ > 1 / index.  The path t to a face solves F(t) = z - sag(x, y) = 0,
    by Newton's method with F' = d_z - d_x z_x - d_y z_y.
    """
    margin, slope, n = math.inf, math.inf, math.ceil(n / math.sqrt(points_per_line(channels)))
    wrong = sum(int((~torch.isfinite(net.heights)).sum()) for net in lens.nets)
    for channel in channels:
        through = channel.through(lens)
        for rays in launch_strips(channel.source, through, n, seed):
            rays = to_first_net(rays, through)
            for face in through.interfaces[through.tailored_numbers[0] : through.solid.stop]:
                met, normal = intersect(face.surface, rays, face.outline, face.status_if_missed)
                n_x, n_y, n_z = normal
                dx, dy, dz = met.direction
                along = met.sense * (n_z * dz + n_x * dx + n_y * dy)
                meets = met.alive & (met.flux > 0)
                wrong += int((~torch.isfinite(met.position)).any(0)[meets].sum())
                if bool(meets.any()):
                    slope = min(slope, float(along.abs()[meets].min()))
                if bool(meets.any()) and face.law.eta > 1:
                    cosine = (along / torch.sqrt(n_z * n_z + n_x * n_x + n_y * n_y))[meets].clamp(-1.0, 1.0)
                    critical = math.degrees(math.asin(1.0 / face.law.eta))
                    margin = min(margin, critical - float(torch.rad2deg(torch.arccos(cosine)).max()))
                rays = deflect(met, normal, face.law, level=face.surface.level).rays
            landed = screen.receiver.land(across(rays, through.behind))
            wrong += int((~torch.isfinite(landed.position)).any(0)[landed.alive].sum())
    return Margins(None if math.isinf(margin) else margin, None if math.isinf(slope) else slope, wrong)


# --- blur by an extended source ---------------------------------------------------------------------------------------

MIN_DISTANCE_RATIO = 2.5  # smallest suggested ratio of a target's distance to the longest side of lens or picture
MAX_NEARER_RATIO = 0.9  # largest ratio of finest details, on a nearer target / on the target, that is reported


@dataclass(frozen=True)
class Blur:
    """Image of the source on the target: the mean over the lens, weighted by flux.

    No lens shows detail much finer than this image.  But a lens can superpose many such images so that their sum is
    closer to the target than the blurred target is.
    """

    width: float  # diameter of the uniform disc with the image's RMS distance from the centroid, in `unit`
    pixels: float  # width in pixels
    rrmsd: float  # RRMSD between the target and the target convolved with the mean image
    unit: str = "mm"  # unit of the receiver


def blur(
    channels: Sequence[Channel], lens: Lens, screen: Screen, target: np.ndarray, n: int = IMAGE_POINTS_PER_SIDE
) -> Blur | None:
    """Return the blur of the picture `target` by the extent of the source, at the first spectral line of the channels.

    n: points per side of the back for which images are computed.  Return None for a point source or if no light passes.
    """
    if points_per_line(channels) == 1:
        return None
    found = images(channels, lens, screen, n)
    if not found.flux.any():
        return None
    width = found.width()
    return Blur(width * screen.pixel_side, width, found.deviation(target), screen.receiver.unit)


@dataclass(frozen=True)
class FinestDetail:
    """Smallest width of a point of the picture for any lens: the image of the source, sampled by pixels.

    w = √(D² + 4/3 p²), where D is the diameter of the image of the source and p the side of a pixel
    (optics.trace.source_images.detail_width).  D is proportional to the distance L from the lens to the target: D = 2 L
    tan(δ / 2) for collimated light of divergence δ through a thin plate, and D = d L / l for a source of diameter d at
    the distance l before the plate.  At a distance L' it is D L' / L.  The resolution of the net is not included, but
    w is never below the side of the smallest cell on which the light is right (analysis.cell_errors).
    """

    width: float  # width w of a point of the picture, in `unit`
    source_image: float  # diameter D of the image of the source, in `unit`
    pixel: float  # side p of a pixel, in `unit`
    distance: float  # distance L from the lens to the target (mm)
    nearer_distance: float | None  # distance L' (mm) of a nearer target that can have the same picture; None: no gain
    nearer_width: float | None  # width w on the nearer target, in `unit`
    of: str  # size of the source: its key in the scene, or the assumption
    assumed: bool  # True if the scene does not state the size
    unit: str = "mm"  # unit of the receiver


def finest_detail(
    source_image: float, lens: Lens, screen: Screen, of: str, assumed: bool = False, least: float = 0.0
) -> FinestDetail:
    """Return the finest detail on a target; source_image: diameter (pixels); of, assumed: as in FinestDetail.

    least: side of the smallest cell on which the light is right, in the unit of the receiver; no width is below it.
    """
    distance, pixel = abs(image_from_lens(lens, screen).throw(lens.back.z)), screen.pixel_side
    grows = distance == abs(per_radian(lens, screen))  # False for an image over angles, which keeps its width
    sizes = (*(2 * half for half in lens.plan.half_extent), *(high - low for low, high in (screen.x, screen.y)))
    nearer, image = MIN_DISTANCE_RATIO * max(sizes), source_image * pixel
    width, narrower = (max(detail_width(image * scale, pixel), least) for scale in (1.0, nearer / distance))
    gains = narrower < MAX_NEARER_RATIO * width and grows and not lens.behind
    gain, unit = (nearer, narrower) if gains else (None, None), screen.receiver.unit
    return FinestDetail(
        width, image, pixel, distance, nearer_distance=gain[0], nearer_width=gain[1], of=of, assumed=assumed, unit=unit
    )
