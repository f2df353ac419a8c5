"""4. Solids of 513 x 513 control points with steep slopes and a thin edge.

Other exporters sew and fit: edges that are used once, meshes with holes at some deflections, volumes that change from
reader to reader (build123d #1356, OCCT #1348, build123d-mcp #284, #290).  Here each edge is built once and shared, the
net is written as it is, and the mesh shares the nodes of its rim.  From the written files: the solid is valid, a parser
that is not OCC finds the same net, each edge is used twice, our mesh and OCC's own are closed at each deflection, and
the volumes of the exact integral, of OCC and of both meshes agree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import cadquery
import numpy as np
import pytest
import torch
import trimesh
from OCP.BRepMesh import BRepMesh_IncrementalMesh
from OCP.BRepTools import BRepTools
from OCP.StlAPI import StlAPI_Writer

from bstcad.analysis.shape import describe
from bstcad.cad import mesh as meshes
from bstcad.cad import step_reading, step_writing
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import BSplineSurface, knots
from bstcad.optics.surfaces.outlines import Circle, Outline, Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.scene.scene import MESH_TOLERANCE
from bstcad.step_text import part21
from bstcad.verify import checks, step_checks
from tests import suite
from tests.exact_volume import exact_volume

SLOPE, EDGE = 64.0, 0.05  # degrees, before the ripple; mm


def steep(outline: Outline, front: Plane | Sphere, m: int, dtype: torch.dtype) -> Lens:
    """A hill of cosines with a ripple on it, so high that only its rim comes down to the front, as near as EDGE."""
    half = outline.half_extent
    reach = [h * (m - 1) / (m - 5) for h in half] if isinstance(outline, Circle) else half
    x, y = (torch.linspace(-r, r, m, dtype=torch.float64) / h for r, h in zip(reach, half, strict=True))
    height = 1.5 * half[0] / math.pi * math.tan(math.radians(SLOPE))
    h = height / 2 * (torch.cos(math.pi * x)[:, None] + torch.cos(math.pi * y))
    h = h + 0.05 * torch.sin(27 * x)[:, None] * torch.cos(24 * y)
    back = BSplineSurface(30.0, h.to(dtype), (-reach[0], reach[0]), (-reach[1], reach[1]))
    lens = Lens.between(front, back, outline, 1.49)
    thick = describe(lens.with_back(back.to(torch.float64)))["thickness_min"]
    return lens.with_back(replace(back, z=back.z - (thick - EDGE)))


LENSES = {
    "513, rectangle, sphere": (Rectangle(24.0, 20.0), Sphere(5.0, 0.01), 513, torch.float64),
    "129, circle, sphere": (Circle(12.0), Sphere(5.0, -0.02), 129, torch.float64),
    "65, rectangle, plane, float32": (Rectangle(24.0, 20.0), Plane(5.0), 65, torch.float32),
}


@dataclass(frozen=True)
class Written:
    """A lens and its file."""

    lens: Lens
    path: Path
    reread: step_reading.StepLens
    volume: float  # mm³, the exact integral
    area: float  # mm², of all faces


@pytest.fixture(scope="module", params=suite.in_turns(LENSES, 3))
def written(request, tmp_path_factory) -> Written:
    lens = steep(*LENSES[request.param])
    path = tmp_path_factory.mktemp("steep") / "lens.step"
    step_writing.write_lens(lens, path, "steep")
    area = meshes.volume_and_area(meshes.lens_mesh(lens, 64))[1]
    return Written(lens, path, step_reading.read(path), exact_volume(lens), area)


def test_it_is_as_steep_and_as_thin_as_the_case_asks(written):
    shape = describe(written.lens.with_back(written.lens.back.to(torch.float64)))
    assert 60 < shape["slope_max_deg"] < 72
    assert shape["thickness_min"] == pytest.approx(EDGE, abs=1e-6)  # z0 is a float64, heights may be float32
    assert shape["edge_thickness_min"] < 2 * EDGE and shape["thickness_max"] > 10


def test_the_solid_is_valid_and_its_face_is_the_designed_one(holds, written):
    """Sixteen digits are written; OCC's own evaluation of a spline is good to some 1e-15 of 30 mm."""
    lens = written.lens.with_back(written.lens.back.to(torch.float64))
    found = {check.id: check for check in step_checks.check(written.path, lens, 1e-9, 1 << 14)}
    assert all(check.passed for check in found.values()), found
    holds("distance of the back in the file from the designed back", found["form"].value, 1e-9, "mm")
    holds("angle between the normals of these two backs", found["normals"].value, 1e-9, "rad")
    holds("largest gap at an edge", found["gaps"].value, 5e-7, "mm")


