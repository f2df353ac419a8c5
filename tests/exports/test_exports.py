"""Files for the shop hold the exact surfaces and edges, read back by readers that share no line with their writers."""

import csv
import io
import math
import re
import shutil
import xml.etree.ElementTree as ElementTree

import ezdxf
import numpy as np
import pytest
import torch

import bstcad
from bstcad import cli
from bstcad.cad.mesh import Label
from bstcad.exports import exports
from bstcad.exports.grid_sag import GridSag
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Sphere, sag
from bstcad.runs import files
from bstcad.scene.mount import Box, CircleRim, Flange, Mount, Screws
from tests import suite

RECTANGLE, CIRCLE = Rectangle(8.0, 6.0), Circle(3.0)


def wavy(outline, m=21):
    """A lens whose back has waves of all lengths that its net can hold, and its vertex nowhere special."""
    a, b = outline.half_extent
    if outline.shape == "circle":
        a = b = outline.radius * (m - 1) / (m - 6)  # the net goes on behind the rim
    heights = torch.from_numpy(np.random.default_rng(7).normal(0.0, 0.02, (m, m)))
    return Lens.between(Sphere(1.0, 0.02), BSplineSurface(4.0, heights, (-a, a), (-b, b)), outline, 1.49)


def read_zemax(text):
    """OpticStudio's grid sag file as its help describes it: (x, y ascending, values (4, ny, nx) with y ascending)."""
    head, *lines = text.splitlines()
    nx, ny, dx, dy, unit, x0, y0 = head.split()
    nx, ny, dx, dy, x0, y0 = int(nx), int(ny), float(dx), float(dy), float(x0), float(y0)
    assert unit == "0" and len(lines) == nx * ny
    table = np.array([line.split() for line in lines], dtype=float)
    assert not table[:, 4].any()
    values = table[:, :4].reshape(ny, nx, 4)[::-1]  # the first line is the highest y
    x, y = (c + d * (np.arange(n) - (n - 1) / 2) for n, d, c in ((nx, dx, x0), (ny, dy, y0)))
    return x, y, values.transpose(2, 0, 1)


def table_of(text):
    """The columns of a CSV by their names."""
    names, *rows = csv.reader(io.StringIO(text))
    return dict(zip(names, np.array(rows, dtype=float).T, strict=True))


@pytest.mark.parametrize("outline", [RECTANGLE, CIRCLE], ids=lambda outline: outline.shape)
def test_zemax_reads_the_surface_with_its_derivatives(outline):
    lens = wavy(outline)
    x, y, (z, z_x, z_y, z_xy) = read_zemax(GridSag.of(lens, lens.back, 33).text())
    assert (x[-1], y[-1]) == pytest.approx(outline.half_extent, abs=1e-12)
    at_x, at_y = np.meshgrid(x, y)
    wanted = lens.back.sag_and_slope(*(torch.from_numpy(p.copy()) for p in (at_x, at_y)))
    for found, exact in zip((z + sag(lens.back, 0.0, 0.0), z_x, z_y), wanted, strict=True):
        assert np.abs(found - exact.numpy()).max() < 1e-9
    step = 1e-4 * min(lens.back.pitch)  # two sides of a knot differ in z_xy: look where a cell of the net is inside
    inner = np.abs(np.modf(at_x / lens.back.pitch[0])[0]) < 0.4
    beside = [lens.back.sag_and_slope(torch.from_numpy(at_x + s), torch.from_numpy(at_y))[2].numpy()
              for s in (-step, step)]  # fmt: skip
    off = np.abs(z_xy - (beside[1] - beside[0]) / (2 * step))[inner & (np.abs(at_x) < outline.half_extent[0] - 1.0)]
    assert off.max() < 1e-6 * np.abs(z_xy).max()


@pytest.mark.parametrize("outline", [RECTANGLE, CIRCLE], ids=lambda outline: outline.shape)
def test_tables_lie_on_the_lens(outline):
    lens = wavy(outline)
    found = table_of(exports.sag_table(lens, 41))
    x, y = found["x_mm"], found["y_mm"]
    assert np.ptp(x) == pytest.approx(2 * outline.half_extent[0]) and np.ptp(y) == pytest.approx(
        2 * outline.half_extent[1]
    )
    assert outline.contains(torch.from_numpy(x), torch.from_numpy(y)).all()
    assert np.abs(found["back_z_mm"] - sag(lens.back, x, y)).max() < 1e-10
    assert np.abs(found["front_z_mm"] - sag(lens.front, x, y)).max() < 1e-10
    turned = table_of(exports.turning_cloud(lens, 21))
    angle = np.radians(turned["angle_deg"])
    x, y = turned["radius_mm"] * np.cos(angle), turned["radius_mm"] * np.sin(angle)
    assert np.abs(turned["sag_mm"] - (sag(lens.back, x, y) - sag(lens.back, 0.0, 0.0))).max() < 1e-9
    reach, rings = np.hypot(*outline.farthest), np.unique(turned["radius_mm"])
    assert rings[-1] >= reach * (1 - 1.001 / 20) and np.ptp(np.diff(rings)) < 1e-9 and turned["sag_mm"][0] == 0


