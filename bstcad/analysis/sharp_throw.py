"""The longest throw at which a picture stays sharp, by the size of the source and the errors of a grade.

Each of these spreads the light of a point of the picture over a spot.  Its diameter D is that of the uniform disc with
the spot's mean square distance from its middle, D² / 8, and the squares of independent causes add.  An error of the
slope of a face, of RMS s along each axis, shifts the light by (a s_x + b s_y), a and b the shifts on the target by a
slope of 1 along x and along y, which are traced for the lens at hand:

    form          s² = 2 (h / ℓ)² along each axis, h the RMS of the form error and exp(-(r / ℓ)²) its covariance
    tool marks    s² = (2π h / p)² along x alone, p their period
    layers        s² = ⟨|∇z|² (q - 1)²⟩ / 2 along each axis, q: slope of a terrace / design (finish.py)

so that D² = 8 s² ⟨|a|² + |b|²⟩ over the light on the target.  Roughness scatters by the angle of
analysis/scattering.py; it counts if more than half of the light is scattered, and less dims and veils the picture, but
leaves it sharp.  All D grow in proportion to the throw, the distance from the back to the target, where the picture
keeps its size.  So the picture is sharp up to the throw at which D is one cell of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from bstcad.analysis.scattering import Scatter
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK
from bstcad.optics.light.channels import Channel
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.bspline import BSplineSurface, is_net, require_net
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.trace.finish import PHASES, Finish, slope_ratio
from bstcad.optics.trace.trace import clear_window, trace
from bstcad.optics.trace.unfolding import per_radian

RAYS_PER_SIDE = 48  # rays per side by which the shifts are traced
TILT = 1e-6  # slope by which a face is tilted for the shifts
MOSTLY = 0.5  # fraction of scattered light above which roughness counts as blur
SOURCE, FORM_ERROR, MARKS, LAYERS, ROUGHNESS = "source", "form", "tool marks", "layers", "roughness"  # causes


@dataclass(frozen=True)
class Making:
    """Errors of a part by the grade of its manufacture that spread light."""

    finish: Finish  # layers, tool marks and roughness of the faces
    form: tuple[float, float] | None  # RMS and correlation length (mm) of the form error of the back; None: none
    grade: str  # grade of manufacture; "none": no errors
    words: str  # words for that grade
    assumed: bool  # True if the scene states no grade


@dataclass(frozen=True)
class SharpThrow:
    """Longest throw of a sharp picture, and the spots on the present target."""

    throw: float  # longest distance (mm) from the back to a target on which the picture is sharp
    distance: float  # distance (mm) of the present target
    cell: float  # width of a point of a sharp picture (`unit`): a pixel, or a larger cell on which the light is right
    spot: float  # diameter of the spot of a point by all causes on the present target (`unit`)
    spots: Mapping[str, float]  # diameter by each cause (`unit`), the largest first
    grade: str  # grade of manufacture whose errors count; "none": no errors
    words: str  # words for that grade
    assumed: bool  # True if the scene states no grade
    unit: str = "mm"  # unit of the target

    @property
    def limit(self) -> str:
        """Cause of the largest spot."""
        return next(iter(self.spots))


def sharp_throw(
    channels: Sequence[Channel], lens: Lens, screen: Screen, making: Making, source_image: float, least: float = 0.0
) -> SharpThrow | None:
    """Return the longest sharp throw of a lens that is made with these errors; None: it is not known.

    channels: light of the centre of the source, of which the heaviest counts.  source_image: diameter of the image of
    the source on the target; 0: no size is known.  least: side of the smallest cell on which the light is right.  Both
    are in the unit of the target.  None for a dome, for a target over angles, behind windows or mirrors, and if neither
    source nor part spreads light.
    """
    distance = abs(screen.receiver.throw(lens.back.z))
    if not lens.back.chart.flat or lens.behind or distance != abs(per_radian(lens, screen)):
        return None
    channel = max(channels, key=lambda each: each.weight)
    spots = {SOURCE: source_image, **dict(spots_of_finish(lens, channel, screen, making.finish))}
    if making.form is not None and is_net(lens.back):
        spots[FORM_ERROR] = spot_of_form(lens, channel, screen, *making.form)
    spots = dict(sorted(((cause, size) for cause, size in spots.items() if size > 0), key=lambda each: -each[1]))
    if not spots:
        return None
    spot, cell = math.hypot(*spots.values()), max(screen.pixel_side, least)
    return SharpThrow(
        distance * cell / spot, distance, cell, spot, spots=spots, grade=making.grade, words=making.words,
        assumed=making.assumed, unit=screen.receiver.unit,
    )  # fmt: skip


def spot_of_form(lens: Lens, channel: Channel, screen: Screen, size: float, length: float) -> float:
    """Return the diameter (unit of the target) of the spot by a form error of the back.

    size: its RMS h (mm).  length: correlation length ℓ (mm).
    """
    along_x, along_y = _square_shifts(lens, channel, screen, BACK)
    return math.sqrt(2) * size / length * math.sqrt(8 * (along_x + along_y))


def spots_of_finish(lens: Lens, channel: Channel, screen: Screen, finish: Finish) -> Iterator[tuple[str, float]]:
    """Yield (cause, diameter (unit of the target)) of the spots by layers, tool marks and roughness of all nets."""
    nets = [face for face in lens.optical_faces if is_net(face.surface)]
    shifts = [_square_shifts(lens, channel, screen, face.name) for face in nets] if finish.is_marked else []
    if finish.ripple > 0:
        slope = 2 * math.pi * finish.ripple / finish.period
        yield MARKS, slope * math.sqrt(8 * sum(along_x for along_x, _ in shifts))
    if finish.layer_height is not None:
        squares = (_square_slope_of_layers(lens, require_net(face.surface), finish) for face in nets)
        pairs = zip(squares, shifts, strict=True)
        yield LAYERS, math.sqrt(8 * sum(square / 2 * (along_x + along_y) for square, (along_x, along_y) in pairs))
    scatter = Scatter.of(channel.through(lens), finish, channel.source.main_wavelength)
    if scatter.fraction > MOSTLY:
        yield ROUGHNESS, 4 * math.sqrt(scatter.strength) * scatter.first_angle * abs(per_radian(lens, screen))


@torch.no_grad()
def _square_shifts(lens: Lens, channel: Channel, screen: Screen, face: str) -> tuple[float, float]:
    """Return the means ⟨|a|²⟩ and ⟨|b|²⟩, a and b the shifts by a slope of 1 of a face along x and y.

    The means are those over the light on the target, since light far beside it may graze the plane.
    """
    lens = channel.through(lens.plain())
    area = clear_window(channel.source, lens)
    rays = channel.source.rays_through(*sampling.grid(area, RAYS_PER_SIDE), lens.entrance.z, 1.0)
    straight = trace(rays, lens, screen.receiver)
    net = require_net(lens.face(face).surface)
    squares = []
    for place in net.places:
        tilted = lens.with_surface(face, replace(net, heights=net.heights + TILT * place))
        landed = trace(rays, tilted, screen.receiver)
        met = straight.alive & landed.alive & screen.contains(*straight.position)
        shift = ((landed.position - straight.position) / TILT).square().sum(0)
        flux = torch.where(met, straight.flux, torch.zeros_like(straight.flux))
        squares.append(float((flux * shift).nansum() / flux.sum()) if bool(flux.any()) else 0.0)
    return squares[0], squares[1]


@torch.no_grad()
def _square_slope_of_layers(lens: Lens, net: BSplineSurface, finish: Finish) -> float:
    """Return ⟨|∇z|² (q - 1)²⟩ of the terraces of a face over its points and over all phases."""
    assert finish.layer_height is not None
    half_x, half_y = lens.plan.half_extent
    x, y = sampling.grid(Rectangle(2 * half_x, 2 * half_y), RAYS_PER_SIDE)
    inside = lens.plan.contains(x, y)
    _, p, q = net.plain().sag_and_slope(x[inside], y[inside])
    slope = torch.sqrt(p * p + q * q).clamp(min=1e-30)
    width = finish.layer_height / (slope * max(finish.smoothing_length, 1e-9))
    ratios = (slope_ratio(width, (k + 0.5) / (2 * PHASES)) for k in range(PHASES))
    return sum(float((slope * (ratio - 1)).square().mean()) for ratio in ratios) / PHASES
