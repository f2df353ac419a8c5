"""The data sheet: true to scale, no label over another, the same bytes twice, whatever the lens and its title."""

import functools
import io
import itertools
import re
import tempfile
import zlib
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from matplotlib.path import Path as Path2D
from OCP.BRepClass3d import BRepClass3d_SolidClassifier
from OCP.BRepGProp import BRepGProp
from OCP.gp import gp_Pnt
from OCP.GProp import GProp_GProps
from OCP.TopAbs import TopAbs_State
from pypdf import PdfReader

from bstcad.analysis.light import needed_apertures
from bstcad.analysis.shape import describe
from bstcad.cad import mounting
from bstcad.exports import data_sheet, part_views
from bstcad.exports.data_sheet import DataSheet
from bstcad.exports.part_views import Views
from bstcad.figures.drawing import GLASS
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.trace.measure import Light
from bstcad.report import prescription
from bstcad.report.goal_figures import figures_of
from bstcad.report.prescription import measured, order_of
from bstcad.report.units import mm
from bstcad.scene.mount import Box, CircleRim, Flange, Mount, Screws
from bstcad.scene.scene import load
from tests import suite
from tests.exact_volume import exact_volume
from tests.scenes import DISK

LONG = "\u041b\u0456\u043d\u0437\u0430 \u00ab\u0388\u03bb\u03bb\u03b7\u03bd\u00bb \u65e5\u672c $x^2$ " + 12 * "and on "
SCENES = {
    "square": {},
    "round, concave": {
        "title": LONG, "name": "a_name_of_many_letters_that_has_no_room_at_all_in_its_block",
        "lens.outline": {"shape": "circle", "diameter": 30.0}, "source.position": [0.0, 0.0, -50.0],
        "lens.front": {"kind": "sphere", "z": -2.0, "curvature": -0.01}, "lens.back.z": 4.0,
        "tolerance": [{"name": "back.form", "limit": 1e-4, "correlation_length": 3.0}],
    },
    "a mirror": {
        "lens.material": None, "lens.back.reflect": True, "lens.front.z": 0.0, "source.position": [0.0, 0.0, 120.0],
        "lens.outline": {"shape": "rectangle", "width": 60.0, "height": 40.0}, "target.seen_from": "behind",
    },
    "a strip": {"lens.outline": {"shape": "rectangle", "width": 60.0, "height": 6.0}, "target.tilt": [30.0, -10.0]},
    "a round rim": {"mount": {"datum": "front", "rim": {"shape": "circle", "diameter": 13.0}, "draft": 2.0}},
    "a flange": {
        "mount": {
            "datum": "flange", "rim": {"shape": "circle", "diameter": 14.0}, "draft": 1.0, "bevel": 0.1,
            "flange": {
                "outline": {"shape": "rectangle", "width": 26.0, "height": 24.0, "corner_radius": 3.0}, "z": 16.0,
                "thickness": 1.5, "draft": 2.0, "bevel": 0.2,
                "screws": {"count": 4, "diameter": 2.2, "circle": 26.0, "first": 45.0},
                "holes": [[0.0, 9.5, 1.5], [0.0, -9.5, 1.5], [10.0, 1.0, 2.0]],
            },
        },
        "part": {
            "number": "LE-017", "author": "A. Maker", "organisation": "Shop", "date": "2031-05-06",
            "surface_profile": 0.005, "front_profile": 0.01, "roughness": 5.0, "coating": "AR 450 to 650 nm",
            "thickness_tolerance": 0.05,
        },
    },
    "the longest values": {
        "title": 199 * "w" + "W", "name": 40 * "W",
        "lens.front": {"kind": "sphere", "z": 14.0123456, "curvature": -0.0123456789},
        "mount": {
            "datum": "flange", "rim": {"shape": "circle", "diameter": 14.0123}, "draft": 1.2345, "bevel": 0.1234,
            "flange": {
                "outline": {"shape": "rectangle", "width": 28.1234, "height": 26.1234, "corner_radius": 3.1234},
                "z": 16.1,
                "thickness": 1.5123, "draft": 2.1234, "bevel": 0.2123,
                "screws": {"count": 4, "diameter": 2.2123, "circle": 27.123, "first": 45.123},
                "holes": [[0.1234, 9.5123, 1.5123], [0.1234, -9.5123, 1.6123], [10.1234, 1.0123, 2.0123]],
            },
        },
        "part": {
            **{key: " ".join(30 * [f"{key[:8]}"])[:200] for key in ("number", "author", "organisation", "coating")},
            "material": 200 * "M", "surface_profile": 0.00012345, "front_profile": 0.00054321, "roughness": 0.0123,
            "thickness_tolerance": 0.00012345, "date": "2031-05-06", "density": 12.3456,
        },
        "tolerance": [
            {"name": f"{face}.form", "limit": 1.2345e-6, "correlation_length": 3.0} for face in ("front", "back")
        ],
    },
    "a round flange around a bare lens": {
        "mount": {"flange": {"outline": {"shape": "circle", "diameter": 30.0}, "z": 15.5, "thickness": 6.0}},
        "part": {"density": 2.0},
    },
}  # fmt: skip
MOUNTED = ("a round rim", "a flange", "the longest values", "a round flange around a bare lens")


