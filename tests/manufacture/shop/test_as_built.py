"""A back that is tailored anew to its blank as it was built: thickness, index and front as measured."""

from pathlib import Path

import numpy as np
import pytest
import torch

from bstcad import cli, commands
from bstcad.app import design_process
from bstcad.manufacture.shop import as_built
from bstcad.manufacture.shop.as_built import AsBuilt
from bstcad.optics.surfaces.surfaces import sag
from bstcad.optics.trace.measure import Effort
from bstcad.scene.errors import SceneError
from tests import suite
from tests.conftest import quick_effort


@pytest.fixture(scope="module")
def made(small_design):
    return commands.read(small_design.folder)


def rrmsd(made):
    return made.light(made.lens, made.goals[0], Effort(512, accuracy=0.02, witness=False)).rrmsd


def thickness(lens):
    return lens.back.vertex_z - lens.front.z


@pytest.mark.parametrize("key", suite.in_turns(["thickness", "index", "both", "curvature"], 4))
def test_the_back_is_tailored_to_the_blank(made, key):
    """A blank that spoils the picture by half or more has its picture back, on its new thickness, index or front."""
    thick, index = thickness(made.lens) + 1.0, made.scene.index + 0.01
    built = {
        "thickness": AsBuilt(thickness=thick),
        "index": AsBuilt(index=index),
        "both": AsBuilt(thickness=thick, index=index),
        "curvature": AsBuilt(front=0.0035),
    }[key]
    found = as_built.retailor(made, built)
    assert found.before > 1.5 * found.design and rrmsd(found.made) < 1.15 * rrmsd(made)
    lens = found.made.lens
    assert thickness(lens) == pytest.approx(built.thickness or thickness(made.lens), abs=1e-3)
    assert lens.index == pytest.approx(built.index or made.lens.index, abs=1e-12)
    assert float(lens.front.curvature) == pytest.approx(0.0035 if key == "curvature" else 0.002, abs=1e-15)


@suite.in_turn(1, 3)
def test_a_measured_front_becomes_the_front(made, tmp_path):
    """Points of a front with 3 µm of astigmatism, misplaced and noisy: the front of the new design has this form."""

    def error(x, y):
        return 3e-3 * (x**2 - y**2) / 16

    chance = np.random.default_rng(3)
    x, y = chance.uniform(-1, 1, (2, 20_000)) * np.array([[4.0], [3.0]])
    z = sag(made.lens.front, x, y) + error(x, y) + chance.normal(0.0, 2e-5, len(x))
    path = tmp_path / "front.csv"
    np.savetxt(path, np.column_stack([x, y, z + 0.01]), delimiter=",", header="x [mm],y [mm],z [mm]", comments="")
    found = as_built.retailor(made, AsBuilt(front=path))
    place = np.meshgrid(np.linspace(-3.8, 3.8, 30), np.linspace(-2.8, 2.8, 30))
    x, y = (part.ravel() for part in place)
    form = sag(found.made.lens.front, x, y) - sag(made.lens.front, x, y)
    off = form - error(x, y)
    columns = np.stack([np.ones_like(x), x, y], axis=1)
    off -= columns @ np.linalg.lstsq(columns, off, rcond=None)[0]
    assert np.abs(off).max() < 1e-4 and np.ptp(form) > 3e-3
    assert rrmsd(found.made) < 1.1 * rrmsd(made)


def test_a_melt_has_another_index_than_its_material(made):
    """A scene with a material keeps its dispersion; the difference of the melt is a key of its own."""
    scene = made.scene.changed({"lens.index": None, "lens.material": "PMMA"})
    melt = scene.changed({"lens.index_offset": 3e-4})
    for nm in (486.1, 587.6, 656.3):
        assert melt.lens.index_at(nm) - scene.lens.index_at(nm) == pytest.approx(3e-4, abs=1e-15)
    with pytest.raises(SceneError, match=r"lens\.index_offset: has no effect without lens\.material"):
        scene.changed({"lens.material": None, "lens.index": 1.5, "lens.index_offset": 3e-4})


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ("", "names nothing that differs"),
        ("thickness", "is not one of front, thickness, index with a value"),
        ("radius=3", "is not one of front, thickness, index with a value"),
        ("index=glass", "the value is not a finite number"),
        ("thickness=nan", "the value is not a finite number"),
        ("index=1.5,index=1.6", "index is given twice"),
    ],
)
def test_other_words_are_refused(given, why):
    with pytest.raises(SceneError, match=why):
        AsBuilt.parse(given)


def test_blanks_that_no_lens_can_have_are_refused(made):
    far = "--as-built index=9: differs from the"
    for built, why in ((AsBuilt(thickness=-1.0), "--as-built: lens.back.z"), (AsBuilt(index=9.0), far)):
        with pytest.raises(SceneError, match=why):
            as_built.as_built(made, built)
    with pytest.raises(SceneError, match="front: .*missing.csv"):
        as_built.as_built(made, AsBuilt(front=Path("missing.csv")))


@suite.in_turn(0, 3)
def test_the_command_writes_a_design_of_its_own(small_design, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(commands, "FULL", quick_effort())
    before = (small_design.folder / "design.npz").read_bytes()
    with pytest.raises(SystemExit) as ended:
        cli.main(["retailor", str(small_design.folder), "--as-built", "index=1.5", "-o", str(tmp_path / "new")])
    assert ended.value.code == 0 and "with the back tailored anew" in capsys.readouterr().out
    assert (small_design.folder / "design.npz").read_bytes() == before
    (run := tmp_path / "run").mkdir()  # the job of the page
    ended = design_process.retailor({"thickness": None, "index": 1.5}, run, tmp_path / "new", False)
    assert (ended.state, ended.folder, ended.passed) == ("finished", "new-as-built", True)
    again = commands.read(tmp_path / "new")
    assert again.scene.index == pytest.approx(1.5, abs=1e-12) and (tmp_path / "new" / "report.html").exists()
    assert bool(torch.isfinite(again.lens.back_net.heights).all())
