"""Settings of a raster: comments, zero point, units, rapid moves, tiles, and moves without needless points."""

import io
import re

import numpy as np
import pytest

from bstcad.cad.tiling import Tiling
from bstcad.exports.heightmap import HeightMap
from bstcad.exports.toolpath_files import toolpath_files
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.toolpath import chords
from bstcad.toolpath.cutting import Cutting
from bstcad.toolpath.raster import SAFE_HEIGHT
from tests.toolpath.test_foreign_gcode import run
from tests.toolpath.test_simulated_shop import Router, clearance, highest, lens_of, points_on, waves

pytestmark = pytest.mark.usefixtures("few_samples")
PLATE = Rectangle(8.0, 6.0)
COARSE = {"cusp": 0.05, "tolerance": 0.002}


def files_of(lens, name="a lens", cells=(), **settings):
    """The files of a raster by their names."""
    return dict(toolpath_files("raster", lens, Cutting(**COARSE | settings), name, cells))


def table(text):
    """Points (n, 3) of the table of a raster (mm)."""
    return np.loadtxt(io.StringIO(text), delimiter=",", skiprows=1)[:, 2:]


@pytest.fixture(scope="module")
def lens():
    return lens_of(waves, PLATE)


def test_a_comment_has_no_sign_that_acts_on_a_controller(lens):
    name = "LOGOPEN,x (Hello! 50 % für Zoë ~ ok?) Straße; Ж 光 \x18\x85 \u00a1"
    text = files_of(lens, name)["toolpath-raster.nc"]
    assert text.isascii() and text.replace("\n", "").isprintable() and not re.search("[!~?;]", text)
    assert text.startswith("(LOGOPEN -x [Hello. 50 % fur Zoe - ok.] Strasse, Zhe U+5149")
    Router(text)  # asserts that each line is a comment or moves, of at most 80 characters


@pytest.mark.parametrize("front", [None, Sphere(0.5, -0.01)], ids=["plane", "sphere"])
def test_zero_is_on_the_top_or_on_the_bottom_of_the_blank(lens, front):
    lens = lens if front is None else lens.with_front(front)
    top, bottom = (files_of(lens, zero=side, stock=0.3) for side in ("top", "bottom"))
    lowest = (
        0.0 if front is None else 0.5 - 0.01 * 25 / 2
    )  # z = 0.5 mm - r² / 200 mm at the corners, 5 mm from the axis
    thickness = highest(lens.back, PLATE) + 0.3 - lowest
    found = table(bottom["toolpath-raster.csv"]) - table(top["toolpath-raster.csv"])
    assert (
        np.abs(found - (0.0, 0.0, thickness)).max() < 2e-3
    )  # the decimals of the table, and the sphere's fourth order
    for side, files in (("top", top), ("bottom", bottom)):
        words = " ".join(files["toolpath-raster.nc"].replace(")\n(", " ").split())
        assert f"Z0 on the {side} of the blank" in words
        assert float(re.search(r"Blank: flat, ([\d.]+) mm thick", words)[1]) == pytest.approx(thickness, abs=2e-3)
    rapid = run(bottom["toolpath-raster.nc"])[1]
    assert np.nanmax(rapid[:, 3]) == pytest.approx(SAFE_HEIGHT + thickness, abs=2e-3) and rapid[:, 3].min() > 0


def test_a_file_in_inches_without_rapid_moves_has_the_points_of_the_table(lens):
    files = files_of(lens, units="inch", rapid="G1", feed=635.0)
    commands, moves = run(files["toolpath-raster.nc"])
    assert set(commands) == {"G20", "G90", "G94", "G17", "G1", "M2"}
    points = table(files["toolpath-raster.csv"])
    place = moves[2:-2, 1:4] * 25.4
    away = np.abs(place[:, None] - points[None, ::50]).max(-1).min(0)  # each point of the table is in the file
    assert away.max() < 0.002 / 2
    assert {25.0, float(f"{25 / 3:.5g}"), float(f"{3000 / 25.4:.5g}")} == set(moves[:, 4])


