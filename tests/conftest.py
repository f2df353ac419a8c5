"""Before any test: the environment that `import bstcad` sets, since some tests import torch first, and its threads.

And one small design, made once a session: every step of the main job on real geometry, in two seconds.
"""

import gc
import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# Worker processes, and the processes that they start, share the cores.  A second thread for a core that is busy is
# waited for at each parallel region: 20 ms, where one thread needs 6 µs (1000 elements, beside eight busy processes).
if beside := int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "0")):
    for library in ("OMP", "OPENBLAS", "NUMBA"):
        os.environ.setdefault(f"{library}_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // beside)))

from types import SimpleNamespace

import pytest

from tests.scenes import DISK, SMALL, designed

pytest_plugins = ["tests.suite"]


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
    folder = tmp_path_factory.mktemp("small") / "outputs" / "small"
    return SimpleNamespace(folder=folder, report=designed(small_scene, quick_effort(), folder, flat_pictures()))


def pictures(*kinds):
    """Let `drawing` draw these kinds of a report's pictures alone, by the names of the methods of Pictures."""
    from bstcad.figures.figure_jobs import Pictures

    every = ("solid", "lens", "light", "numbers", "sheet", "judges", "part")
    return type(
        f"Pictures of {kinds}", (Pictures,), {kind: lambda self, *given: None for kind in every if kind not in kinds}
    )


def flat_pictures():
    """Let `drawing` draw all pictures of a report but the 3-D one, over which VTK takes two seconds."""
    return pictures("lens", "light", "numbers", "sheet", "judges", "part")


def draws_nothing(patch):
    """Commands that are not told what to draw draw nothing: three of nine seconds of a small design."""
    from bstcad.figures.figure_jobs import NoPictures

    patch.setattr("bstcad.commands.Pictures", NoPictures)


def pixels_of_all(path, pixels):
    """Overrides by which each target of a scene file has so many pixels."""
    number = path.read_text(encoding="utf-8").count("[[target]]")
    return {key: pixels for key in [f"target[{k}].pixels" for k in range(number)] or ["target.pixels"]}


def quick_effort():
    """Return an effort of few points, with the tubes and rays that resolve the small design."""
    from bstcad.optics.trace.measure import Effort

    return Effort(512, places=129, points=4096, tubes=129)


def quickly(patch):
    """The command line generates by little effort, verifies by `quick_effort` and draws nothing."""
    from functools import partial

    from bstcad import commands
    from bstcad.figures.figure_jobs import NoPictures
    from tests.efforts import LITTLE

    options = commands.ProofOptions(quick_effort(), NoPictures, tailoring=LITTLE)
    patch.setattr(commands, "generate", partial(commands.generate, options=options))


def proofs(patch):
    """The list of all proofs (verify.checks.Proof) from now on."""
    from bstcad.verify import checks

    verify, kept = checks.verify, []
    patch.setattr(checks, "verify", lambda *given, **more: kept.append(verify(*given, **more)) or kept[-1])
    return kept


def verify_with(patch, few):
    """Whatever verifies with no effort of its own, such as the command line, does so with this one."""
    from bstcad.verify import checks

    verify = checks.verify
    patch.setattr(checks, "verify", lambda *given, effort=None, **more: verify(*given, effort=effort or few, **more))
