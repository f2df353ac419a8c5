"""The solid of a bare lens: its net, its round rim, and lenses of which there is none; see also test_fronts."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bstcad.cad import nurbs, patches
from bstcad.cad.mass_properties import exact_volume
from bstcad.cad.solid import lens_solid
from bstcad.optics.bspline import BSplineSurface, knots
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle
from bstcad.optics.surfaces import Plane, Sphere


def test_poles_and_knots_are_the_design(make_lens):
    lens = make_lens(m=33)
    surface = patches.back_patch(lens).surface
    assert np.array_equal(nurbs.net_of(surface), lens.back.control_points())
    for full in nurbs.knots_of(surface):
        assert np.array_equal(full, knots(33))
    assert (surface.UDegree(), surface.VDegree()) == (2, 2)


def test_a_round_rim_is_exact_in_the_face_and_tight_in_space(make_lens):
    lens = make_lens(outline=Circle(12.0), m=33)
    patch = patches.back_patch(lens)
    rim = patch.borders["rim"]
    for t in np.linspace(0.0, 2 * np.pi, 997):
        uv, on_cylinder, p = rim.uv.Value(t), rim.around.Value(t), rim.curve.Value(t)
        q = patch.surface.Value(uv.X(), uv.Y())
        assert np.hypot(q.X(), q.Y()) == pytest.approx(12.0, abs=1e-12)
        assert p.Distance(q) < 2 * patches.RIM
        assert on_cylinder.X() == pytest.approx(t, abs=1e-12)
        assert on_cylinder.Y() == pytest.approx(p.Z(), abs=1e-12)


def test_float32_heights_make_the_same_solid_as_their_float64_values(make_lens):
    lens = make_lens(m=9)
    single = Lens(lens.front, lens.back.to(torch.float32), lens.outline, lens.index)
    same = Lens(lens.front, single.back.to(torch.float64), lens.outline, lens.index)
    assert exact_volume(single) == exact_volume(same)
    assert lens_solid(single).isValid()


def of_net(*ends):
    back = BSplineSurface(20.0, torch.zeros(17, 17), *((-end, end) for end in ends))
    return Lens(Plane(8.0), back, Circle(12.0), 1.5)


def test_a_lens_that_cannot_be_is_refused_in_one_sentence(make_lens):
    for lens, words in (
        (make_lens(Plane(19.0)), "move the front down"),
        (make_lens(Sphere(0.0, -0.08)), "ends inside the lens's rim"),
        (of_net(12.0, 12.0), "two spans past the rim"),
        (of_net(20.0, 24.0), "square net"),
    ):
        with pytest.raises(ValueError, match=words):
            lens_solid(lens)
