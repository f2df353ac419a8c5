"""The bounds that a scene puts on the back ([lens] tool_radius, max_slope, thicknesses), held to the re-read lens."""

from __future__ import annotations

from collections.abc import Mapping

from bstcad.analysis.shape import survey
from bstcad.optics.lens import Lens
from bstcad.scene.blank import LensBlank
from bstcad.verify.verdict import Check

GRID = ", on a grid four times finer than the net"


def of_bounds(
    lens: Lens, asked: LensBlank | None, shape: Mapping[str, float | None]
) -> tuple[list[Check], dict[str, float]]:
    """A check for each bound that is asked, and the part of the back that is at each of them on curvature and slope."""
    if asked is None:
        return [], {}
    checks, at_bounds = _of_tool(lens, asked)
    for name, judge, key, limit in (
        ("smallest thickness", Check.at_least, "thickness_min", asked.min_thickness),
        ("largest thickness", Check.at_most, "thickness_max", asked.max_thickness),
        ("smallest thickness of the edge", Check.at_least, "edge_thickness_min", asked.edge_thickness),
    ):
        if limit is not None:
            checks.append(judge(name, shape[key], limit, "mm"))
    return checks, at_bounds


def _of_tool(lens: Lens, asked: LensBlank) -> tuple[list[Check], dict[str, float]]:
    """Those of the tool's radius and of the slope."""
    checks: list[Check] = []
    at_bounds: dict[str, float] = {}
    radius, degrees, kind = asked.tool_radius, asked.max_slope, "convex" if asked.mould else "concave"
    if radius is None and degrees is None:
        return checks, at_bounds
    found = survey(lens, **{kind: radius}, slope=degrees)
    if radius is not None:
        met = getattr(found, kind)
        checks.append(Check.at_least(f"smallest {kind} radius{GRID}", met.largest, radius, "mm", met.where))
        at_bounds["tool_radius"] = met.at_bound
    if degrees is not None:
        met = found.slope
        checks.append(Check.at_most(f"steepest slope{GRID}", met.largest, degrees, "deg", met.where))
        at_bounds["max_slope"] = met.at_bound
    return checks, at_bounds
