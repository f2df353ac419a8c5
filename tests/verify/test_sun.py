"""A plate for the sun, as `bstcad new` proposes it: the verdict against rays of the sun that share no code with bstcad.

Each ray starts at random in the aperture, in a random direction of the sun's disc, is refracted by Snell's law in
vectors at the flat front and at the spline (scipy's, from design.npz), and falls into a pixel.
"""

import json
import math

import numpy as np
import pytest
from scipy.interpolate import BSpline, NdBSpline
from scipy.stats import qmc

from bstcad import cli
from bstcad.scene.scene import load
from tests.conftest import draws_nothing, quick_effort, verify_with

SMALL = {
    "lens.back.control_points": 33, "target.pixels": 32, "tailoring.rays": 192, "tailoring.transport_grid": 64,
    "tailoring.stage2_iterations": 10, "output.mesh_tolerance": 0.05,
}  # fmt: skip
RAYS = 1 << 17  # a set
SUN = math.radians(0.53) / 2  # its angular radius


def refracted(d, n, ratio):
    """Snell's law in vectors: d' = ratio d + (√(1 - ratio² (1 - c²)) - ratio c) n with c = d · n > 0."""
    c = (d * n).sum(0)
    return ratio * d + (np.sqrt(1 - ratio**2 * (1 - c**2)) - ratio * c) * n


def sunlight(folder, scene, seed):
    """(rows, columns) of the light on the target by one set of rays, of sum 1."""
    with np.load(folder / "design.npz") as design:
        net, knots, degree = design["control_points"], [design[f"knots_{a}"] for a in "xy"], int(design["degree"])
    back = NdBSpline(tuple(knots), net[..., 2], degree)
    along = [BSpline(k, p, degree) for k, p in zip(knots, (net[:, 0, 0], net[0, :, 1]), strict=True)]  # x(s), y(t)
    tables = [np.linspace(k[0], k[-1], 1 << 16) for k in knots]
    u = qmc.Sobol(4, scramble=True, seed=seed).random(RAYS).T
    half, index = scene.lens.outline.half_extent, scene.index
    x, y = ((2 * a - 1) * h for a, h in zip(u[:2], half, strict=True))
    r, turn = math.sin(SUN) * np.sqrt(u[2]), 2 * math.pi * u[3]
    d = np.stack([r * np.cos(turn), r * np.sin(turn), np.sqrt(1 - r**2)])
    d = refracted(d, np.array([0.0, 0.0, 1.0])[:, None], 1 / index)
    z = np.full(RAYS, scene.lens.back.z)
    for _ in range(8):  # z = h(x + z d_x / d_z, …): contracts by slope times lean, some 1e-3
        at = np.stack([np.clip(p + z * d[i] / d[2], -h, h) for i, (p, h) in enumerate(zip((x, y), half, strict=True))])
        where = [np.interp(p, curve(s), s) for p, curve, s in zip(at, along, tables, strict=True)]
        z = back(np.stack(where, -1))
    inside = (np.abs(x + z * d[0] / d[2]) <= half[0]) & (np.abs(y + z * d[1] / d[2]) <= half[1])
    slopes = np.stack(
        [back(np.stack(where, -1), nu=nu) / along[i](where[i], nu=1) for i, nu in enumerate(((1, 0), (0, 1)))]
    )
    n = np.stack([-slopes[0], -slopes[1], np.ones(RAYS)]) / np.sqrt(1 + (slopes**2).sum(0))
    d = refracted(d, n, index)
    way = (scene.target.z - z) / d[2]
    rows, columns = scene.target.screen.shape
    landed = [p + way * d[i] for i, p in enumerate(at)]
    (left, right), (low, high) = scene.target.x, scene.target.y
    column = np.floor((landed[0] - left) / (right - left) * columns).astype(int)
    row = np.floor((high - landed[1]) / (high - low) * rows).astype(int)
    there = inside & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    picture = np.bincount(row[there] * columns + column[there], minlength=rows * columns).reshape(rows, columns)
    return picture / picture.sum()


def rrmsd_of(folder, sets=2):
    """RRMSD by the product of the errors of two sets of rays, whose expectation has no noise in it."""
    scene = load(folder / "scene.toml")
    target = scene.target.irradiance()
    target = target / target.sum()
    one, other = (sunlight(folder, scene, seed) - target for seed in range(sets))
    return math.sqrt((one * other).sum() / (target**2).sum())


@pytest.fixture(scope="module")
def plate(tmp_path_factory):
    """A plate of 40 x 30 mm that throws letters on a wall 200 mm behind it: its folder."""
    with pytest.MonkeyPatch.context() as patch:
        draws_nothing(patch)
        verify_with(patch, quick_effort())
        patch.chdir(tmp_path_factory.mktemp("sun"))
        assert cli.run(["new", "plate", "--light", "sun", "--size", "40x30", "--distance", "200"]) == 0
        settings = [part for key, value in SMALL.items() for part in ("--set", f"{key}={value}")]
        assert cli.run(["generate", "plate.toml", "--quality", "draft", "-o", "plate", *settings]) in (0, 1)
        yield (tmp_path_factory.getbasetemp() / "sun0" / "plate").resolve()


def test_the_stated_rrmsd_is_that_of_rays_from_the_sun(plate):
    report = json.loads((plate / "report.json").read_text())
    assert report["rrmsd"] == pytest.approx(rrmsd_of(plate), rel=0.03)  # few tubes add half a per cent
    assert not any("size of the source" in sentence for sentence in report["given_up"])


def test_the_finest_detail_is_the_image_of_the_sun(plate):
    """2 · 200 mm · tan(0.265°) through a plate that bends little, on pixels of 1.25 mm; at 100 mm half of it."""
    report = json.loads((plate / "report.json").read_text())
    found, image = report["finest_detail"], 2 * 200 * math.tan(SUN)
    assert found["source_image"] == pytest.approx(image, rel=0.02)
    assert found["width"] == pytest.approx(math.sqrt(image**2 + 4 / 3 * 1.25**2), rel=0.02)
    assert found["nearer_distance"] == 100 and found["of"] == "source.divergence = 0.53 degrees"
    page = (plate / "report.html").read_text(encoding="utf-8")
    assert "Finest detail on the target" in page
    assert "with the target 100 mm instead of 200 mm from the lens: 1.7 mm" in page
