"""The solid, the mesh and the part of a lens whose front has an outline of its own: a dome in a flat underside."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
import torch
import trimesh

from bstcad.cad import mesh, solid_properties, step_reading, step_writing
from bstcad.cad.mounting import part_of
from bstcad.cad.solid import lens_solid, named_solid
from bstcad.optics.lens import face_integrals
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Conic, Recess, Sphere
from bstcad.scene.mount import CircleRim, Flange, Mount
from bstcad.verify import step_checks
from tests.lenses import half_over, net

RADIUS, EDGE = 12.0, 10.5
OUTLINES = {"round": Circle(25.0), "oblong": Rectangle(50.0, 30.0)}
FRONTS = {
    "dome": Recess(Sphere(12.0, -1 / RADIUS), Circle(EDGE)),
    "steep": Recess(Sphere(12.0, -1 / RADIUS), Circle(11.78)),
    "conic": Recess(Conic(12.0, -1 / RADIUS, -0.5), Circle(EDGE)),
    "bulge": Recess(Sphere(4.0, 0.05), Circle(EDGE)),
}


def lens(front="dome", outline="round"):
    a, b = half = half_over(OUTLINES[outline], 33)
    back = net(lambda x, y: -3 * ((x / a) ** 2 + (y / b) ** 2) + 0.2 * torch.sin(5 * x / a), 22.0, 33, half)
    return Lens.between(FRONTS[front], back, OUTLINES[outline], 1.5)


@pytest.mark.parametrize(("front", "outline"), [*((front, "round") for front in FRONTS), ("dome", "oblong")])
def test_the_step_file_holds_the_lens_exactly(front, outline, tmp_path):
    made, path = lens(front, outline), tmp_path / "lens.step"
    step_writing.write_lens(made, path, "lens")
    read = step_reading.read(path)
    assert (read.front.outline, read.outline) == (made.front.outline, made.outline) and read.edge is None
    assert read.clear == (made.front.outline, made.outline) == step_reading.lens(read, 1.5).apertures
    assert abs(read.front.around.z - made.front.around.z) < 1e-12
    checks = step_checks.check(path, made, 1e-6, 1000)
    assert len(checks) > 6 and [check.name for check in checks if not check.passed] == []
    by_faces, own = solid_properties.of_solid(read.shape), face_integrals.of_lens(made)
    assert by_faces.volume == pytest.approx(own.volume, rel=1e-9)
    assert by_faces.area == pytest.approx(own.area, rel=1e-8)
    np.testing.assert_allclose(by_faces.centroid, own.centroid, rtol=0, atol=1e-8)  # mm
    by_itself = step_checks.examine(path).checks
    assert [check.name for check in by_itself if not check.passed] == []


def test_its_volume_is_that_without_the_cap_of_a_sphere():
    made = lens()
    height = RADIUS - math.sqrt(RADIUS**2 - EDGE**2)
    flat = made.with_front(made.front.around)
    cap = math.pi * height**2 * (3 * RADIUS - height) / 3
    assert face_integrals.of_lens(flat).volume - face_integrals.of_lens(made).volume == pytest.approx(cap, rel=1e-11)
    assert named_solid(made).faces.count("underside") == 1


def test_a_front_of_another_outline_or_curvature_is_found(tmp_path):
    step_writing.write_lens(lens(), tmp_path / "lens.step", "lens")
    for other in (Recess(FRONTS["dome"].face, Circle(EDGE - 1e-3)), Recess(Sphere(12.0, -1 / 12.001), Circle(EDGE))):
        checks = step_checks.check(tmp_path / "lens.step", lens().with_front(other), 1e-6, 100)
        assert any(not check.passed for check in checks)


@pytest.mark.parametrize("front", FRONTS)
def test_the_mesh_is_closed_and_as_near_as_asked(front):
    made = lens(front)
    _, found = mesh.fit_mesh(made, 2e-3)
    volume, _ = mesh.volume_and_area(found)
    whole = face_integrals.of_lens(made)
    assert mesh.is_closed(found) and mesh.chordal_error(found, made) <= 2e-3
    assert abs(volume - whole.volume) < 2e-3 * whole.area
    assert mesh.vertex_error(found, made) < 1e-12
    assert len(mesh.lens_mesh(made, mesh.max_cells(made, 20_000)).faces) <= 20_000


def test_the_preview_of_a_dome_is_closed_and_shaded_by_its_own_normals():
    found = dict(mesh.preview_files(lens(), mesh.Label("dome")))
    [solid] = trimesh.load(io.BytesIO(found["preview.glb"]), file_type="glb").geometry.values()
    a, b, c = (solid.vertices[solid.faces[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    along = (solid.vertex_normals[solid.faces].mean(1) * across).sum(1) / np.linalg.norm(across, axis=1)
    assert along.min() > 0.9  # an edge between dome and plane that were shaded as one would turn them
    closed = solid.copy()
    closed.merge_vertices(merge_norm=True, merge_tex=True)
    assert closed.is_watertight and closed.volume == pytest.approx(
        1e-9 * face_integrals.of_lens(lens()).volume, rel=1e-3
    )


def test_wires_stay_in_the_plane_around_the_front():
    drilled = lens_solid(lens(), holes=[(18.0, 0.0, 3.0)])
    depth = face_integrals.of_lens(lens()).volume - solid_properties.of_solid(drilled).volume
    assert drilled.isValid() and 50 < depth < 120
    for hole in ((10.0, 0.0, 3.0), (0.0, 0.0, 3.0)):
        with pytest.raises(ValueError, match="a wire crosses the front, Ø21 mm, or lies inside it; move the wire"):
            lens_solid(lens(), holes=[hole])


@pytest.mark.parametrize("z", [None, 1.0, -1.0], ids=["flush", "higher", "lower"])
def test_a_flange_holds_it(z, tmp_path):
    """The flange's lower face lies in the plane of the underside, above it or below."""
    made = lens()
    level = made.front.around.z + (z or 0.0)
    flange = Flange(outline=CircleRim(shape="circle", diameter=60.0), z=level, thickness=2.5)
    part = part_of(made, Mount(flange=flange))
    assert part.solid.isValid()
    ring = math.pi * (30.0**2 - 25.0**2) * 2.5
    assert solid_properties.of_solid(part.solid).volume == pytest.approx(
        face_integrals.of_lens(made).volume + ring, rel=1e-8
    )
    step_writing.write(part.solid, tmp_path / "part.step", "part", faces=part.faces)
    read = step_reading.read(tmp_path / "part.step")
    assert read.front.outline == made.front.outline and read.clear == (made.front.outline, made.outline)
