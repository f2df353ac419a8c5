"""Proof, folder and report of a lens with two tailored faces for two targets; one written design serves all tests."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import bstcad
from bstcad import commands
from bstcad.analysis.shape import describe, survey
from bstcad.commands import ProofOptions
from bstcad.designs import folder as folders
from bstcad.report import report
from bstcad.step_text import part21
from bstcad.verify import checks, step_checks, text_checks
from bstcad.verify.nominal import Nominal
from tests.conftest import flat_pictures, quick_effort
from tests.two_faces import CHANGES, bent, made_of, scene_of

MOUNT = {
    "datum": "front", "rim": {"shape": "circle", "diameter": 7.6},
    "flange": {"z": 9.5, "thickness": 2.0, "outline": {"shape": "circle", "diameter": 14.0}},
}  # fmt: skip


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """The lens of both faces in a folder, with its report."""
    made, folder = made_of(scene_of()), tmp_path_factory.mktemp("two") / "faces"
    with pytest.MonkeyPatch.context() as patch:
        kept = []
        verify = checks.verify
        patch.setattr(checks, "verify", lambda *given, **more: kept.append(verify(*given, **more)) or kept[-1])
        found = commands.write(made, folder, ProofOptions(quick_effort(), flat_pictures()))
    return SimpleNamespace(made=made, folder=folder, report=found, proof=kept[0], facts=found.facts)


def named(found, *parts):
    """The checks whose names hold all of these parts."""
    return [check for check in found if all(part in check.name for part in parts)]


# ---- the light on each target ----------------------------------------------------------------------------------------

OF_EACH = ("rrmsd", "noise", "tubes", "light-on-target", "efficiency", "ledger", "target")


def test_each_target_has_its_checks(two):
    assert two.report.passed and [check for check in two.report.checks if not check.passed] == []
    for id in OF_EACH:
        first, second = (check for check in two.report.checks if check.id == id)
        assert ", target[0]" in first.name and ", target[1]" in second.name


def test_each_light_is_that_of_its_own_screen(two):
    """Traced one by one, as if there were no other; the second target is wider, further away and of other pixels."""
    light, other = two.proof.lights
    assert two.proof.light is max(light, other, key=lambda each: each.rrmsd) and two.proof.wavefront is None
    nominal = folders.read_nominal(two.folder)
    effort = replace(nominal.effort(quick_effort()), seed=nominal.scene.tailoring.seed + checks.VERIFY_SEED)
    for goal, found in zip(nominal.goals, two.proof.lights, strict=True):
        alone = bstcad.measure(two.proof.lens, nominal.channels, goal.screen, goal.picture, effort=effort)
        assert np.array_equal(alone.picture, found.picture) and alone.rrmsd == found.rrmsd
    assert light.picture.shape == (16, 16) and other.picture.shape == (18, 24) and light.rrmsd != other.rrmsd


def test_accept_holds_for_each_target(two):
    """A limit between the two figures fails the worse one alone."""
    low, high = sorted(light.rrmsd for light in two.proof.lights)
    nominal = folders.read_nominal(two.folder)
    between = replace(nominal, scene=nominal.scene.changed({"accept.rrmsd": (low + high) / 2}))
    proof = checks.verify(two.folder, between, effort=quick_effort())
    assert not proof.passed
    [failed] = [check for check in proof.checks if not check.passed]
    assert failed.id == "rrmsd" and failed.name.endswith(", target[1]")


def test_a_target_without_light_is_named(two):
    nominal = folders.read_nominal(two.folder)
    first, second = nominal.goals
    dark = replace(second, screen=replace(second.screen, x=(500.0, 510.0)))
    with pytest.raises(ValueError, match=r"none of its light falls on target\[1\]"):
        checks.verify(two.folder, replace(nominal, goals=(first, dark)), effort=quick_effort())


# ---- both faces ------------------------------------------------------------------------------------------------------


def changed(net, by=1e-6):
    heights = net.heights.clone()
    heights[heights.shape[0] // 2, heights.shape[1] // 2] += by
    return replace(net, heights=heights)


@pytest.mark.parametrize("face", ["front", "back"])
def test_a_face_that_is_off_by_a_nanometre_in_one_control_point_is_found(two, face):
    """Both readers find it by the net, and OCC by the surface, too."""
    lens, path = two.made.lens, two.folder / "lens.step"
    other = lens.with_surface(face, changed(getattr(lens, face)))
    [failed] = [c for c in text_checks.lens_checks(part21.read_lens(path), other) if not c.passed]
    assert failed.id == "control-points" and failed.name.endswith("of the front") == (face == "front")
    by_id = {c.id: c.name for c in step_checks.check(path, other, 1e-8, 4096) if not c.passed}
    assert face in by_id["form"] and ("front-net" in by_id) == (face == "front")


def test_a_file_whose_front_is_flat_is_no_lens_of_two_nets(two, tmp_path):
    """The net is missing for either reader, and the rest of the proof goes on."""
    lens = replace(two.made.lens, tailored=None).with_front(bstcad.Plane(8.0))
    folders.write_geometry(replace(two.made, lens=lens), tmp_path)()
    text = part21.read_lens(tmp_path / "lens.step")
    [failed] = [check for check in text_checks.lens_checks(text, two.made.lens) if not check.passed]
    assert failed.id == "control-points" and failed.name.endswith("of the front")
    nominal = Nominal(two.made.scene, two.made.lens, two.made.goals)
    proof = checks.verify(tmp_path, nominal, effort=quick_effort())
    failed = {check.id: check.name for check in proof.checks if not check.passed}
    assert "front" in failed["form"] and proof.lens.tailored is None


def test_figures_of_the_front_are_those_of_the_same_face_as_a_back(two):
    """Turned over: a ridge towards +z is a valley for whoever cuts the front from outside."""
    lens, shape = two.made.lens, two.facts["shape"]
    as_back = describe(replace(lens, tailored=None).with_back(lens.front).with_front(lens.back.moved(-30.0)), 129)
    for key in ("sag_pv", "slope_max_deg", "departure_best_sphere", "slope_energy_top_octave"):
        assert shape[f"front_{key}"] == pytest.approx(as_back[key], rel=1e-9)
    assert shape["front_radius_min_concave"] == pytest.approx(as_back["radius_min_convex"], rel=1e-9)
    assert shape["front_radius_min_convex"] == pytest.approx(as_back["radius_min_concave"], rel=1e-9)
    found = survey(lens, "front")
    assert found.concave.largest == survey(lens.with_back(lens.front)).convex.largest


def test_bounds_hold_for_both_faces(two):
    """The front has the smaller radius of valleys and the back the steeper slope, by limits between theirs."""
    lens, shape = two.made.lens, two.facts["shape"]
    lens = lens.with_front(bent(lens.front, 0.2)).with_back(bent(lens.back, -0.02))
    shape = describe(lens) | {"volume": 1.0}
    radius = (shape["front_radius_min_concave"] * shape["radius_min_concave"]) ** 0.5
    slope = (shape["front_slope_max_deg"] * shape["slope_max_deg"]) ** 0.5
    asked = two.made.scene.lens.model_copy(update={"tool_radius": radius, "max_slope": slope})
    found, at_bounds = checks.bound_checks(lens, asked, shape)
    failed = {check.id: check.name for check in found if not check.passed}
    assert failed.keys() == {"tool-radius", "slope"} and all("of the front" in name for name in failed.values())
    assert at_bounds.keys() == {"tool_radius", "max_slope"} and all(0 < at.share < 1 for at in at_bounds.values())
    assert [at.tightest.endswith("of the front") for at in at_bounds.values()] == [True, True]
    alone, _ = checks.bound_checks(replace(lens, tailored=None), asked, shape)
    assert all(check.passed for check in alone)


def test_a_mounted_lens_has_both_nets_in_its_part(tmp_path):
    """Heights of the front are counted from another plane than the frame of its vertex."""
    made = made_of(scene_of(mount=MOUNT))
    vertex = made.lens.front_vertex
    assert vertex == pytest.approx(8.06, abs=0.01) and made.lens.front.z == 8.0
    folders.write_geometry(made, tmp_path)()
    found = step_checks.check_part(tmp_path, made.lens, made.scene.mount, made.scene.part.of(made.scene.lens))
    assert [check.name for check in found if not check.passed] == []
    assert named(found, "part.step: deviation of the control points of the front")
    text = part21.read_lens(tmp_path / "part.step")
    down = made.lens.front.control_points() - [0.0, 0.0, vertex]
    assert np.abs(text.front.control_points - down).max() < 1e-11
    lens = step_checks.lens_of_part(tmp_path, made.lens, made.scene.mount)
    assert np.abs(lens.front.control_points() - made.lens.front.control_points()).max() < 1e-11


def test_the_margin_to_total_reflection_is_of_light_in_the_glass(two):
    """Nets that are free move no ray: the figure is that of the same faces with a fixed front."""
    nominal = folders.read_nominal(two.folder)
    free, fixed = (
        checks.margins(nominal.channels, replace(nominal.lens, tailored=shaped), nominal.goals[0].screen, 0, n=64)
        for shaped in ((0, 1), None)
    )
    assert free.tir_margin_deg == pytest.approx(fixed.tir_margin_deg, abs=1e-9)
    assert free.newton_slope_min == pytest.approx(fixed.newton_slope_min, abs=1e-12)


# ---- the folder ------------------------------------------------------------------------------------------------------


def test_the_design_holds_every_target_and_reads_back(two):
    with np.load(two.folder / "design.npz") as design:
        found = {name: design[name] for name in design.files}
    assert {"target", "target_2", "irradiance", "irradiance_2", "front_knots_x"} <= found.keys()
    assert "target_1" not in found and "target_3" not in found
    assert found["target_2"].shape == found["irradiance_2"].shape == (18, 24)
    assert len(found["front_knots_x"]) == 33 + 3
    opened = bstcad.open(two.folder)
    assert opened.report.facts == json.loads((two.folder / "report.json").read_text())
    assert np.array_equal(opened.report.irradiance, two.proof.light.picture)
    for irradiance, light in zip(opened.report.irradiances, two.proof.lights, strict=True):
        assert np.array_equal(irradiance, light.picture)
    for face in ("front", "back"):
        net, designed = (getattr(lens, face).control_points() for lens in (opened.lens, two.made.lens))
        assert np.array_equal(net, designed)
    nominal = folders.read_nominal(two.folder)
    scene = nominal.scene
    assert scene == two.made.scene and [goal.weight for goal in nominal.goals] == [1.0, 2.5]
    assert [goal.key for goal in nominal.goals] == ["target[0]", "target[1]"]


def test_what_light_cannot_reach_of_a_further_target_is_kept(two, tmp_path):
    part = np.ones((18, 24), dtype=bool)
    part[:, :4] = False
    first, second = two.made.goals
    made = replace(two.made, goals=(first, second.restricted(part)))
    folders._write_scene(made, tmp_path)
    folders.write_design(made, (), tmp_path)
    nominal = folders.read_nominal(tmp_path)
    first, goal = nominal.goals
    assert np.array_equal(goal.reachable, part) and not goal.picture[:, :4].any() and goal.whole[:, :4].all()
    assert first.reachable is None and goal.picture.sum() == pytest.approx(goal.whole.sum())
    assert np.array_equal(commands.read(tmp_path).goals[1].reachable, part)


def test_a_damaged_further_target_is_a_sentence(two, tmp_path):
    with np.load(two.folder / "design.npz") as design:
        found = {name: design[name] for name in design.files}
    folders._write_scene(two.made, tmp_path)
    np.savez_compressed(tmp_path / "design.npz", **(found | {"target_2": 0 * found["target_2"]}))
    with pytest.raises(bstcad.SceneError, match=r"the picture of target\[1\] is all black"):
        folders.read_nominal(tmp_path)


# ---- the report ------------------------------------------------------------------------------------------------------


def test_report_json_tells_each_target(two):
    told = json.loads((two.folder / "report.json").read_text())
    first, second = told["goals"]
    assert first["key"] == "target[0]" and second["key"] == "target[1]" and second["where"] == "z = 150 mm"
    assert [each["weight"] for each in told["goals"]] == [1.0, 2.5]
    worst = max(first, second, key=lambda goal: goal["rrmsd"])
    assert worst["rrmsd"] == told["rrmsd"] and worst["rrmsd_standard_error"] == told["rrmsd_noise"]
    assert first["leak"] and second["leak"] is None and told["leak"] == worst["leak"]  # it is lit all over
    assert second["efficiency"] == pytest.approx(two.proof.lights[1].efficiency, rel=1e-11)
    assert [target["z"] for target in told["prescription"]["targets"]] == [60.0, 150.0]


def test_the_page_and_the_terminal_show_each_target(two):
    page = (two.folder / "report.html").read_text(encoding="utf-8")
    assert page.count("Target, simulated irradiance and their signed difference") == 2
    for each in two.report.goals:
        assert f"<strong>{each.key}</strong>" in page
    assert "Maps of the front surface" in page and "Steepest slope of the front" in page
    rows = {name: value for name, value, _ in report.first_figures(two.report.contents)}
    assert "RRMSD against target[0]" in rows and "RRMSD against target[1]" in rows
    assert repr(two.report).count("RRMSD 0.") == 1 and ", 0." in repr(two.report).splitlines()[0]


def test_prescription_and_data_sheet_have_both_nets(two):
    text = (two.folder / "prescription.txt").read_text()
    assert "33 x 33" in text and "65 x 65" in text and "Both freeform faces are exact in lens.step" in text
    assert "target[0]" in text and "target[1]" in text and "z of the scene (lens.front.z) 8 mm" in text
    sheet = commands._sheet_again(two.made, two.folder)
    front, body, back, purpose = list(sheet.tables.values())[:4]
    assert [name for name, _ in front] == [name for name, _ in back]
    assert dict(front)["Form"] == "B-spline of degree 2, 33 × 33"
    assert "RRMSD" in dict(purpose)["target[1]"] and body
    order = commands._order(two.made, two.facts["shape"], two.folder)
    assert order.freeform == ("back", "front") and "8.06 mm before the vertex of the front" in order.datum
    radii = two.facts["shape"]["radius_min_concave"], two.facts["shape"]["front_radius_min_concave"]
    assert order.tool_radius == pytest.approx(min(radii), rel=1e-9)


# ---- a lens of one's own ---------------------------------------------------------------------------------------------


def test_with_lens_keeps_a_front_that_is_tailored(two):
    design = bstcad.Design(two.made)
    net = design.scene.flat_lens((65, 65)).front
    other = design.with_lens(two.made.lens.with_front(bent(net, 0.1)))
    assert other.scene.lens.front.is_tailored and other.lens.tailored == (0, 1)
    finer = design.scene.changed({"lens.front.control_points": 65}).flat_lens((65, 65)).front
    again = design.with_lens(two.made.lens.with_front(bent(finer, 0.1)))
    assert again.lens.front.shape == (65, 65) and again.scene.lens.nets() == (65, 65)
    narrow = replace(two.made.lens.front, x=(-1.0, 1.0))
    with pytest.raises(bstcad.SceneError, match="extent of the front's net along x"):
        design.with_lens(two.made.lens.with_front(narrow))
    assert CHANGES["lens.front"]["control_points"] == 33
