"""A mirror and a tilted wall, from the scene to the files: the picture, which way round it is, the solid, the words."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

import bstcad
from bstcad import commands
from bstcad.verify import step_checks
from tests.conftest import draws_nothing, quick_effort
from tests.efforts import LITTLE
from tests.scenes import designed
from tests.test_seen import letter

SMALL = {
    "lens.back.control_points": 33, "target.pixels": 48, "target.sample": None, "tailoring.quality": "draft",
    "tailoring.rays": 256, "tailoring.transport_grid": 64, "accept": {"rrmsd": 0.25},
}  # fmt: skip
PARALLEL = {"source": {"kind": "collimated", "aperture": {"shape": "circle", "radius": 27.0}, "z": 100.0}}
EFFORT = quick_effort()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """(folder, report.json, the scene) of a mirror that throws an F on a tilted wall, by parallel light."""
    place = tmp_path_factory.mktemp("mirror")
    Image.fromarray(letter()).save(place / "F.png")
    scene = bstcad.load("templates/mirror.toml").changed(
        SMALL | PARALLEL | {"target.tilt": [0.0, 35.0], "target.image": str(place / "F.png"), "target.gamma": 1.0}
    )
    designed(scene, EFFORT, place / "out", tailoring=LITTLE)
    return place / "out", json.loads((place / "out" / "report.json").read_text()), scene


def test_every_check_passes(made):
    _, report, _ = made
    assert report["passed"] and report["optic"] == "mirror"
    assert report["flux"]["on target"] > 0.95 and report["efficiency"] > 0.98
    assert report["flux"]["total internal reflection"] == report["flux"]["lost through the sides"] == 0.0


def test_rays_in_space_draw_the_letter_as_it_is_to_whom_looks_along_z(made):
    """The mirror as it was read back, its rays carried to the plane by n · (P - C) = 0 here, counted in pixels.

    To that person x grows to the left; a letter that is turned or mirrored correlates less.
    """
    folder, report, scene = made
    lens = step_checks.lens(folder / "lens.step", scene.index, scene.lens.passes)
    half_x, half_y = lens.outline.half_extent
    line = (torch.arange(500, dtype=torch.float64) + 0.5) / 250 - 1
    x, y = (p.reshape(-1) for p in torch.meshgrid(half_x * line, half_y * line, indexing="ij"))
    leaving = scene.source.rays_through(x, y, lens.entrance.z, 1.0)
    for interface in lens.interfaces:
        leaving = bstcad.cross(leaving, interface).rays
    target, b = scene.target, np.radians(scene.target.tilt[1])
    middle = np.array([sum(target.x) / 2, sum(target.y) / 2, target.z])
    turn = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    alive = leaving.alive.numpy() & (leaving.flux.numpy() > 0)
    start = torch.stack([*leaving.position[:2], leaving.above(0.0)]).numpy()[:, alive] - middle[:, None]
    start, way = turn.T @ start, turn.T @ leaving.direction.numpy()[:, alive]  # as the plane sees them
    landed = start[:2] - start[2] / way[2] * way[:2] + middle[:2, None]
    columns, rows = target.columns_rows
    found, *_ = np.histogram2d(
        landed[1], landed[0], (rows, columns), (target.y, target.x), weights=leaving.flux.numpy()[alive]
    )
    wanted = target.irradiance()
    found = found[::-1] / found.sum()
    assert np.sqrt(((found - wanted) ** 2).sum() / (wanted**2).sum()) < 1.5 * report["rrmsd"] + 0.05
    seen, wanted = found[:, ::-1].ravel(), wanted[:, ::-1]
    upright, *others = (
        np.corrcoef(seen, o.ravel())[0, 1] for o in (wanted, wanted[:, ::-1], wanted[::-1], wanted[::-1, ::-1])
    )
    assert upright > 0.9 and max(others) < 0.7
    ours = target.screen.receiver.to(leaving)
    assert ours.alive.numpy()[alive].all()


def test_it_opens_again_and_is_the_same(made, monkeypatch):
    draws_nothing(monkeypatch)
    folder, report, _ = made
    design = bstcad.open(folder)
    assert design.lens.reflects and design.solid().isValid()
    again = design.verify(progress=False, effort=EFFORT)
    assert again.rrmsd == pytest.approx(report["rrmsd"], rel=1e-9)
    assert [i.law for i in design.lens.interfaces] == [bstcad.Reflect()]


def test_what_is_shown_of_it_goes_from_the_lamp_by_the_mirror_to_the_wall(made):
    folder, _, _ = made
    shown = commands.light_path_in(folder)
    source, back, wall = (shown.rays[:, stop, 2] for stop in range(3))
    assert shown.mirror and shown.rays.shape[1] == 3 and source.min() > back.max() and wall.min() > source.max()
    assert len(shown.lamp) == 0


def test_it_is_told_in_the_words_of_a_mirror(made):
    folder, report, scene = made
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "Mirror report" in page and "missed the mirror" in page and "meets the mirror" in page
    assert "total internal reflection" not in page and "missed the lens" not in page and "Glass" not in page
    text = (folder / "prescription.txt").read_text(encoding="utf-8")
    assert "Rear: dark" in text and "refractive index" not in text
    assert "reflect = true" in (folder / "scene.toml").read_text(encoding="utf-8")
    assert "tilt                          35 degrees about y" in text and "35 degrees about y" in page
    assert report["prescription"]["targets"][0]["tilt"] == list(scene.target.tilt) == [0.0, 35.0]
    assert bstcad.load(folder / "scene.toml").target == scene.target
