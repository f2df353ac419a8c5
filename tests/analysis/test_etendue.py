"""Étendue: closed forms of discs, chips and the sun, and the sentences that a request gets which it forbids."""

import math

import numpy as np
import pytest

import bstcad
from bstcad.analysis.etendue import FORBIDDEN, Silhouette, etendue
from bstcad.planning.plan import plan
from tests.planning.conftest import typical_pilot

LAMP = {
    "name": "lamp",
    "source": {
        "kind": "point", "position": [0, 0, 0], "profile": "lambertian", "half_angle": 30.0, "wavelength": 550.0,
    },
    "lens": {
        "material": "PMMA", "outline": {"shape": "circle", "diameter": 60.0}, "front": {"kind": "plane", "z": 20.0},
        "back": {"kind": "bspline", "z": 26.0, "control_points": 17},
    },
    "target": {"kind": "intensity", "x": [-5, 5], "y": [-5, 5], "pixels": 40, "uniform": True},
    "tailoring": {"quality": "draft"},
}  # fmt: skip
CHIP = {"source.width": 1.0, "source.height": 2.0}


def of(**changes):
    scene = bstcad.load("templates/disk.toml").changed(LAMP | changes)
    return etendue(scene.light, scene.flat_lens(scene.lens.back.net), scene.goals[0])


@pytest.mark.parametrize("size", [CHIP, {"source.diameter": 1.0}])
@pytest.mark.parametrize("index", [None, 1.4])
def test_a_lambertian_chip_needs_its_area_times_its_cone(size, index):
    """A_s n² sin² α = A sin² θ; the light of the cone of 30 degrees passes the lens whole."""
    area = 2.0 if "source.width" in size else math.pi / 4
    found = of(**size, **{"lens.encapsulant": index, "target.outline": {"shape": "circle", "radius": 0.8}})
    sine = math.sqrt(area / (math.pi * 30.0**2)) * (index or 1.0) * math.sin(math.radians(30.0))
    assert found.unit == "degrees" and found.narrowest == pytest.approx(math.degrees(math.asin(sine)), rel=0.02)
    share = min((math.sin(math.radians(0.8)) / sine) ** 2, 1.0)
    assert found.fits == pytest.approx(share, rel=0.05) and found.forbids == (share < FORBIDDEN)


def test_a_point_and_parallel_light_fit_everywhere():
    assert of() is None


def test_a_far_wall_is_a_target_over_directions():
    """A wall at 10 m of the same angles takes as much, and its smallest disc has the radius throw tan θ."""
    half = 10_000.0 * math.tan(math.radians(5.0))
    wall = {"z": 10_026.0, "x": [-half, half], "y": [-half, half], "pixels": 40, "uniform": True}
    cone = {"target.outline": {"shape": "circle", "radius": 0.8}}
    disc = {"target": wall | {"outline": {"shape": "circle", "radius": 10_000.0 * math.tan(math.radians(0.8))}}}
    far, near = of(**CHIP, **disc), of(**CHIP, **cone)
    assert far.fits == pytest.approx(near.fits, rel=0.02)
    assert far.narrowest == pytest.approx(10_000.0 * math.tan(math.radians(near.narrowest)), rel=0.01)


def test_sunlight_keeps_its_cone_behind_a_window_of_the_same_area():
    beam = {
        "kind": "collimated", "wavelength": 550.0, "divergence": 0.53,
        "aperture": {"shape": "circle", "diameter": 60.0},
    }  # fmt: skip
    assert of(source=beam).narrowest == pytest.approx(0.265, rel=0.03)


def test_a_hemisphere_is_seen_as_a_disc_and_a_half():
    """The silhouette of a hemisphere from the angle θ to the axis is π R² (1 + cos θ) / 2."""
    dome = {"kind": "radial", "radius": 15.0, "half_angle": 88.0, "control_points": 65}
    scene = bstcad.load("templates/disk.toml").changed(
        LAMP | {"lens": {"material": "PMMA", "front": {"kind": "sphere", "z": 8.0, "curvature": -0.125}, "back": dome}}
    )
    cosines = np.array([0.2, 0.5, 1.0])
    seen = Silhouette.of(scene.flat_lens(65)).area(cosines)
    assert seen == pytest.approx(math.pi * 15.0**2 * (1 + cosines) / 2, rel=0.05)  # its rim is at 85 degrees


def test_a_plan_begins_with_it(monkeypatch):
    monkeypatch.setattr("bstcad.planning.plan.run_pilot", typical_pilot)
    scene = bstcad.load("templates/disk.toml").changed(
        LAMP | CHIP | {"target.outline": {"shape": "circle", "radius": 0.3}}
    )
    first = next(iter(plan(scene)))
    assert first["verdict"]["kind"] == "etendue" and first["goals"][0]["etendue"]["fits"] < 0.2
    said = first["verdict"]["sentence"]
    assert "of the light fits into the lit part" in said and "nearer" not in said
