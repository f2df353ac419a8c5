"""A design in a script or a notebook: made, written, proved, opened again to the last bit, and shown."""

import json
import math
import os
import re
import shutil
import sys
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import bstcad
from bstcad import commands
from bstcad.manufacture.tolerance import tolerancing as tolerances
from bstcad.manufacture.tolerance.study import StudySettings
from bstcad.optics.trace.measure import Effort
from bstcad.optics.trace.trace import trace
from bstcad.optics.trace.tubes import rays_to
from bstcad.runs import files
from bstcad.step_text import part21
from bstcad.transport.mapping import nodes
from bstcad.verify import step_checks as step_checks
from tests import suite
from tests.conftest import draws_nothing, proofs, quick_effort, verify_with

FILES = {
    "lens.step", "lens.stl", "lens.3mf", "design.npz", "scene.toml", "report.html", "report.json", "prescription.txt",
    "report.junit.xml", "figures",
}  # fmt: skip


@pytest.fixture
def quick(monkeypatch):
    """No pictures and no data sheet; tubes and rays as many as made the small design."""
    draws_nothing(monkeypatch)
    verify_with(monkeypatch, quick_effort())


@pytest.fixture(scope="module")
def made(small_design):
    """The small scene's lens, nowhere written; designed from the path of a scene."""
    return bstcad.design(str(small_design.folder / "scene.toml"), progress=False, device="cpu")


@pytest.fixture
def fresh(made):
    """Forget the designs of earlier tests."""
    return bstcad.Design(made._made)


@pytest.fixture
def folder(small_design, tmp_path):
    return Path(shutil.copytree(small_design.folder, tmp_path / "small"))


def arrays(folder):
    with np.load(folder / "design.npz") as data:
        return {name: data[name] for name in data.files}


class TestDesign:
    def test_it_is_the_lens_that_the_command_line_makes(self, made, small_scene, small_design):
        kept = arrays(small_design.folder)
        assert made.scene == small_scene
        assert np.array_equal(made.lens.back.control_points(), kept["control_points"])
        assert np.array_equal(made.target, kept["target"])
        assert made.solid().isValid()

    def test_what_is_wrong_is_a_sentence(self, small_scene):
        with pytest.raises(bstcad.SceneError, match=r"none\.toml: no such scene file"):
            bstcad.design("none.toml")
        with pytest.raises(bstcad.SceneError, match="device: 'gpu' is not possible"):
            bstcad.design(small_scene, device="gpu")
        wrong = small_scene.model_copy(update={"lens": small_scene.lens.model_copy(update={"front": bstcad.Plane(99)})})
        with pytest.raises(bstcad.SceneError, match=r"lens\.back\.z: the lens is -74 mm thick"):
            bstcad.design(wrong)


def bumped(lens, by=2e-4):
    """The lens with a gentle wave on its back (mm)."""
    wave = torch.linspace(0, 6, lens.back.m, dtype=torch.float64).sin()
    return lens.with_back(replace(lens.back, heights=lens.back.heights + by * wave[:, None] * wave))


