"""Limits of all errors, from the grades of manufacture and alignment and from the [[tolerance]] tables.

The first three grades are round numbers of the magnitude that manufacturers state for moulded plastic, diamond-turned
and precision optics of some 20 mm.  The other four are those of a maker with a router or a resin printer, for plates of
some 100 mm.  They follow no standard and no particular manufacturer; replace them with your own limits.

Sources of the roughness Ra: moulded lenses and lenses printed by inkjet have less than 20 nm (PMC5724772).  Prints have
tens of µm before a coat of resin and a few nm after it (Vaidya and Solgaard 2018, Microsyst. Nanoeng. 4, 18).  Most of
it is that of the steps, which `layer_height` describes, and not that between the steps.  The other values are orders of
magnitude: PMMA polished (20 nm) and sanded with 2000 grit (0.2 µm), correlation and smoothing lengths, form.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

from bstcad.analysis.sharp_throw import Making
from bstcad.manufacture.tolerance.perturbations import Kind, Perturbation, Setup, form_error, kinds, ripple
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK, FRONT
from bstcad.optics.trace.finish import Finish
from bstcad.scene.errors import SceneError
from bstcad.scene.quality import FINISH_KEYS, FORM, NONE, RIPPLE, TWO_FACE_ERRORS, Tolerance, settings_of

DEFAULT_GRADE: Final = "diamond-turned"
FORM_MODES = 3  # number of independent random fields, with normally distributed amounts, whose sum is the form error


@dataclass(frozen=True)
class ToleranceGrade:
    """Limits (±) of all errors; RMS for form and ripple."""

    words: str  # name in reports
    decentre: float  # shift of lens, front and source across and along the axis, mm
    tilt: float  # tilt, clocking and wedge, degrees
    screen: float  # shift of the screen across the axis / its width; shift along the axis / its distance
    thickness: float  # thickness at the centre, mm
    index: float  # refractive index
    front_power: float  # sag of the front at its rim, mm
    scale: float  # size of the lens, relative
    temperature: float  # difference from the design temperature, K
    wavelength: float  # difference from the design wavelength, nm
    source: float  # size and cone angle of the source, relative
    form: float  # form error, mm RMS
    form_length: float  # correlation length of the form error / smaller of width and height of the lens
    ripple: float  # ripple, mm RMS
    period: float  # period of the ripple, mm
    finish: Finish  # layers, smoothing and roughness; its tool marks are ripple and period


# Limits of a part that is mounted by hand in the light of the sun, in the units of ToleranceGrade.
HOBBY: Final = {
    "decentre": 0.5, "tilt": 0.5, "screen": 5e-3, "thickness": 0.1, "front_power": 0.02, "temperature": 15.0,
    "wavelength": 10.0, "source": 0.05, "form_length": 0.15,
}  # fmt: skip
GRADES = {
    "moulded": ToleranceGrade(
        "moulded plastic", decentre=0.05, tilt=0.1, screen=1e-3, thickness=0.05, index=5e-4, front_power=2e-3,
        scale=1e-3, temperature=10.0, wavelength=5.0, source=0.05, form=5e-4, form_length=0.15, ripple=2e-5, period=1.0,
        finish=Finish(roughness=10.0),
    ),
    "diamond-turned": ToleranceGrade(
        "diamond-turned, screwed together", decentre=0.02, tilt=0.03, screen=3e-4, thickness=0.02, index=2e-4,
        front_power=3e-4, scale=1e-4, temperature=3.0, wavelength=2.0, source=0.02, form=1e-4, form_length=0.15,
        ripple=5e-6, period=0.5, finish=Finish(roughness=5.0),
    ),
    "precise": ToleranceGrade(
        "precise, aligned when mounted", decentre=0.005, tilt=0.005, screen=1e-4, thickness=0.005, index=5e-5,
        front_power=5e-5, scale=2e-5, temperature=1.0, wavelength=0.5, source=0.005, form=3e-5, form_length=0.15,
        ripple=2e-6, period=0.5, finish=Finish(roughness=2.0),
    ),
    "milled-polished": ToleranceGrade(
        "milled by a router, sanded and polished", **HOBBY, index=5e-4, scale=5e-4, form=1e-2, ripple=1e-4, period=0.5,
        finish=Finish(roughness=20.0, roughness_length=0.05, smoothing_length=0.2),
    ),
    "milled-sanded": ToleranceGrade(
        "milled by a router and sanded", **HOBBY, index=5e-4, scale=5e-4, form=1e-2, ripple=3e-4, period=0.5,
        finish=Finish(roughness=200.0, roughness_length=0.02, smoothing_length=0.1),
    ),
    "resin-printed": ToleranceGrade(
        "printed in resin", **HOBBY, index=5e-3, scale=3e-3, form=2e-2, ripple=1e-5, period=1.0,
        finish=Finish(roughness=100.0, roughness_length=0.02, layer_height=0.05, smoothing_length=0.05),
    ),
    "resin-printed-coated": ToleranceGrade(
        "printed in resin, with a levelling coat", **HOBBY, index=5e-3, scale=3e-3, form=2e-2, ripple=1e-5, period=1.0,
        finish=Finish(roughness=10.0, roughness_length=0.05, layer_height=0.05, smoothing_length=0.4),
    ),
}  # fmt: skip


def grade_limit(kind: Kind, grade: ToleranceGrade, setup: Setup) -> float:
    """Return the limit (±) that a grade sets for a kind of error, in the unit of the kind."""
    field = limit_of(kind.name)
    if field == "screen" and kind.unit == "mm":
        screen, z = setup.screen, setup.pivot("lens")[2]
        distance = abs(screen.receiver.throw(z))
        width = (screen.x[1] - screen.x[0]) * (distance / abs(screen.receiver.per_radian(z)))  # mm
        return grade.screen * (distance if kind.name == "screen.axial" else width)
    return grade.decentre if field == "screen" else getattr(grade, field)


# field of ToleranceGrade by the name of an error without its part; other errors have a field of their own name
FIELDS = {
    **dict.fromkeys(("tilt", "tilt_x", "tilt_y", "clocking", "wedge", "wedge_x", "wedge_y"), "tilt"),
    **dict.fromkeys(("decentre", "decentre_x", "decentre_y", "axial"), "decentre"),
}


def limit_of(name: str) -> str:
    """Return the field of ToleranceGrade that limits the error of this name, such as lens.decentre_x."""
    part, _, error = name.partition(".")
    field = FIELDS.get(error)
    if field is not None:
        return "screen" if (part, field) == ("screen", "decentre") else field
    return "source" if part == "source" else error or part


def graded_table(table: Sequence[Tolerance], grade: str | None = None) -> tuple[Tolerance, ...]:
    """Return a table with `grade`, then the scene's tables without their general grade.

    grade None: a table with DEFAULT_GRADE, then the scene's tables unchanged.
    """
    if grade is None:
        return Tolerance(grade=DEFAULT_GRADE), *table
    if grade not in GRADES:
        raise SceneError(f"--grade {grade}: unknown grade; give one of {', '.join(GRADES)}")
    others = (e if e.name else e.model_copy(update={"grade": None}) for e in table)
    return Tolerance.model_validate({"grade": grade}), *others


def base_grade(table: Sequence[Tolerance]) -> str:
    """Return the grade of the errors that a `graded_table` does not name; "none" if these errors are zero."""
    return settings_of([entry for entry in table if entry.name is None], "")["grade"]


def finish_of(table: Sequence[Tolerance]) -> Finish:
    """Return the finish of the part by a `graded_table`: that of its general grade, changed by its general keys."""
    values = settings_of([entry for entry in table if entry.name is None], "")
    marks, general = settings_of(table, "back.ripple"), GRADES.get(values["grade"])
    grade = GRADES.get(marks.get("grade", values["grade"]))  # None: no tool marks unless a table states their limit
    finish = Finish() if general is None else general.finish
    ripple, period = (0.0, finish.period) if grade is None else (grade.ripple, grade.period)
    finish = replace(finish, ripple=marks.get("limit", ripple), period=marks.get("period", period))
    return replace(finish, **{key: values[key] for key in FINISH_KEYS if key in values})


def form_of(table: Sequence[Tolerance], lens: Lens) -> tuple[float, float] | None:
    """Return RMS and correlation length (mm) of the back's form error by a `graded_table`; None: there is none."""
    values = settings_of(table, FORM[0])
    if values.get("grade") == NONE or BACK not in lens.passes.faces:
        return None
    grade = GRADES.get(values.get("grade", ""))
    size = values.get("limit", 0.0 if grade is None else grade.form)
    relative = GRADES[DEFAULT_GRADE].form_length if grade is None else grade.form_length
    return size, values.get("correlation_length", relative * 2 * min(lens.outline.half_extent))


