"""Checks of the solid in a STEP file, read by OCC: lens.step and part.step against the design, or a file by itself.

Called in a process of its own, since OCC may end it over a damaged file.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bstcad.analysis.shape import thickness_range
from bstcad.cad import mounted_part, solid_edges, solid_properties, step_reading
from bstcad.cad.mass_properties import MassProperties
from bstcad.cad.solid_properties import WholePart
from bstcad.cad.step_reading import StepLens
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import Surface
from bstcad.runs import processes
from bstcad.scene.mount import Mount
from bstcad.scene.part import Part
from bstcad.step_text import part21
from bstcad.verify import text_checks
from bstcad.verify.text_checks import NET, off_by
from bstcad.verify.verdict import Check

NORMAL = 1e-9  # rad
CURVATURE = 1e-12  # 1/mm
FLAT = 1e-9  # mm; a front so flat that all conics of its curvature are alike to this may be read back as another
BRIDGED = 5e-7  # mm; written with 1e-7
MOVED = 1e-6  # mm, of an edge of a part; written with 1e-7
PART = "part.step"


def one_sentence(work: Callable[..., Any]) -> Callable[..., Any]:
    """Whatever OCC raises over a damaged solid is a ValueError in one sentence; path: of the file or its folder."""

    @functools.wraps(work)
    def asked(path: Path, *arguments: Any, **options: Any) -> Any:
        try:
            return work(path, *arguments, **options)
        except (ValueError, OSError, MemoryError):
            raise
        except Exception as error:  # OCC has a hundred kinds, which do not all descend from one
            name, kind = path.name if path.suffix else PART, type(error).__name__
            raise ValueError(f"{name}: read by OCC: the solid is damaged ({kind}); write it again") from error

    return asked


@one_sentence
def lens(path: Path, index: float, reflects: bool = False) -> Lens:
    """The lens of a STEP file, which says neither its index nor whether it is a mirror; ValueError if it holds none."""
    return replace(step_reading.lens(_read(path, _stamp(path)), index), reflects=reflects)


@one_sentence
def check(path: Path, nominal: Lens, form: float, points: int) -> tuple[Check, ...]:
    """The checks of the solid in the STEP file of a design; ValueError if it holds none.

    form: tolerance of the back face and of the front's vertex (mm); points: of the back at which it is looked at.
    """
    return tuple(_solid(_read(path, _stamp(path)), nominal, form, points))


@functools.lru_cache(maxsize=1)
def _read(path: Path, stamp: object) -> StepLens:
    """The file as OCC reads it; kept, since `lens` and `check` ask for the same file in turn.

    In the second process at once, while the first one reads its text: it may end.
    """
    if not processes.is_second():
        part21.read_lens(path)
    return step_reading.read(path)


def _stamp(path: Path) -> object:
    """Another one for another file in the same place."""
    with contextlib.suppress(OSError):  # the reader will say what is wrong
        status = path.stat()
        return status.st_ino, status.st_size, status.st_mtime_ns
    return None


@one_sentence
def examine(path: Path) -> tuple[list[Check], Lens, WholePart | None]:
    """Check a STEP file by itself; the lens it holds, of an index that does not matter, and what is around that.

    There is no design: it is asked what the file is, not what it was meant to be.
    """
    text, reread = part21.read_lens(path), step_reading.read(path)
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
        *text_checks.density(text.properties),
    ]
    return checks, found, solid_properties.whole_part(reread, properties)


def _stated(text: part21.StepText, reread: StepLens, found: MassProperties | None) -> Iterator[Check]:
    """What the file states of its area, volume and centroid, which it may of more than a lens."""
    if found is None:  # it has faces that no lens and no mount has
        yield Check("STEP text: what it states can be held to its faces", False, None, "", True)
    else:
        yield from text_checks.measures(text.properties, found, reread.outline)


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
    (faces, on_face), (rim, on_rim) = solid_edges.off(reread.shape, lens)
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


# ---- part.step ------------------------------------------------------------------------------------------------------


@one_sentence
def lens_of_part(folder: Path, designed: Lens, mount: Mount) -> Lens:
    """The lens of the part in a design's folder, in the scene's frame, with the clear apertures of the part's faces.

    ValueError if there is no such part, or its faces have other edges than a mount's.
    """
    path = folder / PART
    if not path.exists():
        raise ValueError(f"{PART}: is not there")
    reread = step_reading.read(path)
    found, up = step_reading.lens(reread, designed.index), mounted_part.origin(designed, mount)
    front, back = (face.moved(face.z + up) for face in (found.front, found.back))
    return replace(designed, front=front, back=back, clear=reread.clear, losses=None)


@one_sentence
def check_part(folder: Path, lens: Lens, mount: Mount, part: Part) -> tuple[Check, ...]:
    """The checks of the part in a design's folder; part: what it should state besides the shape."""
    path = folder / PART
    if not path.exists():
        return (Check.true(f"{PART}: written", False, mounted_part.misfit(lens, mount) or "generate the design again"),)
    try:
        text, solid = part21.read_lens(path), step_reading.solid(path)
    except ValueError as error:
        return (Check.true(f"{PART}: can be read", False, str(error)),)
    down = np.array([0.0, 0.0, mounted_part.origin(lens, mount)])
    off, where = off_by(text.surface.control_points, lens.back.control_points() - down, "control point")
    return (
        *(
            replace(each, name=each.name.replace("STEP text", PART, 1))
            for each in text_checks.structure(text, lens.back.m)
        ),
        Check.at_most(f"{PART}: control points", off, NET, "mm", where),
        Check.true(f"{PART}: solid valid", step_reading.is_valid(solid)),
        Check.at_most(f"{PART}: gaps that edges and vertices bridge", step_reading.gaps(solid), BRIDGED, "mm"),
        _as_mounted(solid, lens, mount),
        *_stated_of_part(text, solid, lens, part),
    )


def _as_mounted(solid: Any, lens: Lens, mount: Mount) -> Check:
    """Is it the part of this mount?  Its edges against those of the part built anew."""
    name = f"{PART}: edges against the mount's"
    try:
        off, where = mounted_part.off(lens, mount, solid)
    except ValueError as error:
        return Check.true(name, False, str(error))
    return Check.at_most(name, off, MOVED, "mm", where)


def _stated_of_part(text: part21.StepText, solid: Any, lens: Lens, part: Part) -> Iterator[Check]:
    """What the file states; a damaged face, which other checks find, has no integral, nor have walls that lean."""
    found = solid_properties.of_solid(solid) if text.properties.of_shape else None
    if text.properties.of_shape and found is None:
        yield Check.true(f"{PART}: area, volume and centroid can be found", False, "a face is of an unknown kind")
    else:
        yield from text_checks.measures(text.properties, found, lens.outline, PART)
    yield from text_checks.of_part(text, part, PART)
