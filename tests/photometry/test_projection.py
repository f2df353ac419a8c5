"""Projection on a file's grid: the flux is exact, and an intensity that the grid can state is returned."""

from __future__ import annotations

import numpy as np
import pytest

from bstcad.photometry import projection
from bstcad.photometry.intensity import Intensity
from bstcad.photometry.projection import Projection

GRIDS = {
    "even": (np.arange(0.0, 360.0, 5.0), np.arange(0.0, 91.0, 1.0)),
    "uneven": (
        np.array([0.0, 20.0, 50.0, 90.0, 120.0, 180.0, 240.0, 300.0]),
        np.array([0.0, 2.0, 4.0, 8.0, 15.0, 25.0, 40.0, 60.0]),
    ),
    "one plane": (np.zeros(1), np.arange(0.0, 91.0, 2.5)),
    "all directions": (np.arange(0.0, 360.0, 30.0), np.arange(0.0, 181.0, 10.0)),
}


def field(around, along):
    """A smooth intensity to one side; the same on all planes if there is only one."""
    c, g = np.radians(around)[:, None], np.radians(along)[None]
    side = 0.0 if len(around) == 1 else 0.6
    return 100 * np.exp(-((g / 0.7) ** 2)) * (1 + side * np.sin(g) * np.cos(c - 0.4))


def flux_of(table, steps=(360, 2000)):
    """Directions and flux of the bilinear intensity of a table, on a fine grid."""
    c = (np.arange(steps[0]) + 0.5) * 360 / steps[0]
    edges = np.radians(np.linspace(0.0, table.along[-1], steps[1] + 1))
    g = np.degrees((edges[1:] + edges[:-1]) / 2)
    at_c, at_g = (part.ravel() for part in np.meshgrid(c, g, indexing="ij"))
    solid = np.tile(-np.diff(np.cos(edges)) * 2 * np.pi / steps[0], steps[0])
    return at_c, at_g, table.between(at_c, at_g) * solid


@pytest.mark.parametrize("name", GRIDS)
def test_an_intensity_of_the_grid_is_returned_with_its_flux(name, monkeypatch):
    """Coarse uneven grids need more iterations for the same accuracy; the flux needs none."""
    monkeypatch.setattr(projection, "ITERATIONS", {"uneven": 30}.get(name, projection.ITERATIONS))
    given = Intensity("C", *GRIDS[name], field(*GRIDS[name]))
    c, gamma, flux = flux_of(given)
    sums = Projection(*GRIDS[name])
    for part in (slice(None, None, 2), slice(1, None, 2)):
        sums.add(c[part], gamma[part], flux[part])
    found = sums.table()
    assert found.lumens == pytest.approx(flux.sum(), rel=1e-9)
    assert found.candela == pytest.approx(given.candela, abs=0.015 * given.candela.max())
    assert np.ptp(found.candela[:, 0]) < 1e-9  # on the axis all planes agree


def test_noise_near_the_axis_is_like_that_elsewhere():
    """Rays of an even intensity: planes that are closer than 1 degree share their rays."""
    random, count = np.random.default_rng(3), 1_000_000
    gamma = np.degrees(np.arccos(1 - random.random(count) * (1 - np.cos(np.radians(30)))))
    sums = Projection(*GRIDS["even"])
    sums.add(360 * random.random(count), gamma, np.full(count, 1.0))
    found = sums.table()
    noise = found.candela.std(0) / found.candela[:, :28].mean()
    assert found.lumens == pytest.approx(count, rel=1e-9)
    assert noise[1:28].max() < 0.12  # about 200 to 1500 rays in a cell
    assert noise[1:5].max() < 3 * noise[20:28].mean()


def test_light_at_an_edge_is_never_negative():
    c, gamma, flux = flux_of(Intensity("C", *GRIDS["even"], np.ones((72, 91))))
    sums = Projection(*GRIDS["even"])
    sums.add(c, gamma, flux * (np.abs(gamma - 25) < 6) * (c < 90))
    found = sums.table()
    assert found.candela.min() >= 0
    assert found.between(np.array([45.0]), np.array([25.0])) == pytest.approx(1.0, rel=0.01)
    assert found.between(np.array([45.0]), np.array([40.0])) < 1e-3
    assert found.candela.max() < 1.25  # the overshoot beside an edge, at a corner that of both directions