LIGHT = Light(np.ones((2, 2)), 0.0123, 0.0, rays=1, flux={"on target": 0.87, "off target": 0.13})


@functools.cache
def sheet(name):
    """The sheet of a wavy lens for one of SCENES, which nobody tailored."""
    scene = scene_of(name)
    lens, target = lens_of(scene), scene.target.irradiance()
    shape = describe(lens, 65) | {"volume": exact_volume(lens)}
    return DataSheet(
        scene=scene, designed=lens, shape=shape, order=ordered(scene, lens, shape), target=target, irradiance=target,
        figures=figures_of(scene.goals, [LIGHT] * len(scene.targets)), passed=True, version="0.1",
    )  # fmt: skip


def scene_of(name):
    return load(DISK).changed({"lens.back.control_points": 33, **SCENES[name]})


def lens_of(scene):
    outline = scene.lens.outline
    a, b = outline.half_extent if outline.shape == "rectangle" else 2 * (outline.radius * 32 / 27,)
    u, v = torch.meshgrid(*2 * (torch.linspace(-1, 1, 33, dtype=torch.float64),), indexing="ij")
    back = BSplineSurface(scene.lens.back.z, 0.04 * a * (torch.cos(3 * u) * torch.sin(2 * v + 1) + u), (-a, a), (-b, b))
    return Lens.between(scene.lens.front.surface, back, outline, scene.index, passes=scene.lens.passes)


def ordered(scene, lens, shape):
    """Return the data of a lens whose files are written, and deleted again."""
    with tempfile.TemporaryDirectory() as place:
        said, folder = scene.part.of(scene.lens), Path(place)
        (folder / "lens.step").write_bytes(b"ISO-10303-21;")  # of which nothing but its digest is asked
        if scene.mount is not None:
            mounting.write_if_it_fits(lens, scene.mount, folder / "part.step", scene.name, said)
        found = scene.mount and measured(folder / "part.step")
        return order_of(lens, shape, folder, stated=said, mount=scene.mount, found=found)


@functools.cache
def drawn(name):
    """(page, its texts)."""
    page = data_sheet.page(sheet(name))
    FigureCanvasAgg(page).draw()
    return page, [text for axes in page.axes for text in axes.texts if text.get_text()]


@functools.cache
def words_of(made):
    return [text.get_text() for axes in data_sheet.page(made).axes for text in axes.texts]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", suite.in_turns(SCENES, 4))
