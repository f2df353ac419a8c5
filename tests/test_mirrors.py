"""A mirror from its scene to its files: the picture, which way round it is, the solid, and the words."""

import json

import numpy as np
import pytest
from PIL import Image

import bstcad
from bstcad import commands
from bstcad.verify import step_checks
from tests.conftest import draws_nothing, quick_effort
from tests.test_seen import letter

SMALL = {
    "lens.back.control_points": 33, "target.pixels": 48, "target.sample": None, "tailoring.quality": "draft",
    "tailoring.rays": 256, "tailoring.transport_grid": 64, "accept.rrmsd": 0.25,
}  # fmt: skip
LAMPS = {
    "point": {},  # as in test_tilted
    "parallel": {"source": {"kind": "collimated", "aperture": {"shape": "circle", "radius": 27.0}, "z": 100.0}},
}
EFFORT = quick_effort()


@pytest.fixture(scope="module", params=[pytest.param("point", marks=pytest.mark.bench), "parallel"])
def made(request, tmp_path_factory):
    """(folder, report.json, the scene) of a mirror that throws an F on the wall."""
    place = tmp_path_factory.mktemp(request.param)
    Image.fromarray(letter()).save(place / "F.png")
    scene = bstcad.load("templates/mirror.toml").changed(
        SMALL | LAMPS[request.param] | {"target.image": str(place / "F.png"), "target.gamma": 1.0}
    )
    with pytest.MonkeyPatch.context() as patch:
        draws_nothing(patch)
        commands.generate(scene, place / "out", device="cpu", effort=EFFORT)
    return place / "out", json.loads((place / "out" / "report.json").read_text()), scene


def test_every_check_passes(made):
    _, report, _ = made
    assert report["passed"] and report["optic"] == "mirror"
    assert report["flux"]["on target"] > 0.95 and report["efficiency"] > 0.98
    assert report["flux"]["total internal reflection"] == report["flux"]["lost through the sides"] == 0.0


def test_the_wall_shows_the_letter_as_it_is_to_whom_looks_along_z(made):
    """x grows to the left there; a letter that is turned or mirrored correlates less."""
    folder, _, scene = made
    lens = step_checks.lens(folder / "lens.step", scene.index, scene.lens.passes)
    light = bstcad.measure(lens, scene.channels(), scene.target.screen, scene.target.irradiance(), EFFORT)
    seen = light.picture[:, ::-1]
    wanted = scene.target.irradiance()[:, ::-1]
    upright = np.corrcoef(seen.ravel(), wanted.ravel())[0, 1]
    others = [np.corrcoef(seen.ravel(), o.ravel())[0, 1] for o in (wanted[:, ::-1], wanted[::-1], wanted[::-1, ::-1])]
    assert upright > 0.9 and max(others) < 0.7


def test_it_opens_again_and_is_the_same(made, monkeypatch):
    draws_nothing(monkeypatch)
    folder, report, _ = made
    design = bstcad.open(folder)
    assert design.lens.reflects and design.solid().isValid()
    again = design.verify(progress=False, effort=EFFORT)
    assert again.rrmsd == pytest.approx(report["rrmsd"], rel=1e-9)
    assert [i.law for i in design.lens.interfaces] == [bstcad.Reflect()]


def test_what_is_shown_of_it_goes_from_the_lamp_by_the_mirror_to_the_wall(made):
    folder, _, scene = made
    shown = commands.light_path_in(folder)
    source, back, wall = (shown.rays[:, stop, 2] for stop in range(3))
    assert shown.mirror and shown.rays.shape[1] == 3 and source.min() > back.max() and wall.min() > source.max()
    assert len(shown.lamp) == (scene.source.kind == "point")


def test_it_is_told_in_the_words_of_a_mirror(made):
    folder, _, _ = made
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "Mirror report" in page and "missed the mirror" in page and "meets the mirror" in page
    assert "total internal reflection" not in page and "missed the lens" not in page and "Glass" not in page
    text = (folder / "prescription.txt").read_text(encoding="utf-8")
    assert "Rear: dark" in text and "refractive index" not in text
    assert "reflect = true" in (folder / "scene.toml").read_text(encoding="utf-8")
