"""15. Truncated, hostile and huge files.

Here the STEP file of a design that `verify` is asked about: damaged by a hair or by half.  OCC reads in its own
process, as the program has it do, so that what ends that process does not end the test.
"""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from pathlib import Path
from random import Random

import cadquery
import numpy as np
import psutil
import pytest

from bstcad import commands
from bstcad.cad import step_reading, step_writing
from bstcad.cad.solid import lens_solid
from bstcad.designs.folder import read_nominal
from bstcad.optics.trace.measure import Effort
from bstcad.report import report
from bstcad.runs import processes
from bstcad.scene.scene import SceneError
from tests import suite
from tests.conftest import draws_nothing, verify_with
from tests.hard_cases import fuzz

SECONDS = 10.0  # largest CPU seconds for one file
NOISE = "standard error of the RRMSD, times five"  # check that fails by the few rays of the test, whatever the file


@pytest.fixture
def folder(small_design, tmp_path, monkeypatch):
    """The small design in an empty place, where temporary files show, too; few points: a change shows anywhere."""
    draws_nothing(monkeypatch)
    verify_with(monkeypatch, Effort(192, places=65, points=2048, tubes=97))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("TMPDIR", str(tmp_path / "here"))
    return Path(shutil.copytree(small_design.folder, tmp_path / "design"))


