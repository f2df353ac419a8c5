"""What batoid and mitsuba make of every template through its STEP file, optiland of an exported grid; `make bench`."""

from __future__ import annotations

import numpy as np
import pytest
from tests.shop.test_export import read_zemax

from bstcad.judges import comparison
from bstcad.optics.spline_basis import DEGREE, knots
from bstcad.report import exports
from bstcad.scene.new_scene import templates
from tests.benchmarks.written_lenses import of_template
from tests.cad.test_trimming import plate

pytestmark = pytest.mark.bench

RAYS = 1 << 22
DECLINED = {("sun_caustic", "mitsuba")}  # the sun's directions


@pytest.mark.parametrize("template", templates())
def test_other_programs_agree(template, tmp_path):
    lens = of_template(template, {"tailoring.quality": "draft"}, tmp_path)
    target, channels = lens.scene.target, lens.scene.judging_channels()
    for name in comparison.JUDGES:
        found = comparison.compare(name, lens.lens, channels, target.screen, target.irradiance(), rays=RAYS)
        assert bool(found.declined) is ((template, name) in DECLINED)
        if found.declined:
            print(f"\n{template}, {name}: {found.declined}", end="")
            continue
        print(
            f"\n{template}, {name}: RRMSD {found.rrmsd:.4f}, by bstcad {found.rrmsd_ours:.4f}, apart "
            f"{found.difference:.4f}, noise {found.noise:.4f}, over it {found.over_noise:.3f}; light on the target "
            f"{found.on_target:.5f}, by bstcad {found.on_target_ours:.5f}; {found.seconds:.0f} s",
            end="",
        )
        assert all(check.passed for check in found.checks)


def test_the_grid_sag_for_zemax_is_optiland_s_spline():
    """At each point of the grid, above the vertex, to 1e-9 mm; the knots run from 0 to 1 there."""
    pytest.importorskip("optiland", reason="pip install 'bstcad[judges]'")
    from optiland.coordinate_system import CoordinateSystem
    from optiland.geometries.nurbs.nurbs_geometry import NurbsGeometry

    lens = plate("plane")
    x, y, (z, *_) = read_zemax(exports.zemax_grid(lens, lens.back, 33))
    full = knots(lens.back.m) / knots(lens.back.m)[-1]
    net = np.moveaxis(lens.back.control_points(), -1, 0)
    theirs = NurbsGeometry(
        CoordinateSystem(), control_points=net, u_degree=DEGREE, v_degree=DEGREE, u_knots=full, v_knots=full, tol=1e-13
    )
    at_x, at_y = np.meshgrid(x, y)
    apart = np.abs(theirs.sag(at_x, at_y) - theirs.sag(0.0, 0.0) - z)
    print(f"\n{z.size} points of a relief of {np.ptp(z):.3g} mm: {apart.max():.1e} mm apart at most")
    assert apart.max() < 1e-9
