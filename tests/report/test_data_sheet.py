"""The data sheet: true to scale, no label over another, the same bytes twice, whatever the lens and its title."""

import functools
import re
import zlib
from itertools import combinations

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba

from bstcad.analysis.shape import describe
from bstcad.cad.volume import exact_volume
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.report import data_sheet, data_sheet_page, drafting, part_views
from bstcad.report.data_sheet import Stated
from bstcad.report.drawing import GLASS
from bstcad.scene.scene import load
from tests.conftest import DISK

DIGEST = "0123456789abcdef" * 4
LONG = "\u041b\u0456\u043d\u0437\u0430 \u00ab\u0388\u03bb\u03bb\u03b7\u03bd\u00bb \u65e5\u672c $x^2$ " + 12 * "and on "
SCENES = {
    "square": {},
    "round, concave": {
        "title": LONG, "lens.outline": {"shape": "circle", "diameter": 30.0}, "source.position": [0.0, 0.0, -50.0],
        "lens.front": {"kind": "sphere", "z": -2.0, "curvature": -0.01}, "lens.back.z": 4.0,
        "tolerance": [{"name": "back.form", "limit": 1e-4, "correlation_length": 3.0}],
    },
    "a thin plate": {
        "name": "a_name_of_many_letters_that_has_no_room_at_all_in_its_block",
        "lens.outline": {"shape": "rectangle", "width": 100.0, "height": 100.0}, "target.z": 3e3,
    },
    "a mirror": {
        "lens.material": None, "lens.back.reflect": True, "lens.front.z": 0.0, "source.position": [0.0, 0.0, 120.0],
        "lens.outline": {"shape": "rectangle", "width": 60.0, "height": 40.0}, "target.seen_from": "behind",
    },
    "a strip": {"lens.outline": {"shape": "rectangle", "width": 60.0, "height": 6.0}, "target.tilt": [30.0, -10.0]},
}  # fmt: skip


def sheet(name, stated=None):
    """The sheet of a wavy lens for one of SCENES, which nobody tailored."""
    scene = load(DISK).changed({"lens.back.control_points": 33, **SCENES[name]})
    outline = scene.lens.outline
    a, b = outline.half_extent if outline.shape == "rectangle" else 2 * (outline.radius * 32 / 27,)
    u, v = torch.meshgrid(*2 * (torch.linspace(-1, 1, 33, dtype=torch.float64),), indexing="ij")
    back = BSplineSurface(scene.lens.back.z, 0.04 * a * (torch.cos(3 * u) * torch.sin(2 * v + 1) + u), (-a, a), (-b, b))
    lens = Lens(scene.lens.front.surface, back, outline, scene.index, scene.lens.back.reflect)
    target = scene.target.irradiance()
    shape = describe(lens, 65) | {"volume": exact_volume(lens)}
    return data_sheet.sheet_of(scene, lens, shape, target, target, (0.0123, 0.87, True), "0.1", stated)


@functools.cache
def drawn(name):
    """(page, its texts)."""
    page = data_sheet_page.page(sheet(name), DIGEST)
    FigureCanvasAgg(page).draw()
    return page, [text for axes in page.axes for text in axes.texts if text.get_text()]


def words_of(made):
    return [text.get_text() for axes in data_sheet_page.page(made, DIGEST).axes for text in axes.texts]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", SCENES)
def test_no_label_lies_on_another_nor_leaves_the_frame(name):
    page, texts = drawn(name)
    pixels = page.dpi / 25.4
    boxes = {text: text.get_window_extent().extents / pixels for text in texts}
    left, low, right, high = data_sheet_page.FRAME
    for text, box in boxes.items():
        assert left < box[0] and low < box[1] and box[2] < right and box[3] < high, text.get_text()
    for (one, a), (other, b) in combinations(boxes.items(), 2):
        apart = max(max(a[0], b[0]) - min(a[2], b[2]), max(a[1], b[1]) - min(a[3], b[3]))
        assert apart > -0.2, (one.get_text(), other.get_text())  # mm; boxes of turned text hold its corners too


