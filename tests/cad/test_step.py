"""The written lens is the designed lens: checked from the file by OCC, by our own parser and by scipy."""

from __future__ import annotations

import ctypes
import re

import numpy as np
import pytest
import torch
from scipy.interpolate import NdBSpline

from bstcad import commands
from bstcad.cad import step_reading, step_writing
from bstcad.cad.solid import lens_solid
from bstcad.optics.surfaces.bspline import knots, parameter
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.runs import processes
from bstcad.runs.files import SceneError
from bstcad.step_text import part21
from bstcad.verify import checks, step_checks
from tests import suite

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
    for full in text.surface.full_knots:
        assert np.array_equal(full, knots(m))
    assert text.surface.degrees == (2, 2)
    for counts in text.surface.multiplicities:
        assert counts.tolist() == [3] + [1] * (m - 3) + [3]


@pytest.mark.parametrize("outline", OUTLINES, ids=lambda o: o.shape)
def test_the_re_read_face_is_the_designed_surface(make_lens, tmp_path, outline):
    """Points and normals by OCC against the closed form, and against scipy's spline on the net of the design."""
    lens = make_lens(outline=outline, m=33)
    again = through_file(lens, tmp_path / "lens.step")
    x, y = random_points(outline)
    points, normals = step_reading.sample(again, x, y)
    z, z_x, z_y = (v.numpy() for v in lens.back.sag_and_slope(torch.from_numpy(x), torch.from_numpy(y)))
    assert np.abs(points - np.column_stack([x, y, z])).max() <= 1e-9  # mm
    normal = np.column_stack([-z_x, -z_y, np.ones_like(z)])
    assert np.abs(normals - normal / np.linalg.norm(normal, axis=1, keepdims=True)).max() < 1e-9

    net, full = lens.back.control_points(), knots(33)
    (x0, y0, _), (x1, y1, _) = net[0, 0], net[-1, -1]
    t = parameter(torch.from_numpy((x - x0) / (x1 - x0) * 32), 33).numpy()
    s = parameter(torch.from_numpy((y - y0) / (y1 - y0) * 32), 33).numpy()
    by_scipy = NdBSpline((full, full), net, (2, 2))(np.column_stack([t, s]))
    assert np.abs(points - by_scipy).max() <= 1e-9  # mm


def test_a_net_moved_sideways_is_no_lens_of_ours(make_lens, tmp_path):
    path = tmp_path / "lens.step"
    step_writing.write(lens_solid(make_lens()), path, "lens")
    path.write_text(path.read_text().replace("-10.50000000000000", "-10.40000000000000"))
    with pytest.raises(ValueError, match="a uniform grid"):
        step_reading.read(path)


@pytest.mark.parametrize(("weight", "fault"), [("1.", ""), ("1.01", "rational with weights from 1 to 1.01")])
def test_a_face_with_weights_is_the_same_face_or_refused(make_lens, tmp_path, weight, fault):
    """The file's name is stated once."""
    path, lens = tmp_path / "lens.step", make_lens(m=9)
    step_writing.write_lens(lens, path, "lens")
    written = re.search(r"B_SPLINE_SURFACE_WITH_KNOTS\('',(2,2,.*?\.[FU]\.),(\(3.*?)\);", path.read_text(), re.DOTALL)
    weights = ",".join(f"({','.join(['1.'] * 9)})" for _ in range(8)) + f",({','.join(['1.'] * 8)},{weight})"
    complex_entity = (
        f"(BOUNDED_SURFACE()B_SPLINE_SURFACE({written[1]})B_SPLINE_SURFACE_WITH_KNOTS({written[2]})"
        f"GEOMETRIC_REPRESENTATION_ITEM()RATIONAL_B_SPLINE_SURFACE(({weights}))REPRESENTATION_ITEM('')SURFACE());"
    )
    path.write_text(path.read_text().replace(written[0], complex_entity))
    if not fault:
        found = commands.examine(path)
        assert (
            found.passed and np.abs(step_reading.read(path).control_points - lens.back.control_points()).max() <= EXACT
        )
        return
    with pytest.raises(SceneError, match=fault) as caught:
        commands.examine(path)
    assert str(caught.value).count("lens.step") == 1


