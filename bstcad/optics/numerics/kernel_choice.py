"""Registry of the functions of optics that have a kernel, by device.

A kernel returns the values of the plain form (torch code) of its function to rounding and accepts the same tensors.
The caller requests a kernel by name and runs the plain form if there is none.  Kernels for a GPU are compiled by Warp
(the extra `gpu`); without it a GPU runs the plain forms.  On every device some computations run on the CPU: the blur by
the image of a source, stage 1's transport, the map between two faces, the bounds and checks of a net's shape, and the
rays by which a design is verified.  The cosine transform of stage 2 is scipy's on the CPU and a product of matrices
elsewhere.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor

ENABLED = True  # False turns all kernels off, for tests of the plain forms
# Kernels by function and type of device: callables, or their names in bstcad.optics, loaded at first use.
KERNELS: dict[str, dict[str, str | Callable[..., Any]]] = {
    "bspline.evaluate": {"cpu": "kernels.spline.BSplineSag.apply"},
    "bspline.net_gradient": {"cpu": "kernels.spline.net_gradient"},
    "irradiance.collect": {"cpu": "kernels.splat.Splat.apply"},
    "irradiance.picture_error": {"cpu": "kernels.picture_error.PictureError.apply"},
    "trace.behind bspline": {"cpu": "kernels.crossing.behind"},
    "trace.behind radial": {"cpu": "kernels.dome.behind"},
    "trace.through bspline": {"cpu": "kernels.crossing.landed", "cuda": "kernels.gpu_crossing.landed"},
    "trace.through radial": {"cpu": "kernels.dome.landed"},
    "trace.simulate bspline": {"cpu": "kernels.forward.simulate"},  # the whole path, from the source to the receiver
    "trace.simulate radial": {"cpu": "kernels.dome.simulate"},
    "trace.land bspline": {"cpu": "kernels.forward.land"},  # the whole path of single rays
    "trace.land radial": {"cpu": "kernels.dome.land"},
    "tubes.search": {"cpu": "kernels.search.search"},  # rays of sources through a front to given points
    "tubes.collect": {"cpu": "kernels.clip.Clip.apply", "cuda": "kernels.gpu_clip.Clip.apply"},
    "folds.penalty": {"cpu": "kernels.overturned.Folds.apply"},
    "reductions.dot": {"cpu": "numerics.reductions.dot_of_arrays"},
}
DTYPES = (torch.float32, torch.float64)  # precisions that the kernels support
# Form of the equation by kind of Surface; the kernels of the whole path implement no others.
SURFACE_FORMS = {"bspline": "net", "radial": "radial", "plane": "revolved", "sphere": "revolved", "conic": "revolved"}
# Sequences of interfaces that these kernels trace, each interface as (its form, True if it reflects).
WHOLE_PATHS = [("net", True)], [("revolved", False), ("net", False)], [("revolved", False), ("radial", False)]
FRONTS = [path[:-1] for path in WHOLE_PATHS]  # interfaces before the last face of these paths


def kernel(name: str, *tensors: Tensor) -> Callable[..., Any] | None:
    """Return kernel `name` of KERNELS for tensors that are on one device and have one of DTYPES; None: none fits."""
    device, dtype = tensors[0].device.type, tensors[0].dtype
    found = KERNELS[name].get(device) if ENABLED else None
    if found is None or dtype not in DTYPES or any(t.device.type != device or t.dtype != dtype for t in tensors):
        return None
    if device == "cuda" and not _compiles_for_gpu():
        return None
    return _loaded(found) if isinstance(found, str) else found


def whole_kernel(name: str, interfaces: Sequence[Any]) -> Callable[..., Any] | None:
    """Return kernel `name` for rays across all these Interfaces, the last of its kind; None: none supports them."""
    if _forms(interfaces) not in WHOLE_PATHS or not all(loss.fused for each in interfaces for loss in each.losses):
        return None
    last = interfaces[-1].surface
    return kernel(f"{name} {last.kind}", last.heights)


def front_kernel(name: str, before: Sequence[Any], *tensors: Tensor) -> Callable[..., Any] | None:
    """Return kernel `name` for rays across the Interfaces before a face, without losses; None: none supports them."""
    return kernel(name, *tensors) if _forms(before) in FRONTS else None


def _forms(interfaces: Sequence[Any]) -> list[tuple[str | None, bool]]:
    return [(SURFACE_FORMS.get(interface.surface.kind), interface.law.reverses) for interface in interfaces]


@functools.cache
def _compiles_for_gpu() -> bool:
    """Return True if Warp is installed and finds a GPU."""
    return importlib.util.find_spec("warp") is not None and _loaded("kernels.warp_launch.has_gpu")()


@functools.cache
def _loaded(name: str) -> Callable[..., Any]:
    room, module, function = name.split(".", 2)
    return attrgetter(function)(importlib.import_module(f"bstcad.optics.{room}.{module}"))
