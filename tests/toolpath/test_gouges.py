"""The deepest gouge that is stated is at least that of a dense, independent search on the written moves, within 5 %."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from bstcad.optics.surfaces.outlines import Circle, Rectangle
from tests.toolpath.test_simulated_shop import Router, exact, highest, lens_of, points_on, stated, waves, written


def deepest_gouge(moves, radius, lift, net, outline):
    """Deepest gouge (mm) at face points about the worst of a coarse grid, by exact distances from the nearest moves."""
    begin, end = (np.array(each) for each in zip(*moves, strict=True))
    kept = np.isfinite(begin[:, 2])
    begin, end = (each[kept] + (0.0, 0.0, lift + radius) for each in (begin, end))
    long = np.linalg.norm(end - begin, axis=1) < 0.5  # longer moves are those of roughing and between lines
    begin, end = begin[long], end[long]
    tree, span = cKDTree((begin + end) / 2), end - begin
    points, width = points_on(net, outline, 0.03), 0.03
    clearance = None
    for turn in range(4):
        if turn:
            worst = points[np.argsort(clearance)[:1500]]
            away = np.linspace(-width / 2, width / 2, 5)
            x, y = (np.ravel(worst[:, k, None, None] + part) for k, part in enumerate(np.meshgrid(away, away)))
            inside = outline.depth(x, y) >= 0
            points, width = np.column_stack([x, y, exact(net, x, y)])[inside], width / 3
        _, near = tree.query(points, 12)
        off = points[:, None] - begin[near]
        share = np.einsum("nkd,nkd->nk", off, span[near]) / np.maximum((span[near] ** 2).sum(-1), 1e-30)
        clearance = np.linalg.norm(off - np.clip(share, 0, 1)[..., None] * span[near], axis=-1).min(1) - radius
    return -clearance.min()


@pytest.mark.parametrize(
    ("outline", "along", "tolerance"),
    [(Rectangle(4.0, 3.0), "x", 5e-4), (Circle(3.0), "y", 2e-4)],
    ids=["plate", "disc"],
)
def test_the_deepest_gouge_is_not_less_than_a_finer_search_finds(outline, along, tolerance):
    lens, radius = lens_of(waves, outline), 1.5
    files = written("raster", lens, along=along, tolerance=tolerance, stock=0.0)
    router = Router(files["toolpath-raster.nc"])
    found = deepest_gouge(router.moves["Finish"], radius, highest(lens.back, outline), lens.back, outline)
    gouge, _ = stated(files["toolpath-raster.txt"])
    assert found < 1.05 * gouge and gouge < 1.2 * found


def test_only_plunges_have_a_third_of_the_feed_and_the_files_say_so():
    files = written("raster", lens_of(waves, Rectangle(4.0, 4.0)), feed=900.0)
    router, down = Router(""), set()
    for line in files["toolpath-raster.nc"].splitlines():
        before = router.place.copy()
        router.run(line)
        if router.mode == 1 and router.place[2] < before[2]:
            down.add((bool((router.place[:2] == before[:2]).all()), router.feed))
    assert (True, 300.0) in down and (False, 900.0) in down and (False, 300.0) not in down
    assert "a third of it in plunges straight down" in " ".join(files["toolpath-raster.txt"].split())
