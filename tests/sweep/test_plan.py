"""The plan of a scene: effects by the lines that ask for them, predictions, refusals, and the record of the fit."""

import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bstcad import cli
from bstcad.report.record import simulated
from bstcad.scene.scene import load
from bstcad.scene.target import FEWEST
from bstcad.sweep import plan as plans
from bstcad.sweep.cold_run import Units
from bstcad.sweep.estimates import coarse_lens
from bstcad.sweep.plan import (
    KINDS,
    QUALITIES,
    amounts,
    complaint,
    detail,
    fitted,
    forecast,
    of_quality,
    outlook,
    pilots,
    plan,
    seconds,
)
from tests.benchmarks.prediction_scenes import FIT, KEPT_OUT, NET, PIXELS, PLAIN
from tests.conftest import pixels_of_all

ROOT = Path(__file__).parent.parent.parent
TEMPLATES = ROOT / "templates"
THU = TEMPLATES / "thu.toml"
FEW = {"target.pixels": 48}
NINE_OF_TEN = {"seconds": 1.5, "rrmsd": 1.5, "memory_gb": 1.5}  # by what factor they may be off
UNIT = Units(tubes=0.15, serial=0.02)


def portrait(net):
    return load(TEMPLATES / "caustic_portrait.toml", {NET: net, PIXELS: 128})


@pytest.fixture(scope="module")
def flown():
    """The pilots of one scene with two nets, by control points."""
    return {net: pilots(portrait(net), coarse_lens(portrait(net))) for net in (65, 129)}


@pytest.fixture
def known_pilots(flown, monkeypatch):
    """Predictions of this scene take the pilots that were flown already."""
    monkeypatch.setattr(plans, "pilots", lambda scene, lens, tick: flown[scene.lens.back.control_points])


@pytest.fixture
def ahead(flown, known_pilots):
    """What is predicted for the scene with its two nets."""
    return {net: outlook(portrait(net), None, lambda: UNIT) for net in flown}


def test_better_qualities_and_finer_nets_predict_no_more_error_longer_times_and_more_memory(ahead):
    for key, sense in (("rrmsd", -1), ("seconds", 1), ("memory_gb", 1)):
        for net in ahead:
            by_quality = [sense * ahead[net]["predicted"][quality][key][1] for quality in QUALITIES]
            assert by_quality == sorted(by_quality)
        for quality in QUALITIES:
            by_net = [sense * ahead[net]["predicted"][quality][key][1] for net in ahead]
            finer = sense * ahead[65]["finer"]["predicted"][quality][key][1]
            assert by_net == sorted(by_net) and finer >= by_net[0]
    assert [ahead[net]["finer"]["control_points"] for net in ahead] == [129, 257]


def test_a_machine_that_takes_twice_as_long_takes_twice_the_seconds():
    scene = load(TEMPLATES / "thu.toml")
    for quality in QUALITIES:
        one, other = (forecast(scene, quality, 0.03, unit) for unit in (UNIT, Units(2 * UNIT.tubes, 2 * UNIT.serial)))
        assert np.allclose(other["seconds"], 2 * np.array(one["seconds"])) and other["memory_gb"] == one["memory_gb"]
        assert one["seconds"][0] < one["seconds"][1] < one["seconds"][2]


def test_seconds_are_amounts_times_prices():
    """More processors make what tubes cost cheaper, and leave the rest."""
    work = amounts(of_quality(load(TEMPLATES / "thu.toml"), "standard"))
    assert set(work) == set(KINDS)
    prices = fitted()["prices"]
    both = seconds(work, prices, Units(0.0, 1.0)) + seconds(work, prices, Units(1.0, 0.0))
    assert seconds(work, prices, Units(1.0, 1.0)) == pytest.approx(both)
    assert all(price >= 0 for price in prices.values())


def test_detail_is_what_is_finer_than_the_cells():
    x = (np.arange(64) + 0.5) / 64
    wave = 1 + 0.5 * np.cos(np.pi * 20 * x) + np.zeros((64, 64))  # 20 half waves
    assert detail(wave, 19.5) == pytest.approx(np.sqrt(0.125 / 1.125)) and detail(wave, 20.5) < 1e-12


