"""The prescription is what was designed: it agrees with lens.step, and its scene makes the same lens again."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest

from bstcad.analysis.shape import describe
from bstcad.cad import step_reading, step_writing
from bstcad.designs.as_designed import scene_text
from bstcad.designs.folder import read_nominal
from bstcad.designs.pipeline import design, resolved
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.report import prescription as prescriptions
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import load
from bstcad.tailoring.stage1 import _curvature_of_sag
from tests.scenes import DISK, SMALL

FREE = {
    "lens.front": {"kind": "sphere", "z": 15.0, "curvature": 0.0, "optimise": True},
    "lens.back": {"kind": "bspline", "z": 25.0, "control_points": 33},
    **{key: value for key, value in SMALL.items() if key.startswith("tailoring")},
    "target.pixels": 32,
    "target.x": [-150.0, 150.0],
    "target.y": [-150.0, 150.0],
    "target.outline": {"shape": "circle", "radius": 140.0},
}
SHAPE = {"centre_thickness": 10.0, "edge_thickness_min": 9.0, "edge_thickness_max": 11.0, "volume": 500.0}


@pytest.fixture(scope="module")
def free():
    """A small disc from a near source, by a lens whose front may be bent."""
    return design(load(DISK, FREE), device="cpu")


def figure(text, name):
    """The first number behind a name in prescription.txt."""
    return float(re.search(rf"^ +{name} +\(?([-\d.e]+)", text, re.M).group(1))


def test_radius_and_vertices_agree_with_the_step_file_everywhere(small_design):
    front = step_reading.read(small_design.folder / "lens.step").front
    written = json.loads((small_design.folder / "report.json").read_text())["prescription"]
    text = (small_design.folder / "prescription.txt").read_text(encoding="utf-8")
    page = (small_design.folder / "report.html").read_text(encoding="utf-8")
    radius = 1 / front.curvature
    assert radius == pytest.approx(500.0)
    assert written["front"]["radius"] == pytest.approx(radius, rel=1e-12, abs=1e-9)
    assert written["front"]["curvature"] == pytest.approx(front.curvature, rel=1e-12)
    assert figure(text, "radius") == written["front"]["radius"] and figure(text, "curvature") == 0.002
    assert f"<td>{written['front']['radius']:.0f} mm</td>" in page
    assert written["front"]["vertex"] == [0.0, 0.0, front.z]
    lens = step_reading.lens(step_reading.read(small_design.folder / "lens.step"), 1.5)
    assert written["back"]["vertex"][2] == pytest.approx(prescriptions.vertex(lens), abs=1e-9)
    assert written["net"]["control_points"] == [33, 33] and written["net"]["degree"] == 2
    assert written["material"] == "PMMA" and written["index"] == read_nominal(small_design.folder).lens.index
    assert written["mass"] == pytest.approx(1.19e-3 * small_design.report["shape"]["volume"], rel=1e-9)


def test_a_radius_that_was_found_agrees_with_the_step_file(free, tmp_path):
    step_writing.write_lens(free.lens, tmp_path / "lens.step", "free")
    front = step_reading.read(tmp_path / "lens.step").front
    record = prescriptions.prescription(free.scene, free.lens, SHAPE)
    assert abs(record["front"]["curvature"]) > 1e-4  # it was worth a search
    assert record["front"]["radius"] == pytest.approx(1 / front.curvature, rel=1e-12, abs=1e-9)
    assert figure(prescriptions.text(record), "radius") == record["front"]["radius"]  # in full


def test_the_resolved_scene_makes_the_same_lens_to_the_last_bit(free, tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(scene_text(free.scene, free.lens), encoding="utf-8")
    scene = load(path)
    assert scene.lens.front.curvature == free.lens.front.curvature and scene.lens.front.optimise is False
    again = design(scene, device="cpu")
    assert again.lens.front.curvature == free.lens.front.curvature
    assert np.array_equal(again.lens.back.control_points(), free.lens.back.control_points())
    assert again.scene == scene


def test_the_papers_scene_stays_as_it_is(free):
    """Front and back are found together: only the search itself gives that lens again."""
    paper = load(DISK, FREE | {"tailoring.quality": "paper"})
    assert resolved(paper, free.lens) == paper


def test_a_back_that_moved_says_where_it_stands(free, tmp_path):
    scene = free.scene.changed({"lens.back.z": 24.0})
    z = prescriptions.vertex(free.lens)
    text = scene_text(scene, free.lens)
    assert text.startswith("# as designed, the vertex of the back is at z = ") and repr(z) in text.splitlines()[0]
    (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
    assert load(tmp_path / "scene.toml").lens.back.z == 24.0
    said = prescriptions.text(prescriptions.prescription(scene, free.lens, SHAPE))
    assert "z of the scene (lens.back.z)  24 mm" in said and repr(z) in said
    assert scene_text(free.scene, free.lens) == free.scene.toml()  # which it did not


def test_a_plane_has_no_radius_and_an_index_no_mass(small_design):
    nominal = read_nominal(small_design.folder)
    scene = nominal.scene
    lens = nominal.lens.between(Plane(15.0), nominal.lens.back, nominal.lens.outline, 1.7)
    bare = scene.changed({"lens.front": Plane(15.0), "lens.material": None, "lens.index": 1.7})
    record = prescriptions.prescription(bare, lens, describe(lens) | {"volume": 500.0})
    assert record["front"]["radius"] is None and record["front"]["curvature"] == 0.0 and record["mass"] is None
    text = prescriptions.text(record)
    assert "infinite" in text and "not known" in text and "not named" in text


@pytest.mark.parametrize(("material", "mass"), [("N-LAK33A", 2.11), ("other/Optorez1330/Sultanova", None)])
def test_the_mass_is_known_where_the_density_is(small_design, material, mass):
    nominal = read_nominal(small_design.folder)
    scene = nominal.scene
    other = scene.model_copy(update={"lens": scene.lens.model_copy(update={"material": material})})
    record = prescriptions.prescription(other, nominal.lens, describe(nominal.lens) | {"volume": 500.0})
    assert record["mass"] == (mass and pytest.approx(mass, abs=0.01))
    text = prescriptions.text(record)
    assert material in text and ("not known: density not specified" in text) == (mass is None)


@pytest.mark.parametrize("changes", [
    {},
    {"source.position": [0.0, 0.0, 13.5]},  # near the rim
    {"lens.front.curvature": 0.03, "lens.min_thickness": 8.0},  # more than half of the blank
], ids=str)  # fmt: skip
def test_a_front_that_is_found_is_one_that_the_scene_may_have(changes):
    """Fronts at either end of the search are valid, and the search covers no small part of the valid range."""
    scene = load(DISK, FREE | changes)
    rim = math.hypot(*scene.lens.outline.farthest)
    low, high = (_curvature_of_sag(sag, rim, 0.0) for sag in scene.rim_sags)
    low, high = min(low, scene.lens.front.curvature), max(high, scene.lens.front.curvature)
    for curvature in (low, high):
        scene.changed({"lens.front.curvature": curvature})
    assert low < 0 < high
    for curvature in (1.02 * low, 1.02 * high):
        with pytest.raises(SceneError):
            scene.changed({"lens.front.curvature": curvature})
