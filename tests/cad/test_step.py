"""What is written is what was designed: checked by OCC, by our own parser and by scipy, from the file."""

from __future__ import annotations

import random
import re
import subprocess
import sys

import numpy as np
import pytest
import torch
from OCP.Interface import Interface_Static
from OCP.STEPControl import STEPControl_Writer
from scipy.interpolate import NdBSpline

from bstcad.cad import step_reading, step_writing
from bstcad.cad.mass_properties import exact_volume
from bstcad.cad.solid import lens_solid
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.spline_basis import knots, parameter
from bstcad.optics.surfaces import Plane, Sphere
from bstcad.runs import processes
from bstcad.step_text import part21
from bstcad.verify import checks, step_checks

OUTLINES = [Rectangle(24.0, 20.0), Circle(12.0)]
EXACT = 1e-11  # mm, the acceptance; the file holds 14 decimals


def through_file(lens, path):
    step_writing.write(lens_solid(lens), path, "lens")
    return step_reading.read(path)


def random_points(outline, n=4000):
    half_x, half_y = outline.half_extent
    g = np.random.default_rng(5)
    x, y = g.uniform(-half_x, half_x, n), g.uniform(-half_y, half_y, n)
    inside = outline.contains(torch.from_numpy(x), torch.from_numpy(y)).numpy()
    return x[inside], y[inside]


@pytest.mark.parametrize("outline", OUTLINES, ids=lambda o: o.shape)
@pytest.mark.parametrize("m", [9, 65])
def test_net_and_knots_survive_the_file_by_two_readers(make_lens, tmp_path, outline, m):
    lens = make_lens(outline=outline, m=m)
    again = through_file(lens, tmp_path / "lens.step")
    text, net = part21.read(tmp_path / "lens.step"), lens.back.control_points()
    assert np.abs(again.control_points - net).max() <= EXACT
    assert np.abs(text.surface.control_points - net).max() <= EXACT
    for full in (again.knots_x, again.knots_y, *text.surface.full_knots):
        assert np.array_equal(full, knots(m))
    assert text.surface.degrees == (2, 2) and not text.surface.rational
    for counts in text.surface.multiplicities:
        assert counts.tolist() == [3] + [1] * (m - 3) + [3]


@pytest.mark.parametrize("outline", OUTLINES, ids=lambda o: o.shape)
@pytest.mark.parametrize("front", [Plane(8.0), Sphere(8.0, 0.02), Sphere(8.0, -0.03), Sphere(8.0, 1e-6)], ids=str)
def test_the_file_holds_one_closed_solid_in_millimetres(make_lens, tmp_path, outline, front):
    again = through_file(make_lens(front, outline), tmp_path / "lens.step")
    faces, edges = (6, 12) if isinstance(outline, Rectangle) else (3, 3)
    text = part21.read(tmp_path / "lens.step")
    assert (text.solids, text.faces, len(text.edge_uses)) == (1, faces, edges)
    assert text.closed  # each edge once forwards, once backwards
    assert (text.unit, text.product) == ("millimetre", "lens") and text.schema.startswith("AP242")
    assert again.solid.isValid() and (len(again.solid.Faces()), len(again.solid.Edges())) == (faces, edges)
    assert again.solid.Volume() > 0


@pytest.mark.parametrize("outline", OUTLINES, ids=lambda o: o.shape)
def test_the_re_read_face_is_the_designed_surface(make_lens, tmp_path, outline):
    """Points and normals by OCC against the closed form, and against scipy's spline on the net of the design."""
    lens = make_lens(outline=outline, m=33)
    again = through_file(lens, tmp_path / "lens.step")
    x, y = random_points(outline)
    found = step_reading.sample(again, x, y)
    z, z_x, z_y = (v.numpy() for v in lens.back.sag_and_slope(torch.from_numpy(x), torch.from_numpy(y)))
    assert np.abs(found.points - np.column_stack([x, y, z])).max() <= 1e-9  # mm
    normal = np.column_stack([-z_x, -z_y, np.ones_like(z)])
    assert np.abs(found.normals - normal / np.linalg.norm(normal, axis=1, keepdims=True)).max() < 1e-9

    net, full = lens.back.control_points(), knots(33)
    (x0, y0, _), (x1, y1, _) = net[0, 0], net[-1, -1]
    t = parameter(torch.from_numpy((x - x0) / (x1 - x0) * 32), 33).numpy()
    s = parameter(torch.from_numpy((y - y0) / (y1 - y0) * 32), 33).numpy()
    by_scipy = NdBSpline((full, full), net, (2, 2))(np.column_stack([t, s]))
    assert np.abs(found.points - by_scipy).max() <= 1e-9  # mm


