"""Designs in processes of their own, to be killed.

python tests/hard_cases/killed.py FOLDER: the small design of the suite, with a checkpoint at every step and --resume;
says "ready" when it begins, and "done RRMSD" at its end.
"""

from __future__ import annotations

import functools
import hashlib
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
# First in a process that runs the command line: it verifies by as many tubes and rays as resolve the small design, and
# draws all but the 3-D picture.
FEW_RAYS = """
from bstcad.optics.measure import Effort
from bstcad.report import rendering
from bstcad.verify import checks
checks.FULL = Effort(256)
rendering.lens_picture = lambda mesh: None
"""


def start(folder: Path) -> subprocess.Popen:
    """Begin it, and wait until it is ready."""
    command = [sys.executable, str(Path(__file__)), str(folder)]
    running = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert running.stdout.readline() == "ready\n", running.communicate()[0]
    return running


def design_of(folder: Path) -> str:
    """A digest of the design in a folder."""
    return hashlib.sha256((folder / "design.npz").read_bytes()).hexdigest()


def main(folder: str) -> None:
    sys.path.insert(0, str(ROOT))
    from bstcad import commands
    from bstcad.optics.measure import Effort
    from bstcad.report import rendering
    from bstcad.scene.scene import load
    from tests.conftest import DISK, SMALL

    commands.Keeper = functools.partial(commands.Keeper, every=0.0)
    commands.checkpoint.SHARE = 1e9  # no pause, however long the writing takes
    rendering.lens_picture = lambda mesh: None
    scene = load(DISK, SMALL | {"tailoring.stage2_iterations": 45})
    print("ready", flush=True)
    report = commands.generate(scene, Path(folder), device="cpu", resume=True, effort=Effort(256))
    print("done", report.rrmsd)


if __name__ == "__main__":
    main(*sys.argv[1:])
