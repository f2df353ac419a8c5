"""The bounds that a scene puts on the back ([lens] tool_radius, max_slope, thicknesses), held to the re-read lens."""

from __future__ import annotations

from collections.abc import Mapping

from bstcad.analysis import machining
from bstcad.optics.lens import Lens
from bstcad.scene.wanted import LensBlank
from bstcad.verify.verdict import Check

GRID = ", on a grid four times finer than the net"


def of_bounds(
    lens: Lens, asked: LensBlank | None, shape: Mapping[str, float | None]
) -> tuple[list[Check], dict[str, float]]:
    """A check for each bound that is asked, and the part of the back that is at each of them on curvature and slope."""
    checks: list[Check] = []
    at_bounds: dict[str, float] = {}
    if asked is None:
        return checks, at_bounds
    if (radius := asked.tool_radius) is not None:
        kind, look = ("convex", machining.convex) if asked.mould else ("concave", machining.concave)
        met = look(lens, radius)
        checks.append(Check.at_least(f"smallest {kind} radius{GRID}", met.largest, radius, "mm", met.where))
        at_bounds["tool_radius"] = met.at_bound
    if (degrees := asked.max_slope) is not None:
        met = machining.slope(lens, degrees)
        checks.append(Check.at_most(f"steepest slope{GRID}", met.largest, degrees, "deg", met.where))
        at_bounds["max_slope"] = met.at_bound
    for name, judge, key, limit in (
        ("smallest thickness, of lens.min_thickness", Check.at_least, "thickness_min", asked.min_thickness),
        ("largest thickness", Check.at_most, "thickness_max", asked.max_thickness),
        ("smallest thickness of the edge", Check.at_least, "edge_thickness_min", asked.edge_thickness),
    ):
        if limit is not None:
            checks.append(judge(name, shape[key], limit, "mm"))
    return checks, at_bounds
