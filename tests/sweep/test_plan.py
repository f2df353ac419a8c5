"""The plan of a scene: what is simulated and by which line, what is left out, and what is wrong in a sentence."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from bstcad import cli
from bstcad.optics.measure import tubes_picture
from bstcad.report.assemble import simulated
from bstcad.report.record import LEFT_OUT
from bstcad.scene.scene import load
from bstcad.sweep import forecast
from bstcad.sweep.plan import coarse_lens, left_out, plan

ROOT = Path(__file__).parent.parent.parent
TEMPLATES = sorted((ROOT / "templates").glob("*.toml"))
THU = ROOT / "templates" / "thu.toml"
FEW = {"target.pixels": 48}


@pytest.fixture(scope="module")
def thu():
    """The entries of thu's plan, with few pixels."""
    return plan(load(THU, FEW), THU.read_text(encoding="utf-8"))


def by_kind(entries):
    return {entry["kind"]: entry for entry in entries}


def test_what_is_simulated_names_the_line_that_asks_for_it(thu):
    lines = THU.read_text(encoding="utf-8").splitlines()
    refraction, _, vignetting = thu["simulated"]
    assert lines[refraction["line"] - 1].startswith('material = "PMMA"')
    assert refraction["asked_by"] == f"lens.material, line {refraction['line']}"
    assert lines[vignetting["line"] - 1].startswith("outline =") and vignetting["key"] == "lens.outline"


def test_an_effect_is_named_with_its_table_and_left_out_no_more(tmp_path):
    path = tmp_path / "thu.toml"
    path.write_text(THU.read_text(encoding="utf-8") + '\n[[effects]]\nkind = "fresnel"\n', encoding="utf-8")
    text = path.read_text(encoding="utf-8")
    found = plan(load(path, FEW), text, ["target.pixels"])
    *_, fresnel = found["simulated"]
    assert text.splitlines()[fresnel["line"] - 1] == 'kind = "fresnel"' and fresnel["key"] == "effects[0].kind"
    assert "fresnel" not in by_kind(found["left_out"])


def test_what_the_command_line_asks_for_has_no_line():
    found = plan(load(THU, FEW | {"lens.index": 1.5}), THU.read_text(encoding="utf-8"), ["target.pixels", "lens.index"])
    assert found["simulated"][0]["asked_by"] == "--set lens.index" and found["simulated"][0]["line"] is None


def test_what_is_left_out_comes_with_estimates_the_largest_first(thu):
    found = by_kind(thu["left_out"])
    assert {"fresnel", "absorption", "dispersion", "source size", "ghost", "diffraction", "stray light"} == set(found)
    assert set(found) <= set(LEFT_OUT)
    known = [entry["rrmsd_change"] for entry in thu["left_out"] if entry["rrmsd_change"] is not None]
    assert known == sorted(known, reverse=True) and thu["left_out"][-1]["rrmsd_change"] is None
    assert all({"kind", "flux_change", "rrmsd_change", "blur_pixels"} <= set(entry) for entry in thu["left_out"])
    # two faces of PMMA at up to 40 degrees in the glass reflect 8 to 14 percent
    assert -0.14 < found["fresnel"]["flux_change"] < -0.075 and found["fresnel"]["blur_pixels"] == 0
    # 650 nm over 24 mm (a disc's 21 mm as a square) at 1 m, against 8.3 mm pixels
    assert found["diffraction"]["blur_pixels"] == pytest.approx(650e-6 * 980 / 21.3 / 8.33, rel=0.05)


def test_blur_grows_with_the_size_that_the_scene_states():
    disk = ROOT / "templates" / "disk.toml"

    def blur(**more):
        return by_kind(plan(load(disk, FEW | more), "")["left_out"])["source size"]

    small, large = blur(), blur(**{"source.real_diameter": 0.4})
    assert large["blur_pixels"] == pytest.approx(4 * small["blur_pixels"], rel=0.02)
    assert small["assumed"] and not large["assumed"] and "real_diameter" in large["detail"]


def test_without_a_material_nothing_is_known_of_it(thu):
    found = by_kind(plan(load(THU, FEW | {"lens.index": 1.49}), "")["left_out"])
    assert found["dispersion"]["rrmsd_change"] is None and "lens.index" in found["dispersion"]["detail"]
    assert found["absorption"]["flux_change"] is None
    assert found["fresnel"]["flux_change"] == pytest.approx(
        by_kind(thu["left_out"])["fresnel"]["flux_change"], rel=0.05
    )


def test_a_mirror_has_nothing_of_glass():
    found = by_kind(plan(load(ROOT / "templates" / "mirror.toml", FEW), "")["left_out"])
    assert {"reflectance", "shadows", "source size", "diffraction", "stray light"} == set(found)
    assert -0.2 < found["reflectance"]["flux_change"] < -0.02


def test_the_estimates_are_those_of_the_finished_lens(small_scene, small_design):
    """Within a factor of two: the coarse lens knows nothing of the finished one."""
    with np.load(small_design.folder / "design.npz") as design:
        picture = design["irradiance"]
    import bstcad

    lens = bstcad.open(small_design.folder).lens
    coarse = {entry.kind: entry for entry in left_out(small_scene, coarse_lens(small_scene), picture)}
    for entry in left_out(small_scene, lens, picture):
        for key, least in (("flux_change", 1e-3), ("rrmsd_change", 1e-3), ("blur_pixels", 0.01)):
            one, other = getattr(entry, key), getattr(coarse[entry.kind], key)
            assert (one is None) == (other is None)
            assert one is None or abs(one) < least or 0.5 < other / one < 2, (entry.kind, key)


