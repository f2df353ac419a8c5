"""Tiles of a plate: valid solids whose faces are the lens's to the last bit, whose volumes and light add up."""

import math
import shutil
from collections import Counter

import numpy as np
import pytest
import shapely
import torch
from OCP.BRepAdaptor import BRepAdaptor_Surface
from OCP.TopAbs import TopAbs_FACE
from OCP.TopoDS import TopoDS

import bstcad
from bstcad import cli
from bstcad.cad import patches, solid_properties, step_reading
from bstcad.cad.tiles import tiles_of
from bstcad.cad.tiling import Tiling
from bstcad.optics.lens.face_integrals import of_lens
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.receivers.irradiance import Screen, collect
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Conic, Plane, Recess, Sphere
from bstcad.optics.trace.trace import trace
from bstcad.scene.errors import SceneError
from bstcad.scene.mount import Part
from tests import suite
from tests.cad.conftest import rough_back
from tests.lenses import rough
from tests.tracing import stratified

PLATE, DISC = Rectangle(24.0, 20.0), Circle(11.0)
LENSES = {
    "plane": (Plane(8.0), PLATE, (2, 2)),
    "sphere": (Sphere(8.0, 0.01), DISC, (2, 2)),
    "conic": (Conic(8.0, 0.01, -1.0), PLATE, (1, 3)),
    "net": (rough(0.01, seed=3, z=8.0, m=17, half=15.0), DISC, (2, 1)),
}


def lens_of(name, m=25):
    front, outline, _ = LENSES[name]
    return Lens.between(front, rough_back(outline, m), outline, 1.49)


def reread(tile, path):
    """The solid in the file of a tile, and its faces by the names that the tile has for them."""
    path.write_bytes(tile.step("plate", Part()))
    solid = step_reading.solid(path).shape
    assert step_reading.is_valid(solid) and step_reading.gaps(solid) <= 1e-7
    return solid, dict(zip(tile.faces, map(TopoDS.Face_s, step_reading.parts_of(solid, TopAbs_FACE)), strict=True))


def light_of_tile(tile, lens, path, source, screen, start):
    """The picture of the rays of a beam that start over a re-read tile, inside the edge of its own back.

    start: x, y (mm) of the rays and the area of each (mm²).  The front is a plane that the rays cross squarely.
    """
    _, faces = reread(tile, path)
    own = shapely.Polygon(ordered(step_reading.outer_edge(faces["back"])))
    x, y, area = start
    inside = torch.from_numpy(shapely.contains_xy(own, x.numpy(), y.numpy()))
    again = Lens.between(lens.front, step_reading.freeform_surface(faces["back"]), lens.outline, lens.index)
    landed = trace(source.rays_through(x[inside], y[inside], lens.front.z, area), again, screen.receiver)
    return collect(landed, screen)[0]


def polygon_of(cell):
    """The outline of a tile with many points on its arcs."""
    points = []
    for side in cell.sides:
        first, span = side.angles if side.radius else (0.0, 0.0)
        turns = first + np.linspace(0.0, span, 400, endpoint=False)
        points += (side.radius * np.stack([np.cos(turns), np.sin(turns)], axis=1)).tolist() if span else [side.start]
    return shapely.Polygon(points)


def ordered(edge):
    """Points of the edge of a convex tile, counterclockwise."""
    x, y = (edge - edge.mean(axis=0)).T
    return edge[np.argsort(np.arctan2(y, x))]


def rays_over(outline, n, seed):
    window = Rectangle(*(2 * half for half in outline.half_extent))
    x, y = (each.reshape(-1) for each in stratified(window, n, seed))
    inside = outline.contains(x, y)
    return x[inside], y[inside], window.area / n**2


def rms(difference, mean):
    return float((difference / mean).square().mean().sqrt())


@pytest.mark.parametrize("name", suite.in_turns(LENSES, 3))
def test_tiles_are_valid_solids_of_the_lens_and_add_up_to_it(name, tmp_path):
    lens, tiling = lens_of(name), Tiling(*LENSES[name][2])
    found = list(tiles_of(lens, tiling))
    volume, joints, poles = 0.0, Counter(), lens.back_net.control_points()
    for tile in found:
        solid, faces = reread(tile, tmp_path / "tile.step")
        properties = solid_properties.of_solid(solid)
        assert properties.volume == pytest.approx(tile.properties.volume, rel=1e-9)
        volume += properties.volume
        built = TopoDS.Face_s(step_reading.parts_of(tile.solid, TopAbs_FACE)[0])
        net, again = (patches.net_of(BRepAdaptor_Surface(face).BSpline()) for face in (built, faces["back"]))
        i, j = (int(np.abs(poles[..., k] - net[0, 0, k]).min(axis=1 - k).argmin()) for k in (0, 1))
        m, n, _ = net.shape
        assert (net == poles[i : i + m, j : j + n]).all() and m * n < 0.8 * len(
            poles
        ) ** 2  # poles of the lens, not all
        assert np.abs(net - again).max() < 1e-14  # mm: the digits of the file
        joints.update(frozenset((side.start, side.end)) for side in tile.cell.sides if side.joint)
        assert tile.faces.count("joint") == sum(side.joint for side in tile.cell.sides)
    assert volume == pytest.approx(of_lens(lens).volume, rel=1e-9)
    assert set(joints.values()) == {2}  # each joint has a tile on both sides


