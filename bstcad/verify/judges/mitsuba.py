"""Mitsuba 3, a renderer, as a judge: photons from Mitsuba's emitters through a mesh of Mitsuba's dielectric.

Mitsuba's particle tracer sends photons from the source, reflects or transmits each at random (Fresnel reflectance), and
images a matt screen through a pinhole.  Therefore the light has photon noise, and the losses of uncoated faces even if
the scene requests none.  Mirrors are lossless.  With a library of LLVM 16 or later, Mitsuba is several times faster.

The wall of the lens and a plate around its front stop the light that bstcad counts as lost: light through the sides of
the lens, and light beside it.  A parallel beam starts from a plate of the aperture's shape with normals along the beam.
A cone of uniform radiant intensity is a spot; any other point source is a projector, with a slide of its irradiance.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from trimesh import Trimesh

from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.losses import FresnelLoss, Losses
from bstcad.optics.lens.passes import BACK, FRONT, LENS, MIRROR
from bstcad.optics.light.channels import Channel, points_per_line
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.rays import axes
from bstcad.optics.trace.trace import window
from bstcad.verify.judges import faces
from bstcad.verify.judges.faces import Face, FaceError, Traced

MIN_LLVM = 16  # first version of LLVM that compiles Mitsuba's kernels; with 15 the process crashes
SCREEN_REFLECTANCE = 1e-3  # reflectance of the screen, so low that light reflected to the lens is negligible
PHOTONS_PER_PASS = 1 << 22  # largest number of photons in one rendering, limited by memory
MESH_PARTS = (1, 2, 4)  # numbers of mesh cells per half span of the net, tried in turn
MAX_CORNERS = 5_000_000  # largest number of corners of a mesh that refines the coarsest one
MAX_FACET_SHIFT = 0.007  # largest RMS shift of light by facets (pixels); a shift of 0.02 changes a picture by 0.8 %
TEXELS = 1024  # number of texels (pixels) along each side of a slide, or of the picture of a Gaussian beam
TEXEL_CENTRES = (2 * np.arange(TEXELS) + 1) / TEXELS - 1  # centres of texels, from -1 to 1
FIELD_MARGIN = 1.01  # ratio of the slopes at the edge of a projector's field to the largest slope of a ray to the lens
SPOT_EDGE = 1e-5  # width of a spot's soft edge, relative to its half angle
PROJECTOR_FLUX = math.pi  # ratio of the flux of Mitsuba's projector to the irradiance of its slide

Entry = dict[str, Any]  # entry of a scene in Mitsuba's notation
S = TypeVar("S", CollimatedSource, PointSource)


def cannot(lens: Lens, channels: Sequence[Channel]) -> str:
    """Return the reason, a sentence, why Mitsuba cannot trace this light; "" if it can."""
    if lens.before or lens.behind:
        return "it simulates only the lens, and there are windows or mirrors before or behind it"
    if lens.passes not in (LENS, MIRROR):
        return "it simulates a lens or a mirror, and light takes another path through this solid"
    if (first := channels[0].source).kind not in LAMPS:
        return f"Mitsuba has no lamp for the light of {type(first).__name__}"
    if first.parallel and points_per_line(channels) > 1:
        return "parallel light of many directions starts from a plate per direction, and these plates block each other"
    if lens.passes.sense < 0 and first.parallel:
        return "a parallel beam that comes down to a mirror starts from a plate, which would block the reflected light"
    return ""


def light(lens: Lens, channels: Sequence[Channel]) -> tuple[Channel, ...]:
    """Return the channels with the losses that Mitsuba simulates."""
    if not lens.passes.enters:
        return tuple(replace(channel, losses=None) for channel in channels)
    return tuple(replace(channel, losses=Losses(FresnelLoss(channel.source.main_wavelength))) for channel in channels)


def trace(
    lens: Lens, channels: Sequence[Channel], screen: Screen, rays: int, seed: int, reflections: int = 0
) -> Traced:
    """Trace about `rays` photons; reflections: largest number of reflections of a photon in the lens (2: ghosts)."""
    _mitsuba().set_variant(variant := _variant())
    _mitsuba().logger().clear_appenders()  # no progress bar per render
    halves, photons = np.zeros((2, *screen.shape)), 0
    with tempfile.TemporaryDirectory(prefix="bstcad-") as name:
        folder = Path(name)
        bench, error = _scene_without_lamps(lens, screen, folder)
        by_index: dict[float, list[Channel]] = {}
        for channel in channels:
            by_index.setdefault(channel.index, []).append(channel)
        for number, alike in enumerate(by_index.values()):
            scene = _scene(bench, alike, lens, edges=len(lens.passes.steps) + reflections + 2, folder=folder)
            fraction = math.fsum(channel.weight for channel in alike)
            for half, picture in enumerate(halves):
                flux, count = _render(scene, screen, fraction * rays / 2, (seed, number, half))
                picture += flux
                photons += count
    return Traced(halves, photons, error, variant)


def _mitsuba() -> Any:
    """Return the module of Mitsuba, whose contents depend on the variant."""
    import mitsuba

    return mitsuba


def _variant() -> str:
    """Return the variant of Mitsuba: vectorised if LLVM is installed, otherwise one photon at a time."""
    import drjit

    llvm = drjit.has_backend(drjit.JitBackend.LLVM) and drjit.detail.llvm_version()[0] >= MIN_LLVM
    return "llvm_ad_mono" if llvm else "scalar_rgb"


def _render(scene: Any, screen: Screen, photons: float, seed: tuple[int, ...]) -> tuple[np.ndarray, int]:
    """Return the flux per pixel (its area x π radiance / reflectance; row 0 = y max) and the number of photons."""
    pixels, passes = math.prod(screen.shape), math.ceil(photons / PHOTONS_PER_PASS)
    spp = max(1, round(photons / pixels / passes))
    numbers = np.random.SeedSequence([abs(part) for part in seed]).generate_state(passes)
    renders = (np.array(_mitsuba().render(scene, spp=spp, seed=int(n)), dtype=float) for n in numbers)
    mean, (per_x, per_y) = np.asarray(sum(renders)) / passes, screen.per_unit
    flux = mean.reshape(*screen.shape, -1)[..., 0] * (math.pi / SCREEN_REFLECTANCE / (per_x * per_y))
    return flux[:, ::-1], passes * spp * pixels  # looking along +z with y up, x grows to the left


def _scene_without_lamps(lens: Lens, screen: Screen, folder: Path) -> tuple[dict[str, Entry], FaceError]:
    """Return the scene without lamps, with meshes (files in `folder`) fine enough for the screen, and their error."""
    back, (below, above) = faces.face(lens.back, lens.outline), lens.apertures
    upper, error = _fine_mesh(back, above, lens, screen, up=True)
    meshes = {BACK: upper}
    if FRONT in lens.passes.faces:
        front, level = faces.face(lens.front, below), faces.face(lens.front.around, lens.outline)
        meshes[FRONT], of_front = _fine_mesh(front, below, lens, screen, up=False)
        error = FaceError.worst((error, of_front))
        foot = (front, below) if lens.front.outline is None else (level, above)
        meshes |= {"wall": faces.wall(foot[0], back, (foot[1], above)), "plate": faces.plate(front, below)}
    entries = {name: _ply(mesh, folder / f"{name}.ply") for name, mesh in meshes.items()}
    for name in entries.keys() & {"wall", "plate"}:
        entries[name]["bsdf"] = _matt(0.0)
    top = float(upper.vertices[:, 2].max())
    return entries | {"sensor": _camera(screen, top), "screen": _screen_entry(screen)}, error


def _ply(mesh: Trimesh, path: Path) -> Entry:
    mesh.export(path, vertex_normal=True)
    return {"type": "ply", "filename": str(path)}


def _fine_mesh(face: Face, aperture: Outline, lens: Lens, screen: Screen, up: bool) -> tuple[Trimesh, FaceError]:
    """Return the coarsest mesh of a face that shifts light by at most MAX_FACET_SHIFT of a pixel, or the finest one."""
    pixel = 1 / max(screen.per_unit)
    for parts in MESH_PARTS:
        mesh, error = faces.face_mesh(face, aperture, parts, up)
        if error.shift(lens, screen) <= MAX_FACET_SHIFT * pixel or 4 * len(mesh.vertices) > MAX_CORNERS:
            break
    return mesh, error


def _scene(bench: dict[str, Entry], channels: Sequence[Channel], lens: Lens, *, edges: int, folder: Path) -> Any:
    """Load the scene `bench` with the lamps of channels of one index; edges: maximum number of segments of a path."""
    material = {"type": "dielectric", "int_ior": channels[0].index, "ext_ior": 1.0}
    if not lens.passes.enters:
        material = {"type": "conductor", "material": "none"}
    bench = bench | {name: bench[name] | {"bsdf": material} for name in bench.keys() & set(lens.passes.faces)}
    tracer = {"type": "ptracer", "max_depth": edges, "rr_depth": 100, "hide_emitters": True}
    scene = {"type": "scene", "integrator": tracer} | bench | lamps(channels, lens, folder)
    return _mitsuba().load_dict(scene, optimize=False)


def _camera(screen: Screen, top: float) -> Entry:
    """Return a pinhole camera before the centre of the screen, nearer than the lens, whose top is at z = top (mm)."""
    middle, (_, up, normal) = screen.middle, axes(screen.tilt or (0.0, 0.0))
    across = screen.x[1] - screen.x[0]
    away = min(across / 2, (screen.z - top) / 2)
    film = {"type": "hdrfilm", "pixel_format": "luminance", "component_format": "float32", "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": math.degrees(2 * math.atan(across / 2 / away)), "fov_axis": "x"}
    return sensor | {
        "to_world": _look_at([m - away * n for m, n in zip(middle, normal, strict=True)], middle, up),
        "near_clip": 1e-3 * away,
        "far_clip": 1e3 * away,
        "film": film | {"width": screen.columns, "height": screen.rows},
        "sampler": {"type": "independent"},
    }


def _screen_entry(screen: Screen) -> Entry:
    """Return the screen, twice as large as the picture, so that the camera sees nothing else."""
    middle, (_, up, normal) = screen.middle, axes(screen.tilt or (0.0, 0.0))
    facing = _look_at(middle, [m - n for m, n in zip(middle, normal, strict=True)], up)
    size = max(high - low for low, high in (screen.x, screen.y))
    return {"type": "rectangle", "bsdf": _matt(SCREEN_REFLECTANCE), "to_world": facing.scale(size)}


def _matt(reflectance: float) -> Entry:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}}


def _look_at(origin: Iterable[float], target: Iterable[float], up: Iterable[float] = (0.0, 1.0, 0.0)) -> Any:
    return _mitsuba().ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=list(up))


# --- lamps ------------------------------------------------------------------------------------------------------------


def lamps(channels: Sequence[Channel], lens: Lens, folder: Path) -> dict[str, Entry]:
    """Return the sources of channels as entries of a scene; each emits the flux of its channel's weight."""
    first = channels[0].source
    return LAMPS[first.kind](channels, lens, folder)


