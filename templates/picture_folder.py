"""A lens for every picture in a folder: python templates/picture_folder.py templates/disk.toml photos outputs/photos

All lenses use one scene, in which each picture replaces the target's; each lens has its own folder.
"""

import sys
from pathlib import Path

import bstcad

scene, pictures, outputs = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
for path in sorted(path for path in pictures.iterdir() if path.suffix.lower() in (".png", ".jpg", ".jpeg", ".webp")):
    changed = bstcad.load(scene).changed(
        {"name": path.stem, "target.image": path, "target.outline": None, "tailoring.quality": "draft"}
    )
    folder = outputs / changed.name
    report = bstcad.design(changed).write(folder)
    solid = bstcad.open(folder).solid()
    print(f"{folder}: RRMSD {report.rrmsd:.3f}, {report.verdict}, {'valid' if solid.isValid() else 'NOT valid'}")
