"""Mitsuba 3's caustic optimisation, at the settings of its tutorial, on a caustic scene of ours.

python -m tests.benchmarks.mitsuba_caustic templates/caustic_portrait.toml heights.npz --limit 600

Settings as in the tutorial "Caustics optimization" of Mitsuba 3's documentation (mitsuba.readthedocs.io, inverse
rendering): a plate whose exit face is a mesh of 512 x 512 vertices, displaced along its
normal by a height map of 32 x 32 texels that doubles four times on the way; a particle tracer with 64 photons a
pixel, 32 for the gradient, on 128 x 128 pixels through a Gaussian filter; squared differences of the two pictures,
each over its mean; Adam at 3e-5 for 1000 iterations, with twice the photons and half the rate from 70 % and again
from 90 %; heights within a hundredth.  Its unit of length is half the plate, as there.  What is ours is the case: the
index, the distance and the width of the picture are those of the scene, and its target takes the place of the
tutorial's pictures.

The variant llvm_ad_rgb needs a shared library of LLVM, with drjit 1.5 a recent one (Debian and Ubuntu: apt install
libllvm19, which is found; elsewhere name it in DRJIT_LIBLLVM_PATH).  With LLVM 15 its kernels end in "Cannot select".
"""

from __future__ import annotations

import time

BEGAN = time.perf_counter()  # before the libraries are loaded, which is a part of what a run takes

import argparse  # noqa: E402
import math  # noqa: E402
from dataclasses import dataclass  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402

PIXELS, VERTICES, UPSAMPLINGS = 128, 512, 4  # a side; a side; doublings of the height map
ITERATIONS, PHOTONS, RATE = 1000, 32, 3e-5  # PHOTONS: a pixel, for the gradient; twice as many for the picture
REFINED = (0.7, 0.9)  # fractions of the iterations at which the photons are doubled and the rate is halved
HIGHEST = 0.01  # largest height of the height map, in halves of the plate
FIELD = 45.0  # degrees, of the camera
THREADS = 2
SEEN, LOOKS = 1024, 4  # photons a pixel with which Mitsuba judges the end of its run; so many times
KEPT = (5, 10, 20, 40, 80, 160, 250, 360, 500, 640, 700, 800, 900, 1000)  # iterations whose heights are kept


@dataclass(frozen=True)
class Case:
    """A caustic scene in Mitsuba's unit of length, half the plate."""

    index: float
    distance: float  # distance from the exit face to the screen (mm)
    half: float  # half the width of the picture, which is in the middle of the screen
    target: np.ndarray  # (PIXELS, PIXELS) irradiance, row 0 = y max, column 0 = x min
    unit: float  # mm

    @classmethod
    def of(cls, path: Path) -> Case:
        """Read a scene file with a square plate in parallel light, on axis."""
        from bstcad.scene.scene import load

        scene = load(path)
        target, unit = scene.target, scene.lens.outline.width / 2
        picture = target.irradiance()
        block = picture.shape[0] // PIXELS
        coarse = picture.reshape(PIXELS, block, PIXELS, block).mean(axis=(1, 3))
        low, high = target.x
        assert low == -high and target.y == target.x and scene.source.kind == "collimated"
        return cls(scene.index, (target.z - scene.lens.back.z) / unit, high / unit, coarse, unit)


def plate(mitsuba: Any) -> Any:
    """The exit face, flat at z = 0 over [-1, 1]², as a mesh with texture coordinates and vertex normals."""
    n = VERTICES
    line = np.linspace(0.0, 1.0, n, dtype=np.float32)
    v, u = np.meshgrid(line, line, indexing="ij")
    i, j = (part.ravel() for part in np.indices((n - 1, n - 1)))
    a, b, c, d = (r * n + s for r, s in ((i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)))
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([b, c, d], 1)])
    mesh = mitsuba.Mesh("plate", n * n, len(faces), has_vertex_normals=True, has_vertex_texcoords=True)
    known = mitsuba.traverse(mesh)
    known["vertex_positions"] = np.stack([2 * u - 1, 2 * v - 1, 0 * u], -1).ravel()
    known["vertex_normals"] = np.tile(np.float32([0, 0, 1]), n * n)
    known["vertex_texcoords"] = np.stack([u, v], -1).ravel()
    known["faces"] = faces.astype(np.uint32).ravel()
    known.update()
    return mesh


