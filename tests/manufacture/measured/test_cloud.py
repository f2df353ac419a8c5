"""Reading a cloud: any usual text and mesh, and one sentence for each file that is no cloud of the face."""

import struct
import tracemalloc

import numpy as np
import pytest
import trimesh

from bstcad import cli, commands
from bstcad.manufacture.measured import cloud as clouds
from bstcad.optics.surfaces.outlines import Circle
from bstcad.scene.errors import SceneError

GOOD = np.random.default_rng(0).uniform(-4, 4, (200, 3))
ROUND = Circle(4.0)


def lines(found, separator):
    return "\n".join(separator.join(f"{value:.6f}" for value in row) for row in found)


def zygo(heights, pixel):
    """A Zygo XYZ file of rows of heights (mm), the first row at the top; pixel: m.  NaN is "No Data"."""
    header = ["Zygo XYZ Data File - Format 1", '0 8 1 5 "Mon"', "0 0 9 9 1 255", "0 0 9 9", '""', '""', '""']
    header += [f"0 0.5 6.328e-07 0 1 0 {pixel:.9g} 1500000000", "640 480 0 0 0 0", "#"]
    data = [
        f"{x} {y} " + ("No Data" if np.isnan(height) else f"{1e3 * height:.5f}")
        for y, row in enumerate(heights)
        for x, height in enumerate(row)
    ]
    return "\n".join([*header, *data, "#"])


