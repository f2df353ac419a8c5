"""A made part by its cloud: its form, the light that it throws, and the faults of the part or of the cloud."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import bstcad
from bstcad import cli, commands
from bstcad.commands import ProofOptions
from bstcad.designs import folder as folders
from bstcad.figures.figure_jobs import NoPictures
from bstcad.manufacture.measured import cloud as clouds
from bstcad.manufacture.measured import made_part
from bstcad.manufacture.measured.alignment import BackFace, align, first_pose
from bstcad.manufacture.measured.made_part import Prediction
from bstcad.manufacture.measured.shrinkage import axis_scales
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.measure import measure
from bstcad.verify import checks
from tests import suite
from tests.conftest import pictures
from tests.efforts import FEWEST_RAYS as EFFORT
from tests.lenses import net
from tests.manufacture.measured.synthetic import SHIFT, TURN, cloud, dirty, points, with_form_error

PART = "made part: "


@pytest.fixture(scope="module")
def nominal(small_design):
    return folders.read_nominal(small_design.folder)


@pytest.fixture(scope="module")
def light(nominal):
    return measure(nominal.lens, nominal.channels, nominal.goals[0].screen, nominal.goals[0].picture, EFFORT)


@pytest.fixture
def same_light(monkeypatch, light):
    """Whatever is wrong with a part, its light is the design's: for tests of its form."""
    monkeypatch.setattr(made_part, "_light", lambda *given, **more: Prediction(light, light.rrmsd, 0.0))


def judged(found, nominal, unit="mm"):
    return made_part.judge(clouds.Cloud(found, unit, Path("cloud.csv")), nominal.lens, nominal, EFFORT)


def failed(part):
    return {check.id: check.where for check in part.checks if not check.passed}


def test_the_form_error_is_recovered_and_its_light_predicted(nominal, light):
    lens = nominal.lens
    made = with_form_error(lens, 2e-4, 1.5, seed=4)
    part = judged(cloud(made, 8000, noise=2e-5), nominal)
    assert failed(part) == {} and part.facts["passed"]
    x, y = (t.ravel() for t in np.meshgrid(part.deviation.x, part.deviation.y))
    here = torch.from_numpy(x), torch.from_numpy(y)
    (z, z_x, z_y), (true, *_) = (surface.sag_and_slope(*here) for surface in (lens.back, made.back))
    wanted = ((true - z) / torch.sqrt(1 + z_x**2 + z_y**2)).numpy()
    found = part.deviation.form.ravel()
    assert np.sqrt(np.mean((found - wanted) ** 2)) < 0.05 * np.sqrt(np.mean(wanted**2))
    assert part.facts["noise"] == pytest.approx(2e-5, rel=0.05)
    rrmsd = measure(made, nominal.channels, nominal.goals[0].screen, nominal.goals[0].picture, EFFORT).rrmsd
    assert rrmsd > 1.5 * light.rrmsd
    assert part.facts["rrmsd_predicted"] == pytest.approx(rrmsd, rel=0.05)
    assert part.facts["rrmsd_high"] >= part.facts["rrmsd_predicted"]
    shares = sum(band["rms"] ** 2 for band in part.facts["bands"])
    assert shares == pytest.approx(part.facts["form_rms"] ** 2, rel=0.3)  # bands are nearly orthogonal on the outline
    assert part.facts["pv"] >= part.facts["minimum_zone"]["width"] > part.facts["form_pv"] / 2


def as_designed(lens):
    """A cloud of the lens itself in the frame of its design."""
    return cloud(lens, 4000, 2e-5, (0.0,) * 3, (0.0,) * 3)


def test_a_decentre_of_ten_micrometres_is_found_to_a_tenth_and_fails_where_less_is_asked(nominal, same_light):
    """A cloud in inches fails by name."""
    strict = replace(nominal, scene=nominal.scene.changed({"accept.decentre": 0.005}))
    part = judged(as_designed(nominal.lens) + [0.01, 0.0, 0.0], strict, unit="inches")
    assert (part.facts["alignment"]["dx"], part.facts["alignment"]["dy"]) == pytest.approx((0.01, 0.0), abs=1e-4)
    faults = failed(part)
    assert list(faults) == ["made-unit", "made-decentre"] and "inches" in faults["made-unit"]


