"""Size of every error: of three grades of making, mounting and lighting, and of the scene's [[tolerance]] tables.

Grades are round numbers of the order that makers state for moulded plastic, for diamond-turned and for precision optics
of some 20 mm, not those of a standard or of one shop: put your own in their place.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bstcad.optics.lens import Lens
from bstcad.scene.errors import SceneError
from bstcad.scene.quality import FORM, NONE, OF_TWO_FACES, RIPPLE, Tolerance, settings_of
from bstcad.tolerance.perturbations import Kind, Perturbation, Setup, form_error, kinds, ripple

USUAL = "diamond-turned"
MODES = 3  # independent fields, normal in their amounts, that add up to the form error of a trial


@dataclass(frozen=True)
class Grade:
    """± limits of all errors; of form and ripple RMS."""

    words: str
    decentre: float  # mm, of lens, front and source, and along the axis
    tilt: float  # degrees, clocking and wedge too
    screen: float  # its shift over its width, and along the axis over its distance
    thickness: float  # mm
    index: float
    front_power: float  # mm of sag at the rim
    scale: float
    temperature: float  # K
    wavelength: float  # nm
    source: float  # size and angle of the source, relative
    form: float  # mm RMS
    form_length: float  # correlation length over the lens's width
    ripple: float  # mm RMS
    period: float  # mm, of the ripple


GRADES = {
    "moulded": Grade(
        "moulded plastic", decentre=0.05, tilt=0.1, screen=1e-3, thickness=0.05, index=5e-4, front_power=2e-3,
        scale=1e-3, temperature=10.0, wavelength=5.0, source=0.05, form=5e-4, form_length=0.15, ripple=2e-5, period=1.0,
    ),
    "diamond-turned": Grade(
        "diamond-turned, screwed together", decentre=0.02, tilt=0.03, screen=3e-4, thickness=0.02, index=2e-4,
        front_power=3e-4, scale=1e-4, temperature=3.0, wavelength=2.0, source=0.02, form=1e-4, form_length=0.15,
        ripple=5e-6, period=0.5,
    ),
    "precise": Grade(
        "precise, aligned when mounted", decentre=0.005, tilt=0.005, screen=1e-4, thickness=0.005, index=5e-5,
        front_power=5e-5, scale=2e-5, temperature=1.0, wavelength=0.5, source=0.005, form=3e-5, form_length=0.15,
        ripple=2e-6, period=0.5,
    ),
}  # fmt: skip


def limit(kind: Kind, grade: Grade, setup: Setup) -> float:
    """± of a kind of error, in its unit."""
    part, _, error = kind.name.partition(".")
    if part == "screen" and kind.unit == "mm":
        screen, z = setup.screen, setup.pivot("lens")[2]
        distance = abs(screen.plane.throw(z))
        width = (screen.x[1] - screen.x[0]) * (distance / abs(screen.plane.per_radian(z)))  # mm
        return grade.screen * (distance if error == "axial" else width)
    if error.startswith(("tilt", "clocking", "wedge")):
        return grade.tilt
    if error.startswith(("decentre", "axial")):
        return grade.decentre
    return grade.source if part == "source" else getattr(grade, error or part)


def whole_table(table: Sequence[Tolerance], grade: str | None = None) -> tuple[Tolerance, ...]:
    """The tables of a scene behind their grade; `grade` precedes the grade that the tables state for all errors."""
    if grade is None:
        return Tolerance(grade=USUAL), *table
    if grade not in GRADES:
        raise SceneError(f"--grade {grade}: there is no such grade; give one of {', '.join(GRADES)}")
    named = (e if e.name else e.model_copy(update={"grade": None}) for e in table)
    return Tolerance(grade=grade), *named


def start_of(table: Sequence[Tolerance]) -> str:
    """Grade of all errors that a whole table does not name; "none": they are zero."""
    return settings_of([entry for entry in table if entry.name is None], "")["grade"]


def perturbations(setup: Setup, table: Sequence[Tolerance], material: str | None = None) -> tuple[Perturbation, ...]:
    """All errors of the setup by a whole table.

    Errors that the lens's net is too coarse for are left out, unless the table names them; those of one face against
    the other are off only where it does.  Raises SceneError, in a sentence, for tables of errors that do not exist.
    """
    errors = []
    for kind in kinds(setup, material).values():
        told = settings_of(table, kind.name)
        left_out = kind.name.startswith(OF_TWO_FACES) and not _named(table, kind.name)
        if told.get("grade") != NONE and not left_out:
            size = told["limit"] if "limit" in told else limit(kind, GRADES[told["grade"]], setup)
            errors.append(Perturbation(kind, size, told.get("distribution", "normal"), told.get("cost", 1.0)))
    errors += _of_faces(setup.lens, table)
    for k, entry in enumerate(table[1:]):
        none = entry.name and settings_of(table, entry.name).get("grade") == NONE
        if entry.name and not none and entry.name.startswith(OF_TWO_FACES) and "front" not in setup.lens.passes.faces:
            only = "is of a lens that refracts at two faces, and a mirror has one face"
            raise SceneError(f"tolerance[{k}].name: {entry.name!r} {only}; remove that table")
        if entry.name and not none and not any(entry.covers(error.kind.name) for error in errors):
            raise SceneError(
                f"tolerance[{k}].name: {entry.name!r} changes nothing here, or the scene does not say by how much "
                "(a lens.material does, of temperature and wavelength); remove that table"
            )
    if not errors:
        raise SceneError('tolerance: nothing can be off; give a grade other than "none", or name errors with a limit')
    return tuple(errors)


def _named(table: Sequence[Tolerance], error: str) -> bool:
    """Does a table name it?"""
    return any(entry.name and entry.covers(error) for entry in table)


def _of_faces(lens: Lens, table: Sequence[Tolerance]) -> Iterator[Perturbation]:
    """Form errors and ripple; of the front if the table names it: that takes twice as long to trace."""
    for name in (*FORM, *RIPPLE):
        told, by_name = settings_of(table, name), _named(table, name)
        face = name.partition(".")[0]
        if told.get("grade") == NONE or face not in lens.optical_faces or not (by_name or face == "back"):
            continue
        grade, cost = GRADES[told.get("grade", USUAL)], told.get("cost", 1.0)
        try:
            if name in RIPPLE:
                kind = ripple(lens, told.get("period", grade.period), told.get("pattern", "spiral"))
                yield Perturbation(kind, told.get("limit", grade.ripple), told.get("distribution", "normal"), cost)
                continue
            length = told.get("correlation_length", grade.form_length * 2 * min(lens.outline.half_extent))
            size = told.get("limit", grade.form) / math.sqrt(MODES)
            for seed in range(MODES):
                yield Perturbation(form_error(lens, length, seed, face), size, "field", cost)
        except ValueError as error:  # finer than the net
            if by_name:
                raise SceneError(f"tolerance: {name}: {error}") from error
