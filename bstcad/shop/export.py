"""Files of `bstcad export` and `[output] export`, by the names of their kinds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from bstcad.cad.mesh_files import UNNAMED, Label, preview_files
from bstcad.optics.lens import Lens
from bstcad.runs import files
from bstcad.scene.mount import Mount
from bstcad.shop import part_drawings, tables

FEWEST, MOST = 3, 4097  # points a side
SHEET = "datasheet"  # drawn by the caller, from the report beside the lens
ALL = ("sag", "points", "zemax", "turning", "dxf", "svg", "preview", SHEET)


def export(
    lens: Lens, kinds: Sequence[str], folder: Path, points: int | None = None, label: Label = UNNAMED,
    mount: Mount | None = None,
) -> list[Path]:  # fmt: skip
    """Write the files of these kinds, but SHEET, to the folder, each whole or not at all; their paths.

    points: along the wider side of grids, by default as many as the net of the back has; label: name of meshes and of a
    part; mount: drawings show the part that it makes; None: the lens's outline.
    ValueError names the kind or number that is not possible.
    """
    wanted = known(kinds)
    points = lens.back.m if points is None else points
    if not FEWEST <= points <= MOST:
        raise ValueError(f"{points} points a side are not possible; give {FEWEST} to {MOST}")
    lens, written = lens.plain(), []
    for kind in wanted:
        for name, data in _files(kind, lens, points, label=label, mount=mount):
            files.put(folder / name, data.encode("utf-8") if isinstance(data, str) else data)
            written.append(folder / name)
    return written


def _files(
    kind: str, lens: Lens, points: int, *, label: Label, mount: Mount | None
) -> Iterator[tuple[str, str | bytes]]:  # fmt: skip
    """(name, data) of each file of a kind."""
    match kind:
        case "sag":
            yield "sag.csv", tables.sag_table(lens, points)
        case "points":
            yield "points-front.csv", tables.points_table(lens, lens.front, points)
            yield "points-back.csv", tables.points_table(lens, lens.back, points)
        case "zemax":  # of a front that is no net prescription.txt has the numbers
            yield "zemax-back.dat", tables.zemax_grid(lens, lens.back, points)
            if lens.front.curvature is None:
                yield "zemax-front.dat", tables.zemax_grid(lens, lens.front, points)
        case "turning":
            yield "turning.csv", tables.turning_cloud(lens, (points + 1) // 2)
        case "dxf":
            yield "outline.dxf", part_drawings.dxf(lens.outline, mount, label)
        case "svg":
            yield "outline.svg", part_drawings.svg(lens.outline, mount, label)
        case "preview":
            yield from preview_files(lens, label)


def known(kinds: Sequence[str]) -> list[str]:
    """The kinds, each once; ValueError if one is none."""
    for name in kinds:
        if name not in ALL:
            raise ValueError(f"'{name}' is nothing that can be exported; give one of {', '.join(ALL)}")
    return list(dict.fromkeys(kinds))
