"""Remarks on the lens of an LED: the light that arrives first, then each wish of the scene that was not reached.

A Lambertian source 9.4 mm before a round lens of 20 mm, and 800 x 500 mm of a wall off its axis: half of the light
misses the lens, and no back nearer than 10 mm to the front can bend the rest so far.
"""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from bstcad import commands
from bstcad.optics.trace.measure import Effort
from bstcad.report import report as reports
from bstcad.report.record import of_json
from bstcad.scene.scene import load
from tests import suite
from tests.conftest import draws_nothing, verify_with
from tests.efforts import LITTLE

FEW = Effort(256, places=65, points=1024, tubes=97)
TEMPLATES = Path(__file__).parent.parent.parent / "templates"
LED = {
    "name": "led",
    "source.wavelength": 550.0,
    "lens.outline": {"shape": "circle", "radius": 10.0},
    "lens.front.z": 9.4,
    "lens.back.z": 15.4,
    "target.z": 1000.0,
    "target.x": [-200.0, 600.0],
    "target.y": [-100.0, 400.0],
    "target.outline": None,
    "accept.rrmsd": None,
    "lens.back.control_points": 33,
    "target.pixels": 32,
    "tailoring.quality": "draft",
    "tailoring.accuracy": 0.001,
    "tailoring.rays": 192,
    "tailoring.transport_grid": 64,
    "tailoring.stage2_iterations": 10,
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """(folder, report) of a lens 6 mm thick and exact to a thousandth, if it were up to the scene; few tubes and rays.

    So verifies `commands.verify` after it.
    """
    folder = tmp_path_factory.mktemp("led") / "led"
    with pytest.MonkeyPatch.context() as patch:
        draws_nothing(patch)
        verify_with(patch, FEW)
        options = commands.ProofOptions(FEW, tailoring=LITTLE)
        scene = load(TEMPLATES / "disk.toml").changed(LED)
        yield folder, commands.generate(scene, folder, options, device="cpu").facts


def printed(report):
    console = Console(file=io.StringIO(), width=300)
    console.print(reports.summary(of_json(json.dumps(report))))
    return console.file.getvalue()


@suite.in_turn(2, 3)
def test_the_part_of_its_light_that_arrives_is_said_first(made):
    """sin² of the angle to the rim enters, 53 %; a third of that leaves through the sides."""
    folder, report = made
    assert report["flux"]["missed the lens"] == pytest.approx(1 - 10**2 / (10**2 + 9.4**2), abs=1e-3)
    assert report["light_on_target"] == report["flux"]["on target"] == pytest.approx(0.34, abs=0.03)
    assert report["efficiency"] > 0.9  # which alone would mislead
    rrmsd, _, light, *others = reports.first_figures(of_json(json.dumps(report)))
    assert rrmsd[0].startswith("RRMSD") and light[0] == "Light on the target"
    assert all("fficiency" not in name for name, _, _ in others)
    assert "missed the lens 46.9 %, lost through the sides 1" in light[2]
    for text in (printed(report), (folder / "report.html").read_text(encoding="utf-8")):
        assert "Light on the target" in text
        assert "PASSED WITH REMARKS" in text
        assert "(accept.rrmsd), so the verdict does not judge it." in text


@suite.in_turn(2, 3)
def test_what_the_scene_asked_for_and_did_not_get_comes_first(made):
    folder, report = made
    moved, missed, *others = report["given_up"]
    assert report["remarks"][:3] == ["back-moved", "accuracy", "misses"]
    assert "instead of 6 mm" in moved and "0.001" in missed and others[0].startswith("46.9 %")
    assert report["verdict"] == "passed with remarks" and report["passed"] is True


@suite.in_turn(2, 3)
def test_the_folder_says_where_the_back_stands(made):
    folder, report = made
    written = report["prescription"]
    z = written["back"]["vertex"][2]
    assert written["back_asked"] == 15.4 and z == pytest.approx(9.4 + report["shape"]["centre_thickness"], abs=1e-9)
    assert f"z = {z!r} mm" in (folder / "scene.toml").read_text(encoding="utf-8").splitlines()[0]
    assert load(folder / "scene.toml").lens.back.z == 15.4  # from which it goes where it went
    again = commands.verify(folder).facts
    assert (again["verdict"], again["given_up"]) == (report["verdict"], report["given_up"])
