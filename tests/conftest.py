"""Before any test: the environment that `import bstcad` sets, since some tests import torch first, and its threads.

And one small design, made once a session: every step of the main job on real geometry, in two seconds.
"""

import gc
import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
if beside := int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "0")):  # they share the cores: a tenth less time in all
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // beside)))

from pathlib import Path
from types import SimpleNamespace

import pytest

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
    "tailoring.quality": "draft",
    "tailoring.rays": 256,
    "tailoring.rounds": 3,
    "tailoring.stage2_iterations": 30,  # two rounds
    "tailoring.transport_grid": 64,
}


def pytest_collection_finish():
    """The libraries and the tests themselves stay: no collection of garbage walks over their million objects again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def small_scene():
    """templates/disk.toml, made small: 33² control points, 64 x 48 pixels, an off-axis point, a spherical front."""
    from bstcad.scene.scene import load

    return load(DISK, SMALL)


@pytest.fixture(scope="session")
def small_design(small_scene, tmp_path_factory):
    """(folder, report) of the small scene as `generate` wrote it; everything is drawn but the 3-D picture."""
    from bstcad.runs import commands

    folder = tmp_path_factory.mktemp("small") / "outputs" / "small"
    report = commands.generate(small_scene, folder, device="cpu", effort=quick_effort(), drawing=flat_pictures())
    return SimpleNamespace(folder=folder, report=report.facts())


def flat_pictures():
    """For `drawing`: all pictures of a report but the 3-D one, over which VTK takes two seconds."""
    from bstcad.report.figure_jobs import Pictures

    class Flat(Pictures):
        def solid(self, lens):
            pass

    return Flat


def draws_nothing(patch):
    """Commands that are not told what to draw draw nothing: three of nine seconds of a small design."""
    from bstcad.report.figure_jobs import NoPictures

    patch.setattr("bstcad.runs.commands.Pictures", NoPictures)


def quick_effort():
    """As many tubes and rays as it takes to resolve the small design."""
    from bstcad.optics.measure import Effort

    return Effort(512)


def verify_with(patch, few):
    """Whatever verifies with no effort of its own, such as the command line, does so with this one."""
    from bstcad.verify import checks

    verify = checks.verify
    patch.setattr(checks, "verify", lambda *given, effort=None: verify(*given, effort=effort or few))
