"""The irradiance with Fresnel's losses, by a program not written here: mitsuba's particle tracer; run by `make bench`.

So with the ghost, where mitsuba's photons may turn twice in the lens.

Mitsuba sends single photons from the source, meets each face of the STEP file as a mesh with exact normals at its
corners, reflects or transmits a photon by a draw against Fresnel's reflectance, and looks at a matt screen by a pinhole
camera.  Its picture has the noise of so many photons, which its own repetitions with other seeds state.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from bstcad.optics.channels import Channel
from bstcad.optics.effects import Fresnel, Losses
from bstcad.optics.ghosts import ghost_light
from bstcad.optics.measure import tubes_picture
from bstcad.optics.outlines import Rectangle
from tests.benchmarks.written_lenses import SCENES, back_grid, written

pytestmark = pytest.mark.bench


@pytest.fixture(scope="module", autouse=True)
def judge():
    """mitsuba, which only this benchmark needs."""
    global mitsuba
    import mitsuba  # make bench installs it: pip install -e '.[judges]'


PIXELS = 64
PHOTONS = 250  # a pixel and repetition
REPETITIONS = 8
WHITE = 1e-3  # reflectance of the screen: what it throws back at the lens is nothing
TUBES = 1031
STRAIGHT, TWICE = 3, 5  # surfaces that light meets, the screen among them: straight through, and reflected twice
SIGMAS = 4


@pytest.fixture(scope="module", params=SCENES)
def lens(request, tmp_path_factory):
    return written(request.param, tmp_path_factory.mktemp("judged"))


def mesh(path, x, y, z, z_x, z_y, up):
    """A face as triangles in a PLY file, z and slopes (n, n) with y along the first axis; up: does it face +z?"""
    rows, columns = z.shape
    normal = np.stack([-z_x, -z_y, np.ones_like(z)], axis=-1) * (1 if up else -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    grid_x, grid_y = np.meshgrid(x, y)
    corners = np.concatenate([np.stack([grid_x, grid_y, z], axis=-1), normal], axis=-1).reshape(-1, 6)
    i, j = (a.ravel() for a in np.indices((rows - 1, columns - 1)))
    a, b, c, d = (r * columns + s for r, s in ((i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    triangles = triangles if up else triangles[:, ::-1]
    faces = np.empty(len(triangles), dtype=[("n", "u1"), ("corners", "<i4", 3)])
    faces["n"], faces["corners"] = 3, triangles
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(corners)}\n{names}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(head.encode() + corners.astype("<f4").tobytes() + faces.tobytes())
    return path


def spherical(x, y, front):
    """(z, ∂z/∂x, ∂z/∂y) of z0 + c r² / (1 + sqrt(1 - c² r²))."""
    c = front.curvature
    grid_x, grid_y = np.meshgrid(x, y)
    r2 = grid_x**2 + grid_y**2
    root = np.sqrt(1 - c * c * r2)
    return front.z + c * r2 / (1 + root), c * grid_x / root, c * grid_y / root


def emitter(source):
    """A light source of ours as mitsuba has it, of flux 1."""
    if source.kind == "collimated":
        radius = source.aperture.radius
        turn = mitsuba.ScalarTransform4f().scale([radius, radius, 1])
        power = {"type": "rgb", "value": 1 / (math.pi * radius**2)}
        black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
        return {
            "type": "disk", "to_world": turn, "bsdf": black, "emitter": {"type": "directionalarea", "radiance": power},
        }  # fmt: skip
    x, y, z = source.position
    intensity = 1 / (2 * math.pi * (1 - math.cos(math.radians(source.half_angle))))
    return {
        "type": "spot", "to_world": mitsuba.ScalarTransform4f().translate([x, y, z]),
        "cutoff_angle": source.half_angle, "beam_width": source.half_angle * (1 - 1e-5),
        "intensity": {"type": "rgb", "value": intensity},
    }  # fmt: skip


def stage(written, folder, depth):
    """Mitsuba's scene; depth: of surfaces that a photon may meet, the screen the last."""
    look, screen, step = mitsuba.ScalarTransform4f(), written.scene.target.screen, written.step
    (left, right), (low, high) = screen.x, screen.y
    across, middle = right - left, ((left + right) / 2, (low + high) / 2)
    assert across == high - low
    grid = back_grid(step, parts=4)
    faces = {
        "back": mesh(folder / "back.ply", grid.x, grid.y, grid.z, grid.z_x, grid.z_y, True),
        "front": mesh(folder / "front.ply", grid.x, grid.y, *spherical(grid.x, grid.y, step.front), False),
    }
    glass = {"type": "dielectric", "int_ior": written.scene.index, "ext_ior": 1.0}
    eye = screen.z - across / 2  # between lens and screen; the camera is a point, and stands in nobody's light
    camera = look.look_at(origin=[*middle, eye], target=[*middle, screen.z], up=[0, 1, 0])
    matt = {"type": "diffuse", "reflectance": {"type": "rgb", "value": WHITE}}
    wall = look.translate([*middle, screen.z]).rotate([0, 1, 0], 180).scale(across)  # twice the target each way
    return mitsuba.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "ptracer", "max_depth": depth + 1, "rr_depth": 100, "hide_emitters": True},
            "sensor": {
                "type": "perspective", "fov": 90.0, "to_world": camera,
                "near_clip": 1.0, "far_clip": 1e5,
                "film": {
                    "type": "hdrfilm", "width": PIXELS, "height": PIXELS, "pixel_format": "luminance",
                    "component_format": "float32", "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent"},
            },
            "light": emitter(written.scene.channels()[0].source),
            "screen": {"type": "rectangle", "to_world": wall, "bsdf": matt},
            **{name: {"type": "ply", "filename": str(path), "bsdf": glass} for name, path in faces.items()},
        }
    )  # fmt: skip


