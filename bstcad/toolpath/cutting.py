"""Settings of a tool path: the tool, the finish that is asked for, and the steps of roughing.

A setting that is None has a default of the machine: `LATHE` for a spiral, `ROUTER` for a raster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

from bstcad.runs.files import TOOL_RADII

HEIGHTS = (1e-7, 10.0)  # smallest and largest cusp height and tolerance, mm
STEPS = (1e-5, 1e3)  # smallest and largest pitch, stock and depth of cut, mm
FEEDS = (1e-2, 1e6)  # smallest and largest feed, mm/min
LIMITS = {
    "tool_radius": (*TOOL_RADII, "mm"), "cusp": (*HEIGHTS, "mm"), "pitch": (*STEPS, "mm"),
    "tolerance": (*HEIGHTS, "mm"), "stock": (*STEPS, "mm"), "depth": (*STEPS, "mm"), "feed": (*FEEDS, "mm/min"),
}  # fmt: skip
CHOICES = {"along": ("x", "y"), "zero": ("top", "bottom"), "units": ("mm", "inch"), "rapid": ("G0", "G1")}


@dataclass(frozen=True)
class Cutting:
    """Tool, finish and steps of a path as a user states them; lengths in mm."""

    tool_radius: float | None = None  # radius of the nose or ball, mm
    cusp: float | None = None  # largest height of the cusps between neighbouring passes, mm
    pitch: float | None = None  # spacing of the passes, mm; None: from the cusp
    tolerance: float | None = None  # largest distance of the straight moves from the exact path, mm
    stock: float | None = None  # stock that roughing leaves on the face, mm; 0 (a raster): no roughing
    depth: float | None = None  # depth of cut of roughing, mm
    feed: float | None = None  # feed, mm/min
    along: Literal["x", "y"] = "x"  # axis along which the lines of a raster run
    zero: Literal["top", "bottom"] | None = None  # side of the blank on which the Z of a raster is 0
    units: Literal["mm", "inch"] = "mm"  # unit of length of the G-code
    rapid: Literal["G0", "G1"] = "G0"  # command of rapid moves in the G-code

    def __post_init__(self) -> None:
        """Raise ValueError with a sentence for a value out of range."""
        for name, (least, most, unit) in LIMITS.items():
            value = getattr(self, name)
            if value is None or (name == "stock" and value == 0):
                continue
            if not (math.isfinite(value) and least <= value <= most):
                raise ValueError(f"{name} = {value:g} {unit} is not possible; give a value from {least:g} to {most:g}")
        for name, choices in CHOICES.items():
            if (value := getattr(self, name)) not in choices and not (name == "zero" and value is None):
                raise ValueError(f"{name} = {value!r} is not possible; give {' or '.join(choices)}")

    def completed(self, defaults: Cutting) -> Cutting:
        """Return the settings with the values of `defaults` in the place of None."""
        missing = {f.name: getattr(defaults, f.name) for f in fields(self) if getattr(self, f.name) is None}
        return replace(self, **missing)

    @property
    def radius(self) -> float:
        """Radius of the tool (mm) of completed settings."""
        return _stated(self.tool_radius)

    @property
    def finish(self) -> tuple[float, float]:
        """Cusp height asked and tolerance (mm) of completed settings."""
        return _stated(self.cusp), _stated(self.tolerance)

    @property
    def roughing(self) -> tuple[float, float]:
        """Stock left and depth of cut (mm) of completed settings."""
        return _stated(self.stock), _stated(self.depth)

    @property
    def speed(self) -> float:
        """Feed (mm/min) of completed settings."""
        return _stated(self.feed)


def _stated(value: float | None) -> float:
    assert value is not None, "the settings are completed first"
    return value


DEFAULTS = Cutting()  # settings that are those of the machine
# A lathe with a diamond of 0.5 mm: cusps of 50 nm and moves of 5 nm are below what a polished face scatters.  The
# roughing of a blank is turned by the program of the shop, so that a spiral has no stock.
LATHE = Cutting(tool_radius=0.5, cusp=5e-5, tolerance=5e-6, stock=0.0, depth=1.0, feed=50.0, zero="top")
# A router with a ball end mill of 3 mm diameter: cusps of 10 µm, which sanding and polishing remove.
ROUTER = Cutting(tool_radius=1.5, cusp=0.01, tolerance=5e-4, stock=0.2, depth=1.0, feed=800.0, zero="top")
