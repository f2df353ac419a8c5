"""Batches: a bad scene stops nothing, what is finished is not done again, where a design was made does not matter."""

import csv
import json
import shutil
import threading
import tomllib
from pathlib import Path

import distributed
import pytest

import bstcad
from bstcad import cli
from bstcad.designs.folder import scene_files
from bstcad.planning import batch
from bstcad.planning.batch import BatchScene, LocalPool
from bstcad.runs import environment, processes
from bstcad.runs.processes import ExitStatus
from bstcad.scene.errors import MachineError

KILLED, FAULT = ExitStatus(-9, 1.0, 1.0, ""), ExitStatus(70, 1.0, 1.0, "bstcad: this is a fault of bstcad")
NO_SOLID = ExitStatus(2, 1.0, 1.0, "bstcad: warning: doubtful\nbstcad: no solid; move the back\n")


class Designs:
    """Makes a copy of the small design, however the scene; of scenes by some names, what these come to."""

    def __init__(self, small_design):
        self.small, self.ends, self.made, self.lock = small_design.folder, {}, [], threading.Lock()

    def __call__(self, contents, folder, variables, tick=lambda: None):
        name = tomllib.loads(contents["scene.toml"].decode())["name"]
        with self.lock:
            self.made.append(name)
        end = self.ends.get(name, ExitStatus(0, 1.0, 1.0, ""))
        if end.code in (0, 1):
            shutil.copytree(self.small, folder, dirs_exist_ok=True)
        if end.code == 1:
            facts = json.loads((folder / "report.json").read_text())
            facts["checks"][0]["passed"] = False
            (folder / "report.json").write_text(json.dumps(facts | {"passed": False, "verdict": "failed"}))
        return end


@pytest.fixture
def designs(small_design, monkeypatch):
    found = Designs(small_design)
    monkeypatch.setattr(batch, "design", found)
    return found


@pytest.fixture
def scenes(small_scene, tmp_path):
    """Files of three scenes, and of one that is none."""
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.toml").write_text(small_scene.changed({"name": name}).toml())
    (tmp_path / "wrong.toml").write_text('name = "wrong"\nsouce = 1\n')
    return tmp_path


def run(scenes, *arguments):
    return cli.run(["batch", str(scenes / "*.toml"), "-o", str(scenes / "out"), *arguments])


def told(scenes):
    return {row["name"] or Path(row["scene"]).stem: row for row in facts(scenes)}


def facts(scenes):
    return json.loads((scenes / "out" / "batch.json").read_text())["designs"]


def test_one_bad_scene_stops_nothing(scenes, designs, capsys):
    designs.ends = {"b": ExitStatus(1, 1.0, 1.0, ""), "c": NO_SOLID}
    assert run(scenes, "--workers", "2") == 2
    rows = told(scenes)
    assert {name: row["status"] for name, row in rows.items()} == {
        "a": json.loads((designs.small / "report.json").read_text())["verdict"],
        "b": "failed",
        "c": "refused",
        "wrong": "refused",
    }
    out, err = (" ".join(text.split()) for text in capsys.readouterr())
    assert "no solid; move the back" in out and "souce" in out and "report.html" in out
    a, b = (Path(rows[name]["scene"]) for name in ("a", "b"))
    checks = json.loads((scenes / "out" / "b" / "report.json").read_text())["checks"]
    assert out.startswith(f"{rows['a']['status'].upper()} RRMSD {rows['a']['rrmsd']:.4f} ")
    assert f"FAIL {b}: {checks[0]['name']}: " in out and checks[1]["name"] not in out and f"FAIL {a}" not in out
    assert "3 designs, 2 at a time on this machine, each with up to" in err
    assert len(rows["b"]["checks_failed"]) == 1 and rows["a"]["rrmsd"] == rows["b"]["rrmsd"] > 0
    lines = list(csv.DictReader((scenes / "out" / "batch.csv").open()))
    assert [line["status"] for line in lines] == [row["status"] for row in facts(scenes)]
    assert all((scenes / "out" / line["report"]).is_file() for line in lines if line["rrmsd"])
    assert sorted(path.name for path in (scenes / "out").iterdir()) == ["a", "b", "batch.csv", "batch.json"]


def test_a_damaged_report_is_a_sentence(scenes, designs, tmp_path):
    """A design whose report.json is damaged is broken; a later summary that needs the report is refused."""
    (scenes / "wrong.toml").unlink()
    designs.small = shutil.copytree(designs.small, tmp_path / "damaged")  # the other tests need it whole
    report = designs.small / "report.json"
    report.write_text(report.read_text()[:500])
    assert run(scenes) == 1
    rows = told(scenes)
    assert {row["status"] for row in rows.values()} == {batch.BROKEN}
    assert all("run bstcad verify to write it again" in row["reason"] for row in rows.values())
    failed = batch.BatchEntry(scene="a.toml", name="a", checks_failed=("a check",))
    with pytest.raises(MachineError, match="cannot be read .*; run bstcad verify"):
        batch.summary([failed], scenes / "out")


@pytest.mark.parametrize(("end", "code"), [(None, 0), (FAULT, 1)])
def test_the_exit_code_is_of_the_worst(scenes, designs, end, code):
    (scenes / "wrong.toml").unlink()
    designs.ends = {"b": end} if end else {}
    assert run(scenes) == code


