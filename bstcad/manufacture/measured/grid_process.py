"""Read a height map in a child process, with limits of time and memory.

Other packages parse these files.  A damaged or hostile file can keep them busy, take all the memory, or end their
process.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from bstcad.manufacture.measured import point_grid
from bstcad.manufacture.measured.point_text import MeasuredPoints
from bstcad.runs import files, processes

MAX_READER_TIME = 300.0  # longest time (s) of the child; 20 million points of an X3P file take 25 s
MAX_READER_MEMORY = 8_000_000_000  # largest address space (bytes) of the child; these points take 3.6 GB
MODULE = "bstcad.manufacture.measured.grid_process"  # name of the module that the child runs
REFUSED = 2  # exit code for a file that is refused in a sentence; an error that is not caught gives 1
INPUT, OUTPUT = "map", "points.npz"  # names of the files of parent and child
COUNTS = ("without_data", "duplicates")  # numbers of MeasuredPoints
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # each further thread takes address space


def read_limited(data: bytes, name: str) -> MeasuredPoints:
    """Return the points of a height map as `point_grid.read_grid` does; raise ValueError at its limits, too."""
    with tempfile.TemporaryDirectory(prefix="bstcad-") as folder:
        (Path(folder) / INPUT).write_bytes(data)
        ended = processes.run([name, folder], MAX_READER_TIME, environment=ONE_THREAD, module=MODULE)
        if ended.code == 0:
            with np.load(Path(folder) / OUTPUT) as found:
                counts = {key: int(found[key]) for key in COUNTS}
                return MeasuredPoints(found["positions"], columns=str(found["columns"]), **counts)
    if ended.code == REFUSED:
        raise ValueError(ended.reason)
    if ended.seconds > MAX_READER_TIME:
        raise ValueError(f"was not read within {MAX_READER_TIME:g} s; {point_grid.EXPORT_HINT}")
    raise ValueError(f"ended the process that reads {name} files ({ended.reason}); {point_grid.EXPORT_HINT}")


def main() -> None:
    """Read the file of the folder in the second argument, of the format in the first one, and write its points."""
    processes.end_with_parent()
    processes.limit_memory(MAX_READER_MEMORY)
    name, folder = sys.argv[1], Path(sys.argv[2])
    try:
        found = point_grid.read_grid((folder / INPUT).read_bytes(), name)
    except (ValueError, MemoryError) as error:
        memory = f"needs more than {MAX_READER_MEMORY / 1e9:g} GB of memory; {point_grid.EXPORT_HINT}"
        reason = memory if isinstance(error, MemoryError) else files.one_line(error)
        print(f"\nbstcad: {reason}", file=sys.stderr)
        sys.exit(REFUSED)
    arrays = {key: np.asarray(getattr(found, key)) for key in ("positions", "columns", *COUNTS)}
    np.savez(folder / OUTPUT, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
