"""A design in a script or a notebook: made, written, proved, opened again to the last bit, and shown."""

import json
import os
import re
import shutil
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch

import bstcad
from bstcad import commands, pipeline
from bstcad.optics.measure import Effort
from bstcad.runs import lock, progress
from bstcad.step_text import part21
from bstcad.tolerance import command as tolerances
from bstcad.tolerance.model import here
from bstcad.verify import step_checks as step_checks
from tests.conftest import verify_with
from tests.measured.synthetic import cloud

ROOT = Path(__file__).parent.parent
FILES = {
    "lens.step", "lens.stl", "lens.3mf", "design.npz", "scene.toml", "report.html", "report.json", "prescription.txt",
    "report.junit.xml", "figures", "datasheet.pdf",
}  # fmt: skip


@pytest.fixture
def quick(monkeypatch):
    """No 3-D picture, few points; tubes and rays as many as made the small design."""
    monkeypatch.setattr("bstcad.report.rendering.lens_picture", lambda mesh: None)
    verify_with(monkeypatch, Effort((384, 512), 512, places=65, points=4096))


@pytest.fixture(scope="module")
def made(small_scene):
    """The small scene's lens, nowhere written."""
    return bstcad.design(small_scene, progress=False, device="cpu")


@pytest.fixture
def fresh(made):
    """The same, with nothing known of earlier tests."""
    return bstcad.Design(made._made)


@pytest.fixture
def folder(small_design, tmp_path):
    return Path(shutil.copytree(small_design.folder, tmp_path / "small"))


def arrays(folder):
    with np.load(folder / "design.npz") as data:
        return {name: data[name] for name in data.files}


def some(handle):
    """What there is to read, nothing at the end; a terminal says so by an error."""
    try:
        return os.read(handle, 65536)
    except OSError:
        return b""


class TestDesign:
    def test_it_is_the_lens_that_the_command_line_makes(self, made, small_design):
        kept = arrays(small_design.folder)
        assert np.array_equal(made.lens.back.control_points(), kept["control_points"])
        assert np.array_equal(made.target, kept["target"])
        assert made.solid().isValid()

    def test_a_path_will_do(self, small_scene, small_design, made):
        again = bstcad.design(str(small_design.folder / "scene.toml"), progress=False)
        assert again.scene == small_scene
        assert torch.equal(again.lens.back.heights, made.lens.back.heights)

    def test_what_is_wrong_is_a_sentence(self, small_scene):
        with pytest.raises(bstcad.SceneError, match=r"none\.toml: no such scene file"):
            bstcad.design("none.toml")
        with pytest.raises(bstcad.SceneError, match="device: 'gpu' is not possible"):
            bstcad.design(small_scene, device="gpu")
        wrong = small_scene.model_copy(update={"lens": small_scene.lens.model_copy(update={"front": bstcad.Plane(99)})})
        with pytest.raises(bstcad.SceneError, match=r"lens\.back\.z: the lens is -74 mm thick"):
            bstcad.design(wrong)

    def test_plumbing_is_not_in_the_signature(self):
        import inspect

        assert list(inspect.signature(bstcad.design).parameters) == ["scene", "progress", "device"]

    def test_max_time_holds_until_it_is_written(self, small_scene, monkeypatch):
        """What writing and proving take is left over, as for the command line."""
        asked = {}
        monkeypatch.setattr(pipeline, "design", lambda scene, **more: asked.update(more) or 1 / 0)
        with pytest.raises(ZeroDivisionError):
            bstcad.design(small_scene.changed({"tailoring.max_time": 60.0}), progress=False)
        assert asked["reserve"] == commands.reserve(small_scene) > 0


class TestWrite:
    def test_the_folder_is_the_command_lines(self, fresh, small_design, quick, tmp_path):
        report = fresh.write(tmp_path / "out", progress=False)
        assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
        assert [path.name for path in tmp_path.iterdir()] == ["out"]
        for name in ("lens.stl", "scene.toml"):  # the others tell the time
            assert (tmp_path / "out" / name).read_bytes() == (small_design.folder / name).read_bytes()
        ours, theirs = arrays(tmp_path / "out"), arrays(small_design.folder)
        assert ours.keys() == theirs.keys() and all(np.array_equal(ours[name], theirs[name]) for name in ours)
        one, other = (
            json.loads((place / "report.json").read_text()) for place in (tmp_path / "out", small_design.folder)
        )
        assert one.keys() == other.keys() and one["rrmsd"] == other["rrmsd"]
        assert [s["name"] for s in one["stages"]] == [s["name"] for s in other["stages"]]
        assert sum(s["seconds"] for s in one["stages"]) <= one["seconds_total"]
        assert fresh.report is report and fresh.folder == tmp_path / "out"

    def test_an_earlier_design_gives_way_and_other_files_do_not(self, fresh, folder, quick, tmp_path):
        (tmp_path / "mine").mkdir()
        (tmp_path / "mine" / "letter.txt").write_text("dear")
        with pytest.raises(bstcad.SceneError, match="holds files that are not a design's; give a new folder"):
            fresh.write(tmp_path / "mine", progress=False)
        assert [path.name for path in (tmp_path / "mine").iterdir()] == ["letter.txt"] and fresh.folder is None
        (folder / "stale.txt").write_text("old")
        fresh.write(folder, progress=False)
        assert {path.name for path in folder.iterdir()} == FILES

    def test_a_run_that_designs_into_the_folder_is_waited_for(self, fresh, tmp_path):
        with lock.held(tmp_path / "out"), pytest.raises(bstcad.SceneError, match="is being designed by another run"):
            fresh.write(tmp_path / "out", progress=False)
        assert list(tmp_path.iterdir()) == [] and fresh.folder is None


