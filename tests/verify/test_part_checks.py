"""part.step, the lens in its mount: written with the design, proved from the file, and found out where it is wrong."""

import hashlib
import re
from dataclasses import replace

import cadquery
import numpy as np
import pytest
from OCP.BRepGProp import BRepGProp
from OCP.GProp import GProp_GProps

import bstcad
from bstcad import commands
from bstcad.cad import mounting, step_reading
from bstcad.commands import ProofOptions
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.report.prescription import part
from bstcad.scene.errors import SceneError
from bstcad.step_text import part21
from bstcad.verify import step_checks
from tests import suite
from tests.conftest import draws_nothing, quick_effort

MOUNT = {
    "datum": "flange",
    "flange": {
        "outline": {"shape": "rectangle", "width": 18.0, "height": 14.0, "corner_radius": 2.0},
        "z": 17.0,
        "thickness": 2.0,
        "screws": {"count": 2, "diameter": 2.2, "circle": 13.0, "first": 0.0},
        "draft": 1.0,
        "bevel": 0.2,
    },
}


@pytest.fixture(scope="module")
def design(small_design):
    return bstcad.open(small_design.folder)


@pytest.fixture(scope="module")
def written(design, tmp_path_factory):
    """(the scene with a mount, its folder, what report.json holds)."""
    folder = tmp_path_factory.mktemp("mounted") / "small"
    scene = design.scene.changed({"mount": MOUNT})
    with pytest.MonkeyPatch.context() as patch:
        draws_nothing(patch)
        report = commands.write(replace(design._made, scene=scene), folder, ProofOptions(quick_effort()))
    return scene, folder, report.facts


def of_part(report):
    return [check for check in report["checks"] if check["name"].startswith("part.step")]


def test_a_design_with_a_mount_has_its_part_and_the_proof_of_it(written):
    scene, folder, report = written
    assert len(of_part(report)) == 19 and all(check["passed"] for check in of_part(report))
    assert bstcad.open(folder).part().isValid()


def test_what_is_sent_is_the_part_by_its_digest_volume_mass_and_size(written, design):
    """The file's own statements by a reader that is not OCC, and OCC's box of the solid, within the walls' 1e-6 mm."""
    scene, folder, report = written
    data, order = (folder / "part.step").read_bytes(), report["order"]
    [volume] = part21.read_lens(folder / "part.step").properties.volumes
    assert (order["file"], order["sha256"]) == ("part.step", hashlib.sha256(data).hexdigest())
    assert order["volume"] == pytest.approx(volume, rel=1e-6) and order["volume"] > 1.2 * report["shape"]["volume"]
    assert order["mass"] == pytest.approx(1.19e-3 * volume, rel=1e-6)
    box = bstcad.open(folder).part().BoundingBox(1e-4)
    assert order["size"] == pytest.approx((box.xlen, box.ylen, box.zlen), abs=0.02)
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert order["sha256"] in page and f"{order['mass']:.4g} g (1.19 g/cm³)" in page
    assert (order["datum"], order["origin"]) == ("the lower face of the flange", MOUNT["flange"]["z"])


@pytest.mark.parametrize("harm, words", suite.in_turns([
    ("missing", "generate the design again"),
    ("bent", "control point"),
    ("lighter", "the file states 9"),
    ("steeper", "edge at ("),
], 2))  # fmt: skip
def test_a_part_that_is_not_the_design_s_fails_by_name(written, design, tmp_path, harm, words):
    scene, folder, _ = written
    text = (folder / "part.step").read_text()
    if harm == "bent":
        bent = design.lens.back.control_points()
        bent[5, 7, 2] += 1e-9
        lens = design.lens.with_back(bstcad.BSplineSurface.from_control_points(bent, design.lens.back.z))
        mounting.write_if_it_fits(lens, scene.mount, tmp_path / "part.step", "bent", scene.part)
    elif harm == "lighter":
        (tmp_path / "part.step").write_text(re.sub(r"(?<=VOLUME_MEASURE\()\s*[-+.E\d]+", "900.0", text))
    elif harm == "steeper":  # a part of another mount, with walls that hardly differ
        other = design.scene.changed({"mount": MOUNT | {"flange": MOUNT["flange"] | {"draft": 1.001}}}).mount
        mounting.write_if_it_fits(design.lens, other, tmp_path / "part.step", "other", scene.part)
    said = scene.part.of(scene.lens)
    failed = [check for check in step_checks.check_part(tmp_path, design.lens, scene.mount, said) if not check.passed]
    assert len(failed) == 1 and words in failed[0].where


