"""The record of what tailoring changes: taken from one lens, it makes another of the same blank."""

from dataclasses import replace

import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.surfaces import Plane, Sphere
from bstcad.tailoring.parameters import Parameters


def lens_of(front):
    heights = torch.zeros((9, 9), dtype=torch.float64)
    return Lens(front, BSplineSurface(20.0, heights, (-8.0, 8.0), (-8.0, 8.0)), Rectangle(16.0, 16.0), 1.5)


def test_what_is_taken_from_a_lens_makes_it_again():
    blank = lens_of(Sphere(15.0, 0.0))
    heights = torch.rand((17, 17), dtype=torch.float64)
    lens = replace(blank, front=replace(blank.front, curvature=0.01), back=replace(blank.back, z=21.0, heights=heights))
    found = Parameters.of(lens).applied(blank)
    assert found == lens


def test_every_free_net_has_its_entry():
    net = lens_of(Plane(15.0)).back
    lens = replace(lens_of(replace(net, z=15.0)), free=(0, 1))
    shaped = lens.with_heights((torch.rand((9, 9), dtype=torch.float64), torch.rand((17, 17), dtype=torch.float64)))
    kept = Parameters.of(shaped)
    assert [entry.z for entry in kept.nets] == [15.0, 20.0] and kept.front == {}
    assert kept.applied(lens) == shaped


def test_a_plane_has_nothing_to_tailor():
    lens = lens_of(Plane(15.0))
    assert Parameters.of(lens).front == {} and Parameters.of(lens).applied(lens).front == lens.front