@pytest.mark.parametrize("side", ["front", "back"])
def test_normals_point_out_of_the_lens_and_stand_on_the_face(side):
    lens = wavy(RECTANGLE)
    face = getattr(lens, side)
    found = table_of(exports.points_table(lens, face, lens.plan, 61))
    normal = np.array([found[f"normal_{axis}"] for axis in "xyz"])
    assert np.abs(np.linalg.norm(normal, axis=0) - 1).max() < 1e-11
    assert (normal[2] < 0).all() if side == "front" else (normal[2] > 0).all()
    x, y, step = found["x_mm"], found["y_mm"], 1e-6
    for ahead in ((step, 0.0), (0.0, step)):  # a step along the face is square to the normal
        rise = sag(face, x + ahead[0], y + ahead[1]) - sag(face, x - ahead[0], y - ahead[1])
        along = normal[0] * 2 * ahead[0] + normal[1] * 2 * ahead[1] + normal[2] * rise
        inner = (np.abs(x) < 3.9) & (np.abs(y) < 2.9)
        assert np.abs(along[inner]).max() < 1e-7 * step * 1e3


@suite.in_turn(1, 2)
def test_the_command_and_the_scene_write_every_kind_and_the_design_still_proves(small_design, tmp_path, capsys):
    folder = shutil.copytree(small_design.folder, tmp_path / "copy")  # which other tests look at
    kinds = list(files.EXPORTS)
    sheet = (folder / "datasheet.pdf").read_bytes()
    assert cli.run(["export", str(folder), "--as", ", ".join(kinds), "--points", "17"]) == 0
    out = capsys.readouterr().out
    written = {"sag.csv", "points-front.csv", "points-back.csv", "zemax-back.dat", "turning.csv", "outline.dxf",
               "outline.svg", "preview.glb", "preview.3mf", "datasheet.pdf",
               "sag.txt", "points.txt", "zemax-back.txt"}  # fmt: skip
    assert all(str(folder / name) in out for name in written)
    for name in ("sag", "points", "zemax-back"):  # what the sidecars state, the terminal says
        [sentence] = (folder / f"{name}.txt").read_text().splitlines()
        assert sentence in out and "the light on the target by" in sentence
    assert (folder / "datasheet.pdf").read_bytes() == sheet  # as generate drew it
    design = bstcad.open(folder)
    x, y, (z, *_) = read_zemax((folder / "zemax-back.dat").read_text())
    lens = design.lens
    assert np.abs(z + sag(lens.back, 0.0, 0.0) - sag(lens.back, *np.meshgrid(x, y))).max() < 1e-12
    assert [path.name for path in design.export("svg")] == ["outline.svg"]


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--as", "iges"], "'iges' cannot be exported; give one of sag, points"),
        ([], "--as: is missing; give one or more kinds of files"),
        (["--as", "sag", "--points", "2"], "points = 2 is not possible; give a number from 3 to 4097"),
        (["--as", "datasheet"], "report.json: cannot be read"),  # whose figures it quotes
    ],
)
def test_what_cannot_be_exported_is_one_sentence(arguments, words, small_design, tmp_path, capsys):
    folder = shutil.copytree(small_design.folder, tmp_path / "copy")
    for name in ("report.json", "datasheet.pdf"):
        (folder / name).unlink()
    before = sorted(path.name for path in folder.iterdir())
    assert cli.run(["export", str(folder), *arguments]) == 2
    err = capsys.readouterr().err
    assert words in err and err.count("\n") == 1
    assert sorted(path.name for path in folder.iterdir()) == before


# --- drawings -------------------------------------------------------------------------------------------------------