def stage(mitsuba: Any, case: Case, folder: Path, filter: str = "gaussian") -> Any:
    """Light along +z through the plate onto the screen, which a pinhole between the two looks at.

    filter: how a photon is shared out among pixels; "box": it counts for the one that it hits.
    """
    turn = mitsuba.ScalarTransform4f
    file = str(folder / "plate.ply")
    plate(mitsuba).write_ply(file)
    eye = case.distance - case.half / math.tan(math.radians(FIELD / 2))
    glass = {
        "type": "dielectric", "int_ior": case.index, "ext_ior": "air",
        "specular_reflectance": {"type": "spectrum", "value": 0},
    }  # fmt: skip
    black = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0}}
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    lamp = {"type": "directionalarea", "radiance": {"type": "spectrum", "value": 0.8}}
    film = {
        "type": "hdrfilm", "width": PIXELS, "height": PIXELS, "pixel_format": "rgb", "rfilter": {"type": filter}
    }  # fmt: skip
    return mitsuba.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "ptracer", "samples_per_pass": 256, "max_depth": 4, "hide_emitters": False},
            "sensor": {
                "type": "perspective", "near_clip": 1e-2, "far_clip": 1000, "fov": FIELD,
                "to_world": turn().look_at(origin=[0, 0, eye], target=[0, 0, case.distance], up=[0, 1, 0]),
                "film": film, "sampler": {"type": "independent"},
            },
            "lamp": {"type": "rectangle", "to_world": turn().translate([0, 0, -5]), "bsdf": black, "emitter": lamp},
            "entrance": {
                "type": "rectangle", "to_world": turn().translate([0, 0, -0.2]).rotate([0, 1, 0], 180), "bsdf": glass,
            },
            "exit": {"type": "ply", "filename": file, "bsdf": glass},
            "screen": {
                "type": "rectangle", "bsdf": white,
                "to_world": turn().translate([0, 0, case.distance]).rotate([0, 1, 0], 180).scale(5),
            },
        },
        optimize=False,  # which would make one mesh of both faces
    )  # fmt: skip


