"""A scene with a ghost: written, proved; its share and its picture in the report."""

import json
from dataclasses import replace

import pytest

import bstcad
from bstcad import commands
from bstcad.cli import run
from bstcad.commands import ProofOptions
from bstcad.designs.folder import read_irradiances
from bstcad.figures.figure_jobs import NoPictures
from tests.conftest import pictures, proofs, quick_effort


@pytest.fixture(scope="module")
def design(small_design, tmp_path_factory):
    """(scene, folder, report) of the small design with a ghost."""
    folder, made = tmp_path_factory.mktemp("ghost") / "small", bstcad.open(small_design.folder)._made
    scene = made.scene.changed({"effects": [{"kind": "ghost"}]})
    made = replace(made, scene=scene)
    return scene, folder, commands.write(made, folder, ProofOptions(quick_effort(), pictures("light"))).facts


def test_the_ledger_has_a_line_for_it_and_closes(design):
    _, folder, report = design
    flux = json.loads((folder / "report.json").read_text())["flux"]
    assert flux == pytest.approx(report["flux"])
    assert sum(report["flux"].values()) == pytest.approx(1, abs=1e-12)
    enters = 1 - report["flux"]["missed the lens"]
    ghost = report["flux"]["ghost on target"] + report["flux"]["ghost off target"]
    assert 0 < report["flux"]["ghost on target"] <= ghost < 3e-3 * enters  # bare PMMA: 0.039² at normal incidence
    assert 0.06 * enters < report["flux"]["reflected at the faces"] < 0.09 * enters


def test_the_report_shows_it(design):
    _, folder, _ = design
    page = (folder / "report.html").read_text()
    assert "The picture includes a ghost" in page and "ghost on the target" in page
    assert (folder / "figures" / "ghost.png").stat().st_size > 1000


def test_the_same_design_proved_again_has_the_same_ghost(design, monkeypatch):
    scene, folder, report = design
    kept = proofs(monkeypatch)
    again = commands.verify(folder, options=ProofOptions(quick_effort(), NoPictures))
    assert again.flux == pytest.approx(report["flux"], abs=1e-12)
    assert again.rrmsd == pytest.approx(report["rrmsd"], abs=1e-12)
    [irradiance] = read_irradiances(folder, scene)
    assert kept[0].light.ghost.shape == irradiance.shape and 0 < kept[0].light.ghost.sum() < 0.01


def test_a_scene_without_one_has_no_picture_of_it(small_design):
    page = (small_design.folder / "report.html").read_text()
    assert "The picture includes a ghost" not in page and "ghost on target" not in page
    assert not (small_design.folder / "figures" / "ghost.png").exists()


def test_a_mirror_has_none(tmp_path, capsys):
    scene = "templates/mirror.toml"
    assert run(["generate", scene, "--set", 'effects=[{kind="ghost"}]', "-o", str(tmp_path / "mirror")]) == 2
    said = capsys.readouterr().err
    assert "effects[0]" in said and "ghost" in said and not (tmp_path / "mirror").exists()
