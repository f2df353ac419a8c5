"""A preview has the lens's outline and front, and its back nearly."""

from dataclasses import replace

import numpy as np
import pytest

from bstcad.cad.likeness import likeness
from bstcad.cad.mass_properties import exact_volume
from bstcad.cad.solid import lens_solid
from bstcad.optics.outlines import Circle
from bstcad.optics.surfaces import sag
from tests.cad.test_trimming import plate, waves


@pytest.mark.parametrize("outline", ["rectangle", "circle"])
def test_it_looks_like_the_lens(outline):
    lens = plate("convex")
    lens = replace(lens, back=waves(129)) if outline == "rectangle" else replace(
        lens, outline=Circle(3.5), back=waves(129, half=(4.0, 4.0))
    )  # fmt: skip
    light = likeness(lens, 33)
    assert light.back.m == 33 and lens_solid(light).isValid()
    assert exact_volume(light) == pytest.approx(exact_volume(lens), rel=2e-3)
    x, y = np.random.default_rng(1).uniform(-2.4, 2.4, (2, 500))
    assert np.abs(sag(light.back, x, y) - sag(lens.back, x, y)).max() < 0.01
    assert likeness(lens, 129).back.m == 129