def test_the_finest_detail_of_a_point_is_that_of_the_size_which_the_estimate_takes(small_design):
    """0.1 mm, 82 mm before the back (10 mm of PMMA count as 7), 475 mm off the target; a nearer has pixels as large."""
    found = small_design.report["finest_detail"]
    assert found["assumed"] and found["of"] == "a disc of 0.1 mm"
    assert found["source_image"] == pytest.approx(0.1 * 475 / 82, rel=0.05)
    assert found["distance"] == pytest.approx(475, abs=1) and found["nearer_distance"] is None


def test_fresnel_is_as_measured_on_the_finished_lens(small_scene, small_design):
    import bstcad

    lens, screen = bstcad.open(small_design.folder).lens, small_scene.target.screen
    with_it = load(ROOT / "templates" / "disk.toml", {})  # of the same kind of scene
    effects = type(with_it).model_validate(with_it.model_dump() | {"effects": [{"kind": "fresnel"}]}).effects
    on = small_scene.model_copy(update={"effects": effects})
    before, after = (tubes_picture(lens, s.channels(), screen, 257).sum() for s in (small_scene, on))
    with np.load(small_design.folder / "design.npz") as design:
        found = {entry.kind: entry for entry in left_out(small_scene, lens, design["irradiance"])}
    assert found["fresnel"].flux_change == pytest.approx(float(after / before - 1), rel=0.02)


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.stem)
def test_every_template_has_a_plan(path):
    scene = load(path, FEW)
    found = plan(scene, path.read_text(encoding="utf-8"))
    assert [item["what"] for item in found["simulated"]] == [words for words, _ in simulated(scene)]
    assert all(item["line"] for item in found["simulated"])
    assert any(entry["rrmsd_change"] for entry in found["left_out"])


def test_the_coarse_lens_sends_its_light_to_the_target():
    scene = load(THU, FEW)
    with torch.no_grad():
        picture = tubes_picture(coarse_lens(scene), scene.channels(), scene.target.screen, 129)
    assert float(picture.sum()) > 0.9


class TestCommand:
    def test_as_json(self, capsys):
        assert cli.run(["plan", str(THU), "--json", "--set", "target.pixels=48"]) == 0
        out, err = capsys.readouterr()
        found = json.loads(out)
        assert set(found) == {"predicted", "not_predicted", "finer", "notes", "simulated", "left_out"} and err == ""
        assert found["predicted"] is None and "target.pixels from 128 to 512" in found["not_predicted"]

    def test_predictions_as_json(self, capsys):
        few = ["--set", "target.pixels=128", "--set", "lens.back.control_points=65"]
        assert cli.run(["plan", str(THU), "--json", *few]) == 0
        found = json.loads(capsys.readouterr().out)
        assert set(found["predicted"]) == {"draft", "standard", "fine"} and found["not_predicted"] is None
        for each in (*found["predicted"].values(), *found["finer"]["predicted"].values()):
            assert set(each) == {"seconds", "rrmsd", "memory_gb"}
            assert all(0 < low < likely < high for low, likely, high in each.values())
        assert found["finer"]["control_points"] == 129

    def test_as_tables(self, capsys):
        assert cli.run(["plan", str(THU), "--set", "target.pixels=48"]) == 0
        out, _ = capsys.readouterr()
        assert (
            "vignetting by the outline" in out and "Fresnel reflection" in out and '[[effects]] kind = "fresnel"' in out
        )
        assert "not predicted" in out and max(map(len, out.splitlines())) <= 100

    def test_effects_are_shown_before_anything_is_predicted(self, capsys, monkeypatch):
        shown = []

        def outlook(scene, lens, units):
            shown.extend(capsys.readouterr())
            return forecast.Outlook(None, "the test ends here")

        monkeypatch.setattr(forecast, "outlook", outlook)
        assert cli.run(["plan", str(THU), "--set", "target.pixels=128"]) == 0
        out, err = shown
        assert "vignetting by the outline" in out and "Fresnel reflection" in out and "predicted" not in out
        assert err == "predicting seconds, RRMSD and memory …\n"
        assert "not predicted: the test ends here." in capsys.readouterr().out

    def test_predictions_as_a_table(self, capsys):
        few = ["--set", "target.pixels=128", "--set", "lens.back.control_points=65"]
        assert cli.run(["plan", str(THU), *few]) == 0
        out, _ = capsys.readouterr()
        assert "seconds" in out and "standard" in out and "129" in out

    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            (["none.toml"], "none.toml: no such scene file"),
            ([str(THU), "--set", "target.pixel=3"], "did you mean 'pixels'?"),
            ([str(THU), "--set", "lens.back.z=3"], "lens.back.z"),
            ([str(THU), "--sed"], "no such option"),
            ([], "missing argument 'SCENE'"),
            (
                [str(THU), "--set", "source.aperture.radius=1e-3", "--set", "target.x=[9000.0, 9400.0]"],
                "source: no ray",
            ),
        ],
    )
    def test_what_is_wrong_is_one_sentence(self, capsys, arguments, sentence):
        assert cli.run(["plan", *arguments]) == 2
        out, err = capsys.readouterr()
        assert sentence in err and err.splitlines()[-1].startswith("bstcad: ") and out == ""