def making_of(tolerance: Sequence[Tolerance], lens: Lens) -> Making:
    """Return the errors that spread light, by the [[tolerance]] tables of a scene; without a grade, DEFAULT_GRADE."""
    table = graded_table(tolerance)
    name = base_grade(table)
    words = GRADES[name].words if name in GRADES else "as stated in the scene"
    stated = any(entry.name is None and entry.grade is not None for entry in tolerance)
    return Making(finish_of(table), form_of(table, lens), name, words, assumed=not stated)


def perturbations(setup: Setup, table: Sequence[Tolerance], material: str | None = None) -> tuple[Perturbation, ...]:
    """Return all errors of the setup, with limits from a `graded_table`; material: lens.material or None.

    Form errors and ripple that need a finer net are omitted.  Errors of one face relative to the other are included
    only if the table names them.  SceneError if the table names an omitted error, or if all errors are zero.
    """
    errors = []
    for kind in kinds(setup, material).values():
        values = settings_of(table, kind.name)
        left_out = kind.name in TWO_FACE_ERRORS and not _names_error(table, kind.name)
        if values.get("grade") != NONE and not left_out:
            stated = "limit" in values
            size = values["limit"] if stated else grade_limit(kind, GRADES[values["grade"]], setup)
            errors.append(Perturbation(kind, size, values.get("distribution", "normal"), values.get("cost", 1.0)))
    errors += _face_errors(setup.lens, table)
    for k, entry in enumerate(table[1:]):
        off = entry.name and settings_of(table, entry.name).get("grade") == NONE
        if entry.name and not off and entry.name in TWO_FACE_ERRORS and FRONT not in setup.lens.passes.faces:
            reason = "is an error of a lens with two faces, but a mirror has one face"
            raise SceneError(f"tolerance[{k}].name: {entry.name!r} {reason}; remove that table")
        if entry.name and not off and not any(entry.covers(error.kind.name) for error in errors):
            raise SceneError(
                f"tolerance[{k}].name: {entry.name!r} has no effect in this scene, or its effect is unknown "
                "(temperature and wavelength need lens.material); remove that table"
            )
    if not errors:
        raise SceneError('tolerance: all errors are zero; give a grade other than "none", or name errors with a limit')
    return tuple(errors)