@pytest.mark.parametrize(
    ("template", "changes", "words"),
    [
        ("thu", {NET: 33}, "lens.back.control_points from 65 to 1025, and here there are 33"),
        ("thu", {NET: 1537}, "lens.back.control_points"),
        ("thu", {PIXELS: 1024}, "target.pixels"),
        ("thu", {PIXELS: [512, 128]}, "nearly equal sides"),
        ("thu", {"tailoring.rays": 600}, "tailoring.rays is set"),
        ("thu", {"tailoring.method": "integration"}, 'and tailoring.method = "integration" tailors none'),
        ("thu", {"lens.front": {"kind": "conic", "z": 8.0, "curvature": 0.001, "conic_constant": -1.0}}, "conic"),
        ("thu", {"target.tilt": [10.0, 0.0]}, "tilted"),
        ("thu", {"effects": [{"kind": "fresnel"}]}, "the scene asks for fresnel"),
        ("machinable_letters", {}, "bounds it by lens.tool_radius and lens.max_slope and lens.edge_thickness"),
        ("led", {}, "the scene asks for fresnel"),
        ("white_logo", {}, "source.wavelength has several"),
    ],
)
def test_what_was_not_fitted_is_refused_in_a_sentence(template, changes, words):
    scene = load(TEMPLATES / f"{template}.toml", changes)
    assert words in complaint(scene)
    assert outlook(scene, None, lambda: pytest.fail("calibrates in vain"))["predicted"] is None


@pytest.mark.parametrize(
    ("template", "changes", "words"),
    [
        ("thu", {"lens.front.z": 4.0, "target.x": [1500.0, 1650.0], "target.y": [-75.0, 75.0]}, "no light reaches it"),
        ("caustic_portrait", {"target.z": 24.0}, "target.z"),
    ],
)
def test_a_scene_whose_design_is_refused_is_told_so(template, changes, words):
    scene = load(TEMPLATES / f"{template}.toml", {NET: 65, PIXELS: 128, "accept.rrmsd": None} | changes)
    facts = outlook(scene, coarse_lens(scene), lambda: UNIT)
    assert facts["predicted"] is None and words in facts["not_predicted"]


def test_the_pilot_of_a_narrow_target_has_pixels_enough():
    narrow = load(TEMPLATES / "thu.toml", {PIXELS: [128, 64], NET: 1025})
    for quality in plans.SIZES:
        small, factor, _ = plans._small(narrow, quality)  # SceneError for pixels too few
        assert factor > 1 and min(small.target.columns_rows) >= FEWEST


def test_a_scene_with_the_knobs_of_its_quality_is_predicted():
    scene = load(TEMPLATES / "thu.toml")
    assert complaint(scene) == ""
    assert complaint(scene.changed({"tailoring.rays": 1536, "tailoring.stage2_iterations": 98})) == ""


@pytest.mark.parametrize(("template", "changes"), [("mirror", {}), ("sun_caustic", {}), ("led", PLAIN)])
def test_mirrors_and_sources_of_some_size_are_predicted(template, changes):
    assert complaint(load(TEMPLATES / f"{template}.toml").changed(changes)) == ""


def test_what_ends_a_design_early_is_said(known_pilots):
    scene = portrait(65).changed({"tailoring.max_time": 5.0, "tailoring.accuracy": 0.9})
    late, early = outlook(scene, None, lambda: UNIT)["notes"]
    assert "max_time = 5" in late and "fine" in late and "accuracy = 0.9" in early and "draft" in early


def recorded(name):
    return json.loads((ROOT / "tests" / "benchmarks" / f"prediction_{name}.json").read_text())["runs"]


@pytest.mark.parametrize(("key", "most"), NINE_OF_TEN.items())
def test_predictions_of_scenes_that_were_kept_out_of_the_fit_hold(key, most):
    """The record of tests/benchmarks/prediction_figure.py: `make prediction`."""
    runs, within = recorded("kept_out"), fitted()["within"][key]
    off = np.sort([np.exp(abs(np.log(run["predicted"][key][1] / run[key]))) for run in runs])
    assert len(off) == 14 and np.median(off) <= 1.3 and off[12] <= most  # thirteen of fourteen
    assert within <= most and off[12] <= within * 1.001  # the last digit of the record
    for low, likely, high in (run["predicted"][key] for run in runs):
        assert high / likely == pytest.approx(within, rel=0.01) and likely / low == pytest.approx(within, rel=0.01)


