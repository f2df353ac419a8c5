"""The main job on a small design: what `generate` writes, and what `verify` says of it anywhere and however damaged."""

from __future__ import annotations

import json
import os
import re
import shutil
from concurrent.futures import BrokenExecutor, Future
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from PIL import Image

import bstcad
from bstcad import cli, commands
from bstcad.commands import ProofOptions
from bstcad.designs import folder as folders
from bstcad.optics.surfaces.bspline import knots
from bstcad.optics.trace.measure import Effort
from bstcad.planning.cold_run import round_numbers
from bstcad.report import report
from bstcad.report.record import Examined
from bstcad.scene.errors import MachineError, SceneError
from bstcad.scene.scene import load
from bstcad.verify import checks, jobs
from bstcad.verify import step_checks as step_checks
from tests import suite
from tests.conftest import draws_nothing, flat_pictures, pictures, quick_effort, verify_with

FILES = {
    "lens.step", "lens.stl", "lens.3mf", "design.npz", "scene.toml", "report.html", "report.json", "prescription.txt",
    "report.junit.xml", "figures", "datasheet.pdf",
}  # fmt: skip
KEYS = {  # DESIGN section 3
    "name", "verdict", "passed", "rrmsd", "rrmsd_tent", "rrmsd_noise", "light_on_target", "efficiency", "flux",
    "prescription", "seconds_total", "stages", "history", "checks", "effects", "machine", "versions", "seed",
}  # fmt: skip
JUDGED = (
    "verdict", "passed", "given_up", "rrmsd", "rrmsd_tent", "rrmsd_noise", "light_on_target", "efficiency", "flux",
    "rays_traced",
)  # fmt: skip
DESIGN_TIME = ("seconds_total", "stages", "history", "machine", "versions", "transport", "skipped_steps", "stopped")
PICTURE = b"\x89PNG\r\n\x1a\n"
POOR = Effort(64, places=65, points=4096, tubes=97)
HASTY = {  # settings by which anything is designed at once
    "tailoring.rays": 32, "tailoring.rounds": 1, "tailoring.stage2_iterations": 1, "target.pixels": 16,
}  # fmt: skip


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def quick(monkeypatch):
    """No pictures, no second process, few points; tubes and rays as many as made the small design."""
    monkeypatch.setattr(commands.processes, "submit", commands.processes.run_here)
    draws_nothing(monkeypatch)
    verify_with(monkeypatch, quick_effort())


def dying(*works):
    """A submit whose process dies over the functions whose names begin with one of `works`."""

    def submit(work, *arguments, **options):
        if not f"{work.__module__}.{work.__name__}".startswith(works):
            return commands.processes.run_here(work, *arguments, **options)
        broken = Future()
        broken.set_exception(BrokenExecutor("it died"))
        return broken

    return submit


@pytest.fixture
def folder(small_design, quick, tmp_path):
    """The small design, moved to another place."""
    return Path(shutil.copytree(small_design.folder, tmp_path / "elsewhere" / "moved design"))


@pytest.fixture
def poor(folder, monkeypatch):
    """Return the design verified with so few tubes that only its noise fails: fast, for checks that fail before."""
    verify_with(monkeypatch, POOR)
    return folder


@pytest.fixture(scope="module")
def proof(small_design):
    """The proof of the small design."""
    return checks.verify(small_design.folder, folders.read_nominal(small_design.folder), effort=quick_effort())


@pytest.fixture
def proved(folder, proof, monkeypatch):
    """Return the design, whoever proves it, for tests of later steps."""
    monkeypatch.setattr(checks, "verify", lambda *given, **more: proof)
    return folder


