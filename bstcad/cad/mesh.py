"""A closed triangle mesh of a lens on our own structured grid, for STL and 3MF.

Every vertex lies on the lens; the faces share the nodes of the rim, so the mesh is closed by construction.  The grid is
as fine as the tolerance asks for, as measured: the chordal error falls with the square of the node spacing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from bstcad.cad.mesh_measures import chordal_error
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Outline
from bstcad.optics.surfaces import Surface, sag

if TYPE_CHECKING:
    import trimesh

COARSEST = 16  # cells each way
MOST = 2_000_000  # triangles of a mesh of ours: 100 MB of STL
ASKED = 32_000_000  # of one whose tolerance a scene states: 1.6 GB
GOAL = 0.95  # of the tolerance at most, which float32 shall not take a vertex over
SINGLE = 2.0**-24  # of a coordinate: what float32 rounds it by
MORE = 1.1  # times as many cells as may be: the estimate of how many are needed is no better than that


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, wound counterclockwise seen from outside."""

    vertices: np.ndarray  # (n, 3) float64, mm
    faces: np.ndarray  # (k, 3) int32, the vertices of each triangle

    @property
    def trimesh(self) -> trimesh.Trimesh:
        """The same for scripts: sections, viewers, other formats."""
        import trimesh  # most of a second to load, which a design need not pay

        return trimesh.Trimesh(self.vertices, self.faces, process=False)


def lens_mesh(lens: Lens, cells: int) -> Mesh:
    """The lens as a closed mesh, wound counterclockwise from outside; mm.

    `cells` is the number of grid cells each way (even); see `fitting`.
    """
    if cells < 2 or cells % 2:
        raise ValueError(f"mesh: {cells} cells each way; give an even number of at least 2")
    x, y = nodes(lens.outline, cells)
    grid = np.arange(x.size, dtype=np.int32).reshape(x.shape)
    border, z = rim(grid), sag(lens.back, x, y)
    back = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    if _flat(lens):  # one fan of triangles covers a plane
        front = np.vstack([back[border], [0.0, 0.0, 0.0]])
        front[:, 2] = lens.front.z
        front_rim = x.size + np.arange(len(border))
        front_faces = _fan(front_rim, front_rim[-1] + 1)
    else:
        low = sag(lens.front, x, y)
        front = np.stack([x, y, low], axis=-1).reshape(-1, 3)
        front_rim = border + x.size
        front_faces = _triangles(grid + x.size, _rising(lens.outline, lens.front, x, y, low))[:, ::-1]
    back_faces = _triangles(grid, _rising(lens.outline, lens.back, x, y, z))
    triangles = np.concatenate([back_faces, front_faces, _wall(front_rim, border)])
    return Mesh(np.concatenate([back, front]), triangles.astype(np.int32, copy=False))


def nodes(outline: Outline, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """x and y (mm) of a square grid of nodes, (cells + 1, cells + 1), whose rim lies on the outline.

    On a disc, squares around the centre become circles (Shirley and Chiu 1997): with |a| >= |b| the node (a, b) goes to
    the radius a and the angle pi/4 b/a, else to the radius b and the angle pi/2 - pi/4 a/b.
    """
    unit = np.linspace(-1.0, 1.0, cells + 1)
    if not isinstance(outline, Circle):
        half_x, half_y = outline.half_extent
        x, y = np.meshgrid(half_x * unit, half_y * unit, indexing="ij")
        return x, y
    a, b = np.meshgrid(unit, unit, indexing="ij")
    wide = np.abs(a) >= np.abs(b)
    major, minor = np.where(wide, a, b), np.where(wide, b, a)
    turn = np.pi / 4 * minor / np.where(major == 0, 1.0, major)
    angle = np.where(wide, turn, np.pi / 2 - turn)
    return outline.radius * major * np.cos(angle), outline.radius * major * np.sin(angle)


def sampled(surface: Surface, x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    """z (mm), ∂z/∂x and ∂z/∂y of a face at points (mm)."""
    found = surface.plain().sag_and_slope(*(torch.from_numpy(np.ravel(p).copy()) for p in (x, y)))
    return [np.broadcast_to(part.numpy(), x.size).reshape(x.shape) for part in found]


def _triangles(grid: np.ndarray, rising: np.ndarray) -> np.ndarray:
    """Two triangles a cell (2 n², 3), counterclockwise, cut along the diagonal that rises, or else the other."""
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    rising = rising[..., None]
    first = np.where(rising, np.stack([a, b, c], axis=-1), np.stack([a, b, d], axis=-1))
    second = np.where(rising, np.stack([a, c, d], axis=-1), np.stack([b, c, d], axis=-1))
    return np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)])


