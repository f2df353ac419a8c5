"""What `bstcad export` and `[output] export` write, each by its name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from bstcad import files
from bstcad.cad import preview
from bstcad.cad.mesh_files import UNNAMED, Label
from bstcad.optics.lens import Lens
from bstcad.scene.mount import Mount
from bstcad.shop import outline_drawings, part_drawings, tables

FEWEST, MOST = 3, 4097  # points a side

PREVIEW = "preview"  # light meshes, which have a name
SHEET = "datasheet"  # which every design's folder has: of more than a lens, and so the caller's to draw again

# Name of a kind -> its files, (name, text) each, of a lens and so many points a side.
Kind = Callable[[Lens, int], Iterator[tuple[str, str]]]


def _sag(lens: Lens, points: int) -> Iterator[tuple[str, str]]:
    yield "sag.csv", tables.sag_table(lens, points)


def _points(lens: Lens, points: int) -> Iterator[tuple[str, str]]:
    yield "points-front.csv", tables.points_table(lens, lens.front, points)
    yield "points-back.csv", tables.points_table(lens, lens.back, points)


def _zemax(lens: Lens, points: int) -> Iterator[tuple[str, str]]:
    """The back; a freeform front too.  Of any other front prescription.txt has the numbers."""
    yield "zemax-back.dat", tables.zemax_grid(lens, lens.back, points)
    if lens.front.curvature is None:
        yield "zemax-front.dat", tables.zemax_grid(lens, lens.front, points)


def _turning(lens: Lens, points: int) -> Iterator[tuple[str, str]]:
    yield "turning.csv", tables.turning_cloud(lens, (points + 1) // 2)


KINDS: dict[str, Kind] = {"sag": _sag, "points": _points, "zemax": _zemax, "turning": _turning}
# Name of a drawing -> how the outline of a lens is drawn, and how the part that a mount makes of it.
DRAWINGS = {
    "dxf": (outline_drawings.dxf, part_drawings.dxf),
    "svg": (outline_drawings.svg, part_drawings.svg),
}
ALL = (*KINDS, *DRAWINGS, PREVIEW, SHEET)


def export(
    lens: Lens, kinds: Sequence[str], folder: Path, points: int | None = None, label: Label = UNNAMED,
    mount: Mount | None = None,
) -> list[Path]:  # fmt: skip
    """Write the files of these kinds, but SHEET, to the folder, each whole or not at all; their paths.

    points: along the wider side of grids, by default as many as the net of the back has; label: what a mesh, or a part,
    is called; mount: how the lens is held, so that drawings are of the part; None: they are of its outline.
    ValueError says which kind or number is not possible.
    """
    wanted = known(kinds)
    points = lens.back.m if points is None else points
    if not FEWEST <= points <= MOST:
        raise ValueError(f"{points} points a side are not possible; give {FEWEST} to {MOST}")
    lens, written = lens.plain(), []
    for kind in wanted:
        for name, data in _files(kind, lens, points, label, mount):
            files.put(folder / name, data.encode("utf-8") if isinstance(data, str) else data)
            written.append(folder / name)
    return written


def _files(kind: str, lens: Lens, points: int, label: Label, mount: Mount | None) -> Iterable[tuple[str, str | bytes]]:
    """(name, data) of each file of a kind."""
    if kind in KINDS:
        return KINDS[kind](lens, points)
    if kind in DRAWINGS:
        plain, of_part = DRAWINGS[kind]
        return [(f"outline.{kind}", plain(lens.outline) if mount is None else of_part(lens.outline, mount, label))]
    return preview.files_of(lens, label) if kind == PREVIEW else ()


def known(kinds: Sequence[str]) -> list[str]:
    """The kinds, each once; ValueError if one is none."""
    for name in kinds:
        if name not in ALL:
            raise ValueError(f"'{name}' is nothing that can be exported; give one of {', '.join(ALL)}")
    return list(dict.fromkeys(kinds))
