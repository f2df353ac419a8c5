"""14. Truncated, hostile or huge input.

Here the STEP file of a design that `verify` is asked about: damaged by a hair or by half.  OCC reads in its own
process, as the program has it do, so that what ends that process does not end the test.
"""

from __future__ import annotations

import json
import re
import shutil
import time
from collections import Counter
from pathlib import Path

import cadquery
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from OCP.BRep import BRep_Tool
from OCP.BRepAdaptor import BRepAdaptor_Curve
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeVertex
from OCP.BRepExtrema import BRepExtrema_DistShapeShape
from OCP.TopAbs import TopAbs_EDGE, TopAbs_VERTEX
from OCP.TopoDS import TopoDS

from bstcad import commands
from bstcad.cad import step_reading, step_writing
from bstcad.cad.solid import lens_solid
from bstcad.cad.step_reading import parts_of
from bstcad.folder import read_nominal
from bstcad.optics.measure import Effort
from bstcad.report import report
from bstcad.runs import processes
from bstcad.scene.scene import SceneError, load
from tests.conftest import draws_nothing, verify_with
from tests.hard_cases import fuzz
from tests.hard_cases.lenses import examples

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


@pytest.fixture(scope="module")
def design(small_design, tmp_path_factory):
    """The small design, its target 8 % off what the lens makes, so that few rays resolve it.

    The picture travels as an array does, and both the scene and design.npz speak of it.
    """
    place = Path(shutil.copytree(small_design.folder, tmp_path_factory.mktemp("sent") / "design"))
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
    return place


@pytest.fixture
def folder(design, second_process, tmp_path, monkeypatch):
    """The design in an empty place, where temporary files show, too."""
    monkeypatch.setattr(commands.processes, "submit", second_process)
    draws_nothing(monkeypatch)
    verify_with(monkeypatch, Effort(192, places=65, points=2048))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("TMPDIR", str(tmp_path / "here"))
    return Path(shutil.copytree(design, tmp_path / "design"))


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
    head = b"ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION(('2147483648 bytes'),'2;1');\nFILE_SCHEMA(('AP242'));\n"
    head += b"ENDSEC;\nDATA;\n"
    return found | {
        "empty": b"", "a header alone": head + END, "zeros": bytes(100_000), "UTF-16": "ISO-10303-21;".encode("utf-16"),
        "rubbish": np.random.default_rng(0).bytes(50_000), "brackets": head + b"#1=" + b"(" * 300_000 + END,
        "a claim of 2 GB": head + b"#2147483647=CARTESIAN_POINT('',(0.,0.,0.));\n" + END,
    }  # fmt: skip


END = b"ENDSEC;\nEND-ISO-10303-21;\n"


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


# ---- do two files hold the same solid?  What damage may leave of one that `verify` still passes ----------------------

FACE = 1e-11  # mm: what sixteen digits of text leave of a control point
REST = 5e-7  # mm: what the report lets edges and vertices bridge


def geometry(path):
    """(net and knots of the freeform face, corners (n, 3), edges) as OCC reads them; edges tell the side faces."""
    found = step_reading.read(path)
    face = found.control_points.ravel()
    corners = [BRep_Tool.Pnt_s(TopoDS.Vertex_s(v)).Coord() for v in parts_of(found.shape, TopAbs_VERTEX)]
    corners.sort(key=lambda corner: np.round(corner, 3).tolist())
    return face, np.array(corners), [TopoDS.Edge_s(e) for e in parts_of(found.shape, TopAbs_EDGE)]


def apart(edge, other):
    """Largest distance (mm) of nine points of an edge from another, wherever along it."""
    curve = BRepAdaptor_Curve(edge)
    points = (curve.Value(t) for t in np.linspace(curve.FirstParameter(), curve.LastParameter(), 9))
    vertices = (BRepBuilderAPI_MakeVertex(point).Vertex() for point in points)
    return max(BRepExtrema_DistShapeShape(vertex, other).Value() for vertex in vertices)


