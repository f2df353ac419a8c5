"""Estimates around a design: what a small lens cost, and what effects that are left out change."""

import json
import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import bstcad
from bstcad.designs import pipeline
from bstcad.optics.trace.measure import Effort, measure, tubes_picture
from bstcad.planning.effect_estimates import coarse_lens, diagnosis, left_out
from bstcad.report.record import LEFT_OUT
from bstcad.scene.scene import load
from bstcad.tailoring.driver import Hooks
from bstcad.tailoring.effort import FULL
from tests import suite
from tests.efforts import LITTLE, designed_quickly
from tests.scenes import DISK, SMALL

TEMPLATES = Path(__file__).parent.parent.parent / "templates"
THU, FEW = TEMPLATES / "thu.toml", {"target.pixels": 48}
TINY = SMALL | {
    "tailoring.rays": 64, "target.pixels": 32, "tailoring.transport_grid": 32, "tailoring.rounds": 3,
    "lens.back.control_points": 17,
}  # fmt: skip
SCENES = {
    "spectrum": {"source.wavelength": [[500.0, 1.0], [600.0, 2.0]], "lens.material": "PMMA", "lens.index": None},
    "extended source": {"source.diameter": 1.0, "tailoring.source_points": 4, "tailoring.stage2_iterations": 12},
    "paper": {
        "tailoring.quality": "paper", "tailoring.levels": [17], "tailoring.stage1_iterations": 8,
        "tailoring.stage2_iterations": 12,
    },
}  # fmt: skip


def of(found):
    scene, target = found.scene, found.scene.target
    light = measure(found.lens, scene.channels(), target.screen, found.goals[0].picture, Effort(96, witness=False))
    proven = SimpleNamespace(picture=light.picture, efficiency=0.9)
    proof = SimpleNamespace(lens=found.lens, light=proven, at_bounds=None)
    return diagnosis(scene, found.course, proof, found.goals[0].picture), found.course


@pytest.mark.parametrize("name", suite.in_turns(SCENES, 3))
def test_every_kind_of_design_has_one(name):
    found, course = of(designed_quickly(load(DISK, TINY | SCENES[name])))
    assert sum(part["error"] for part in found["remaining_error"]["parts"]) == pytest.approx(1)
    assert sum(octave["error"] for octave in found["remaining_error"]["octaves"]) == pytest.approx(1)
    assert found["remaining_error"]["outside"] == pytest.approx(0.1)
    assert 0 <= found["convergence"]["last_tenth"] <= 1 and found["convergence"]["rrmsd"] > 0
    json.dumps(found, allow_nan=False)
    assert course.stages[0].cpu_seconds is None
    assert all(0 <= stage.cpu_seconds < math.inf for stage in course.stages[1:])


def test_sunlight_parts_over_all_that_is_seen():
    """Light of the sun's divergence counts from 400 to 700 nm; a laser's light counts as a line of 10 nm."""
    scene = load(TEMPLATES / "sun_caustic.toml", {"target.pixels": 64, "lens.back.control_points": 65})
    lens = coarse_lens(scene)

    def dispersion(divergence):
        changed = scene.changed({"source.divergence": None, "source.real_divergence": divergence})
        [entry] = [e for e in left_out(changed, lens, scene.target.irradiance()) if e.kind == "dispersion"]
        return entry

    sun, laser = dispersion(0.53), dispersion(0.01)
    assert sun.detail == "of sunlight, uniform from 400 to 700 nm" and not sun.assumed
    assert laser.detail == "for a spectral width of 10 nm" and laser.assumed
    # the index of PMMA changes by 0.0155 between 434 and 666 nm, and by 3.6e-4 over the line
    assert 20 < sun.blur_pixels / laser.blur_pixels < 60 and sun.rrmsd_change > 10 * laser.rrmsd_change


@suite.in_turn(0, 2)
def test_lines_that_stand_for_a_lamp_are_told_from_a_continuous_spectrum():
    """A lens that is tailored for two lines far apart has another picture at wavelengths between them, by new rays."""
    lines = {"source.wavelength": [[500.0, 1.0], [650.0, 1.0]], "lens.material": "PMMA", "lens.index": None}
    off_axis = {"target.x": [40.0, 80.0], "target.y": [-20.0, 20.0]}
    found = designed_quickly(load(DISK, TINY | lines | off_axis), FULL)
    continuous = found.scene.changed({"source.wavelength": [[nm, 1.0] for nm in np.arange(430.0, 725.0, 20.0)]})
    few = Effort(256, accuracy=0.0, witness=False)
    pictures = (
        measure(found.lens, scene.channels(), scene.target.screen, found.goals[0].picture, few).picture
        for scene in (found.scene, continuous)
    )
    before, after = (picture / picture.sum() for picture in pictures)
    changed = float(np.sqrt(((after - before) ** 2).sum() / (before**2).sum()))
    [entry] = [e for e in left_out(found.scene, found.lens, before) if e.kind == "dispersion"]
    assert changed > 0.01 and entry.assumed and "continuous between the 2 lines" in entry.detail
    assert changed / 2 < entry.rrmsd_change < changed * 2