WRONG = {
    "two columns": (lines(GOOD[:, :2], ","), "line 1 has 2 numbers; give x, y and z in mm"),
    "infinite": (lines(GOOD, ",") + "\n1,inf,3", "line 201: y = inf mm exceeds 1000000 mm"),
    "a placeholder": (lines(GOOD, " ") + "\n1 2 -1e10", "leave out points that were not measured"),
    "decimal commas": ("x,y,z\n" + lines(GOOD, ",").replace(".", ","), "line 2 has 6 fields, but its heading"),
    "nominal alone": ("X_nom,Y_nom,Z_nom\n" + lines(GOOD, ","), "its heading, 'X_nom,Y_nom,Z_nom', names nominal"),
    "pixels": ("Zygo XYZ Data File - Format 2\n#\n0 0 No Data\n0 1 16025.3\n#", "header states no width of a pixel"),
    "another zip archive": (b"PK\x03\x04" + bytes(50), "is not a readable X3P file (File is not a zip file)"),
    "a compressed SUR": (b"DSCOMPRESSED" + bytes(50), "is a compressed SUR file; save it without compression"),
    "half of UTF-16": ("x,y,z\n".encode("utf-16") + b"1", "is not text in UTF-16"),
    "more columns": (lines(np.hstack([GOOD, GOOD]), ","), "has 6 columns, but no heading names x, y and z"),
    "x twice": ("x,y,z,x\n" + lines(GOOD[:, [0, 1, 2, 0]], ","), "names x, y or z twice"),
    "another unit": ("x [ft],y [ft],z [ft]\n" + lines(GOOD, ","), "'x[ft]', has an unknown unit; give mm"),
    "metres": (lines(GOOD / 1000, ","), "seem to be in metres"),
    "no text": (bytes(range(256)), "is not a text file"),
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
    with pytest.raises(SceneError, match="few.csv: contains 10 points"):
        commands.verify(small_design.folder, measured=tmp_path / "few.csv")
    assert (small_design.folder / "report.json").read_bytes() == before


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", "x,y,z\n" + lines(GOOD, ",")),
        ("a.txt", "# by an instrument\n" + lines(GOOD, "\t")),
        ("a.csv", lines(GOOD, ";").replace(".", ",")),
        ("a.csv", "z [\u00b5m];x [mm];y [mm]\n" + lines(GOOD[:, [2, 0, 1]] * [1e3, 1, 1], ";").replace(".", ",")),
        ("a.txt", "# serial 17\n# x [in]  y [in]  z [in]  nx ny nz\n" + lines(np.hstack([GOOD / 25.4, GOOD]), " ")),
        ("a.csv", "X_nom,Y_nom,Z_nom,ActX,YMeas,Z [ist]\n" + lines(np.hstack([0 * GOOD, GOOD]), ",")),
        ("a.txt", "\n".join(f"PT{k}  {x:.7f} {y:.7f} {z:.7f}" for k, (x, y, z) in enumerate(GOOD))),  # named points
        ("a.csv", "X,Y,Z\n" + "\n".join(",".join(f'"{v:.7f}"'.replace(".", ",") for v in row) for row in GOOD)),
        ("a.txt", "X Y Z\n" + "\n".join(" ".join(f"{v:.8E}".replace("E", "D") for v in row) for row in GOOD)),
        ("a.csv", ("x [\u00b5m];y [mm];z [mm]\n" + lines(GOOD * [1e3, 1, 1], ";").replace(".", ",")).encode("cp1252")),
        ("a.csv", ("x,y,z\r\n" + lines(GOOD, ",")).encode("utf-16")),
        ("a.csv", ("x,y,z\n" + lines(GOOD, ",")).encode("utf-8-sig")),
        ("a.csv", "sep=;\nX;Y;Z\n" + lines(GOOD, ";").replace(".", ",")),
        ("a.csv", lines(GOOD, ",").replace("\n", ",\n")),  # a comma behind each line
        ("a.txt", "; by a CMM\n# part 17\n% mm\nX;Y;Z\n" + lines(GOOD, ";")),
        ("a.csv", '"x","y","z","note"\n' + "\n".join(f'{x:.7f},{y:.7f},{z:.7f},"a, b"' for x, y, z in GOOD)),
    ],
)
def test_text_is_read_with_any_separator_and_heading(tmp_path, name, text):
    (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    found = clouds.load(tmp_path / name, ROUND)
    assert found.points == pytest.approx(GOOD, abs=2e-5) and found.unit == "mm"  # half of the last digit, in inches
    assert found.without_data == 0


NO_DATA = ("Bad", "No Data", "NaN", "-nan(ind)", "-1.#IND00", "n/a", "---", "NoData", "null", "")


@pytest.mark.parametrize(("separator", "heading"), [(" ", ""), (";", "x;y;z\n")])
def test_lines_without_data_are_counted_and_left_out(tmp_path, separator, heading):
    """Instruments write words, or an empty height where the separator shows it."""
    words = NO_DATA[: 9 if separator == " " else 10]
    rows = [f"{x:.6f}{separator}{y:.6f}{separator}{z:.6f}" for x, y, z in GOOD]
    for k, word in enumerate(words):
        place = 17 * k + (k > 0)  # the first line, too
        rows[place] = rows[place].rsplit(separator, 1)[0] + separator + word
    (tmp_path / "a.txt").write_text(heading + "\n".join(rows) + "\n")
    found = clouds.load(tmp_path / "a.txt", ROUND)
    kept = np.delete(GOOD, [17 * k + (k > 0) for k in range(len(words))], axis=0)
    assert found.without_data == len(words) and found.points == pytest.approx(kept, abs=1e-6)


@pytest.mark.parametrize("name", ["a.csv", "a.ply"])
def test_duplicated_points_are_used_once(tmp_path, name):
    """The whole cloud twice, and one point 40 times more, which would have hidden that it is an outlier."""
    given = np.vstack([GOOD, GOOD, np.repeat(GOOD[:1], 40, axis=0)])
    head = HEADER.format("ascii", "", len(given), XYZ.replace("property float quality\n", ""), "")
    (tmp_path / name).write_text((head if name == "a.ply" else "") + lines(given, " "))
    found = clouds.load(tmp_path / name, ROUND)
    assert found.points == pytest.approx(GOOD, abs=1e-6)
    assert found.duplicates == (0 if name == "a.ply" else 240)  # triangles of a mesh share vertices
    (tmp_path / name).write_text(lines(given[:60].repeat(4, axis=0), " "))
    if name == "a.csv":
        with pytest.raises(ValueError, match="contains 60 points and 180 duplicated, which are too few"):
            clouds.load(tmp_path / name, ROUND)


def test_the_actual_columns_are_taken_and_that_is_known(tmp_path):
    heading = "ID;X nom;Y nom;Z nom;X act;Y act;Z act;Dev"
    rows = [f"{k};0;0;0;{x};{y};{z};0" for k, (x, y, z) in enumerate(GOOD)]
    (tmp_path / "a.csv").write_text("\n".join([heading, *rows]))
    found = clouds.load(tmp_path / "a.csv", ROUND)
    assert found.columns == "X act, Y act, Z act" and found.points == pytest.approx(GOOD)
    (tmp_path / "a.csv").write_text("\n".join(["x,y,z", lines(GOOD, ",")]))
    assert clouds.load(tmp_path / "a.csv", ROUND).columns == ""


def test_a_zygo_file_is_read_in_its_pixels_from_the_top(tmp_path):
    """Pixels of 0.1 mm, heights in µm, one of 81 x 61 without data."""
    x, y = np.meshgrid(np.arange(81) * 0.1, np.arange(61) * 0.1)  # y downwards
    heights = 0.01 * x**2 - 0.02 * y
    heights[5, 7] = np.nan
    (tmp_path / "a.xyz").write_text(zygo(heights, 1e-4))
    found = clouds.load(tmp_path / "a.xyz", ROUND)
    assert found.without_data == 1 and len(found.points) == 81 * 61 - 1 and "0.1 mm" in found.columns
    across, up, height = found.points.T
    assert (across.max(), up.min(), up.max()) == (pytest.approx(4.0), pytest.approx(-3.0), pytest.approx(3.0))
    assert height == pytest.approx(0.01 * (across + 4) ** 2 + 0.02 * (up - 3), abs=1e-8)


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
    with pytest.raises(ValueError, match="its header does not end|declares 1280 triangles, but 1.32 follow"):
        clouds.load(path, ROUND)


HEADER = "ply\nformat {} 1.0\ncomment made here\n{}element vertex {}\n{}{}end_header\n"
XYZ = "property double x\nproperty float quality\nproperty double y\nproperty double z\n"
FACES = "element face {}\nproperty list uchar int vertex_indices\n"


def ply(order, promised=200, faces=2, triangles=2, more=b""):
    """A PLY file of GOOD, with an element before the points and faces of 3 and 4 corners behind them."""
    camera = "element camera 1\nproperty float view\nproperty list uchar int ids\n"
    form = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = HEADER.format(form, camera, promised, XYZ, FACES.format(faces)).encode()
    if not order:
        rows = ["0.5 2 7 8", *(f"{x:.9g} 1 {y:.9g} {z:.9g}" for x, y, z in GOOD), *["3 0 1 2", "4 0 1 2 3"][:triangles]]
        return head + "\n".join(rows).encode() + b"\n" + more
    rows = [struct.pack(f"{order}dfdd", x, 1, y, z) for x, y, z in GOOD]
    ends = [struct.pack(f"{order}B3i", 3, 0, 1, 2), struct.pack(f"{order}B4i", 4, 0, 1, 2, 3)][:triangles]
    return head + struct.pack(f"{order}fB2i", 0.5, 2, 7, 8) + b"".join(rows + ends) + more


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_a_ply_file_is_held_to_what_its_header_promises(tmp_path, order):
    path = tmp_path / "a.ply"
    path.write_bytes(ply(order))
    found = clouds.load(path, ROUND)
    assert found.points == pytest.approx(GOOD, abs=1e-8)
    wrong = {
        "declares 1000000000 points, but": ply(order, 10**9),  # 28 GB
        "declares 999999999999999999 rows of element 'face', but 2 follow": ply(order, faces=10**18 - 1),
        "declares 2 rows of element 'face', but 1 follow": ply(order, triangles=1),
        "follow": ply(order, more=b"1 2 3\n"),
        "is not a readable PLY file (its header has the unknown line 'element vertex -5')": ply(order, -5),
    }
    for sentence, data in wrong.items():
        path.write_bytes(data)
        tracemalloc.start()
        with pytest.raises(ValueError, match="a.ply: ") as error:
            clouds.load(path, ROUND)
        assert sentence in str(error.value) and tracemalloc.get_traced_memory()[1] < 1e6
        tracemalloc.stop()


def test_points_of_a_ply_file_without_data_or_far_off_are_told_as_in_text(tmp_path):
    path, rows = tmp_path / "a.ply", [" ".join(map(str, row)) for row in GOOD]
    head = "ply\nformat ascii 1.0\nelement vertex 202\n" + XYZ.replace("property float quality\n", "") + "end_header\n"
    path.write_text(head + "\n".join([*rows, "1 2 nan", "nan nan nan"]))
    found = clouds.load(path, ROUND)
    assert len(found.points) == 200 and found.without_data == 2
    path.write_text(head + "\n".join([*rows, "1 2 nan", "1 2 1e9"]))
    with pytest.raises(ValueError, match=r"point 202: z = 1e\+09 mm exceeds"):
        clouds.load(path, ROUND)
    path.write_text(head + "\n".join([*rows, "1 2 nan", "1 2"]))
    with pytest.raises(ValueError, match="its point 202 is not three numbers"):
        clouds.load(path, ROUND)


def test_a_broken_stl_of_text_is_told_by_its_corners(tmp_path):
    path = tmp_path / "a.stl"
    trimesh.creation.icosphere(2, 4.0).export(path, file_type="stl_ascii")
    found = clouds.load(path, ROUND).points
    assert len(found) == 162
    path.write_text(path.read_text().rsplit("vertex", 1)[0])
    with pytest.raises(ValueError, match="it has 320 triangles, but 959 corners"):
        clouds.load(path, ROUND)