def test_no_label_lies_on_another_nor_leaves_the_frame(name):
    page, texts = drawn(name)
    pixels = page.dpi / 25.4
    boxes = {text: text.get_window_extent().extents / pixels for text in texts}
    left, low, right, high = data_sheet.FRAME
    for text, box in boxes.items():
        assert left < box[0] and low < box[1] and box[2] < right and box[3] < high, text.get_text()
    for (one, a), (other, b) in combinations(boxes.items(), 2):
        apart = max(max(a[0], b[0]) - min(a[2], b[2]), max(a[1], b[1]) - min(a[3], b[3]))
        assert apart > -0.2, (one.get_text(), other.get_text())  # mm; boxes of turned text hold its corners too


def views_of(made):
    return Views(made.lens, made.mount or Mount(), made.order.origin, used=None, names=(("", ""), ("", "")))


@pytest.mark.parametrize("name", suite.in_turns(SCENES, 4))
def test_sections_are_true_to_scale_and_dimensions_say_what_is_there(name):
    made, (page, texts) = sheet(name), drawn(name)
    words = [text.get_text() for text in texts]
    views = views_of(made)
    scale = part_views.scale_for(views, data_sheet.LIGHT_LEFT - 20, 200 - data_sheet.TABLE_TOP)
    assert part_views.scale_words(scale) in words
    bodies = [patch.get_xy() for patch in page.axes[0].patches if patch.get_facecolor() == to_rgba(GLASS)]
    cuts = [(body, cut) for cut in views.cuts for body in cut.bodies]
    assert len(bodies) == len(cuts)
    for body, (wanted, cut) in zip(bodies, cuts, strict=True):
        assert np.ptp(body, axis=0) / scale == pytest.approx(np.ptp(wanted, axis=0), rel=1e-9)
        assert area(body) / scale**2 == pytest.approx(area(wanted), rel=1e-9)
        if made.mount is None or made.mount.flange is None:
            assert all(mm(b - f) in words for b, f in zip(cut.back, cut.front, strict=True))
    assert mm(made.shape["centre_thickness"]) in words
    outer = views.outermost
    size = f"\u00d8{mm(2 * outer.radius)}" if outer.shape == "circle" else mm(outer.width)
    assert size in words


def area(body):
    x, y = body.T
    return abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2


@pytest.mark.parametrize("name", suite.in_turns(MOUNTED, 4))
def test_a_section_is_the_solid_s(name):
    """The solid of part.step, by OCC, lies where the polygons of the section lie, and nowhere else."""
    made = sheet(name)
    mount, views, random = made.mount or Mount(), views_of(made), np.random.default_rng(1)
    whole = lens_of(scene_of(name))
    solid = mounting.part_of(whole, mount).solid.wrapped
    classified = BRepClass3d_SolidClassifier(solid)
    for cut, upright in zip(views.cuts, (True, False), strict=True):
        low, high = np.array(cut.ends).T - 0.2, np.array(cut.ends).T + 0.2
        places = random.uniform(low[0], high[1], (150, 2))
        edges = np.concatenate([np.concatenate([body, body[:1]]) for body in cut.bodies])
        for z, along in places:
            if np.hypot(*(edges - (z, along)).T).min() < 0.05:
                continue
            x, y = (0.0, along) if upright else (along, 0.0)
            classified.Perform(gp_Pnt(x, y, z), 1e-7)
            inside = sum(Path2D(body).contains_point((z, along)) for body in cut.bodies)
            assert inside == (classified.State() == TopAbs_State.TopAbs_IN), (name, upright, z, along)


