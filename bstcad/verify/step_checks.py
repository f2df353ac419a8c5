"""Checks of the solid in a STEP file, read by OCC: lens.step and part.step against the design, or a file alone.

They run in a second process, because a damaged file may crash OCC.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from bstcad.analysis.shape import thickness_range
from bstcad.cad import mounting, solid_properties, step_reading
from bstcad.cad.solid_properties import WholePart
from bstcad.cad.step_reading import StatedFace, StatedSolid, StepLens
from bstcad.optics.lens.face_integrals import MassProperties
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import FRONT, LENS, Face, Passes
from bstcad.optics.surfaces.bspline import is_net, require_net
from bstcad.optics.surfaces.surfaces import Surface, points_and_normals
from bstcad.runs import processes
from bstcad.scene.mount import Mount, Part
from bstcad.step_text import part21
from bstcad.step_text.part21 import StepText
from bstcad.step_text.placement import Placement
from bstcad.verify import text_checks
from bstcad.verify.text_checks import net_check
from bstcad.verify.verdict import Check

NORMAL_TOLERANCE = 1e-9  # largest angle (rad) between written and designed normals
CURVATURE_TOLERANCE = 1e-12  # largest difference (1/mm) of written and designed curvature of the front
CONIC_TOLERANCE = 1e-9  # largest difference of sag (mm) due to the conic constant, which a flat front hardly defines
GAP_TOLERANCE = 5e-7  # largest gap (mm) at an edge or vertex, or between edge and face; shapes are exact to 1e-7 mm
PART_EDGE_TOLERANCE = 1e-6  # largest distance (mm) between edges of part.step and of the scene's part, exact to 1e-7 mm
PART_FILE = "part.step"


def one_sentence(work: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a job so that any error of OCC becomes a ValueError in one sentence; path: file or folder of the job."""

    @functools.wraps(work)
    def checked(path: Path, *arguments: Any, **options: Any) -> Any:
        try:
            return work(path, *arguments, **options)
        except (ValueError, OSError, MemoryError):
            raise
        except Exception as error:  # OCC has a hundred classes of errors without a common base
            name, kind = path.name if path.suffix else PART_FILE, type(error).__name__
            raise ValueError(f"{name}: OpenCASCADE finds the solid damaged ({kind}); write it again") from error

    return checked


@dataclass(frozen=True)
class ExaminedFile:
    """Checks and contents of a STEP file without a design."""

    checks: tuple[Check, ...]
    lens: Lens  # lens of the file, in its own frame, with an arbitrary refractive index
    whole: WholePart | None  # part around the lens; None: a bare lens
    placement: Placement  # placement of the lens's frame in the file


@one_sentence
def lens(path: Path, index: float, passes: Passes = LENS) -> Lens:
    """Read the lens of a STEP file; index, passes: properties that no file states.  ValueError if it has no lens."""
    return replace(step_reading.lens(_read(path, _stamp(path)), index), passes=passes)


@one_sentence
def check(path: Path, nominal: Lens, form: float, points: int) -> tuple[Check, ...]:
    """Check the solid in the STEP file of a design; ValueError if the file has no lens.

    form: tolerance (mm) of placement, tailored faces and front vertex; points: number of points per compared face.
    """
    reread = _read(path, _stamp(path))
    return (
        *_placement_checks(reread, form),
        *_solid_checks(reread.shape),
        *_face_checks(reread.stated, reread),
        *_edge_checks(reread, nominal),
        *(found for face in nominal.described_faces for found in _form_checks(reread, face, form, points)),
        *_front_checks(reread.front, nominal, form),
    )


@functools.lru_cache(maxsize=1)
def _read(path: Path, stamp: object) -> StepLens:
    """Read a file with OCC, and cache the result, because `lens` and `check` use the same file in turn.

    The second process, which may crash, reads the file while the first one reads its text.  Without a second process,
    the text is read first, to find damage.  stamp: changes if the file changes.
    """
    if not processes.is_second():
        part21.read_lens(path)
    return step_reading.read(path)


def _stamp(path: Path) -> tuple[int, int, int] | None:
    """Return inode, size and modification time of a file; None if it cannot be read (`_read` gives the reason)."""
    with contextlib.suppress(OSError):
        status = path.stat()
        return status.st_ino, status.st_size, status.st_mtime_ns
    return None