def photons(written, folder, depth=STRAIGHT):
    """(REPETITIONS, PIXELS, PIXELS) flux that falls into each pixel, row 0 = y max, column 0 = x min; E = π L / ρ."""
    mitsuba.set_variant("scalar_rgb")
    scene = stage(written, folder, depth)
    screen = written.scene.target.screen
    area = (screen.x[1] - screen.x[0]) * (screen.y[1] - screen.y[0]) / PIXELS**2
    mitsuba.logger().clear_appenders()  # else a progress bar each
    seen = [np.array(mitsuba.render(scene, spp=PHOTONS, seed=k))[..., 0] for k in range(1, REPETITIONS + 1)]
    return np.stack(seen)[:, :, ::-1] * (math.pi / WHITE * area)  # looking along +z with y up, x grows to the left


def disagreement(ours, theirs):
    """sqrt(Σ (ours - mean)² / Σ σ²), σ the deviation of the mean by its repetitions: 1 where they agree."""
    sigma2 = theirs.var(axis=0, ddof=1) / len(theirs)
    return math.sqrt(float(((ours - theirs.mean(axis=0)) ** 2).sum() / sigma2.sum()))


def ours(written, losses):
    channel = written.scene.channels()[0]
    channel = Channel(channel.source, channel.index, 1.0, losses)
    return tubes_picture(written.lens, (channel,), written.scene.target.screen, TUBES).numpy()


def test_the_irradiance_with_fresnels_losses_is_mitsubas(lens, tmp_path):
    theirs = photons(lens, tmp_path)
    source = lens.scene.source
    weighted = ours(lens, Losses(Fresnel(source.wavelength)))
    lossless = ours(lens, None)
    apart, without = disagreement(weighted, theirs), disagreement(lossless, theirs)
    noise = math.sqrt(float((theirs.var(axis=0, ddof=1) / len(theirs)).sum() / (weighted**2).sum()))
    flux, wanted = float(theirs.mean(axis=0).sum()), float(weighted.sum())
    print(
        f"\n{PIXELS**2 * PHOTONS * REPETITIONS / 1e6:.0f} M photons, noise {noise:.2%} of the picture: difference over "
        f"that noise {apart:.3f}, without Fresnel {without:.2f}; flux {flux:.5f} there, {wanted:.5f} here",
        end="",
    )
    assert apart <= 1.1  # of two thousand pixels or more: 1 within a few hundredths
    assert without > 3  # so a wrong loss is seen
    assert flux == pytest.approx(wanted, rel=1e-3)


def test_the_ghost_is_mitsubas(tmp_path):
    """Its flux over all of the target, and where it falls alone: on pixels two away from any that others light."""
    lens = written("a point, through a sphere", tmp_path)
    theirs = photons(lens, tmp_path, TWICE)
    grid = back_grid(lens.step)  # mitsuba's faces have no round rim, which a part of the ghost would meet
    wide = replace(lens, lens=replace(lens.lens, outline=Rectangle(np.ptp(grid.x).item(), np.ptp(grid.y).item())))
    channel = replace(lens.scene.channels()[0], losses=Losses(Fresnel(lens.scene.source.wavelength)))
    ghost = ghost_light(wide.lens, (channel,), lens.scene.target.screen, 1024, 0).picture.numpy()
    straight = ours(wide, channel.losses)
    alone = ~binary_dilation(straight > 1e-6 * straight.max(), iterations=2)
    for where, others in ((np.ones_like(alone), straight.sum()), (alone, 0.0)):
        seen = theirs[:, where].sum(axis=1)
        found, noise = float(seen.mean()), float(seen.std(ddof=1)) / math.sqrt(len(seen))
        expected = float(others + ghost[where].sum())
        print(f"\nflux {found:.6f} ± {noise:.6f} there, {expected:.6f} here, {others:.6f} without a ghost", end="")
        assert abs(found - expected) < SIGMAS * noise < found - others