@pytest.mark.parametrize("name", SCENES)
def test_sections_are_true_to_scale_and_dimensions_say_what_is_there(name):
    made, (page, texts) = sheet(name), drawn(name)
    words = [text.get_text() for text in texts]
    views = part_views.views_of(made.lens, None, (("", ""), ("", "")))
    scale = part_views.scale_for(views, data_sheet_page.ASIDE - 20, 200 - data_sheet_page.TABLE)
    assert part_views.scale_words(scale) in words
    bodies = [patch.get_xy() for patch in page.axes[0].patches if patch.get_facecolor() == to_rgba(GLASS)]
    a, b = made.lens.outline.half_extent
    for body, cut, half in zip(bodies, views.cuts, (b, a), strict=True):
        x, y = body.T
        area = abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2
        assert area / scale**2 == pytest.approx(np.trapezoid(cut.back - cut.front, cut.along), rel=1e-9)
        assert np.ptp(y) / scale == pytest.approx(2 * half, rel=1e-12)
        assert all(part_views.length(float(cut.back[k] - cut.front[k])) in words for k in (0, -1))
    centre = made.shape["centre_thickness"]
    assert part_views.length(centre) in words and f"{part_views.length(centre)} mm" in words
    across = "\u00d8" if made.lens.outline.shape == "circle" else ""
    assert f"{across}{part_views.length(2 * a)}" in words
    assert any(DIGEST[:16] in word and DIGEST[:17] not in word for word in words)


def test_the_scale_is_the_largest_of_the_series_that_fits():
    width, height = 206.0, 139.5
    for name in SCENES:
        views = part_views.views_of(sheet(name).lens, None, (("", ""), ("", "")))
        a, b = views.lens.outline.half_extent
        thick = sum(np.ptp([cut.front, cut.back]) for cut in views.cuts)
        scale = part_views.scale_for(views, width, height)
        series = [k * 10.0**p for p in range(-3, 4) for k in (1, 2, 5)]
        fits = [
            s for s in series if s * (2 * a + thick) + sum(part_views.SIDES) <= width
            and s * 2 * max(a, b) + part_views.HEAD + part_views.FOOT <= height
        ]  # fmt: skip
        assert scale == pytest.approx(max(fits), rel=1e-12)
    assert [part_views.scale_words(s) for s in (0.05, 0.5, 1.0, 1000.0)] == ["1:20", "1:2", "1:1", "1000:1"]


def test_what_is_stated_stands_there_and_what_is_not_is_said():
    assert words_of(sheet("square")).count("not stated") == 3  # both faces, and sizes
    concave = words_of(sheet("round, concave"))
    assert "3/\u2014RMSt < 100 nm" in concave and "100 mm CC" in concave
    said = words_of(sheet("square", Stated("X-17", "A. Maker", "Shop", "2031-05-06", back_form="0.5 \u00b5m")))
    assert {"X-17", "A. Maker", "Shop", "2031-05-06", "0.5 \u00b5m"} <= set(said)


@pytest.mark.filterwarnings("error")
def test_the_pdf_is_one_a4_with_its_fonts_and_the_same_twice(tmp_path):
    (tmp_path / "lens.step").write_bytes(b"ISO-10303-21;")
    made = sheet("round, concave")
    pdf = data_sheet_page.draw(made, tmp_path / "lens.step")
    assert pdf == data_sheet_page.draw(made, tmp_path / "lens.step")
    assert pdf.startswith(b"%PDF") and len(pdf) < 300_000 and b"CreationDate" not in pdf
    assert len(re.findall(rb"/Type /Page\b", pdf)) == 1
    [box] = re.findall(rb"/MediaBox \[ ([\d. ]+) \]", pdf)
    assert [float(end) for end in box.split()] == pytest.approx([0, 0, 297 / 25.4 * 72, 210 / 25.4 * 72], abs=1e-3)
    fonts, known = re.findall(rb"/BaseFont", pdf), re.findall(rb"/FontFile2|/CharProcs", pdf)
    assert fonts and known
    streams = [zlib.decompressobj().decompress(part) for part in re.findall(rb"stream\r?\n(x.*?)endstream", pdf, re.S)]
    assert max(text.count(b" l\n") for text in streams) > 1000  # lines, not a picture of them
    (tmp_path / "lens.step").write_bytes(b"ISO-10303-21; another")
    assert pdf != data_sheet_page.draw(made, tmp_path / "lens.step")


def test_text_is_made_to_fit_its_room():
    text = "a sentence that is too long for the room that it is given"
    for room in (3.0, 20.0, 60.0, 300.0):
        said, size = drafting.fitted(text, 2.5, room)
        assert drafting.width_of(said, size) <= room * (1 + 1e-9) and 2.0 <= size <= 2.5
        lines = drafting.wrapped(text, 2.5, room, 3)
        assert len(lines) <= 3 and all(drafting.width_of(line, 2.5) <= room or " " not in line for line in lines)
    assert drafting.fitted(text, 2.5, 300.0) == (text, 2.5)
    assert drafting.wrapped(text, 2.5, 40.0, 9) == [
        line for line in drafting.wrapped(text, 2.5, 40.0, 9) if "\u2026" not in line
    ]
    assert drafting.drawable("m\u00b2 \u65e5") == f"m\u00b2 {drafting.UNKNOWN}"
