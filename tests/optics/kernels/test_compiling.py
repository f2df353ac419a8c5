"""A kernel is compiled anew when any kernel's file has changed, and follows the constants of the plain form."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numba
import pytest
import torch

from bstcad.optics.lens import interfaces
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.point import PointSource
from bstcad.optics.numerics import compiling
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces import rays, sampling, surfaces
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.optics.trace import tubes
from bstcad.optics.trace.tubes import launch_tubes
from tests.lenses import net
from tests.tracing import simulated


@pytest.fixture
def files(tmp_path, monkeypatch):
    numerics, kernels = tmp_path / "numerics", tmp_path / "kernels"
    for folder, text in ((numerics, "one"), (kernels, "two")):
        folder.mkdir()
        (folder / "a.py").write_text(text)
    monkeypatch.setattr(compiling, "FOLDER", numerics)
    monkeypatch.setattr(compiling, "SOURCES", (numerics, kernels))
    yield numerics
    compiling._caches.cache_clear()


def caches(chosen=""):
    compiling._caches.cache_clear()
    return compiling._caches(chosen)


def test_the_place_of_the_caches_follows_every_file(files):
    before = caches()
    assert before.parent == files / "__pycache__" and caches() == before
    before.mkdir(parents=True)
    (files.with_name("kernels") / "a.py").write_text("another two")
    after = caches()
    assert after != before and not before.exists()  # nobody will ask for those again


def test_a_chosen_place_counts_and_nothing_there_is_removed(files, tmp_path):
    kept = tmp_path / "chosen" / f"{compiling.PREFIX}of-another-version"
    kept.mkdir(parents=True)
    assert caches(str(kept.parent)).parent == kept.parent and kept.exists()


def test_a_kernel_keeps_its_code_there():
    """Other users of numba in this process keep their code where they had it."""
    before = numba.config.CACHE_DIR

    def twice(x):
        return 2 * x

    kernel = compiling.compiled()(twice)
    assert kernel(2) == 4 and before == numba.config.CACHE_DIR
    assert Path(kernel.stats.cache_path).is_relative_to(compiling._caches(before))


THREADS = """
import bstcad, numba, numpy as np
from numba import prange
from bstcad.optics.numerics.compiling import MIN_PART, compiled

def count_threads(x, counts):
    for k in prange(counts.size):
        counts[k] = numba.get_num_threads()

kernel, counts, found = compiled(threads_by="x")(count_threads), np.zeros(4, np.int64), []
for size in (2 * MIN_PART - 1, 2 * MIN_PART):
    kernel(np.zeros(size), counts)
    found.append((set(counts.tolist()), numba.get_num_threads()))
print(found, numba.threading_layer())
"""


def test_loops_over_few_elements_have_one_thread():
    """A second process has two threads however few cores the machine has, and the layer that the package prefers."""
    others = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    given = others | {"NUMBA_NUM_THREADS": "2", "PYTHONPATH": str(Path(compiling.__file__).parents[3])}
    done = subprocess.run([sys.executable, "-c", THREADS], env=given, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[({1}, 2), ({2}, 2)] omp", done.stderr


SOURCE, SCREEN = PointSource((0.0, 0.0, -40.0), "lambertian"), Screen(400.0, (-80.0, 80.0), (-80.0, 80.0), (8, 8))
CHANGED = {  # constant: (where it stands, a value that no ray can fail to feel)
    "NEWTON_STEPS": (interfaces, 1),
    "APPROACH_STEPS": (interfaces, 0),
    "SIDE_EXIT_COSINE": (interfaces, 1.0),
    "MIN_NEWTON_DERIVATIVE": (interfaces, 50.0),
    "TANGENCY_TOLERANCE": (interfaces, 2.0),
    "MIN_COS_REFRACTION": (interfaces, 50.0),
    "MIN_COS2": (surfaces, 0.9999),
    "MIN_AXIAL_COSINE": (rays, 0.9999),
    "SPLITMIX_INCREMENT": (sampling, 3),
    "MIX_1": (sampling, 3),
    "MIX_2": (sampling, 3),
    "MIN_TRIANGLE_AREA": (tubes, 1e9),
}


def lens(cliff):
    """A round front and a wavy back; with a cliff in its corner (mm) most rays are steep to the net as a whole."""
    back = net(lambda x, y: 0.02 * torch.sin(1.1 * x) * torch.cos(y) + cliff * (x > 7.0) * (y > 7.0), m=33, half=8.0)
    return Lens.between(Sphere(10.0, 0.01), back, Rectangle(16.0, 16.0), 1.5)


def seen(cliff):
    """Return the results of all kernels that know constants of the plain form."""
    now = lens(cliff)
    box = simulated(SOURCE, now, SCREEN, 64, 0).box
    tubes = launch_tubes(SOURCE, now, 32)
    heights = now.back.heights.clone().requires_grad_()
    landed = tubes.landing(now.with_back(replace(now.back, heights=heights)), LevelPlane(SCREEN.z))
    picture, _ = tubes.collect(landed, SCREEN)
    (gradient,) = torch.autograd.grad((picture**2).sum(), heights)
    return torch.cat([t.detach().reshape(-1) for t in (box, picture, gradient)])


@pytest.mark.parametrize("name", CHANGED)
def test_a_compiled_kernel_follows_the_plain_form(name, monkeypatch):
    cliff = 8.0 if name in ("APPROACH_STEPS", "SIDE_EXIT_COSINE") else 0.0
    before = seen(cliff)
    assert torch.equal(seen(cliff), before)
    module, value = CHANGED[name]
    assert getattr(module, name) != value
    monkeypatch.setattr(module, name, value)
    assert not torch.equal(seen(cliff), before)
