"""Small designs, end to end, with a front that is a conic or the freeform back of an earlier design."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import bstcad
from bstcad.cad import step_reading
from bstcad.designs.folder import read_nominal
from bstcad.manufacture.tolerance import perturbations
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Toroid, sag
from bstcad.scene.scene import load
from tests import suite
from tests.conftest import quick_effort
from tests.efforts import LITTLE
from tests.scenes import designed


def made(scene, folder):
    return SimpleNamespace(scene=scene, folder=folder, report=designed(scene, quick_effort(), folder, tailoring=LITTLE))


@pytest.fixture(scope="module")
def behind_another(small_scene, small_design, tmp_path_factory):
    """The small lens again, its front the back of the first one, by a scene that names that design's folder."""
    front = {"kind": "bspline", "z": 15.0, "file": str(small_design.folder)}
    return made(small_scene.changed({"lens.front": front}), tmp_path_factory.mktemp("fronts") / "freeform")


@pytest.fixture(scope="module")
def toroid(small_scene, tmp_path_factory):
    """The small lens with a toroid front, convex along x and concave along y."""
    front = {"kind": "toroid", "z": 15.0, "curvature_x": 0.006, "curvature_y": -0.004}
    return made(small_scene.changed({"lens.front": front}), tmp_path_factory.mktemp("fronts") / "toroid")


@pytest.fixture(scope="module")
def conic(small_scene, tmp_path_factory):
    """The small lens with a conic of which both numbers are to be found."""
    front = {"kind": "conic", "z": 15.0, "curvature": 0.002, "conic_constant": -0.5, "optimise": True}
    return made(small_scene.changed({"lens.front": front}), tmp_path_factory.mktemp("fronts") / "conic")


DOME = {  # all light of the cone enters a dome about the source, which is narrower than the lens
    "source.position": [0.0, 0.0, 0.0],
    "source.half_angle": 40.0,
    "lens.outline": {"shape": "circle", "diameter": 32.0},
    "lens.front": {"kind": "sphere", "z": 12.0, "curvature": -1 / 12, "outline": {"shape": "circle", "diameter": 17.0}},
    "lens.back.z": 18.0,
    "target.x": [-450.0, 450.0],
    "target.y": [-450.0, 450.0],
    "target.pixels": 32,
    "target.outline": {"shape": "circle", "radius": 390.0},
    "output.mesh_tolerance": 0.01,
}


@pytest.fixture(scope="module")
def dome(small_scene, tmp_path_factory):
    """The small lens with a dome over the source, narrower than the lens."""
    return made(small_scene.changed(DOME), tmp_path_factory.mktemp("fronts") / "dome")


@suite.in_turn(0, 4)
def test_all_light_goes_through_the_dome_and_lands(dome):
    flux = dome.report["flux"]
    assert flux["on target"] > 0.99 and flux["vignetted by the underside"] < 1e-6
    assert sum(flux.values()) == pytest.approx(1, abs=1e-9)
    assert dome.report["prescription"]["front"]["outline"] == {"radius": 8.5, "shape": "circle"}
    level = dome.report["prescription"]["front"]["around"]
    assert level == pytest.approx((12**2 - 8.5**2) ** 0.5, abs=1e-12)
    text = (dome.folder / "prescription.txt").read_text()
    assert "outline of the face" in text and f"z = {level!r} mm" in text


@suite.in_turn(0, 4)
def test_the_dome_is_in_the_scene_and_in_the_step_file_of_its_design(dome):
    nominal = read_nominal(dome.folder)
    scene = nominal.scene
    assert scene == dome.scene and nominal.lens.front == dome.scene.lens.front.surface
    assert step_reading.read(dome.folder / "lens.step").front.outline == Circle(8.5)
    again = bstcad.open(dome.folder)
    assert again.solid().isValid()


@suite.in_turn(0, 4)
def test_tolerances_of_a_domed_lens_move_its_dome(dome):
    """A form error is a net in the dome's place, which keeps the outline; a larger lens has a larger outline."""
    nominal = read_nominal(dome.folder)
    setup = perturbations.Setup(nominal.lens, nominal.channels, nominal.goals[0].screen)
    rough = perturbations.form_error(nominal.lens, 4.0, 0, "front").apply(setup, 0.0).lens
    assert rough.front.is_net and rough.apertures == nominal.lens.apertures
    x = torch.linspace(-8, 8, 101, dtype=torch.float64)
    off = rough.front.sag_and_slope(x, 0 * x)[0] - nominal.lens.front.sag_and_slope(x, 0 * x)[0]
    assert float(off.abs().max()) < 1e-5
    larger = setup.with_lens_scaled(1.01).lens
    assert larger.front.outline == Circle(8.5 * 1.01) == larger.apertures[0]
    assert larger.front.curvature == pytest.approx(-1 / 12 / 1.01)