def _rising(outline: Outline, surface: Surface, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(n, n) True for cells that are cut from their first corner to the opposite one: what lies nearer to the face.

    A diagonal along a ridge is off by half as much as one over it, or less, so that fewer triangles
    do.  On a disc, cells on the diagonals of the grid are cut towards its middle: their outer corners lie on a circle,
    and the other cut would leave triangles that are flat.
    """
    inwards = np.arange(len(x) - 1) < (len(x) - 1) / 2
    inwards = inwards[:, None] == inwards[None, :]
    if surface.level:
        return inwards
    (a, b, c, d), (e, f, g, h), (p, q, r, s) = ((v[:-1, :-1], v[1:, :-1], v[1:, 1:], v[:-1, 1:]) for v in (x, y, z))
    along = np.abs(sag(surface, (a + c) / 2, (e + g) / 2) - (p + r) / 2)
    across = np.abs(sag(surface, (b + d) / 2, (f + h) / 2) - (q + s) / 2)
    if not isinstance(outline, Circle):
        return along <= across
    k = np.arange(len(x) - 1)
    diagonal = (k[:, None] == k) | (k[:, None] == k[::-1])
    return np.where(diagonal, inwards, along <= across)


def rim(grid: np.ndarray) -> np.ndarray:
    """The border nodes of the grid, once around, counterclockwise from its first corner."""
    return np.concatenate([grid[:-1, 0], grid[-1, :-1], grid[:0:-1, -1], grid[0, :0:-1]])


def _fan(rim: np.ndarray, centre: int) -> np.ndarray:
    """Triangles from the rim to one node inside it, facing -z."""
    return np.stack([np.full_like(rim, centre), np.roll(rim, -1), rim], axis=1)


def _wall(front: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Two triangles between each pair of neighbours on the front's and the back's rim, facing outwards."""
    front_next, back_next = np.roll(front, -1), np.roll(back, -1)
    return np.concatenate(
        [np.stack([front, front_next, back_next], axis=1), np.stack([front, back_next, back], axis=1)]
    )


def fitting(lens: Lens, tolerance: float, most: int | None = None) -> tuple[int, Mesh]:
    """The fewest cells each way, or nearly, whose facets lie within `tolerance` (mm) of the lens, and that mesh.

    most: triangles (default MOST).  Where so many do not do, the finest mesh of MOST, or of `most` if that is less.
    """
    allowed = MOST if most is None else most
    cells, last, goal = COARSEST, finest(lens, allowed), aimed(lens, tolerance)
    while cells < last or (cells == last and allowed > MOST):
        mesh = lens_mesh(lens, cells)
        error = chordal_error(mesh, lens)
        if error <= goal:
            return cells, mesh
        # it falls with the square of the spacing, and more slowly while a cell is larger than what it has to follow
        needed = 2 * math.ceil(0.505 * cells * (error / goal) ** 0.5)
        if cells == last or (allowed > MOST and needed > MORE * last):
            break
        cells = min(last, needed)
    last = finest(lens, min(allowed, MOST))
    return last, lens_mesh(lens, last)


def aimed(lens: Lens, tolerance: float) -> float:
    """What facets are held to (mm) so that, once float32 has rounded their corners, they keep the tolerance."""
    return max(0.1 * tolerance, min(GOAL * tolerance, tolerance - 2 * SINGLE * reach(lens)))


def reach(lens: Lens) -> float:
    """The largest coordinate of a place on the lens, or nearly (mm)."""
    ends = [abs(face.z + height) for face in (lens.front, lens.back) for height in face.sags(lens.outline)]
    return max(*lens.outline.half_extent, *ends)


def finest(lens: Lens, most: int | None = None) -> int:
    """Cells each way of the finest grid of so many triangles (default MOST), two a cell on a face that is not plane."""
    faces, most = 2 if _flat(lens) else 4, MOST if most is None else most
    wall = 12  # triangles a cell of the grid's side: four rows of two along the wall, four of a fan over a plane front
    return int((math.sqrt(wall**2 + 4 * faces * most) - wall) / (2 * faces)) // 2 * 2


def mesh_volume(lens: Lens, cells: int) -> float:
    """Volume (mm³) of the mesh of so many cells each way, without building it: prisms under each triangle."""
    x, y = nodes(lens.outline, cells)
    grid, volume = np.arange(x.size).reshape(x.shape), 0.0
    for surface, sense in ((lens.back, 1), (lens.front, -1)):
        z = sag(surface, x, y)
        a, b, c = _triangles(grid, _rising(lens.outline, surface, x, y, z)).T
        flat_x, flat_y, z = x.ravel(), y.ravel(), z.ravel()
        area = (flat_x[b] - flat_x[a]) * (flat_y[c] - flat_y[a]) - (flat_x[c] - flat_x[a]) * (flat_y[b] - flat_y[a])
        volume += sense * float(area @ (z[a] + z[b] + z[c])) / 6
    return volume


def _flat(lens: Lens) -> bool:
    """Is the front plane inside the outline?"""
    return lens.front.sags(lens.outline) == (0.0, 0.0)