def immaterial(path, whole):
    """Is the solid that OCC reads the same: its freeform face to FACE, its corners and each of its edges to REST?"""
    (face, corners, edges), (face_0, corners_0, edges_0) = geometry(path), whole
    if face.shape != face_0.shape or corners.shape != corners_0.shape or len(edges) != len(edges_0):
        return False
    if np.abs(face - face_0).max() > FACE or np.abs(corners - corners_0).max() > REST:
        return False
    off = np.array([[apart(edge, other) for other in edges_0] for edge in edges])
    return sorted(off.argmin(1)) == list(range(len(edges))) and bool(off.min(1).max() <= REST)


IMMATERIAL = {  # to a reader of shapes
    "dates": lambda text: re.sub(r"'\d{4}-\d\d-\d\dT[\d:]+'", "'2001-01-01T00:00:00'", text),
    "product": lambda text: text.replace("PRODUCT('small','small'", "PRODUCT('part 7','rev B'"),
    "blanks": lambda text: text.replace(",", ",\n  ").replace(" = ", "="),
    "entity numbers": lambda text: re.sub(r"#(\d+)", lambda hit: f"#{int(hit[1]) + 5000}", text),
    "digits": lambda text: re.sub(r"-?\d+\.\d+(?:E[-+]\d+)?", lambda hit: f"{float(hit[0]):.17E}", text),
    "a stray entity": lambda text: text.replace("DATA;", "DATA;\n#777777 = DIRECTION('stray',(0.,0.,1.));", 1),
}


@pytest.mark.parametrize("change", IMMATERIAL)
def test_a_text_that_holds_the_same_solid_passes(folder, change):
    path = folder / "lens.step"
    path.write_text(IMMATERIAL[change](path.read_text()))
    assert verdict(folder) == ("passed", "")


@pytest.mark.parametrize("count", [30, pytest.param(300, marks=pytest.mark.bench)])
def test_a_damaged_step_file_fails_is_refused_or_is_the_same_solid(folder, others, holds, count):
    """Most by an exchange within one kind of entity, some cut, a few of them files of other things altogether."""
    path, alone = folder / "lens.step", folder.parent / "alone.step"
    good, whole = fuzz.Good(path.read_text(), ";"), geometry(path)
    alone.write_text(good.text)
    assert verdict(folder) == ("passed", "")  # whole; and its second process runs from here on
    before, slowest, ends = set(folder.parent.rglob("*")), 0.0, Counter()
    changes = (fuzz.exchange, fuzz.exchange, fuzz.number, fuzz.statement, fuzz.cut, *[fuzz.digit] * 5)
    damaged = fuzz.texts([good], changes, most=2).map(lambda text: text.encode("latin-1", "replace"))
    damages = st.one_of(*[damaged] * 4, st.sampled_from(sorted(others)).map(others.get))

    @given(damages)
    @examples(count)
    def every_end_is_right(data):
        nonlocal slowest
        path.write_bytes(data)
        began = time.perf_counter()
        end, _ = verdict(folder)
        slowest = max(slowest, time.perf_counter() - began)
        ends[end] += 1
        assert end != "passed" or immaterial(path, whole)
        if ends.total() % 8 == 0:  # and the file by itself
            alone.write_bytes(data)
            verdict(alone)

    every_end_is_right()
    assert min(ends[end] for end in ("passed", "failed", "refused")) >= count // 30, ends
    holds(f"verify: damaged STEP files that it passed though another solid, of {count}", 0, 0)
    holds("verify: files written outside the folder", len(set(folder.parent.rglob("*")) - before), 0)
    holds("verify: slowest damaged STEP file (an indication)", slowest, SECONDS, "s")


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
    assert commands.verify(folder).passed
    path.write_text(moved_pole(path.read_text(), 3, 4, 1e-6))
    assert commands.verify(folder).passed is False
    forged = json.loads((folder / "report.json").read_text())
    for check in forged["checks"]:
        check |= {"passed": True, "where": ""}
    (folder / "report.json").write_text(json.dumps(forged | {"passed": True}))
    assert commands.verify(folder).passed is False
    assert json.loads((folder / "report.json").read_text())["passed"] is False