class TestOwnSurfaces:
    @suite.in_turn(2, 3)
    def test_another_lens_is_judged_and_written_as_what_it_is(self, made, quick, tmp_path):
        lens = bumped(made.lens)
        design = made.with_lens(lens)
        assert made.transport is not None and design.transport is None and "changed by hand" in repr(design)
        report = design.write(tmp_path / "own", progress=False)
        scene, effort = made.scene, Effort(1024, seed=5, witness=False)
        theirs, ours = (
            bstcad.measure(one, scene.channels(), scene.target.screen, made.target, effort).rrmsd
            for one in (made.lens, lens)
        )
        assert report.rrmsd == pytest.approx(ours, abs=3 * report.rrmsd_noise) and ours > 1.05 * theirs
        facts = report.facts
        assert [stage["name"] for stage in facts["stages"]] == ["write", "verify", "report"]
        assert facts["stopped"] == "by hand" and all(point["seconds"] < 600 for point in facts["history"])
        assert "changed by hand" in (tmp_path / "own" / "report.html").read_text()
        again = bstcad.open(tmp_path / "own")
        assert np.array_equal(again.lens.back.control_points(), lens.back.control_points())
        assert again.transport is None and again.verify(progress=False).rrmsd == report.rrmsd

    def test_heights_are_those_of_the_back_in_its_order(self, made):
        heights = made.lens.back.heights
        for given in (heights, heights.numpy(), heights.numpy().tolist(), heights.to(torch.float32).double()):
            back = made.with_heights(given).lens.back
            assert np.abs(back.control_points() - made.lens.back.control_points()).max() < 1e-6
        design = made.with_heights(bumped(made.lens).back.heights)
        assert torch.equal(design.lens.back.heights, bumped(made.lens).back.heights)
        assert design.lens.front == made.lens.front and design.scene == made.scene
        held = made.lens.with_clear((bstcad.Circle(1.0), bstcad.Circle(1.0)))  # by a mount that this scene lacks
        assert made.with_lens(held).lens.clear is None
        net = design.lens.back.control_points()
        assert np.array_equal(made.with_heights(net[..., 2] - made.lens.back.z).lens.back.control_points(), net)

    def test_front_and_number_of_control_points_go_into_the_scene(self, made):
        flat = made.with_heights(np.zeros((49, 49)))
        assert flat.scene.lens.back.control_points == 49
        assert flat.lens.back.x == pytest.approx((-4 * 48 / 44, 4 * 48 / 44))  # two of its spans past the rim
        oblong = made.with_heights(np.zeros((33, 32)))
        assert oblong.scene.lens.back.control_points == (33, 32) and oblong.lens.back.shape == (33, 32)
        other = made.with_lens(made.lens.with_front(bstcad.Conic(14.0, 0.004, -0.5)))
        assert other.scene.lens.front.surface == bstcad.Conic(14.0, 0.004, -0.5)
        assert other.scene.target == made.scene.target and torch.equal(other.lens.back.heights, made.lens.back.heights)

    WRONG = (
        (lambda d: d.with_lens(3), "with_lens: int is not possible; give a bstcad.Lens"),
        (
            lambda d: d.with_lens(replace(d.lens, outline=bstcad.Circle(3.0))),
            "outline is Circle.*in the scene it is Rectangle",
        ),
        (
            lambda d: d.with_lens(net(d, x=(-3.0, 4.0))),
            r"net along x \(mm\) is \(-3.0, 4.0\), and in the scene it is \(-4\.571\d+, 4\.571\d+\); give",
        ),
        (lambda d: d.with_heights(torch.full((33, 33), math.nan)), "back has heights that are not finite"),
        (
            lambda d: d.with_heights(np.zeros((33, 32, 1))),
            r"with_heights: numbers of shape \(33, 32, 1\) .*; give \(m, n\) numbers",
        ),
        (lambda d: d.with_heights(np.zeros((4, 4))), "control_points: 4 is not between 5 and 2049"),
        (lambda d: d.with_lens(d.lens.with_front(bstcad.Plane(26.0))), "the lens is -1 mm thick at its centre"),
    )

    @pytest.mark.parametrize(("change", "sentence"), WRONG)
    def test_a_lens_that_does_not_fit_is_a_sentence(self, made, change, sentence):
        with pytest.raises(bstcad.SceneError, match=sentence):
            change(made)


def net(design, **more):
    return design.lens.with_back(replace(design.lens.back, **more))