def test_straight_level_moves_have_no_points_between(lens):
    rows = np.loadtxt(io.StringIO(files_of(lens)["toolpath-raster.csv"]), delimiter=",", skiprows=1)
    rough = rows[rows[:, 1] == 1]
    same = (rough[2:, 0] == rough[:-2, 0]) & (np.ptp([rough[2:, 4], rough[1:-1, 4], rough[:-2, 4]], axis=0) == 0)
    assert not same.any()
    flat = table(files_of(lens_of(lambda x, y: 0 * x, PLATE))["toolpath-raster.csv"])
    assert not (np.abs(flat[:, :2]) < np.array(PLATE.half_extent) - 0.1).all(1).any()  # points are beyond the rim only


def test_points_that_are_left_out_lie_near_the_moves():
    random = np.random.default_rng(4)
    t = np.cumsum(random.uniform(0.01, 0.1, 3000))
    z = np.sin(t) + 1e-4 * random.normal(size=3000)
    corner = random.random(3000) < 0.01
    kept = chords.bends(t, z, corner, 1e-3)
    assert kept[corner].all() and kept[[0, -1]].all() and kept.mean() < 0.7
    assert np.abs(np.interp(t, t[kept], z[kept]) - z).max() <= 1e-3 * (1 + 1e-9)


@pytest.mark.parametrize(("outline", "count"), [(PLATE, 4), (Circle(3.5), 4)], ids=["plate", "disc"])
def test_each_tile_has_a_path_about_its_own_zero_point(outline, count):
    lens, cells = lens_of(waves, outline), Tiling(2, 2).cells(outline)
    files = files_of(lens, cells=cells)
    paths = [name for name in files if name.endswith(".nc")]
    assert paths == [f"toolpath-raster-{cell.name}.nc" for cell in cells] and len(paths) == count
    lift = highest(lens.back, outline) + 0.2  # all tiles are cut from blanks of one thickness
    for cell, path in zip(cells, paths, strict=True):
        (x0, x1), (y0, y1) = cell.extent
        text = files[path.replace(".nc", ".txt")]
        x, y = re.search(r"x = (\S+) mm, y = (\S+) mm of the lens", text).groups()
        centre = np.array([float(x), float(y), 0.0])
        assert centre == pytest.approx([(x0 + x1) / 2, (y0 + y1) / 2, 0.0])
        moves = Router(files[path]).moves
        points = points_on(lens.back, outline, 0.1) - centre
        points = points[(np.abs(points[:, :2]) <= ((x1 - x0) / 2, (y1 - y0) / 2)).all(1)]
        found = clearance(moves["Roughing"] + moves["Finish"], 1.5, lift, points, 0.05)
        assert found.min() > -0.004 and found.max() < 2 * 0.05  # tolerance; cusps, twice as high where the ball bridges


def test_the_height_map_of_a_tile_is_that_part_of_the_whole():
    lens, cells = lens_of(waves, PLATE), Tiling(2, 3).cells(PLATE)
    whole = HeightMap.of(lens.back, PLATE, 160)
    for cell in cells:
        tile = HeightMap.of(lens.back, PLATE, 160, cell)
        row, column = 40 * (3 - cell.row), 80 * (cell.column - 1)
        assert np.abs(tile.z - whole.z[row : row + 40, column : column + 80]).max() < 1e-12
        assert f"heightmap-{cell.name}.png" in tile.words() and "Its middle is x = " in tile.words()


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ({"zero": "side"}, "zero = 'side' is not possible; give top or bottom"),
        ({"units": "cm"}, "units = 'cm' is not possible; give mm or inch"),
        ({"rapid": "G2"}, "rapid = 'G2' is not possible; give G0 or G1"),
    ],
)
def test_an_impossible_setting_is_one_sentence(setting, words):
    with pytest.raises(ValueError, match=words):
        Cutting(**setting)
