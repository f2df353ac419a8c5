"""Reading a cloud: any usual text and mesh, and one sentence for each file that is no cloud of the face."""

import numpy as np
import pytest
import trimesh

from bstcad import cli, commands
from bstcad.measured import cloud as clouds
from bstcad.optics.outlines import Circle
from bstcad.scene.errors import SceneError

GOOD = np.random.default_rng(0).uniform(-4, 4, (200, 3))
ROUND = Circle(4.0)


def lines(found, separator):
    return "\n".join(separator.join(f"{value:.6f}" for value in row) for row in found)


def named(found):
    return "\n".join(f"P{k},{x:.7f},{y:.7f},{z:.7f},0.1,high" for k, (x, y, z) in enumerate(found))


WRONG = {
    "two columns": (lines(GOOD[:, :2], ","), "line 1 holds 2 numbers; give x, y and z in mm"),
    "nan": (lines(GOOD, ",") + "\n1,nan,3", "point 201 is not three finite numbers"),
    "words": (lines(GOOD, " ") + "\n1 two 3", "line 201 is not three numbers"),
    "a short line": ("x,y,z\n" + lines(GOOD, ",") + "\n1,2\n", "line 202 is not three numbers"),
    "ten points": (lines(GOOD[:10], ","), "holds 10 points, too few"),
    "more columns": (lines(np.hstack([GOOD, GOOD]), ","), "holds 6 columns, and no heading says which are x, y and z"),
    "another heading": ("r,phi,z\n" + lines(GOOD, ","), "its heading, 'r,phi,z', names no x, y and z"),
    "x twice": ("x,y,z,x\n" + lines(GOOD[:, [0, 1, 2, 0]], ","), "names x, y or z twice"),
    "another unit": ("x [ft],y [ft],z [ft]\n" + lines(GOOD, ","), "'x[ft]', has a unit that is not known; give mm"),
    "metres": (lines(GOOD / 1000, ","), "as if they were in metres; give them in mm"),
    "nothing": ("\n \n", "is empty"),
    "a heading alone": ("x,y,z\n", "holds no points"),
    "another size": (lines(GOOD * 20, ","), "where the lens is 8 mm wide"),
    "no text": (bytes(range(256)), "is no text"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_cloud_is_one_sentence(tmp_path, wrong):
    content, sentence = WRONG[wrong]
    (tmp_path / "cloud.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match="cloud.csv: ") as error:
        clouds.load(tmp_path / "cloud.csv", ROUND)
    assert sentence in str(error.value) and "\n" not in str(error.value)


def test_a_wrong_cloud_ends_the_command_with_2_and_changes_nothing(small_design, tmp_path, capsys):
    before = (small_design.folder / "report.json").read_bytes()
    assert cli.run(["verify", str(small_design.folder), "--measured", str(tmp_path / "none.csv")]) == 2
    assert "none.csv: cannot be read (No such file" in capsys.readouterr().err
    (tmp_path / "few.csv").write_text(lines(GOOD[:10], ","))
    with pytest.raises(SceneError, match="few.csv: holds 10 points"):
        commands.verify(small_design.folder, measured=tmp_path / "few.csv")
    assert (small_design.folder / "report.json").read_bytes() == before


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", "x,y,z\n" + lines(GOOD, ",")),
        ("a.txt", "# by an instrument\n" + lines(GOOD, "\t")),
        ("a.xyz", lines(GOOD, "  ")),
        ("a.csv", lines(GOOD, ";").replace(".", ",")),
        ("a.csv", "z,x,y\n" + lines(GOOD[:, [2, 0, 1]], ",")),
        ("a.csv", "z [\u00b5m];x [mm];y [mm]\n" + lines(GOOD[:, [2, 0, 1]] * [1e3, 1, 1], ";").replace(".", ",")),
        ("a.txt", "# serial 17\n# x [in]  y [in]  z [in]  nx ny nz\n" + lines(np.hstack([GOOD / 25.4, GOOD]), " ")),
        ("a.csv", "made by an instrument\nID,X_mm,Y_mm,Z_mm,normal x,intensity\n" + named(GOOD)),
        ("a.csv", "x nominal,x actual,y actual,z actual\n" + lines(GOOD[:, [1, 0, 1, 2]], ",")),
        ("a.csv", '"x","y","z","note"\n' + "\n".join(f'{x:.7f},{y:.7f},{z:.7f},"a, b"' for x, y, z in GOOD)),
    ],
)
def test_text_is_read_with_any_separator_and_heading(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    found = clouds.load(tmp_path / name, ROUND)
    assert found.points == pytest.approx(GOOD, abs=2e-5) and found.unit == "mm"  # half of the last digit, in inches


def test_a_cloud_without_a_unit_as_large_as_the_lens_in_inches_is_in_inches(tmp_path):
    (tmp_path / "a.csv").write_text(lines(GOOD / 25.4, ","))
    found = clouds.load(tmp_path / "a.csv", ROUND)
    assert found.points == pytest.approx(GOOD, abs=2e-5) and found.unit == "inches" and len(found.sha256) == 64


@pytest.mark.parametrize("ending", ["ply", "stl"])
def test_vertices_of_meshes_are_points(tmp_path, ending):
    mesh, path = trimesh.creation.icosphere(3, 4.0), tmp_path / f"a.{ending}"
    mesh.export(path)
    found = clouds.load(path, ROUND).points
    assert len(found) == len(mesh.vertices) and np.linalg.norm(found, axis=1) == pytest.approx(4.0, abs=1e-6)
    path.write_bytes(path.read_bytes()[:150])
    with pytest.raises(ValueError, match=rf"is no {ending.upper()} file that can be read|holds .* points|no points"):
        clouds.load(path, ROUND)
