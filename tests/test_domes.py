"""A dome from its scene to its files and back; what does not go with a dome."""

import math
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import bstcad
from bstcad import commands
from bstcad.commands import ProofOptions
from bstcad.designs import pipeline
from bstcad.manufacture.tolerance import tolerancing
from bstcad.manufacture.tolerance.study import StudySettings
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.trace.measure import Effort
from bstcad.scene.errors import SceneError
from tests import suite
from tests.conftest import draws_nothing, pictures, verify_with
from tests.efforts import LITTLE

SCENE = """
name = "dome"
[source]
kind = "point"
position = [0.0, 0.0, 0.0]
profile = "lambertian"
[lens]
material = "PMMA"
front = { kind = "sphere", z = 8.0, curvature = -0.125 }
back = { kind = "radial", radius = 15.0, half_angle = 75.0, control_points = 33 }
[target]
z = 200.0
x = [-200.0, 200.0]
y = [-150.0, 150.0]
pixels = 24
uniform = true
[tailoring]
quality = "draft"
transport_grid = 32
rays = 64
stage2_iterations = 10
[accept]
light_on_target = 0.85
"""

MOUNT = """
[mount]
datum = "flange"
[mount.flange]
outline = { shape = "rectangle", width = 44.0, height = 38.0, corner_radius = 3.0 }
z = 1.0
thickness = 1.0
draft = 1.0
bevel = 0.2
screws = { count = 4, diameter = 2.2, circle = 40.0, first = 45.0 }
"""
EXPORTS = {
    "points": {"points-front.csv", "points-back.csv"},
    "sag": {"sag-polar.csv"},
    "dxf": {"outline.dxf"},
    "svg": {"outline.svg"},
    "preview": {"preview.glb", "preview.3mf"},
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("dome") / "dome.toml"
    path.write_text(SCENE)
    return bstcad.load(path)


@pytest.fixture(scope="module")
def designed(tmp_path_factory):
    """The report and the folder of the dome with a flange, which tests must not change."""
    path = tmp_path_factory.mktemp("designed")
    (path / "dome.toml").write_text(SCENE + MOUNT)
    scene = bstcad.load(path / "dome.toml")
    assert scene.lens.front.outline.radius == pytest.approx(np.sqrt(8.0**2 - 1.0))  # it ends in the flange's lower face
    options = ProofOptions(Effort(128, places=33, points=64, tubes=97), pictures("sheet"), tailoring=LITTLE)
    return commands.generate(scene, path / "out", device="cpu", options=options), path / "out"


@suite.in_turn(0, 2)
def test_a_dome_is_designed_written_and_proved_from_its_files(designed):
    """The files hold the dome and its part, its light passes the checks, and the opened folder has the same lens."""
    report, folder = designed
    assert report.passed, [check for check in report.checks if not check.passed]
    assert report.rrmsd < 0.05 and report.efficiency > 0.85
    assert report.flux["missed the lens"] == pytest.approx(1 / 64, abs=1e-3)  # 1 - sin² of the angle at the flange
    beside = np.cos(np.radians(75.0)) ** 2 - 1 / 64  # light between this angle and the rim of the dome
    assert report.flux["lost through the sides"] == pytest.approx(beside, abs=5e-3)
    again = bstcad.open(folder)
    assert isinstance(again.lens.back, RadialSurface)
    checks = {check.id: check for check in report.checks}
    assert {"part-written", "part-edges", "flange-light", "mount-cut"} - {*checks} <= {"part-written"}
    assert checks["mount-cut"].value == pytest.approx(0.0, abs=1e-9) and checks["flange-light"].value < 1e-3
    for kind, names in EXPORTS.items():
        paths = again.export(kind)
        assert {path.name for path in paths} == names and all(path.stat().st_size > 100 for path in paths)
    assert (folder / "datasheet.pdf").stat().st_size > 1000
    far = again._made.far_field
    leaving = report.flux["on target"] + report.flux["off target"]
    assert far.table(again.lens, rays=128).lumens == pytest.approx(1000.0 * leaving, rel=5e-3)  # ies, ldt and csv
    behind = far.rays(again.lens, 1 << 14)
    assert behind.flux == pytest.approx(leaving, rel=1e-2)
    for kind in ("zemax", "turning", "spiral", "raster", "heightmap"):
        with pytest.raises(SceneError, match=f'^export: "{kind}" is a \\w+ (of|over) heights .* write "sag"'):
            again.export(kind)
    with pytest.raises(SceneError, match=r'^export: "tiles" cuts .*, and lens.back is a dome; use lens.step$'):
        again.export("tiles")
    for change in (lambda: again.with_lens(again.lens),):
        with pytest.raises(SceneError, match="is not possible for a dome yet"):
            change()
    assert again.lens.back.shape == (33, 33) and again.report.rrmsd == pytest.approx(report.rrmsd)
    assert float(again.lens.back.at(*again.lens.back.heights.new_zeros(2, 1)).position[2]) == pytest.approx(
        15.0, abs=0.5
    )


@pytest.mark.parametrize(("change", "key"), [
    ({"lens.tool_radius": 3.0}, "lens.tool_radius"),
    ({"source.tilt": [0.0, 5.0]}, "source.tilt"),
    ({"lens.back.centre": [1.0, 0.0, 0.0]}, "lens.back.centre"),
    ({"lens.back.radius": 7.0}, "lens.back.radius"),
    ({"lens.front": {"kind": "toroid", "z": 8.0}}, "lens.front.kind"),
    ({"source": {"kind": "collimated", "aperture": {"shape": "circle", "radius": 5.0}}}, "source.kind"),
    ({"behind": [{"kind": "window", "z": 60.0, "thickness": 2.0, "index": 1.5,
                  "outline": {"shape": "circle", "diameter": 90.0}}]}, "behind"),
    ({"wavefront": {"kind": "plane", "z": 45.0}}, "wavefront"),
    ({"tailoring.method": "adam"}, "tailoring.method"),
    ({"output.export": ["dxf", "zemax"]}, "output.export"),
    ({"mount": {"rim": {"shape": "circle", "diameter": 20.0}}}, "mount.rim"),
    ({"mount": {"draft": 2.0}}, "mount.draft"),
    ({"mount": {"bevel": 0.1}}, "mount.bevel"),
    ({"mount": {"flange": {"outline": {"shape": "circle", "diameter": 40.0}, "z": 1.0, "thickness": 4.0}}},
     "mount.flange.thickness"),
])  # fmt: skip
def test_what_does_not_go_with_a_dome_is_refused_with_its_key(scene, change, key):
    with pytest.raises(SceneError, match=f"^{re.escape(key)}: [^\n]+$"):
        scene.changed(change)


def test_light_that_cannot_return_to_the_target_is_refused_before_the_design(scene):
    """One face of PMMA bends light by 43 degrees, to an exit angle of 85: light beyond the edge + 43 is lost."""
    sides = {"target.x": [-60.0, 60.0], "target.y": [-60.0, 60.0]}
    with pytest.raises(SceneError, match=r"^lens\.back\.half_angle: .* cannot reach a lit part") as refused:
        of = scene.changed({"lens.back.half_angle": 85.0, **sides})
        pipeline.reachable_part(of, of.goals[0])
    beyond = float(re.search(r"light, ([\d.]+) degrees", str(refused.value))[1])
    edge = math.degrees(math.atan(60.0 / 200.0))
    assert edge + 43.0 - 2.0 < beyond < edge + 43.0 + 8.0  # the sampled angles are 6 degrees apart
    of = scene.changed({"lens.back.half_angle": 57.0, **sides})
    assert pipeline.reachable_part(of, of.goals[0]) == (None, None)


def test_the_advice_for_two_targets_can_be_followed(scene):
    """A dome has one tailored face, and refuses a tailored front."""
    near = scene.targets[0].model_dump(exclude_none=True, exclude_defaults=True) | {"z": 2 * scene.targets[0].z}
    both = [scene.targets[0].model_dump(exclude_none=True, exclude_defaults=True), near]
    said = " ".join(scene.changed({"target": both, "wavefront": None}).warnings())
    assert "set the weights" in said and "bspline" not in said


def test_a_front_about_the_lamp_ends_at_the_half_angle(scene):
    """The sphere's rim is seen from the centre at the half angle, but for the margin."""
    x = scene.lens.front.outline.radius
    assert np.degrees(np.arcsin(x / 8.0)) == pytest.approx(75.0, abs=1e-3)


def test_changes_of_the_dome_move_the_outlines_that_the_scene_does_not_state(scene):
    """A larger half angle lights more of the front; a stated outline of the front stays."""
    wider = scene.changed({"lens.back.half_angle": 80.0})
    assert np.degrees(np.arcsin(wider.lens.front.outline.radius / 8.0)) == pytest.approx(80.0, abs=1e-3)
    assert wider.lens.outline.radius == pytest.approx(15.0 * np.sin(np.radians(80.0)))
    assert "outline" not in wider.toml()
    stated = scene.changed({"lens.front.outline": {"shape": "circle", "radius": 7.0}})
    assert stated.changed({"lens.back.half_angle": 70.0}).lens.front.outline.radius == 7.0


@pytest.mark.thorough
def test_the_tolerances_of_a_dome_are_studied(designed, tmp_path, monkeypatch):
    """A decentred lamp and a thicker dome change the light more than their sum of squares leaves the model."""
    folder = Path(shutil.copytree(designed[1], tmp_path / "out"))
    errors = ("source.decentre_x", "lens.thickness", "lens.index", "back.form")
    tables = "".join(f'[[tolerance]]\nname = "{name}"\ngrade = "moulded"\n' for name in errors)
    text = (folder / "scene.toml").read_text().replace("tolerance = []", "")
    (folder / "scene.toml").write_text(f'{text}\n[[tolerance]]\ngrade = "none"\n{tables}')
    study = tolerancing.tolerance(folder, StudySettings(tubes=65, trials=300, full=2))
    changes = {s.name: s.rrmsd_change for s in study.sensitivities}
    assert {name.split("_")[0] for name in changes} >= {"source.decentre", "lens.thickness", "lens.index"}
    assert any(name.startswith("back.form") for name in changes) and study.model_off["median"] < 0.1
    assert all(np.isfinite(each) for each in changes.values()) and (folder / "tolerance.json").is_file()


def _with_points(folder, change):
    """Change the control points (m, n, 3) of design.npz."""
    with np.load(folder / "design.npz") as found:
        arrays = dict(found)
    arrays["control_points"] = change(arrays["control_points"].copy())
    np.savez(folder / "design.npz", **arrays)


def _with_text(path, before, after):
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after, 1))


