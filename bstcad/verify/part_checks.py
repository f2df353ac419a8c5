"""What part.step holds, the lens in its mount, against the design."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bstcad.cad import mounted_part, solid_properties, step_reading
from bstcad.optics.lens import Lens
from bstcad.scene.mount import Mount
from bstcad.scene.part import Part
from bstcad.step_text import part21
from bstcad.verify import stated_checks, text_checks
from bstcad.verify.text_checks import NET, off_by
from bstcad.verify.verdict import Check

BRIDGED = 5e-7  # mm; written with 1e-7
MOVED = 1e-6  # mm, of an edge; written with 1e-7
NAME = "part.step"


def lens(folder: Path, designed: Lens, mount: Mount) -> Lens:
    """The lens of the part in a design's folder, in the scene's frame, with the clear apertures of the part's faces.

    ValueError if there is no such part, or its faces have other edges than a mount's.
    """
    path = folder / NAME
    if not path.exists():
        raise ValueError(f"{NAME}: is not there")
    reread = step_reading.read(path)
    found, up = step_reading.lens(reread, designed.index), mounted_part.origin(designed, mount)
    front, back = (face.moved(face.z + up) for face in (found.front, found.back))
    return replace(designed, front=front, back=back, clear=reread.clear, losses=None)


def check(folder: Path, lens: Lens, mount: Mount, part: Part) -> tuple[Check, ...]:
    """The checks of the part in a design's folder; part: what it should state besides the shape."""
    path = folder / NAME
    if not path.exists():
        return (Check.true(f"{NAME}: written", False, mounted_part.misfit(lens, mount) or "generate the design again"),)
    try:
        text, solid = part21.read_lens(path), step_reading.solid(path)
    except ValueError as error:
        return (Check.true(f"{NAME}: can be read", False, str(error)),)
    down = np.array([0.0, 0.0, mounted_part.origin(lens, mount)])
    off, where = off_by(text.surface.control_points, lens.back.control_points() - down, "control point")
    return (
        *(
            replace(each, name=each.name.replace("STEP text", NAME, 1))
            for each in text_checks.structure(text, lens.back.m)
        ),
        Check.at_most(f"{NAME}: control points", off, NET, "mm", where),
        Check.true(f"{NAME}: solid valid", step_reading.is_valid(solid)),
        Check.at_most(f"{NAME}: gaps that edges and vertices bridge", step_reading.gaps(solid), BRIDGED, "mm"),
        _as_mounted(solid, lens, mount),
        *_stated(text, solid, lens, part),
    )


def _as_mounted(solid: Any, lens: Lens, mount: Mount) -> Check:
    """Is it the part of this mount?  Its edges against those of the part built anew."""
    name = f"{NAME}: edges against the mount's"
    try:
        off, where = mounted_part.off(lens, mount, solid)
    except ValueError as error:
        return Check.true(name, False, str(error))
    return Check.at_most(name, off, MOVED, "mm", where)


def _stated(text: part21.StepText, solid: Any, lens: Lens, part: Part) -> Iterator[Check]:
    """What the file states; a damaged face, which other checks find, has no integral, nor have walls that lean."""
    found = solid_properties.of_solid(solid) if text.properties.of_shape else None
    if text.properties.of_shape and found is None:
        yield Check.true(f"{NAME}: area, volume and centroid can be found", False, "a face is of an unknown kind")
    else:
        yield from stated_checks.measures(text.properties, found, lens.outline, NAME)
    yield from stated_checks.of_part(text, part, NAME)