def _beam_lamps(channels: Sequence[Channel], lens: Lens, folder: Path) -> dict[str, Entry]:
    beams = enumerate(_sources(channels, CollimatedSource))
    return {f"lamp{k}": _plate(beam, weight, lens, folder / f"lamp{k}.ply") for k, (beam, weight) in beams}


def _point_lamps(channels: Sequence[Channel], lens: Lens, folder: Path) -> dict[str, Entry]:
    """Return a spot for each point source of uniform radiant intensity in a cone, otherwise a projector."""
    points = _sources(channels, PointSource)
    first, _ = points[0]
    if first.profile == "uniform" and first.is_cone:
        return {f"lamp{k}": _spot(point, weight, lens) for k, (point, weight) in enumerate(points)}
    half = FIELD_MARGIN * max(_largest_slope(point, lens) for point, _ in points)
    slide = {"slide": _slide(first, lens, half)}
    return slide | {f"lamp{k}": _projector(point, weight, lens, half) for k, (point, weight) in enumerate(points)}


def _sources(channels: Sequence[Channel], kind: type[S]) -> list[tuple[S, float]]:
    """Return the sources of channels, all of one kind, and their weights."""
    return [(channel.source, channel.weight) for channel in channels if isinstance(channel.source, kind)]


LAMPS = {"collimated": _beam_lamps, "point": _point_lamps}  # function that returns the lamps, for each kind of source


