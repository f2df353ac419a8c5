"""Drawings of a bare lens and of a part in its mount, read back by ezdxf and by an XML parser."""

import io
import math
import re
import shutil
import xml.etree.ElementTree as ElementTree

import ezdxf
import numpy as np
import pytest

from bstcad import cli
from bstcad.cad.mesh_files import Label
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.scene.mount import Box, Flange, Mount, Round, Screws
from bstcad.shop import part_drawings

AREA = 1e-9  # mm²
LABEL = Label("lamp", 'A disc, "even" & <bright>')
FLANGED = Mount(
    datum="flange",
    rim=Round(shape="circle", diameter=15.0),
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
        outline=Round(shape="circle", diameter=31.0), z=1.0, thickness=2.0)), {
        "RIM": [108.0], "FLANGE": [math.pi * 15.5**2],
    }),
    "rim alone": (Circle(10.0), Mount(rim=Box(shape="rectangle", width=9.0, height=12.0, corner_radius=0.7)), {
        "RIM": [108.0 - (4 - math.pi) * 0.49],
    }),
    "a bare rectangle": (Rectangle(8.0, 6.0), None, {"OUTLINE": [48.0]}),
    "a bare circle": (Circle(3.0), None, {"OUTLINE": [math.pi * 9.0]}),
    "datum alone": (Circle(10.0), Mount(datum="front"), {"RIM": [math.pi * 100.0]}),
}  # fmt: skip


def entities_of(outline, mount):
    """{layer: entities} of the DXF, as ezdxf reads them, which finds no fault in it."""
    document = ezdxf.read(io.StringIO(part_drawings.dxf(outline, mount, LABEL)))
    assert document.units == ezdxf.units.MM and not document.audit().has_errors
    found = document.modelspace().groupby("layer")
    assert all(layer in document.layers for layer in found)
    return found


def area(entity):
    """Of a closed curve (mm²); an arc of a polyline from a vertex to the next has the bulge tan(angle / 4)."""
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


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_the_dxf_has_each_edge_closed_on_its_layer_in_true_size(case):
    outline, mount, wanted = case
    found = entities_of(outline, mount)
    assert list(found) == (list(wanted) if mount is None else [*wanted, "CENTRES", "TEXT"])
    for layer, areas in wanted.items():
        assert [area(entity) for entity in found[layer]] == pytest.approx(areas, abs=AREA)


def test_holes_lie_where_the_part_has_them_and_are_marked():
    found = entities_of(Circle(10.0), FLANGED)
    places = [tuple(hole.dxf.center)[:2] for layer in ("SCREW_HOLES", "HOLES") for hole in found[layer]]
    assert np.array(places) == pytest.approx(np.array([(x, y) for x, y, _ in FLANGED.flange.all_holes()]), abs=1e-11)
    ends = [(line.dxf.start, line.dxf.end) for line in found["CENTRES"]]  # without the screws' circle, outside of it
    crossed = [tuple(start.lerp(end))[:2] for start, end in ends]
    assert crossed == [pytest.approx(place, abs=1e-11) for place in [(0.0, 0.0), *places] for _ in range(2)]
    assert all((start.x == end.x) != (start.y == end.y) for start, end in ends)


def test_the_circle_of_the_screws_is_drawn_where_it_lies_in_the_flange():
    flange = Flange(outline=Round(shape="circle", diameter=31.0), z=1.0, thickness=2.0,
                    screws=Screws(count=3, diameter=2.0, circle=26.0))  # fmt: skip
    mount = Mount(flange=flange)
    [pitch] = [mark for mark in entities_of(Circle(10.0), mount)["CENTRES"] if mark.dxftype() == "CIRCLE"]
    assert pitch.dxf.radius == 13.0
    _, groups = svg_of(Circle(10.0), mount)
    assert [line.get("r") for line in groups["centres"] if line.tag.endswith("}circle")] == ["13"]


def test_words_say_what_it_is():
    found = entities_of(Circle(10.0), FLANGED)
    assert [line.dxf.text for line in found["TEXT"]] == [
        'lamp: A disc, "even" & <bright>',
        "As in part.step, seen from the back: x right, y up; in mm",
        "RIM: %%c15, cut from %%c20",
        "FLANGE: 26 x 24.5, R3, 1.5 thick",
        "its walls lean inwards by 1%%d from this, their lower edge",
        "its edges are bevelled by 0.2, which is not drawn",
        "SCREW_HOLES: 4 x %%c2.2 on %%c26, one at 45%%d",
        "HOLES: 1 x %%c0.9, 1 x %%c1.3",
    ]
    assert all(line.dxf.insert.y < -24.5 / 2 for line in found["TEXT"])  # below the part


def test_words_say_how_the_lens_s_own_walls_end():
    leaning = Mount(draft=2.0, bevel=0.15)
    rim, *walls = list(part_drawings.words(Circle(10.0), leaning, LABEL))[2:]
    assert rim == "RIM: Ø20"
    assert walls == [
        "below the back its walls lean inwards by 2° from this",
        "its edge with the front is bevelled by 0.15, not drawn",
    ]
    flanged = FLANGED.model_copy(update={"draft": 3.0})
    assert "below the flange its walls lean inwards by 3° from this" in part_drawings.words(
        Circle(10.0), flanged, LABEL
    )


def svg_of(outline, mount):
    """(the root, {id of a group: its elements})."""
    root = ElementTree.fromstring(part_drawings.svg(outline, mount, LABEL))
    return root, {child.get("id"): list(child) for child in root if child.tag.endswith("}g")}


def svg_area(shape):
    """Of a circle, or of a rectangle whose corners are quarters of circles (mm²)."""
    if shape.tag.endswith("}circle"):
        return math.pi * float(shape.get("r")) ** 2
    corner = float(shape.get("rx", 0.0))
    return float(shape.get("width")) * float(shape.get("height")) - (4 - math.pi) * corner**2


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_the_svg_has_each_edge_in_its_group_in_true_size(case):
    outline, mount, wanted = case
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
    assert all(len(line.text) <= part_drawings.COLUMNS for line in groups["text"])


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
