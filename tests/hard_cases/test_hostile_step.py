"""14. Truncated, hostile or huge input.

Here the STEP file of a design that `verify` is asked about: damaged in three hundred ways, by a hair or by half.  OCC
reads in its own process, as the program has it do, so that what ends that process does not end the test.
"""

from __future__ import annotations

import json
import re
import shutil
import time
from pathlib import Path

import cadquery
import numpy as np
import pytest

from bstcad import commands
from bstcad.cad import step_writing
from bstcad.cad.solid import lens_solid
from bstcad.folder import read_nominal
from bstcad.optics.measure import Effort
from bstcad.report import report
from bstcad.runs import processes
from bstcad.scene.scene import SceneError, load
from tests.conftest import draws_nothing, verify_with
from tests.hard_cases import fuzz, fuzz_solids
from tests.hard_cases.same_solid import geometry, immaterial

SECONDS = 10.0  # for one file


@pytest.fixture(scope="module")
def second_process():
    """OCC in its process, with few points to compare: what is changed here shows anywhere."""

    there = processes.submit  # the module's own, which each test puts the one below in place of

    def submit(work, *arguments):
        checks = isinstance(work, str) and work.startswith("bstcad.verify.step_checks")
        return (there if checks else processes.here)(work, *arguments)

    processes.end()
    yield submit
    processes.end()


