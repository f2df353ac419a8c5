"""Height maps are read back by another library, and the command line states the tool of a path."""

import io
import re
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

import bstcad
from bstcad import cli
from bstcad.exports.heightmap import HeightMap
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import sag
from bstcad.scene.errors import SceneError

pytestmark = pytest.mark.usefixtures("few_samples")


@pytest.mark.parametrize("outline", [Rectangle(8.0, 6.0), Circle(3.0)], ids=["plate", "disc"])
def test_a_height_map_is_the_face_by_the_scales_that_it_states(outline):
    heights = torch.from_numpy(np.random.default_rng(5).normal(0.0, 0.1, (21, 21)))
    face = BSplineSurface(4.0, heights, (-5.0, 5.0), (-5.0, 5.0))
    made = HeightMap.of(face, outline, 160)
    numbers = [float(each) for each in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", made.words().replace("heightmap.", ""))]
    columns, rows, pixel, *_, low, white, high, per_grey, _, _ = numbers
    png, tiff = (Image.open(io.BytesIO(data)) for data in (made.png(), made.tiff()))
    assert png.size == tiff.size == (columns, rows) and white == 65535 and png.text["Description"] == made.words()
    assert png.info["dpi"][0] == pytest.approx(25.4 / pixel, rel=1e-3)
    x = (np.arange(columns) + 0.5) * pixel - columns * pixel / 2  # left to right, and from the top down
    y = rows * pixel / 2 - (np.arange(rows) + 0.5) * pixel
    x, y = (at.copy() for at in np.broadcast_arrays(x, y[:, None]))
    inside = outline.depth(x, y) > 1e-9
    exact = sag(face, x[inside], y[inside])
    assert np.abs(low + per_grey * np.asarray(png, float)[inside] - exact).max() < 0.51 * per_grey
    assert np.abs(low + np.asarray(tiff, float)[inside] - exact).max() < 1e-6
    assert high == pytest.approx(low + 65535 * per_grey) and not np.asarray(png)[~inside].any()


def test_the_command_and_python_state_the_tool(small_design, tmp_path, capsys):
    folder = shutil.copytree(small_design.folder, tmp_path / "copy")
    options = ["--tool-radius", "1", "--cusp", "0.02", "--along", "y", "--stock", "0.3", "--feed", "500"]
    assert cli.run(["export", str(folder), "--as", "raster,heightmap", "--points", "64", *options]) == 0
    out = capsys.readouterr().out
    assert "Ball end mill of radius 1 mm" in out and "lines along y" in out and "deepest gouge" in out
    assert "mm per grey" in out and "leaves 0.3 mm" in out and "Feed 500 mm/min" in out
    text = (folder / "toolpath-raster.nc").read_text()
    assert "F500" in text and "(Roughing)" in text and "Zero point: X0 Y0" in text
    shop, spec = tmp_path / "new" / "shop", ["--as", "raster,heightmap,tiles", "--tiles", "2x1", "--zero", "bottom"]
    before = {path.name for path in folder.iterdir()}
    for columns, expected in (("3x1", 3), ("2x1", 2)):  # older tiles are removed
        spec[3] = columns
        assert cli.run(["export", str(folder), *spec, "--cusp", "0.05", "-o", str(shop)]) == 0
        for pattern in ("tile-*-*.step", "toolpath-raster-tile-*-*.nc", "heightmap-tile-*-*.png"):
            assert len(list(shop.glob(pattern))) == expected
    assert not (shop / "toolpath-raster.nc").exists() and before == {path.name for path in folder.iterdir()}
    assert "Z0 on the bottom of the blank" in capsys.readouterr().out
    assert cli.run(["export", str(folder), "--as", "svg", "-o", str(shop / "tiles.csv")]) == 2
    assert "tiles.csv is a file; give another folder" in capsys.readouterr().err
    design = bstcad.open(folder)
    [*_, words] = design.export("raster", cusp=0.05, folder=tmp_path / "python")
    assert words.parent == tmp_path / "python" and "Z0 on the top" in words.read_text()
    scene = folder / "scene.toml"
    scene.write_text(scene.read_text().replace('zero = "top"', 'zero = "bottom"'))
    [*_, words] = bstcad.open(folder).export("raster", cusp=0.05)
    assert "Z0 on the bottom" in words.read_text()
    names = {path.name for path in design.export("spiral", tool_radius=2.0, cusp=1e-2)}
    assert names == {"toolpath-spiral.csv", "toolpath-spiral.txt"}
    assert "radius 2 mm" in (folder / "toolpath-spiral.txt").read_text()
    for wrong, words in (({"tool_radius": "big"}, "'big' is not a number"), ({"nose": 1.0}, "'nose' is no setting")):
        with pytest.raises(SceneError, match=words):
            design.export("spiral", **wrong)
    assert cli.run(["export", str(folder), "--as", "raster", "--cusp", "-1"]) == 2
    err = capsys.readouterr().err
    assert "cusp = -1 mm is not possible; give a value from 1e-07 to 10" in err and err.count("\n") == 1
