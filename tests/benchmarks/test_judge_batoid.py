"""Where rays land, by a program not written here: batoid, on the surfaces of the STEP file; run by `make bench`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bstcad.optics.effects import Fresnel, Losses
from bstcad.optics.ghosts import follow
from bstcad.optics.simulation import launch
from bstcad.optics.trace import to_plane, towards_back, trace
from tests.benchmarks.written_lenses import SCENES, back_grid, written

pytestmark = pytest.mark.bench


@pytest.fixture(scope="module", autouse=True)
def judge():
    """batoid, which only this benchmark needs."""
    global batoid
    import batoid  # make bench installs it: pip install -e '.[judges]'


RMS = 1e-6  # mm, at a throw of a metre
RAYS = 200  # a side


@pytest.fixture(scope="module", params=SCENES)
def lens(request, tmp_path_factory):
    return written(request.param, tmp_path_factory.mktemp("judged"))


def faces(step):
    """(front, back), each a surface of batoid's and where it stands (mm)."""
    front = step.front
    shape = batoid.Sphere(1 / front.curvature) if front.curvature else batoid.Plane()
    grid = back_grid(step)
    middle = len(grid.x) // 2
    z = float(grid.z[middle, middle])
    back = batoid.Bicubic(grid.x, grid.y, grid.z - z, grid.z_x, grid.z_y, grid.z_xy)
    return (shape, front.z), (back, z), (grid.x[0], grid.x[-1], grid.y[0], grid.y[-1])


def standing(z):
    return batoid.CoordSys(origin=[0.0, 0.0, z])


def rays_of(bundle):
    """The rays of a bundle of ours; batoid's velocity is that of light in the medium."""
    x, y, _ = (np.ascontiguousarray(p) for p in bundle.position.numpy())
    z = np.ascontiguousarray(bundle.above(0.0).numpy())
    return batoid.RayVector(x, y, z, *(np.ascontiguousarray(d) for d in bundle.direction.numpy()))


def landing(bundle, written, more=0.0):
    """(x, y) (mm) on the target's plane, and which rays got there; the index is `more` than the lens's."""
    air, glass = batoid.ConstMedium(1.0), batoid.ConstMedium(written.scene.index + more)
    (front, front_z), (back, back_z), _ = faces(written.step)
    rays = rays_of(bundle)
    batoid.refract(front, rays, air, glass, standing(front_z))
    batoid.refract(back, rays, glass, air, standing(back_z))
    batoid.intersect(batoid.Plane(), rays, standing(written.scene.target.z))
    return np.stack([rays.x, rays.y]), ~rays.failed


def bundle_of(written):
    """Rays over all of the light that meet the back where batoid's grid of it is exact."""
    source, lens = written.scene.channels()[0].source, written.lens
    rays = launch(source, lens, RAYS, seed=3)
    *_, (left, right, low, high) = faces(written.step)
    x, y, _ = towards_back(rays, lens).position  # on the front: the rays lie further in on the back, or little further
    ours = trace(rays, lens, written.scene.target.z)
    margin = 0.02 * (right - left)
    inside = (x > left + margin) & (x < right - margin) & (y > low + margin) & (y < high - margin)
    kept = ours.alive & inside
    assert float(kept.sum()) > 0.8 * float(ours.alive.sum())
    return rays, ours, kept


def rms_apart(ours, theirs):
    """Root mean square and largest distance (mm) of landing points (2, n)."""
    off = np.hypot(*(ours - theirs))
    return float(np.sqrt(np.mean(off**2))), float(off.max())


def test_rays_land_where_batoid_has_them(lens):
    rays, ours, kept = bundle_of(lens)
    theirs, arrived = landing(rays, lens)
    kept = kept.numpy()
    assert arrived[kept].all()
    rms, worst = rms_apart(ours.position.numpy()[:, kept], theirs[:, kept])
    print(f"\n{kept.sum()} rays, a metre's throw: rms {rms:.1e} mm, worst {worst:.1e} mm", end="")
    assert rms <= RMS


def test_a_wrong_index_is_seen(lens):
    rays, ours, kept = bundle_of(lens)
    theirs, _ = landing(rays, lens, more=1e-7)
    rms, _ = rms_apart(ours.position.numpy()[:, kept.numpy()], theirs[:, kept.numpy()])
    assert rms > RMS


def test_the_ghost_lands_where_batoid_has_it(tmp_path):
    """Down again from the back and up again from the front; rays that meet the back off batoid's grid are left out.

    The other lens has none: it turns light so far off the axis that the ghost meets the back beyond the critical angle.
    """
    lens = written("a point, through a sphere", tmp_path)
    rays, _, kept = bundle_of(lens)
    air, glass = batoid.ConstMedium(1.0), batoid.ConstMedium(lens.scene.index)
    (front, front_z), (back, back_z), _ = faces(lens.step)
    theirs = rays_of(rays)
    batoid.refract(front, theirs, air, glass, standing(front_z))
    batoid.reflect(back, theirs, standing(back_z))
    batoid.reflect(front, theirs, standing(front_z))
    batoid.refract(back, theirs, glass, air, standing(back_z))
    batoid.intersect(batoid.Plane(), theirs, standing(lens.scene.target.z))
    out, _ = follow(rays, replace(lens.lens, losses=Losses(Fresnel(lens.scene.source.wavelength))))
    ours = to_plane(out, lens.scene.target.z)
    found = np.stack([theirs.x, theirs.y])
    both = (kept & ours.alive).numpy() & ~theirs.failed & np.isfinite(found).all(axis=0)
    rms, worst = rms_apart(ours.position[:2].numpy()[:, both], found[:, both])
    print(f"\n{both.sum()} rays of a ghost: rms {rms:.1e} mm, worst {worst:.1e} mm", end="")
    assert both.sum() > 0.3 * int(kept.sum())
    assert rms <= RMS
