"""Mitsuba 3, a renderer, as a judge: single photons from its own lamps through a mesh of its own glass.

Its particle tracer sends photons from the source, reflects or transmits each at a face of the lens by a draw against
Fresnel's reflectance, and images a matt screen through a pinhole.  So its light has the losses of bare faces, whatever
a scene asks for, and photon noise.  Its mirror is lossless.

With a shared library of LLVM from version 16 on it is several times faster; without, it needs no other.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bstcad.judges import faces, lamps, triangles
from bstcad.judges.faces import Face, Off
from bstcad.judges.protocol import Seen
from bstcad.judges.triangles import Mesh
from bstcad.optics.channels import Channel, points
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.losses import Fresnel, Losses
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import axes

LLVM = 16  # the first version by which its kernels compile; with 15 the process ends
WHITE = 1e-3  # reflectance of the screen: light back to the lens does not matter
STRAIGHT = {False: 3, True: 2}  # surfaces that light meets, the screen the last: of a lens, of a mirror
AT_ONCE = 1 << 22  # photons in a pass, by memory
PARTS = (1, 2, 4)  # of half a span of the net
MOST = 5_000_000  # corners of a mesh
ENOUGH = 0.007  # of a pixel: shift of light by facets (RMS); 0.02 change a picture by 0.8 %


@dataclass(frozen=True, eq=False)
class Bench:
    """Lens and screen as entries of Mitsuba's scene, without a lamp."""

    entries: dict[str, Any]  # of its scene
    off: Off


def cannot(lens: Lens, channels: Sequence[Channel], screen: Screen) -> str:
    """Why it cannot serve, in a sentence; empty: it can."""
    if channels[0].source.kind == "collimated" and points(channels) > 1:
        return "parallel light of many directions starts from a plate for each, which would stand in each other's light"
    if lens.reflects and channels[0].source.kind == "collimated":
        return "a parallel beam that comes down to a mirror starts from a plate, which would stand in the light"
    return ""


def light(lens: Lens, channels: Sequence[Channel]) -> tuple[Channel, ...]:
    """The channels with the losses that it simulates."""
    if lens.reflects:
        return tuple(replace(channel, losses=None) for channel in channels)
    return tuple(replace(channel, losses=Losses(Fresnel(channel.source.wavelength))) for channel in channels)


def trace(lens: Lens, channels: Sequence[Channel], screen: Screen, rays: int, seed: int, reflections: int = 0) -> Seen:
    """The picture on a screen of square pixels by so many photons, in two halves.

    reflections: inside a lens, at most; with 2 its ghost is part of the picture.
    """
    import mitsuba

    mitsuba.set_variant(variant := _variant())
    mitsuba.logger().clear_appenders()  # it would draw a bar for each render
    halves, photons = np.zeros((2, *screen.shape)), 0
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        folder = Path(place)
        around = bench(lens, screen, folder)
        for number, alike in enumerate(_by_index(channels)):
            scene = _scene(around, alike, lens, met=STRAIGHT[lens.reflects] + reflections, folder=folder)
            share = math.fsum(channel.weight for channel in alike)
            for half, picture in enumerate(halves):
                seen, count = _rendered(scene, screen, share * rays / 2, (seed, number, half))
                picture += seen
                photons += count
    return Seen(halves, photons, around.off, variant)


def _variant() -> str:
    """Of Mitsuba: compiled for many photons at once where LLVM is there, else one photon at a time."""
    import drjit

    llvm = drjit.has_backend(drjit.JitBackend.LLVM) and drjit.detail.llvm_version()[0] >= LLVM
    return "llvm_ad_mono" if llvm else "scalar_rgb"


def _by_index(channels: Sequence[Channel]) -> list[list[Channel]]:
    """The channels that meet the same glass, together."""
    alike: dict[float, list[Channel]] = {}
    for channel in channels:
        alike.setdefault(channel.index, []).append(channel)
    return list(alike.values())


def _rendered(scene: Any, screen: Screen, photons: float, seed: tuple[int, ...]) -> tuple[np.ndarray, int]:
    """(flux into each pixel, photons), row 0 = y max, column 0 = x min.  E = π L / ρ."""
    import mitsuba

    pixels = math.prod(screen.shape)
    passes = math.ceil(photons / AT_ONCE)
    spp = max(1, round(photons / pixels / passes))
    numbers = np.random.SeedSequence([abs(part) for part in seed]).generate_state(passes)
    seen = sum(np.array(mitsuba.render(scene, spp=spp, seed=int(n)), dtype=float) for n in numbers) / passes
    per_x, per_y = screen.per_mm
    flux = seen.reshape(*screen.shape, -1)[..., 0] * (math.pi / WHITE / (per_x * per_y))
    return flux[:, ::-1], passes * spp * pixels  # looking along +z with y up, x grows to the left


