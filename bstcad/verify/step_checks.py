"""Checks of the solid in a STEP file, read by OCC: lens.step and part.step against the design, or a file by itself.

Called in a process of its own, since OCC may end it over a damaged file.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from bstcad.analysis.shape import thickness_range
from bstcad.cad import mounting, solid_properties, step_reading
from bstcad.cad.solid_properties import WholePart
from bstcad.cad.step_reading import StepLens
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.passes import LENS, Passes
from bstcad.optics.quadrature import MassProperties
from bstcad.optics.surfaces import Surface, sampled
from bstcad.runs import processes
from bstcad.scene.mount import Mount, Part
from bstcad.step_text import part21
from bstcad.step_text.part21 import StepText
from bstcad.step_text.placement import Placement
from bstcad.verify import text_checks
from bstcad.verify.text_checks import net_check
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


@dataclass(frozen=True)
class ExaminedFile:
    """A STEP file by itself."""

    checks: tuple[Check, ...]
    lens: Lens  # lens of the file, in its own frame; its index does not matter
    whole: WholePart | None  # the part around that lens; None: it is bare
    placement: Placement  # where the lens's frame lies in the file


@one_sentence
def lens(path: Path, index: float, passes: Passes = LENS) -> Lens:
    """The lens of a STEP file, which says neither its index nor the passes of light; ValueError if it holds none."""
    return replace(step_reading.lens(_read(path, _stamp(path)), index), way=passes)


@one_sentence
def check(path: Path, nominal: Lens, form: float, points: int) -> tuple[Check, ...]:
    """The checks of the solid in the STEP file of a design; ValueError if it holds none.

    form: tolerance of the tailored faces and of the front's vertex (mm); points: of a face at which it is compared.
    """
    reread = _read(path, _stamp(path))
    return (
        *_placed(reread, form),
        *_sound(reread.shape),
        *_edges(reread, nominal),
        *_form(reread, nominal.back, form, points),
        *(_form(reread, nominal.front, form, points, of="front") if nominal.shapes("front") else ()),
        *_front(reread.front, nominal, form),
    )


@functools.lru_cache(maxsize=1)
def _read(path: Path, stamp: object) -> StepLens:
    """The file as OCC reads it; kept, since `lens` and `check` ask for the same file in turn.

    In the second process at once, while the first one reads its text: it may end.  stamp: another for
    another file in the same place.
    """
    if not processes.is_second():
        part21.read_lens(path)
    return step_reading.read(path)


def _stamp(path: Path) -> tuple[int, int, int] | None:
    """A number of the file itself, its size and its time of change; None: `_read` says why there are none."""
    with contextlib.suppress(OSError):
        status = path.stat()
        return status.st_ino, status.st_size, status.st_mtime_ns
    return None


@one_sentence
def examine(path: Path) -> ExaminedFile:
    """Check a STEP file by itself, its text first: over a damaged one OCC may never end.

    There is no design to compare it with: the checks are whether its two readers, its text and its faces agree.
    """
    text, reread = part21.read_lens(path, any_unit=True), step_reading.read(path)
    lens_read, placed = step_reading.lens(reread, index=1.5), reread.placement
    properties = solid_properties.of_solid(reread.shape)
    checks = [
        *text_checks.structure(text, lens_read.back.shape, any_unit=True),
        *_sound(reread.shape),
        *_edges(reread, lens_read, bare=reread.edge is None),
        net_check(
            "STEP text against OCC: control points",
            text.surface.control_points,
            placed(reread.control_points),
            id="net-two-readers",
        ),
    ]
    if text.front is not None:
        name = "STEP text against OCC: control points of the front"
        own = reread.front.control_points() if reread.front.is_net else np.empty((0, 0, 3))
        checks.append(net_check(name, text.front.control_points, placed(own), id="net-two-readers"))
    thinnest = thickness_range(lens_read, reread.edge)[0]
    checks.append(Check.at_least("smallest thickness", thinnest, 0.0, "mm", id="thickness"))
    if properties is None:  # it has faces that no lens and no mount has
        name = "STEP text: what it states can be held to its faces"
        checks.append(Check(name, False, None, unit="", passed=True, id="measures-unknown"))
    else:
        from_definition = placed.inverse.after(text.placement)
        checks += text_checks.measures(text.properties.moved(from_definition), properties, reread.outline)
    checks += text_checks.density(text.properties)
    whole = solid_properties.whole_part(reread, properties)
    return ExaminedFile(tuple(checks), lens_read, whole, placed)


def _placed(reread: StepLens, tolerance: float) -> Iterator[Check]:
    """The placement of the lens in the file of its design, if it has one."""
    if reread.placement.moves:
        net, words = reread.control_points, reread.placement.words
        off = float(np.abs(reread.placement(net) - net).max())
        name = "form: placement of the lens in the file, largest shift of a control point"
        yield Check.at_most(name, off, tolerance, "mm", where=f"the lens is {words}", id="placement")


def _sound(solid: Any, of_part: bool = False) -> Iterator[Check]:
    valid, gaps = (f"{PART}: solid valid", f"{PART}: gaps") if of_part else ("solid valid", "solid: gaps")
    yield Check.true(valid, step_reading.is_valid(solid), id="solid-valid")
    name = f"{gaps} that edges and vertices bridge"
    yield Check.at_most(name, step_reading.gaps(solid), BRIDGED, "mm", id="gaps")


def _edges(reread: StepLens, lens: Lens, bare: bool = True) -> Iterator[Check]:
    """bare: it is to be a lens and no more; the edges of a flange, or of walls that lean, lie elsewhere."""
    (faces, on_face), (wall, on_wall) = step_reading.edges_off(reread.shape, lens)
    name = "solid: edges off the faces they bound"
    yield Check.at_most(name, faces, BRIDGED, unit="mm", where=on_face, id="edges-off-faces")
    if bare:
        name = "solid: edges off the wall of the lens"
        yield Check.at_most(name, wall, BRIDGED, unit="mm", where=on_wall, id="edges-off-wall")


def _form(
    reread: StepLens, face: BSplineSurface, tolerance: float, count: int, *, of: str = "back"
) -> Iterator[Check]:  # fmt: skip
    """Distances (mm) and angles between normals (rad) of a face at `count` Sobol points, evaluated by OCC."""
    which, turns = ("front", "the front's normals") if of == "front" else ("back", "the normals")
    form = f"form: re-read {which} face against the optimised one"
    if of == "front" and not reread.front.is_net:
        yield Check.true(form, False, "the file's front is no net", id="form")
        return
    points = torch.quasirandom.SobolEngine(2, scramble=True, seed=1).draw(count, dtype=torch.float64)
    x, y = (low + p * (high - low) for p, (low, high) in zip(points.T, (face.x, face.y), strict=True))
    found, normals = step_reading.sample(reread, x.numpy(), y.numpy(), of=of)
    z, z_x, z_y = sampled(face, *found[:, :2].T)
    wanted = np.stack([-z_x, -z_y, np.ones_like(z)], axis=1)
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    off = np.abs(found - np.stack([x.numpy(), y.numpy(), z], axis=1)).max(axis=1)
    turned = np.linalg.norm(normals - wanted, axis=1)
    j, k = int(off.argmax()), int(turned.argmax())
    at_j, at_k = (f"at ({x[worst]:.4g}, {y[worst]:.4g}) mm" for worst in (j, k))
    yield Check.at_most(form, float(off[j]), tolerance, "mm", where=at_j, id="form")
    yield Check.at_most(f"form: direction of {turns}", float(turned[k]), NORMAL, "rad", where=at_k, id="normals")


def _front(reread: Surface, lens: Lens, tolerance: float) -> Iterator[Check]:
    """The re-read front against the designed one."""
    wanted, difference = lens.front, "difference from the designed one"
    name, off = f"form: vertex of the front, {difference}", abs(reread.z - lens.front_vertex)
    yield Check.at_most(name, off, tolerance, "mm", id="front-vertex")
    if wanted.is_net:
        net = reread.control_points() if reread.is_net else np.empty(0)
        name = f"form: control points of the front, {difference}"
        yield net_check(name, net, wanted.control_points(), id="front-net")
        return
    curvature, constant = wanted.conic()
    found = (math.inf, math.inf) if reread.is_net else reread.conic()
    name = f"form: curvature of the front, {difference}"
    yield Check.at_most(name, abs(found[0] - curvature), CURVATURE, "1/mm", id="front-curvature")
    if constant:
        sag = abs(found[1] - constant) * abs(curvature) ** 3 * math.hypot(*lens.outline.farthest) ** 4 / 8
        name = f"form: sag at the rim by the front's conic constant, {difference}"
        yield Check.at_most(name, sag, FLAT, "mm", id="front-conic")


# ---- part.step -----------------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=1)
def _part(path: Path, stamp: object) -> tuple[StepText, Any]:
    """The text of a part and, if that is not damaged, its solid by OCC; kept, since three works ask for them in turn.

    stamp: as of `_read`.
    """
    return part21.read_lens(path), step_reading.solid(path)


@functools.lru_cache(maxsize=1)
def _properties(path: Path, stamp: object) -> MassProperties | None:
    """Area, volume and centroid of the solid of a part."""
    return solid_properties.of_solid(_part(path, stamp)[1])


@one_sentence
def whole_part(path: Path) -> tuple[Lens, WholePart | None]:
    """The lens of a part, whose index does not matter, and the walls around it."""
    reread = step_reading.read(path, _part(path, _stamp(path))[1])
    return step_reading.lens(reread, index=1.5), solid_properties.whole_part(reread, _properties(path, _stamp(path)))


@one_sentence
def lens_of_part(folder: Path, designed: Lens, mount: Mount) -> Lens:
    """The lens of the part in a design's folder, in the scene's frame, with the clear apertures of the part's faces.

    ValueError if there is no such part, or its faces have other edges than a mount's.
    """
    path = folder / PART
    if not path.exists():
        raise ValueError(f"{PART}: is not there")
    reread, up = step_reading.read(path, _part(path, _stamp(path))[1]), mount.origin(designed.front_vertex)
    front, back = (face.moved(face.z + up) for face in (reread.front, reread.back))
    return replace(designed, front=front, back=back, clear=reread.clear, losses=None)


@one_sentence
def check_part(folder: Path, lens: Lens, mount: Mount, part: Part) -> tuple[Check, ...]:
    """The checks of the part in a design's folder; part: whose facts the file should state."""
    path = folder / PART
    try:
        wanted, why = mounting.part_of(lens, mount).solid.wrapped, "generate the design again"
    except ValueError as error:
        wanted, why = None, str(error)
    if not path.exists():
        return (Check.true(f"{PART}: written", False, why, id="part-written"),)
    try:
        text, solid = _part(path, _stamp(path))
    except ValueError as error:
        return (Check.true(f"{PART}: can be read", False, str(error), id="part-readable"),)
    down = np.array([0.0, 0.0, mount.origin(lens.front_vertex)])
    net = lens.back.control_points() - down
    of_front = ()
    if lens.shapes("front"):
        name, held = f"{PART}: control points of the front", text_checks.net_of_front(text)
        of_front = (net_check(name, held, lens.front.control_points() - down, id="control-points"),)
    properties = _properties(path, _stamp(path)) if text.properties.of_shape else None
    if text.properties.of_shape and properties is None:  # of a damaged face, which other checks find
        name, strange = f"{PART}: area, volume and centroid can be found", "a face is of an unknown kind"
        stated = [Check.true(name, False, strange, id="measures-unknown")]
    else:
        stated = text_checks.measures(text.properties, properties, lens.outline, PART)
    return (
        *text_checks.structure(text, lens.back.shape, PART),
        net_check(f"{PART}: control points", text.surface.control_points, net, id="control-points"),
        *of_front,
        *_sound(solid, of_part=True),
        _edges_moved(wanted, solid, why),
        *stated,
        *text_checks.of_part(text, part, PART),
    )


def _edges_moved(wanted: Any, reread: Any, why: str) -> Check:
    """The largest distance (mm) between an edge of one solid and those of the other; why: there is none wanted."""
    name = f"{PART}: edges against the mount's"
    if wanted is None:
        return Check.true(name, False, why, id="part-edges")
    there, here = (step_reading.along_edges(solid) for solid in (wanted, reread))
    missing, strange = cKDTree(here).query(there)[0], cKDTree(there).query(here)[0]
    worst, places = max((missing, there), (strange, here), key=lambda pair: pair[0].max())
    where = "edge at ({:.4g}, {:.4g}, {:.4g}) mm".format(*places[worst.argmax()])
    return Check.at_most(name, float(worst.max()), MOVED, unit="mm", where=where, id="part-edges")
