"""The plan of a scene: effects by the lines that ask for them, predictions by pilots, the verdict, and refusals."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from bstcad import cli
from bstcad.optics.trace.measure import Effort
from bstcad.planning import plan as plans
from bstcad.planning.effect_estimates import simulated
from bstcad.planning.plan import plan, predict_qualities
from bstcad.planning.prediction import QUALITIES, run_pilot
from bstcad.planning.reduction import PILOT
from bstcad.scene.errors import SceneError, toml_positions
from bstcad.scene.scene import load
from tests import suite
from tests.efforts import LITTLE

ROOT = Path(__file__).parent.parent.parent
TEMPLATES = ROOT / "templates"
THU = TEMPLATES / "thu.toml"
NET, PIXELS = "lens.back.control_points", "target.pixels"
FEW = {PIXELS: 48}
ENDS = {"predicted": None, "not_predicted": "the test ends here", "finer": None, "notes": []}  # an outlook


def portrait(net):
    return load(TEMPLATES / "caustic_portrait.toml", {NET: net, PIXELS: 128})


@pytest.fixture(scope="module")
def flown():
    """The pilot of one scene."""
    size, rays = replace(PILOT, tubes=256, effort=LITTLE), Effort(384, accuracy=0.02, witness=False, cells=2)
    return run_pilot(portrait(65), size=size, rays=rays)


@pytest.fixture
def known_pilot(flown, monkeypatch):
    """Predictions take the pilot that was flown already."""
    monkeypatch.setattr(plans, "run_pilot", lambda scene, tick: flown)
    monkeypatch.setattr("bstcad.planning.prediction.pace", lambda: 1.0)


@pytest.fixture
def lens():
    """A coarse lens for this scene."""
    return plans.coarse_lens(portrait(65))


def test_better_qualities_and_finer_nets_predict_no_more_error_longer_times_and_more_memory(known_pilot, lens):
    ahead = predict_qualities(portrait(65), [lens])
    assert ahead["finer"]["control_points"] == 129
    for key, sense in (("rrmsd", -1), ("seconds", 1), ("memory_gb", 1)):
        few, many = ([sense * at[quality][key][1] for quality in QUALITIES]
                     for at in (ahead["predicted"], ahead["finer"]["predicted"]))  # fmt: skip
        assert few == sorted(few) and many == sorted(many)
        assert all(one <= other for one, other in zip(few, many, strict=True))


def test_what_ends_a_design_early_is_said(known_pilot, lens):
    scene = portrait(65).changed({"tailoring.max_time": 5.0, "tailoring.accuracy": 0.9})
    late, early = predict_qualities(scene, [lens])["notes"]
    assert "max_time = 5" in late and "fine" in late and "accuracy = 0.9" in early and "draft" in early


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


def test_every_effect_of_every_template_is_asked_for_by_a_line():
    for path in TEMPLATES.glob("*.toml"):
        at = toml_positions(path.read_text(encoding="utf-8"))
        assert all(plans._request_of(key, at, ())["line"] for _, key in simulated(load(path))), path


TWO = {  # pictures, behind a back that is tailored
    "target": [{"z": z, "x": [-20.0, 20.0], "y": [-20.0, 20.0], "pixels": 32, "uniform": True} for z in (220.0, 660.0)],
    "lens.back.control_points": 65,
}  # fmt: skip


def test_each_target_has_its_own_estimates():
    """Three times as far off the image of the source's cone is three times as wide."""
    scene = load(TEMPLATES / "caustic_portrait.toml").changed(TWO | {"source.real_divergence": 0.5})
    found = next(plan(scene))
    first, second = found["goals"]
    near, far = (
        next(entry for entry in each["left_out"] if entry["kind"] == "source size") for each in (first, second)
    )
    assert second["key"] == "target[1]" and far["blur_pixels"] / near["blur_pixels"] == pytest.approx(3, rel=0.1)
    alone = next(plan(scene.changed({"target": scene.targets[1]})))
    assert second["left_out"] == alone["left_out"] == alone["goals"][0]["left_out"] and "caveat" not in alone
    assert found["caveat"] == plans.CAVEAT


