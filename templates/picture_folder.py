"""A lens for every picture in a folder: python templates/picture_folder.py templates/disk.toml photos outputs/photos

All lenses use one scene, in which each picture replaces the target's; each lens has its own folder.
"""

import sys
from pathlib import Path

import bstcad

if len(sys.argv) != 4:
    sys.exit("picture_folder: give a scene, a folder of pictures, and a folder for the designs")
scene, pictures, outputs = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
paths = sorted(path for path in pictures.glob("*") if path.suffix.lower() in (".png", ".jpg", ".jpeg", ".webp"))
if not paths:
    sys.exit(f"{pictures}: has no picture; give a folder with PNG, JPEG or WebP files")
for path in paths:
    try:
        changed = bstcad.load(scene).changed(
            {"name": path.stem, "target.image": path, "target.outline": None, "tailoring.quality": "draft"}
        )
        folder = outputs / changed.name
        report = bstcad.design(changed).write(folder)
        solid = bstcad.open(folder).solid()
    except bstcad.SceneError as error:
        sys.exit(f"{path}: {error}")
    rrmsd = f"{report.rrmsd:.3f}" if report.rrmsd is not None else "not known"
    print(f"{folder}: RRMSD {rrmsd}, {report.verdict}, {'valid' if solid.isValid() else 'NOT valid'}")