def test_a_design_that_was_stopped_before_there_was_a_curve():
    asked = iter([False, False, False])
    options = pipeline.DesignOptions(effort=LITTLE)
    found, _ = of(
        pipeline.design(load(DISK, TINY), hooks=Hooks(interrupted=lambda: next(asked, True)), options=options)
    )
    assert found["convergence"] is None and found["remaining_error"]["octaves"]


def test_the_report_of_a_design_shows_it(small_design):
    page = (small_design.folder / "report.html").read_text()
    told = json.loads((small_design.folder / "report.json").read_text())
    assert {"convergence", "remaining_error"} <= set(told)
    assert "of its final value" in page and 'class="stack"' in page
    assert page.count("flex-grow: ") == len(told["stages"])
    rows = sum(part["pixels"] > 0 for part in told["remaining_error"]["parts"])
    assert len(re.findall(r"<tr><th scope=.row.>(?:along the rim|at edges|in the|in all other)", page)) == rows


# --- effects that are left out ----------------------------------------------------------------------------------------


def by_kind(scene, **changes):
    scene = load(TEMPLATES / f"{scene}.toml", FEW | changes)
    return {entry.kind: entry for entry in left_out(scene, coarse_lens(scene), scene.target.irradiance())}


def test_what_is_left_out_comes_with_estimates_the_largest_first():
    found = by_kind("thu")
    assert {"fresnel", "absorption", "dispersion", "source size", "ghost", "diffraction", "stray light"} == set(found)
    assert set(found) <= set(LEFT_OUT) and list(found)[-1] == "stray light"
    known = [entry.rrmsd_change for entry in found.values() if entry.rrmsd_change is not None]
    assert known == sorted(known, reverse=True) and found["stray light"].rrmsd_change is None
    # two faces of PMMA at up to 40 degrees in the glass reflect 8 to 14 percent
    assert -0.14 < found["fresnel"].flux_change < -0.075 and found["fresnel"].blur_pixels == 0
    # 650 nm over 24 mm (a disc's 21 mm as a square) at 1 m, against 8.3 mm pixels
    assert found["diffraction"].blur_pixels == pytest.approx(650e-6 * 980 / 21.3 / 8.33, rel=0.05)
    without = by_kind("thu", **{"lens.index": 1.49})  # of no material
    assert without["dispersion"].rrmsd_change is None and "lens.index" in without["dispersion"].detail
    assert without["absorption"].flux_change is None
    assert without["fresnel"].flux_change == pytest.approx(found["fresnel"].flux_change, rel=0.05)


def test_blur_grows_with_the_size_that_the_scene_states():
    small, large = (by_kind("disk", **size)["source size"] for size in ({}, {"source.real_diameter": 0.4}))
    assert large.blur_pixels == pytest.approx(4 * small.blur_pixels, rel=0.02)
    assert small.assumed and not large.assumed and "real_diameter" in large.detail


def test_a_mirror_has_nothing_of_glass():
    found = by_kind("mirror")
    assert {"reflectance", "shadows", "source size", "diffraction", "stray light"} == set(found)
    assert -0.2 < found["reflectance"].flux_change < -0.02


@pytest.fixture(scope="module")
def finished(small_scene, small_design):
    """(lens, what is left out of it, by kind) of the finished small design."""
    lens = bstcad.open(small_design.folder).lens
    with np.load(small_design.folder / "design.npz") as design:
        return lens, {entry.kind: entry for entry in left_out(small_scene, lens, design["irradiance"])}


def test_the_estimates_are_those_of_the_finished_lens(small_scene, finished):
    """Within a factor of two: the coarse lens knows nothing of the finished one."""
    coarse = left_out(small_scene, coarse_lens(small_scene), small_scene.target.irradiance())
    for entry in coarse:
        for key, least in (("flux_change", 1e-3), ("rrmsd_change", 1e-3), ("blur_pixels", 0.01)):
            there, here = getattr(finished[1][entry.kind], key), getattr(entry, key)
            assert (there is None) == (here is None)
            assert there is None or abs(there) < least or 0.5 < here / there < 2, (entry.kind, key)


def test_fresnel_is_as_measured_on_the_finished_lens(small_scene, finished):
    lens, found = finished
    on, screen = small_scene.changed({"effects": [{"kind": "fresnel"}]}), small_scene.target.screen
    before, after = (tubes_picture(lens, s.channels(), screen, 257).sum() for s in (small_scene, on))
    assert found["fresnel"].flux_change == pytest.approx(float(after / before - 1), rel=0.02)


def test_the_finest_detail_of_a_point_is_that_of_the_size_which_the_estimate_takes(small_design):
    """0.1 mm, 82 mm before the back (10 mm of PMMA count as 7), 475 mm off the target; a nearer has pixels as large."""
    found = small_design.report["finest_detail"]
    assert found["assumed"] and found["of"] == "a disc of 0.1 mm"
    assert found["source_image"] == pytest.approx(0.1 * 475 / 82, rel=0.05)
    assert found["distance"] == pytest.approx(475, abs=1) and found["nearer_distance"] is None