def _beside(points):
    points[5, 7, 0] += 1e-3
    return points


DAMAGES = {  # (change of the folder, the sentence)
    "a point beside its direction": (
        lambda f: _with_points(f, _beside), r"design\.npz: .*directions of a radial net by 0\.00\d+ mm; generate",
    ),
    "a distance that is no number": (lambda f: _with_points(f, lambda p: p * np.nan), r"not finite; generate"),
    "another half angle": (
        lambda f: _with_text(f / "scene.toml", "half_angle = 75.0", "half_angle = 70.0"), r"directions .*; generate",
    ),
    "another centre": (
        lambda f: _with_text(f / "scene.toml", "    0.0,\n]\nradius", "    0.5,\n]\nradius"),
        r"directions .*; generate",
    ),
    "a net of heights": (
        lambda f: _with_text(f / "scene.toml", 'kind = "radial"', 'kind = "bspline"'), r"lens\.back\.",
    ),
    "a file cut short": (lambda f: os.truncate(f / "lens.step", 20_000), r"lens\.step: "),
    "a pole beside its direction": (lambda f: _with_pole_moved(f / "lens.step"), r"lens\.step: .*no radial net"),
}  # fmt: skip


def _with_pole_moved(path):
    """Move a control point in the middle of the dome's net by a micrometre along x."""
    text = path.read_text()
    net = re.search(r"B_SPLINE_SURFACE_WITH_KNOTS\([^;]*|BOUNDED_SURFACE[^;]*", text)[0]
    number = re.findall(r"#\d+", net)[33 * 7 + 9]
    found = re.search(rf"\n{number} ?= ?CARTESIAN_POINT\('',\(([^,]*),", text)
    path.write_text(f"{text[: found.start(1)]}{float(found[1]) + 1e-3!r}{text[found.end(1) :]}")


@suite.in_turn(0, 2)
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_folder_of_a_dome_ends_in_one_sentence(designed, tmp_path, monkeypatch, damage):
    monkeypatch.setattr(commands.processes, "submit", commands.processes.run_here)
    draws_nothing(monkeypatch)
    verify_with(monkeypatch, Effort(64, places=17, points=33, tubes=97))
    folder, (change, sentence) = Path(shutil.copytree(designed[1], tmp_path / "out")), DAMAGES[damage]
    change(folder)
    with pytest.raises((SceneError, ValueError), match=sentence) as refusal:
        commands.verify(folder)
    assert str(refusal.value).isprintable()
