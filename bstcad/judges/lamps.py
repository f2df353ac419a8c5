"""The sources of a scene as lamps of Mitsuba's.

A parallel beam starts from a plate of the aperture's shape, whose normals point its way; a cone of one radiant
intensity is a spot; any other point is a projector, whose slide is its irradiance over the solid angle of the lens.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bstcad.judges import triangles
from bstcad.optics.channels import Channel
from bstcad.optics.lens import Lens
from bstcad.optics.sources import Collimated, Point
from bstcad.optics.trace import window

TEXELS = 1024  # of a slide, along each side
ROOM = 1.01  # field of a projector over the lens's
SOFT = 1e-5  # of a spot's cone: width of its edge
PROJECTED = math.pi  # flux of Mitsuba's projector over the irradiance of its slide


def of(channels: Sequence[Channel], lens: Lens, folder: Path) -> dict[str, Any]:
    """The lamps of channels as entries of Mitsuba's scene; each sends the flux of its channel's weight."""
    first = channels[0].source
    if first.kind == "collimated":
        lamps = [_plate(c.source, c.weight, lens, folder / f"lamp{k}.ply") for k, c in enumerate(channels)]
    elif first.profile == "uniform" and first.half_angle < 89:
        lamps = [_spot(c.source, c.weight, lens) for c in channels]
    else:
        half = ROOM * max(_half(c.source, lens) for c in channels)
        lamps = [_projector(c.source, c.weight, lens, half) for c in channels]
    slide = {"slide": _slide(first, lens, half)} if lamps[0]["type"] == "projector" else {}
    return slide | {f"lamp{k}": lamp for k, lamp in enumerate(lamps)}


def _plate(source: Collimated, weight: float, lens: Lens, path: Path) -> dict[str, Any]:
    """A parallel beam through its aperture, from the plane where rays start."""
    z = lens.entrance.z
    start = source.start(z)
    (x, y), (a, b), way = source.shift(z), source.slopes, z - start
    triangles.disc(source.aperture, (x - way * a, y - way * b, start), source.axes[2]).write(path)
    if source.profile == "gaussian":
        radiance = _texture(_over_aperture(source, z) * weight)
    else:
        radiance = {"type": "rgb", "value": weight / source.aperture.area}
    return {
        "type": "ply", "filename": str(path), "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
        "emitter": {"type": "directionalarea", "radiance": radiance},
    }  # fmt: skip


def _over_aperture(source: Collimated, z: float) -> np.ndarray:
    """(TEXELS, TEXELS) E over the box around the aperture."""
    x, y = source.shift(z)
    a, b = source.aperture.half_extent
    return _irradiance(source, x + a * _centres(), y + b * _centres(), z)


def _spot(source: Point, weight: float, lens: Lens) -> dict[str, Any]:
    """I = 1 / (2π (1 - cos θ_max)) up to θ_max."""
    edge = source.half_angle
    intensity = weight / (2 * math.pi * (1 - math.cos(math.radians(edge))))
    return {
        "type": "spot", "to_world": _looking(source.position, tuple(_sense(source, lens) * n for n in source.axes[2])),
        "cutoff_angle": edge, "beam_width": edge * (1 - SOFT), "intensity": {"type": "rgb", "value": intensity},
    }  # fmt: skip


def _projector(source: Point, weight: float, lens: Lens, half: float) -> dict[str, Any]:
    """Looks along the axis of the lens at a square of slopes up to `half`."""
    return {
        "type": "projector", "to_world": _looking(source.position, (0.0, 0.0, _sense(source, lens))),
        "fov": math.degrees(2 * math.atan(half)), "scale": weight / PROJECTED,
        "irradiance": {"type": "ref", "id": "slide"},
    }  # fmt: skip


def _half(source: Point, lens: Lens) -> float:
    """The largest slope of light that the lens can meet."""
    seen, (x, y, z) = window(source, lens), source.position
    return max(seen.width / 2 + abs(x), seen.height / 2 + abs(y)) / abs(lens.entrance.z - z)


def _slide(source: Point, lens: Lens, half: float) -> dict[str, Any]:
    """E on the plane at the distance 1 from the source, as seen along its light."""
    x, y, z = source.position
    sense = _sense(source, lens)
    across = half * _centres()
    return _texture(_irradiance(source, x - sense * across, y - across, z + sense))


def _irradiance(source: Collimated | Point, x: np.ndarray, y: np.ndarray, z: float) -> np.ndarray:
    """(rows, columns) of a source on a plane z (mm)."""
    places = (torch.from_numpy(np.ascontiguousarray(p)) for p in np.meshgrid(x, y))
    return source.irradiance(*places, z).numpy()


def _centres() -> np.ndarray:
    """Of texels, from -1 to 1."""
    return (2 * np.arange(TEXELS) + 1) / TEXELS - 1


def _texture(values: np.ndarray) -> dict[str, Any]:
    import mitsuba

    picture = mitsuba.Bitmap(np.ascontiguousarray(values[..., None], dtype=np.float32))
    return {"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": "clamp"}


def _sense(source: Point, lens: Lens) -> float:
    """1 if it looks along its third axis, -1 against it."""
    return 1.0 if source.position[2] <= lens.entrance.z else -1.0


def _looking(place: tuple[float, float, float], along: tuple[float, float, float]) -> Any:
    import mitsuba

    ahead = [p + a for p, a in zip(place, along, strict=True)]
    return mitsuba.ScalarTransform4f().look_at(origin=list(place), target=ahead, up=[0, 1, 0])
