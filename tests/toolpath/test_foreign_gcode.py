"""The G-code of a raster by a foreign parser: its moves are the points of the table beside it."""

import io
import math

import gcodeparser
import numpy as np
import pytest

from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.toolpath.raster import PLUNGE, SAFE_HEIGHT
from tests.toolpath.test_simulated_shop import lens_of, waves, written

FEED, DIGITS = 640.0, 0.5e-4  # mm/min; half of the last digit of the file, mm


def run(text):
    """The commands of a file in their order, and the (n, 5) moves: kind 0 or 1, x, y, z (mm) and feed (mm/min)."""
    place, feed, moves, commands = dict.fromkeys("XYZ", math.nan), math.nan, [], []
    for line in gcodeparser.parse_gcode_lines(text):
        commands.append(line.command_str)
        if line.type is gcodeparser.Commands.MOVE:
            assert set(line.params) <= set("XYZF")
            place |= {axis: value for axis, value in line.params.items() if axis != "F"}
            feed = line.params.get("F", feed)
            moves.append((line.command[1], *place.values(), feed))
    return commands, np.array(moves)


@pytest.mark.parametrize("outline", [Circle(6.0), Rectangle(12.0, 9.0)])
def test_a_foreign_parser_finds_the_points_of_the_table(outline):
    files = written("raster", lens_of(waves, outline), tool_radius=1.5, cusp=0.05, stock=0.2, depth=1.0, feed=FEED)
    commands, moves = run(files["toolpath-raster.nc"])
    assert [each for each in commands if each not in ("G0", "G1")] == ["G21", "G90", "G94", "G17", "M2"]
    assert commands[:4] == ["G21", "G90", "G94", "G17"] and commands[-1] == "M2"
    table = np.loadtxt(io.StringIO(files["toolpath-raster.csv"]), delimiter=",", skiprows=1)
    first = np.append(True, np.diff(table[:, 0]) != 0)  # of a pass
    points = np.round(table[:, 2:], 4)
    differs = first | np.append(True, (np.diff(points, axis=0) != 0).any(1))
    cut = moves[moves[:, 0] == 1]
    assert len(cut) == differs.sum() and np.abs(cut[:, 1:4] - points[differs]).max() <= 2 * DIGITS
    assert cut[first[differs], 4] == pytest.approx(PLUNGE * FEED, rel=5e-5) and cut[
        ~first[differs], 4
    ] == pytest.approx(FEED)
    rapid = moves[moves[:, 0] == 0]
    assert (rapid[:, 3] == SAFE_HEIGHT).all() and len(rapid) == 2 * first.sum() + 3
    assert cut[:, 3].max() < SAFE_HEIGHT