AREA = 1e-9  # mm²
LABEL = Label("lamp", 'A disc, "even" & <bright>')
FLANGED = Mount(
    datum="flange",
    rim=CircleRim(shape="circle", diameter=15.0),
    flange=Flange(
        outline=Box(shape="rectangle", width=26.0, height=24.5, corner_radius=3.0), z=15.5, thickness=1.5, draft=1.0,
        bevel=0.2, screws=Screws(count=4, diameter=2.2, circle=26.0, first=45.0), holes=((1, 11, 0.9), (9.5, 0, 1.3)),
    ),
)  # fmt: skip
CASES = {  # outline of the lens, mount, area (mm²) of each edge by layer
    "flange": (Circle(10.0), FLANGED, {
        "RIM": [math.pi * 7.5**2], "FLANGE": [26.0 * 24.5 - (4 - math.pi) * 9.0], "SCREW_HOLES": [math.pi * 1.1**2] * 4,
        "HOLES": [math.pi * 0.45**2, math.pi * 0.65**2],
    }),
    "round flange of a square lens": (Rectangle(12.0, 9.0), Mount(flange=Flange(
        outline=CircleRim(shape="circle", diameter=31.0), z=1.0, thickness=2.0)), {
        "RIM": [108.0], "FLANGE": [math.pi * 15.5**2],
    }),
    "rim alone": (Circle(10.0), Mount(rim=Box(shape="rectangle", width=9.0, height=12.0, corner_radius=0.7)), {
        "RIM": [108.0 - (4 - math.pi) * 0.49],
    }),
    "a bare rectangle": (Rectangle(8.0, 6.0), None, {"OUTLINE": [48.0]}),
    "a bare circle": (Circle(3.0), None, {"OUTLINE": [math.pi * 9.0]}),
}  # fmt: skip


def entities_of(outline, mount):
    """{layer: entities} of the DXF, as ezdxf reads them, which finds no fault in it."""
    document = ezdxf.read(io.StringIO(exports.dxf(outline, mount, LABEL)))
    assert document.units == ezdxf.units.MM and not document.audit().has_errors
    found = document.modelspace().groupby("layer")
    assert all(layer in document.layers for layer in found)
    return found


def area(entity):
    """Return the area of a closed curve (mm²); an arc between two vertices has the bulge tan(angle / 4)."""
    if entity.dxftype() == "CIRCLE":
        return math.pi * entity.dxf.radius**2
    assert entity.closed
    x, y, bulge = np.array(entity.get_points("xyb")).T
    ahead_x, ahead_y = np.roll(x, -1), np.roll(y, -1)
    angle, chord = 4 * np.arctan(bulge), np.hypot(ahead_x - x, ahead_y - y)
    bent = angle != 0
    radius = chord[bent] / (2 * np.sin(angle[bent] / 2))
    caps = radius**2 / 2 * (angle[bent] - np.sin(angle[bent]))
    return (x @ ahead_y - ahead_x @ y) / 2 + caps.sum()


def test_holes_lie_where_the_part_has_them_and_are_marked():
    found = entities_of(Circle(10.0), FLANGED)
    places = [tuple(hole.dxf.center)[:2] for layer in ("SCREW_HOLES", "HOLES") for hole in found[layer]]
    assert np.array(places) == pytest.approx(np.array([(x, y) for x, y, _ in FLANGED.flange.all_holes()]), abs=1e-11)
    ends = [(line.dxf.start, line.dxf.end) for line in found["CENTRES"]]  # without the screws' circle, outside of it
    crossed = [tuple(start.lerp(end))[:2] for start, end in ends]
    assert crossed == [pytest.approx(place, abs=1e-11) for place in [(0.0, 0.0), *places] for _ in range(2)]
    assert all((start.x == end.x) != (start.y == end.y) for start, end in ends)


def test_the_circle_of_the_screws_is_drawn_where_it_lies_in_the_flange():
    flange = Flange(outline=CircleRim(shape="circle", diameter=31.0), z=1.0, thickness=2.0,
                    screws=Screws(count=3, diameter=2.0, circle=26.0))  # fmt: skip
    mount = Mount(flange=flange)
    [pitch] = [mark for mark in entities_of(Circle(10.0), mount)["CENTRES"] if mark.dxftype() == "CIRCLE"]
    assert pitch.dxf.radius == 13.0
    _, groups = svg_of(Circle(10.0), mount)
    assert [line.get("r") for line in groups["centres"] if line.tag.endswith("}circle")] == ["13"]