class TestVerify:
    def test_a_design_without_files_is_proved_and_leaves_none(self, fresh, small_design, quick, tmp_path, monkeypatch):
        monkeypatch.setattr(commands.tempfile, "tempdir", str(tmp_path))
        report = fresh.verify(progress=False)
        assert list(tmp_path.iterdir()) == [] and fresh.folder is None and fresh.report is report
        assert report.passed is small_design.report["passed"] and report.rrmsd == small_design.report["rrmsd"]
        assert np.array_equal(report.irradiance, arrays(small_design.folder)["irradiance"])

    def test_the_record_is_frozen_and_says_what_the_report_says(self, fresh, quick):
        report = fresh.verify(progress=False)
        off = np.linalg.norm(report.irradiance - fresh.target) / np.linalg.norm(fresh.target)
        assert off == pytest.approx(report.rrmsd, rel=1e-12)
        assert sum(report.flux.values()) == pytest.approx(1.0, abs=1e-11)
        assert all(isinstance(check.passed, bool) and check.name for check in report.checks) and len(report.checks) > 15
        assert report.given_up == tuple(report.facts["given_up"])
        assert report.prescription["front"]["curvature"] == 0.002 and report.prescription["front"]["radius"] == 500
        assert "irradiance=" not in repr(report) and len(repr(report).splitlines()) == 1 + len(report.given_up)
        with pytest.raises(AttributeError):
            report.rrmsd = 0.0

    def test_one_with_files_is_proved_from_them(self, folder, quick):
        """A damaged edge in lens.step is seen, though the lens in memory is whole; the report there says so too."""
        opened = bstcad.open(folder)
        text = (folder / "lens.step").read_text()
        (folder / "lens.step").write_text(re.sub(r"(ORIENTED_EDGE\('',\*,\*,#\d+,)\.T\.", r"\1.F.", text, count=1))
        assert opened.report.passed and not opened.verify(progress=False).passed
        assert json.loads((folder / "report.json").read_text())["passed"] is False
        assert "failed: STEP text: every edge used twice, once each way" in repr(opened.report)

    @pytest.mark.parametrize("other", ["control_points", "front_curvature", "target"])
    def test_the_files_of_another_design_are_not_taken_for_its_own(self, fresh, folder, quick, other):
        opened = bstcad.open(folder)
        kept = arrays(folder)
        if other == "target":
            text = (folder / "scene.toml").read_text()
            (folder / "scene.toml").write_text(text.replace("radius = 20.0", "radius = 19.0"))
        else:
            kept[other] = kept[other] + 1e-9
        np.savez_compressed(folder / "design.npz", **kept)
        before = (folder / "report.json").read_bytes()
        with pytest.raises(bstcad.SceneError, match="holds another design by now"):
            opened.verify(progress=False)
        assert (folder / "report.json").read_bytes() == before

    def test_files_that_are_gone_are_no_hindrance(self, folder, quick):
        opened = bstcad.open(folder)
        shutil.rmtree(folder)
        assert opened.verify(progress=False).passed and not folder.exists()


