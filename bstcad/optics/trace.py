"""The trace: intersect, refract, land.  Free functions on rays and surfaces; differentiable in every parameter."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from bstcad.optics import intersection
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.kernels import fused
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import Landed, Rays, Status
from bstcad.optics.surfaces import Plane, Sphere

Surface = Plane | Sphere | BSplineSurface
GRAZING, SKIMMING = fused.GRAZING, fused.SKIMMING


def intersect(surface: Surface, rays: Rays, outline: Outline, reason: Status) -> tuple[Rays, Tensor, Tensor]:
    """Move the rays to the surface; those that do not meet it inside the outline are lost for `reason`.

    F(s) = z(s) - sag(x(s), y(s)) = 0.  The root is found without gradient; then one differentiable Newton step,
    s = s* - F(s*) / F'(s*) with F' held, carries the implicit gradient ds = -dF / F' (Wang, C. 2022 after Griewank).
    The path s counts from the surface's base plane: it is as short as the sag, so that neither a source far off nor a
    scene far from its origin costs digits.

    Returns (rays at the surface, ∂z/∂x, ∂z/∂y there).
    """
    if rays.axial:  # closed form: the hit is (x, y, sag)
        x, y, _ = rays.position
        h, z_x, z_y = surface.relative_sag_and_slope(x, y)
        status = rays.lose(~(surface.reaches(x, y) & outline.contains(x, y)), reason)
        return replace(rays, position=torch.stack([x, y, h]), z=surface.z, status=status), z_x, z_y

    start, s, found = _plane_and_root(surface, rays)
    # double where: a ray without a root takes no step, and whatever it is, none of it reaches the others' gradients
    x, y, z = torch.where(found, start + s * rays.direction, torch.zeros_like(start))
    h, z_x, z_y = surface.relative_sag_and_slope(x, y)
    dx, dy, dz = rays.direction.detach()
    slope = dz - z_x.detach() * dx - z_y.detach() * dy
    ok = found & (slope.abs() > 1e-6)
    step = torch.where(ok, z - h, torch.zeros_like(h)) / torch.where(ok, slope, torch.ones_like(slope))
    before = torch.stack([*rays.position[:2], rays.above(surface.z)])
    position = torch.where(ok, torch.stack([x, y, z]) - step * rays.direction, before)
    x, y = (torch.where(ok, p, torch.zeros_like(p)) for p in position[:2])
    _, z_x, z_y = surface.relative_sag_and_slope(x, y)  # the slope moves with the hit
    there = ok & surface.reaches(x, y) & outline.contains(x, y)
    return replace(rays, position=position, z=surface.z, status=rays.lose(~there, reason)), z_x, z_y


def _plane_and_root(surface: Surface, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
    """(where the rays cross the base plane (3, …), path s from there to the surface, found); no gradient in s."""
    dz = rays.direction[2]
    way = -rays.above(surface.z) / torch.where(dz.abs() > 1e-12, dz, torch.full_like(dz, 1e-12))
    start = torch.stack([*(rays.position[:2] + way * rays.direction[:2]), torch.zeros_like(dz)])
    with torch.no_grad():
        if isinstance(surface, BSplineSurface):
            s, found = intersection.first_root(surface, start, way, rays, intersection.bounds(surface, dz.dtype))
        else:
            s, found = surface.crossing(start[0], start[1], rays.direction)
            found = found & (way + s >= 0)  # only the forward root counts
    return start, s, found


def refract(rays: Rays, z_x: Tensor, z_y: Tensor, n_in: float, n_out: float) -> Rays:
    """Snell's law as vectors: d' = η d + (cos θ' - η cos θ) N, η = n_in / n_out, N = (-z_x, -z_y, 1) / |…|.

    cos² θ' = 1 - η² (1 - cos² θ) <= 0 is total internal reflection; so is counted a ray that meets a face from behind
    (cos θ <= 0).  Neither has a gradient.  That of the others grows as d cos θ' = η² cos θ / cos θ' d cos θ towards the
    critical angle, and is capped there: cos θ' counts as SKIMMING at least, in this derivative and nowhere else.
    """
    norm = torch.rsqrt(1 + z_x * z_x + z_y * z_y)
    dx, dy, dz = torch.where(rays.alive, rays.direction, torch.ones_like(rays.direction))
    cos_in = (dz - dx * z_x - dy * z_y) * norm
    eta = n_in / n_out
    cos2_out = 1 - eta * eta * (1 - cos_in * cos_in)
    total = cos2_out <= 0
    cos_out = _capped_root(torch.where(total, torch.ones_like(cos2_out), cos2_out))
    shift = (cos_out - eta * cos_in) * norm
    direction = torch.stack([eta * dx - shift * z_x, eta * dy - shift * z_y, eta * dz + shift])
    status = rays.lose(total | (cos_in <= 0), Status.TOTAL_REFLECTION)
    direction = torch.where(status == Status.ALIVE, direction, rays.direction.detach())
    return replace(rays, direction=direction, status=status, axial=False)


def _capped_root(cos2: Tensor) -> Tensor:
    """cos = sqrt(cos²) > 0 with the derivative 1 / (2 max(cos, SKIMMING)): the same sign, never more than that."""
    cos = torch.sqrt(cos2.detach())
    return cos + (cos2 - cos2.detach()) / (2 * cos.clamp(min=SKIMMING))


def into_glass(rays: Rays, lens: Lens) -> Rays:
    """The rays just behind the front face."""
    at_front, z_x, z_y = intersect(lens.front, rays, lens.outline, Status.MISSED_FRONT)
    if rays.axial and isinstance(lens.front, Plane):
        return at_front  # normal incidence: the direction stays
    return refract(at_front, z_x, z_y, 1.0, lens.index)


def to_plane(rays: Rays, z: float) -> Rays:
    """Move the rays along their direction to the plane z (mm) ahead of them; those that lead away from it are lost."""
    status = rays.lose(rays.direction[2] <= GRAZING, Status.TURNED_BACK)
    lands = status == Status.ALIVE
    dz = torch.where(lands, rays.direction[2], torch.ones_like(rays.direction[2]))
    path = torch.where(lands, -rays.above(z) / dz, torch.zeros_like(dz))
    return replace(rays, position=rays.position + path * rays.direction, status=status)


def through_back_plain(in_glass: Rays, lens: Lens, z: float) -> Landed:
    """From the glass through the back face to the plane z (mm)."""
    at_back, z_x, z_y = intersect(lens.back, in_glass, lens.outline, Status.VIGNETTED)
    landed = to_plane(refract(at_back, z_x, z_y, lens.index, 1.0), z)
    return Landed(landed.position[:2], landed.flux, landed.status)


def through_back(in_glass: Rays, lens: Lens, z: float) -> Landed:
    """`through_back_plain`, by a fused kernel where one serves: rays on the CPU that need no gradient themselves."""
    rays_fixed = not (in_glass.position.requires_grad or in_glass.direction.requires_grad)
    if not (rays_fixed and fused.serves(lens.back.heights, in_glass.position, in_glass.direction)):
        return through_back_plain(in_glass, lens, z)
    back, shape = lens.back, in_glass.status.shape
    pitch_x, pitch_y = back.pitch
    face = fused.BackFace(
        frame=(back.x[0], back.y[0], 1 / pitch_x, 1 / pitch_y, back.z - in_glass.z), limits=lens.outline.limits,
        known=intersection.bounds(back, torch.float64), index=lens.index, throw=z - back.z,
    )  # fmt: skip
    position, direction = (t.reshape(3, -1).contiguous() for t in (in_glass.position, in_glass.direction))
    landing, status = fused.ThroughBack.apply(back.heights, position, direction, in_glass.status.reshape(-1), face)
    return Landed(landing.view(2, *shape), in_glass.flux, status.view(shape))


def trace(rays: Rays, lens: Lens, z: float) -> Landed:
    """From the source through both faces of the lens to the plane z (mm)."""
    return through_back(into_glass(rays, lens), lens, z)
