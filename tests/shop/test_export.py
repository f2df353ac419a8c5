"""Files for the shop hold the exact surfaces, read back by readers that share no line with what wrote them."""

import csv
import io
import shutil
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch

import bstcad
from bstcad import cli
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.surfaces import Sphere, sag
from bstcad.scene.scene import Output
from bstcad.shop import export, tables
from bstcad.shop.tables import axes, on_grid

RECTANGLE, CIRCLE = Rectangle(8.0, 6.0), Circle(3.0)


def wavy(outline, m=21):
    """A lens whose back has waves of all lengths that its net can hold, and its vertex nowhere special."""
    a, b = outline.half_extent
    if outline.shape == "circle":
        a = b = outline.radius * (m - 1) / (m - 6)  # the net goes on behind the rim
    heights = torch.from_numpy(np.random.default_rng(7).normal(0.0, 0.02, (m, m)))
    return Lens(Sphere(1.0, 0.02), BSplineSurface(4.0, heights, (-a, a), (-b, b)), outline, 1.49)


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
    x, y, (z, z_x, z_y, z_xy) = read_zemax(tables.zemax_grid(lens, lens.back, 33))
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
    found = table_of(tables.sag_table(lens, 41))
    x, y = found["x_mm"], found["y_mm"]
    assert np.ptp(x) == pytest.approx(2 * outline.half_extent[0]) and np.ptp(y) == pytest.approx(
        2 * outline.half_extent[1]
    )
    assert outline.contains(torch.from_numpy(x), torch.from_numpy(y)).all()
    assert np.abs(found["back_z_mm"] - sag(lens.back, x, y)).max() < 1e-10
    assert np.abs(found["front_z_mm"] - sag(lens.front, x, y)).max() < 1e-10
    turned = table_of(tables.turning_cloud(lens, 21))
    angle = np.radians(turned["angle_deg"])
    x, y = turned["radius_mm"] * np.cos(angle), turned["radius_mm"] * np.sin(angle)
    assert np.abs(turned["sag_mm"] - (sag(lens.back, x, y) - sag(lens.back, 0.0, 0.0))).max() < 1e-9
    reach, rings = np.hypot(*outline.farthest), np.unique(turned["radius_mm"])
    assert rings[-1] >= reach * (1 - 1.001 / 20) and np.ptp(np.diff(rings)) < 1e-9 and turned["sag_mm"][0] == 0


@pytest.mark.parametrize("side", ["front", "back"])
def test_normals_point_out_of_the_lens_and_stand_on_the_face(side):
    lens = wavy(RECTANGLE)
    face = getattr(lens, side)
    found = table_of(tables.points_table(lens, face, 61))
    normal = np.array([found[f"normal_{axis}"] for axis in "xyz"])
    assert np.abs(np.linalg.norm(normal, axis=0) - 1).max() < 1e-11
    assert (normal[2] < 0).all() if side == "front" else (normal[2] > 0).all()
    x, y, step = found["x_mm"], found["y_mm"], 1e-6
    for ahead in ((step, 0.0), (0.0, step)):  # a step along the face is square to the normal
        rise = sag(face, x + ahead[0], y + ahead[1]) - sag(face, x - ahead[0], y - ahead[1])
        along = normal[0] * 2 * ahead[0] + normal[1] * 2 * ahead[1] + normal[2] * rise
        inner = (np.abs(x) < 3.9) & (np.abs(y) < 2.9)
        assert np.abs(along[inner]).max() < 1e-7 * step * 1e3


def test_derivatives_on_a_grid_are_those_of_a_polynomial():
    """Where the net is a product x y of one bend, ∂²z/∂x∂y is that everywhere, in the end spans too."""
    lens = wavy(RECTANGLE)
    net = lens.back.control_points()
    bent = replace(lens.back, heights=torch.from_numpy(0.05 * net[..., 0] * net[..., 1]))
    x, y = axes(RECTANGLE, 57)
    _, z_x, z_y, z_xy = on_grid(bent, x, y)
    assert z_xy == pytest.approx(0.05, abs=1e-13)
    assert np.abs(z_x - 0.05 * y).max() < 1e-13 and np.abs(z_y - 0.05 * x[:, None]).max() < 1e-13


def test_the_command_and_the_scene_write_every_kind_and_the_design_still_proves(small_design, tmp_path, capsys):
    folder = shutil.copytree(small_design.folder, tmp_path / "copy")  # which other tests look at
    kinds = list(export.ALL)
    assert cli.EXPORTS.split(", ") == kinds
    assert set(get_args(get_args(Output.model_fields["export"].annotation)[0])) == set(kinds)
    sheet = (folder / "datasheet.pdf").read_bytes()
    assert cli.run(["export", str(folder), "--as", ", ".join(kinds), "--points", "17"]) == 0
    out = capsys.readouterr().out
    written = {"sag.csv", "points-front.csv", "points-back.csv", "zemax-back.dat", "turning.csv", "outline.dxf",
               "outline.svg", "preview.glb", "preview.3mf", "datasheet.pdf"}  # fmt: skip
    assert all(str(folder / name) in out for name in written)
    assert (folder / "datasheet.pdf").read_bytes() == sheet  # as generate drew it
    design = bstcad.open(folder)
    x, y, (z, *_) = read_zemax((folder / "zemax-back.dat").read_text())
    lens = design.lens
    assert np.abs(z + sag(lens.back, 0.0, 0.0) - sag(lens.back, *np.meshgrid(x, y))).max() < 1e-12
    assert [path.name for path in design.export("svg")] == ["outline.svg"]


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--as", "iges"], "'iges' is nothing that can be exported; give one of sag, points"),
        ([], "--as is missing; give what to write"),
        (["--as", "sag", "--points", "2"], "2 points a side are not possible; give 3 to 4097"),
    ],
)
def test_what_cannot_be_exported_is_one_sentence(arguments, words, small_design, capsys):
    before = sorted(path.name for path in small_design.folder.iterdir())
    assert cli.run(["export", str(small_design.folder), *arguments]) == 2
    err = capsys.readouterr().err
    assert words in err and err.count("\n") == 1
    assert sorted(path.name for path in small_design.folder.iterdir()) == before


def test_a_data_sheet_needs_the_report_that_it_quotes(small_design, tmp_path, capsys):
    folder = shutil.copytree(small_design.folder, tmp_path / "copy")
    (folder / "report.json").unlink()
    (folder / "datasheet.pdf").unlink()
    assert cli.run(["export", str(folder), "--as", "datasheet"]) == 2
    err = capsys.readouterr().err
    assert "report.json: cannot be read" in err and "bstcad verify writes it anew" in err and err.count("\n") == 1
    assert not (folder / "datasheet.pdf").exists()
