"""The wavefront through the written files, in proof and report; one written design of two nets serves most tests."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
from rich.console import Console

from bstcad import commands
from bstcad.commands import ProofOptions
from bstcad.designs import folder as folders
from bstcad.optics.light.wavefront import ZernikeWave
from bstcad.optics.trace.wavefront_error import wavefront_error
from bstcad.report import record, report
from bstcad.verify import checks
from bstcad.verify.nominal import Nominal
from tests import suite
from tests.conftest import flat_pictures, proofs, quick_effort
from tests.two_faces import CHANGES, made_of, scene_of

WAVE = {"kind": "plane", "z": 60.0}
ONE = {"target": CHANGES["target"][0], "wavefront": WAVE}
RMS, FLOOR = "wavefront", "wavefront-floor"  # ids of the two checks
KEYS = [
    "z", "wavelength", "rms", "pv", "rms_with_tilt", "tilt_urad", "angle_rms_urad", "angle_max_urad", "floor", "flux",
    "removed",
]  # fmt: skip


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    """A lens of two nets for one target and a plane wave in a folder, with its report."""
    made, folder = made_of(scene_of(**ONE)), tmp_path_factory.mktemp("wave") / "faces"
    with pytest.MonkeyPatch.context() as patch:
        kept = proofs(patch)
        found = commands.write(made, folder, ProofOptions(quick_effort(), flat_pictures()))
    return SimpleNamespace(made=made, folder=folder, report=found, proof=kept[0])


def judged(lens, nominal, **accept):
    """The wavefront of a lens, and its two checks by other limits by id."""
    scene = nominal.scene
    limits = scene.accept.model_copy(update=accept)
    nominal = replace(nominal, scene=scene.model_copy(update={"accept": limits}))
    error, found = checks._wavefront_checks(lens, nominal)
    return error, {check.id: check for check in found}


@suite.in_turn(0, 3)
def test_the_written_lens_has_the_wavefront_of_the_designed_one(one):
    scene, lens = one.made.scene, one.made.lens
    designed, found = wavefront_error(scene.source, lens, scene.wavefront), one.proof.wavefront
    assert found.without_tilt.rms > 1  # a lens that is bent by hand
    assert found.without_tilt.rms == pytest.approx(designed.without_tilt.rms, rel=1e-6)
    assert found.rays == designed.rays and found.wavelength == 633.0 and 0 < found.floor < 1e-8


@suite.in_turn(0, 3)
def test_without_a_limit_both_values_are_stated(one):
    found = {check.id: check for check in one.report.checks if check.id.startswith("wavefront")}
    assert found.keys() == {RMS, FLOOR} and all(check.passed and check.limit is None for check in found.values())
    assert found[RMS].value == one.proof.wavefront.without_tilt.rms and found[RMS].unit == "waves"
    assert one.report.passed and found[FLOOR].topic == "check-wavefront-floor"


@suite.in_turn(0, 3)
def test_a_wavefront_beyond_its_limit_fails(one):
    nominal, rms = folders.read_nominal(one.folder), one.proof.wavefront.without_tilt.rms
    assert nominal.scene.wavefront == one.made.scene.wavefront
    _, found = judged(one.proof.lens, nominal, wavefront=0.99 * rms)
    assert not found[RMS].passed and found[FLOOR].passed and found[FLOOR].limit == pytest.approx(0.099 * rms)
    _, found = judged(one.proof.lens, nominal, wavefront=1.01 * rms)
    assert found[RMS].passed and found[RMS].limit == 1.01 * rms


@suite.in_turn(0, 3)
def test_a_limit_that_rounding_hides_fails_by_the_floor(one):
    nominal, floor = folders.read_nominal(one.folder), one.proof.wavefront.floor
    _, found = judged(one.proof.lens, nominal, wavefront=5 * floor)
    assert not found[FLOOR].passed and found[FLOOR].limit == 0.5 * floor


@suite.in_turn(0, 3)
def test_a_wave_that_no_light_meets_fails_and_has_no_figures(one):
    nominal, beside = folders.read_nominal(one.folder), ZernikeWave((0.0,), 1.0, z=60.0, centre=(500.0, 0.0))
    nominal = replace(nominal, scene=nominal.scene.model_copy(update={"wavefront": beside}))
    error, found = judged(one.proof.lens, nominal)
    assert error is None and found.keys() == {RMS} and not found[RMS].passed
    assert found[RMS].value is None and "too few rays" in found[RMS].where


def test_a_flat_plate_leaves_parallel_light_parallel():
    """A plain lens: parallel light through level faces has no error but rounding."""
    made = made_of(scene_of(**ONE), front=0.0, back=0.0)
    error, found = judged(made.lens, Nominal(made.scene, made.lens, made.goals), wavefront=1e-6)
    assert found[RMS].passed and found[FLOOR].passed
    assert error.without_piston.rms < 1e-8 and error.angle_max < 1e-6


def test_a_mounted_lens_is_measured_as_it_is_made(tmp_path):
    """The rim of the mount cuts away light that the bare lens lets through."""
    made = made_of(scene_of(**ONE, mount={"datum": "front", "rim": {"shape": "circle", "diameter": 6.4}}))
    folders.write_geometry(made, tmp_path)()
    proof = checks.verify(tmp_path, Nominal(made.scene, made.lens, made.goals), effort=quick_effort())
    bare = wavefront_error(made.scene.source, made.lens.with_clear(None), made.scene.wavefront)
    cut = wavefront_error(made.scene.source, made.lens, made.scene.wavefront)
    assert proof.wavefront.flux == pytest.approx(cut.flux, abs=1e-4) and proof.wavefront.flux < 0.95 * bare.flux


def test_waves_are_those_of_the_main_line():
    source = CHANGES["source"] | {"wavelength": [[633.0, 1.0], [520.0, 3.0], [450.0, 1.0]]}
    made = made_of(scene_of(**ONE, source=source))
    heaviest = Nominal(made.scene, made.lens, made.goals).heaviest
    assert heaviest.source == made.scene.source.central and heaviest.source.wavelength == 520.0


# ---- the report ------------------------------------------------------------------------------------------------------


@suite.in_turn(0, 3)
def test_report_json_tells_the_wavefront_and_reads_back(one):
    told, error = json.loads((one.folder / "report.json").read_text())["wavefront"], one.proof.wavefront
    assert list(told) == KEYS and told["removed"] == "piston and tilt" and told["z"] == 60.0
    assert told["rms"] == pytest.approx(error.without_tilt.rms, rel=1e-11)
    assert told["pv"] == pytest.approx(error.without_tilt.pv, rel=1e-11)
    assert told["rms_with_tilt"] == pytest.approx(error.without_piston.rms, rel=1e-11)
    assert told["tilt_urad"] == pytest.approx(error.tilt, rel=1e-11)
    assert (told["angle_rms_urad"], told["angle_max_urad"]) == pytest.approx((error.angle_rms, error.angle_max))
    assert record.read(one.folder / "report.json").facts()["wavefront"] == told
    assert error.flux > 1 == told["flux"]  # on a grid the edge of the beam is a little too wide


@suite.in_turn(0, 3)
def test_the_page_the_terminal_and_the_figures_show_it(one):
    page = (one.folder / "report.html").read_text(encoding="utf-8")
    assert page.count("<h2>Wavefront</h2>") == 1 and page.count("optical path difference in waves") == 1
    assert "RMS, piston and tilt removed" in page and "Rounding error of the RMS" in page
    assert (one.folder / "figures" / "wavefront.png").read_bytes().startswith(b"\x89PNG")
    console = Console(width=400)
    with console.capture() as shown:
        console.print(report.summary(one.report.contents))
    [line] = [line for line in shown.get().splitlines() if line.startswith("Wavefront error")]
    assert "waves" in line and "of 633 nm, piston and tilt removed" in line


def test_a_scene_without_a_wave_has_nothing_of_it(small_design):
    assert "wavefront" not in small_design.report
    assert [check["name"] for check in small_design.report["checks"] if "wavefront" in check["name"]] == []
    page = (small_design.folder / "report.html").read_text(encoding="utf-8")
    assert "Wavefront" not in page and not (small_design.folder / "figures" / "wavefront.png").exists()
    assert folders.read_nominal(small_design.folder).scene.wavefront is None