def test_the_pose_of_the_part_is_found_and_points_of_other_faces_are_counted(nominal):
    """Points of the front, of the sides and of the rim are not used."""
    back = cloud(nominal.lens, 5000)
    below = cloud(nominal.lens.with_back(nominal.lens.back.moved(nominal.lens.back.z - 8.0)), 1500)
    face = BackFace.of(nominal.lens)
    everything = np.vstack([back, below])
    found = align(face, everything, first_pose(face, everything)[0])
    assert found.pose.shift == pytest.approx(SHIFT, abs=1e-6) and found.pose.angles == pytest.approx(TURN, abs=1e-5)
    assert found.rms < 1e-9 and found.off_face >= 1400 and found.outside < 100 and found.undetermined == ()


def test_motions_that_a_flat_face_does_not_determine_are_left_alone(nominal):
    lens = nominal.lens
    flat = lens.with_back(replace(lens.back, heights=torch.zeros_like(lens.back.heights)))
    face = BackFace.of(flat)
    given = points(flat, 5000) + [0.0, 0.0, 0.3] + np.random.default_rng(0).normal(0, 1e-4, (5000, 3)) * [0, 0, 1]
    found = align(face, given, first_pose(face, given)[0])
    assert set(found.undetermined) == {"shift in x", "shift in y", "rotation about z"}
    assert found.pose.shift == pytest.approx([0, 0, 0.3], abs=1e-5)


def half(points):
    return points[points[:, 0] < 0]


FAULTS = {  # a cloud of a lens, the check that fails, words of its sentence
    "swapped axes of a flipped face": (
        lambda lens: as_designed(lens)[:, [1, 0, 2]] * [1, 1, -1],
        "made-axes",
        "x is y, y is x, z is -z",
    ),
    "a scale of 1.001": (lambda lens: 1.001 * as_designed(lens), "made-scale", ""),
    "half a face": (lambda lens: half(as_designed(lens)), "made-covered", ""),
    "another lens": (lambda lens: cloud(with_form_error(lens, 0.05, 1.5), 2000), "made-distance", ""),
}


@pytest.mark.parametrize("fault", suite.in_turns(FAULTS, 2))
def test_a_fault_is_named(nominal, same_light, fault):
    made, check, words = FAULTS[fault]
    part = judged(np.array(made(nominal.lens)), nominal)
    assert not part.facts["passed"] and words in failed(part)[check]
    if fault not in ("half a face", "another lens"):
        assert part.facts["scale"] == pytest.approx(1.001 if "scale" in fault else 1.0, abs=5e-5)


def test_the_scale_along_each_axis_is_found_where_the_relief_determines_it(nominal):
    """A plane determines none of them."""
    lens = with_form_error(nominal.lens, 0.02, 0.7)
    face, true = BackFace.of(lens), np.array([1.001, 0.9995, 1.004])
    found = (points(lens, 8000) - face.pivot) * true + face.pivot + np.random.default_rng(6).normal(0, 1e-5, (8000, 3))
    fitted = axis_scales(face, align(face, found, first_pose(face, found)[0]))
    assert np.array(fitted.scales) == pytest.approx(true, abs=1e-4)
    assert max(fitted.uncertainties) < 1e-4
    flat = lens.with_back(replace(lens.back, heights=torch.zeros_like(lens.back.heights)))
    face, found = BackFace.of(flat), points(flat, 3000)
    facts = axis_scales(face, align(face, found, first_pose(face, found)[0])).facts()
    assert facts["scale_xyz"] == [None, None, None] == facts["scale_xyz_uncertainty"]


def test_a_part_of_a_mould_states_the_shrinkage_that_it_had(nominal, same_light):
    """The small scene assumes 0.5 % of the cavity; the part is larger by a thousandth, so it shrank less."""
    part = judged(1.001 * as_designed(nominal.lens), nominal)
    [found] = part.facts["moulding_shrinkage"]
    assert found == pytest.approx(1 - 0.995 * 1.001, abs=5e-5)


@pytest.fixture(scope="module")
def proof(small_design, nominal):
    return checks.verify(small_design.folder, nominal, effort=EFFORT)


