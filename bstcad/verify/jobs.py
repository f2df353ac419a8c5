"""Jobs of OCC for the second process: functions whose import does not load OCC in the process that submits them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bstcad.optics.lens.face_integrals import MassProperties
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import Passes
from bstcad.scene.mount import Mount, Part
from bstcad.verify.verdict import Check

if TYPE_CHECKING:
    from bstcad.verify.step_checks import ExaminedFile


def write_lens(lens: Lens, path: Path, name: str, part: Part, properties: MassProperties) -> None:
    """Write lens.step (step_writing.write_lens)."""
    from bstcad.cad import step_writing

    step_writing.write_lens(lens, path, name, part, properties=properties)


def write_part(lens: Lens, mount: Mount, path: Path, name: str, facts: Part) -> None:
    """Write part.step, if it can be built (mounting.write_if_it_fits)."""
    from bstcad.cad import mounting

    mounting.write_if_it_fits(lens, mount, path, name, facts=facts)


def read_lens(path: Path, index: float, passes: Passes) -> Lens:
    """Read the lens of lens.step (step_checks.lens)."""
    from bstcad.verify import step_checks

    return step_checks.lens(path, index, passes)


def read_lens_of_part(folder: Path, designed: Lens, mount: Mount) -> Lens:
    """Read the lens of part.step (step_checks.lens_of_part)."""
    from bstcad.verify import step_checks

    return step_checks.lens_of_part(folder, designed, mount)


def check_lens(path: Path, nominal: Lens, form: float, points: int) -> tuple[Check, ...]:
    """Check the solid of lens.step (step_checks.check)."""
    from bstcad.verify import step_checks

    return step_checks.check(path, nominal, form, points)


def check_part(folder: Path, lens: Lens, mount: Mount, part: Part) -> tuple[Check, ...]:
    """Check the solid of part.step (step_checks.check_part)."""
    from bstcad.verify import step_checks

    return step_checks.check_part(folder, lens, mount, part)


def examine(path: Path) -> ExaminedFile:
    """Check a STEP file without a design (step_checks.examine)."""
    from bstcad.verify import step_checks

    return step_checks.examine(path)