@one_sentence
def examine(path: Path) -> ExaminedFile:
    """Check a STEP file without a design: compare its readings by two readers, and its statements with its faces."""
    text = part21.read_lens(path, any_unit=True)  # first, because a damaged file may hang OCC
    reread = step_reading.read(path)
    lens_read, placed = step_reading.lens(reread, index=1.5), reread.placement
    properties = solid_properties.of_solid(reread.shape)
    name = "control points: difference between STEP text and OCC"
    checks = [
        *text_checks.structure_checks(text, lens_read.back_net.shape, any_unit=True),
        *_solid_checks(reread.shape),
        *_face_checks(reread.stated, reread),
        *_edge_checks(reread, lens_read, bare=reread.edge is None),
        net_check(name, text.surface.control_points, placed(reread.control_points), id="net-two-readers"),
    ]
    if text.front is not None:
        name = "control points of the front: difference between STEP text and OCC"
        own = lens_read.front_net.control_points() if lens_read.front.is_net else np.empty((0, 0, 3))
        checks.append(net_check(name, text.front.control_points, placed(own), id="net-two-readers"))
    thinnest = thickness_range(lens_read, reread.edge)[0]
    checks.append(Check.at_least("smallest thickness", thinnest, 0.0, "mm", id="thickness"))
    if properties is None:  # a face is of a kind that bstcad does not write
        name = "STEP text: area, volume and centroid can be computed from the faces"
        checks.append(Check(name, False, None, unit="", passed=True, id="measures-unknown"))
    else:
        from_definition = placed.inverse.after(text.placement)
        checks += text_checks.measure_checks(text.properties.moved(from_definition), properties, reread.outline)
    checks += text_checks.density_checks(text.properties)
    whole = solid_properties.whole_part(reread, properties)
    return ExaminedFile(tuple(checks), lens_read, whole, placed)


def _placement_checks(reread: StepLens, tolerance: float) -> Iterator[Check]:
    """Check the placement of the lens in the file of its design, if it is not the identity; tolerance: mm."""
    if reread.placement.moves:
        net, words = reread.control_points, reread.placement.words
        off = float(np.abs(reread.placement(net) - net).max())
        name = "form: placement of the lens in the file, largest shift of a control point"
        yield Check.at_most(name, off, tolerance, "mm", where=f"the lens is {words}", id="placement")


def _solid_checks(solid: Any, of_part: bool = False) -> Iterator[Check]:
    valid, prefix = (f"{PART_FILE}: solid is valid", PART_FILE) if of_part else ("solid: is valid", "solid")
    yield Check.true(valid, step_reading.is_valid(solid), id="solid-valid")
    name = f"{prefix}: largest gap at edges and vertices"
    yield Check.at_most(name, step_reading.gaps(solid), GAP_TOLERANCE, "mm", id="gaps")


def _face_checks(faces: Sequence[StatedFace], lens: StepLens | None, prefix: str = "solid") -> Iterator[Check]:
    """Check senses and names that the file states for its faces; lens: the lens with these faces (None: unreadable)."""
    wrong = [face.name for face in faces if not face.consistent]
    where = f"{len(wrong)} of {len(faces)} faces are reversed, first the face named '{wrong[0]}'" if wrong else ""
    yield Check.true(f"{prefix}: senses of the faces agree with their edges", not wrong, where, id="face-senses")
    if lens is not None:
        names = list(lens.faces)[::-1]
        quoted, own = " and ".join(f"'{name}'" for name in names), " and ".join(f"the {name}" for name in names)
        name = f"{prefix}: faces with the names {quoted} are {own}"
        yield Check.true(name, not lens.misnamed, lens.misnamed, id="face-names")


def _edge_checks(reread: StepLens, lens: Lens, bare: bool = True) -> Iterator[Check]:
    """Check the distance of edges from faces and, for a bare lens (no flange, no leaning walls), from its wall."""
    (faces, on_face), (wall, on_wall) = step_reading.edge_deviations(reread.shape, lens)
    name = "solid: distance of edges from the faces they bound"
    yield Check.at_most(name, faces, GAP_TOLERANCE, unit="mm", where=on_face, id="edges-off-faces")
    if bare and lens.shares_outline:
        name = "solid: distance of edges from the wall of the lens"
        yield Check.at_most(name, wall, GAP_TOLERANCE, unit="mm", where=on_wall, id="edges-off-wall")