def test_a_flange_that_cuts_the_rim_leaves_the_lens_and_says_why(design, tmp_path):
    sags = design.lens.back.z + np.array(design.lens.back.sags(design.lens.outline))
    flange = MOUNT["flange"] | {"z": float(sags.mean()) - 2.0, "draft": 0.0}
    mount = design.scene.changed({"mount": {"flange": flange}}).mount
    mounting.write_if_it_fits(design.lens, mount, tmp_path / "part.step", "cut", design.scene.part)
    [check] = step_checks.check_part(tmp_path, design.lens, mount, design.scene.part)
    assert not check.passed and "cuts the rim of the back" in check.where and "\n" not in check.where


def test_a_bevel_that_occ_cannot_build_is_a_sentence(design):
    """The bevel is wider than the corner that it runs around; a scene is refused for it."""
    mount = design.scene.changed({"mount": MOUNT}).mount
    outline = mount.flange.outline.model_copy(update={"corner_radius": 0.05})
    flange = mount.flange.model_copy(update={"outline": outline, "bevel": 0.9, "draft": 5.0})
    with pytest.raises(
        ValueError, match=r"^mount: OpenCASCADE cannot build the part \(StdFail_NotDone\); reduce or omit bevel"
    ):
        mounting.part_of(design.lens, mount.model_copy(update={"flange": flange}))


def test_without_a_mount_there_is_no_part(design, small_design):
    assert not (small_design.folder / "part.step").exists() and not of_part(small_design.report)
    with pytest.raises(SceneError, match=r"has no \[mount\]"):
        design.part()


def test_a_script_s_part_states_what_it_holds(design, tmp_path):
    """Less a hole of 1 mm through 10 mm of lens; and with a ring around it."""
    plain, drilled = (
        part21.read_lens(design.write_part(tmp_path / "part.step", holes=holes)) for holes in ((), [(0.5, 0.2, 1.0)])
    )
    [whole], [rest] = plain.properties.volumes, drilled.properties.volumes
    assert whole - rest == pytest.approx(np.pi / 4 * 10, rel=0.05)
    ring = cadquery.Workplane("XY", origin=(0, 0, 17)).circle(8).extrude(2)
    [held] = part21.read_lens(design.write_part(tmp_path / "part.step", body=ring)).properties.volumes
    assert held - whole == pytest.approx((np.pi * 64 - 48) * 2, rel=1e-6)


ROUNDED = {"shape": "rectangle", "width": 7.0, "height": 5.0, "corner_radius": 1.0}