@pytest.fixture
def folder(small_design, second_process, tmp_path, monkeypatch):
    """The small design in an empty place, its target 8 % off what the lens makes, so that few rays resolve it.

    The picture travels as an array does, and both the scene and design.npz speak of it.
    """
    monkeypatch.setattr(commands.processes, "submit", second_process)
    draws_nothing(monkeypatch)
    verify_with(monkeypatch, Effort(192, places=65, points=2048))
    place = Path(shutil.copytree(small_design.folder, tmp_path / "design"))
    with np.load(place / "design.npz") as data:
        arrays = {name: data[name] for name in data.files}
    rows, columns = arrays["target"].shape
    blocks = (-1.0) ** np.add.outer(np.arange(rows // 4), np.arange(columns // 4))
    picture = arrays["target"] * (1 + 0.08 * np.kron(blocks, np.ones((4, 4))))
    as_it_is = {"target.seen_from": "behind", "target.fit": "stretch", "target.outline": None}
    scene = load(place / "scene.toml").changed({"target.image": picture, **as_it_is, "accept.rrmsd": 0.2})
    np.savez_compressed(place / "design.npz", **arrays | {"target": scene.target.irradiance()})
    (place / "scene.toml").write_text(scene.toml())
    (place / scene.target.image.name).write_bytes(scene.target.image.data)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("TMPDIR", str(tmp_path / "here"))
    verified = commands.verify(place).facts
    assert verified["passed"], [check for check in verified["checks"] if not check["passed"]]
    return place


@pytest.fixture(scope="module")
def others(small_design, tmp_path_factory):
    """STEP files of other things, and files of no kind."""
    place = tmp_path_factory.mktemp("others")
    scene, nominal = read_nominal(small_design.folder)
    lens, box = lens_solid(nominal.lens), cadquery.Workplane().box(8, 6, 10).val()
    shapes = {
        "a box": box,
        "a sphere": cadquery.Workplane().sphere(5).val(),
        "two lenses": cadquery.Compound.makeCompound([lens, lens.translate(cadquery.Vector(50, 0, 0))]),
        "a lens and a box": cadquery.Compound.makeCompound([lens, box]),
        "the lens 1 µm aside": lens.translate(cadquery.Vector(1e-3, 0, 0)),
        "the lens turned": lens.rotate(cadquery.Vector(0, 0, 0), cadquery.Vector(0, 0, 1), 90),
        "the lens mirrored": lens.mirror("YZ"),
        "its shell": lens.Shells()[0],
        "its faces": cadquery.Compound.makeCompound(lens.Faces()[:5]),
    }
    found = {}
    for name, solid in shapes.items():
        step_writing.write(solid, place / "x.step", name)
        found[name] = (place / "x.step").read_bytes()
    frame = cadquery.Assembly(name="frame").add(cadquery.Workplane().box(1, 2, 3), name="p")
    frame.add(cadquery.Workplane().sphere(1), name="q", loc=cadquery.Location((5, 0, 0))).export(str(place / "a.step"))
    found["an assembly"] = (place / "a.step").read_bytes()
    return found | dict(fuzz_solids.refuse(fuzz.generator("refuse", 0, 0)))


def verdict(path):
    """('passed', 'failed' or 'refused', what it says)."""
    try:
        found = commands.verify(path)
    except SceneError as error:
        sentence = str(error)
        assert sentence.isprintable() and "; " in sentence and len(sentence) <= 600, sentence
        return "refused", sentence
    failed = [check.name for check in found.checks if not check.passed]
    assert found.passed is (not failed)
    return ("failed" if failed else "passed"), ", ".join(failed)


def paths(place):
    return {path for path in place.rglob("*")}


def outcomes(folder, others, numbers, holds):
    """What became of each damaged file; in every fourth case also of the file by itself."""
    text, whole = (folder / "lens.step").read_text(), geometry(folder / "lens.step")
    alone = folder.parent / "alone.step"
    alone.write_text(text)
    before, slowest, count, material = paths(folder.parent), 0.0, {}, []
    for number in numbers:
        name, data = fuzz_solids.solid(fuzz.generator("solid", 2, number), text, others)
        (folder / "lens.step").write_bytes(data)
        began = time.perf_counter()
        end, _ = verdict(folder)
        slowest = max(slowest, time.perf_counter() - began)
        if number % 4 == 0:
            alone.write_bytes(data)
            verdict(alone)
        if end == "passed" and not immaterial(folder / "lens.step", whole):
            material.append((number, name))
        assert not (name == "immaterial" and end != "passed"), number
        count[end] = count.get(end, 0) + 1
    assert material == []
    holds(f"verify: damaged STEP files that it passed though another solid, of {len(numbers)}", len(material), 0)
    holds("verify: files written outside the folder", len(paths(folder.parent) - before), 0)
    holds("verify: slowest damaged STEP file (an indication)", slowest, SECONDS, "s")
    return count


def test_a_damaged_step_file_fails_is_refused_or_is_the_same_solid(folder, others, holds):
    count = outcomes(folder, others, range(30), holds)
    assert min(count.get(end, 0) for end in ("passed", "failed", "refused")) >= 2, count


@pytest.mark.bench
def test_three_hundred_damaged_step_files(folder, others, holds):
    count = outcomes(folder, others, range(30, 330), holds)
    assert min(count.get(end, 0) for end in ("passed", "failed", "refused")) >= 20, count


def test_what_moves_a_corner_or_a_pole_is_not_immaterial(folder):
    """The judge of the two tests above, judged."""
    path, text = folder / "lens.step", (folder / "lens.step").read_text()
    whole = geometry(path)
    assert immaterial(path, whole)
    for by, same in ((5e-12, True), (2e-11, False)):
        path.write_text(moved_pole(text, 9, 9, by))
        assert immaterial(path, whole) is same
    corner = re.search(r"VERTEX_POINT\('',(#\d+)\)", text).group(1)
    hit = re.search(rf"(?<={corner} = CARTESIAN_POINT\('',\()[^,]*", text)
    for by, same in ((1e-7, True), (1e-6, False)):
        path.write_text(f"{text[: hit.start()]}{float(hit.group()) + by:.14f}{text[hit.end() :]}")
        assert immaterial(path, whole) is same


def test_a_directory_in_place_of_the_file_is_one_sentence(folder):
    (folder / "lens.step").unlink()
    (folder / "lens.step").mkdir()
    assert verdict(folder) == (
        "refused",
        f"{folder}: lens.step: cannot be read (it is a folder); give the path of a STEP file",
    )


# ---- by name, and where ----------------------------------------------------------------------------------------------

NET, KNOTS, EDGES = "STEP text: control points", "STEP text: knots", "STEP text: every edge used twice, once each way"


def moved_pole(text, i, j, by, axis=2):
    """One coordinate of control point (i, j) of 33 x 33."""
    net = re.search(r"B_SPLINE_SURFACE_WITH_KNOTS\('',2,2,\((.*?)\)\s*\)\s*,\s*\.", text, re.DOTALL).group(1)
    number = re.findall(r"#(\d+)", net)[33 * i + j]
    hit = re.search(rf"#{number} = CARTESIAN_POINT\('',\(([^)]*)\)", text)
    values = [float(value) for value in hit.group(1).split(",")]
    values[axis] += by
    return text[: hit.start(1)] + ",".join(f"{value:.14f}" for value in values) + text[hit.end(1) :]


def moved_knot(text, knot, axis, by):
    """A knot of the freeform face, in u (0) or v (1)."""
    start = text.index("B_SPLINE_SURFACE_WITH_KNOTS")
    places = [hit.start() for hit in re.finditer(rf"(?<![\d.]){knot}\.0+(?!\d)", text[start : text.index(";", start)])]
    at = start + places[axis]
    return text[:at] + f"{knot + by:.14f}" + text[at + len(f"{knot:.14f}") :]


WHERE = {
    "a height": (lambda t: moved_pole(t, 12, 20, 1e-6), NET, "control point (12, 20)"),
    "a height at the rim": (lambda t: moved_pole(t, 32, 5, -1e-6), NET, "control point (32, 5)"),
    "a height by 2e-11": (lambda t: moved_pole(t, 7, 31, 2e-11), NET, "control point (7, 31)"),
    "a knot in u": (lambda t: moved_knot(t, 11, 0, 1e-13), KNOTS, "in u: knot 11"),
    "a knot in v": (lambda t: moved_knot(t, 23, 1, -1e-13), KNOTS, "in v: knot 23"),
    "an edge": (
        lambda t: re.sub(r"(ORIENTED_EDGE\('',\*,\*,#21,)\.T\.", r"\1.F.", t, count=1), EDGES,
        "edge #21: 0 times forwards, 2 times back",
    ),
}  # fmt: skip


@pytest.mark.parametrize("change", WHERE)
def test_a_change_is_named_with_its_place(folder, change):
    alter, name, where = WHERE[change]
    path = folder / "lens.step"
    text = path.read_text()
    path.write_text(alter(text))
    assert path.read_text() != text
    proof = commands.verify(folder).contents
    found = proof.facts()
    [check] = [check for check in found["checks"] if check["name"] == name]
    assert check["passed"] is found["passed"] is False and check["where"].startswith(where)
    written = json.loads((folder / "report.json").read_text())
    assert [line["where"] for line in written["checks"] if line["name"] == name] == [check["where"]]
    page = (folder / "report.html").read_text()
    assert f"{name} ({where}" in "".join(map(str, report.summary(proof).renderables)) and f"{name} ({where}" in page
    assert all(line["where"] == "" for line in found["checks"] if line["passed"])


SAID = {  # what the reader itself refuses
    "sideways": (lambda t: moved_pole(t, 12, 20, 1e-6, 0), r"1\.0e-06 mm off a uniform grid, the worst at \(12, 20\)"),
    "a knot": (lambda t: moved_knot(t, 11, 0, 1e-3), r"knots in x are not 0 … 31 \(11 is 11\.001\)"),
    "metres": (lambda t: t.replace(".MILLI.,.METRE.", "$,.METRE."), "lengths in metre"),
    "inches": (
        lambda t: t.replace("SI_UNIT(.MILLI.,.METRE.)", "CONVERSION_BASED_UNIT('INCH',#2190)"), "lengths in inch",
    ),
    "a millimetre of its own": (
        lambda t: t.replace("SI_UNIT(.MILLI.,.METRE.)", "CONVERSION_BASED_UNIT('MILLIMETRE',#2190)"),
        "lengths in millimetre by a factor of its own",
    ),
    "thousandths of a radian": (lambda t: t.replace("$,.RADIAN.", ".MILLI.,.RADIAN."), "angles in milliradian"),
}  # fmt: skip


@pytest.mark.parametrize("change", SAID)
def test_what_is_no_lens_in_millimetres_says_what_it_is(folder, change):
    alter, sentence = SAID[change]
    path = folder / "lens.step"
    text = path.read_text()
    path.write_text(alter(text))
    assert path.read_text() != text
    with pytest.raises(SceneError, match=rf"lens\.step: .*{sentence}"):
        commands.verify(folder)


def test_a_report_that_says_passed_does_not_pass_an_altered_file(folder):
    """Whatever an earlier report, or a hand in it, says."""
    path = folder / "lens.step"
    assert json.loads((folder / "report.json").read_text())["passed"] is True
    path.write_text(moved_pole(path.read_text(), 3, 4, 1e-6))
    assert commands.verify(folder).passed is False
    forged = json.loads((folder / "report.json").read_text())
    for check in forged["checks"]:
        check |= {"passed": True, "where": ""}
    (folder / "report.json").write_text(json.dumps(forged | {"passed": True}))
    assert commands.verify(folder).passed is False
    assert json.loads((folder / "report.json").read_text())["passed"] is False