def run(capsys, *arguments):
    """(exit code, stdout, stderr without the lines of progress)."""
    code = cli.run([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return code, out, "".join(line for line in err.splitlines(keepends=True) if line.startswith(("bstcad", "Trace")))


class TestGenerate:
    def test_every_file_of_the_contract_is_there_and_nothing_beside(self, small_design):
        assert {path.name for path in small_design.folder.iterdir()} == FILES
        assert all(path.stat().st_size > 0 for path in small_design.folder.rglob("*"))

    def test_the_report_has_the_contracts_keys(self, small_design):
        read = json.loads((small_design.folder / "report.json").read_text())
        assert set(read) >= KEYS and set(read) == set(small_design.report)
        assert read["passed"] is True and all(check["passed"] for check in read["checks"])
        keys = {"name", "value", "limit", "unit", "passed", "where", "id"}
        assert all(set(check) == keys for check in read["checks"])
        assert read["version"] == read["versions"]["bstcad"] == bstcad.__version__
        assert read["name"] == "small" and read["seed"] == 0 and read["quality"] == "draft"
        assert 0 < 5 * read["rrmsd_noise"] <= read["rrmsd"] < 0.1 and 0 < read["rrmsd_tent"] < 0.1
        assert 0.99 < read["efficiency"] <= 1 and sum(read["flux"].values()) == pytest.approx(1.0, abs=1e-11)
        assert set(read["effects"]) == {"simulated", "left_out"} and read["effects"]["simulated"]
        assert read["rrmsd"] == pytest.approx(small_design.report["rrmsd"], rel=1e-11)

    def test_the_stages_and_the_history_are_told_in_order(self, small_design):
        found = small_design.report
        names = [stage["name"] for stage in found["stages"]]
        rounds = [f"stage 2, {tubes}² tubes" for tubes in (128, 171, 256)]
        assert names == ["loading", "stage 1", "float32 beside float64", *rounds, "write", "verify", "report"]
        seconds = [stage["seconds"] for stage in found["stages"]]
        assert min(seconds) >= 0 and sum(seconds) <= found["seconds_total"]
        times = [point["seconds"] for point in found["history"]]
        assert len(times) > 2 and times == sorted(times) and times[0] > 0 and times[-1] <= found["seconds_total"]
        after = {stage["name"]: stage["rrmsd"] for stage in found["stages"]}
        assert 0 < after[rounds[0]] < after["stage 1"] < 1 and after["verify"] == found["rrmsd"]
        assert after["loading"] is after["write"] is None

    def test_the_arrays_of_the_contract(self, small_design, small_scene, proof):
        with np.load(small_design.folder / "design.npz", allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        net, target, irradiance = (arrays[name] for name in ("control_points", "target", "irradiance"))
        assert net.shape == (33, 33, 3) and net.dtype == np.float64
        ends = 4 * 32 / 28, 3 * 32 / 28  # two spans past the rim
        assert net[:, 5, 0] == pytest.approx(np.linspace(-ends[0], ends[0], 33), abs=1e-12)  # x along the first axis
        assert net[5, :, 1] == pytest.approx(np.linspace(-ends[1], ends[1], 33), abs=1e-12)
        assert np.array_equal(arrays["knots_x"], knots(33)) and np.array_equal(arrays["knots_y"], knots(33))
        assert arrays["degree"] == 2 and arrays["front_curvature"] == 0.002
        assert target.shape == irradiance.shape == (48, 64)
        assert np.array_equal(target, small_scene.target.irradiance())
        assert irradiance.sum() == pytest.approx(target.sum(), rel=1e-12) and irradiance.min() >= 0
        off = np.linalg.norm(irradiance - target) / np.linalg.norm(target)
        value, noise = small_design.report["rrmsd"], proof.light.picture_error
        assert np.array_equal(irradiance, proof.light.picture) and noise < 0.01
        assert abs(value - noise) <= off <= value + noise  # the picture has noise and is smoothed, RRMSD neither
        assert str(arrays["scene"]) == (small_design.folder / "scene.toml").read_text() == small_scene.toml()
        assert load(small_design.folder / "scene.toml") == small_scene

    def test_the_meshes_are_the_same_closed_solid(self, small_design):
        stl = trimesh.load(small_design.folder / "lens.stl")
        other = trimesh.load(small_design.folder / "lens.3mf", force="mesh")
        for mesh in (stl, other):
            exact = small_design.report["shape"]["volume"]
            assert mesh.is_watertight and abs(mesh.volume - exact) < 1e-3 * mesh.area  # the mesh's tolerance

    def test_the_page_holds_its_pictures_and_says_what_is_missing(self, small_design):
        page = (small_design.folder / "report.html").read_text()
        names = {path.stem for path in (small_design.folder / "figures").iterdir()}
        assert {"irradiance", "cross_section", "surface", "side_view", "transport", "convergence"} <= names
        assert all(path.read_bytes().startswith(PICTURE) for path in (small_design.folder / "figures").iterdir())
        assert "lens" not in names and "No 3-D picture" in page  # the fixture draws none
        assert page.count("data:image/png;base64,") >= 6
        assert not re.search("https?:", re.sub(r"base64,[^\"]*", "", page))
        assert "A &lt;small&gt; disc" in page

    @suite.in_turn(1, 2)
    def test_a_picture_with_y_up_travels_with_its_design(self, quick, small_design, monkeypatch, tmp_path):
        """A PNG bright at the top: row 0 is y max; its copy lies next to scene.toml, and the folder is enough."""
        (tmp_path / "in").mkdir()
        grey = np.linspace(255, 60, 40)[:, None] * np.ones((1, 50))
        Image.fromarray(grey.astype(np.uint8)).save(tmp_path / "in" / "My photo.png")
        text = (small_design.folder / "scene.toml").read_text().replace("uniform = true", 'image = "My photo.png"')
        text = text.replace('\n[target.outline]\nradius = 20.0\nshape = "circle"\n', "")
        (tmp_path / "in" / "photo.toml").write_text(text)
        scene = load(tmp_path / "in" / "photo.toml", HASTY | {"tailoring.rounds": 2})
        made = commands.generate(scene, tmp_path / "out", device="cpu")
        copied = tmp_path / "out" / "My-photo.png"
        assert copied.read_bytes() == (tmp_path / "in" / "My photo.png").read_bytes()
        with np.load(tmp_path / "out" / "design.npz") as data:
            for picture in (data["target"], data["irradiance"]):
                assert picture[0].sum() > 3 * picture[-1].sum()
        shutil.rmtree(tmp_path / "in")
        moved = shutil.move(tmp_path / "out", tmp_path / "moved")
        assert load(moved / "scene.toml") == scene
        again = commands.verify(moved)
        assert (again.rrmsd, again.passed) == (made.rrmsd, made.passed)

    @suite.in_turn(2, 3)
    def test_a_failure_while_it_is_written_keeps_the_design_and_resume_writes_the_same(
        self, small_scene, quick, monkeypatch, tmp_path
    ):
        """One sentence names the folder; with --resume nothing is tailored again."""
        verify_with(monkeypatch, POOR)
        scene = small_scene.changed(HASTY)

        def fails(*given, **more):
            raise ValueError("lens: the back lies -0.2 mm above the front at (1, 2) mm; move the front down")

        with monkeypatch.context() as broken, pytest.raises(ValueError, match="move the front down") as raised:
            broken.setattr(report, "html", fails)
            commands.generate(scene, tmp_path / "out", device="cpu")
        kept, resumed = raised.value.__notes__
        assert f"the finished design is kept in {tmp_path / 'out-unwritten'}" in kept and "--resume" in resumed
        assert {path.name for path in tmp_path.iterdir()} == {".out.checkpoint", "out-unwritten"}
        found = commands.read(tmp_path / "out-unwritten").lens.back.control_points()
        monkeypatch.setattr("bstcad.designs.pipeline.PROCEDURES", {})  # whoever tailored would fail
        commands.generate(scene, tmp_path / "out", device="cpu", resume=True)
        assert [path.name for path in tmp_path.iterdir()] == ["out"]
        assert np.array_equal(commands.read(tmp_path / "out").lens.back.control_points(), found)

    def test_a_second_process_that_dies_over_the_solid_is_one_sentence(self, small_scene, quick, monkeypatch, tmp_path):
        monkeypatch.setattr(commands.processes, "submit", dying("bstcad.verify.jobs.write_lens"))
        with pytest.raises(MachineError) as broken:
            commands.generate(small_scene.changed(HASTY), tmp_path / "out", device="cpu")
        assert "--resume" in broken.value.__notes__[-1]
        assert {path.name for path in tmp_path.iterdir()} == {".out.checkpoint", "out-unwritten"}

    def test_a_second_process_that_dies_over_the_pictures_takes_only_them(self, proved, monkeypatch):
        dies = dying("bstcad.figures.figure_jobs", "bstcad.runs.processes.peak_memory")
        monkeypatch.setattr(commands.processes, "submit", dies)
        again = commands.verify(proved, options=ProofOptions(drawing=flat_pictures())).facts
        assert again["passed"] and "peak_memory_gb" in again["machine"]
        assert (proved / "report.html").is_file()

    def test_a_second_process_that_dies_over_the_file_says_so(self, folder, monkeypatch):
        monkeypatch.setattr(commands.processes, "submit", dying("bstcad.verify.jobs."))
        before = contents(folder)
        for path in (folder, folder / "lens.step"):
            with pytest.raises(SceneError, match=r"lens\.step: "):
                commands.verify(path)
        assert contents(folder) == before

    def test_a_second_process_that_does_not_end_over_the_file_is_stopped(self, folder, monkeypatch):
        """Within the limit, in a sentence that says what took how long."""

        def submit(work, *arguments, **options):
            hangs = work in (jobs.read_lens, jobs.check_lens, jobs.examine)
            return Future() if hangs else commands.processes.run_here(work, *arguments, **options)

        monkeypatch.setattr(commands.processes, "submit", submit)
        monkeypatch.setattr(commands.checks, "TIME_LIMIT", 0.1)
        monkeypatch.setattr(commands.checks, "TIME_LIMIT_PER_MB", 0.0)
        for path in (folder, folder / "lens.step"):
            with pytest.raises(SceneError, match=r"lens\.step: .* 0 s "):
                commands.verify(path)

    @suite.in_turn(0, 2)
    @suite.in_turn(1, 2)
    def test_the_3d_picture_is_drawn_where_the_machine_can(self, proved):
        commands.verify(proved, options=ProofOptions(drawing=pictures("solid")))
        page, drawn = (proved / "report.html").read_text(), proved / "figures" / "lens.png"
        assert drawn.exists() != ("No 3-D picture" in page)  # either it is there, or the page says that it is not
        assert not drawn.exists() or drawn.read_bytes().startswith(PICTURE)


class TestVerify:
    def test_a_moved_folder_gets_the_verdict_it_was_born_with(self, folder, small_design):
        """The folder keeps the facts that only its own run knows."""
        before = contents(folder)
        again = commands.verify(folder).facts
        for key in JUDGED:
            assert again[key] == small_design.report[key]
        for key in ("front", "back", "net", "index", "source", "targets"):
            told, known = (round_numbers(facts["prescription"][key], 14) for facts in (again, small_design.report))
            assert told == known  # the sum of a height and a plane is rounded once more on its way through the file
        for one, two in zip(again["checks"], small_design.report["checks"], strict=True):
            assert one["name"] == two["name"] and one["passed"] == two["passed"] and one["limit"] == two["limit"]
        assert set(again) == set(small_design.report)
        after = contents(folder)
        assert {name for name in after if not name.startswith("figures")} == FILES - {"figures"}
        for name in ("lens.step", "lens.stl", "lens.3mf", "design.npz", "scene.toml"):
            assert after[name] == before[name]
        told, first = (json.loads(files["report.json"]) for files in (after, before))
        assert all(told[key] == first[key] for key in DESIGN_TIME)
        assert told["history"] and told["seconds_total"] > 0

    def test_without_an_earlier_report_it_still_verifies(self, proved):
        for damage in (None, b"\xff\xfe", b'{"history": 1, "stages": 2}'):
            (proved / "report.json").unlink()
            if damage is not None:
                (proved / "report.json").write_bytes(damage)
            assert commands.verify(proved).history == ()
            assert set(json.loads((proved / "report.json").read_text())) >= KEYS

    def test_a_changed_file_changes_the_verdict_everywhere(self, poor, capsys):
        text = (poor / "lens.step").read_text()
        (poor / "lens.step").write_text(re.sub(r"(ORIENTED_EDGE\('',\*,\*,#\d+,)\.T\.", r"\1.F.", text, count=1))
        code, out, _ = run(capsys, "verify", poor)
        assert code == 1 and "FAILED" in out
        written = json.loads((poor / "report.json").read_text())
        assert written["passed"] is False and "FAILED" in (poor / "report.html").read_text()
        failed = {check["name"] for check in written["checks"] if not check["passed"]}
        assert "STEP text: every edge used twice, once each way" in failed
        suite = ElementTree.parse(poor / "report.junit.xml").getroot()[0]
        assert {case.get("name") for case in suite.iter("testcase") if case.find("failure") is not None} == failed

    DAMAGES = {
        "no scene": (lambda d: (d / "scene.toml").unlink(), "scene.toml: no such scene file"),
        "no step": (lambda d: (d / "lens.step").unlink(), "lens.step: cannot be read"),
        "no mesh": (lambda d: (d / "lens.stl").unlink(), "lens.stl: cannot be read"),
        "a truncated design": (lambda d: os.truncate(d / "design.npz", 9000), "design.npz: cannot be read"),
        "a truncated step": (lambda d: os.truncate(d / "lens.step", 90_000), "read as text: the file is truncated"),
        "a truncated mesh": (lambda d: os.truncate(d / "lens.stl", 90_000), "has 90000 bytes"),
        "step in metres": (
            lambda d: (d / "lens.step").write_text((d / "lens.step").read_text().replace(".MILLI.", "$")),
            "lens.step: read as text: its lengths are in metre",
        ),
        "a blank thinner than asked": (
            lambda d: (d / "scene.toml").write_text(
                (d / "scene.toml").read_text().replace("min_thickness = 0.5", "min_thickness = 11.0")
            ),
            "lens.min_thickness",
        ),
    }

    @pytest.mark.parametrize("damage", suite.in_turns(DAMAGES, 2))
    def test_what_cannot_be_read_is_one_sentence_and_changes_nothing(self, poor, capsys, damage):
        harm, sentence = self.DAMAGES[damage]
        harm(poor)
        before = contents(poor)
        code, out, err = run(capsys, "verify", poor)
        assert code == 2 and out == "" and sentence in err
        assert err.startswith("bstcad: ") and err.count("\n") == 1 and "Traceback" not in err
        assert contents(poor) == before

    def test_a_target_other_than_the_scenes_is_found_and_not_believed(self, folder, small_design):
        """The irradiance with 1 % noise in its place would pass by far."""
        with np.load(folder / "design.npz") as data:
            arrays = dict(data)
        noise = 1 + 0.01 * np.random.default_rng(0).standard_normal(arrays["target"].shape)
        np.savez(folder / "design.npz", **(arrays | {"target": arrays["irradiance"] * noise}))
        found = commands.verify(folder).facts
        assert found["rrmsd"] == small_design.report["rrmsd"]
        [failed] = [check for check in found["checks"] if not check["passed"]]
        assert failed["id"] == "target"
        off = np.abs(arrays["irradiance"] * noise - arrays["target"])
        row, column = np.unravel_index(off.argmax(), off.shape)
        assert failed["value"] == pytest.approx(off.max() / arrays["target"].max())
        assert failed["where"] == f"pixel ({column}, {row}), counted from the upper left"

    CHANGED_LIGHT = {
        "5 % brighter": lambda light: 1.05 * light,
        "two pixels beside": lambda light: np.roll(light, 2, axis=1),
        "10 % brighter at the right edge": lambda light: light * np.linspace(0.9, 1.1, light.shape[1]),
    }

    @pytest.mark.parametrize("change", suite.in_turns(CHANGED_LIGHT, 3))
    def test_an_irradiance_of_another_lens_is_found(self, folder, change):
        with np.load(folder / "design.npz") as data:
            arrays = dict(data)
        light = self.CHANGED_LIGHT[change](arrays["irradiance"])
        np.savez(folder / "design.npz", **(arrays | {"irradiance": light}))
        [failed] = [check for check in commands.verify(folder).facts["checks"] if not check["passed"]]
        assert failed["id"] == "irradiance"
        of_error = arrays.pop("irradiance_error")  # an earlier version did not store it
        np.savez(folder / "design.npz", **arrays)
        again = commands.verify(folder)
        assert 0 <= of_error < 0.05 and again.passed
        [found] = [check for check in again.checks if check.id == "irradiance"]
        assert found.limit < 0.05 and found.value < 0.2 * failed["value"]

    SWAPS = ("the whole folder", "one file", "the folder, by one that is no design")

    @pytest.mark.parametrize("swap", SWAPS)
    def test_a_design_that_comes_there_meanwhile_does_not_get_this_ones_verdict(
        self, folder, proof, capsys, monkeypatch, swap
    ):
        other = Path(shutil.copytree(folder, folder.with_name("other")))
        (other / "report.json").write_text("{}")
        places = []

        def meanwhile(*arguments, **effort):
            if swap == "one file":
                shutil.copy(other / "lens.stl", folder / "lens.stl")
                places.append(folder)
            else:
                folder.rename(folder.with_name("moved"))
                if swap == "the whole folder":
                    other.rename(folder)
                else:
                    folder.mkdir()
                places.extend((folder, folder.with_name("moved")))
            before.extend(contents(place) for place in places)
            return proof

        before: list = []
        monkeypatch.setattr(checks, "verify", meanwhile)
        code, out, err = run(capsys, "verify", folder)
        assert code == 2 and out == "" and err.count("\n") == 1
        assert "the design was replaced during this command, so nothing is written" in err
        assert [contents(place) for place in places] == before


class TestAFileByItself:
    def test_passes_with_what_it_is(self, small_design, tmp_path):
        path = Path(shutil.copy(small_design.folder / "lens.step", tmp_path / "part.step"))
        found = commands.verify(path)
        assert found.passed is True and found.name == "part" and len(found.checks) >= 7
        volume, mass = (float(found.part[key].split()[0]) for key in ("Volume", "Mass"))  # PMMA: 1.19 g/cm³
        assert mass == pytest.approx(1.19 * volume, rel=1e-3)
        assert "1.19 g/cm³ that the file states" in found.part["Mass"]
        assert list(tmp_path.iterdir()) == [path]  # looking writes nothing

    def test_in_a_design_s_folder_it_is_only_looked_at(self, small_design, capsys):
        """The folder stays as it is, byte by byte, also where a check of the design itself would fail."""

        def files():
            return {path: (path.stat().st_mtime_ns, path.is_file() and path.read_bytes())
                    for path in (small_design.folder, *small_design.folder.rglob("*"))}  # fmt: skip

        before = files()
        code, out, err = run(capsys, "verify", small_design.folder / "lens.step")
        assert all(value in out for value in ("8 × 6 × ", "convex, radius 500 mm", "15 mm before the vertex"))
        assert code == 0 and "PASSED" in out and "RRMSD" not in out and err == ""
        assert files() == before

    def test_another_kind_of_file_is_one_sentence(self, small_design, capsys):
        code, out, err = run(capsys, "verify", small_design.folder / "lens.stl")
        assert code == 2 and out == "" and "not a STEP file" in err and err.count("\n") == 1


def test_the_summary_of_a_report_without_light_shows_no_figures_of_it():
    alone = Examined("part", "part.step", "passed", True, (), {})
    assert report.first_figures(alone) == []
