"""Tiles of a lens: exact solids, whose faces are those of the lens between planes parallel to its axis.

A tile has the control points of the lens that act over it, to the last bit, so that its file is as small as the tile.
Each joint is a plane wall, whose edges are built as those of a cut lens (cad.solid): no boolean operation is used.  All
tiles are in the frame of the lens, so that they form the plate when they are read together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from OCP.TopoDS import TopoDS_Solid

from bstcad.cad import patches, solid_properties, step_writing, walls, wires
from bstcad.cad.patches import FacePatch
from bstcad.cad.solid import cap, prepared
from bstcad.cad.tiling import Cell, Side, Tiling
from bstcad.cad.wires import LoopPiece
from bstcad.optics.lens.face_integrals import MassProperties
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK, FRONT
from bstcad.optics.surfaces.bspline import is_net
from bstcad.optics.surfaces.surfaces import Surface
from bstcad.scene.mount import Part

INVALID_TILE = "{}: its faces and walls do not bound a valid solid; give another number of tiles"


@dataclass(frozen=True)
class Tile:
    """A tile of a lens as a solid in the frame of the lens."""

    cell: Cell
    solid: TopoDS_Solid
    faces: tuple[str, ...]  # names of the faces: the back, the front, then "rim" or "joint" for each wall
    properties: MassProperties | None  # area, volume and centroid; None: a face is of a kind that is not integrated

    def step(self, name: str, part: Part) -> bytes:
        """Return the STEP file of the tile of a lens called `name`, as one product, with its area and volume."""
        product = f"{name}, {self.cell.name}"
        return b"".join(step_writing.encode(self.solid, product, part, faces=self.faces, properties=self.properties))


def tiles_of(lens: Lens, tiling: Tiling) -> Iterator[Tile]:
    """Yield the tiles of a lens, row by row.

    ValueError in one sentence if the lens is a dome, if its front has an outline of its own, or if a tile is a sliver.
    """
    if not lens.back.chart.flat:
        raise ValueError("tiles: the back of a dome is not cut into tiles; use lens.step")
    if lens.front.outline is not None:
        raise ValueError("tiles: the front ends in an outline of its own and is not cut into tiles; use lens.step")
    lens = prepared(lens)
    for cell in tiling.cells(lens.outline):
        solid, names = tile_shape(lens, cell)
        yield Tile(cell, solid, names, solid_properties.of_solid(solid))


def tile_shape(lens: Lens, cell: Cell) -> tuple[TopoDS_Solid, tuple[str, ...]]:
    """Return the solid of one tile of a prepared lens and the names of its faces."""
    loop = [_piece(side) for side in cell.sides]
    top, low = walls.rail_on(lens.back, loop), walls.rail_on(lens.front, loop)
    built = [face for face, _ in walls.upright_walls(loop, low, top)]
    names = ["joint" if side.joint else "rim" for side in cell.sides]
    back = cap(_patch(lens, lens.back, cell), [top], along=True)
    front = cap(_patch(lens, lens.front, cell), [low], along=False)
    return walls.solid_of([back, front, *built], INVALID_TILE.format(cell.name)), (BACK, FRONT, *names)


def _patch(lens: Lens, face: Surface, cell: Cell) -> FacePatch:
    if is_net(face):
        return patches.part_of_net(face, *cell.extent, outward=face is lens.back)
    return patches.front_patch(lens)


def _piece(side: Side) -> LoopPiece:
    if side.radius is None:
        return wires.line(side.start, side.end)
    start, span = side.angles
    return wires.arc((0.0, 0.0), side.radius, start, span=span)