@pytest.fixture(scope="module")
def others(small_design, tmp_path_factory):
    """STEP texts of other things, and texts of no kind."""
    path = tmp_path_factory.mktemp("others") / "x.step"
    lens, box = lens_solid(read_nominal(small_design.folder).lens), cadquery.Workplane().box(8, 6, 10)
    shapes = {
        "the lens 1 µm aside": lens.translate(cadquery.Vector(1e-3, 0, 0)),
        "the lens turned": lens.rotate(cadquery.Vector(0, 0, 0), cadquery.Vector(0, 0, 1), 90),
        "a box": box.val(),
        "a lens and a box": cadquery.Compound.makeCompound([lens, box.val()]),
        "the lens mirrored": lens.mirror("YZ"),
        "its shell": lens.Shells()[0],
    }
    found = {}
    for name, solid in shapes.items():
        step_writing.write(solid, path, name)
        found[name] = path.read_bytes()
    cadquery.Assembly(box, name="frame").add(cadquery.Workplane().sphere(1), name="q").export(str(path))
    head = b"ISO-10303-21;\nHEADER;\nFILE_SCHEMA(('AP242'));\nENDSEC;\nDATA;\n"
    return found | {
        "an assembly": path.read_bytes(), "zeros": bytes(100_000), "brackets": head + b"#1=" + b"(" * 300_000 + END,
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
    failed = [check.name for check in found.checks if not check.passed and check.name != NOISE]
    return ("failed" if failed else "passed"), ", ".join(failed)


# ---- do two files hold the same solid?  What damage may leave of one that `verify` still passes ----------------------

FACE = 1e-11  # mm: what sixteen digits of text leave of a control point
REST = 5e-7  # mm: what the report lets edges and vertices bridge


def geometry(path):
    """(net and knots of the freeform face, corners (n, 3), edges) as OCC reads them; edges tell the side faces."""
    found = step_reading.read(path)
    shape = cadquery.Shape.cast(found.shape)
    corners = sorted((corner.toTuple() for corner in shape.Vertices()), key=lambda c: np.round(c, 3).tolist())
    return found.control_points.ravel(), np.array(corners), shape.Edges()


def apart(edge, other):
    """Largest distance (mm) of nine points of an edge from another, wherever along it."""
    places = edge.positions(np.linspace(0.0, 1.0, 9))
    return max(cadquery.Vertex.makeVertex(*place.toTuple()).distance(other) for place in places)


def immaterial(path, whole):
    """Is the solid that OCC reads the same: its freeform face to FACE, its corners and each of its edges to REST?"""
    (face, corners, edges), (face_0, corners_0, edges_0) = geometry(path), whole
    if face.shape != face_0.shape or corners.shape != corners_0.shape or len(edges) != len(edges_0):
        return False
    if np.abs(face - face_0).max() > FACE or np.abs(corners - corners_0).max() > REST:
        return False
    off = np.array([[apart(edge, other) for other in edges_0] for edge in edges])
    return sorted(off.argmin(1)) == list(range(len(edges))) and bool(off.min(1).max() <= REST)


def test_a_text_that_holds_the_same_solid_passes(folder):
    """Other dates, names, blanks, numbers of entities, digits, and an entity that nothing needs."""
    path = folder / "lens.step"
    text = re.sub(r"'\d{4}-\d\d-\d\dT[\d:]+'", "'2001-01-01T00:00:00'", path.read_text())
    text = text.replace("PRODUCT('small','small'", "PRODUCT('part 7','rev B'").replace(",", ",\n  ").replace(" = ", "=")
    text = re.sub(r"#(\d+)", lambda hit: f"#{int(hit[1]) + 5000}", text)
    text = re.sub(r"-?\d+\.\d+(?:E[-+]\d+)?", lambda hit: f"{float(hit[0]):.17E}", text)
    path.write_text(text.replace("DATA;", "DATA;\n#777777 = DIRECTION('stray',(0.,0.,1.));", 1))
    assert verdict(folder) == ("passed", "")


# ---- by name, and where ----------------------------------------------------------------------------------------------


def moved_pole(text, i, j, by):
    """z of control point (i, j) of 33 x 33."""
    net = re.search(r"B_SPLINE_SURFACE_WITH_KNOTS\('',2,2,\((.*?)\)\s*\)\s*,\s*\.", text, re.DOTALL).group(1)
    number = re.findall(r"#(\d+)", net)[33 * i + j]
    hit = re.search(rf"#{number} = CARTESIAN_POINT\('',\(([^)]*)\)", text)
    values = [float(value) for value in hit.group(1).split(",")]
    values[2] += by
    return text[: hit.start(1)] + ",".join(f"{value:.14f}" for value in values) + text[hit.end(1) :]


def test_a_change_is_named_with_its_place(folder):
    """A height at the rim by 2e-11 mm."""
    name, where = "STEP text: deviation of the control points", "control point (32, 5)"
    path = folder / "lens.step"
    path.write_text(moved_pole(path.read_text(), 32, 5, -2e-11))
    (folder / "report.json").write_text('{"passed": true, "checks": [], "rrmsd": 0.0}')  # which is not believed
    proof = commands.verify(folder).contents
    found = proof.facts()
    [check] = [check for check in found["checks"] if check["name"] == name]
    assert check["passed"] is found["passed"] is False and check["where"].startswith(where)
    written = json.loads((folder / "report.json").read_text())
    assert [line["where"] for line in written["checks"] if line["name"] == name] == [check["where"]]
    page = (folder / "report.html").read_text()
    assert f"{name} ({where}" in "".join(map(str, report.summary(proof).renderables)) and f"{name} ({where}" in page
    assert all(line["where"] == "" for line in found["checks"] if line["passed"])


# ---- damaged at random; refused files end OCC's process, whose start takes three seconds, so this comes last --------


def processor():
    """Seconds of this process and of those that it started, OCC's among them."""
    me = psutil.Process()
    return sum(sum(process.cpu_times()[:2]) for process in (me, *me.children(recursive=True)))


CHANGES = ("exchange", "exchange", "number", "statement", "cut", *["digit"] * 5)
SEEDS = ((10, 3, 5, 4), (15, 6, 7, 9), (23, 8, 14, 11))  # seeds of the shares; each comes to all three ends
REFUSED = (4, 9, 11)  # seeds of files that are refused, which ends OCC's process; its next start takes three seconds


@pytest.mark.parametrize(
    "share", [*suite.in_turns(range(len(SEEDS)), len(SEEDS)), pytest.param(-1, marks=pytest.mark.bench)]
)
def test_a_damaged_step_file_fails_is_refused_or_is_the_same_solid(folder, others, holds, share):
    """Most by an exchange within one kind of entity, some cut; and files of other things altogether.

    Files that are known to be refused come last.
    """
    seeds, part = (range(3, 303), slice(None)) if share < 0 else (SEEDS[share], slice(share, None, len(SEEDS)))
    path, alone = folder / "lens.step", folder.parent / "alone.step"
    good, whole = fuzz.Good(path.read_text(), ";"), geometry(path)
    processes.end()  # another one starts here
    shutil.copy(path, alone)
    assert verdict(folder) == ("passed", "")
    before, slowest, ends = set(folder.parent.rglob("*")), 0.0, Counter()
    damaged = {seed: fuzz.changed(Random(seed), good, CHANGES, 2).encode("latin-1", "replace") for seed in seeds}
    aside, turned, *further = others.values()
    files = [(data, True) for seed, data in damaged.items() if seed not in REFUSED]
    files += [(data, False) for data in (aside, turned)[part]]
    files += [(damaged[seed], True) for seed in REFUSED if seed in damaged] + [(data, False) for data in further[part]]
    for number, (data, is_damaged) in enumerate(files):
        path.write_bytes(data)
        began = processor()
        end, _ = verdict(folder)
        slowest = max(slowest, processor() - began)
        assert end != "passed" or (is_damaged and immaterial(path, whole)), number
        ends[end] += is_damaged
        if number % 8 == 0:  # and the file by itself
            alone.write_bytes(data)
            verdict(alone)
    assert min(ends[end] for end in ("passed", "failed", "refused")) >= 1, ends
    holds("verify: files written outside the folder", len(set(folder.parent.rglob("*")) - before), 0)
    holds(f"verify: slowest of {len(seeds)} damaged STEP files (an indication)", slowest, SECONDS, "s")


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