@pytest.fixture
def quick(monkeypatch, same_light, proof):
    """One proof of the small design and one judgement of each cloud serve all; the made part alone is drawn."""
    judge, known = made_part.judge, {}

    def once(cloud, *given):
        if cloud.sha256 not in known:
            known[cloud.sha256] = judge(cloud, *given)
        return known[cloud.sha256]

    monkeypatch.setattr(made_part, "judge", once)
    monkeypatch.setattr(commands.processes, "submit", commands.processes.run_here)
    monkeypatch.setattr(commands, "Pictures", pictures("part"))
    monkeypatch.setattr(checks, "verify", lambda *given, **more: proof)


def saved(path, found):
    path.parent.mkdir(exist_ok=True)
    np.savetxt(path, found, delimiter=",")
    return path


@suite.in_turn(0, 2)
def test_the_report_has_a_made_part_where_one_was_asked_for(small_design, nominal, tmp_path, quick):
    folder = shutil.copytree(small_design.folder, tmp_path / "design")
    given = dirty(cloud(with_form_error(nominal.lens, 1e-4, 2.0), 3000, 1e-5), 0.02, (1.0,))[0]
    report = commands.verify(folder, measured=saved(tmp_path / "cloud.csv", given)).facts
    written, page = json.loads((folder / "report.json").read_text()), (folder / "report.html").read_text()
    assert report["passed"] and {
        "points", "alignment", "pv", "rms", "slope_rms", "rrmsd_predicted", "passed", "outliers",
    } <= written["measured"].keys()  # fmt: skip
    assert [check["name"] for check in written["checks"] if check["name"].startswith(PART)]
    assert "(2.0 % of the points near the face) are outliers" in " ".join(page.split())
    assert report["verdict"] == "passed with remarks" and "are outliers" in report["given_up"][-1]
    assert (
        "RRMSD, made part" in page
        and "The made part" in page
        and (folder / "figures" / "made_part.png").stat().st_size > 10_000
    )
    saved(tmp_path / "two" / "cloud.csv", 1.002 * cloud(nominal.lens, 3000, 1e-5))
    options = ProofOptions(drawing=NoPictures)
    assert not commands.verify(folder, options, measured=tmp_path / "two" / "cloud.csv").passed
    assert commands.verify(folder, options).measured is None
    assert "The made part" not in (folder / "report.html").read_text()
    ours = [json.loads((folder / "measured" / name / "report.json").read_text()) for name in ("cloud", "cloud-2")]
    assert [each["measured"]["passed"] for each in ours] == [True, False]  # the later verification erased neither
    again = commands.verify(folder, options, measured=tmp_path / "cloud.csv").facts["measured"]
    assert {path.name for path in (folder / "measured").iterdir()} == {"cloud", "cloud-2"}
    assert again["deviation_map"] == ["measured/cloud/deviation.npz", "measured/cloud/deviation.csv"]
    assert all((folder / name).is_file() for name in again["deviation_map"])


