"""The bounds on the back ([lens] tool_radius, max_slope, thicknesses), and what they cost, in words."""

from __future__ import annotations

from bstcad.report.record import Contents
from bstcad.report.units import number, percent

UNITS = {"max_slope": "degrees"}  # of a bound; all others are in mm


def sentence(report: Contents) -> str:
    """What was asked, how much of the back is at it, and what the design comes to without; nothing if none is asked."""
    found = report.bounds
    if not found:
        return ""
    asked = ", ".join(f"lens.{key} = {value:g} {UNITS.get(key, 'mm')}" for key, value in found["asked"].items())
    at = " and ".join(f"{percent(share)} of it is within 3 % of lens.{key}" for key, share in found["at"].items())
    said = f"The back was tailored within bounds ({asked})" + (f"; {at}." if at else ".")
    if found["rrmsd"] is None or found["rrmsd_freed"] is None:
        return f"{said} What they cost was not measured in this run."
    kept, freed = found["rrmsd"], found["rrmsd_freed"]
    return (
        f"{said} With them the design comes to an RRMSD of {number(kept)}; freed of them, it comes to {number(freed)} "
        "in an eighth of its evaluations more. So much of their cost one run can measure; a design without them tells "
        "all."
    )
