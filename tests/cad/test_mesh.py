"""The mesh: closed, wound outwards, of the lens's volume, and as far from the lens as it says."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
import zipfile

import numpy as np
import pytest
import torch
import trimesh

from bstcad.cad import mesh
from bstcad.cad.distances import normals_near
from bstcad.cad.mesh import Mesh, chordal_error, is_closed, lens_mesh, volume_and_area
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Sphere, sag
from bstcad.verify.checks import VERTEX_ROUNDING
from tests.exact_volume import exact_volume
from tests.lenses import lens_of, net

RECTANGLE, CIRCLE = Rectangle(24.0, 20.0), Circle(12.0)
OUTLINES = pytest.mark.parametrize("outline", [RECTANGLE, CIRCLE], ids=lambda o: o.shape)
FRONTS = pytest.mark.parametrize("front", [Plane(8.0), Sphere(8.0, 0.02), Sphere(8.0, -0.03)], ids=str)


def by_trimesh(made):
    return trimesh.Trimesh(made.vertices, made.faces, process=False)


def test_normals_of_a_sphere_point_away_from_its_centre():
    x, y = np.meshgrid(np.linspace(-5, 4, 7), np.linspace(-6, 3, 6))
    centre, points = np.array([0.0, 0.0, 8.0 - 20.0]), np.stack([x, y, np.full_like(x, 8.0)], -1).reshape(-1, 3)
    points[:, 2] = centre[2] + np.sqrt(400.0 - x**2 - y**2).ravel()
    np.testing.assert_allclose(normals_near(Sphere(8.0, -0.05), points), (points - centre) / 20.0, rtol=0, atol=1e-12)


@OUTLINES
@FRONTS
def test_closed_and_wound_outwards_and_all_vertices_on_the_lens(make_lens, outline, front):
    lens = make_lens(front, outline)
    own = lens_mesh(lens, 32)
    made = by_trimesh(own)
    assert made.is_watertight and made.is_winding_consistent and made.body_count == 1
    assert made.volume > 0 and made.euler_number == 2
    assert made.area_faces.min() > 0
    assert (made.volume, made.area) == pytest.approx(volume_and_area(own), rel=1e-12)
    assert made.volume == pytest.approx(exact_volume(lens), rel=2e-3)  # 32 cells
    x, y, z = torch.from_numpy(own.vertices).T
    back, low = (surface.sag_and_slope(x, y)[0] for surface in (lens.back, lens.front))
    assert float(torch.minimum((z - back).abs(), (z - low).abs()).max()) < 1e-12
    round_rim = (torch.hypot(x, y) - 12).abs() < 1e-12
    rim = round_rim if isinstance(outline, Circle) else (x.abs() == 12) | (y.abs() == 10)
    assert int(rim.sum()) == 2 * 4 * 32


@OUTLINES
@FRONTS
def test_the_grid_is_as_fine_as_its_tolerance_requires_and_no_finer(make_lens, outline, front):
    """The chordal error falls with the square of the spacing: 11 % fewer cells would miss the tolerance by a fifth."""
    lens = make_lens(front, outline, m=65)
    for tolerance in (5e-3, 1e-3):
        cells, made = mesh.fit_mesh(lens, tolerance)
        volume, area = volume_and_area(made)
        assert chordal_error(made, lens) <= tolerance
        assert chordal_error(lens_mesh(lens, 2 * round(0.445 * cells)), lens) > tolerance
        assert abs(volume - exact_volume(lens)) <= area * tolerance


@pytest.mark.parametrize("sense", [1, -1])
def test_cells_are_cut_along_a_ridge(sense):
    """A cylinder of curvature c at 45 degrees: cut over it, facets are off by c h²/4, along it by c h²/16 at edges."""
    c = 0.01
    lens = lens_of(net(lambda x, y: c / 4 * (x - sense * y) ** 2, m=65), Plane(8.0))
    across = 20.0 / 32
    assert chordal_error(lens_mesh(lens, 32), lens) < 1.1 * c * across**2 / 16


def test_what_so_many_triangles_cannot_do_is_not_tried(make_lens, monkeypatch):
    """A mesh as large as may be, that is not fine enough all the same, serves nobody: it is as large as by default."""
    monkeypatch.setattr(mesh, "DEFAULT_MAX_TRIANGLES", 5_000)
    lens = make_lens(m=33)
    for most, asked, cells in ((20_000, 1e-9, mesh.max_cells(lens)), (4_000, 1e-9, mesh.max_cells(lens, 4_000))):
        assert mesh.fit_mesh(lens, asked, most)[0] == cells
    reached = chordal_error(lens_mesh(lens, mesh.max_cells(lens, 20_000)), lens)
    cells, made = mesh.fit_mesh(lens, 1.1 * reached, 20_000)
    assert mesh.max_cells(lens) < cells <= mesh.max_cells(lens, 20_000)
    assert chordal_error(made, lens) <= 1.1 * reached


@pytest.mark.parametrize("allowed", [None, 4_000, 20_000])
def test_an_error_that_is_only_known_to_be_too_large_leads_to_the_same_grid(make_lens, monkeypatch, allowed):
    monkeypatch.setattr(mesh, "DEFAULT_MAX_TRIANGLES", 5_000)
    lens, ended = make_lens(m=33), []

    def error(made, lens, enough=np.inf):
        whole = chordal_error(made, lens)
        ended.append(chordal_error(made, lens, enough) < whole)
        return whole

    for tolerance in np.geomspace(1e-4, 1e-1, 40):
        cells, _ = mesh.fit_mesh(lens, tolerance, allowed)
        with monkeypatch.context() as patched:
            patched.setattr(mesh, "chordal_error", error)
            assert mesh.fit_mesh(lens, tolerance, allowed)[0] == cells
    assert any(ended)


def test_facets_larger_than_what_they_have_to_follow_are_seen_to_miss_it():
    """A net that goes up and down from point to point by 1 µm, under facets of eight spans."""
    ripple = 5e-4 * (-1.0) ** torch.arange(129)
    lens = lens_of(net(ripple[:, None].expand(129, 129).double()), Plane(8.0))
    heights = lens.back.sag_and_slope(*(torch.linspace(-10, 10, 50_000, dtype=torch.float64),) * 2)[0]
    swing = float(heights.max() - heights.min())
    error = chordal_error(lens_mesh(lens, 16), lens)
    assert 0.5 * swing < error < 1.01 * swing
    assert mesh.fit_mesh(lens, 2 * swing)[0] == mesh.MIN_MESH_CELLS < mesh.fit_mesh(lens, 0.2 * swing)[0]
    heights = torch.zeros((129, 129), dtype=torch.float64)
    heights[67, 66] = 1e-3  # one point, which lies beside the middles of facets and edges
    lens = lens_of(net(heights), Plane(8.0))
    assert 0.4e-3 < chordal_error(lens_mesh(lens, 16), lens) < 0.6e-3


def test_the_chordal_error_of_a_sphere_is_the_sagitta_and_of_a_round_wall_that_of_its_polygon():
    """The worst facet of a sphere is off by c (d/2)² / 2 in the middle of a diagonal d."""
    lens = lens_of(net(), Sphere(8.0, 1e-3))
    sagitta = 1e-3 * ((20.0 / 16) ** 2 / 2) / 2
    assert chordal_error(lens_mesh(lens, 16), lens) == pytest.approx(sagitta, rel=1e-3)
    lens = lens_of(net(half=24.0), Plane(8.0), CIRCLE)
    polygon = 12.0 * (1 - np.cos(np.pi / 64))  # 16 cells: 64 sides
    assert chordal_error(lens_mesh(lens, 16), lens) == pytest.approx(polygon, rel=1e-9)


@OUTLINES
def test_stl_comes_back_closed(make_lens, tmp_path, outline):
    made = lens_mesh(make_lens(Sphere(8.0, 0.02), outline), 48)
    mesh.write_stl(made, tmp_path / "lens.stl")
    again = mesh.read_stl(tmp_path / "lens.stl")
    assert is_closed(again)
    assert (len(again.vertices), len(again.faces)) == (len(made.vertices), len(made.faces))
    volume = volume_and_area(made)[0]
    assert volume_and_area(again)[0] == pytest.approx(volume, rel=1e-7)  # float32
    other = trimesh.load_mesh(tmp_path / "lens.stl")
    assert other.is_watertight and other.volume == pytest.approx(volume, rel=1e-7)
    assert not (tmp_path / "lens.stl").read_bytes().startswith(b"solid")


BOX = trimesh.creation.box((2.0, 3.0, 4.0))
TWO = trimesh.util.concatenate(
    [BOX, trimesh.creation.box((1.0, 1.0, 1.0), trimesh.transformations.translation_matrix([9, 0, 0]))]
)


@pytest.mark.parametrize(
    ("faces", "closed"),
    [
        (BOX.faces, True),
        (TWO.faces, True),
        (BOX.faces[1:], False),
        (np.vstack([BOX.faces, BOX.faces[:1]]), False),
        (np.vstack([BOX.faces[1:], BOX.faces[:1, ::-1]]), False),
        (np.vstack([BOX.faces, BOX.faces]), False),
        (BOX.faces[:0], False),
    ],
    ids=["box", "two boxes", "a hole", "a triangle twice", "a triangle turned", "all twice", "nothing"],
)
def test_closed_is_each_edge_walked_once_each_way(faces, closed):
    made = Mesh(TWO.vertices, faces.astype(np.int32))
    assert is_closed(made) == closed
    if len(faces) and not (np.array_equal(faces[: len(BOX.faces)], faces[len(BOX.faces) :])):
        other = by_trimesh(made)
        assert closed == (other.is_watertight and other.is_winding_consistent)


def test_a_damaged_stl_is_refused(make_lens, tmp_path):
    path = tmp_path / "lens.stl"
    mesh.write_stl(lens_mesh(make_lens(m=9), 16), path)
    data = path.read_bytes()
    for damaged in (b"", data[:-1], data + b"x", data[:84]):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="not a complete binary STL"):
            mesh.read_stl(path)
    path.write_bytes(data[:100] + np.float32(np.nan).tobytes() + data[104:])
    with pytest.raises(ValueError, match="not finite"):
        mesh.read_stl(path)
    with pytest.raises(ValueError, match="cannot be read"):
        mesh.read_stl(tmp_path / "gone.stl")


def test_a_3mf_states_millimetres_the_mesh_a_name_and_a_colour_and_is_the_same_twice(make_lens, tmp_path, monkeypatch):
    made = lens_mesh(make_lens(), 16)
    label = mesh.Label('a "name" <1>', "Title & <b>", "N-BK7 'x'", remark="A remark.")
    mesh.write_3mf(made, tmp_path / "one.3mf", label)
    monkeypatch.setattr("time.time", lambda: 2e9)
    mesh.write_3mf(made, tmp_path / "two.3mf", label)
    assert (tmp_path / "one.3mf").read_bytes() == (tmp_path / "two.3mf").read_bytes()
    with zipfile.ZipFile(tmp_path / "one.3mf") as package:
        assert set(package.namelist()) == {"[Content_Types].xml", "_rels/.rels", "3D/3dmodel.model"}
        model = ElementTree.fromstring(package.read("3D/3dmodel.model"))
    core = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
    order = ["metadata", "metadata", "metadata", "resources", "build"]
    assert model.get("unit") == "millimeter" and [child.tag.removeprefix(core) for child in model] == order
    vertices = np.array([[float(entry.get(axis)) for axis in "xyz"] for entry in model.iter(f"{core}vertex")])
    faces = np.array([[int(entry.get(key)) for key in ("v1", "v2", "v3")] for entry in model.iter(f"{core}triangle")])
    assert np.abs(vertices - made.vertices).max() < 1e-8 and np.array_equal(faces, made.faces)
    said = {entry.get("name"): entry.text for entry in model.iter(f"{core}metadata")}
    assert said == {"Title": "Title & <b>", "Description": "A remark.", "Application": "bstcad"}
    [material], [thing], [item] = (list(model.iter(f"{core}{tag}")) for tag in ("basematerials", "object", "item"))
    assert material[0].attrib == {"name": "N-BK7 'x'", "displaycolor": mesh.CLEAR_RGBA}
    assert re.fullmatch("#[0-9A-F]{8}", mesh.CLEAR_RGBA) and re.fullmatch("#[0-9A-F]{8}", mesh.MIRROR_RGBA)
    assert (thing.get("name"), thing.get("pid"), thing.get("pindex")) == ('a "name" <1>', material.get("id"), "0")
    assert item.get("objectid") == thing.get("id") != material.get("id")
    again = trimesh.load(tmp_path / "one.3mf", force="mesh")
    assert again.is_watertight and again.volume == pytest.approx(volume_and_area(made)[0], rel=1e-9)


def test_corners_that_are_made_to_collide_are_welded_all_the_same(tmp_path):
    """A hash table may be attacked: of random corners those that ask for one 16th of its places, each twice."""
    corners = np.random.default_rng(0).random((400_000, 3), dtype=np.float32)
    factors = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0xD6E8FEB86659FD93], np.uint64)
    key = (corners.view(np.uint32) * factors).sum(axis=1, dtype=np.uint64)
    alike = corners[((key ^ (key >> np.uint64(32))) & np.uint64((1 << 16) - 1)) < 1 << 12]
    alike = np.repeat(alike[: len(alike) // 3 * 3], 2, axis=0)
    assert not len(mesh._weld(alike.view(np.uint32))[1])
    triangles = np.zeros(len(alike) // 3, mesh.STL_TRIANGLE)
    triangles["corners"] = alike.reshape(-1, 3, 3)
    path = tmp_path / "alike.stl"
    path.write_bytes(bytes(80) + len(triangles).to_bytes(4, "little") + triangles.tobytes())
    read = mesh.read_stl(path)
    assert len(read.vertices) == len(alike) // 2
    assert (read.vertices[read.faces.ravel()] == alike).all()


def test_vertices_in_single_precision_lie_on_the_steepest_of_faces():
    """Rounding moves a vertex by 2^-24 of a coordinate; along z, where the slope is 4, by five times that."""
    lens = Lens.between(Plane(-5.0), Sphere(0.0, -0.097), Circle(10.0), 1.5)
    radius, turn = np.random.default_rng(0).uniform(9.5, 10.0, 20_000), np.linspace(0, 2 * np.pi, 20_000)
    x, y = radius * np.cos(turn), radius * np.sin(turn)
    exact = np.stack([x, y, sag(lens.back, x, y)], axis=1)
    rounded = Mesh(exact.astype(np.float32).astype(float), np.zeros((0, 3), dtype=np.int32))
    assert mesh.vertex_error(rounded, lens) < VERTEX_ROUNDING * np.abs(exact).max()
    moved = Mesh(exact + [0.0, 0.0, 1e-4], rounded.faces)  # and a mesh that is off is seen
    assert 1e-5 < mesh.vertex_error(moved, lens) < 1e-4