def _form_checks(reread: StepLens, designed: Face, tolerance: float, count: int) -> Iterator[Check]:
    """Check a face, evaluated by OCC at `count` Sobol points: coordinates, within `tolerance` (mm), and normals."""
    of, face = designed.name, require_net(designed.surface)
    form = f"form: deviation of the {of} in the file from the designed one"
    in_file = reread.faces[of].surface
    if not is_net(in_file):
        yield Check.true(form, False, f"the file's {of} is not a net", id="form")
        return
    points = torch.quasirandom.SobolEngine(2, scramble=True, seed=1).draw(count, dtype=torch.float64)
    x, y = (low + p * (high - low) for p, (low, high) in zip(points.T, (face.x, face.y), strict=True))
    if in_file.kind != face.kind:
        yield Check.true(form, False, f"the file's {of} is no {face.kind} surface as designed", id="form")
        return
    scale = 1.0 if face.chart.flat else in_file.x[1] / face.x[1]  # a chart is read with another radius
    found, normals = step_reading.sample(reread, scale * x.numpy(), scale * y.numpy(), of=of)
    place, wanted = points_and_normals(face, x.numpy(), y.numpy())
    off = np.abs(found - place).max(axis=1)
    turned = np.linalg.norm(normals - wanted, axis=1)
    j, k = int(off.argmax()), int(turned.argmax())
    at_j, at_k = (f"at ({x[worst]:.4g}, {y[worst]:.4g}) mm" for worst in (j, k))
    yield Check.at_most(form, float(off[j]), tolerance, "mm", where=at_j, id="form")
    name = f"form: angle between normals of the {of} in the file and of the designed one"
    yield Check.at_most(name, float(turned[k]), NORMAL_TOLERANCE, "rad", where=at_k, id="normals")


def _front_checks(reread: Surface, lens: Lens, tolerance: float) -> Iterator[Check]:
    wanted, difference = lens.front, "difference from the designed one"
    name, off = f"form: vertex of the front, {difference}", abs(reread.z - lens.front_vertex)
    yield Check.at_most(name, off, tolerance, "mm", id="front-vertex")
    if is_net(wanted):
        net = reread.control_points() if is_net(reread) else np.empty(0)
        name = f"form: control points of the front, {difference}"
        yield net_check(name, net, wanted.control_points(), id="front-net")
        return
    curvature, constant = wanted.conic()
    found = (math.inf, math.inf) if reread.is_net else reread.conic()
    name = f"form: curvature of the front, {difference}"
    yield Check.at_most(name, abs(found[0] - curvature), CURVATURE_TOLERANCE, "1/mm", id="front-curvature")
    if constant:
        sag = abs(found[1] - constant) * abs(curvature) ** 3 * math.hypot(*lens.plan.farthest) ** 4 / 8
        name = f"form: sag at the rim due to the front's conic constant, {difference}"
        yield Check.at_most(name, sag, CONIC_TOLERANCE, "mm", id="front-conic")


# ---- part.step -----------------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=1)
def _part(path: Path, stamp: object) -> tuple[StepText, StatedSolid]:
    """Read the text of a part, then its solid by OCC; cached, because three jobs use them; stamp: see `_read`."""
    return part21.read_lens(path), step_reading.solid(path)


@functools.lru_cache(maxsize=1)
def _properties(path: Path, stamp: object) -> MassProperties | None:
    """Return area, volume and centroid of the solid of a part; cached, as in `_part`."""
    return solid_properties.of_solid(_part(path, stamp)[1].shape)


@functools.lru_cache(maxsize=1)
def _lens_in_part(path: Path, stamp: object) -> StepLens:
    """Read the lens of a part by OCC; cached, as in `_part`."""
    return step_reading.read(path, _part(path, stamp)[1])


@one_sentence
def whole_part(path: Path) -> tuple[Lens, WholePart | None]:
    """Read the lens of a part, with an arbitrary refractive index, and the part around it (None: a bare lens)."""
    reread = _lens_in_part(path, _stamp(path))
    return step_reading.lens(reread, index=1.5), solid_properties.whole_part(reread, _properties(path, _stamp(path)))