@pytest.mark.parametrize("name", suite.in_turns(["dome", "behind_another", "conic", "toroid"], 4))
def test_the_design_passes_its_checks(name, request):
    report = request.getfixturevalue(name).report
    assert [check["name"] for check in report["checks"] if not check["passed"]] == []
    assert report["rrmsd"] < 0.1


@suite.in_turn(1, 4)
def test_the_given_front_is_in_every_file(behind_another, small_design):
    earlier = np.load(small_design.folder / "design.npz")["control_points"]
    found = np.load(behind_another.folder / "design.npz")["front_control_points"]
    assert np.abs(found[..., :2] - earlier[..., :2]).max() < 1e-12
    assert np.ptp(found[..., 2] - earlier[..., 2]) < 1e-12  # moved along z as a whole
    step = step_reading.read(behind_another.folder / "lens.step")
    assert np.abs(step.front.control_points() - found).max() < 1e-11
    assert abs(sag(step.front, 0.0, 0.0) - 15.0) < 1e-12
    written = json.loads((behind_another.folder / "report.json").read_text())["prescription"]["front"]
    assert written["kind"] == "bspline" and written["vertex"] == [0.0, 0.0, 15.0]
    assert written["curvature"] is None and written["radius"] is None
    assert "freeform" in (behind_another.folder / "prescription.txt").read_text()


@suite.in_turn(1, 4)
def test_it_reads_back_to_the_last_bit_without_the_earlier_design(behind_another):
    """The folder has a copy of the net."""
    nominal = read_nominal(behind_another.folder)
    scene = nominal.scene
    assert scene == behind_another.scene and scene.lens.front.file.shape == (33, 33)
    assert torch.equal(nominal.lens.front.heights, behind_another.scene.lens.front.surface.heights)
    again = bstcad.open(behind_another.folder)
    assert again.lens.front.z == 15.0 and again.solid().isValid()


@suite.in_turn(2, 4)
def test_both_numbers_of_the_conic_are_found(conic):
    """The scene of the design has them and nothing left to search for, and so has the STEP file."""
    front = load(conic.folder / "scene.toml").lens.front
    assert front.free == () and front.optimise is False
    assert (front.curvature, front.conic_constant) != (0.002, -0.5)
    step = step_reading.read(conic.folder / "lens.step")
    rim = np.hypot(4.0, 3.0)
    assert sag(step.front, rim, 0.0) == pytest.approx(float(sag(front.surface, rim, 0.0)), abs=1e-12)
    nominal = read_nominal(conic.folder)
    assert nominal.lens.front == front.surface
    written = json.loads((conic.folder / "report.json").read_text())["prescription"]["front"]
    assert written["kind"] == "conic" and written["conic_constant"] == front.conic_constant
    assert repr(front.conic_constant) in (conic.folder / "prescription.txt").read_text()


@suite.in_turn(3, 4)
def test_the_step_file_of_a_toroid_lies_within_a_nanometre_of_it(toroid):
    step = step_reading.read(toroid.folder / "lens.step")
    x, y = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 1000)) * [[4.0], [3.0]]
    assert np.abs(sag(step.front, x, y) - sag(Toroid(15.0, 0.006, -0.004), x, y)).max() < 1e-6
    assert sag(step.front, 0.0, 0.0) == pytest.approx(15.0, abs=1e-12)


@suite.in_turn(3, 4)
def test_a_toroid_is_read_again_to_the_last_bit_and_its_sheets_have_both_radii(toroid):
    nominal = read_nominal(toroid.folder)
    scene = nominal.scene
    assert scene == toroid.scene and nominal.lens.front.is_net
    assert np.array_equal(
        nominal.lens.front.control_points(), np.load(toroid.folder / "design.npz")["front_control_points"]
    )
    assert bstcad.open(toroid.folder).lens.front.z == 15.0
    front = json.loads((toroid.folder / "report.json").read_text())["prescription"]["front"]
    assert front["kind"] == "toroid" and front["vertex"] == [0.0, 0.0, 15.0]
    assert (front["radius_x"], front["radius_y"]) == (1 / 0.006, 1 / -0.004) and front["radius"] is None
    text = (toroid.folder / "prescription.txt").read_text()
    for words in ("radius in x", repr(1 / 0.006), "radius in y", "-250 mm", "curvature in y", "within 10⁻⁶ mm"):
        assert words in text
