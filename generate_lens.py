"""From a scene file to a lens: python generate_lens.py templates/thu.toml (takes what `bstcad generate` takes).

The same in Python is `generate_lens` below: a start for scripts of your own.
"""

import sys

import bstcad
from bstcad.cli import main


def generate_lens(scene, folder, **changes):
    """The lens for a scene file, written to a folder; changes by dotted key: **{"target.text": "HI"}."""
    design = bstcad.design(bstcad.load(scene).changed(changes))  # the transport map, then both stages of tailoring
    report = design.write(folder)  # STEP, STL, 3MF and the report, which is proved from the files
    print(f"{folder}: RRMSD {report.rrmsd:.3f}, {report.verdict}")
    return design.solid()  # the exact solid, for cadquery


if __name__ == "__main__":
    main(["generate", *sys.argv[1:]])
