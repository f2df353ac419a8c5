"""Three grades of making, mounting and lighting a lens, for who has stated no tolerances of their own.

They are round numbers of the order that makers state for moulded plastic, for diamond-turned and for precision optics
of some 20 mm, not those of a standard or of one shop: put your own in their place.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from bstcad.tolerance.kinds import Kind, form_error, kinds, ripple
from bstcad.tolerance.perturbation import Perturbation
from bstcad.tolerance.setup import Setup

MODES = 3  # independent fields that the form error of a trial is mixed of, normal in their amounts


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
    source: float  # size and angle of the source, relative
    form: float  # mm RMS
    form_length: float  # correlation length, of the lens's width
    ripple: float  # mm RMS
    period: float  # mm, of the ripple


GRADES: Mapping[str, Grade] = {
    "moulded": Grade(
        "moulded plastic", 0.05, 0.1, 1e-3, 0.05, 5e-4, 2e-3, 1e-3, 10.0, 0.05, 5e-4, 0.15, 2e-5, 1.0
    ),
    "diamond-turned": Grade(
        "diamond-turned, screwed together", 0.02, 0.03, 3e-4, 0.02, 2e-4, 3e-4, 1e-4, 3.0, 0.02, 1e-4, 0.15, 5e-6, 0.5
    ),
    "precise": Grade(
        "precise, aligned when mounted", 0.005, 0.005, 1e-4, 0.005, 5e-5, 5e-5, 2e-5, 1.0, 0.005, 3e-5, 0.15, 2e-6, 0.5
    ),
}  # fmt: skip


def perturbations(setup: Setup, grade: Grade, material: str | None = None) -> tuple[Perturbation, ...]:
    """All that can be off in the setup, within a grade; what the lens's net is too coarse for is left out."""
    found = [Perturbation(kind, _limit(kind, grade, setup)) for kind in kinds(setup, material).values()]
    return (*found, *_of_the_face(setup, grade))


def _of_the_face(setup: Setup, grade: Grade) -> Iterator[Perturbation]:
    lens = setup.lens
    length = grade.form_length * 2 * min(lens.outline.half_extent)
    try:
        fields = [form_error(lens, length, seed) for seed in range(MODES)]
        yield from (Perturbation(kind, grade.form / math.sqrt(MODES), "field") for kind in fields)
        yield Perturbation(ripple(lens, grade.period, "spiral"), grade.ripple)
    except ValueError:  # finer than the net
        return


def _limit(kind: Kind, grade: Grade, setup: Setup) -> float:
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