class TestTransport:
    @suite.in_turn(1, 3)
    def test_light_from_there_lands_where_the_map_says(self, made):
        """The finished lens traced: within a tenth of a pixel of 0.94 mm inside the lit disc."""
        sent, lens, source = made.transport, made.lens, made.scene.source
        assert sent.plane == "back"
        assert sent.source.shape == sent.target.shape == (65, 49, 2) and sent.source.dtype == np.float32
        x, y = torch.from_numpy(sent.source.astype(np.float64)).unbind(-1)
        x, y, _ = rays_to(source, lens, x, y)
        landed = trace(source.rays_through(x, y, lens.entrance.z, 1.0), lens, made.scene.target.screen.receiver)
        off = np.linalg.norm(np.stack(landed.position[:2], axis=-1) - sent.target, axis=-1)
        inside = np.linalg.norm(sent.target, axis=-1) < 18
        assert np.percentile(off[inside], 95) < 0.1 and sent.target[inside].std() > 5

    def test_it_comes_back_with_its_folder(self, made, folder):
        kept = bstcad.open(folder)
        for name in ("x", "y", "source"):
            assert np.array_equal(getattr(kept.transport, name), getattr(made.transport, name))
        assert kept.transport.plane == "back" and kept.transport.source.dtype == np.float32
        data = arrays(folder)
        assert {"transport_x", "transport_y", "transport_back"} < set(data)
        older = {name: value for name, value in data.items() if not name.startswith("transport")}
        np.savez(folder / "design.npz", **older)
        assert bstcad.open(folder).transport is None
        np.savez(folder / "design.npz", **older, transport_back=np.zeros(3), transport_x=0, transport_y=0)
        with pytest.raises(bstcad.SceneError, match=r"design\.npz: cannot be read .*transport"):
            bstcad.open(folder)

    def test_a_picture_of_many_pixels_has_few_places(self):
        """Both rims, and about as many pixels between all neighbours."""
        for pixels in (8, 256, 257, 4096):
            found = nodes(pixels)
            assert found[0] == 0 and found[-1] == pixels and len(found) == min(pixels + 1, 257)
            assert np.ptp(np.diff(found)) <= 1


class TestLeak:
    def test_light_in_the_dark_is_told_and_held_to_what_is_asked(self, made, quick):
        """The lens of a disc of 20 mm, held to one of 15 mm; the picture is smoothed, the leak is not."""
        small = {"target.outline": {"shape": "circle", "radius": 15.0}, "accept.rrmsd": 9.0}
        passed = {}
        for asked in (None, 1e-9):
            scene = made.scene.changed(small | {"accept.leak": asked})
            report = bstcad.Design(replace(made._made, scene=scene, goals=scene.goals)).verify(progress=False)
            dark = scene.target.irradiance() == 0
            share = report.irradiance[dark].sum() / report.irradiance.sum()
            assert report.leak == report.facts["leak"] == pytest.approx(share, rel=1e-4) and 0.3 < share < 0.5
            lit = report.irradiance[~dark].mean()
            assert report.contrast == pytest.approx(lit / report.irradiance[dark].mean(), rel=1e-4)
            [check] = [check for check in report.checks if check.id == "leak"]
            assert (check.value, check.limit) == (report.leak, asked)
            passed[asked] = report.passed
        assert passed == {None: True, 1e-9: False}


class TestWrite:
    def test_files_that_are_not_a_design_s_stay(self, fresh, tmp_path):
        (tmp_path / "letter.txt").write_text("dear")
        with pytest.raises(bstcad.SceneError, match="contains files that are not a design's; give a new folder"):
            fresh.write(tmp_path, progress=False)
        assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"] and fresh.folder is None

    @suite.in_turn(0, 3)
    def test_what_cannot_be_written_is_kept_and_opened_again(self, fresh, small_design, quick, tmp_path, monkeypatch):
        """Two designs do not take each other's place; a design that is written at last is kept no longer."""

        def full(*given, **more):
            raise OSError(28, "No space left on device", str(tmp_path / "out"))

        other = bstcad.Design(replace(fresh._made, lens=fresh.lens.with_back(fresh.lens.back.moved(25.5))))
        with monkeypatch.context() as broken:
            broken.setattr(commands.folders, "write_geometry", full)
            for design, name in ((fresh, "out-unwritten"), (other, "out-unwritten-2"), (fresh, "out-unwritten")):
                with pytest.raises(OSError, match="No space left") as raised:
                    design.write(tmp_path / "out", progress=False)
                assert f"is kept in {tmp_path / name}" in raised.value.__notes__[0]
        kept = bstcad.open(tmp_path / "out-unwritten")
        assert kept.report is None
        assert kept.write(tmp_path / "out", progress=False).rrmsd == small_design.report["rrmsd"]
        ours, theirs = arrays(tmp_path / "out"), arrays(small_design.folder)
        assert all(np.array_equal(ours[name], theirs[name]) for name in theirs)
        assert {path.name for path in tmp_path.iterdir()} == {"out", "out-unwritten-2"}

    def test_a_run_that_designs_into_the_folder_is_waited_for(self, fresh, tmp_path):
        with files.exclusive(tmp_path / "out"), pytest.raises(bstcad.SceneError, match="is in use by another run"):
            fresh.write(tmp_path / "out", progress=False)
        assert list(tmp_path.iterdir()) == [] and fresh.folder is None