def test_a_parser_that_is_not_occ_finds_the_same_net_and_each_edge_twice(holds, written):
    text, m = part21.read(written.path), written.lens.back.m
    off = np.abs(text.surface.control_points - written.lens.back.control_points()).max()
    holds("distance of the control points in the text of the file from the designed ones", float(off), 1e-11, "mm")
    assert np.abs(written.reread.control_points - text.surface.control_points).max() <= 1e-11
    assert all(np.array_equal(full, knots(m)) for full in text.surface.full_knots)
    edges = 12 if isinstance(written.lens.outline, Rectangle) else 6
    assert len(text.edge_uses) == edges and set(text.edge_uses.values()) == {(1, 1)} and text.closed
    assert (text.solids, text.unit) == (1, "millimetre")


def test_occ_finds_the_volume(holds, written):
    """OCC's adaptive integral is asked for 1e-5.

    Over a trimmed round face that is good to 5e-4 only, whatever is asked; there OCC's mesh is the judge.
    """
    if isinstance(written.lens.outline, Rectangle):
        volume = cadquery.Solid(written.reread.shape).Volume(1e-5)
        holds("error of the volume by OCC's integral", abs(volume / written.volume - 1), 1e-5, "of it")


@pytest.mark.parametrize("cells", (64, 256, None))
def test_our_mesh_is_closed_at_each_deflection(holds, written, tmp_path, cells):
    """None: as output.mesh_tolerance asks by default.  The volume is off by area times deflection at most."""
    asked = cells or meshes.fit_mesh(written.lens, MESH_TOLERANCE)[0]
    meshes.write_stl(meshes.lens_mesh(written.lens, asked), tmp_path / "lens.stl")
    found = meshes.read_stl(tmp_path / "lens.stl")
    assert meshes.is_closed(found) and len(found.faces) > 0
    corners = found.vertices[found.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert area.min() > 0  # no facet of the thin side has collapsed in float32
    size = float(np.abs(found.vertices).max())
    vertices_off = meshes.vertex_error(found, written.lens)
    holds("STL: distance of vertices from the faces, relative to the size", vertices_off / size, checks.VERTEX_ROUNDING)
    deflection = meshes.chordal_error(found, written.lens)
    off = abs(meshes.volume_and_area(found)[0] / written.volume - 1)
    of = f"of {cells} cells per side" if cells else "by default"
    holds(f"STL {of}: error of the volume", off, deflection * written.area / written.volume, "of it")
    if cells is None and asked < meshes.max_cells(written.lens):
        holds("STL by default: chordal error", deflection, MESH_TOLERANCE, "mm")
    if cells == 64:
        other = trimesh.load_mesh(tmp_path / "lens.stl")
        assert other.is_watertight and other.is_winding_consistent and other.body_count == 1


@pytest.mark.parametrize("deflection", (0.3, 0.02))
def test_occ_meshes_the_solid_closed_at_each_deflection(holds, written, tmp_path, deflection):
    """The mesh is made from the file, as a CAD program would make it."""
    shape = written.reread.shape
    BRepTools.Clean_s(shape)
    BRepMesh_IncrementalMesh(shape, deflection, False, 0.5, True)  # mm, not relative; rad; in threads
    writer = StlAPI_Writer()
    writer.ASCIIMode = False
    assert writer.Write(shape, str(tmp_path / "occ.stl"))
    found = meshes.read_stl(tmp_path / "occ.stl")
    assert meshes.is_closed(found)
    off = abs(meshes.volume_and_area(found)[0] / written.volume - 1)
    bound = deflection * written.area / written.volume
    holds(f"OCC's mesh with a chordal error of at most {deflection:g} mm: error of the volume", off, bound, "of it")