def test_the_fit_can_be_made_again_and_knows_none_of_the_scenes_kept_out():
    """fitted.json comes from the runs on record: each needs its scene, whose pilot the fit flies anew."""
    fit = {(run["name"], run["quality"]) for run in recorded("fit")}
    assert fit == {(case.name, quality) for case in FIT for quality in case.qualities}
    assert not {run["name"] for run in recorded("kept_out")} & {name for name, _ in fit}
    assert len(KEPT_OUT) == 14 and all(case.picture or "target.text" in case.changes for case in KEPT_OUT)
    for of_case in (name, picture, geometry):
        assert not {of_case(case) for case in KEPT_OUT} & {of_case(case) for case in FIT}


def name(case):
    return case.name


def picture(case):
    return case.picture or case.changes.get("target.text") or as_it_is(case.template).target.text


def geometry(case):
    scene = as_it_is(case.template)
    usual = {NET: scene.lens.back.control_points, PIXELS: scene.target.pixels, "target.z": scene.target.z}
    return case.template, *(case.changes.get(key, value) for key, value in usual.items())


@cache
def as_it_is(template):
    return load(TEMPLATES / f"{template}.toml")


# --- which line asks for an effect ------------------------------------------------------------------------------------


def test_what_is_simulated_names_the_line_that_asks_for_it(tmp_path):
    path, lines = tmp_path / "thu.toml", THU.read_text(encoding="utf-8").splitlines()
    lines += ["[[effects]]", 'kind = "fresnel"']
    path.write_text("\n".join(lines), encoding="utf-8")
    scene, keys = load(path, FEW | {"lens.index": 1.5}), ["target.pixels", "lens.index"]
    found = next(plan(scene, path.read_text(encoding="utf-8"), keys))
    refraction, _, vignetting, fresnel = found["simulated"]
    assert refraction["asked_by"] == "--set lens.index" and refraction["line"] is None
    assert lines[vignetting["line"] - 1].startswith("outline =") and vignetting["key"] == "lens.outline"
    assert vignetting["asked_by"] == f"lens.outline, line {vignetting['line']}"
    assert lines[fresnel["line"] - 1] == 'kind = "fresnel"' and fresnel["key"] == "effects[0].kind"
    assert "fresnel" not in {entry["kind"] for entry in found["left_out"]}