class TestJudged:
    """What the commands say of a design that was written, a script may ask it for."""

    def test_a_made_part_is_judged(self, folder, quick, tmp_path):
        opened = bstcad.open(folder)
        np.savetxt(tmp_path / "cloud.csv", cloud(opened.lens, 5000, 1e-5), delimiter=",")
        report = opened.verify(measured=str(tmp_path / "cloud.csv"), progress=False)
        assert report.facts["measured"]["points"] > 4500 and report.facts["measured"]["rms"] < 2e-5
        with pytest.raises(bstcad.SceneError, match="--against zemax"):
            opened.verify(against=["zemax"], progress=False)

    def test_tolerances_are_those_of_the_command(self, folder, monkeypatch):
        asked = {}
        monkeypatch.setattr(tolerances, "tolerance", lambda *given, **more: asked.update(more) or {"yield": [0, 1, 1]})
        opened = bstcad.open(folder)
        assert opened.tolerance(grade="precise", wanted=0.9, progress=False) == {"yield": [0, 1, 1]}
        assert (asked["grade"], asked["wanted"], asked["seed"], asked["spread"]) == ("precise", 0.9, 0, here)
        with pytest.raises(bstcad.SceneError, match="wanted: 90 is not between 0 and 1"):
            opened.tolerance(wanted=90, progress=False)
        with pytest.raises(bstcad.SceneError, match="give one of the two"):
            opened.tolerance(workers=2, scheduler="tcp://127.0.0.1:9", progress=False)

    def test_it_is_drawn_as_the_command_draws_it(self, folder, monkeypatch, tmp_path):
        monkeypatch.setattr("bstcad.report.light_path.draw", lambda path, picture: bool(picture.write_bytes(b"drawn")))
        bstcad.open(folder).show(tmp_path / "light.png")
        assert (tmp_path / "light.png").read_bytes() == b"drawn"

    def test_what_takes_files_says_so(self, fresh):
        for ask in (fresh.tolerance, fresh.show, lambda: fresh.verify(measured="cloud.csv")):
            with pytest.raises(bstcad.SceneError, match="has no files yet, which that takes; write the design"):
                ask()


class TestOpen:
    def test_it_is_exact_from_its_files(self, folder, made, small_scene):
        opened, kept = bstcad.open(folder), arrays(folder)
        assert opened.scene == small_scene
        assert np.array_equal(opened.lens.back.control_points(), kept["control_points"])
        assert np.array_equal(opened.lens.back.control_points(), made.lens.back.control_points())
        assert opened.lens.front == made.lens.front and opened.lens.outline == made.lens.outline
        assert np.array_equal(opened.target, made.target)
        assert np.array_equal(opened.report.irradiance, kept["irradiance"])
        told = json.loads((folder / "report.json").read_text())
        assert opened.report.facts == told and opened.report.rrmsd == told["rrmsd"]
        net = part21.read(folder / "lens.step").surface.control_points
        assert np.allclose(net, kept["control_points"], rtol=0, atol=1e-11)  # mm; the digits that STEP has
        assert opened.solid().isValid()

    def test_a_net_far_below_its_blank_is_exact_too(self, folder):
        """Where z of the blank and of the net differ much, z + (net - z) is not the net: its last bit is lost."""
        kept = arrays(folder)
        kept["control_points"][..., 2] = np.random.default_rng(0).uniform(0.01, 5.0, (33, 33))
        np.savez_compressed(folder / "design.npz", **kept)
        assert np.array_equal(bstcad.open(folder).lens.back.control_points(), kept["control_points"])

    def test_it_writes_the_same_design_again(self, folder, quick, tmp_path):
        bstcad.open(folder).write(tmp_path / "copy", progress=False)
        one, other = arrays(folder), arrays(tmp_path / "copy")
        assert all(np.array_equal(one[name], other[name]) for name in one)
        assert (tmp_path / "copy" / "scene.toml").read_bytes() == (folder / "scene.toml").read_bytes()
        ours, theirs = (json.loads((place / "report.json").read_text()) for place in (tmp_path / "copy", folder))
        for key in ("history", "transport", "stopped", "twins", "machine", "passed"):
            assert ours[key] == theirs[key]
        assert ours["rrmsd"] == pytest.approx(theirs["rrmsd"], rel=1e-6)
        assert [stage["name"] for stage in ours["stages"]] == [stage["name"] for stage in theirs["stages"]]
        assert sum(stage["seconds"] for stage in ours["stages"]) <= ours["seconds_total"]

    @pytest.mark.parametrize("damage", [b"", b"{", b"[]", b'{"rrmsd": 0.1}', None])
    def test_a_report_that_is_none_is_left_out(self, folder, damage):
        (folder / "report.json").unlink()
        if damage is not None:
            (folder / "report.json").write_bytes(damage)
        assert bstcad.open(folder).report is None

    @pytest.mark.parametrize("key", ["verdict", "passed", "rrmsd", "light_on_target", "checks", "flux", "given_up"])
    @pytest.mark.parametrize("value", [None, "<script>", [[1]], {"a": "b"}, 1e9])
    def test_an_edited_report_is_left_out(self, folder, key, value):
        told = json.loads((folder / "report.json").read_text())
        (folder / "report.json").write_text(json.dumps(told | {key: value}))
        assert bstcad.open(folder).report is None

    def test_what_is_no_design_is_a_sentence(self, folder, tmp_path):
        with pytest.raises(bstcad.SceneError, match="no such folder; give a design's folder"):
            bstcad.open(tmp_path / "none")
        with pytest.raises(bstcad.SceneError, match="no such scene file"):
            bstcad.open(tmp_path)

    @pytest.mark.parametrize(("value", "sentence"), [(np.nan, "finite numbers"), (0.0, "its irradiance is none")])
    def test_an_irradiance_that_is_none_is_a_sentence(self, folder, value, sentence):
        kept = arrays(folder)
        kept["irradiance"][:] = value
        np.savez_compressed(folder / "design.npz", **kept)
        with pytest.raises(bstcad.SceneError, match=sentence):
            bstcad.open(folder)