def _names_error(table: Sequence[Tolerance], error: str) -> bool:
    return any(entry.name and entry.covers(error) for entry in table)


def _face_errors(lens: Lens, table: Sequence[Tolerance]) -> Iterator[Perturbation]:
    """Yield form errors and ripple; form of the front only if the table names it, since it doubles the time."""
    for name in (*FORM, *RIPPLE):
        values, by_name = settings_of(table, name), _names_error(table, name)
        face = name.partition(".")[0]
        if values.get("grade") == NONE or face not in lens.passes.faces or not (by_name or face == BACK):
            continue
        if face == FRONT and not lens.shares_outline:
            continue  # the front is nearly vertical at its rim, where no net of heights has its form
        grade, cost = GRADES[values.get("grade", DEFAULT_GRADE)], values.get("cost", 1.0)
        try:
            if name in RIPPLE:
                kind = ripple(lens, values.get("period", grade.period), values.get("pattern", "spiral"))
                yield Perturbation(kind, values.get("limit", grade.ripple), values.get("distribution", "normal"), cost)
                continue
            length = values.get("correlation_length", grade.form_length * 2 * min(lens.outline.half_extent))
            size = values.get("limit", grade.form) / math.sqrt(FORM_MODES)
            for seed in range(FORM_MODES):
                yield Perturbation(form_error(lens, length, seed, face), size, "field", cost)
        except ValueError as error:  # the net is too coarse
            if by_name:
                raise SceneError(f"tolerance: {name}: {error}") from error