def _plate(source: CollimatedSource, weight: float, lens: Lens, path: Path) -> Entry:
    """Return a plate of the aperture's shape that emits a parallel beam, in the plane where rays start."""
    z = lens.entrance.z
    start = source.start(z)
    (x, y), (a, b), distance = source.shift(z), source.slopes, z - start
    disc = faces.disc(source.aperture, (x - distance * a, y - distance * b, start), source.axes[2])
    if source.profile != "uniform":
        half_x, half_y = source.aperture.half_extent
        radiance = _texture(_irradiance(source, x + half_x * TEXEL_CENTRES, y + half_y * TEXEL_CENTRES, z) * weight)
    else:
        radiance = {"type": "rgb", "value": weight / source.aperture.area}
    emitter = {"type": "directionalarea", "radiance": radiance}
    return _ply(disc, path) | {"bsdf": _matt(0.0), "emitter": emitter}


def _spot(source: PointSource, weight: float, lens: Lens) -> Entry:
    """Return a spot with the radiant intensity weight / (2π (1 - cos θ_max)) up to the half angle θ_max."""
    edge = source.half_angle
    assert edge is not None  # a cone has a half angle
    intensity = weight / (2 * math.pi * (1 - math.cos(math.radians(edge))))
    to_world = _look_along(source.position, [_sense(source, lens) * n for n in source.axes[2]])
    spot = {"type": "spot", "to_world": to_world, "cutoff_angle": edge, "beam_width": edge * (1 - SPOT_EDGE)}
    return spot | {"intensity": {"type": "rgb", "value": intensity}}


