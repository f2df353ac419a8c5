"""The cadquery scripts among the templates: each runs on a small design and writes valid solids."""

import runpy
import shutil
import sys
from pathlib import Path

import cadquery as cq
import pytest
import skimage
import torch

import bstcad
import bstcad.cad.plugin
from bstcad.api import Design
from bstcad.optics.trace.measure import Effort
from tests import suite
from tests.cad.test_trimming import occ_volume
from tests.conftest import draws_nothing, verify_with
from tests.efforts import designed_quickly
from tests.exact_volume import exact_volume

TEMPLATES = Path(__file__).parent.parent / "templates"


@pytest.fixture(scope="module")
def design(small_design, tmp_path_factory):
    """The small design, in a folder that a script may write to."""
    folder = tmp_path_factory.mktemp("scripts") / "small"
    shutil.copytree(small_design.folder, folder)
    return bstcad.open(folder)


def run(name, *arguments):
    """A script as `python templates/NAME ARGUMENTS` runs it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [name, *map(str, arguments)])
        return runpy.run_path(str(TEMPLATES / name), run_name="__main__")


def written(path):
    """The solids of a STEP file that a script wrote."""
    solids = cq.importers.importStep(str(path)).solids().vals()
    assert all(solid.isValid() for solid in solids)
    return solids


def test_a_lens_in_its_housing_with_its_led(design):
    made = run("housing.py", design.folder)
    solids = written(design.folder / "housing.step")
    assert len(solids) == 3
    lens, housing, led = (made[name] if name == "lens" else made[name].val() for name in ("lens", "housing", "led"))
    for one, other in ((lens, housing), (led, housing), (lens, led)):
        assert one.intersect(other).Volume() < 1e-6  # nothing is inside something else


def test_a_flange_is_one_with_the_lens(design):
    run("flanged_lens.py", design.folder)
    [part] = written(design.folder / "flanged_lens.step")
    assert part.Volume() > exact_volume(design.lens)


@suite.in_turn(1, 2)
def test_nine_lenses_on_a_plate(design):
    made = run("lens_array.py", design.folder)
    [part] = written(design.folder / "lens_array.step")
    plate = made["plate"].val().Volume() - 9 * design.lens.outline.area * 1.0
    assert occ_volume(part, 1e-5) == pytest.approx(9 * exact_volume(design.lens) + plate, rel=1e-5)


def test_the_insert_of_a_mould_is_the_negative_of_the_back(design):
    """Turned back and shrunk again, its face is the design's, control point for control point."""
    made = run("mould_insert.py", design.folder)
    [part] = written(design.folder / "mould_insert.step")
    scale = made["moulding"].factors[0]
    assert scale == pytest.approx(1 / 0.995)
    net = made["insert"].back.control_points()[:, ::-1] * (1, -1, -1) / scale
    assert abs(net - design.lens.back.control_points()).max() < 1e-12
    x, y = 1.5, -1.0
    top = max(p.z for p in _along_z(part, scale * x, -scale * y))
    back, _, _ = design.lens.back.plain().sag_and_slope(*_tensors(x, y))
    assert top == pytest.approx(-scale * float(back), abs=1e-7)


OTHER = {  # designs of other kinds than the lens for which the scripts were written, as changes of a template
    "plate": ("sun_caustic", {
        "lens.back.z": 1.5, "lens.min_thickness": 0.5, "target.image": None, "target.text": "A", "target.fit": None,
        **{f"{table}.{key}": {"shape": "rectangle", "width": 24.0, "height": 30.0}
           for table, key in (("source", "aperture"), ("lens", "outline"))},
        "target.x": [-12.0, 12.0], "target.y": [-15.0, 15.0], "target.z": 78.0,
    }),
    "round": ("disk", {"lens.outline": {"shape": "circle", "diameter": 10.0}}),
    "dome": ("dome_even", {}),
}  # fmt: skip
REFUSED = {("plate", "housing.py"): "has no place for an LED", ("dome", "mould_insert.py"): "use bstcad export"}
FEW = {  # settings that take no time
    "lens.back.control_points": 33, "target.pixels": 24, "tailoring.quality": "draft", "tailoring.rays": 64,
    "tailoring.transport_grid": 64, "tailoring.stage1_iterations": 100, "tailoring.rounds": 2,
    "tailoring.stage2_iterations": 4,
}  # fmt: skip


@pytest.fixture(scope="module", params=suite.in_turns(OTHER, 3))
def other(request, tmp_path_factory):
    """Kind and folder of a design of another kind."""
    template, changes = OTHER[request.param]
    folder = tmp_path_factory.mktemp("other") / request.param
    with pytest.MonkeyPatch.context() as patch:
        draws_nothing(patch)
        scene = bstcad.load(TEMPLATES / f"{template}.toml").changed({"name": request.param, **changes, **FEW})
        Design(designed_quickly(scene)).write(
            folder, progress=False, effort=Effort(64, places=65, points=1024, tubes=97)
        )
    return request.param, folder


