"""What was given up is said with its figure, and nothing is said where nothing was given up."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from bstcad.analysis.light import Blur, FinestDetail
from bstcad.optics.goal import Goal
from bstcad.optics.irradiance import Screen
from bstcad.report.record import LeftOut, remarks
from bstcad.scene.scene import load
from bstcad.verify.verdict import Check
from tests.report.test_report import CONTENTS

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
COARSE = {"checks": (Check("STL: chordal error", 1.75e-3, None, "mm", True),)}
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
SENTENCES = [  # changes of the facts, of the scene; what the sentences hold, each in its own
    ({}, {}, []),
    ({"rrmsd": 0.234}, {}, ["The RRMSD is 0.234 where 0.1 was asked."]),
    ({"flux.total internal reflection": 0.032}, {}, ["4.0 % of the light that enters the lens is lost to total"]),
    ({"flux.lost through the sides": 0.16}, {}, ["20.0 % of the light that enters the lens leaves through the sides"]),
    ({"flux.lost through the sides": 0.0004, "efficiency": 0.9995, "flux.missed the lens": 0.25}, {}, []),
    ({"flux.missed the lens": 0.47}, {}, ["47.0 % of the light that the source sends out misses the lens."]),
    ({"flux.vignetted by the underside": 0.05}, {}, ["5.0 % of the light that the source sends out meets the under"]),
    ({"flux.vignetted by the underside": 0.0005}, {}, []),
    ({"efficiency": 0.97}, {}, ["3.0 % of the light that leaves the lens falls outside the target."]),
    ({"stability.tir_margin_deg": 1.25}, {}, ["only 1.25° short of total internal reflection"]),
    ({"stability.tir_margin_deg": -0.5}, {}, ["0.5° beyond the critical angle, and is reflected."]),
    ({"shape.centre_thickness": 6.25, "shape.thickness_min": 0.6}, {}, [
        "The lens is 6.25 mm thick on the axis instead of 5 mm: the back was moved by 1.25 mm along +z, so that the "
        "thinnest place keeps 0.6 mm."]),
    ({"shape.centre_thickness": 5.2}, {}, ["5.2 mm thick on the axis instead of 5 mm: tailoring moved the vertex"]),
    ({"shape.centre_thickness": 4.8}, {}, ["4.8 mm thick on the axis instead of 5 mm: tailoring moved the vertex"]),
    ({"shape.centre_thickness": 5.004, "shape.thickness_min": 0.6}, {}, []),  # stage 2 moves it a little
    ({"shape.centre_thickness": 5.04}, {}, []),
    ({"shape.thickness_min": 0.25}, {}, ["The lens is 0.25 mm thin where 0.5 mm was asked."]),
    ({"shape.slope_max_deg": 75.0}, {}, ["as steep as 75°"]),
    ({"transport": {"steep_share": 0.125, "steepest_deg": 97.4}}, {}, [
        "12.5 % of the light of the target would need a back steeper than 70°, up to 97°, which overhangs: a height "
        "over a plane carries no more, and that light is sent elsewhere."]),
    ({"transport": {"steep_share": 0.02, "steepest_deg": 74.0}}, {}, ["steeper than 70°, up to 74°: a height over"]),
    ({"transport": {"steep_share": 0.0005, "steepest_deg": 74.0}}, {}, []),
    ({"stopped": "time"}, {}, ["ended when its time was up"]),
    ({"stopped": "interrupt"}, {}, ["stopped by hand"]),
    ({"skipped_steps": 3}, {}, ["Steps left out because their gradient was not finite: 3."]),
    ({"seconds_total": 26.8}, TIMED, ["The time limit of 20.0 s was missed by 6.8 s: "]),
    ({"seconds_total": 19.9}, TIMED, []),
    ({"seconds_total": 1000.0}, {}, []),
    (COARSE, {}, ["The facets of lens.stl and lens.3mf lie within 1.75 µm of the lens, not within 1 µm"]),
    (COARSE, FINE, []),  # a check says it
    ({}, {"tailoring.accuracy": 0.02}, [
        "The accuracy of 0.02 that was asked is not reached: the RRMSD is 0.03."]),
    ({"rrmsd": 0.0201}, {"tailoring.accuracy": 0.02}, []),  # by other tubes than tailoring ended with
    # 0.03 is stated and 0.1 allowed: an effect of 0.031 makes √(0.03² + 0.031²) of it
    (effects(left_out("fresnel", 0.031, by='[[effects]] kind = "fresnel"'), left_out("absorption", 0.029)), {}, [
        "Left out: Fresnel reflection would change the picture by an RRMSD of 0.031, more than the stated 0.03; "
        '[[effects]] kind = "fresnel" in the scene simulates it.']),
    (effects(left_out("fresnel", 0.11), rrmsd=0.2, rrmsd_asked=0.1), {}, [
        "The RRMSD is 0.2", "by an RRMSD of 0.11, more than the 0.1 that is allowed."]),
    (effects(left_out("fresnel", 0.09), rrmsd=0.2, rrmsd_asked=0.1), {}, ["The RRMSD is 0.2"]),
    (effects(ASSUMED), {}, [
        "Left out: size of the source, a cone of 0.1 degrees, which the scene does not state, would change the picture "
        "by an RRMSD of 0.06, more than the stated 0.03; source.divergence in the scene simulates it, "
        "source.real_divergence states another size."]),
    (effects(replace(ASSUMED, rrmsd_change=0.006, assumed=False)), {}, []),
    (BLURRED | {"rrmsd": 0.5}, {}, ["The RRMSD is 0.5", (
        "The source is too large for the picture: the finest detail on the target is 46 mm wide (source.divergence = "
        "0.53 degrees), and the picture with no finer detail has an RRMSD of 0.54 where 0.1 is allowed; with the "
        "target 250 mm instead of 5\u202f000 mm from the lens it is 2.4 mm.")]),
    (BLURRED, {}, []),  # tailoring made up for it
]  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    """Front at 15 mm, back at 20, RRMSD 0.1 and 0.5 mm of glass asked."""
    return load("templates/disk.toml")


def said(scene, changes=None, target=None, found=None):
    facts = copy.deepcopy(FACTS)
    for key, value in (changes or {}).items():
        table, _, name = key.partition(".")
        if name:
            facts[table][name] = value
        else:
            facts[key] = value
    target = np.full((8, 8), 1 / 64) if target is None else target
    figures = {key: facts[key] for key in ("rrmsd", "efficiency") if key in facts}
    contents = replace(CONTENTS, **facts, goals=(replace(CONTENTS.goals[0], **figures),))
    goal = Goal("target", Screen(500.0, (-200.0, 200.0), (-200.0, 200.0), 8), target)
    return remarks(contents, scene, [goal], [target if found is None else found])


@pytest.mark.parametrize(("changes", "asked", "words"), SENTENCES)
def test_each_loss_is_one_sentence_with_its_figure(scene, changes, asked, words):
    sentences = said(scene.changed(asked), changes)
    for sentence, part in zip(sentences, words, strict=True):
        assert part in sentence and sentence.endswith(".")


def test_what_the_scene_asked_for_comes_first(scene):
    losses = {"flux.missed the lens": 0.47, "shape.slope_max_deg": 75.0, "efficiency": 0.97, "rrmsd": 0.2}
    moved = {"shape.centre_thickness": 6.25, "shape.thickness_min": 0.6}
    beginnings = (
        "The lens is 6.25 mm",
        "The accuracy of 0.02",
        "The RRMSD is 0.2",
        "47.0 %",
        "3.0 %",
        "The back is as",
    )
    found = said(scene.changed({"tailoring.accuracy": 0.02}), losses | moved)
    assert all(sentence.startswith(words) for sentence, words in zip(found, beginnings, strict=True))


def test_a_strip_left_dark_is_said_with_its_place(scene):
    """Columns 12 and 13 of 100 and a single pixel, of a target 400 mm wide; a tenth of what was asked is enough."""
    target = np.full((50, 100), 1 / 5000)
    found = target.copy()
    found[10:30, 12:14] = 0.09 / 5000
    found[45, 90] = 0.0
    [sentence] = said(scene, target=target, found=found)
    assert sentence.startswith(
        "0.82 % of the lit part of the target is left dark, with less than 10 % of what was asked"
    )
    assert sentence.endswith("the largest patch lies at x = -152 to -144 mm, y = -40 to 120 mm.")
    found[10:30, 12:14] = 0.11 / 5000
    assert said(scene, target=target, found=found) == []  # one pixel is 0.02 %


def test_dark_parts_that_are_lit_are_measured_and_not_left_dark(scene):
    """Half of the picture is black and gets a tenth of the light."""
    target = np.zeros((8, 8))
    target[:, 4:] = 1 / 32
    assert said(scene, target=target) == []
    [sentence] = said(scene, target=target, found=np.where(target > 0, 0.9 / 32, 0.1 / 32))
    assert "get 20.0 % of it, and in all 10.0 % of the light on the target more" in sentence


def test_the_report_of_a_design_says_it(small_design):
    said = small_design.report["given_up"]
    page = (small_design.folder / "report.html").read_text(encoding="utf-8")
    assert said and all(sentence in page for sentence in said)
    assert page.index("<h2>Remarks</h2>") < page.index("Irradiance on the target")