@one_sentence
def lens_of_part(folder: Path, designed: Lens, mount: Mount) -> Lens:
    """Read the lens of the part in a design's folder, in the scene's frame, with the clear apertures of its faces.

    Raises ValueError if there is no such part, or the edge of its back is no circle or rectangle about the axis.
    """
    path = folder / PART_FILE
    if not path.exists():
        raise ValueError(f"{PART_FILE}: is missing; generate the design again")
    text_checks.check_size(_part(path, _stamp(path))[0], designed, PART_FILE)
    reread, up = _lens_in_part(path, _stamp(path)), mount.origin(designed.front_vertex)
    front, back, clear = reread.front, reread.back, reread.clear
    chart, rim = designed.back.chart, clear[1]
    back, rim = back.in_chart(chart), back.chart.outline_in(chart, rim)
    bounded = designed.shares_outline or not front.level  # no edge bounds the light on the plane of a base
    clear = clear[0] if bounded else designed.apertures[0], rim
    front, back = front.moved(front.z + up), back.moved(back.z + up)
    return replace(designed, losses=None).with_front(front).with_back(back).with_clear(clear)


@one_sentence
def check_part(folder: Path, lens: Lens, mount: Mount, part: Part) -> tuple[Check, ...]:
    """Check the part in a design's folder; part: data that the file should state."""
    path = folder / PART_FILE
    try:
        wanted, why = mounting.part_of(lens, mount).solid.wrapped, "generate the design again"
    except ValueError as error:
        wanted, why = None, str(error)
    if not path.exists():
        return (Check.true(f"{PART_FILE}: written", False, why, id="part-written"),)
    try:
        text, (solid, faces) = _part(path, _stamp(path))
        text_checks.check_size(text, lens, PART_FILE)
    except ValueError as error:
        return (Check.true(f"{PART_FILE}: can be read", False, str(error), id="part-readable"),)
    reread = None
    with contextlib.suppress(ValueError):  # the check of the clear apertures gives the reason
        reread = _lens_in_part(path, _stamp(path))
    down = np.array([0.0, 0.0, mount.origin(lens.front_vertex)])
    net = lens.back_net.control_points() - down
    of_front = []
    if lens.is_tailored(FRONT):
        name, read = f"{PART_FILE}: deviation of the control points of the front", text_checks.net_of_front(text)
        of_front.append(net_check(name, read, lens.front_net.control_points() - down, id="control-points"))
    properties = _properties(path, _stamp(path)) if text.properties.of_shape else None
    if text.properties.of_shape and properties is None:  # a damaged face, which other checks find
        name = f"{PART_FILE}: area, volume and centroid can be computed from the faces"
        stated = iter([Check.true(name, False, "a face is of an unknown kind", id="measures-unknown")])
    else:
        stated = text_checks.measure_checks(text.properties, properties, lens.plan, PART_FILE)
    name = f"{PART_FILE}: deviation of the control points"
    return (
        *text_checks.structure_checks(text, lens.back_net.shape, PART_FILE),
        net_check(name, text.surface.control_points, net, id="control-points"),
        *of_front,
        *_solid_checks(solid, of_part=True),
        *_face_checks(faces, reread, PART_FILE),
        _part_edge_check(wanted, solid, why),
        *stated,
        *text_checks.part_checks(text, part, PART_FILE),
    )


def _part_edge_check(wanted: Any, reread: Any, why: str) -> Check:
    """Check the distance (mm) between edges of two solids; wanted: the scene's part, or None if not built (`why`)."""
    name = f"{PART_FILE}: distance of edges from the mount's"
    if wanted is None:
        return Check.true(name, False, why, id="part-edges")
    expected, found = (step_reading.points_on_edges(solid) for solid in (wanted, reread))
    missing, extra = cKDTree(found).query(expected)[0], cKDTree(expected).query(found)[0]
    worst, points = max((missing, expected), (extra, found), key=lambda pair: pair[0].max())
    where = "edge at ({:.4g}, {:.4g}, {:.4g}) mm".format(*points[worst.argmax()])
    return Check.at_most(name, float(worst.max()), PART_EDGE_TOLERANCE, unit="mm", where=where, id="part-edges")
