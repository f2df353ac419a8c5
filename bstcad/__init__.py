"""bstcad: from a picture to a freeform lens, as an exact B-spline solid.

    import bstcad
    design = bstcad.design("templates/thu.toml")
    report = design.write("outputs/thu")
    design.lens, design.solid(), report.rrmsd

A public name is imported when it is first used, so that `import bstcad` is quick.
"""

import os
from importlib import import_module
from typing import Any

# Let idle threads of torch and numba sleep instead of spinning; this must be set before either library is loaded.
# Kernels are then up to twenty times faster while other programs use the machine, and equally fast otherwise.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# OpenMP first: idle threads of TBB spin, and workqueue ends the process if two threads of Python call kernels at once.
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")

__version__ = "0.1.0"
_HOMES = {  # module of each public name, relative to bstcad
    **dict.fromkeys(("design", "open", "mounted", "Design"), "api"),
    "workbench": "app.widget",
    "Report": "report.record",
    **dict.fromkeys(("Scene", "load"), "scene.scene"),
    **dict.fromkeys(("LensBlank", "Back"), "scene.blank"),
    "Accept": "scene.accept",
    "Target": "scene.target",
    "Collimated": "scene.beam",
    "Point": "scene.lamp",
    **dict.fromkeys(("Circle", "Rectangle"), "optics.surfaces.outlines"),
    **dict.fromkeys(("Surface", "Plane", "Sphere", "Conic", "Toroid"), "optics.surfaces.surfaces"),
    **dict.fromkeys(("Interface", "Refract", "Reflect", "cross"), "optics.lens.interfaces"),
    **dict.fromkeys(("measure", "Effort", "Light", "RayTubes"), "optics.trace.measure"),
    "trace": "optics.trace.trace",
    "Lens": "optics.lens.lens",
    "BSplineSurface": "optics.surfaces.bspline",
    "Channel": "optics.light.channels",
    "Screen": "optics.receivers.irradiance",
    "Tailoring": "scene.quality",
    "effect": "scene.effects",
    "Check": "verify.verdict",
    "SceneError": "scene.errors",
}
__all__ = [*sorted(_HOMES), "__version__"]


def __getattr__(name: str) -> Any:
    """Import a public name from its module."""
    if name not in _HOMES:
        raise AttributeError(f"module 'bstcad' has no attribute {name!r}")
    return getattr(import_module(f"bstcad.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