@pytest.mark.parametrize("mount, outline, plane", suite.in_turns([
    ({}, None, True),
    ({"rim": {"shape": "circle", "diameter": 5.0}, "draft": 3.0, "bevel": 0.2, "datum": "front"}, Circle(2.5), True),
    (MOUNT | {"rim": ROUNDED}, Rectangle(7.0, 5.0), True),
], 3))  # fmt: skip
def test_a_part_passes_by_itself(design, tmp_path, mount, outline, plane):
    """The outline is that of the back, whatever walls are around it; the walls of a bare lens are checked, too."""
    lens = design.lens.with_front(Plane(design.lens.front.z)) if plane else design.lens
    scene = design.scene.changed({"mount": mount})
    said = scene.part.of(scene.lens)
    mounting.write_if_it_fits(lens, scene.mount, tmp_path / "part.step", "part", said)
    examined = step_checks.examine(tmp_path / "part.step")
    checks, found, whole = examined.checks, examined.lens, examined.whole
    assert [check for check in checks if not check.passed] == []
    bare = set(mount) <= {"rim"}
    assert ("edges-off-wall" in {check.id for check in checks}) is bare
    assert (whole is None) is bare
    assert found.outline.half_extent == pytest.approx((outline or lens.outline).half_extent, abs=1e-7)
    assert found.outline.shape == (outline or lens.outline).shape
    assert found.front.z == pytest.approx(lens.front.z - scene.mount.origin(lens.front.z), abs=1e-12)
    if "draft" in mount:
        of_mount = step_checks.check_part(tmp_path, lens, scene.mount, said)
        assert len(of_mount) == 15 and all(check.passed for check in of_mount)
        assert sum(check.id in ("stated-measures", "stated-centroid") for check in of_mount) == 3
        path = tmp_path / "part.step"
        text = path.read_text()
        assert "'bevel'" in text
        path.write_text(re.sub("'(back|bevel)',", lambda hit: "'bevel'," if hit[1] == "back" else "'back',", text))
        of_mount = step_checks.check_part(tmp_path, lens, scene.mount, said)
        assert {check.id for check in of_mount if not check.passed} >= {"face-names"}


def test_a_script_s_cut_passes_by_itself(design, tmp_path):
    """A triangle off the axis, in the rectangle about the axis that holds it."""
    triangle = cadquery.Wire.makePolygon([(x, y, 0.0) for x, y in ((-1.0, -1.0), (2.5, -1.0), (2.5, 2.0))], close=True)
    examined = step_checks.examine(design.write_part(tmp_path / "part.step", trim=triangle))
    found, whole = examined.lens, examined.whole
    assert all(check.passed for check in examined.checks)
    assert found.outline.half_extent == pytest.approx((2.5, 2.0), abs=1e-7)
    said = part(found, whole)
    assert said["Outline"].startswith("back: x = −1 to 2.5, y = −1 to 2 mm with cut corners")
    assert said["Overall size"].startswith("3.5 × 3 × ") and said["Extent"].startswith("x = −1 to 2.5, y = −1 to 2, z")


def test_the_words_of_a_part_by_itself_are_those_of_the_whole(written):
    """Size and volume of lens and flange, not of the lens."""
    scene, folder, _ = written
    examined = step_checks.examine(folder / "part.step")
    lens, whole = examined.lens, examined.whole
    said, solid = part(lens, whole), step_reading.solid(folder / "part.step").shape
    volume = GProp_GProps()
    BRepGProp.VolumePropertiesGK_s(solid, volume, 1e-4)
    assert float(said["Volume"].removesuffix(" cm³")) == pytest.approx(volume.Mass() / 1000, rel=5e-4)
    box = cadquery.Solid(solid).BoundingBox()
    size = [float(each) for each in said["Overall size"].removesuffix(" mm (x, y, z)").split(" × ")]
    assert size == pytest.approx((box.xlen, box.ylen, box.zlen), abs=1e-3) and size[0] > 17.9
    assert said["Outline"].startswith("back: rectangle, 8 × 6 mm; around it are other walls")


def test_walls_that_meet_leave_the_lens_and_say_why(design, tmp_path):
    """The bevel, for which a scene is not refused, leaves no wall below the lowest point of the tailored back."""
    thin = design.lens.back.z - design.lens.front.z + float(min(design.lens.back.sags(design.lens.outline)))
    mount = design.scene.changed({"mount": {"draft": 1.0, "bevel": 1.0}}).mount.model_copy(update={"bevel": thin})
    mounting.write_if_it_fits(design.lens, mount, tmp_path / "part.step", "met", design.scene.part)
    [check] = step_checks.check_part(tmp_path, design.lens, mount, design.scene.part)
    assert not check.passed and "no wall is left between z =" in check.where and "\n" not in check.where
