"""How far facets lie from a lens, at places that no routine of the mesh chose: random ones, on their edges too."""

import numpy as np

from bstcad.cad.mesh import UPRIGHT
from bstcad.optics.outlines import Circle
from bstcad.optics.surfaces import sag

SHARE = 200_000  # facets at a time


def deviation(mesh, lens, places, seed=0):
    """The largest distance (mm) along a facet's normal of `places` in all, four a facet at least, from face or wall."""
    rng, worst = np.random.default_rng(seed), 0.0
    for faces in np.array_split(mesh.faces, len(mesh.faces) // SHARE + 1):
        corners = mesh.vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        for k in range(max(4, places // len(mesh.faces))):
            shares = rng.exponential(size=(len(faces), 3))  # evenly over a triangle
            if k % 2:  # on one of its edges: on the rim it is a chord
                shares[np.arange(len(faces)), rng.integers(0, 3, len(faces))] = 0.0
            shares /= shares.sum(1, keepdims=True)
            x, y, z = np.einsum("ij,ijk->ki", shares, corners)
            worst = max(worst, float(_off(lens, x, y, z, normals[:, 2]).max()))
    return worst


def _off(lens, x, y, z, upwards):
    off = np.zeros_like(x)
    for which, face in ((upwards > UPRIGHT, lens.back), (upwards < -UPRIGHT, lens.front)):
        off[which] = np.abs(sag(face, x[which], y[which]) - z[which]) * np.abs(upwards[which])
    wall = np.abs(upwards) <= UPRIGHT
    if isinstance(lens.outline, Circle):
        off[wall] = np.abs(np.hypot(x[wall], y[wall]) - lens.outline.radius)
    else:
        a, b = lens.outline.half_extent
        off[wall] = np.minimum(np.abs(np.abs(x[wall]) - a), np.abs(np.abs(y[wall]) - b))
    return off
