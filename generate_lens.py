"""Design a lens for a scene file: python generate_lens.py templates/thu.toml (same options as `bstcad generate`).

The function `generate_lens` below does the same in Python, as a start for your own scripts.
"""

import sys

import bstcad
from bstcad.cli import main


def generate_lens(scene, folder, **changes):
    """Design the lens of a scene file and write it to a folder; changes by dotted key: **{"target.text": "HI"}."""
    design = bstcad.design(bstcad.load(scene).changed(changes))  # the transport map, then both stages of tailoring
    report = design.write(folder)  # STEP, STL, 3MF and a report on the written files
    print(f"{folder}: RRMSD {report.rrmsd:.3f}, {report.verdict}")
    return design.solid()  # the exact solid, for cadquery


if __name__ == "__main__":
    main(["generate", *sys.argv[1:]])