def optimised(case: Case, limit: float, folder: Path) -> dict[str, np.ndarray]:
    """Seconds, CPU seconds, iterations and heights (VERTICES, VERTICES) in mm, y along the first axis, on the way."""
    import drjit
    import mitsuba

    drjit.set_thread_count(THREADS)
    mitsuba.set_variant("llvm_ad_rgb")
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    scene = stage(mitsuba, case, folder)
    target = mitsuba.TensorXf(np.repeat(case.target[:, ::-1, None], 3, axis=2).astype(np.float32))
    target = target / drjit.mean(target)  # the camera looks along +z with y up: x grows to the left
    first = VERTICES // 2**UPSAMPLINGS
    flat = mitsuba.Bitmap(drjit.zeros(mitsuba.TensorXf, (first, first)))
    heights = mitsuba.load_dict({"type": "bitmap", "bitmap": flat, "raw": True})
    known, world = mitsuba.traverse(heights), mitsuba.traverse(scene)
    known.keep(["data"])
    adam = mitsuba.ad.Adam(lr=RATE, params=known)
    places = drjit.unravel(mitsuba.Vector3f, world["exit.vertex_positions"])
    looked = drjit.zeros(mitsuba.SurfaceInteraction3f, drjit.width(places))
    looked.uv = drjit.unravel(mitsuba.Point2f, world["exit.vertex_texcoords"])

    def displaced() -> Any:
        known["data"] = drjit.clip(known["data"], -HIGHEST, HIGHEST)
        drjit.enable_grad(known["data"])
        known.update()
        z = heights.eval_1(looked)
        world["exit.vertex_positions"] = drjit.ravel(places + mitsuba.Vector3f(0, 0, z))
        world.update()
        return z

    photons, stamps, kept = PHOTONS, [], []
    doubled = {int(ITERATIONS * (k / (UPSAMPLINGS + 1)) ** 2) for k in range(1, UPSAMPLINGS + 1)}
    for iteration in range(ITERATIONS):
        displaced()
        picture = mitsuba.render(scene, known, seed=iteration, spp=2 * photons, spp_grad=photons)
        drjit.backward(drjit.mean(drjit.square(picture / drjit.mean(drjit.detach(picture)) - target)))
        adam.step()
        if iteration in doubled:
            a_side = 2 * adam["data"].shape[0]  # each texel four times, as there
            adam["data"] = drjit.resample(adam["data"], (a_side, a_side, 1), filter="box")
        known.update(adam)
        if iteration in {int(share * ITERATIONS) for share in REFINED}:
            photons *= 2
            adam.set_learning_rate(0.5 * adam.learning_rate())
        spent, done = time.perf_counter() - BEGAN, iteration + 1
        if done in KEPT or spent > limit:
            stamps.append((spent, time.process_time(), done))
            kept.append(case.unit * np.array(drjit.detach(displaced())).reshape(VERTICES, VERTICES))
            print(f"{done} iterations, {spent:.0f} s", flush=True)
        if spent > limit:
            break
    seconds, cpu_seconds, iterations = map(np.array, zip(*stamps, strict=True))
    found = {"seconds": seconds, "cpu_seconds": cpu_seconds, "iterations": iterations}
    return found | {"heights": np.stack(kept).astype(np.float32)}


def by_itself(case: Case, heights: np.ndarray, folder: Path) -> tuple[float, float]:
    """RRMSD of heights (mm) by Mitsuba's own particle tracer on its own pixels, and how much of it is noise."""
    import mitsuba

    scene = stage(mitsuba, case, folder, "box")
    world = mitsuba.traverse(scene)
    places = np.array(world["exit.vertex_positions"]).reshape(-1, 3)
    places[:, 2] += heights.ravel() / case.unit
    world["exit.vertex_positions"] = places.ravel()
    world.update()
    seen = [np.array(mitsuba.render(scene, spp=SEEN, seed=k))[:, ::-1, 0].astype(float) for k in range(1, LOOKS + 1)]
    pictures = np.stack([picture / picture.sum() for picture in seen])
    target = case.target / case.target.sum()
    size = math.sqrt((target**2).sum())
    apart = math.sqrt(((pictures.mean(axis=0) - target) ** 2).sum())
    return apart / size, math.sqrt((pictures.var(axis=0, ddof=1) / LOOKS).sum()) / size


def control_net(heights: np.ndarray) -> np.ndarray:
    """The net (n + 1, n + 1) of the quadratic spline that refracts as the mesh of heights (n, n) does.

    Its points lie half a pitch beside the vertices, at the means of four of them, and so its slope at a vertex is the
    mean over the facets around, which are the vertex normals that Mitsuba interpolates and refracts by.
    """
    middles = (heights[1:, 1:] + heights[1:, :-1] + heights[:-1, 1:] + heights[:-1, :-1]) / 4
    return np.pad(middles, 1, mode="reflect", reflect_type="odd")


def main() -> None:
    """Optimise a scene within `limit` seconds, and keep the heights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--limit", type=float, default=600.0)
    wanted = parser.parse_args()
    case, folder = Case.of(wanted.scene), wanted.output.parent
    found = optimised(case, wanted.limit, folder)
    own = by_itself(case, found["heights"][-1], folder)
    np.savez(wanted.output, **found, own=np.array(own))


if __name__ == "__main__":
    main()
