"""Light copies of a lens: a coarse solid, and a closed mesh in the units of its formats with the lens's own normals."""

import io
import xml.etree.ElementTree as ElementTree
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from bstcad.cad import mesh
from bstcad.cad.mesh import MIRROR_RGBA, Label, Mesh, chordal_error
from bstcad.cad.solid import coarse_copy, lens_solid
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Sphere, sag
from tests.cad.test_trimming import plate, waves
from tests.exact_volume import exact_volume

LENSES = [(Plane(8.0), Rectangle(24.0, 20.0)), (Sphere(8.0, -0.03), Circle(12.0))]


@pytest.mark.parametrize("front, outline", LENSES, ids=["plate", "round"])
def test_the_preview_is_the_lens_in_metres_with_y_up(make_lens, front, outline):
    lens = make_lens(front, outline, m=65)
    found = dict(mesh.preview_files(lens, Label("L 1", "<T> & Co", "PMMA", MIRROR_RGBA)))
    scene = trimesh.load(io.BytesIO(found["preview.glb"]), file_type="glb")
    [(name, solid)] = scene.geometry.items()
    assert name == "L 1" and 15_000 < len(solid.faces) <= mesh.PREVIEW_TRIANGLES
    assert len(found["preview.glb"]) < 1_000_000
    x, y, z = 1e3 * solid.vertices.T
    normal_x, normal_y, normal_z = solid.vertex_normals.T
    own, normals = np.stack([x, -z, y], 1), np.stack([normal_x, -normal_z, normal_y], 1)
    closed = solid.copy()
    closed.merge_vertices(merge_norm=True, merge_tex=True)
    assert closed.is_watertight and closed.volume == pytest.approx(1e-9 * exact_volume(lens), rel=1e-3)
    off = solid.metadata["off_mm"]
    assert chordal_error(Mesh(own, np.asarray(solid.faces, np.int32)), lens) == pytest.approx(off, rel=1e-3)
    back = normals[:, 2] > 0.5
    _, z_x, z_y = (p.numpy() for p in lens.back.sag_and_slope(*(torch.from_numpy(own[back, k].copy()) for k in (0, 1))))
    wanted = np.stack([-z_x, -z_y, np.ones_like(z_x)], 1) / np.sqrt(1 + z_x**2 + z_y**2)[:, None]
    assert np.abs(normals[back] - wanted).max() < 1e-3  # places in float32, on a rough back
    a, b, c = (own[solid.faces[:, corner]] for corner in range(3))
    assert np.einsum("ij,ij->i", normals[solid.faces].mean(1), np.cross(b - a, c - a)).min() > 0
    again = trimesh.load(io.BytesIO(found["preview.3mf"]), file_type="3mf", force="mesh")
    assert again.is_watertight and again.volume == pytest.approx(1e9 * closed.volume, rel=1e-4)
    with zipfile.ZipFile(io.BytesIO(found["preview.3mf"])) as package:
        model = ElementTree.fromstring(package.read("3D/3dmodel.model"))
    said = {entry.get("name"): entry.text for entry in model if entry.tag.endswith("metadata")}
    assert said["Title"] == "<T> & Co" and f"{off:.2g} mm" in said["Description"]
    assert dict(mesh.preview_files(lens, Label())) == dict(mesh.preview_files(lens, Label()))


@pytest.mark.parametrize("outline, half", [(Rectangle(10.0, 8.0), (5.0, 4.0)), (Circle(3.5), (4.0, 4.0))])
def test_a_coarse_copy_has_the_outline_and_front_and_nearly_the_back(outline, half):
    lens = replace(plate("convex"), outline=outline).with_back(waves(129, half=half))
    light = coarse_copy(lens, 33)
    assert light.back.m == 33 and lens_solid(light).isValid()
    assert not outline.is_round or light.back.x[1] == pytest.approx(3.5 + 4 * light.back.pitch[0])  # four more
    assert exact_volume(light) == pytest.approx(exact_volume(lens), rel=2e-3)
    x, y = np.random.default_rng(1).uniform(-2.4, 2.4, (2, 500))
    assert np.abs(sag(light.back, x, y) - sag(lens.back, x, y)).max() < 0.01
    assert coarse_copy(lens, 129).back.m == 129
