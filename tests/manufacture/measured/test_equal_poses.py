"""Faces whose form does not tell the rotation about the axis: round ones, and ones that equal themselves turned."""

import numpy as np
import pytest
import torch

from bstcad.manufacture.measured import made_part
from bstcad.manufacture.measured.alignment import BackFace, align, equal_turns, identity_pose, turn_about_axis
from bstcad.manufacture.measured.made_part import Prediction
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Plane
from tests.lenses import net
from tests.manufacture.measured.synthetic import low_order, points


def placed(relief, degrees=0.0, astigmatism=0.0):
    """Return the face of a bowl with a relief (mm) at x and y, and 1500 points of a part that is turned, aligned."""
    back = net(lambda x, y: 0.02 * (x**2 + y**2) + 1e-4 * (x**2 + y**2) ** 2 + relief(x, y), 5.0, 65, 6.0)
    face = BackFace.of(Lens.between(Plane(0.0), back, Circle(5.0), 1.5))
    random, given = np.random.default_rng(4), points(face.lens, 1500)
    given[:, 2] += low_order(given, "astigmatism", astigmatism, random) + random.normal(0.0, 1e-4, len(given))
    start = identity_pose(face).compose(turn_about_axis(face, degrees), face.reach)
    return face, align(face, start.to_design(given), identity_pose(face))


def fourfold(x, y):
    return 2e-3 * (torch.cos(2 * x) + torch.cos(2 * y))


@pytest.mark.parametrize("astigmatism", [0.0, 3e-4])
def test_a_fourfold_face_has_four_equal_poses(astigmatism):
    face, found = placed(fourfold, astigmatism=astigmatism)
    assert equal_turns(face, found) == (90.0, 180.0, 270.0) and not found.turns_freely


def test_a_face_with_one_orientation_has_one_pose():
    face, found = placed(lambda x, y: 2e-3 * torch.sin(2 * x + 0.5 * y))
    assert equal_turns(face, found) == ()


def test_a_round_face_has_every_rotation():
    """Only the rotation about the axis is undetermined; the part is turned by 30 degrees, which nothing shows."""
    face, found = placed(lambda x, y: 0 * x + 0 * y, degrees=30.0)
    turns = equal_turns(face, found)
    assert found.turns_freely and {30.0, 90.0, 120.0, 180.0} <= set(turns)


class Dim:
    def __init__(self, rrmsd):
        self.rrmsd = rrmsd


def test_the_light_is_claimed_for_no_orientation():
    face, found = placed(fourfold)
    turns = equal_turns(face, found)
    same = made_part._orientation(found, turns, Prediction(Dim(0.1), 0.1, 0.01, turned=(0.11, 0.09)))
    assert same.startswith("4 poses fit equally well") and "90, 180, 270 degrees" in same
    assert "is the same there within its uncertainty, 0.09 to 0.11" in same
    other = made_part._orientation(found, turns, Prediction(Dim(0.1), 0.1, 0.01, turned=(0.2, 0.1)))
    assert "depends on it, 0.1 to 0.2" in other
    assert made_part._orientation(found, (), Prediction(Dim(0.1), 0.1, 0.01)) == ""
    face, found = placed(lambda x, y: 0 * x + 0 * y)
    every = made_part._orientation(found, equal_turns(face, found), Prediction(Dim(0.1), 0.1, 0.01, turned=(0.1,)))
    assert every.startswith("The form of the face does not determine the rotation about its axis")
