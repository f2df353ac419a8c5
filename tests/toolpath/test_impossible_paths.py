"""A kind of output.export that is not possible: refused before the design if that is known, else a remark."""

from dataclasses import replace

import pytest

from bstcad import commands
from bstcad.exports.exports import export
from bstcad.exports.toolpath_files import refuse_hopeless
from bstcad.figures.figure_jobs import NoPictures
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.runs.files import SceneError
from bstcad.scene.scene import load
from bstcad.toolpath.cutting import DEFAULTS, Cutting
from tests.conftest import quick_effort
from tests.scenes import DISK, SMALL
from tests.toolpath.test_simulated_shop import lens_of, waves

pytestmark = pytest.mark.usefixtures("few_samples")
PLATE = Rectangle(8.0, 6.0)
COARSE = Cutting(cusp=0.05, tolerance=0.002)


def steep(x, y):
    """A roof of 76 degrees, which a ball reaches and a nose does not."""
    return 4.0 * abs(x)


@pytest.mark.parametrize("kind", ["raster", "spiral"])
def test_a_radius_that_no_tool_has_is_refused_for_a_path_alone(kind):
    wide = {"lens.tool_radius": 5000.0}
    sentence = f'output.export: "{kind}" cuts with lens.tool_radius, and 5000 mm is not between 0.001 and 1000 mm'
    with pytest.raises(SceneError, match=sentence):
        load(DISK, SMALL | wide | {"output.export": ["sag", kind]})
    load(DISK, SMALL | wide | {"output.export": [kind], "lens.mould": True})  # the tool cuts the mould
    scene = load(DISK, SMALL | wide | {"output.export": ["sag"]})
    assert commands._cutting_of(scene, ["sag"]).tool_radius is None
    with pytest.raises(ValueError, match="tool_radius = 5000 mm is not possible"):
        commands._cutting_of(scene, [kind])
    assert commands._cutting_of(scene, [kind], Cutting(tool_radius=2.0)).tool_radius == 2.0


def test_a_path_that_is_too_long_is_refused_before_the_design(tmp_path):
    """A lathe's nose of 0.5 mm needs 14 µm per turn: 40 000 turns over a plate of 0.8 m with cells of 3 mm."""
    large = {
        "lens.outline": {"shape": "rectangle", "width": 800.0, "height": 800.0},
        "lens.front": {"kind": "plane", "z": 15.0}, "lens.back.control_points": 257,
        "source.position": [0.0, 0.0, -3000.0], "target.z": 3000.0,
    }  # fmt: skip
    with pytest.raises(SceneError, match='"spiral" is not possible: the path would have more than 20 million points'):
        commands.generate(load(DISK, SMALL | large | {"output.export": ["spiral"]}), tmp_path / "large", device="cpu")
    assert not list(tmp_path.iterdir())
    commands._refuse_exports(load(DISK, SMALL | large | {"output.export": ["raster", "tiles"]}))


def test_a_face_that_stays_steep_is_refused_before_the_design():
    lens = lens_of(steep, PLATE)
    with pytest.raises(ValueError, match=r"the face is [78]\d\.?\d* degrees steep, and a nose reaches 60 degrees"):
        refuse_hopeless("spiral", lens, DEFAULTS, ())
    refuse_hopeless("spiral", lens, DEFAULTS, ("back",))  # tailoring may change it
    refuse_hopeless("raster", lens, DEFAULTS, ())


def test_a_kind_that_fails_leaves_no_file_and_the_other_kinds_are_written(tmp_path):
    """The spiral over the back is written before that over the front fails."""
    folder, gentle = tmp_path / "kept", lens_of(waves, PLATE)
    both = gentle.with_front(replace(lens_of(steep, PLATE).back, z=-60.0))
    folder.mkdir()
    with pytest.raises(ValueError, match="degrees steep"):
        export(both, ["spiral"], tmp_path, cutting=COARSE)
    found = export(both, ["sag", "spiral", "cavity", "dxf"], folder, cutting=COARSE, strict=False)
    assert list(found.failures) == ["spiral", "cavity"] and "degrees steep" in found.failures["spiral"]
    assert [path.name for path in found.paths] == ["sag.csv", "outline.dxf"]
    assert sorted(folder.iterdir()) == sorted(found.paths)


def test_a_design_whose_path_fails_is_written_with_a_remark(small_design, tmp_path, monkeypatch):
    """The verdict is that of the checks, with remarks."""
    monkeypatch.setattr("bstcad.toolpath.raster.MAX_BALL_SLOPE", 0.01)
    made = commands.read(small_design.folder)
    made = replace(made, scene=made.scene.changed({"output.export": ["raster", "sag"]}))
    report = commands.write(made, tmp_path / "out", commands.ProofOptions(quick_effort(), NoPictures))
    assert report.passed and report.verdict == "passed with remarks" and report.remarks[-1] == "not-exported"
    assert report.given_up[-1].startswith('The files of "raster" in output.export are not written: the face is ')
    assert report.given_up[-1].endswith("on a machine with more axes.")
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"sag.csv", "lens.step", "report.html"} <= written and not [n for n in written if "toolpath" in n]
    assert commands.record.read(tmp_path / "out" / "report.json").remarks == report.remarks
    again = commands.verify(tmp_path / "out", commands.ProofOptions(quick_effort(), NoPictures))
    assert (again.remarks, again.given_up, again.verdict) == (report.remarks, report.given_up, report.verdict)