@pytest.mark.parametrize("outline", OUTLINES, ids=lambda o: o.shape)
@pytest.mark.parametrize("curvature", [0.0, 1e-9, -1e-6, 3e-5, -5e-5, 0.02, -0.03])
def test_the_re_read_lens_is_the_designed_lens(make_lens, tmp_path, outline, curvature):
    lens = make_lens(Sphere(8.0, curvature), outline)
    again = step_reading.lens(through_file(lens, tmp_path / "lens.step"), lens.index)
    assert again.outline == outline and again.index == lens.index
    assert isinstance(again.front, Plane if curvature == 0 else Sphere)
    assert again.front.z == pytest.approx(8.0, abs=1e-10)  # mm; 14 decimals of a centre up to 4e4 mm away
    assert getattr(again.front, "curvature", 0.0) == pytest.approx(curvature, rel=1e-5)
    assert exact_volume(again) == pytest.approx(exact_volume(lens), rel=1e-11)
    x, y = (torch.from_numpy(v) for v in random_points(outline, 500))
    for a, b in zip(again.back.sag_and_slope(x, y), lens.back.sag_and_slope(x, y), strict=True):
        assert float((a - b).abs().max()) < 1e-11


def test_a_net_altered_after_writing_is_seen(make_lens, tmp_path):
    lens = make_lens()
    path = tmp_path / "lens.step"
    before, said = through_file(lens, path), part21.read(path).surface.control_points
    x, y = random_points(lens.outline)
    z = f"{lens.back.control_points()[8, 8, 2]:.14f}"
    text = path.read_text()
    assert text.count(z) == 1
    path.write_text(text.replace(z, f"{float(z) + 1e-6:.14f}"))  # mm: a nanometre
    after = step_reading.read(path)
    assert np.abs(after.control_points - before.control_points).max() == pytest.approx(1e-6, rel=1e-6)
    assert np.abs(part21.read(path).surface.control_points - said).max() > EXACT
    assert np.abs(step_reading.sample(after, x, y).points - step_reading.sample(before, x, y).points).max() > 1e-9


def test_a_net_moved_sideways_is_no_lens_of_ours(make_lens, tmp_path):
    path = tmp_path / "lens.step"
    step_writing.write(lens_solid(make_lens()), path, "lens")
    path.write_text(path.read_text().replace("-10.50000000000000", "-10.40000000000000"))
    with pytest.raises(ValueError, match="off a uniform grid"):
        step_reading.back_surface(step_reading.read(path))


def test_an_edge_turned_around_is_seen_though_occ_calls_the_solid_valid(make_lens, tmp_path):
    path = tmp_path / "lens.step"
    step_writing.write(lens_solid(make_lens()), path, "lens")
    path.write_text(re.sub(r"(ORIENTED_EDGE\('',\*,\*,#\d+,)\.T\.", r"\1.F.", path.read_text(), count=1))
    assert not part21.read(path).closed


@pytest.mark.parametrize("name", ["lens", "it's 2\" wide; (a) #1", "Prägelinse 鏡 \\ 𝄞"])
def test_any_name_survives(make_lens, tmp_path, name):
    solid = lens_solid(make_lens(m=5))
    for _ in range(2):  # OCC itself numbers a name it has seen before
        step_writing.write(solid, tmp_path / "lens.step", name)
        assert part21.read(tmp_path / "lens.step").product == name
    assert (tmp_path / "lens.step").read_bytes().isascii()


