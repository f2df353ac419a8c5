"""The exported grid sag against the spline of optiland, a program not written here, on the design's own net and knots.

pytest -s -m bench tests/benchmarks/test_judge_optiland.py
"""

import numpy as np
import pytest

from bstcad.optics.spline_basis import DEGREE, knots
from bstcad.shop import tables
from tests.cad.test_trimming import plate
from tests.shop.test_export import read_zemax

pytestmark = pytest.mark.bench


def test_the_grid_sag_for_zemax_is_optiland_s_spline():
    """At each point of the grid, above the vertex, to 1e-9 mm; the knots run from 0 to 1 there."""
    pytest.importorskip("optiland", reason="pip install 'bstcad[judges]'")
    from optiland.coordinate_system import CoordinateSystem
    from optiland.geometries.nurbs.nurbs_geometry import NurbsGeometry

    lens = plate("plane")
    x, y, (z, *_) = read_zemax(tables.zemax_grid(lens, lens.back, 33))
    full = knots(lens.back.m) / knots(lens.back.m)[-1]
    net = np.moveaxis(lens.back.control_points(), -1, 0)
    theirs = NurbsGeometry(
        CoordinateSystem(), control_points=net, u_degree=DEGREE, v_degree=DEGREE, u_knots=full, v_knots=full, tol=1e-13
    )
    at_x, at_y = np.meshgrid(x, y)
    apart = np.abs(theirs.sag(at_x, at_y) - theirs.sag(0.0, 0.0) - z)
    print(f"\n{z.size} points of a relief of {np.ptp(z):.3g} mm: {apart.max():.1e} mm apart at most")
    assert apart.max() < 1e-9