def bench(lens: Lens, screen: Screen, folder: Path) -> Bench:
    """The lens as meshes in `folder`, as fine as this screen asks for, what stops light beside it, and the screen."""
    back, (below, above) = faces.face(lens.back, lens.outline), lens.apertures
    upper, off = _fine_enough(back, above, lens, screen, up=True)
    solids, blocks = {"back": upper}, {}
    if not lens.reflects:
        front = faces.face(lens.front, lens.outline)
        solids["front"], of_front = _fine_enough(front, below, lens, screen, up=False)
        off = Off.worst((off, of_front))
        blocks = {
            "wall": triangles.wall(front, back, lens.apertures),
            "plate": triangles.plate(front, below),
        }
    meshes = {
        name: {"type": "ply", "filename": str(mesh.write(folder / f"{name}.ply"))}
        for name, mesh in (solids | blocks).items()
    }
    for name in blocks:
        meshes[name]["bsdf"] = _matt(0.0)
    top = float(upper.corners[:, 2].max())
    return Bench(meshes | {"sensor": _camera(screen, top), "screen": _wall(screen)}, off)


def _fine_enough(face: Face, aperture: Outline, lens: Lens, screen: Screen, up: bool) -> tuple[Mesh, Off]:
    """A face in the coarsest mesh that moves no light by more than ENOUGH of a pixel, or in the finest."""
    pixel = 1 / max(screen.per_mm)
    for parts in PARTS:
        mesh, off = triangles.of_face(face, aperture, parts, up)
        if off.moves(lens, screen) <= ENOUGH * pixel or 4 * len(mesh.corners) > MOST:
            break
    return mesh, off


def _scene(around: Bench, channels: Sequence[Channel], lens: Lens, *, met: int, folder: Path) -> Any:
    """All of it with the lamps of channels of one index; met: surfaces that a photon may meet."""
    import mitsuba

    if lens.reflects:
        material = {"type": "conductor", "material": "none"}
    else:
        material = {"type": "dielectric", "int_ior": channels[0].index, "ext_ior": 1.0}
    entries = {
        name: entry | {"bsdf": material} if name in ("front", "back") else entry
        for name, entry in around.entries.items()
    }
    edges = met + 1  # the last leads to the camera
    tracer = {"type": "ptracer", "max_depth": edges, "rr_depth": 100, "hide_emitters": True}
    lit = lamps.of(channels, lens, folder)
    return mitsuba.load_dict({"type": "scene", "integrator": tracer} | entries | lit, optimize=False)


def _camera(screen: Screen, top: float) -> dict[str, Any]:
    """A pinhole before the middle of the screen, nearer than the lens, whose highest point is at z = top (mm)."""
    import mitsuba

    middle, (_, up, normal) = _middle(screen), axes(screen.tilt or (0.0, 0.0))
    across = screen.x[1] - screen.x[0]
    away = min(across / 2, (screen.z - top) / 2)
    eye = [m - away * n for m, n in zip(middle, normal, strict=True)]
    look = mitsuba.ScalarTransform4f().look_at(origin=eye, target=list(middle), up=list(up))
    film = {
        "type": "hdrfilm", "width": screen.columns, "height": screen.rows, "pixel_format": "luminance",
        "component_format": "float32", "rfilter": {"type": "box"},
    }  # fmt: skip
    return {
        "type": "perspective", "fov": math.degrees(2 * math.atan(across / 2 / away)), "fov_axis": "x",
        "to_world": look, "near_clip": 1e-3 * away, "far_clip": 1e3 * away, "film": film,
        "sampler": {"type": "independent"},
    }  # fmt: skip


def _wall(screen: Screen) -> dict[str, Any]:
    """The screen, twice as large as the picture, so that the camera sees nothing else."""
    import mitsuba

    middle, (_, up, normal) = _middle(screen), axes(screen.tilt or (0.0, 0.0))
    behind = [m - n for m, n in zip(middle, normal, strict=True)]
    look = mitsuba.ScalarTransform4f().look_at(origin=list(middle), target=behind, up=list(up))
    return {
        "type": "rectangle", "bsdf": _matt(WHITE),
        "to_world": look.scale(max(high - low for low, high in (screen.x, screen.y))),
    }  # fmt: skip


def _middle(screen: Screen) -> tuple[float, float, float]:
    return sum(screen.x) / 2, sum(screen.y) / 2, screen.z


def _matt(reflectance: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}}