@suite.in_turn(0, 2)
def test_the_sheet_is_of_the_part_and_not_of_the_lens_before_it_was_cut():
    """Volume and mass are what OCC integrates over the part; a lens's own are smaller by the flange."""
    made = sheet("a flange")
    words = words_of(made)
    lens, mount = lens_of(scene_of("a flange")), made.mount
    found = GProp_GProps()
    BRepGProp.VolumePropertiesGK_s(mounting.part_of(lens, mount).solid.wrapped, found, 1e-4, False, False, True)
    mass = found.Mass() * 1.19 / 1000
    assert made.order.mass == pytest.approx(mass, rel=1e-3)
    assert made.order.mass != pytest.approx(made.shape["volume"] * 1.19 / 1000, rel=0.05)
    assert f"{made.order.volume / 1000:.4g} cm\u00b3" in words and f"{made.order.mass:.4g} g (1.19 g/cm\u00b3)" in words
    digest = made.order.sha256
    assert {"SHA-256 of part.step:", digest[:32], digest[32:]} <= set(words) and len(digest) == 64
    half, bevel = made.order.size[0] / 2, 0.2
    assert half == pytest.approx(13.0 - bevel * np.tan(np.radians(2.0)), abs=1e-6)  # where wall and bevel meet
    holes = {"4 \u00d7 \u00d82.2 on \u00d826", "2 \u00d7 \u00d81.5", "\u00d82"}
    walls = {"draft 1\u00b0, 0.1 \u00d7 45\u00b0", "draft 2\u00b0, 0.2 \u00d7 45\u00b0"}
    assert holes | walls | {"R3", "lens \u00d814", "26", "24", "1.5", "the flange's lower face"} <= set(words)
    assert "z = 484 mm in part.step" in words  # the screen, from the flange's lower face …
    assert "z = \u22121 mm" in words  # … and the front


def test_the_table_of_the_part_has_every_hole_at_its_place():
    flange = Flange(
        outline=Box(shape="rectangle", width=26.0, height=24.5, corner_radius=3.0), z=15.5, thickness=1.5,
        screws=Screws(count=4, diameter=2.2, circle=28.0), holes=((1, 11, 0.9), (-1, 11, 0.9), (0, -11, 2)),
    )  # fmt: skip
    mount = Mount(datum="flange", rim=CircleRim(shape="circle", diameter=15.0), bevel=0.15, flange=flange)
    made = sheet("a flange")
    scene, order = made.scene.model_copy(update={"mount": mount}), replace(made.order, origin=mount.origin(15.0))
    rows = replace(made, scene=scene, order=order).tables["The part, as in part.step"]
    assert [value for name, value in rows if name == "Holes"] == [
        "4 × Ø2.2 on Ø28 mm at x, y = 0, 14; −14, 0; 0, −14; 14, 0", "2 × Ø0.9 mm at x, y = 1, 11; −1, 11",
        "Ø2 mm at x, y = 0, −11",
    ]  # fmt: skip
    told = dict(rows)
    assert (told["Lens cut to"], told["Flange"][:14]) == ("Ø15 mm", "26 × 24.5, R3 ")
    assert told["Flange, range of z"] == "z = 0 to 1.5 mm"


@pytest.mark.parametrize("name", suite.in_turns(MOUNTED, 4))
def test_clear_apertures_lie_within_the_part_s_faces(name):
    made = sheet(name)
    views = views_of(made)
    along_y, along_x = (cut.front_ends[1] for cut in views.cuts)
    rooms = (along_x, along_y), views.rim.half_extent
    for patch, room in zip(needed_apertures(made.scene.source, made.lens).values(), rooms, strict=True):
        assert patch is None or np.all(np.array(patch.half_extent) <= np.array(room) + 1e-9)


def test_what_is_stated_stands_there_and_what_is_not_is_said():
    """The code numbers of ISO 10110, texture and coating, of both faces, and sizes."""
    assert words_of(sheet("square")).count("not specified") == 2 * 5 + 1
    concave = words_of(sheet("round, concave"))
    assert "3/\u2014RMSt < 100 nm" in concave and "100 mm CC" in concave
    said = words_of(sheet("a flange"))
    assert {"LE-017", "A. Maker", "Shop", "2031-05-06"} <= set(said)
    assert {"profile 0.01 mm (ISO 1101)", "profile 0.005 mm (ISO 1101)"} <= set(said)
    assert said.count("P, Ra \u2264 5 nm") == said.count("AR 450 to 650 nm") == 2
    assert any(re.fullmatch(r"5\.\d+ \u00b1 0\.05 mm", word) for word in said)
    assert said.count("not specified") == 2 * 2 + 1  # centring and imperfections of each face, sizes


