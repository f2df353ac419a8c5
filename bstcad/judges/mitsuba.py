"""Mitsuba 3, a renderer, as a judge: single photons from its own lamps through a mesh of its own glass.

Its particle tracer sends photons from the source, reflects or transmits each at a face of the lens by a draw against
Fresnel's reflectance, and images a matt screen through a pinhole.  So its light has the losses of bare faces, whatever
a scene asks for, and photon noise.  Its mirror is lossless.

The wall of the lens and a plate around its front stop the light that bstcad counts as lost: through the sides, and past
the lens.  A parallel beam starts from a plate of the aperture's shape, whose normals point its way; a cone of one
radiant intensity is a spot; any other point is a projector, whose slide is its irradiance over the solid angle of the
lens.

With a shared library of LLVM from version 16 on it is several times faster; without, it needs no other.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from trimesh import Trimesh

from bstcad.judges import faces
from bstcad.judges.faces import Face, FaceError, Traced
from bstcad.optics.channels import Channel, points_per_line
from bstcad.optics.collimated import Collimated
from bstcad.optics.emitters import Emitter
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.losses import Fresnel, Losses
from bstcad.optics.outlines import Outline
from bstcad.optics.point import Point
from bstcad.optics.rays import axes
from bstcad.optics.trace import window

LLVM = 16  # the first version by which its kernels compile; with 15 the process ends
WHITE = 1e-3  # reflectance of the screen: light back to the lens does not matter
AT_ONCE = 1 << 22  # photons in a pass, by memory
PARTS = (1, 2, 4)  # parts of half a span of the net
MOST = 5_000_000  # corners of a mesh
ENOUGH = 0.007  # shift of light by facets (RMS, pixels); 0.02 change a picture by 0.8 %
TEXELS = 1024  # texels of a slide along each side
CENTRES = (2 * np.arange(TEXELS) + 1) / TEXELS - 1  # centres of texels, from -1 to 1
ROOM = 1.01  # field of a projector over the lens's
SOFT = 1e-5  # width of a spot's edge, as a part of its cone
PROJECTED = math.pi  # flux of Mitsuba's projector over the irradiance of its slide

Entry = dict[str, Any]  # entry of Mitsuba's scene


def cannot(lens: Lens, channels: Sequence[Channel]) -> str:
    """Why it cannot trace this light, in a sentence; "": it can."""
    if lens.before or lens.behind:
        return "it builds the lens alone, and there are windows or mirrors before or behind it"
    if lens.way is not None:
        return "it builds a lens or a mirror, and light takes another way through this solid"
    if (first := channels[0].source).kind not in LAMPS:
        return f"Mitsuba has no lamp for the light of {type(first).__name__}"
    if first.parallel and points_per_line(channels) > 1:
        return "parallel light of many directions starts from a plate for each, which would stand in each other's light"
    if lens.passes.sense < 0 and first.parallel:
        return "a parallel beam that comes down to a mirror starts from a plate, which would stand in the light"
    return ""


def light(lens: Lens, channels: Sequence[Channel]) -> tuple[Channel, ...]:
    """The channels with the losses that it simulates."""
    if not lens.passes.enters:
        return tuple(replace(channel, losses=None) for channel in channels)
    return tuple(replace(channel, losses=Losses(Fresnel(channel.source.wavelength))) for channel in channels)


def trace(
    lens: Lens, channels: Sequence[Channel], screen: Screen, rays: int, seed: int, reflections: int = 0
) -> Traced:
    """The picture on a screen of square pixels by so many photons, in two halves.

    reflections: inside a lens, at most; with 2 its ghost is part of the picture.
    """
    import mitsuba

    mitsuba.set_variant(variant := _variant())
    mitsuba.logger().clear_appenders()  # it would draw a bar for each render
    halves, photons = np.zeros((2, *screen.shape)), 0
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        folder = Path(place)
        bench, error = _bench(lens, screen, folder)
        by_index: dict[float, list[Channel]] = {}
        for channel in channels:
            by_index.setdefault(channel.index, []).append(channel)
        for number, alike in enumerate(by_index.values()):
            scene = _scene(bench, alike, lens, edges=len(lens.passes.steps) + reflections + 2, folder=folder)
            share = math.fsum(channel.weight for channel in alike)
            for half, picture in enumerate(halves):
                flux, count = _rendered(scene, screen, share * rays / 2, (seed, number, half))
                picture += flux
                photons += count
    return Traced(halves, photons, error, variant)


def _variant() -> str:
    """The variant of Mitsuba: many photons at once where LLVM is there, else one photon at a time."""
    import drjit

    llvm = drjit.has_backend(drjit.JitBackend.LLVM) and drjit.detail.llvm_version()[0] >= LLVM
    return "llvm_ad_mono" if llvm else "scalar_rgb"


def _rendered(scene: Any, screen: Screen, photons: float, seed: tuple[int, ...]) -> tuple[np.ndarray, int]:
    """(flux into each pixel, photons), row 0 = y max, column 0 = x min.  E = π L / ρ."""
    import mitsuba

    pixels, passes = math.prod(screen.shape), math.ceil(photons / AT_ONCE)
    spp = max(1, round(photons / pixels / passes))
    numbers = np.random.SeedSequence([abs(part) for part in seed]).generate_state(passes)
    mean = sum(np.array(mitsuba.render(scene, spp=spp, seed=int(n)), dtype=float) for n in numbers) / passes
    per_x, per_y = screen.per_unit
    flux = mean.reshape(*screen.shape, -1)[..., 0] * (math.pi / WHITE / (per_x * per_y))
    return flux[:, ::-1], passes * spp * pixels  # looking along +z with y up, x grows to the left


def _bench(lens: Lens, screen: Screen, folder: Path) -> tuple[dict[str, Entry], FaceError]:
    """(the scene without lamps, with meshes in `folder` as fine as the screen asks for; the error of the meshes)."""
    back, (below, above) = faces.face(lens.back, lens.outline), lens.apertures
    upper, error = _fine_enough(back, above, lens, screen, up=True)
    meshes = {"back": upper}
    if "front" in lens.passes.faces:
        front, level = faces.face(lens.front, below), faces.face(lens.front.around, lens.outline)
        meshes["front"], of_front = _fine_enough(front, below, lens, screen, up=False)
        error = FaceError.worst((error, of_front))
        foot = (front, below) if lens.front.outline is None else (level, above)
        meshes |= {"wall": faces.wall(foot[0], back, (foot[1], above)), "plate": faces.plate(front, below)}
    entries = {name: _ply(mesh, folder / f"{name}.ply") for name, mesh in meshes.items()}
    for name in entries.keys() & {"wall", "plate"}:
        entries[name]["bsdf"] = _matt(0.0)
    top = float(upper.vertices[:, 2].max())
    return entries | {"sensor": _camera(screen, top), "screen": _wall(screen)}, error


def _ply(mesh: Trimesh, path: Path) -> Entry:
    """A mesh by a binary PLY file in float32."""
    mesh.export(path, vertex_normal=True)
    return {"type": "ply", "filename": str(path)}


def _fine_enough(face: Face, aperture: Outline, lens: Lens, screen: Screen, up: bool) -> tuple[Trimesh, FaceError]:
    """A face in the coarsest mesh that moves no light by more than ENOUGH of a pixel, or in the finest."""
    pixel = 1 / max(screen.per_unit)
    for parts in PARTS:
        mesh, error = faces.face_mesh(face, aperture, parts, up)
        if error.shift(lens, screen) <= ENOUGH * pixel or 4 * len(mesh.vertices) > MOST:
            break
    return mesh, error


def _scene(bench: dict[str, Entry], channels: Sequence[Channel], lens: Lens, *, edges: int, folder: Path) -> Any:
    """The bench with the lamps of channels of one index; edges: of a photon's way, the last leads to the camera."""
    import mitsuba

    material = {"type": "dielectric", "int_ior": channels[0].index, "ext_ior": 1.0}
    if not lens.passes.enters:
        material = {"type": "conductor", "material": "none"}
    bench = bench | {name: bench[name] | {"bsdf": material} for name in bench.keys() & {"front", "back"}}
    tracer = {"type": "ptracer", "max_depth": edges, "rr_depth": 100, "hide_emitters": True}
    scene = {"type": "scene", "integrator": tracer} | bench | lamps(channels, lens, folder)
    return mitsuba.load_dict(scene, optimize=False)