def test_writing_leaves_no_trace_in_the_process(make_lens):
    STEPControl_Writer()
    before = Interface_Static.CVal_s("write.step.schema")
    step_writing.encode(lens_solid(make_lens(m=5)), "lens")
    assert Interface_Static.CVal_s("write.step.schema") == before


DAMAGES = {
    "empty": (lambda t: "", "not a STEP file"),
    "truncated": (lambda t: t[: len(t) // 2], "truncated"),
    "closed half-way": (lambda t: t[: len(t) // 2] + ";\nENDSEC;\nEND-ISO-10303-21;\n", "damaged"),
    "gap": (lambda t: t[: len(t) // 3] + t[len(t) // 3 + 3000 :], "damaged"),
    "metres": (lambda t: t.replace("SI_UNIT(.MILLI.,.METRE.)", "SI_UNIT($,.METRE.)"), "lengths in metre"),
    "no face": (lambda t: re.sub(r"(CLOSED_SHELL\('',\(#\d+),#\d+,", r"\1,", t), "damaged"),
    "no surface": (lambda t: t.replace("B_SPLINE_SURFACE_WITH_KNOTS", "B_SPLINE_SURFAXE"), "text: no B_SPLINE_SURFACE"),
    "no solid": (lambda t: t.replace("MANIFOLD_SOLID_BREP", "FACETED_BREP"), "0 solids"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_refused_in_one_sentence(make_lens, tmp_path, damage):
    change, sentence = DAMAGES[damage]
    path = tmp_path / "lens.step"
    text = step_writing.encode(lens_solid(make_lens(Sphere(8.0, 0.02), m=9)), "lens").decode()
    path.write_text(change(text))
    assert path.read_text() != text
    with pytest.raises(ValueError, match=rf"lens\.step: .*{sentence}") as caught:
        checks.examine(path, processes.submit)
    assert "\n" not in str(caught.value)


def test_nothing_is_printed(make_lens, tmp_path):
    """OCC would print statistics of each transfer, into the middle of what the command line says."""
    torch.save(make_lens(m=7), tmp_path / "lens.pt")
    code = (
        "import sys, torch\nfrom bstcad.cad import step_reading, step_writing\n"
        "lens = torch.load(sys.argv[1], weights_only=False)\n"
        "step_writing.write_lens(lens, sys.argv[2], 'lens')\nstep_reading.read(sys.argv[2])\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "lens.pt"), str(tmp_path / "lens.step")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_random_damage_is_one_sentence(make_lens, tmp_path):
    """OCC ends its process over one or two in a hundred of these, which is a sentence here."""
    path, g = tmp_path / "lens.step", random.Random(3)
    step_writing.write(lens_solid(make_lens(m=7)), path, "lens")
    text, said = path.read_text(), []
    for _ in range(24):
        i, n = g.randrange(600, len(text) - 600), g.choice([1, 1, 10, 400])
        new = g.choice(["", g.choice("0123456789#(),.*$;T "), text[(j := g.randrange(600, len(text) - 600)) : j + n]])
        path.write_text(text[:i] + new + text[i + n :])
        try:
            checks.examine(path, processes.submit)
        except ValueError as error:
            said.append(str(error))
    processes.end()
    assert len(said) > 5
    assert all(re.fullmatch(r"lens\.step: (read as text: |read by OCC: |OCC ).*; .*", each) for each in said), said


def test_two_lenses_in_a_file_are_refused(make_lens, tmp_path):
    import cadquery

    solid = lens_solid(make_lens(m=7))
    pair = cadquery.Compound.makeCompound([solid, solid.translate(cadquery.Vector(50, 0, 0))])
    step_writing.write(pair, tmp_path / "pair.step", "pair")
    with pytest.raises(ValueError, match="pair.step: read as text: 2 solids"):
        step_checks.examine(tmp_path / "pair.step")
    with pytest.raises(ValueError, match="pair.step: OCC finds 2 solids"):
        step_reading.read(tmp_path / "pair.step")


def test_a_folder_that_is_not_there_is_named(make_lens, tmp_path):
    with pytest.raises(FileNotFoundError, match="gone"):
        step_writing.write(lens_solid(make_lens(m=5)), tmp_path / "gone" / "lens.step", "lens")
