"""Loops of wires: their normals point into the lens, in whatever order and direction their edges were drawn."""

from __future__ import annotations

import cadquery
import numpy as np
import pytest
import shapely

from bstcad.cad import wires

WIRES = {
    "circle": lambda plane: plane.center(1.0, -2.0).circle(5.0),
    "rectangle": lambda plane: plane.rect(8.0, 5.0),
    "slot": lambda plane: plane.slot2D(9.0, 4.0, 30.0),
    "ellipse": lambda plane: plane.ellipse(6.0, 3.0),
    "spline": lambda plane: plane.spline([(5.0, 0.0), (0.0, 4.0), (-6.0, 1.0), (0.0, -3.0)], periodic=True),
}


def loop_of(name, reverse):
    loop = wires.wire_loop(WIRES[name](cadquery.Workplane("XY")))
    return wires.reversed_loop(loop) if reverse else loop


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("name", WIRES)
def test_each_normal_is_a_unit_vector_a_quarter_turn_left_of_the_direction(name, reverse):
    for piece in loop_of(name, reverse):
        t = np.linspace(0.02, 0.98, 9) * piece.end
        step = 1e-6 * piece.end
        along = (piece.points(t + step) - piece.points(t - step)) / (2 * step)
        along /= np.linalg.norm(along, axis=1)[:, None]
        assert np.abs(piece.left(t) - along[:, ::-1] * (-1, 1)).max() < 1e-6  # error of the differences


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("name", WIRES)
def test_a_loop_is_closed_and_has_its_inside_on_one_side(name, reverse):
    loop = loop_of(name, reverse)
    area = wires.polygon(loop)
    sides = set()
    for piece, following in zip(loop, loop[1:] + loop[:1], strict=True):
        assert piece.at(piece.end) == pytest.approx(following.at(0.0), abs=1e-7)
        t = np.linspace(0.1, 0.9, 5) * piece.end
        inner = piece.points(t) + 0.1 * piece.left(t)
        sides |= {bool(area.contains(shapely.Point(point))) for point in inner}
    assert len(sides) == 1
    corners = np.concatenate([piece.points(np.linspace(0, piece.end, 200)) for piece in loop])
    x, y = corners.T
    turns = float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
    assert (turns > 0) == sides.pop()  # counterclockwise: the inside is on the left


@pytest.mark.parametrize("name", WIRES)
def test_no_piece_of_a_loop_is_closed(name):
    """A wall of one closed piece would meet itself in a seam."""
    assert all(np.hypot(*np.subtract(p.at(0.0), p.at(p.end))) > 1e-3 for p in loop_of(name, False))
