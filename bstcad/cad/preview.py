"""Light copies of a lens to look at: a solid of a coarse net for viewers, and a mesh of few triangles as files.

Viewers turn every face into triangles before they show it, which takes long with 513 x 513 control points; web pages
(glTF) and slicers (3MF) cannot show a million triangles.  The mesh has the surface's own normals, which shade it as
finely as the lens.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from bstcad.cad.mesh import UPRIGHT, Mesh, chordal_error, finest, lens_mesh, sampled
from bstcad.cad.mesh_files import Label, write_3mf
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle
from bstcad.optics.surfaces import Surface, sag

SPARE = 4  # control points a side beyond the rim of a round lens: two spans, and two more until x(u) is linear
MOST = 20_000  # triangles
METRE = 1e-3  # of a mm: the unit of glTF, whose y points up


def coarse_copy(lens: Lens, m: int) -> Lens:
    """The lens with a back of m x m control points, each as high as the back itself at its (x, y).

    This follows relief wider than a few cells of the coarse net, and smooths the rest (de Boor 1978, Schoenberg's
    operator); the copy does not steer light as the lens does.
    """
    lens = lens.plain()
    if m >= lens.back.m:
        return lens
    stretch = (m - 1) / (m - 1 - 2 * SPARE) if isinstance(lens.outline, Circle) else 1.0
    ends = [stretch * half for half in lens.outline.half_extent]
    spans = zip(ends, (lens.back.x, lens.back.y), strict=True)
    x, y = np.meshgrid(*(np.clip(np.linspace(-end, end, m), *span) for end, span in spans), indexing="ij")
    heights = torch.from_numpy(sag(lens.back, x, y) - lens.back.z)
    return replace(lens, back=BSplineSurface(lens.back.z, heights, *((-end, end) for end in ends)))


def preview(lens: Lens) -> tuple[Mesh, float]:
    """The finest mesh of MOST triangles, and how far its facets lie from the lens (mm)."""
    mesh = lens_mesh(lens, finest(lens, MOST))
    return mesh, chordal_error(mesh, lens)


def files_of(lens: Lens, label: Label) -> Iterator[tuple[str, bytes]]:
    """preview.glb and preview.3mf, both of which state their chordal error."""
    mesh, off = preview(lens)
    label = replace(label, remark=f"A preview: its facets lie within {off:.2g} mm of the lens; lens.step is exact.")
    yield "preview.glb", glb(mesh, lens, label, off)
    package = io.BytesIO()
    write_3mf(mesh, package, label)
    yield "preview.3mf", package.getvalue()


def glb(mesh: Mesh, lens: Lens, label: Label, off: float) -> bytes:
    """The mesh as binary glTF, in metres, the back up; off: its chordal error (mm), which its extras state.

    At an edge of the lens each vertex stands twice, with the normals of both faces.
    """
    import trimesh  # most of a second to load
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    vertices, normals, faces, count = [], [], [], 0
    for part, directions in _patches(mesh, lens):
        used, renumbered = np.unique(part, return_inverse=True)
        vertices.append(mesh.vertices[used])
        normals.append(directions(vertices[-1]))
        faces.append(renumbered.reshape(-1, 3) + count)
        count += len(used)
    red, green, blue, opacity = (int(label.colour[k : k + 2], 16) for k in (1, 3, 5, 7))
    linear = [(part / 255) ** 2.2 for part in (red, green, blue)]
    clear = {"alphaMode": "BLEND"} if opacity < 255 else {"metallicFactor": 1.0}
    material = PBRMaterial(
        name=label.material, baseColorFactor=[*linear, opacity / 255],
        **({"metallicFactor": 0.0, "roughnessFactor": 0.1} | clear),
    )  # fmt: skip
    solid = trimesh.Trimesh(
        METRE * _y_up(np.concatenate(vertices)), np.concatenate(faces), vertex_normals=_y_up(np.concatenate(normals)),
        visual=TextureVisuals(material=material), process=False, validate=False,
        metadata={"title": label.title, "remark": label.remark, "off_mm": off},
    )  # fmt: skip
    scene = trimesh.Scene()
    scene.add_geometry(solid, geom_name=label.name, node_name=label.name)
    return scene.export(file_type="glb", include_normals=True)


def _patches(mesh: Mesh, lens: Lens) -> Iterator[tuple]:
    """The triangles of each smooth piece of the lens, and its normals, out of the lens, at points (n, 3)."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    across /= np.linalg.norm(across, axis=1)[:, None]
    up, down = across[:, 2] > UPRIGHT, across[:, 2] < -UPRIGHT
    yield mesh.faces[up], lambda points: _upwards(lens.back, points)
    yield mesh.faces[down], lambda points: -_upwards(lens.front, points)
    wall, sides = mesh.faces[~(up | down)], across[~(up | down)]
    if isinstance(lens.outline, Circle):
        yield wall, lambda points: points * [1, 1, 0] / lens.outline.radius
        return
    for side in ([1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]):
        yield wall[sides @ side > 0.5], lambda points, side=side: np.tile(side, (len(points), 1))


def _upwards(surface: Surface, points: np.ndarray) -> np.ndarray:
    """Unit normals of a face towards +z."""
    _, z_x, z_y = sampled(surface, points[:, 0], points[:, 1])
    normals = np.stack([-z_x, -z_y, np.ones_like(z_x)], axis=1)
    return normals / np.linalg.norm(normals, axis=1)[:, None]


def _y_up(vectors: np.ndarray) -> np.ndarray:
    x, y, z = vectors.T
    return np.stack([x, z, -y], axis=1)
