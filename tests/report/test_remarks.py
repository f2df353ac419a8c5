"""Remarks state with their figures the wishes that were given up, and nothing else."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from bstcad.analysis.light import Blur, FinestDetail
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.report.goal_figures import CellFigures
from bstcad.report.record import LeftOut, remarks
from bstcad.report.report import doubts
from bstcad.report.units import remarks as written
from bstcad.scene.scene import load
from bstcad.verify.verdict import Check
from tests.report.test_report import CONTENTS
from tests.scenes import DOME

FACTS = {
    "rrmsd": 0.03, "rrmsd_noise": 0.001, "efficiency": 1.0,
    "flux": {
        "on target": 0.8, "off target": 0.0, "missed the lens": 0.2, "lost through the sides": 0.0,
        "total internal reflection": 0.0,
    },
    "shape": {"centre_thickness": 5.0, "thickness_min": 2.5, "sag_pv": 3.0, "slope_max_deg": 30.0},
    "stability": {"tir_margin_deg": 12.0}, "stopped": "evaluations", "skipped_steps": 0, "seconds_total": 0.0,
    "checks": (),
}  # fmt: skip
TIMED, FINE = {"tailoring.max_time": 20.0}, {"output.mesh_tolerance": 0.001}
COARSE = {"checks": (Check("", 1.75e-3, None, "mm", True, id="mesh-chord"),)}
DETAIL = FinestDetail(
    width=46.3, source_image=46.26, pixel=0.39, distance=5000.0, nearer_distance=250.0, nearer_width=2.36,
    of="source.divergence = 0.53 degrees", assumed=False,
)  # fmt: skip
BLURRED = {"finest_detail": DETAIL, "blur": Blur(46.26, 118.4, 0.54), "rrmsd_asked": 0.1}


def left_out(kind, change, detail="", by="", assumed=False):
    return LeftOut(kind, 0.0, change, 1.0, detail=detail, simulate_by=by, assumed=assumed)


def effects(*entries, **more):
    return {"estimates": entries} | more


ASSUMED = left_out("source size", 0.06, "a cone of 0.1 degrees", "source.divergence", assumed=True)
SAID = [  # changes of the facts, of the scene; the remarks in their order, and what each has to say
    ({}, {}, {}),
    ({"rrmsd": 0.234}, {}, {"rrmsd": ["0.234", "0.1"]}),
    ({"flux.total internal reflection": 0.032}, {}, {"total-reflection": ["3.2 %"]}),
    ({"flux.lost through the sides": 0.16}, {}, {"sides": ["16.0 %"]}),
    ({"flux.lost through the sides": 0.0004, "efficiency": 0.9995, "flux.missed the lens": 0.25}, {}, {}),
    ({"flux.missed the lens": 0.47}, {}, {"misses": ["47.0 %"]}),
    ({"flux.vignetted by the underside": 0.05}, {}, {"underside": ["5.0 %"]}),
    ({"efficiency": 0.97}, {}, {"outside": ["3.0 %", "the target"]}),
    ({"stability.tir_margin_deg": 1.25}, {}, {"near-total-reflection": ["1.25°"]}),
    ({"stability.tir_margin_deg": -0.5}, {}, {"beyond-critical-angle": [" 0.5°"]}),
    ({"shape.centre_thickness": 6.25, "shape.thickness_min": 0.6}, {}, {
        "back-moved": ["6.25 mm", "5 mm", "by 1.25 mm along +z", "0.6 mm"]}),
    ({"shape.centre_thickness": 4.8}, {}, {"vertex-moved": ["4.8 mm", "5 mm", "−0.2 mm along z"]}),
    ({"shape.centre_thickness": 5.04}, {}, {}),
    ({"shape.thickness_min": 0.25}, {}, {"too-thin": ["0.25 mm", "0.5 mm"]}),
    ({"shape.slope_max_deg": 75.0}, {}, {"steep": ["back", "75°"]}),
    ({"shape.front_slope_max_deg": 75.0}, {}, {"steep": ["front", "75°"]}),
    ({"transport": {"steep_share": 0.125, "steepest_deg": 97.4}}, {}, {"too-steep": ["12.5 %", "97°", "overhangs"]}),
    ({"transport": {"steep_share": 0.02, "steepest_deg": 74.0}}, {}, {"too-steep": ["2.0 %", "74°: "]}),
    ({"stopped": "time"}, {}, {"time-up": []}),
    ({"stopped": "interrupt"}, {}, {"interrupted": ["--resume"]}),
    ({"skipped_steps": 3}, {}, {"skipped-steps": [" 3."]}),
    ({"seconds_total": 26.8}, TIMED, {"time-limit": ["20.0 s", "6.8 s"]}),
    ({"seconds_total": 19.9}, TIMED, {}),
    (COARSE, {}, {"facets": ["1.75 µm", "1 µm"]}),
    (COARSE, FINE, {}),  # a check says it
    ({"checks": (Check("", 0.3, None, "", True, id="mount-cut"),)}, {}, {"mount-cut": ["30.0 %"]}),
    ({}, {"tailoring.accuracy": 0.02}, {"accuracy": ["0.02", "0.03"]}),
    ({"rrmsd": 0.0201}, {"tailoring.accuracy": 0.02}, {}),  # by other tubes than tailoring ended with
    ({"unreachable": {"area": 0.321, "light": 0.306, "angle": 47.98}, "rrmsd_whole": 0.682}, {}, {
        "unreachable": ["32.1 %", "30.6 %", "48 degrees", "0.682"]}),
    ({"unreachable": {"area": 0.02, "light": 0.01, "angle": None}, "rrmsd_whole": 0.1}, {}, {
        "unreachable": ["2.0 %", "70 degrees", "0.1."]}),
    # 0.03 is stated and 0.1 allowed: an effect of 0.031 makes √(0.03² + 0.031²) of it
    (effects(left_out("fresnel", 0.031, by='[[effects]] kind = "fresnel"'), left_out("absorption", 0.029)), {}, {
        "left-out": ["Fresnel reflection", "0.031", " 0.03.", '[[effects]] kind = "fresnel"']}),
    (effects(left_out("fresnel", 0.11), rrmsd=0.2, rrmsd_asked=0.1), {}, {
        "rrmsd": ["0.2"], "left-out": ["0.11", " 0.1."]}),
    (effects(left_out("fresnel", 0.09), rrmsd=0.2, rrmsd_asked=0.1), {}, {"rrmsd": ["0.2"]}),
    (effects(ASSUMED), {}, {"source-size": [
        "a cone of 0.1 degrees, assumed, since the scene does not state it", "0.06", " 0.03.", "source.divergence in",
        "source.real_divergence"]}),
    (effects(replace(ASSUMED, rrmsd_change=0.006, assumed=False)), {}, {}),
    (BLURRED | {"rrmsd": 0.5}, {}, {"rrmsd": ["0.5"], "source-too-large": [
        "46 mm", "source.divergence = 0.53 degrees", "0.54", "0.1", "250 mm", "5\u202f000 mm", "2.4 mm"]}),
    (BLURRED, {}, {}),  # tailoring made up for it
]  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    """Front at 15 mm, back at 20, RRMSD 0.1 and 0.5 mm of glass asked."""
    return load("templates/disk.toml")


def said(scene, changes=None, target=None, found=None, cells=()):
    facts = copy.deepcopy(FACTS) | {"rrmsd_asked": scene.accept.rrmsd}
    for key, value in (changes or {}).items():
        table, _, name = key.partition(".")
        if name:
            facts[table][name] = value
        else:
            facts[key] = value
    target = np.full((8, 8), 1 / 64) if target is None else target
    figures = {key: facts[key] for key in ("rrmsd", "efficiency") if key in facts}
    contents = replace(CONTENTS, **facts, goals=(replace(CONTENTS.goals[0], **figures, rrmsd_by_cell=cells),))
    goal = Goal("target", Screen(500.0, (-200.0, 200.0), (-200.0, 200.0), 8), target)
    return remarks(
        contents, [goal], [target if found is None else found], blank=scene.lens, source=scene.source,
        asked=scene.tailoring, mesh_tolerance=None if scene.output.mesh_tolerance else scene.mesh_tolerance,
    )  # fmt: skip


def on_cells(pixel, half, blurred=None):
    """Return the figures on pixels and half pixels; blurred: those with the real source."""
    pairs = zip((1.0, 0.5), (pixel, half), blurred or (None, None), strict=True)
    return tuple(CellFigures(0.8 * size, "mm", size, rrmsd, 1e-4, blurred=real) for size, rrmsd, real in pairs)


@pytest.mark.parametrize(("cells", "words"), [
    ((), None),
    (on_cells(0.03, 0.044), None),  # 1.5 times
    (on_cells(0.03, 0.232), ["0.03 on pixels", "0.232 on half pixels", "more target.pixels", "narrower than half"]),
    (on_cells(0.005, 0.029), None),
    (on_cells(0.005, 0.031), ["0.005", "0.031"]),
    (on_cells(0.03, 0.232, (0.1, 0.12)), None),  # the real source blurs the stripes
    (on_cells(0.03, 0.232, (None, 0.06)), ["0.232 on half pixels, and 0.06 on half pixels with the size of the real"]),
])  # fmt: skip
def test_light_that_varies_inside_pixels_is_said(scene, cells, words):
    found = {id: text for id, text in said(scene, cells=cells)}
    assert list(found) == ([] if words is None else ["inside-pixels"])
    assert [each for each in words or () if each not in found["inside-pixels"]] == []


@pytest.mark.parametrize(("changes", "asked", "expected"), SAID)
def test_each_loss_is_one_sentence_with_its_figures(scene, changes, asked, expected):
    found = said(scene.changed(asked), changes)
    assert [remark.id for remark in found] == list(expected)
    for id, sentence in found:
        assert [figure for figure in expected[id] if figure not in sentence] == [] and sentence.endswith(".")


OF_A_DOME = [  # changes of the facts and of the scene of a dome, 7 mm thick; id and words of its remark
    ({"shape.centre_thickness": 7.2, "shape.thickness_min": 0.6}, {}, "vertex-moved", ["0.2 mm", "lens.back.radius"]),
    ({"shape.thickness_min": 0.25}, {}, "too-thin", ["Increase lens.back.radius"]),
    ({"flux.missed the lens": 0.47}, {}, "misses", ["lens.back.half_angle"]),
    ({"efficiency": 0.97}, {}, "outside", ["raise tailoring.overshoot"]),
    ({"efficiency": 0.97}, {"source.diameter": 1.0}, "outside", ["larger dome", "overshoot makes the rest", "worse"]),
]


@pytest.mark.parametrize(("changes", "asked", "id", "words"), OF_A_DOME)
def test_a_dome_is_advised_by_keys_that_it_has(changes, asked, id, words):
    small = load("templates/disk.toml", DOME | asked)
    [remark] = said(small, {"shape.centre_thickness": 7.0} | changes)
    assert remark.id == id and [each for each in words if each not in remark.text] == []
    absent = ("lens.back.z", "lens.outline", "lens.max_thickness")
    assert [key for key in absent if key in remark.text] == []


@pytest.mark.parametrize(("changes", "expected"), [
    ({"rrmsd_asked": 0.1}, {}),
    ({"rrmsd_asked": None}, {"no-rrmsd-asked": ["accept.rrmsd"]}),
    ({"verdict": "no limit was asked", "rrmsd": 0.25}, {"no-limit": ["0.25", "[accept]"]}),
    ({"rrmsd": 0.0284, "rrmsd_noise": 0.02, "rrmsd_asked": 0.1}, {"not-resolved": ["0.0284", "0.02", "0.0484"]}),
])  # fmt: skip
def test_each_doubt_is_one_sentence_with_its_figures(changes, expected):
    rrmsd, noise = changes.get("rrmsd", 0.03), changes.get("rrmsd_noise", 0.001)
    goal = replace(CONTENTS.goals[0], rrmsd=rrmsd, rrmsd_standard_error=noise)
    found = doubts(replace(CONTENTS, **changes, goals=(goal,)))
    assert [remark.id for remark in found] == list(expected)
    assert [figure for id, text in found for figure in expected[id] if figure not in text] == []


@pytest.mark.parametrize(("share", "expected"), [(0.03, [("outliers", "3.0 %")]), (0.01, [])])
def test_outliers_are_counted(share, expected):
    found = written("remarks.txt.j2", "outliers", share=share)
    assert [(id, text[:5]) for id, text in found] == expected


def test_what_the_scene_asked_for_comes_first(scene):
    losses = {"flux.missed the lens": 0.47, "shape.slope_max_deg": 75.0, "efficiency": 0.97, "rrmsd": 0.2}
    moved = {"shape.centre_thickness": 6.25, "shape.thickness_min": 0.6}
    found = said(scene.changed({"tailoring.accuracy": 0.02}), losses | moved)
    order = ["back-moved", "accuracy", "rrmsd", "misses", "outside", "steep"]
    assert [remark.id for remark in found] == order


def test_a_strip_left_dark_is_said_with_its_place(scene):
    """Columns 12 and 13 of 100 and a single pixel, of a target 400 mm wide; a tenth of what was asked is enough."""
    target = np.full((50, 100), 1 / 5000)
    found = target.copy()
    found[10:30, 12:14] = 0.09 / 5000
    found[45, 90] = 0.0
    [(id, sentence)] = said(scene, target=target, found=found)
    assert id == "dark" and sentence.startswith("0.82 % of the lit part of the target")
    assert sentence.endswith("x = -152 to -144 mm, y = -40 to 120 mm.")
    found[10:30, 12:14] = 0.11 / 5000
    assert said(scene, target=target, found=found) == []  # one pixel is 0.02 %


def test_dark_parts_that_are_lit_are_measured_and_not_left_dark(scene):
    """Half of the picture is black and gets a tenth of the light."""
    target = np.zeros((8, 8))
    target[:, 4:] = 1 / 32
    assert said(scene, target=target) == []
    [(id, sentence)] = said(scene, target=target, found=np.where(target > 0, 0.9 / 32, 0.1 / 32))
    assert id == "lifted" and "20.0 %" in sentence and "10.0 % of the light on the target" in sentence


def test_the_report_of_a_design_says_it(small_design):
    said = small_design.report["given_up"]
    page = (small_design.folder / "report.html").read_text(encoding="utf-8")
    assert said and all(sentence in page for sentence in said)
    assert page.index("<h2>Remarks</h2>") < page.index("Light on the target")
