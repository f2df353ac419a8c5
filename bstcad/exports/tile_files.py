"""Files of the tiles of a plate: a STEP file for each tile, a table of their places, and sentences for the maker."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bstcad.cad.tiling import Cell, Tiling
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Outline
from bstcad.scene.mount import Part

PLACES = "file,x_min_mm,x_max_mm,y_min_mm,y_max_mm,area_mm2,volume_mm3,centroid_x_mm,centroid_y_mm,centroid_z_mm"


def tile_files(lens: Lens, tiling: Tiling, name: str, part: Part) -> Iterator[tuple[str, str | bytes]]:
    """Yield (name, content) of the files of the tiles of a lens; name: of the lens; part: data that STEP files state.

    ValueError in one sentence if the lens cannot be cut into these tiles.
    """
    from bstcad.cad.tiles import tiles_of  # loaded late, since it loads OpenCASCADE

    rows = [PLACES]
    for tile in tiles_of(lens, tiling):
        yield f"{tile.cell.name}.step", tile.step(name, part)
        values = [*(end for span in tile.cell.extent for end in span), tile.cell.area]
        if tile.properties is not None:
            values += [tile.properties.volume, *tile.properties.centroid]
        rows.append(",".join([f"{tile.cell.name}.step", *(f"{value:.12g}" for value in values)]))
    yield "tiles.csv", "\n".join(rows) + "\n"
    yield "tiles.txt", tile_words(name, tiling, lens.outline, len(rows) - 1) + "\n"


def tile_words(name: str, tiling: Tiling, outline: Outline, count: int) -> str:
    """Return sentences on the places and the frame of the tiles, with the sizes of the grid (mm)."""
    width, height = (2 * half / k for half, k in zip(outline.half_extent, (tiling.columns, tiling.rows), strict=True))
    return (
        f"{name}, {outline.words}: {count} tiles of at most {width:.6g} x {height:.6g} mm, {tiling.columns} along x "
        f"and {tiling.rows} along y. Seen from the back, with x to the right and y up, tile-1-1 is at the lower left; "
        "the first number counts along x, the second along y (tiles.svg, tiles.csv). All tiles are in the frame of "
        "lens.step: read together, they are the plate. The joints are planes parallel to the axis, without a gap."
    )


def joints(cells: Sequence[Cell]) -> list[tuple[float, float, float, float]]:
    """Return x and y of both ends of each joint (mm), each joint once."""
    found = {
        (*side.start, *side.end) if side.start < side.end else (*side.end, *side.start)
        for cell in cells
        for side in cell.sides
        if side.joint
    }
    return sorted(found)