def _camera(screen: Screen, top: float) -> Entry:
    """A pinhole before the middle of the screen, nearer than the lens, whose highest point is at z = top (mm)."""
    middle, (_, up, normal) = screen.middle, axes(screen.tilt or (0.0, 0.0))
    across = screen.x[1] - screen.x[0]
    away = min(across / 2, (screen.z - top) / 2)
    film = {
        "type": "hdrfilm", "width": screen.columns, "height": screen.rows, "pixel_format": "luminance",
        "component_format": "float32", "rfilter": {"type": "box"},
    }  # fmt: skip
    return {
        "type": "perspective", "fov": math.degrees(2 * math.atan(across / 2 / away)), "fov_axis": "x",
        "to_world": _look_at([m - away * n for m, n in zip(middle, normal, strict=True)], middle, up),
        "near_clip": 1e-3 * away, "far_clip": 1e3 * away, "film": film, "sampler": {"type": "independent"},
    }  # fmt: skip


def _wall(screen: Screen) -> Entry:
    """The screen, twice as large as the picture, so that the camera sees nothing else."""
    middle, (_, up, normal) = screen.middle, axes(screen.tilt or (0.0, 0.0))
    facing = _look_at(middle, [m - n for m, n in zip(middle, normal, strict=True)], up)
    size = max(high - low for low, high in (screen.x, screen.y))
    return {"type": "rectangle", "bsdf": _matt(WHITE), "to_world": facing.scale(size)}


