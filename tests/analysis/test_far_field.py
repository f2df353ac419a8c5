"""Far fields: a plate leaves directions as they are, so that the intensity behind it is that of the source."""

from __future__ import annotations

import math

import numpy as np
import pytest

import bstcad
from bstcad.analysis.far_field import FarField
from bstcad.optics.channels import Channel
from bstcad.optics.collimated import Collimated
from bstcad.optics.outlines import Circle
from bstcad.optics.point import Point
from bstcad.optics.surfaces import Plane
from bstcad.photometry import eulumdat, ies
from tests.lenses import lens_of, net

PLATE = lens_of(net(lambda x, y: 0 * x, 22.0, 17, half=11.0), Plane(20.0), Circle(10.0), 1.5)


def test_the_intensity_of_a_lambertian_behind_a_plate_is_its_own():
    """I = cos γ / π of the flux up to the angle that the plate's rim leaves; the sum is the flux that passes."""
    source = Point((0.0, 0.0, 0.0))
    table = FarField((Channel(source, 1.5),), lumens=100.0).table(PLATE, rays=1024)
    gamma = np.radians(np.arange(1.0, 20.0))
    assert table.candela[:, 1:20].mean(0) == pytest.approx(100 * np.cos(gamma) / math.pi, rel=0.01)
    inside = math.atan2(10.0 - 2.0 * 0.3, 20.0)  # the rim of the back, seen through the glass
    assert table.lumens == pytest.approx(100 * math.sin(inside) ** 2, rel=0.03)


def test_a_tilted_beam_is_where_its_direction_is():
    """C counts from x towards -y: the beam of a tilt about x and y lies at atan2(-n_y, n_x)."""
    source = Collimated(Circle(8.0), tilt=(10.0, 15.0))
    table = FarField((Channel(source, 1.5),)).table(PLATE, rays=512)
    n_x, n_y, n_z = source.axes[2]
    k, j = np.unravel_index(table.candela.argmax(), table.candela.shape)
    assert table.around[k] == pytest.approx(math.degrees(math.atan2(-n_y, n_x)) % 360, abs=3.0)
    assert table.along[j] == pytest.approx(math.degrees(math.acos(n_z)), abs=0.6)


def test_a_design_exports_what_others_read(tmp_path, prepared_design):
    """Both files have one flux, absolute with source.lumens and for 1000 lm without."""
    design = prepared_design
    [one, other] = design.export("ies", "ldt")
    tables = ies.read(one.read_bytes()), eulumdat.read(other.read_bytes())
    assert tables[0].lumens == pytest.approx(tables[1].lumens, rel=1e-4)
    assert {table.rated_lumens for table in tables} == {1000.0}


@pytest.fixture
def prepared_design(tmp_path):
    scene = bstcad.load("templates/disk.toml").changed({
        "lens.back.control_points": 33, "target.pixels": 32, "tailoring.quality": "draft", "tailoring.rays": 96,
        "tailoring.stage2_iterations": 2,
    })  # fmt: skip
    design = bstcad.design(scene, progress=False)
    design.write(tmp_path / "design", progress=False)
    return design
