"""Reach: where a face can send light, in closed form.

A face of relative index η = n / n' > 1 turns a ray by θ' - θ, sin θ' = η sin θ.  The angle grows with θ, and at the
critical angle, sin θ = 1 / η, where light leaves along the face, it is 90° - asin(1 / η): 48° at η = 1.4936.  A place
of the face can send its light towards an aim if the angle between the two directions is less than that of a ray which
leaves at GRAZING, and if the normal that the law asks for, parallel to η d - d', stands in a slope of at most STEEPEST.
A mirror is bound by its slope alone.

Which of the places sends its light there is for a map to say (tailoring/reachable.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.emitters import Emitter
from bstcad.optics.interfaces import Law
from bstcad.optics.kernels.reductions import total
from bstcad.optics.lens import Lens
from bstcad.optics.rays import Rays
from bstcad.optics.receivers import Receiver
from bstcad.optics.tubes import rays_to

GRAZING = math.radians(85)  # from the normal, in air; 0.2° from the critical angle in PMMA
STEEPEST = math.tan(math.radians(70))  # slope; no tool reaches a steeper one, which makes the lens as thick as wide


def largest_deflection(index: float, grazing: float = GRAZING) -> float:
    """The angle (rad) by which a face turns a ray at `grazing` (rad) from the normal in air."""
    return grazing - math.asin(math.sin(grazing) / index)


def grazing_of(index: float, others: Iterable[float], spread: float = 0.0) -> float:
    """The angle (rad) to the normal, GRAZING at most, at which light may leave so that no other light is reflected.

    others: relative indices for other lines of the light, of which the greatest meets its critical angle first; spread:
    angle (rad) in the glass between a ray and the others that meet the face at the same place.
    """
    steepest = math.asin(math.sin(GRAZING) / max((index, *others)))  # incidence of the line that is bent most
    return math.asin(index * math.sin(max(steepest - spread, 0.0)))


def spread_at(source: Emitter, lens: Lens) -> float:
    """The largest angle (rad) before the last freeform face, at its middle, between light from the middle of a source
    and light from the ends of its extent; 0 for a point.
    """
    if source.extent is None:
        return 0.0
    a, b = source.extent.half_extent
    x, y = torch.meshgrid(*[torch.tensor([-1e-3, 1e-3], dtype=torch.float64)] * 2, indexing="ij")
    middle, *ends = (
        rays_to(source.element(a * u, b * v).central, lens, x, y, number=lens.freeform[-1])[2].direction[:, 0, 0]
        for u, v in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
    )
    return max(math.acos(min(float(total(middle * end)), 1.0)) for end in ends)


def directions(at_face: Rays, aim: Tensor, plane: Receiver) -> tuple[Tensor, Tensor, Tensor]:
    """(d, d', d · d') of rays at a face and towards aims (2, …) on the receiver, both unit vectors (3, …)."""
    out = plane.vector_to(at_face, aim)
    d, out = at_face.direction, out / torch.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    return d, out, d[0] * out[0] + d[1] * out[1] + d[2] * out[2]


def wanted_slopes(at_face: Rays, aim: Tensor, plane: Receiver, law: Law) -> tuple[Tensor, Tensor]:
    """(∂z/∂x, ∂z/∂y) that send each ray towards aim (2, …) on the receiver, as `slopes_towards` has it."""
    _, out, _ = directions(at_face, aim, plane)
    return slopes_towards(at_face, out, law)


def slopes_towards(at_face: Rays, out: Tensor, law: Law) -> tuple[Tensor, Tensor]:
    """(∂z/∂x, ∂z/∂y) that turn each ray into the direction d' of `out`, unit vectors (3, …).

    Both laws say that η d - d' is parallel to the normal (-z_x, -z_y, 1), d and d' the directions before the face and
    behind it; into glass, η < 1, it is antiparallel.  Where no face can do that, the slope turns the ray towards the
    same side, as far as a ray that meets or leaves it at GRAZING, and is no steeper than STEEPEST.
    """
    d = at_face.direction
    along = d[0] * out[0] + d[1] * out[1] + d[2] * out[2]
    most = math.pi if law.reverses else largest_deflection(max(law.eta, 1 / law.eta))
    out = torch.where(along < math.cos(most), _turned(d, out, along, most), out)
    normal = normal_towards(at_face, out, law)
    height = torch.maximum(normal[2], torch.sqrt(normal[0] ** 2 + normal[1] ** 2) / STEEPEST)
    return -normal[0] / height, -normal[1] / height


def normal_towards(at_face: Rays, out: Tensor, law: Law) -> Tensor:
    """±(η d - d'): the normal (3, …), of any length, of a face that turns each ray into the direction d' of `out`."""
    return (at_face.sense if law.eta >= 1 else -at_face.sense) * (law.eta * at_face.direction - out)


def kept_from_reflection(
    at_face: Rays, slopes: tuple[Tensor, Tensor], law: Law, grazing: float = GRAZING
) -> tuple[Tensor, Tensor]:
    """Slopes (∂z/∂x, ∂z/∂y) at which no ray leaves a refracting face further than `grazing` (rad) from the normal.

    A normal that stands too far from the ray is turned towards it, in their common plane; all others stay.
    """
    if law.reverses or law.eta <= 1:
        return slopes
    z_x, z_y = slopes
    d, most = at_face.sense * at_face.direction, math.asin(math.sin(grazing) / law.eta)
    normal = torch.stack([-z_x, -z_y, torch.ones_like(z_x)]) / torch.sqrt(1 + z_x * z_x + z_y * z_y)
    along = d[0] * normal[0] + d[1] * normal[1] + d[2] * normal[2]
    turned = _turned(d, normal, along, most)
    beyond = (along < math.cos(most)) & (turned[2] > 0)
    return torch.where(beyond, -turned[0] / turned[2], z_x), torch.where(beyond, -turned[1] / turned[2], z_y)


def _turned(d: Tensor, towards: Tensor, along: Tensor, angle: float) -> Tensor:
    """Unit vectors (3, …) at an angle (rad) to d, in its plane with others; along: the product d · towards of both."""
    across = towards - along * d
    across = across / torch.sqrt(across[0] ** 2 + across[1] ** 2 + across[2] ** 2).clamp(min=1e-12)
    return math.cos(angle) * d + math.sin(angle) * across


def room(at_face: Rays, aim: Tensor, plane: Receiver, law: Law, grazing: float = GRAZING) -> Tensor:
    """How far (a cosine) each ray is from the end of what a slope of the face can do to it: negative beyond.

    The least of three: d · d' less the cosine of the largest deflection; n_z - |(n_x, n_y)| / STEEPEST of the normal
    n = η d - d'; and the cosine to the receiver's normal with which the light meets it from before.
    """
    _, out, along = directions(at_face, aim, plane)
    normal = normal_towards(at_face, out, law)
    upright = normal[2] - torch.sqrt(normal[0] ** 2 + normal[1] ** 2) / STEEPEST
    n_x, n_y, n_z = plane.normal(aim)
    onwards = (-at_face.sense if law.reverses else at_face.sense) * (n_x * out[0] + n_y * out[1] + n_z * out[2])
    least = torch.minimum(upright, onwards)
    if law.reverses:
        return least
    return torch.minimum(least, along - math.cos(largest_deflection(max(law.eta, 1 / law.eta), grazing)))


def unreached(picture: np.ndarray, part: np.ndarray, angle: float | None) -> dict[str, float | None]:
    """What lies outside of the part of a target that can be lit: its share of the area, and of the light of a picture.

    angle: the largest (degrees) by which a face turns light (Passes.largest_turn).
    """
    return {"area": float(1 - part.mean()), "light": float(picture[~part].sum() / picture.sum()), "angle": angle}