def _matt(reflectance: float) -> Entry:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}}


def _look_at(origin: Iterable[float], target: Iterable[float], up: Iterable[float] = (0.0, 1.0, 0.0)) -> Any:
    import mitsuba

    return mitsuba.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=list(up))


# --- lamps ------------------------------------------------------------------------------------------------------------


def lamps(channels: Sequence[Channel], lens: Lens, folder: Path) -> dict[str, Entry]:
    """The sources of channels as entries of Mitsuba's scene; each sends the flux of its channel's weight."""
    first = channels[0].source
    return LAMPS[first.kind](channels, lens, folder)


def _plates(channels: Sequence[Channel], lens: Lens, folder: Path) -> dict[str, Entry]:
    """A plate for each parallel beam."""
    return {f"lamp{k}": _plate(c.source, c.weight, lens, folder / f"lamp{k}.ply") for k, c in enumerate(channels)}


def _spots(channels: Sequence[Channel], lens: Lens, folder: Path) -> dict[str, Entry]:
    """A spot for each point of one radiant intensity in a cone, else a projector."""
    first = channels[0].source
    if first.profile == "uniform" and first.is_cone:
        return {f"lamp{k}": _spot(c.source, c.weight, lens) for k, c in enumerate(channels)}
    half = ROOM * max(_half(c.source, lens) for c in channels)
    slide = {"slide": _slide(first, lens, half)}
    return slide | {f"lamp{k}": _projector(c.source, c.weight, lens, half) for k, c in enumerate(channels)}


LAMPS = {"collimated": _plates, "point": _spots}  # Mitsuba's lamps for each kind of source


def _plate(source: Collimated, weight: float, lens: Lens, path: Path) -> Entry:
    """A parallel beam through its aperture, from the plane where rays start."""
    z = lens.entrance.z
    start = source.start(z)
    (x, y), (a, b), way = source.shift(z), source.slopes, z - start
    disc = faces.disc(source.aperture, (x - way * a, y - way * b, start), source.axes[2])
    if source.profile == "gaussian":
        half_x, half_y = source.aperture.half_extent
        radiance = _texture(_irradiance(source, x + half_x * CENTRES, y + half_y * CENTRES, z) * weight)
    else:
        radiance = {"type": "rgb", "value": weight / source.aperture.area}
    emitter = {"type": "directionalarea", "radiance": radiance}
    return _ply(disc, path) | {"bsdf": _matt(0.0), "emitter": emitter}


def _spot(source: Point, weight: float, lens: Lens) -> Entry:
    """I = 1 / (2π (1 - cos θ_max)) up to θ_max."""
    edge = source.half_angle
    intensity = weight / (2 * math.pi * (1 - math.cos(math.radians(edge))))
    return {
        "type": "spot", "to_world": _looking(source.position, [_sense(source, lens) * n for n in source.axes[2]]),
        "cutoff_angle": edge, "beam_width": edge * (1 - SOFT), "intensity": {"type": "rgb", "value": intensity},
    }  # fmt: skip


def _projector(source: Point, weight: float, lens: Lens, half: float) -> Entry:
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


def _slide(source: Point, lens: Lens, half: float) -> Entry:
    """E on the plane at the distance 1 from the source, as seen along its light."""
    (x, y, z), sense, across = source.position, _sense(source, lens), half * CENTRES
    return _texture(_irradiance(source, x - sense * across, y - across, z + sense))


def _irradiance(source: Emitter, x: np.ndarray, y: np.ndarray, z: float) -> np.ndarray:
    """(rows, columns) of a source on a plane z (mm)."""
    return source.irradiance(*map(torch.from_numpy, np.meshgrid(x, y)), z).numpy()


def _texture(values: np.ndarray) -> Entry:
    import mitsuba

    picture = mitsuba.Bitmap(np.ascontiguousarray(values[..., None], dtype=np.float32))
    return {"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": "clamp"}


def _sense(source: Point, lens: Lens) -> float:
    """1 if it looks along its third axis, -1 against it."""
    return 1.0 if source.position[2] <= lens.entrance.z else -1.0


def _looking(place: Sequence[float], along: Sequence[float]) -> Any:
    return _look_at(place, [p + a for p, a in zip(place, along, strict=True)])
