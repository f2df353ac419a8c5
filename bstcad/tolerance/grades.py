"""Three grades of making, mounting and lighting a lens, for what a scene states no tolerances of.

They are round numbers of the order that makers state for moulded plastic, for diamond-turned and for precision optics
of some 20 mm, not those of a standard or of one shop: put your own in their place.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bstcad.tolerance.kinds import Kind
from bstcad.tolerance.setup import Setup

USUAL = "diamond-turned"


@dataclass(frozen=True)
class Grade:
    """± limits of everything; of the form and the ripple RMS."""

    words: str
    decentre: float  # mm, of lens and source, and along the axis
    tilt: float  # degrees, and clocking
    screen: float  # of its width: its shift; along the axis as much of its distance
    thickness: float  # mm
    index: float
    front_power: float  # mm of sag at the rim
    scale: float
    temperature: float  # K
    wavelength: float  # nm
    source: float  # size and angle of the source, relative
    form: float  # mm RMS
    form_length: float  # correlation length, of the lens's width
    ripple: float  # mm RMS
    period: float  # mm, of the ripple


GRADES: Mapping[str, Grade] = {
    "moulded": Grade(
        "moulded plastic",
        0.05, 0.1, 1e-3, 0.05, 5e-4, 2e-3, 1e-3, 10.0, 5.0, 0.05, 5e-4, 0.15, 2e-5, 1.0
    ),
    "diamond-turned": Grade(
        "diamond-turned, screwed together",
        0.02, 0.03, 3e-4, 0.02, 2e-4, 3e-4, 1e-4, 3.0, 2.0, 0.02, 1e-4, 0.15, 5e-6, 0.5
    ),
    "precise": Grade(
        "precise, aligned when mounted",
        0.005, 0.005, 1e-4, 0.005, 5e-5, 5e-5, 2e-5, 1.0, 0.5, 0.005, 3e-5, 0.15, 2e-6, 0.5
    ),
}  # fmt: skip


def limit(kind: Kind, grade: Grade, setup: Setup) -> float:
    """± of a kind of error, in its unit."""
    part, _, what = kind.name.partition(".")
    if part == "screen" and kind.unit == "mm":
        screen = setup.screen
        width, distance = screen.x[1] - screen.x[0], abs(screen.z - setup.middle[2])
        return grade.screen * (distance if what == "axial" else width)
    if what.startswith(("tilt", "clocking")):
        return grade.tilt
    if what.startswith(("decentre", "axial")):
        return grade.decentre
    if part == "source":
        return grade.source
    return getattr(grade, what or part)