@pytest.mark.parametrize("path", sorted(TEMPLATES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_template_has_a_plan(path):
    scene = load(path, pixels_of_all(path, 48))
    found = next(plan(scene, path.read_text(encoding="utf-8")))
    assert [item["what"] for item in found["simulated"]] == [words for words, _ in simulated(scene)]
    assert all(item["line"] for item in found["simulated"])
    assert any(entry["rrmsd_change"] for entry in found["left_out"])


TWO = {  # pictures, behind a back that is tailored
    "target": [{"z": z, "x": [-20.0, 20.0], "y": [-20.0, 20.0], "pixels": 32, "uniform": True} for z in (220.0, 660.0)],
    "lens.back.control_points": 65,
}  # fmt: skip


def test_each_target_has_its_own_estimates():
    """Three times as far off the image of the source's cone is three times as wide."""
    scene = load(TEMPLATES / "caustic_portrait.toml").changed(TWO | {"source.real_divergence": 0.5})
    found, predicted = plan(scene)
    first, second = found["goals"]
    near, far = (
        next(entry for entry in each["left_out"] if entry["kind"] == "source size") for each in (first, second)
    )
    assert second["key"] == "target[1]" and far["blur_pixels"] / near["blur_pixels"] == pytest.approx(3, rel=0.1)
    alone = next(plan(scene.changed({"target": scene.targets[1]})))
    assert second["left_out"] == alone["left_out"] == alone["goals"][0]["left_out"] and "caveat" not in alone
    assert found["caveat"] == plans.ALONE
    assert predicted["not_predicted"] == "predictions were fitted on one target, and the scene has 2"
    wave = scene.changed({"target": scene.target, "wavefront": {"kind": "plane", "z": 220.0}})
    assert complaint(wave) == "predictions were fitted on pictures alone, and the scene has a [wavefront]"


def test_the_reach_of_each_target_is_drawn_and_of_two_faces_refused(tmp_path, capsys):
    scene = load(TEMPLATES / "caustic_portrait.toml").changed(TWO | {"name": "two", "target[1].x": [-20.0, 30.0]})
    (tmp_path / "two.toml").write_text(scene.toml(), encoding="utf-8")
    png = tmp_path / "reach.png"
    assert cli.run(["plan", str(tmp_path / "two.toml"), "--png", str(png)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "left out, target[0]" in out and "left out, target[1]" in out and plans.ALONE in out
    first, second = (png.with_stem(stem).read_bytes() for stem in ("reach", "reach_2"))
    assert first.startswith(b"\x89PNG") and second.startswith(b"\x89PNG") and first != second
    both = tmp_path / "both.png"
    assert cli.run(["plan", str(TEMPLATES / "two_pictures.toml"), "--png", str(both)]) == 2
    assert "--png: draws what light can reach by way of a tailored back" in capsys.readouterr().err
    assert not both.exists()


def test_the_image_of_a_chip_is_stated_before_the_design():
    """w = d L / (l + t / n): a chip d at l before a plate of the thickness t, a target L behind it, near the axis."""
    path = TEMPLATES / "led.toml"
    near = {"target.x": [-150.0, 150.0], "target.y": [-150.0, 150.0], "lens.outline.radius": 5.0}
    scene = load(path, near)
    found = next(plan(scene, path.read_text(encoding="utf-8")))["blur"]
    d, before, thick, behind = 1.0, 14.0, 10.0, 1000.0 - 24.0
    assert found["width"] == pytest.approx(d * behind / (before + thick / scene.index), rel=0.1)
    assert found["pixels"] == pytest.approx(found["width"] / (300.0 / 120), rel=0.01)
    small = next(plan(load(path, near | {"source.diameter": 0.5})))["blur"]
    assert small["width"] == pytest.approx(found["width"] / 2, rel=0.05) and small["rrmsd"] < found["rrmsd"]


def predicted(low, likely, high):
    figures = {"rrmsd": (low, likely, high), "seconds": (20.0, 30.0, 40.0)}
    return {"predicted": {"standard": figures}, "goals": [{"blur": None}]}


def blurred(rrmsd):
    return {"goals": [{"blur": {"rrmsd": rrmsd, "width": 9.0, "pixels": 3.0}}]}


VERDICTS = [
    (0.1, predicted(0.02, 0.03, 0.04), "within", "An RRMSD of about 0.03 in about 30 s, in standard qualit"),
    (0.1, predicted(0.08, 0.12, 0.15), "open", "0.1 is allowed, and 0.08 to 0.15 may come out."),
    (0.1, predicted(0.2, 0.3, 0.4), "beyond", "0.1 is allowed, and will hardly be reached."),
    (None, predicted(0.02, 0.03, 0.04), "no limit", "nine of ten designs would keep [accept] rrmsd = 0.0"),
    (0.1, {"predicted": None, "not_predicted": "too odd", "goals": [{"blur": None}]}, "not predicted", "too odd."),
    (0.1, blurred(0.3), "blurred", "The RRMSD will be 0.15 to 0.3 whatever"),
    (None, blurred(0.6), "blurred", "to 0.6 whatever the lens. Take"),
    (0.5, blurred(0.3), None, ""),
]


@pytest.mark.parametrize(("asked", "found", "kind", "words"), VERDICTS, ids=[kind for _, _, kind, _ in VERDICTS])
def test_a_plan_comes_to_a_verdict(asked, found, kind, words):
    told = plans.verdict(portrait(65).changed({"accept.rrmsd": asked}), found)
    assert (told and told["kind"]) == kind and (kind is None or words in told["sentence"])


def test_a_chip_that_blurs_the_picture_is_said_first(tmp_path, capsys, monkeypatch):
    """A chip of 5 mm before a lens of 60 mm, whose image on the wall is some 40 mm wide: a line of 300 mm is gone."""
    scene = load(TEMPLATES / "led.toml", {
        "source.diameter": None, "source.width": 5.0, "source.height": 5.0, "lens.front.z": 60.0, "lens.back.z": 70.0,
        "lens.outline.radius": 30.0, "target.z": 570.0, "target.x": [-150.0, 150.0], "target.y": [-150.0, 150.0],
        "target.uniform": None, "target.text": "thirty-two words", "target.pixels": 96, "accept.rrmsd": None,
    })  # fmt: skip
    monkeypatch.setattr(plans, "outlook", lambda *given: {"predicted": None, "not_predicted": "the test ends here"})
    path = tmp_path / "chip.toml"
    path.write_text(scene.toml(), encoding="utf-8")
    assert cli.run(["plan", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert next(iter(found)) == "verdict" and found["verdict"]["kind"] == "blurred" and found["blur"]["rrmsd"] > 0.5
    assert found["blur"]["width"] == pytest.approx((4 / 3) ** 0.5 * 5 * 500 / (60 + 10 / scene.index), rel=0.1)
    monkeypatch.setattr(plans, "outlook", lambda *given: {"predicted": None, "not_predicted": "x", "finer": None})
    assert cli.run(["plan", str(path)]) == 0
    assert capsys.readouterr().out.startswith("PLAN: The picture will be blurred: through each place of the lens")


class TestCommand:
    def test_the_image_of_a_chip_is_a_sentence(self, capsys):
        assert cli.run(["plan", str(TEMPLATES / "led.toml"), "--set", "target.pixels=48"]) == 0
        sentence = " ".join(capsys.readouterr().out.split())
        assert re.search(r"throws an image of itself, [\d.]+ mm \([\d.]+ pixels\) wide on the target", sentence)

    def test_what_is_not_predicted_is_said(self, capsys):
        few = ["plan", str(THU), "--set", "target.pixels=48"]
        assert cli.run([*few, "--json"]) == 0
        out, err = capsys.readouterr()
        found = json.loads(out)
        keys = {"predicted", "not_predicted", "finer", "notes", "simulated", "left_out", "blur", "unreachable", "files"}
        keys |= {"verdict", "goals"}
        assert set(found) == keys and err == ""
        assert found["blur"] is None and found["unreachable"] is None  # a beam of no size, all within reach
        assert found["predicted"] is None and "target.pixels from 120 to 512" in found["not_predicted"]
        assert cli.run(few) == 0
        out, _ = capsys.readouterr()
        for words in (
            "vignetting by the outline",
            "Fresnel reflection",
            '[[effects]] kind = "fresnel"',
            "not predicted",
        ):
            assert words in out
        assert max(map(len, out.splitlines())) <= 100

    def test_predictions_as_json_and_as_a_table(self, capsys, known_pilots):
        path = str(TEMPLATES / "caustic_portrait.toml")
        few = ["plan", path, "--set", f"{PIXELS}=128", "--set", f"{NET}=65"]
        assert cli.run([*few, "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert set(found["predicted"]) == {"draft", "standard", "fine"} and found["not_predicted"] is None
        for each in (*found["predicted"].values(), *found["finer"]["predicted"].values()):
            assert set(each) == {"seconds", "rrmsd", "memory_gb"}
            assert all(0 < low < likely < high for low, likely, high in each.values())
        assert found["finer"]["control_points"] == 129
        assert cli.run(few) == 0
        out, _ = capsys.readouterr()
        assert "seconds" in out and "standard" in out and "129" in out

    def test_effects_are_shown_before_anything_is_predicted(self, capsys, monkeypatch):
        shown = []

        def outlook(scene, lens, units, tick):
            shown.extend(capsys.readouterr())
            return {"predicted": None, "not_predicted": "the test ends here", "finer": None, "notes": []}

        monkeypatch.setattr(plans, "outlook", outlook)
        assert cli.run(["plan", str(THU), "--set", "target.pixels=128"]) == 0
        out, err = shown
        assert "vignetting by the outline" in out and "Fresnel reflection" in out and "predicted" not in out
        assert err == "predicting seconds, RRMSD and memory …\n"
        assert "not predicted: the test ends here." in capsys.readouterr().out

    def test_light_that_cannot_reach_the_target_is_one_sentence(self, capsys):
        far = ["--set", "source.aperture.radius=1e-3", "--set", "target.x=[9000.0, 9400.0]"]
        assert cli.run(["plan", str(THU), *far]) == 2
        out, err = capsys.readouterr()
        assert "source: no ray" in err and err.splitlines()[-1].startswith("bstcad: ") and out == ""
