"""A design for a tilted target plane, end to end: as good as the level one, proved from the written file."""

import json

import numpy as np
import pytest
import torch

import bstcad
from bstcad import commands
from bstcad.verify import step_checks
from tests.conftest import draws_nothing, quick_effort

SMALL = {
    "lens.back.control_points": 33, "target.pixels": 48, "tailoring.quality": "draft", "tailoring.rays": 256,
    "tailoring.transport_grid": 64, "accept.rrmsd": 0.25,
}  # fmt: skip
EFFORT = quick_effort()
CASES = {"thu": {"target.tilt": [30.0, -20.0]}, "mirror": {"target.tilt": [0.0, 35.0]}}
KINDS = [pytest.param("thu", marks=pytest.mark.bench), "mirror"]


@pytest.fixture(scope="module", params=KINDS)
def made(request, tmp_path_factory):
    """(folder, report.json, the scene) of a template whose target is tilted."""
    folder = tmp_path_factory.mktemp(request.param) / "tilted"
    scene = bstcad.load(f"templates/{request.param}.toml").changed(SMALL | CASES[request.param])
    with pytest.MonkeyPatch.context() as patch:
        draws_nothing(patch)
        commands.generate(scene, folder, device="cpu", effort=EFFORT)
    return folder, json.loads((folder / "report.json").read_text()), scene


def test_it_passes_and_is_about_as_good_as_the_level_one(made):
    _, report, scene = made
    assert report["passed"] and report["efficiency"] > 0.97
    level = scene.changed({"target.tilt": None})
    lens, target = bstcad.design(level, progress=False).lens, level.target
    light = bstcad.measure(lens, level.channels(), target.screen, target.irradiance(), EFFORT)
    assert report["rrmsd"] < 1.3 * light.rrmsd


def test_rays_in_space_draw_the_picture(made):
    """The lens as it was read back, its rays carried to the plane by n · (P - C) = 0 here, counted in pixels."""
    folder, report, scene = made
    lens = step_checks.lens(folder / "lens.step", scene.index, scene.lens.passes)
    half_x, half_y = lens.outline.half_extent
    line = (torch.arange(500, dtype=torch.float64) + 0.5) / 250 - 1
    x, y = (p.reshape(-1) for p in torch.meshgrid(half_x * line, half_y * line, indexing="ij"))
    leaving = scene.source.rays(x, y, lens.entrance.z, 1.0)
    for interface in lens.interfaces:
        leaving = bstcad.cross(leaving, interface).rays
    target, (a, b) = scene.target, np.radians(scene.target.tilt)
    middle = np.array([sum(target.x) / 2, sum(target.y) / 2, target.z])
    turn = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]]) @ np.array(
        [[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]]
    )
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
    ours = target.screen.plane.to(leaving)
    assert ours.alive.numpy()[alive].all()


def test_it_is_told(made):
    folder, report, scene = made
    about = {"thu": "30 degrees about x, then -20 degrees about y", "mirror": "35 degrees about y"}[scene.name]
    assert f"tilt                          {about}" in (folder / "prescription.txt").read_text(encoding="utf-8")
    assert report["prescription"]["targets"][0]["tilt"] == list(scene.target.tilt)
    assert about in (folder / "report.html").read_text(encoding="utf-8")
    assert bstcad.load(folder / "scene.toml").target == scene.target


def test_it_opens_again_and_is_the_same(made, monkeypatch):
    draws_nothing(monkeypatch)
    folder, report, _ = made
    again = bstcad.open(folder).verify(progress=False, effort=EFFORT)
    assert again.rrmsd == pytest.approx(report["rrmsd"], rel=1e-9)