@pytest.mark.parametrize(
    "script", suite.in_turns(["housing.py", "flanged_lens.py", "lens_array.py", "mould_insert.py"], 2)
)
def test_a_script_makes_a_part_of_any_design_or_says_why_not(other, script):
    kind, folder = other
    if words := REFUSED.get((kind, script)):
        with pytest.raises(SystemExit) as end:
            run(script, folder)
        assert str(end.value).startswith(f"{folder}: ") and words in str(end.value)
    else:
        run(script, folder)
        assert written(folder / script.replace(".py", ".step"))


@pytest.mark.parametrize("script", ["housing.py", "flanged_lens.py", "lens_array.py", "mould_insert.py"])
def test_a_script_without_a_design_ends_in_a_sentence(script, tmp_path):
    with pytest.raises(SystemExit) as end:
        run(script, tmp_path / "none")
    assert "none" in str(end.value) and "\n" not in str(end.value)


def test_a_folder_without_pictures_is_a_sentence(tmp_path):
    for arguments, words in (((), "give a scene"), (("a.toml", tmp_path, tmp_path), "has no picture")):
        with pytest.raises(SystemExit, match=words):
            run("picture_folder.py", *arguments)
    (tmp_path / "a.png").write_text("no picture")
    with pytest.raises(SystemExit, match=r"a\.png: .*disk"):
        run("picture_folder.py", TEMPLATES / "missing-disk.toml", tmp_path, tmp_path)


def test_the_wall_lies_between_the_rims(design):
    x, y = (torch.from_numpy(each) for each in design.lens.outline.rim_points())
    front, back = (face.plain().sag_and_slope(x, y)[0] for face in (design.lens.front, design.lens.back))
    assert design.wall == pytest.approx((float(front.max()), float(back.min())), abs=1e-3)


def _tensors(*values):
    return [torch.tensor([value], dtype=torch.float64) for value in values]


def _along_z(solid, x, y):
    """Return the heights (mm) at which a line along z at (x, y) meets a solid's faces."""
    line = cq.Edge.makeLine(cq.Vector(x, y, -1e3), cq.Vector(x, y, 1e3))
    return [v.Center() for v in solid.intersect(line).Vertices()]


def quick_scene(design, folder):
    """scene.toml of the small design in a folder, with a tailoring that takes no time."""
    few = {"tailoring.rays": 64, "tailoring.rounds": 2, "tailoring.stage2_iterations": 4, "target.pixels": 24}
    (folder / "scene.toml").write_text(design.scene.changed(few).toml(), encoding="utf-8")
    return folder / "scene.toml"


@pytest.fixture
def quick(monkeypatch):
    draws_nothing(monkeypatch)
    verify_with(monkeypatch, Effort(64, places=65, points=1024, tubes=97))


@suite.in_turn(0, 2)
def test_a_lens_for_each_picture_of_a_folder(design, quick, tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    for k, picture in enumerate((skimage.data.astronaut(), skimage.data.coffee()), start=1):
        skimage.io.imsave(tmp_path / "photos" / f"picture-{k}.png", picture[:400:16, :480:16])  # 30 x 25
    (tmp_path / "photos" / "notes.txt").write_text("no picture")
    run("picture_folder.py", quick_scene(design, tmp_path), tmp_path / "photos", tmp_path / "outputs")
    assert capsys.readouterr().out.count("valid") == 2
    assert all((tmp_path / "outputs" / f"picture-{k}" / "lens.step").exists() for k in (1, 2))


def test_lenses_on_a_workplane(design):
    """The plugin: lenses at the points of the stack, by themselves and as one with the body."""
    chain = cq.Workplane("XY").rarray(20, 20, 2, 1).lens(design)
    assert [solid.isValid() for solid in chain.vals()] == [True, True]
    apart = chain.vals()[1].Center() - chain.vals()[0].Center()
    assert apart.toTuple() == pytest.approx((20, 0, 0), abs=1e-9)
    base = cq.Workplane("XY", origin=(0, 0, design.lens.front.z + 1)).rect(40, 20).extrude(1)
    part = base.faces(">Z").workplane().rarray(20, 20, 2, 1).mounted(design)
    assert part.val().isValid()
    wanted = 2 * exact_volume(design.lens) + (40 * 20 - 2 * design.lens.outline.area) * 1
    assert occ_volume(part.val(), 1e-5) == pytest.approx(wanted, rel=1e-5)


def test_generate_lens_in_python(design, quick, tmp_path, capsys):
    """A script copies the function of generate_lens.py, with a setting changed."""
    made = runpy.run_path(str(TEMPLATES.parent / "generate_lens.py"))
    solid = made["generate_lens"](quick_scene(design, tmp_path), tmp_path / "lens", **{"target.z": 510.0})
    assert solid.isValid() and bstcad.open(tmp_path / "lens").scene.target.z == 510.0
    assert "RRMSD 0." in capsys.readouterr().out