def test_the_reach_of_each_target_is_drawn_and_of_two_faces_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(plans, "predict_qualities", lambda *given: ENDS)
    scene = load(TEMPLATES / "caustic_portrait.toml").changed(TWO | {"name": "two", "target[1].x": [-20.0, 30.0]})
    (tmp_path / "two.toml").write_text(scene.toml(), encoding="utf-8")
    png = tmp_path / "reach.png"
    assert cli.run(["plan", str(tmp_path / "two.toml"), "--png", str(png)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "not simulated, target[0]" in out and "not simulated, target[1]" in out and plans.CAVEAT in out
    first, second = (png.with_stem(stem).read_bytes() for stem in ("reach", "reach_2"))
    assert first.startswith(b"\x89PNG") and second.startswith(b"\x89PNG") and first != second
    both = tmp_path / "both.png"
    assert cli.run(["plan", str(TEMPLATES / "two_pictures.toml"), "--png", str(both)]) == 2
    assert "--png: draws the part of the target that light can reach through a tailored back" in capsys.readouterr().err
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


def predicted(low, likely, high):
    half = tuple(2 * value for value in (low, likely, high))
    figures = {"rrmsd": (low, likely, high), "rrmsd_half": half, "seconds": (20.0, 30.0, 40.0)}
    return {"predicted": {"standard": figures}, "goals": [{"blur": None}]}


def blurred(rrmsd):
    return {"goals": [{"blur": {"rrmsd": rrmsd, "width": 9.0, "pixels": 3.0}}]}


VERDICTS = [
    (0.1, predicted(0.02, 0.03, 0.04), "within", "an RRMSD of about 0.03 on pixels after about 30 s"),
    (0.1, predicted(0.08, 0.12, 0.15), "open", "0.1, and the result will probably lie between 0.08 and 0.15."),
    (0.1, predicted(0.2, 0.3, 0.4), "beyond", "the limit is 0.1, and the RRMSD will probably exceed it."),
    (None, predicted(0.02, 0.03, 0.04), "no limit", "designs would pass with [accept] rrmsd = 0.0"),
    (0.1, {"predicted": None, "not_predicted": "too odd", "goals": [{"blur": None}]}, "not predicted", "too odd."),
    (0.1, blurred(0.3), "blurred", "The RRMSD will be 0.15 to 0.3 for any lens; the limit is 0.1."),
    (None, blurred(0.6), "blurred", "to 0.6 for any lens. Use"),
    (0.5, blurred(0.3), None, ""),
]


@pytest.mark.parametrize(("asked", "found", "kind", "words"), VERDICTS, ids=[kind for _, _, kind, _ in VERDICTS])
def test_a_plan_comes_to_a_verdict(asked, found, kind, words):
    told = plans.verdict(portrait(65).changed({"accept.rrmsd": asked, "accept.rrmsd_half": None}), found)
    assert (told and told["kind"]) == kind and (kind is None or words in told["sentence"])


@pytest.mark.parametrize(("pixels", "half", "kind", "words"), [
    (0.1, 0.5, "within", "about 0.03 on pixels"), (0.1, 0.07, "open", "about 0.06 on half pixels"),
    (None, 0.03, "beyond", "the limit is 0.03"), (0.02, 0.5, "open", "about 0.03 on pixels"),
])  # fmt: skip
def test_the_harder_limit_decides(pixels, half, kind, words):
    scene = portrait(65).changed({"accept.rrmsd": pixels, "accept.rrmsd_half": half})
    told = plans.verdict(scene, predicted(0.02, 0.03, 0.04))
    assert told["kind"] == kind and words in told["sentence"]


def test_a_chip_that_blurs_the_picture_is_said_first(tmp_path, capsys, monkeypatch):
    """A chip of 5 mm before a lens of 60 mm, whose image on the wall is some 40 mm wide: a line of 300 mm is gone."""
    scene = load(TEMPLATES / "led.toml", {
        "source.diameter": None, "source.width": 5.0, "source.height": 5.0, "lens.front.z": 60.0, "lens.back.z": 70.0,
        "lens.outline.radius": 30.0, "target.z": 570.0, "target.x": [-150.0, 150.0], "target.y": [-150.0, 150.0],
        "target.uniform": None, "target.text": "thirty-two words", "target.pixels": 96, "accept.rrmsd": None,
    })  # fmt: skip
    monkeypatch.setattr(plans, "predict_qualities", lambda *given: ENDS)
    path = tmp_path / "chip.toml"
    path.write_text(scene.toml(), encoding="utf-8")
    assert cli.run(["plan", str(path)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert out.startswith("PLAN: The picture will be blurred: ")
    assert re.search(r"an image of the source on the target, [\d.]+ mm \([\d.]+ pixels\) wide", out)


class TestCommand:
    @suite.in_turn(0, 2)
    def test_what_is_not_predicted_is_said(self, capsys, monkeypatch):
        """The plate would reach the target; the second command has the first one's refusal."""
        refusals = []

        def pilot(scene, tick):
            if not refusals:
                with pytest.raises(SceneError) as refusal:
                    run_pilot(scene, tick, size=replace(PILOT, effort=LITTLE))
                refusals.append(refusal.value)
            raise refusals[0]

        monkeypatch.setattr(plans, "run_pilot", pilot)
        few = ["plan", str(TEMPLATES / "caustic_portrait.toml"), "--set", "target.pixels=48", "--set", "target.z=24.0"]
        few += ["--set", f"{NET}=33"]
        assert cli.run([*few, "--json"]) == 0
        out, err = capsys.readouterr()
        found = json.loads(out)
        keys = {
            "predicted",
            "not_predicted",
            "finer",
            "notes",
            "simulated",
            "left_out",
            "blur",
            "unreachable",
            "sharp_throw",
            "etendue",
            "files",
        }
        keys |= {"verdict", "goals"}
        assert set(found) == keys and err == ""
        assert found["blur"] is None and found["unreachable"] is None  # a beam of no size, all within reach
        assert found["predicted"] is None and "target.z" in found["not_predicted"]
        throw = found["sharp_throw"]
        assert throw["throw"] == pytest.approx(throw["distance"] * throw["cell"] / throw["spot"], rel=5e-3)
        assert cli.run(few) == 0
        out, _ = capsys.readouterr()
        said = "vignetting", "Fresnel", '[[effects]] kind = "fresnel"', "not predicted", "sharp up to a throw of"
        assert all(words in out for words in said)
        assert max(map(len, out.splitlines())) <= 100

    def test_predictions_as_json_and_as_a_table(self, capsys, known_pilot):
        path = str(TEMPLATES / "caustic_portrait.toml")
        few = ["plan", path, "--set", f"{PIXELS}=128", "--set", f"{NET}=65"]
        assert cli.run([*few, "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert set(found["predicted"]) == {"draft", "standard", "fine"} and found["not_predicted"] is None
        for each in (*found["predicted"].values(), *found["finer"]["predicted"].values()):
            assert set(each) == {"seconds", "rrmsd", "rrmsd_half", "memory_gb"}
            assert all(0 < low < likely < high for low, likely, high in each.values())
        assert found["finer"]["control_points"] == 129
        assert cli.run(few) == 0
        out, _ = capsys.readouterr()
        assert "seconds" in out and "standard" in out and "129" in out

    def test_effects_are_shown_before_anything_is_predicted(self, capsys, monkeypatch):
        shown = []

        def predict_qualities(*given):
            shown.extend(capsys.readouterr())
            return ENDS

        monkeypatch.setattr(plans, "predict_qualities", predict_qualities)
        assert cli.run(["plan", str(THU), "--set", "target.pixels=128"]) == 0
        out, err = shown
        assert "vignetting by the outline" in out and "Fresnel reflection" in out and "predicted" not in out
        assert err == "predicting time, RRMSD and memory …\n"
        assert "not predicted: the test ends here." in capsys.readouterr().out

    def test_light_that_cannot_reach_the_target_is_one_sentence(self, capsys):
        far = ["--set", "source.aperture.radius=1e-3", "--set", "target.x=[9000.0, 9400.0]"]
        assert cli.run(["plan", str(THU), *far]) == 2
        out, err = capsys.readouterr()
        assert "source: no ray reaches" in err and err.splitlines()[-1].startswith("bstcad: ") and out == ""