def test_what_is_finished_is_not_done_again(scenes, small_scene, designs, monkeypatch):
    (scenes / "wrong.toml").unlink()
    designs.ends = {"b": FAULT, "c": ExitStatus(1, 1.0, 1.0, "")}
    assert run(scenes) == 1
    first = told(scenes)
    designs.made.clear()
    designs.ends = {}
    assert run(scenes) == 1 and designs.made == ["b"]  # c has its lens, and that still fails
    assert told(scenes)["a"] == first["a"] and told(scenes)["c"] == first["c"]
    assert json.loads((scenes / "out" / "batch.json").read_text())["version"] == bstcad.__version__
    designs.made.clear()
    (scenes / "a.toml").write_text(small_scene.changed({"name": "a", "target.z": 301.0}).toml())
    (scenes / "out" / "b" / "design.npz").write_bytes(b"of another run")
    shutil.rmtree(scenes / "out" / "c")
    assert run(scenes, "--workers", "1") == 0 and designs.made == ["a", "b", "c"]
    designs.made.clear()
    assert cli.run(["batch", str(scenes / "a.toml"), "-o", str(scenes / "out")]) == 0 and not designs.made
    assert [row["name"] for row in facts(scenes)] == ["a", "b", "c"]  # of earlier batches too
    monkeypatch.setattr(environment, "version", lambda: "another")
    assert run(scenes, "--workers", "1") == 0 and designs.made == ["a", "b", "c"]


@pytest.mark.parametrize("damage", [b"", b'{"designs": [{"name": "a"}]}'])
def test_a_damaged_record_is_a_sentence(tmp_path, damage):
    assert batch.read(tmp_path) == ()
    (tmp_path / "batch.json").write_bytes(damage)
    with pytest.raises(MachineError, match="batch.json: .*; remove it"):
        batch.read(tmp_path)


def test_a_batch_that_is_stopped_goes_on(scenes, designs, monkeypatch, capsys):
    (scenes / "wrong.toml").unlink()
    answers, asked = LocalPool.next, []

    def stopped(self, tick):
        asked.append(self)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return answers(self, tick)

    monkeypatch.setattr(LocalPool, "next", stopped)
    assert run(scenes, "--workers", "1") == 130
    assert "1 of 3 designs are finished in" in capsys.readouterr().err
    assert told(scenes)["a"]["rrmsd"] and told(scenes)["c"]["status"] == "not done"
    monkeypatch.setattr(LocalPool, "next", answers)
    assert run(scenes, "--workers", "1") == 0
    assert designs.made.count("a") == 1 and designs.made[-2:] == ["b", "c"]


def test_a_design_made_elsewhere_is_the_same(scenes, designs, small_design):
    (scenes / "wrong.toml").unlink()
    designs.ends = {"c": NO_SOLID}
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
    ) as local:
        assert run(scenes, "--scheduler", local.scheduler_address) == 2
    for name in ("a", "b"):
        assert tree(scenes / "out" / name) == tree(small_design.folder)
        assert told(scenes)[name]["where"].startswith("inproc://")
    assert told(scenes)["c"]["reason"] == "no solid; move the back" and not (scenes / "out" / "c").exists()


def tree(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_two_scenes_do_not_share_a_folder(small_scene, tmp_path, designs):
    (tmp_path / "out" / "small").mkdir(parents=True)
    (tmp_path / "out" / "small" / "letter.txt").write_text("dear")
    wanted = [BatchScene("a.toml", small_scene), BatchScene("b.toml", small_scene)]
    reasons = [row.reason for row in batch.batch(wanted, tmp_path / "out")]
    assert "contains files that are not a design's" in reasons[0] and "is also the name of a.toml" in reasons[1]
    assert batch.batch([], tmp_path / "out") == [] and not designs.made


def test_a_design_that_was_killed_goes_on_once(small_scene, tmp_path, monkeypatch):
    asked = []
    ends = [KILLED, ExitStatus(0, 2.0, 2.0, "")]
    monkeypatch.setattr(processes, "run", lambda words, **more: asked.append(words) or ends[len(asked) - 1])
    contents = scene_files(small_scene)
    ended = batch.design(contents, tmp_path / "d", {})
    assert ended.code == 0 and ended.seconds == 3.0 and len(asked) == 2
    assert "--resume" not in asked[0] and asked[1] == [*asked[0], "--resume"]
    asked.clear()
    ends[1] = KILLED
    monkeypatch.setattr(batch, "_has_checkpoint", lambda scene, folder: True)
    assert batch.design(contents, tmp_path / "d", {}).code == -9
    assert len(asked) == 2 and asked[0][-1] == asked[1][-1] == "--resume"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["none*.toml"], "none*.toml: matches no file; give scene files"),
        (["a.toml", "--workers", "1", "--scheduler", "tcp://127.0.0.1:9"], "give one of the two"),
        (["a.toml", "-o", "a.toml"], "a.toml: is a file; give another folder with -o"),
        (["a.toml", "--set", "x"], "--set x: has no value"),
    ],
)
def test_wrong_input_is_one_sentence(scenes, designs, capsys, monkeypatch, arguments, sentence):
    monkeypatch.chdir(scenes)
    assert cli.run(["batch", *arguments]) == 2
    assert sentence in capsys.readouterr().err and not designs.made