class TestVerify:
    def test_a_design_without_files_is_proved_and_leaves_none(self, fresh, small_design, quick, tmp_path, monkeypatch):
        monkeypatch.setattr(commands.tempfile, "tempdir", str(tmp_path))
        kept = proofs(monkeypatch)
        report = fresh.verify(progress=False)
        assert list(tmp_path.iterdir()) == [] and fresh.folder is None and fresh.report is report
        assert report.passed is small_design.report["passed"] and report.rrmsd == small_design.report["rrmsd"]
        assert np.array_equal(report.irradiance, arrays(small_design.folder)["irradiance"])
        off = np.linalg.norm(report.irradiance - fresh.target) / np.linalg.norm(fresh.target)
        light = kept[0].light  # its picture has noise and is smoothed, RRMSD neither: a triangle of distances
        assert np.array_equal(report.irradiance, light.picture) and light.picture_error < 0.01
        assert abs(report.rrmsd - light.picture_error) <= off <= report.rrmsd + light.picture_error
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
        assert opened.report.passed and not opened.verify(progress=False, effort=Effort(64, 0, 65, 4096)).passed
        assert json.loads((folder / "report.json").read_text())["passed"] is False
        assert "failed: STEP text: every edge used twice, once each way" in repr(opened.report)

    @pytest.mark.parametrize("other", ["control_points", "target"])
    def test_the_files_of_another_design_are_not_taken_for_its_own(self, fresh, folder, quick, other):
        opened = bstcad.open(folder)
        kept = arrays(folder)
        if other == "target":
            text = (folder / "scene.toml").read_text()
            (folder / "scene.toml").write_text(text.replace("radius = 20.0", "radius = 19.0"))
        else:
            kept["control_points"] += 1e-9
        np.savez_compressed(folder / "design.npz", **kept)
        before = (folder / "report.json").read_bytes()
        with pytest.raises(bstcad.SceneError, match="the folder now contains another design"):
            opened.verify(progress=False)
        assert (folder / "report.json").read_bytes() == before


