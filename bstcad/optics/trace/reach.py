"""Reach of a face: the points to which it can deflect light, in closed form.

A face of relative index η = n / n' > 1 deflects a ray by θ' - θ, sin θ' = η sin θ.  The deflection grows with θ.  At
the critical angle, sin θ = 1 / η, light leaves along the face and the deflection is 90° - asin(1 / η): 48° at η =
1.4936.  A point of the face can send its light to an aim if the deflection is at most that of a ray that leaves at
MAX_EXIT_ANGLE, and if the normal required by Snell's law, parallel to η d - d' for the directions d before and d'
behind the face, belongs to a slope of at most MAX_SLOPE.  A mirror is limited by its slope alone.

A transport map assigns the points of the face to the aims (tailoring/reachable.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from bstcad.optics.lens.interfaces import Law
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.numerics.reductions import total
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces.charts import HEIGHTS
from bstcad.optics.surfaces.rays import Rays, dot
from bstcad.optics.trace.tubes import rays_to

MAX_EXIT_ANGLE = math.radians(85)  # largest angle of refraction in air (rad); incidence in PMMA 0.2° below critical
MAX_SLOPE = math.tan(math.radians(70))  # largest slope: a steeper face cannot be machined and makes the lens thick


def largest_deflection(index: float, grazing: float = MAX_EXIT_ANGLE) -> float:
    """Return the deflection (rad) of a ray that leaves a face of this relative index at `grazing` rad to its normal."""
    return grazing - math.asin(math.sin(grazing) / index)


def grazing_of(index: float, others: Iterable[float], spread: float = 0.0) -> float:
    """Return the largest exit angle (rad) of a ray at which all other light at the point leaves within MAX_EXIT_ANGLE.

    index, others: relative indices at the ray's wavelength and at the other ones; the largest index limits the angle.
    spread: largest angle (rad) in the glass between a ray and the other rays that meet the face at the same point.
    """
    largest = math.asin(math.sin(MAX_EXIT_ANGLE) / max((index, *others)))  # incidence at the wavelength deflected most
    return math.asin(index * math.sin(max(largest - spread, 0.0)))


def spread_at(source: Emitter, lens: Lens) -> float:
    """Return half the angle (rad) that a source subtends at the last freeform face, in the medium before it.

    It is the largest angle at the face's centre between light from the source's centre and its axes' ends (point: 0).
    """
    if source.extent is None:
        return 0.0
    a, b = source.extent.half_extent
    x, y = torch.meshgrid(*[torch.tensor([-1e-3, 1e-3], dtype=torch.float64)] * 2, indexing="ij")
    points = [source.element(a * u, b * v).central for u, v in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))]
    middle, *ends = rays_to(points, lens, x, y, number=lens.tailored_numbers[-1])[2].direction[:, :, 0, 0].T
    return max(math.acos(min(float(total(middle * end)), 1.0)) for end in ends)


def directions(at_face: Rays, aim: Tensor, receiver: Receiver) -> tuple[Tensor, Tensor, Tensor]:
    """Return (d, d', d · d'): unit vectors (3, …) of rays at a face, and from there to aims (2, …) on the receiver."""
    out = receiver.vector_to(at_face, aim)
    d, out = at_face.direction, out / torch.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    return d, out, dot(d, out)


def wanted_slopes(at_face: Rays, aim: Tensor, receiver: Receiver, law: Law) -> tuple[Tensor, Tensor]:
    """Return the slopes (∂z/∂x, ∂z/∂y) that send each ray to an aim (2, …) on the receiver (see `slopes_towards`)."""
    _, out, _ = directions(at_face, aim, receiver)
    return slopes_towards(at_face, out, law)


def slopes_towards(at_face: Rays, out: Tensor, law: Law) -> tuple[Tensor, Tensor]:
    """Return the slopes (∂z/∂x, ∂z/∂y) that deflect each ray into the direction d' of `out`, unit vectors (3, …).

    On a dome the slopes are those in the chart of the rays (charts.py).

    By the laws of refraction and reflection the normal (-z_x, -z_y, 1) is parallel to ±(η d - d') (`normal_towards`).
    If no face can deflect a ray by so large an angle, the slope deflects it to the same side by the largest
    angle: that of a ray which meets or leaves the face at MAX_EXIT_ANGLE.  No slope is steeper than MAX_SLOPE.
    """
    d = at_face.direction
    along = dot(d, out)
    largest = math.pi if law.reverses else largest_deflection(max(law.eta, 1 / law.eta))
    chart = at_face.chart
    if chart is HEIGHTS:
        out = torch.where(along < math.cos(largest), _at_angle(d, out, along, largest), out)
    normal = chart.local(at_face.position, normal_towards(at_face, out, law))
    height = torch.maximum(normal[2], torch.sqrt(normal[0] ** 2 + normal[1] ** 2) / MAX_SLOPE)
    stretch = chart.stretch(at_face.position)
    return stretch * (-normal[0] / height), stretch * (-normal[1] / height)


def normal_towards(at_face: Rays, out: Tensor, law: Law) -> Tensor:
    """Return n = ±(η d - d'), normals (3, …) of a face that deflects rays from d into d' = `out`; n_z < 0: overhang."""
    return (at_face.sense if law.eta >= 1 else -at_face.sense) * (law.eta * at_face.direction - out)


def limit_refraction(
    at_face: Rays, slopes: tuple[Tensor, Tensor], law: Law, grazing: float = MAX_EXIT_ANGLE
) -> tuple[Tensor, Tensor]:
    """Limit slopes (in the rays' chart) so that no angle of refraction at a face into air exceeds `grazing` (rad).

    A normal at too large an angle to its ray is rotated towards the ray in their common plane; others do not change.
    """
    if law.reverses or law.eta <= 1:
        return slopes
    chart = at_face.chart
    stretch = chart.stretch(at_face.position)
    z_x, z_y = (slope / stretch for slope in slopes)
    d = at_face.sense * chart.local(at_face.position, at_face.direction)
    largest = math.asin(math.sin(grazing) / law.eta)
    normal = torch.stack([-z_x, -z_y, torch.ones_like(z_x)]) / torch.sqrt(1 + z_x * z_x + z_y * z_y)
    along = dot(d, normal)
    limit = _at_angle(d, normal, along, largest)
    exceeds = (along < math.cos(largest)) & (limit[2] > 0)
    within = torch.where(exceeds, -limit[0] / limit[2], z_x), torch.where(exceeds, -limit[1] / limit[2], z_y)
    return stretch * within[0], stretch * within[1]


def _at_angle(d: Tensor, towards: Tensor, along: Tensor, angle: float) -> Tensor:
    """Return unit vectors (3, …) at an angle (rad) to d in the plane of d and `towards`; along: d · towards."""
    across = towards - along * d
    across = across / torch.sqrt(across[0] ** 2 + across[1] ** 2 + across[2] ** 2).clamp(min=1e-12)
    return math.cos(angle) * d + math.sin(angle) * across


def reach_margin(at_face: Rays, aim: Tensor, receiver: Receiver, law: Law, grazing: float = MAX_EXIT_ANGLE) -> Tensor:
    """Return the margin of each ray to the limits of the face, without unit; negative: the aim is out of reach.

    Minimum of three: d · d' minus the cosine of the largest deflection (not for a mirror); n_z - |(n_x, n_y)| /
    MAX_SLOPE, n by `normal_towards`; and d' · m, m the receiver's unit normal, which points away from the lens.
    """
    _, out, along = directions(at_face, aim, receiver)
    normal = at_face.chart.local(at_face.position, normal_towards(at_face, out, law))
    upright = normal[2] - torch.sqrt(normal[0] ** 2 + normal[1] ** 2) / MAX_SLOPE
    onwards = (-at_face.sense if law.reverses else at_face.sense) * dot(receiver.normal(aim), out)
    margin = torch.minimum(upright, onwards)
    if law.reverses:
        return margin
    return torch.minimum(margin, along - math.cos(largest_deflection(max(law.eta, 1 / law.eta), grazing)))


def unreached(picture: np.ndarray, part: np.ndarray, angle: float | None) -> dict[str, float | None]:
    """Return {area, light, angle}: fractions of area and light of a picture outside its `part` (True: reachable).

    angle: largest deflection (degrees) of the face (Passes.largest_deflection), copied to the result.
    """
    return {"area": float(1 - part.mean()), "light": float(picture[~part].sum() / picture.sum()), "angle": angle}