class TestShown:
    def test_three_lines(self, fresh, folder):
        verified = bstcad.open(folder), f"passed with remarks, in {folder}"
        for shown, last in ((fresh, "as tailored; not verified yet"), verified):
            lines = repr(shown).splitlines()
            assert len(lines) == 3 and lines[0] == "Design 'small': A <small> disc" and lines[2].endswith(last)
            assert lines[1] == "  8 x 6 mm of PMMA (index 1.4906), 10 mm thick on the axis, 33 x 33 control points"
            assert re.match(r"  RRMSD 0\.0\d+", lines[2])

    @pytest.mark.parametrize("verified", [False, True])
    def test_in_a_notebook_with_the_picture(self, fresh, folder, verified):
        shown = (bstcad.open(folder) if verified else fresh)._repr_html_()
        assert "A &lt;small&gt; disc" in shown and shown.count("data:image/png;base64,iVBOR") == 1
        assert len(shown) > 10_000 and shown.startswith("<div>") and shown.endswith("</div>")

    def test_the_glance_is_close_to_what_is_verified(self, fresh, folder):
        glance, proved = fresh._irradiance(), bstcad.open(folder).report.irradiance
        assert np.linalg.norm(glance - proved) / np.linalg.norm(proved) < 0.02
        assert glance.sum() == pytest.approx(fresh.target.sum())


class TestProgress:
    """Bars where somebody looks; nothing in a pipe."""

    CODE = (
        "import bstcad\nfrom tests.conftest import DISK, SMALL\n"
        "d = bstcad.design(bstcad.load(DISK, SMALL | {'tailoring.stage2_iterations': 3}), progress=%s)\nprint(d)"
    )

    @pytest.mark.parametrize("wanted", [True, False])
    @pytest.mark.parametrize("terminal", [True, False])
    def test_in_a_terminal_and_in_a_pipe(self, wanted, terminal):
        if not hasattr(os, "openpty"):
            pytest.skip("no pseudo-terminals here")
        ours, theirs = os.openpty() if terminal else os.pipe()
        running = subprocess.Popen(
            [sys.executable, "-c", self.CODE % wanted], stdout=subprocess.PIPE, text=True, stderr=theirs,
            env=os.environ | {"TERM": "xterm", "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        os.close(theirs)
        said = b"".join(iter(lambda: some(ours), b"")).decode()
        printed = running.communicate()[0]
        os.close(ours)
        assert ("stage 1" in said) == (wanted and terminal) and (said == "") == (not (wanted and terminal))
        assert printed.startswith("Design 'small'") and "stage" not in printed and running.returncode == 0

    def test_in_a_notebook(self, monkeypatch):
        """As IPython's display does it: one cell, updated in place."""
        updates = []
        handle = types.SimpleNamespace(update=lambda data, raw: updates.append(data["text/html"]))
        with progress.cells(lambda *given, **more: handle, clock=iter(range(1000)).__next__) as report:
            report("stage 1", 1, 2, "RRMSD <0.5>")
            report("stage 1", 2, 2, "RRMSD 0.25")
            report("stage 2", 0, 0, "")
        assert updates[0].count("<tr>") == 1 and 'value="1"' in updates[0] and "RRMSD &lt;0.5&gt;" in updates[0]
        assert updates[-1].count("<tr>") == 2 and "RRMSD 0.25" in updates[-1]

    def test_a_notebook_is_known_by_its_kernel(self, monkeypatch):
        fake = types.ModuleType("IPython")
        fake.get_ipython = lambda: types.SimpleNamespace(kernel=None)
        shown = types.ModuleType("IPython.display")
        shown.display = print
        monkeypatch.setitem(sys.modules, "IPython", fake)
        monkeypatch.setitem(sys.modules, "IPython.display", shown)
        assert progress._notebook() is print
        fake.get_ipython = lambda: types.SimpleNamespace()  # IPython in a terminal
        assert progress._notebook() is None


def test_the_public_names_come_from_one_place():
    for name in bstcad.__all__:
        assert getattr(bstcad, name) is not None
    assert {
        "design",
        "open",
        "load",
        "Design",
        "Report",
        "Scene",
        "SceneError",
        "Target",
        "LensBlank",
        "Collimated",
    } <= set(bstcad.__all__)