def test_words_say_what_it_is():
    found = entities_of(Circle(10.0), FLANGED)
    said = [line.dxf.text for line in found["TEXT"]]
    assert said[0] == 'lamp: A disc, "even" & <bright>'
    for words in ("RIM: %%c15, cut from %%c20", "26 x 24.5, R3, 1.5 thick", "4 x %%c2.2 on %%c26, one at 45%%d",
                  "1 x %%c0.9, 1 x %%c1.3", "walls: 1%%d", "edges: 0.2"):  # fmt: skip
        assert sum(words in line for line in said) == 1
    assert all(line.dxf.insert.y < -24.5 / 2 for line in found["TEXT"])  # below the part
    rim, draft, bevel = list(exports.words(Circle(10.0), Mount(draft=2.0, bevel=0.15), LABEL))[2:]
    assert rim == "RIM: Ø20" and ": 2°, inwards" in draft and "0.15, not drawn" in bevel


def svg_of(outline, mount):
    """(the root, {id of a group: its elements})."""
    root = ElementTree.fromstring(exports.svg(outline, mount, LABEL))
    return root, {child.get("id"): list(child) for child in root if child.tag.endswith("}g")}


def svg_area(shape):
    """Return the area of a circle, or of a rectangle whose corners are quarters of circles (mm²)."""
    if shape.tag.endswith("}circle"):
        return math.pi * float(shape.get("r")) ** 2
    corner = float(shape.get("rx", 0.0))
    return float(shape.get("width")) * float(shape.get("height")) - (4 - math.pi) * corner**2


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_dxf_and_svg_have_each_edge_closed_on_its_layer_in_true_size(case):
    outline, mount, wanted = case
    found = entities_of(outline, mount)
    assert list(found) == (list(wanted) if mount is None else [*wanted, "CENTRES", "TEXT"])
    for layer, areas in wanted.items():
        assert [area(entity) for entity in found[layer]] == pytest.approx(areas, abs=AREA)
    root, groups = svg_of(outline, mount)
    left, top, width, height = map(float, root.get("viewBox").split())
    assert (root.get("width"), root.get("height")) == (f"{width:g}mm", f"{height:g}mm")
    names = [name.lower().replace("_", "-") for name in wanted]
    assert list(groups) == (names if mount is None else [*names, "centres", "text"])
    for name, areas in zip(groups, wanted.values(), strict=False):
        assert [svg_area(shape) for shape in groups[name]] == pytest.approx(areas, abs=AREA)
    if mount is None:
        assert (left + width / 2, top + height / 2) == pytest.approx((0.0, 0.0))
        return
    reach = max(abs(float(line.get(end))) for line in groups["centres"] for end in ("x1", "y2") if line.get(end))
    assert left < -reach and top < -reach / 2 and left + width > reach
    assert all(top < float(line.get("y")) < top + height for line in groups["text"])
    assert all(len(line.text) <= exports.MAX_LINE_LENGTH for line in groups["text"])


def test_y_points_up_in_the_svg_and_its_words_are_those_of_the_dxf():
    root, groups = svg_of(Circle(10.0), FLANGED)
    small, large = groups["holes"]
    assert [small.get(name) for name in ("cx", "cy", "r")] == ["1", "-11", "0.45"]
    assert [large.get(name) for name in ("cx", "cy", "r")] == ["9.5", "0", "0.65"]
    said = [line.dxf.text for line in entities_of(Circle(10.0), FLANGED)["TEXT"]]
    ascii_only = str.maketrans({"Ø": "%%c", "°": "%%d", "×": "x"})
    assert [line.text.translate(ascii_only) for line in groups["text"]] == said and root[0].text == said[0]


def test_the_command_draws_the_part_of_a_design_with_a_mount(small_design, tmp_path, capsys):
    folder = shutil.copytree(small_design.folder, tmp_path / "copy")
    assert cli.run(["export", str(folder), "--as", "dxf,svg"]) == 0
    assert '"rim"' not in (folder / "outline.svg").read_text() and "RIM" not in (folder / "outline.dxf").read_text()
    with (folder / "scene.toml").open("a") as scene:
        scene.write('\n[mount]\nrim = { shape = "circle", diameter = 5.0 }\n')
    assert cli.run(["export", str(folder), "--as", "dxf,svg"]) == 0
    [rim] = ezdxf.readfile(folder / "outline.dxf").modelspace().query('*[layer=="RIM"]')
    assert area(rim) == pytest.approx(math.pi * 6.25, abs=AREA)
    assert re.search(r'<g id="rim".*\n    <circle cx="0" cy="0" r="2.5" />', (folder / "outline.svg").read_text())
    capsys.readouterr()