@suite.in_turn(0, 3)
def test_many_parts_of_one_design_are_judged_beside_it(small_design, nominal, tmp_path, quick, capsys):
    """The command and Python agree; the design's folder stays as it is to the last bit, and the map is the form."""
    folder, place = shutil.copytree(small_design.folder, tmp_path / "design"), tmp_path / "serial-17"
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    given, found = tmp_path / "cloud.csv", cloud(with_form_error(nominal.lens, 1e-4, 2.0), 5000, 1e-5)
    rows = [f"{k};0;0;0;{x:.7f};{y:.7f};{f'{z:.7f}' if k % 50 else 'Bad'}" for k, (x, y, z) in enumerate(found)]
    given.write_text("\n".join(["ID;X nom;Y nom;Z nom;X act;Y act;Z act", *rows]).replace(".", ","))
    assert cli.run(["verify", str(folder), "--measured", str(given), "-o", str(place)]) == 0
    out, page = capsys.readouterr().out, (place / "report.html").read_text()
    assert f"Files: {place}" in out and "values, X act, Y act, Z act; 100 points without data left out" in out
    assert "measured values X act, Y act, Z act; left out: 100 without data" in " ".join(page.split())
    report = bstcad.open(folder).verify(measured=given, folder=place, progress=False)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    written = json.loads((place / "report.json").read_text())
    assert written["measured"]["deviation_map"] == ["deviation.npz", "deviation.csv"]
    left_out = written["measured"]["left_out"]
    assert left_out["without data"] == 100 and sum(left_out.values()) == 5000 - written["measured"]["points"]
    assert "The made part" in (place / "report.html").read_text() and (place / "figures" / "made_part.png").is_file()
    with np.load(place / "deviation.npz") as found:
        x, y, off = (found[name] for name in ("x", "y", "deviation"))
    assert np.array_equal(off, report.measured.deviation.form, equal_nan=True) and off.shape == (len(y), len(x))
    assert np.sqrt(np.nanmean(off**2)) == pytest.approx(written["measured"]["form_rms"], rel=1e-9)
    rows = np.loadtxt(place / "deviation.csv", delimiter=",", skiprows=1)
    assert rows[:, 2].reshape(off.shape) == pytest.approx(off, rel=1e-8, nan_ok=True)
    assert rows[1, 0] - rows[0, 0] == pytest.approx(x[1] - x[0], abs=2e-6) and rows[1, 1] == rows[0, 1]
    for wrong, sentence in (
        (["-o", str(place)], "give its points with --measured"),
        (["--measured", str(given), "-o", str(folder)], "contains files that are not a made part's"),
    ):
        assert cli.run(["verify", str(folder), *wrong]) == 2 and sentence in capsys.readouterr().err
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("degrees", suite.in_turns([90.0, 137.0, 180.0], 3))
def test_a_turned_part_is_aligned_by_its_relief(degrees):
    """Relief of 1 µm on a bowl: a part upside down was said to be of another lens, or to have reversed axes."""
    bowl = Lens.between(Plane(0.0), net(lambda x, y: 0.02 * x**2 + 0.01 * y**2, 5.0, 65, 6.0), Circle(5.0), 1.5)
    lens = with_form_error(bowl, 1e-3, 0.7)
    face, given = BackFace.of(lens), clouds.Cloud(cloud(lens, 3000, 2e-5, SHIFT, (0.0, 0.0, degrees)), "mm", Path())
    found = made_part.aligned(given, face, None)
    assert all(check.passed for check in found.checks) and found.alignment.rms < 3e-5
    assert abs(found.alignment.pose.angles[2]) == pytest.approx(degrees, abs=0.05)


@suite.in_turn(2, 3)
def test_equal_poses_are_stated_in_terminal_and_report(small_design, nominal, tmp_path, quick, capsys, monkeypatch):
    """Two poses that fit equally well are stated in one sentence, which is absent where there is one pose."""
    folder = shutil.copytree(small_design.folder, tmp_path / "design")
    monkeypatch.setattr(made_part, "equal_turns", lambda *given: ())
    given = saved(tmp_path / "cloud.csv", as_designed(nominal.lens))
    assert cli.run(["verify", str(folder), "--measured", str(given)]) == 0
    assert "Orientation" not in capsys.readouterr().out
    monkeypatch.setattr(made_part, "equal_turns", lambda *given: (180.0,))
    again = saved(tmp_path / "again.csv", as_designed(nominal.lens)[:-1])
    assert cli.run(["verify", str(folder), "--measured", str(again)]) == 0
    words = "2 poses fit equally well: the part may be turned about its axis by 180 degrees."
    written = json.loads((folder / "report.json").read_text())["measured"]
    assert "Orientation" in capsys.readouterr().out and written["orientation"] == words
    assert written["alignment"]["equal_turns"] == [180.0] and words in (folder / "report.html").read_text()


@suite.in_turn(1, 3)
def test_the_largest_rrmsd_of_equal_poses_is_judged(nominal, light):
    """The lens of the disc is the same upside down, but for a tilt, and so is its light, within 15 % of noise."""
    part = judged(as_designed(nominal.lens), nominal)
    [turned] = part.facts["rrmsd_turned"]
    assert part.facts["alignment"]["equal_turns"] == [180.0] and turned == pytest.approx(light.rrmsd, rel=0.15)
    assert "the RRMSD is the same there within its uncertainty" in part.facts["orientation"]
    [check, _] = made_part._light_checks(nominal, [Prediction(light, light.rrmsd, 0.001, turned=(0.3, 0.2))])
    assert check.value == 0.3 and check.where == "standard uncertainty 0.001" and not check.passed
