"""What a STEP file holds as a solid, read by OCC, against the design."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from bstcad.analysis.shape import thickness_range
from bstcad.cad import edges, solid_properties, step_reading, whole_part
from bstcad.cad.mass_properties import MassProperties
from bstcad.cad.step_reading import StepLens
from bstcad.cad.whole_part import WholePart
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import Surface
from bstcad.runs import worker
from bstcad.step_text import part21
from bstcad.verify import stated_checks, text_checks
from bstcad.verify.text_checks import NET, off_by
from bstcad.verify.verdict import Check

NORMAL = 1e-9  # rad
CURVATURE = 1e-12  # 1/mm
FLAT = 1e-9  # mm; a front so flat that all conics of its curvature are alike to this may be read back as another
BRIDGED = 5e-7  # mm; written with 1e-7


def lens(path: Path, index: float, reflects: bool = False) -> Lens:
    """The lens of a STEP file, which says neither its index nor whether it is a mirror; ValueError if it holds none."""
    return replace(step_reading.lens(_read(path, _stamp(path)), index), reflects=reflects)


def check(path: Path, nominal: Lens, form: float, points: int) -> tuple[Check, ...]:
    """The checks of the solid in the STEP file of a design; ValueError if it holds none.

    form: tolerance of the back face and of the front's vertex (mm); points: of the back at which it is looked at.
    """
    return tuple(_solid(_read(path, _stamp(path)), nominal, form, points))


@functools.lru_cache(maxsize=1)
def _read(path: Path, stamp: object) -> StepLens:
    """The file as OCC reads it; kept, since `lens` and `check` ask for the same one in turn.

    In the second process at once, while the first one looks whether the file is whole: it may end.
    """
    return step_reading.by_occ(path) if worker.is_second() else step_reading.read(path)


def _stamp(path: Path) -> object:
    """Another one for another file in the same place."""
    with contextlib.suppress(OSError):  # the reader will say what is wrong
        found = path.stat()
        return found.st_ino, found.st_size, found.st_mtime_ns
    return None


def examine(path: Path) -> tuple[list[Check], Lens, WholePart | None]:
    """Check a STEP file by itself; the lens it holds, of an index that does not matter, and what is around that.

    There is no design: it is asked what the file is, not what it was meant to be.
    """
    text, reread = part21.read_lens(path), step_reading.by_occ(path)
    found = step_reading.lens(reread, index=1.5)  # the index does not matter to the shape
    properties = solid_properties.of_solid(reread.shape)
    off, where = off_by(text.surface.control_points, reread.control_points, "control point")
    checks = [
        *text_checks.structure(text, found.back.m),
        Check.true("solid valid", step_reading.is_valid(reread.shape)),
        Check.at_most("solid: gaps that edges and vertices bridge", step_reading.gaps(reread.shape), BRIDGED, "mm"),
        *_edges(reread, found, bare=reread.edge is None),
        Check.at_most("STEP text against OCC: control points", off, NET, "mm", where),
        *_fronts(text, reread),
        Check.at_least("smallest thickness", thickness_range(found, reread.edge)[0], 0.0, "mm"),
        *_stated(text, reread, properties),
        *stated_checks.density(text.properties),
    ]
    return checks, found, whole_part.of(reread, properties)


def _stated(text: part21.StepText, reread: StepLens, found: MassProperties | None) -> Iterator[Check]:
    """What the file states of its area, volume and centroid, which it may of more than a lens."""
    if found is None:  # it has faces that no lens and no mount has
        yield Check("STEP text: what it states can be held to its faces", False, None, "", True)
    else:
        yield from stated_checks.measures(text.properties, found, reread.outline)


def _fronts(text: part21.StepText, reread: StepLens) -> Iterator[Check]:
    """The same for a freeform front."""
    if text.front is not None:
        off, where = off_by(text.front.control_points, reread.front.control_points(), "control point")
        yield Check.at_most("STEP text against OCC: control points of the front", off, NET, "mm", where)


def _solid(reread: StepLens, lens: Lens, tolerance: float, points: int) -> list[Check]:
    """The re-read solid, its faces evaluated by OCC."""
    (form, form_at), (normal, normal_at) = _form(reread, lens.back, points)
    vertex = abs(reread.front.z - lens.front.z)
    return [
        Check.true("solid valid", step_reading.is_valid(reread.shape)),
        Check.at_most("solid: gaps that edges and vertices bridge", step_reading.gaps(reread.shape), BRIDGED, "mm"),
        *_edges(reread, lens),
        Check.at_most("form: re-read back face against the optimised one", form, tolerance, "mm", form_at),
        Check.at_most("form: direction of the normals", normal, NORMAL, "rad", normal_at),
        Check.at_most("form: vertex of the front, difference from the designed one", vertex, tolerance, "mm"),
        *_front(reread.front, lens),
    ]


def _front(found: Surface, lens: Lens) -> Iterator[Check]:
    """The shape of the re-read front against the designed one."""
    wanted, from_designed = lens.front, "difference from the designed one"
    if wanted.curvature is None:
        same = found.curvature is None
        off, where = (
            off_by(found.control_points(), wanted.control_points(), "control point") if same else (math.inf, "")
        )
        yield Check.at_most(f"form: control points of the front, {from_designed}", off, NET, "mm", where)
        return
    off = math.inf if found.curvature is None else abs(found.curvature - wanted.curvature)
    yield Check.at_most(f"form: curvature of the front, {from_designed}", float(off), CURVATURE, "1/mm")
    if wanted.conic_constant:
        apart = math.inf if found.curvature is None else abs(found.conic_constant - wanted.conic_constant)
        rim = math.hypot(*lens.outline.farthest)
        sag = apart * abs(wanted.curvature) ** 3 * rim**4 / 8
        name = f"form: sag at the rim by the front's conic constant, {from_designed}"
        yield Check.at_most(name, float(sag), FLAT, "mm")


def _edges(reread: StepLens, lens: Lens, bare: bool = True) -> list[Check]:
    """bare: it is to be a lens and no more; the edges of a flange, or of walls that lean, lie elsewhere."""
    (faces, on_face), (rim, on_rim) = edges.off(reread.shape, lens)
    found = [Check.at_most("solid: edges off the faces they bound", faces, BRIDGED, "mm", on_face)]
    return (
        [*found, Check.at_most("solid: edges off the wall of the lens", rim, BRIDGED, "mm", on_rim)] if bare else found
    )


def _form(reread: StepLens, back: BSplineSurface, count: int) -> tuple[tuple[float, str], tuple[float, str]]:
    """Largest distance (mm) and angle between normals (rad) at `count` Sobol points, each with its place."""
    points = torch.quasirandom.SobolEngine(2, scramble=True, seed=1).draw(count, dtype=torch.float64)
    x, y = (low + p * (high - low) for p, (low, high) in zip(points.T, (back.x, back.y), strict=True))
    found = step_reading.sample(reread, x.numpy(), y.numpy())
    z, z_x, z_y = back.sag_and_slope(*(torch.from_numpy(found.points[:, i].copy()) for i in (0, 1)))
    wanted = torch.nn.functional.normalize(torch.stack([-z_x, -z_y, torch.ones_like(z)], dim=1), dim=1).numpy()
    off = np.abs(found.points - torch.stack([x, y, z], dim=1).numpy()).max(axis=1)
    turned = np.linalg.norm(found.normals - wanted, axis=1)
    worst = ((error, error.argmax()) for error in (off, turned))
    return tuple((float(error[k]), f"at ({x[k]:.4g}, {y[k]:.4g}) mm") for error, k in worst)