@pytest.mark.filterwarnings("error")
def test_each_number_of_a_front_stands_on_the_sheet_and_in_the_prescription():
    """Kinds with numbers of their own, such as a biconic, state them, too."""
    numbers = {"curvature_x": 0.02, "curvature_y": -0.01, "conic_constant_x": -0.75, "conic_constant_y": 1.25}
    made = replace(sheet("square"))
    made.record["front"] = prescription._face("biconic", 15.0, numbers) | {"within": 1e-6}
    rows, text = dict(next(iter(made.tables.values()))), prescription.text(made.record)
    assert (rows["Form"], rows["Radius in x"]) == ("biconic; B-spline within 1 nm", "50 mm CX")
    assert [rows[f"Conic constant in {axis}"] for axis in "xy"] == ["-0.75", "1.25"]
    for name, value in numbers.items():
        assert re.search(rf"^ +{name.rpartition('_')[0].replace('_', ' ')} in {name[-1]} +{value!r}", text, re.M)


@suite.in_turn(1, 2)
def test_the_pdf_is_one_a4_with_its_fonts_and_the_same_twice():
    made = sheet("round, concave")
    pdf = data_sheet.draw(made)
    assert pdf == data_sheet.draw(made)
    assert pdf.startswith(b"%PDF") and len(pdf) < 300_000 and b"CreationDate" not in pdf
    assert len(re.findall(rb"/Type /Page\b", pdf)) == 1
    [box] = re.findall(rb"/MediaBox \[ ([\d. ]+) \]", pdf)
    assert [float(end) for end in box.split()] == pytest.approx([0, 0, 297 / 25.4 * 72, 210 / 25.4 * 72], abs=1e-3)
    fonts, known = re.findall(rb"/BaseFont", pdf), re.findall(rb"/FontFile2|/CharProcs", pdf)
    assert fonts and known
    streams = [zlib.decompressobj().decompress(part) for part in re.findall(rb"stream\r?\n(x.*?)endstream", pdf, re.S)]
    assert max(text.count(b" l\n") for text in streams) > 1000  # lines, not a picture of them
    assert pdf != data_sheet.draw(replace(made, order=replace(made.order, sha256="0" * 64)))


@pytest.mark.parametrize("name", suite.in_turns(SCENES, 4))
def test_every_figure_of_the_tables_is_read_back_from_the_pdf_whole(name):
    """The text of the PDF, without spaces and line breaks, contains each name and value of the tables."""
    made = sheet(name)
    [page] = PdfReader(io.BytesIO(data_sheet.draw(made))).pages
    text = re.sub(r"\s", "", page.extract_text())
    assert "\u2026" not in text
    for rows in made.tables.values():
        for cell in itertools.chain.from_iterable(rows):
            assert re.sub(r"\s", "", part_views.drawable(cell)) in text, cell
    part = made.scene.part
    for told in (part.number, part.author, part.organisation, part.date, made.scene.name, made.scene.title):
        assert told is None or re.sub(r"\s", "", part_views.drawable(told)) in text, told


def test_text_is_made_to_fit_its_room():
    text = "a sentence that is too long for the room that it is given"
    for room in (3.0, 20.0, 300.0):
        for most in (1, 3):
            lines, size = part_views.fitted(text, 2.5, room, most=most)
            assert len(lines) <= most and 0 < size <= 2.5 and "".join(lines).replace(" ", "") == text.replace(" ", "")
            assert all(part_views.width_of(line, size) <= room * (1 + 1e-9) for line in lines)
        assert all(part_views.width_of(line, 2.5) <= room * (1 + 1e-9) for line in part_views.broken(text, 2.5, room))
    assert part_views.drawable("m\u00b2 \u65e5") == f"m\u00b2 {part_views.UNKNOWN}"
