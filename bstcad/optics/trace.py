"""The trace: intersect, refract, land.  Free functions on rays and surfaces; differentiable in every parameter."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.kernels import fused
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import Landed, Rays, Status
from bstcad.optics.surfaces import Plane, Sphere

Surface = Plane | Sphere | BSplineSurface
GRAZING = fused.GRAZING
NEWTON_STEPS = 20  # a smooth lens needs 3 to 5; what has not converged by then is a miss


def intersect(surface: Surface, rays: Rays, outline: Outline, reason: Status) -> tuple[Rays, Tensor, Tensor]:
    """Move the rays to the surface; those that do not meet it inside the outline are lost for `reason`.

    F(t) = z(t) - sag(x(t), y(t)) = 0.  The root is found without gradient; then one differentiable Newton step,
    t = t* - F(t*) / F'(t*) with F' held, carries the implicit gradient dt = -dF / F' (Wang, C. 2022 after Griewank).

    Returns (rays at the surface, ∂z/∂x, ∂z/∂y there).
    """
    if rays.axial:  # closed form: the hit is (x, y, sag)
        x, y, _ = rays.position
        h, z_x, z_y = surface.relative_sag_and_slope(x, y)
        position = torch.stack([x, y, surface.z + h])
        status = rays.lose(~outline.contains(x, y), reason)
        return replace(rays, position=position, status=status), z_x, z_y

    with torch.no_grad():
        t, found = _root(surface, rays, _tolerance(outline, rays.position.dtype))
    x, y, z = (p + t * d for p, d in zip(rays.position, rays.direction, strict=True))
    h, z_x, z_y = surface.relative_sag_and_slope(x, y)
    residual = (z - surface.z) - h
    slope = (rays.direction[2] - z_x * rays.direction[0] - z_y * rays.direction[1]).detach()
    ok = found & (slope.abs() > 1e-6)
    # double where: a ray without a root takes no step and sends no gradient
    step = torch.where(ok, residual, torch.zeros_like(residual)) / torch.where(ok, slope, torch.ones_like(slope))
    position = torch.stack([p - step * d for p, d in zip((x, y, z), rays.direction, strict=True)])
    _, z_x, z_y = surface.relative_sag_and_slope(position[0], position[1])  # the slope moves with the hit
    status = rays.lose(~ok | ~outline.contains(position[0], position[1]), reason)
    return replace(rays, position=position, status=status), z_x, z_y


def _tolerance(outline: Outline, dtype: torch.dtype) -> float:
    """|F| (mm) at which a root is found: sags and positions on the lens are of the order of its half width."""
    return 64 * max(outline.half_extent) * torch.finfo(dtype).eps


def _root(surface: Surface, rays: Rays, tolerance: float) -> tuple[Tensor, Tensor]:
    """(t*, found): the ray's path to the surface's base plane, and from there in closed form or by Newton.

    Counted from the base plane the remaining path is as short as the sag, so that the stop does not feel the rounding
    of a long way from the source.
    """
    px, py, pz = rays.position
    dx, dy, dz = rays.direction
    start = (surface.z - pz) / torch.where(dz.abs() > 1e-12, dz, torch.full_like(dz, 1e-12))
    x, y = px + start * dx, py + start * dy
    if isinstance(surface, BSplineSurface):
        s, found = _newton(surface, x, y, rays, tolerance)
    else:
        s, found = surface.crossing(x, y, rays.direction)
    t = start + s
    found = found & (t >= 0)  # only the forward root counts
    return torch.where(found, t, torch.zeros_like(t)), found


def _newton(surface: BSplineSurface, x: Tensor, y: Tensor, rays: Rays, tolerance: float) -> tuple[Tensor, Tensor]:
    """(s*, found): path from (x, y) of the base plane to the surface; the stop is |F| in mm, per ray."""
    dx, dy, dz = rays.direction
    s = torch.zeros_like(x)
    found = torch.zeros_like(x, dtype=torch.bool)
    for _ in range(NEWTON_STEPS):
        h, z_x, z_y = surface.relative_sag_and_slope(x + s * dx, y + s * dy)
        residual = s * dz - h
        slope = dz - z_x * dx - z_y * dy
        found = residual.abs() <= tolerance
        # rays already lost do not hold the others up
        if bool((found | ~rays.alive).all()):
            break
        floor = torch.where(slope < 0, -1e-3, 1e-3).to(slope.dtype)  # keeps the sign
        s = s - torch.where(found, torch.zeros_like(s), residual / torch.where(slope.abs() > 1e-3, slope, floor))
    return s, found


def refract(rays: Rays, z_x: Tensor, z_y: Tensor, n_in: float, n_out: float) -> Rays:
    """Snell's law as vectors: d' = η d + (cos θ' - η cos θ) N, η = n_in / n_out, N = (-z_x, -z_y, 1) / |…|.

    cos² θ' = 1 - η² (1 - cos² θ) <= 0 is total internal reflection; so is counted a ray that meets a face from behind
    (cos θ <= 0).  The gradient grows as 1 / cos θ' towards the critical angle; rounding of cos² θ' bounds it, at some
    1e8 in float64 and 3e3 in float32.
    """
    norm = torch.rsqrt(1 + z_x * z_x + z_y * z_y)
    dx, dy, dz = rays.direction
    cos_in = (dz - dx * z_x - dy * z_y) * norm
    eta = n_in / n_out
    cos2_out = 1 - eta * eta * (1 - cos_in * cos_in)
    total = cos2_out <= 0
    cos_out = torch.sqrt(torch.where(total, torch.ones_like(cos2_out), cos2_out))
    shift = (cos_out - eta * cos_in) * norm
    direction = torch.stack([eta * dx - shift * z_x, eta * dy - shift * z_y, eta * dz + shift])
    status = rays.lose(total | (cos_in <= 0), Status.TOTAL_REFLECTION)
    direction = torch.where(status == Status.ALIVE, direction, rays.direction.detach())
    return replace(rays, direction=direction, status=status, axial=False)


def into_glass(rays: Rays, lens: Lens) -> Rays:
    """The rays just behind the front face."""
    at_front, z_x, z_y = intersect(lens.front, rays, lens.outline, Status.MISSED_FRONT)
    if rays.axial and isinstance(lens.front, Plane):
        return at_front  # normal incidence: the direction stays
    return refract(at_front, z_x, z_y, 1.0, lens.index)


def to_plane(rays: Rays, z: float) -> Rays:
    """Move the rays along their direction to the plane z (mm) ahead of them; those that lead away from it are lost."""
    status = rays.lose(rays.direction[2] <= GRAZING, Status.TURNED_BACK)
    dz = torch.where(status == Status.ALIVE, rays.direction[2], torch.ones_like(rays.direction[2]))
    position = rays.position + (z - rays.position[2]) / dz * rays.direction
    return replace(rays, position=position, status=status)


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
        frame=(back.x[0], back.y[0], 1 / pitch_x, 1 / pitch_y, back.z), limits=lens.outline.limits,
        index=lens.index, throw=z - back.z, steps=NEWTON_STEPS, tolerance=_tolerance(lens.outline, torch.float64),
    )  # fmt: skip
    position, direction = (t.reshape(3, -1).contiguous() for t in (in_glass.position, in_glass.direction))
    landing, status = fused.ThroughBack.apply(back.heights, position, direction, in_glass.status.reshape(-1), face)
    return Landed(landing.view(2, *shape), in_glass.flux, status.view(shape))


def trace(rays: Rays, lens: Lens, z: float) -> Landed:
    """From the source through both faces of the lens to the plane z (mm)."""
    return through_back(into_glass(rays, lens), lens, z)