class TestJudged:
    """Judgements of a written design by a script, as the commands make them."""

    def test_an_unknown_judge_is_refused(self, folder):
        with pytest.raises(bstcad.SceneError, match="--against.*zemax"):
            bstcad.open(folder).verify(against=["zemax"], progress=False)

    def test_tolerances_are_those_of_the_command(self, folder, monkeypatch):
        asked, study = [], types.SimpleNamespace(facts=lambda: {"yield": [0, 1, 1]})
        monkeypatch.setattr(tolerances, "tolerance", lambda folder, settings: asked.append(settings) or study)
        opened = bstcad.open(folder)
        assert opened.tolerance(grade="precise", wanted=0.9, progress=False) == {"yield": [0, 1, 1]}
        default = StudySettings("precise", 0.9)
        assert (asked[0].grade, asked[0].wanted, asked[0].seed, asked[0].spread) == ("precise", 0.9, 0, default.spread)
        with pytest.raises(bstcad.SceneError, match="wanted: 90 is not between 0 and 1"):
            opened.tolerance(wanted=90, progress=False)
        with pytest.raises(bstcad.SceneError, match="give one of the two"):
            opened.tolerance(workers=2, scheduler="tcp://127.0.0.1:9", progress=False)

    def test_what_takes_files_says_so(self, fresh):
        for ask in (fresh.tolerance, fresh.show, lambda: fresh.verify(measured="cloud.csv")):
            with pytest.raises(bstcad.SceneError, match="has no files yet; write it to a folder"):
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
        """Heights z of blank and net that differ much: z + (net - z) is not the net, since its last bit is lost."""
        kept = arrays(folder)
        kept["control_points"][..., 2] = np.random.default_rng(0).uniform(0.01, 5.0, (33, 33))
        np.savez_compressed(folder / "design.npz", **kept)
        assert np.array_equal(bstcad.open(folder).lens.back.control_points(), kept["control_points"])

    def test_it_writes_the_same_design_again(self, folder, quick, tmp_path):
        """An earlier design in the folder is replaced, and nothing of it stays."""
        shutil.copytree(folder, tmp_path / "copy")
        (tmp_path / "copy" / "stale.txt").write_text("old")
        bstcad.open(folder).write(tmp_path / "copy", progress=False)
        assert {path.name for path in (tmp_path / "copy").iterdir()} == FILES
        assert {path.name for path in tmp_path.iterdir()} == {"small", "copy"}
        one, other = arrays(folder), arrays(tmp_path / "copy")
        assert all(np.array_equal(one[name], other[name]) for name in one)
        for name in ("lens.stl", "scene.toml"):  # the others tell the time
            assert (tmp_path / "copy" / name).read_bytes() == (folder / name).read_bytes()
        ours, theirs = (json.loads((place / "report.json").read_text()) for place in (tmp_path / "copy", folder))
        for key in ("history", "transport", "stopped", "twins", "machine", "passed"):
            assert ours[key] == theirs[key]
        assert ours["rrmsd"] == pytest.approx(theirs["rrmsd"], rel=1e-6)
        assert [stage["name"] for stage in ours["stages"]] == [stage["name"] for stage in theirs["stages"]]
        assert sum(stage["seconds"] for stage in ours["stages"]) <= ours["seconds_total"]

    def test_a_report_that_is_none_is_left_out(self, folder):
        edited = json.dumps(json.loads((folder / "report.json").read_text()) | {"verdict": "<script>"}).encode()
        for damage in (b"", b"{", b"[]", b'{"rrmsd": 0.1}', edited, None):
            (folder / "report.json").unlink()
            if damage is not None:
                (folder / "report.json").write_bytes(damage)
            assert bstcad.open(folder).report is None

    def test_what_is_no_design_is_a_sentence(self, folder, tmp_path):
        with pytest.raises(bstcad.SceneError, match="no such folder; give a design's folder"):
            bstcad.open(tmp_path / "none")
        with pytest.raises(bstcad.SceneError, match="no such scene file"):
            bstcad.open(tmp_path)

    @pytest.mark.parametrize(("value", "sentence"), [(np.nan, "not finite"), (0.0, "irradiance in this file is zero")])
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

    def test_in_a_notebook_with_the_picture(self, fresh):
        shown = fresh._repr_html_()
        assert "A &lt;small&gt; disc" in shown and shown.count("data:image/png;base64,iVBOR") == 1
        assert len(shown) > 10_000 and shown.startswith("<div>") and shown.endswith("</div>")


class TestProgress:
    """Bars where somebody looks; nothing in a pipe."""

    def test_in_a_terminal_and_in_a_pipe(self, small_scene, monkeypatch, capfd):
        if not hasattr(os, "openpty"):
            pytest.skip("no pseudo-terminals here")
        few = {"tailoring.rays": 32, "tailoring.rounds": 1, "tailoring.stage2_iterations": 1, "target.pixels": 16}
        scene = small_scene.changed(few)
        bstcad.design(scene)
        assert capfd.readouterr() == ("", "")
        ours, theirs = os.openpty()
        os.set_blocking(ours, False)
        with open(theirs, "w") as terminal:
            monkeypatch.setattr(sys, "stderr", terminal)
            bstcad.design(scene, progress=False)
            with pytest.raises(BlockingIOError):
                os.read(ours, 1)
            bstcad.design(scene)
            assert b"stage 1" in os.read(ours, 65536)
        os.close(ours)