@pytest.mark.parametrize("name", ["lens", "it's 2\" wide; (a) #1", "Prägelinse 鏡 \\ 𝄞"])
def test_any_name_survives(make_lens, tmp_path, name):
    solid = lens_solid(make_lens(m=5))
    for _ in range(2):  # OCC itself numbers a name it has seen before
        step_writing.write(solid, tmp_path / "lens.step", name)
        assert part21.read(tmp_path / "lens.step").product == name
    assert (tmp_path / "lens.step").read_bytes().isascii()


@pytest.mark.parametrize("encoding", ["cp1252", "gb18030"])
def test_names_in_raw_bytes_are_read(make_lens, tmp_path, encoding):
    """OCC takes them for UTF-8, which they are not."""
    path, name = tmp_path / "lens.step", {"cp1252": "Größe 3 – étui", "gb18030": "自由曲面"}[encoding]
    step_writing.write_lens(make_lens(m=9), path, "lens")
    raw = name.encode(encoding)
    path.write_bytes(path.read_bytes().replace(b"'lens'", b"'" + raw + b"'").replace(b"('rim'", b"('" + raw + b"'"))
    assert part21.read(path).product == name and commands.examine(path).passed


DAMAGES = {
    "empty": (lambda t: "", "not a STEP file"),
    "truncated": (lambda t: t[: len(t) // 2], "truncated"),
    "closed half-way": (lambda t: t[: len(t) // 2] + ";\nENDSEC;\nEND-ISO-10303-21;\n", "damaged"),
    "gap": (lambda t: t[: len(t) // 3] + t[len(t) // 3 + 3000 :], "damaged"),
    "picometres": (lambda t: t.replace("SI_UNIT(.MILLI.,", "SI_UNIT(.PICO.,"), "lengths in picometre but does"),
    "no face": (lambda t: re.sub(r"(CLOSED_SHELL\('',\(#\d+),#\d+,", r"\1,", t), "0 solids"),
    "no surface": (lambda t: t.replace("B_SPLINE_SURFACE_WITH_KNOTS", "B_SPLINE_SURFAXE"), "the file has no B_SPLINE_"),
    "no solid": (lambda t: t.replace("MANIFOLD_SOLID_BREP", "FACETED_BREP"), "0 solids"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_refused_in_one_sentence(make_lens, tmp_path, damage):
    change, sentence = DAMAGES[damage]
    path = tmp_path / "lens.step"
    text = b"".join(step_writing.encode(lens_solid(make_lens(Sphere(8.0, 0.02), m=9)), "lens")).decode()
    path.write_text(change(text))
    assert path.read_text() != text
    with pytest.raises(ValueError, match=rf"lens\.step: .*{sentence}") as caught:
        checks.examine(path, processes.submit)
    assert "\n" not in str(caught.value)


@suite.in_turn(0, 2)
def test_nothing_is_printed(make_lens, tmp_path, capfd):
    """OCC would print statistics of each transfer, into the middle of what the command line says."""
    step_writing.write_lens(make_lens(m=7), tmp_path / "lens.step", "lens")
    step_reading.read(tmp_path / "lens.step")
    ctypes.CDLL(None).fflush(None)  # what C has not handed on yet
    assert capfd.readouterr() == ("", "")


def test_two_lenses_in_a_file_are_refused(make_lens, tmp_path):
    import cadquery

    solid = lens_solid(make_lens(m=7))
    pair = cadquery.Compound.makeCompound([solid, solid.translate(cadquery.Vector(50, 0, 0))])
    step_writing.write(pair, tmp_path / "pair.step", "pair")
    with pytest.raises(ValueError, match="pair.step: read as text: it has 2 solids"):
        step_checks.examine(tmp_path / "pair.step")
    with pytest.raises(ValueError, match="pair.step: .* 2 solids"):
        step_reading.read(tmp_path / "pair.step")
