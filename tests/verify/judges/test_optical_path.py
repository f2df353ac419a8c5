"""Optical path and landing places through two freeform faces: batoid against bstcad, and a wrong path shows."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from tests.verify.judges.lenses import MIRROR, waved
from tests.verify.judges.paths import paths_apart

PATH, PLACE = 1e-6, 1e-9  # mm: a nanometre of path, a picometre of place
SCREEN = 120.0  # mm
APERTURE = Circle(8.5)
BEAM = CollimatedSource(Circle(8.0))
SOURCES = {
    "a beam": BEAM,
    "a tilted beam": replace(BEAM, tilt=(4.0, -6.0), centre=(0.5, -0.3), z=2.0),
    "a point": PointSource((1.0, -0.5, -60.0), profile="gaussian", half_angle_1e2=5.0),
}


def two_nets():
    return Lens.between(waved(10.0, 33, 0.03, 0.4), waved(20.0, 41, -0.05, 1.1), APERTURE, 1.49)


@pytest.fixture
def batoid():
    pytest.importorskip("batoid")
    from bstcad.verify.judges import batoid

    return batoid


@pytest.mark.parametrize("name", SOURCES)
def test_batoid_agrees_on_paths_and_places_through_two_nets(batoid, name):
    found = paths_apart(two_nets(), SOURCES[name], SCREEN)
    assert found.path < PATH and found.place < PLACE and found.rays > 5000


@pytest.mark.parametrize("front", [Plane(10.0), Sphere(10.0, 0.01)], ids=lambda front: front.kind)
def test_batoid_agrees_through_one_net(batoid, front):
    found = paths_apart(two_nets().with_front(front), BEAM, SCREEN)
    assert found.path < PATH and found.place < PLACE


def test_batoid_agrees_on_a_mirror(batoid):
    lamp = PointSource((0.5, 1.0, 90.0), profile="uniform", half_angle=5.0)
    found = paths_apart(replace(MIRROR, outline=Rectangle(17.0, 17.0)), lamp, 400.0)
    assert found.path < PATH and found.place < PLACE


@pytest.mark.parametrize("wrong", ["index", "three nanometres of glass", "turned"])
def test_a_wrong_lens_shows(batoid, monkeypatch, wrong):
    """batoid is given another one; of as little as that, the path tells."""
    honest, lens = batoid.through, two_nets()

    def through(glass, known, rays):
        if wrong == "index":
            return honest(replace(glass, index=glass.index + 2e-7), known, rays)
        back = glass.back.moved(20.0 + 3e-6) if "glass" in wrong else replace(glass.back, heights=glass.back.heights.T)
        return honest(glass, batoid.surfaces(glass.with_back(back)), rays)

    monkeypatch.setattr(batoid, "through", through)
    found = paths_apart(lens, BEAM, SCREEN)
    assert found.path > PATH
    assert wrong != "turned" or found.place > PLACE