def _projector(source: PointSource, weight: float, lens: Lens, half: float) -> Entry:
    """Return a projector along the axis of the lens; its square field has slopes up to `half` along x and y."""
    to_world, fov = _look_along(source.position, (0.0, 0.0, _sense(source, lens))), math.degrees(2 * math.atan(half))
    projector = {"type": "projector", "to_world": to_world, "fov": fov, "scale": weight / PROJECTOR_FLUX}
    return projector | {"irradiance": {"type": "ref", "id": "slide"}}


def _largest_slope(source: PointSource, lens: Lens) -> float:
    field, (x, y, z) = window(source, lens), source.position
    return max(field.width / 2 + abs(x), field.height / 2 + abs(y)) / abs(lens.entrance.z - z)


def _slide(source: PointSource, lens: Lens, half: float) -> Entry:
    """Return a projector's slide: the irradiance on a plane 1 mm from the source, seen along the light."""
    (x, y, z), sense, across = source.position, _sense(source, lens), half * TEXEL_CENTRES
    return _texture(_irradiance(source, x - sense * across, y - across, z + sense))


def _irradiance(source: Emitter, x: np.ndarray, y: np.ndarray, z: float) -> np.ndarray:
    """Return the irradiance (rows, columns) of a source at the columns x and rows y (mm) of a plane z (mm)."""
    at_x, at_y = map(torch.from_numpy, np.meshgrid(x, y))
    return source.irradiance(at_x, at_y, z).numpy()


def _texture(values: np.ndarray) -> Entry:
    picture = _mitsuba().Bitmap(np.ascontiguousarray(values[..., None], dtype=np.float32))
    return {"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": "clamp"}


def _sense(source: PointSource, lens: Lens) -> float:
    """Return the direction of the light along z: 1 if the source is below the entrance of the lens, else -1."""
    return 1.0 if source.position[2] <= lens.entrance.z else -1.0


def _look_along(position: Sequence[float], along: Sequence[float]) -> Any:
    return _look_at(position, [p + a for p, a in zip(position, along, strict=True)])
