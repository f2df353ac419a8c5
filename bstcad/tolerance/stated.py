"""Which errors a setup has, and how large they are: of a grade, and as the scene's [[tolerance]] tables say."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from bstcad.optics.lens import Lens
from bstcad.scene.errors import SceneError
from bstcad.scene.tolerance import FORM, NONE, RIPPLE, Tolerance, said_of
from bstcad.tolerance.grades import GRADES, USUAL, limit
from bstcad.tolerance.kinds import Kind, form_error, kinds, ripple
from bstcad.tolerance.perturbation import Perturbation
from bstcad.tolerance.setup import Setup

MODES = 3  # independent fields that the form error of a trial is mixed of, normal in their amounts
Table = Sequence[Tolerance]


def whole_table(table: Table, grade: str | None = None) -> tuple[Tolerance, ...]:
    """The tables of a scene behind the grade from which they start; `grade` goes before what they say of all errors."""
    if grade is None:
        return Tolerance(grade=USUAL), *table
    if grade not in GRADES:
        raise SceneError(f"--grade {grade}: there is no such grade; give one of {', '.join(GRADES)}")
    named = (e if e.name else e.model_copy(update={"grade": None}) for e in table)
    return Tolerance(grade=grade), *named


def start_of(table: Table) -> str:
    """The grade of all errors that a whole table says nothing else of; "none": they cannot be off."""
    return said_of([entry for entry in table if entry.name is None], "")["grade"]


def perturbations(setup: Setup, table: Table, material: str | None = None) -> tuple[Perturbation, ...]:
    """All that can be off in the setup by a whole table.

    What the lens's net is too coarse for is left out, unless the table names it.  Raises SceneError, in a sentence, for
    what it says of errors that there are not.
    """
    found = [
        Perturbation(kind, size, said.get("distribution", "normal"), said.get("cost", 1.0))
        for kind in kinds(setup, material).values()
        if (size := _limit(kind, setup, said := said_of(table, kind.name)))
    ]
    found += _of_the_faces(setup, table)
    for k, entry in enumerate(table[1:]):
        if entry.name and not _none(table, entry.name) and not any(entry.covers(p.kind.name) for p in found):
            raise SceneError(
                f"tolerance[{k}].name: {entry.name!r} changes nothing here, or the scene does not say by how much "
                "(a lens.material does, of temperature and wavelength); remove that table"
            )
    if not found:
        raise SceneError('tolerance: nothing can be off; give a grade other than "none", or name errors with a limit')
    return tuple(found)


def _none(table: Table, error: str) -> bool:
    return said_of(table, error).get("grade") == NONE


def _limit(kind: Kind, setup: Setup, said: Mapping[str, Any]) -> float | None:
    """± of an error; None: it cannot be off."""
    if "limit" in said:
        return said["limit"]
    return None if said["grade"] == NONE else limit(kind, GRADES[said["grade"]], setup)


def _of_the_faces(setup: Setup, table: Table) -> Iterator[Perturbation]:
    """Form errors and ripple; of the front if the table names it: that takes twice as long to trace."""
    for name in (*FORM, *RIPPLE):
        face, by_name = name.partition(".")[0], any(entry.name == name for entry in table)
        if _none(table, name) or (face == "front" and (setup.lens.reflects or not by_name)):
            continue
        try:
            yield from (_form if name in FORM else _ripple)(setup.lens, face, said_of(table, name))
        except ValueError as error:  # finer than the net
            if by_name:
                raise SceneError(f"tolerance: {name}: {error}") from error


def _form(lens: Lens, face: str, said: Mapping[str, Any]) -> list[Perturbation]:
    grade = GRADES[said.get("grade", USUAL)]
    length = said.get("correlation_length", grade.form_length * 2 * min(lens.outline.half_extent))
    size = said.get("limit", grade.form) / math.sqrt(MODES)
    fields = [form_error(lens, length, seed, face) for seed in range(MODES)]
    return [Perturbation(kind, size, "field", said.get("cost", 1.0)) for kind in fields]


def _ripple(lens: Lens, face: str, said: Mapping[str, Any]) -> list[Perturbation]:
    grade = GRADES[said.get("grade", USUAL)]
    kind = ripple(lens, said.get("period", grade.period), said.get("pattern", "spiral"))
    size = said.get("limit", grade.ripple)
    return [Perturbation(kind, size, said.get("distribution", "normal"), said.get("cost", 1.0))]
