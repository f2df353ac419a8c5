"""The caches of the package are bounded, so that a workbench does not grow with the scenes that it has shown."""

import gc
import importlib
import pkgutil
import types
from dataclasses import replace

import numpy as np
import pytest
import torch

import bstcad
from bstcad.photometry import ies
from bstcad.planning.preview import preview
from bstcad.planning.reduction import QUICK
from bstcad.scene.scene import load
from bstcad.scene.schema import _SHARED
from tests.benchmarks.cold import TEMPLATES
from tests.hard_cases.test_mutated_files import LAMP, intensity

WITHOUT_BOUND = {  # caches without a bound, and the reason why no request makes them grow
    **dict.fromkeys(
        (
            "app.form._kind_meanings", "app.form.environment", "figures.light_figures.srgb_grey", "report.manual.pages",
            "report.manual.sections", "exports.part_views._letters", "report.units._plain_text",
            "report.units.environment", "runs.environment.version", "scene.schema.schema", "planning.prediction.pace",
            "optics.numerics.kernel_choice._compiles_for_gpu",
        ),
        "the function has no argument",
    ),
    "optics.numerics.compiling._caches": "the argument is a setting of numba",
    "optics.numerics.reductions._pool": "the argument is the number of threads of torch",
    "optics.numerics.kernel_choice._loaded": "the argument is the name of a kernel",
    "optics.lens.face_integrals.gauss_rule": "the argument is a constant of the package",
    "report.record._adapter": "the argument is a class of the package",
    "planning.cold_run.calibration_kernel": "the argument is a constant of the package",
    "manufacture.tolerance.study._cardinal": "the argument is an entry of SPLINE_NODES",
}  # fmt: skip
WINDOW = {"kind": "window", "z": 1.0, "thickness": 1.0, "material": "PMMA"}
WINDOW |= {"outline": {"shape": "circle", "diameter": 40.0}}
SMALL = replace(QUICK, net=33, tubes=64, rounds=1, evaluations=3, blurred=2)
LARGE_CACHE = 64  # entries, above which a cache may not keep the data of each scene


def modules():
    """All modules of the package; those whose library is not installed are left out."""
    for found in pkgutil.walk_packages(bstcad.__path__, "bstcad."):
        if not found.name.endswith("__main__"):
            try:
                yield importlib.import_module(found.name)
            except ImportError:
                continue


def caches():
    """Caches of functions by the module that makes them and their name there."""
    found = {}
    for module in modules():
        for name, value in vars(module).items():
            if hasattr(value, "cache_parameters"):
                own = value.__module__ == module.__name__ or value.__module__.partition(".")[0] != "bstcad"
                if own or value not in found.values():
                    found = {key: each for key, each in found.items() if each is not value}
                    found[f"{module.__name__}.{name}".removeprefix("bstcad.")] = value
    return found


def sizes():
    """Number of entries of each dict, list and set of a module."""
    kinds = dict, list, set
    return {
        (module.__name__, name): len(value)
        for module in modules()
        for name, value in vars(module).items()
        if type(value) in kinds and not name.startswith("__")
    }


def megabytes(cache):
    """Size of the arrays, bytes and texts that the entries of a cache keep, each counted once (MB)."""
    seen, stack, total = set(), [each for each in gc.get_referents(cache) if each is not vars(cache)], 0
    while stack:
        value = stack.pop()
        if id(value) in seen or isinstance(value, type | types.ModuleType | types.FunctionType):
            continue
        seen.add(id(value))
        if isinstance(value, np.ndarray):
            total += value.nbytes
        elif isinstance(value, torch.Tensor):
            total += value.numel() * value.element_size()
        elif isinstance(value, bytes | str):
            total += len(value)
        else:
            stack += gc.get_referents(value)
    return total / 1e6


@pytest.fixture(scope="module")
def found():
    return caches()


def test_each_cache_is_bounded_or_says_why_not(found):
    assert len(found) > 40
    free = {name for name, cache in found.items() if cache.cache_parameters()["maxsize"] is None}
    assert free == {*WITHOUT_BOUND}


def test_previews_of_several_sizes_leave_no_more_than_one_does(found, tmp_path):
    """The lamp has a file: a net of half a megabyte, of which each scene had kept one of its own."""
    (tmp_path / "lamp.ies").write_bytes(ies.write(intensity(), LAMP))
    (tmp_path / "scene.toml").write_text((TEMPLATES / "led.toml").read_text(encoding="utf-8"))
    counts, kept, tables, before = [], [], [], {*_SHARED}  # other tests may keep contents of their own
    for points, pixels, place in ((33, 16, 0.0), (49, 24, 0.1), (65, 40, 0.2)):
        lamp = {"kind": "point", "position": [place, 0.0, -10.0], "intensity": "lamp.ies"}
        changes = {"source": lamp, "before": [WINDOW | {"z": -2.0}], "accept": {}}
        scene = load(tmp_path / "scene.toml", changes | {"lens.back.control_points": points, "target.pixels": pixels})
        preview(scene, SMALL)
        info = {name: cache.cache_info() for name, cache in found.items()}
        assert all(each.currsize <= each.maxsize for each in info.values() if each.maxsize is not None)
        counts.append({name: info[name].currsize for name in WITHOUT_BOUND})
        large = [name for name, each in info.items() if each.maxsize and each.maxsize > LARGE_CACHE]
        kept.append({name: megabytes(found[name]) for name in large})
        tables.append(sizes())
    assert counts[0] == counts[1] == counts[2] and tables[0] == tables[1] == tables[2]
    assert kept[0]["optics.trace.trace._useful"] > 0.3  # the law of this lamp, MB
    assert all(kept[2][name] < size + 0.05 for name, size in kept[0].items()), kept
    assert len({*_SHARED} - before) < 10
