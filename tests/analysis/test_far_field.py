"""Far fields: a plate leaves directions as they are, so that the intensity behind it is that of the source."""

from __future__ import annotations

import math

import numpy as np
import photompy
import pytest

import bstcad
from bstcad.analysis.far_field import SEED, FarField, default_grid, grid_of
from bstcad.api import Design
from bstcad.optics.lens.losses import FresnelLoss, Losses
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.directions import Directions
from bstcad.optics.receivers.irradiance import Screen, leaving
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.measure import GHOST_DIVISOR, simulated
from bstcad.optics.trace.trace import ghost_light
from bstcad.photometry import intensity_files, ray_files
from bstcad.photometry.intensity import Intensity
from tests import suite
from tests.conftest import pictures, quick_effort
from tests.efforts import designed_quickly
from tests.lenses import lens_of, net
from tests.photometry.other_readers import assert_is_an_l, read_by_others

PLATE = lens_of(net(lambda x, y: 0 * x, 22.0, 17, half=11.0), Plane(20.0), Circle(10.0), 1.5)


def test_the_intensity_of_a_lambertian_behind_a_plate_is_its_own():
    """I = cos γ / π of the flux up to the angle that the plate's rim leaves; the sum is the flux that passes."""
    source = PointSource((0.0, 0.0, 0.0))
    table = FarField((Channel(source, 1.5),), lumens=100.0).table(PLATE, rays=1024)
    gamma = np.radians(np.arange(1.0, 20.0))
    assert table.candela[:, 1:20].mean(0) == pytest.approx(100 * np.cos(gamma) / math.pi, rel=0.01)
    inside = math.atan2(10.0 - 2.0 * 0.3, 20.0)  # the rim of the back, seen through the glass
    assert table.lumens == pytest.approx(100 * math.sin(inside) ** 2, rel=0.03)


def test_a_tilted_beam_is_where_its_direction_is():
    """C counts from x towards -y: the beam of a tilt about x and y lies at atan2(-n_y, n_x)."""
    source = CollimatedSource(Circle(8.0), tilt=(10.0, 15.0))
    table = FarField((Channel(source, 1.5),)).table(PLATE, rays=512)
    n_x, n_y, n_z = source.axes[2]
    k, j = np.unravel_index(table.candela.argmax(), table.candela.shape)
    assert table.around[k] == pytest.approx(math.degrees(math.atan2(-n_y, n_x)) % 360, abs=3.0)
    assert table.along[j] == pytest.approx(math.degrees(math.acos(n_z)), abs=0.6)


def test_the_flux_of_the_table_is_that_of_the_ledger_with_the_ghost():
    """Losses at faces are taken, the light reflected twice is contained; the sum is exact for the same rays."""
    channel = Channel(PointSource((0.0, 0.0, 0.0)), 1.5, losses=Losses(FresnelLoss(587.6)))
    screen = Screen(0.0, *2 * ((-90.0, 90.0),), pixels=720, surface=Directions("C"))
    [light] = simulated(PLATE, (channel,), [screen], 256, seed=SEED)
    ghost = ghost_light(PLATE, (channel,), screen, 256 // GHOST_DIVISOR, SEED)
    assert float(ghost.picture.sum()) > 1e-3 * leaving(light.flux)
    bare, whole = (
        FarField((channel,), lumens=100.0, ghost=each).table(PLATE, rays=256).lumens for each in (None, ghost_light)
    )
    assert bare == pytest.approx(100 * leaving(light.flux), rel=1e-6)
    assert whole == pytest.approx(100 * leaving({**light.flux, **ghost.flux}), rel=1e-6)


def test_the_grid_of_a_file_is_completed_to_90_degrees():
    def grid(around, along, kind="C"):
        return grid_of(Intensity(kind, np.array(around, float), np.array(along, float), np.ones((1, 1))))

    around, along = grid([0, 30, 90, 240], [0, 10, 30, 40])
    assert list(around) == [0, 30, 90, 240] and list(along) == [0, 10, 30, 40, 50, 60, 70, 80, 90]
    assert list(grid([0], [30, 50, 180])[1]) == [0, 10, 30, 50, 180]
    assert len(grid([0], [0, 90])[0]) == 72
    for own, default in zip(grid([-90, 90], [-90, 90], "B"), default_grid(), strict=True):
        assert np.array_equal(own, default)


@suite.in_turn(0, 3)
def test_a_design_exports_what_others_read(design):
    """All files have one flux, that of the ledger for 1000 lm; an L is upright for two packages of others."""
    [one, other, table, rays] = design.export("ies", "ldt", "csv", "tm25")
    tables = [intensity_files.read(path.name, path.read_bytes()) for path in (one, other, table)]
    lumens = 1000 * leaving(design.report.flux)
    for found in tables:
        assert found.lumens == pytest.approx(lumens, rel=1e-3)
        assert found.candela == pytest.approx(tables[2].candela, abs=1e-3 * tables[2].candela.max())
    assert [found.rated_lumens for found in tables] == [1000.0, 1000.0, None]
    for found in read_by_others(other).values():
        assert_is_an_l(found)
    light = ray_files.read(rays.name, rays)
    assert (light.unit, light.flux) == ("W", pytest.approx(leaving(design.report.flux), rel=5e-3))
    # the integral of another package, of the file that states C = 360°
    assert photompy.IESFile.read(one).photometry.total_optical_power() == pytest.approx(lumens, rel=2e-3)


def test_the_figures_of_a_target_over_directions_are_drawn(design):
    names = {path.stem for path in (design.folder / "figures").iterdir()}
    assert {"polar", "isocandela"} <= names and not {"cone", "isolux"} & names  # the flux is not known


@pytest.fixture(scope="module")
def design(tmp_path_factory):
    scene = bstcad.load("templates/disk.toml").changed({
        "lens.back.control_points": 49, "tailoring.quality": "draft", "tailoring.rays": 96,
        "tailoring.stage2_iterations": 3, "effects": [{"kind": "fresnel"}],
        "target": {"kind": "intensity", "x": [-24.0, 24.0], "y": [-24.0, 24.0], "pixels": 48, "text": "L"},
    })  # fmt: skip
    made = Design(designed_quickly(scene))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bstcad.commands.Pictures", pictures("lens"))
        made.write(tmp_path_factory.mktemp("far") / "design", progress=False, effort=quick_effort())
    return made
