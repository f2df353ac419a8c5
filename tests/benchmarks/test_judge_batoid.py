"""Where single rays land, by a program not written here: batoid, on the surfaces of the STEP file; run by `make bench`.

Whole pictures of all templates: test_judges.py.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bstcad.judges import batoid as judge
from bstcad.optics.losses import Fresnel, Losses
from bstcad.optics.trace import follow_ghost, launch, to_first_free, to_plane, trace
from tests.benchmarks.written_lenses import SCENES, written

pytestmark = pytest.mark.bench

RMS = 1e-6  # mm, at a throw of a metre
RAYS = 200  # a side
EXACT = 0.9  # of the net's width: there, within one and a half pitches of its rim, batoid's back is the spline itself


@pytest.fixture(scope="module", params=SCENES)
def lens(request, tmp_path_factory):
    return written(request.param, tmp_path_factory.mktemp("judged"))


def landing(bundle, written, more=0.0):
    """(x, y) (mm) on the target's plane, and which rays got there; the index is `more` than the lens's."""
    lens = replace(written.lens, index=written.scene.index + more)
    x, y, arrived = judge.land(judge.through(lens, judge.surfaces(lens), bundle), written.scene.target.screen)
    return np.stack([x, y]), arrived


def bundle_of(written):
    """Rays over all of the light that meet the back where batoid's grid of it is exact."""
    source, lens = written.scene.channels()[0].source, written.lens
    rays = launch(source, lens, RAYS, seed=3)
    x, y, _ = to_first_free(rays, lens).position  # on the front: the rays lie further in on the back, or little further
    ours = trace(rays, lens, written.scene.target.z)
    (_, right), (_, high) = lens.back.x, lens.back.y
    kept = ours.alive & (x.abs() < EXACT * right) & (y.abs() < EXACT * high)
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
    import batoid

    lens = written("a point, through a sphere", tmp_path)
    rays, _, kept = bundle_of(lens)
    air, glass = batoid.ConstMedium(1.0), batoid.ConstMedium(lens.scene.index)
    front, back = judge.surfaces(lens.lens)
    theirs = judge.vector(rays)
    batoid.refract(front.surface, theirs, air, glass, front.frame)
    batoid.reflect(back.surface, theirs, back.frame)
    batoid.reflect(front.surface, theirs, front.frame)
    batoid.refract(back.surface, theirs, glass, air, back.frame)
    x, y, arrived = judge.land(theirs, lens.scene.target.screen)
    out, _ = follow_ghost(rays, replace(lens.lens, losses=Losses(Fresnel(lens.scene.source.wavelength))))
    ours = to_plane(out, lens.scene.target.z)
    both = (kept & ours.alive).numpy() & arrived
    rms, worst = rms_apart(ours.position[:2].numpy()[:, both], np.stack([x, y])[:, both])
    print(f"\n{both.sum()} rays of a ghost: rms {rms:.1e} mm, worst {worst:.1e} mm", end="")
    assert both.sum() > 0.3 * int(kept.sum())
    assert rms <= RMS
