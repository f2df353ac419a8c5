"""Named small scenes as changes of templates/disk.toml, and designs that are made once for all tests.

A design is kept in tests/.designs, which git ignores, by the hash of its scene, of the effort of its verification and
of all that can change it.  So it is made by the first of several processes that asks for it, and by no later run of the
tests until one of these changes.
"""

from __future__ import annotations

import functools
import hashlib
import pickle
import shutil
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import Any

from filelock import FileLock

import bstcad

DISK = Path(__file__).parent.parent / "templates" / "disk.toml"
SMALL = {  # a gentle lens: few triangles keep its mesh within the volume's tolerance
    "name": "small",
    "title": "A <small> disc",
    "source.position": [0.5, 0.0, -60.0],
    "lens.outline": {"shape": "rectangle", "width": 8.0, "height": 6.0},
    "lens.front": {"kind": "sphere", "z": 15.0, "curvature": 0.002},
    "lens.back.z": 25.0,
    "lens.back.control_points": 33,
    "target.x": [-30.0, 30.0],
    "target.y": [-25.0, 25.0],
    "target.pixels": [64, 48],
    "target.outline": {"shape": "circle", "radius": 20.0},
    "moulding.shrinkage": 0.005,
    "tailoring.quality": "draft",
    "tailoring.rays": 256,
    "tailoring.rounds": 3,
    "tailoring.stage2_iterations": 30,  # two rounds
    "tailoring.transport_grid": 64,
}
TINY = {  # templates/disk.toml itself, with few control points
    "lens.back.control_points": 33, "target.pixels": 48, "tailoring.quality": "draft", "tailoring.rays": 128,
    "tailoring.transport_grid": 64, "tailoring.rounds": 2,
}  # fmt: skip
DOME = {
    "name": "dome",
    "source": {"kind": "point", "profile": "lambertian", "position": [0.0, 0.0, 0.0]},
    "lens": {
        "material": "PMMA",
        "front": {"kind": "sphere", "z": 8.0, "curvature": -0.125},
        "back": {"kind": "radial", "radius": 15.0, "half_angle": 60.0, "control_points": 25},
    },
    "target": {"z": 200.0, "x": [-200.0, 200.0], "y": [-150.0, 150.0], "pixels": 24, "uniform": True},
    "tailoring": {"quality": "draft", "rays": 48, "transport_grid": 24, "rounds": 3, "stage2_iterations": 16},
    "accept": {},
}
KEPT = Path(__file__).with_name(".designs")
MAX_AGE = 7 * 86_400.0  # time (s) without use after which a design is deleted
NOT_IN_DESIGNS = {"app", "cli.py", "cli_options.py"}  # parts of the package on which no design depends
SOURCES = {".py", ".j2", ".json", ".md", ".toml", ".txt", ".js", ".css"}  # endings of files that can change a design


@functools.cache
def versions() -> bytes:
    """Return a hash of the sources of the package, and of the versions of Python and the libraries."""
    from bstcad.runs.environment import LIBRARIES

    package, found = Path(bstcad.__file__).parent, hashlib.sha256(sys.version.encode())
    found.update(repr([metadata.version(name) for name in LIBRARIES]).encode())
    for path in sorted(package.rglob("*")):
        place = path.relative_to(package)
        if path.suffix in SOURCES and place.parts[0] not in NOT_IN_DESIGNS and "__pycache__" not in place.parts:
            found.update(str(place).encode() + path.read_bytes())
    return found.digest()


def designed(scene: Any, effort: Any, folder: Path, drawing: Any = None, tailoring: Any = None) -> dict[str, Any]:
    """Copy the design of a scene to a folder, as `commands.generate` writes it, and return its report.json.

    effort: effort of the verification.  drawing: class of its pictures; None: NoPictures.  tailoring: effort of the
    design; None: FULL.  A test that has changed the package (monkeypatch) must not ask for a design, which others would
    get.
    """
    from bstcad import commands
    from bstcad.figures.figure_jobs import NoPictures
    from bstcad.scene.schema import contents
    from bstcad.tailoring.effort import FULL

    drawing = drawing or NoPictures
    digests = [content.digest for _, content in contents(scene)]
    tailoring = tailoring or FULL
    asked = repr((scene.toml(), digests, effort, drawing.__name__, tailoring)).encode()
    place = KEPT / hashlib.sha256(versions() + asked).hexdigest()[:24]
    KEPT.mkdir(exist_ok=True)
    with FileLock(f"{place}.lock"):
        if not (facts := place / "facts").exists():
            shutil.rmtree(place, ignore_errors=True)
            options = commands.ProofOptions(effort, drawing, tailoring=tailoring)
            report = commands.generate(scene, place / "design", options, device="cpu")
            facts.write_bytes(pickle.dumps(report.facts))
            _delete_old(place)
        facts.touch()
        shutil.copytree(place / "design", folder)
        return pickle.loads(facts.read_bytes())


def _delete_old(new: Path) -> None:
    """Delete the designs that no test has asked for in MAX_AGE."""
    for facts in KEPT.glob("*/facts"):
        if facts.stat().st_mtime < time.time() - MAX_AGE and facts.parent != new:
            shutil.rmtree(facts.parent, ignore_errors=True)