@pytest.mark.parametrize("outline", [PLATE, DISC], ids=["plate", "disc"])
def test_cells_cover_the_outline(outline):
    for columns, rows in [(1, 2), (2, 2), (3, 3), (5, 2), (2, 7), (4, 4)]:
        cells = Tiling(columns, rows).cells(outline)
        assert sum(cell.area for cell in cells) == pytest.approx(outline.area, rel=1e-12)
        for cell, polygon in zip(cells, map(polygon_of, cells), strict=True):
            assert polygon.is_valid and polygon.exterior.is_ccw and polygon.area == pytest.approx(cell.area, rel=1e-4)
            (left, right), (low, high) = cell.extent
            assert polygon.bounds == pytest.approx((left, low, right, high), abs=1e-3)
        assert cells[-1].name == f"tile-{columns}-{rows}"
        assert max(cell.extent[0][1] for cell in cells) == pytest.approx(outline.half_extent[0], rel=1e-15)


def test_the_light_of_the_tiles_is_that_of_the_lens(tmp_path):
    lens, source = lens_of("plane", m=33), CollimatedSource(PLATE)
    screen = Screen(120.0, (-30.0, 30.0), (-30.0, 30.0), 24)
    whole, other = (
        collect(trace(source.rays_through(x, y, 8.0, area), lens, screen.receiver), screen)[0]
        for x, y, area in (rays_over(PLATE, 400, seed) for seed in (1, 2))
    )
    same, new = torch.zeros_like(whole), torch.zeros_like(whole)
    for k, tile in enumerate(tiles_of(lens, Tiling(2, 2))):
        same += light_of_tile(tile, lens, tmp_path / "t.step", source, screen, rays_over(PLATE, 400, 1))
        new += light_of_tile(tile, lens, tmp_path / "t.step", source, screen, rays_over(PLATE, 400, 10 + k))
    assert rms(same - whole, whole.mean()) < 1e-9  # the same rays: only rounding differs
    noise = rms(whole - other, whole.mean())
    assert 0 < rms(new - whole, whole.mean()) < 1.25 * noise < 0.2 * rms(whole, whole.mean())


def test_what_cannot_be_tiled_is_refused_in_one_sentence():
    recess = Lens.between(Recess(Sphere(8.0, 0.01), Circle(5.0)), rough_back(PLATE, 17), PLATE, 1.49)
    with pytest.raises(ValueError, match="the front ends in an outline of its own"):
        list(tiles_of(recess, Tiling()))
    with pytest.raises(ValueError, match="tile 1-1 at the rim is a sliver of .* give another number of tiles"):
        Tiling(4, 13).cells(Circle(10.0))
    for given, words in (
        ("1x1", "is the whole lens"), ("0x2", "give 1 to 20"), ("2x21", "give 1 to 20"), ("two", "such as 2x3"),
        ((2, 2.5), "such as 2x3"), ((1, 2, 3), "such as 2x3"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            Tiling.parse(given)
    assert Tiling.parse(" 2x3") == Tiling.parse((2, 3)) == Tiling(2, 3) and Tiling.parse(3) == Tiling(3, 3)


def test_the_command_and_python_write_tiles_in_place_of_older_ones(small_design, tmp_path, capsys):
    folder = shutil.copytree(small_design.folder, tmp_path / "copy")
    assert cli.run(["export", str(folder), "--as", "tiles", "--tiles", "1x3"]) == 0
    assert "3 tiles of at most 8 x 2 mm, 1 along x and 3 along y" in capsys.readouterr().out
    design = bstcad.open(folder)
    names = [path.name for path in design.export("tiles", tiles=(2, 1))]
    assert names == ["tile-1-1.step", "tile-2-1.step", "tiles.csv", "tiles.txt", "tiles.svg"]
    assert sorted(path.name for path in folder.glob("tile-*.step")) == names[:2]
    heading, *rows = (folder / "tiles.csv").read_text().splitlines()
    column = heading.split(",").index("volume_mm3")
    assert math.fsum(float(row.split(",")[column]) for row in rows) == pytest.approx(of_lens(design.lens).volume)
    drawing = (folder / "tiles.svg").read_text()
    assert drawing.count("tile-") == 2 + 1 and 'id="joints"' in drawing  # the names, and a title
    with pytest.raises(SceneError, match="tiles = 1x1 is the whole lens"):
        design.export("tiles", tiles="1x1")
    assert cli.run(["export", str(folder), "--as", "tiles", "--tiles", "4"]) == 2
    assert "give columns and rows, such as 2x3" in capsys.readouterr().err
