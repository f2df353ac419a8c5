"""What a STEP file holds: read as text by a parser that is not OCC, and as a solid by OCC, against the design."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from bstcad.analysis.shape import describe
from bstcad.cad import edges, step_reading
from bstcad.cad.step_reading import StepLens
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.spline_basis import knots
from bstcad.optics.surfaces import Surface
from bstcad.step_text import part21
from bstcad.verify.verdict import Check

NET = 1e-11  # mm; what sixteen digits of text leave of a control point
NORMAL = 1e-9  # rad
CURVATURE = 1e-12  # 1/mm
FLAT = 1e-9  # mm; a front so flat that all conics of its curvature are alike to this may be read back as another
BRIDGED = 5e-7  # mm; written with 1e-7


def lens(path: Path, index: float, reflects: bool = False) -> Lens:
    """The lens of a STEP file, which says neither its index nor whether it is a mirror; ValueError if it holds none."""
    return replace(step_reading.lens(_read(path, _stamp(path)), index), reflects=reflects)


def check(path: Path, nominal: Lens, form: float, points: int) -> tuple[Check, ...]:
    """The checks of the STEP file of a design; ValueError if it holds no lens.

    form: tolerance of the back face and of the front's vertex (mm); points: of the back at which it is looked at.
    """
    reread = _read(path, _stamp(path))
    return (*_file(reread.text, nominal), *_solid(reread, nominal, form, points))


@functools.lru_cache(maxsize=1)
def _read(path: Path, stamp: object) -> StepLens:
    """The file as OCC reads it; kept, since `lens` and `check` ask for the same one in turn."""
    return step_reading.read(path)


def _stamp(path: Path) -> object:
    """Another one for another file in the same place."""
    with contextlib.suppress(OSError):  # the reader will say what is wrong
        found = path.stat()
        return found.st_ino, found.st_size, found.st_mtime_ns
    return None


def examine(path: Path) -> tuple[list[Check], Lens]:
    """Check a STEP file by itself, and the lens it holds, of an index that does not matter: there is no design."""
    reread = step_reading.read(path)
    text = reread.text
    found = step_reading.lens(reread, index=1.5)  # the index does not matter to the shape
    off, where = _off(text.surface.control_points, reread.control_points, "control point")
    checks = [
        *_text(text, found.back.m),
        Check.true("solid valid", step_reading.is_valid(reread)),
        Check.at_most("solid: gaps that edges and vertices bridge", step_reading.tolerance(reread), BRIDGED, "mm"),
        *_edges(reread, found),
        Check.at_most("STEP text against OCC: control points", off, NET, "mm", where),
        *_fronts(text, reread),
        Check.at_least("smallest thickness", describe(found)["thickness_min"], 0.0, "mm"),
    ]
    return checks, found


def _fronts(text: part21.StepText, reread: StepLens) -> Iterator[Check]:
    """The same for a freeform front."""
    if text.front is not None:
        off, where = _off(text.front.control_points, reread.front.control_points(), "control point")
        yield Check.at_most("STEP text against OCC: control points of the front", off, NET, "mm", where)


def _text(text: part21.StepText, m: int) -> list[Check]:
    """Structure of the STEP file, read without OCC."""
    faces = [(text.surface, m)] + ([(text.front, len(text.front.control_points))] if text.front else [])
    plain = all(_plain(surface, points) for surface, points in faces)
    degrees = ", ".join(
        "rational, " * surface.rational + f"degree {surface.degrees[0]} x {surface.degrees[1]}" for surface, _ in faces
    )
    moved, knot = max(
        (_off(full, knots(points), "")[0], _off(values, np.arange(points - 1.0), f"in {axis}: knot")[1])
        for surface, points in faces
        for axis, full, values in zip("uv", surface.full_knots, surface.knots, strict=True)
    )
    units = f"{text.solids} solids, lengths in {text.unit}"
    return [
        Check.true("STEP text: one solid, in millimetres", text.solids == 1 and text.unit == "millimetre", units),
        Check.true("STEP text: every edge used twice, once each way", text.closed, _open_edge(text)),
        Check.true(
            "STEP text: faces look outwards, edges and loops run on", not text.turned, ", ".join(text.turned[:5])
        ),
        Check.true("STEP text: degree 2 x 2, multiplicities 3, 1, …, 1, 3", plain, degrees),
        Check.at_most("STEP text: knots", moved, 0.0, where=knot),
    ]


def _plain(surface: part21.FreeformSurface, m: int) -> bool:
    """Is it an open surface of degree 2 x 2 with simple inner knots, and not rational?"""
    ones = np.array([3, *[1] * (m - 3), 3])
    simple = all(np.array_equal(counts, ones) for counts in surface.multiplicities)
    open_ = surface.closed == (False, False) and not surface.self_intersecting
    return surface.degrees == (2, 2) and not surface.rational and simple and open_


def _open_edge(text: part21.StepText) -> str:
    """The first edge that is not used once each way."""
    uses = ((name, there, back) for name, (there, back) in text.edge_uses.items() if (there, back) != (1, 1))
    return next((f"edge #{n}: {there} times forwards, {back} times back" for n, there, back in uses), "no edge")


def _file(text: part21.StepText, lens: Lens) -> list[Check]:
    """The STEP file as text, held to the design."""
    off, where = _off(text.surface.control_points, lens.back.control_points(), "control point")
    checks = [*_text(text, lens.back.m), Check.at_most("STEP text: control points", off, NET, "mm", where)]
    if text.front is not None and lens.front.curvature is None:
        off, where = _off(text.front.control_points, lens.front.control_points(), "control point")
        checks.append(Check.at_most("STEP text: control points of the front", off, NET, "mm", where))
    return checks


def _off(found: np.ndarray, wanted: np.ndarray, what: str) -> tuple[float, str]:
    """(largest absolute difference, where that is); infinite if the shapes differ."""
    if found.shape != wanted.shape:
        return float("inf"), f"{what}s: {' x '.join(map(str, found.shape))}, not {' x '.join(map(str, wanted.shape))}"
    apart = np.abs(found - wanted)
    place = [int(i) for i in np.unravel_index(apart.argmax(), apart.shape)]
    return float(apart.max()), f"{what} {place[0] if len(place) == 1 else tuple(place[:2])}"


def _solid(reread: StepLens, lens: Lens, tolerance: float, points: int) -> list[Check]:
    """The re-read solid, its faces evaluated by OCC."""
    (form, form_at), (normal, normal_at) = _form(reread, lens.back, points)
    vertex = abs(reread.front.z - lens.front.z)
    return [
        Check.true("solid valid", step_reading.is_valid(reread)),
        Check.at_most("solid: gaps that edges and vertices bridge", step_reading.tolerance(reread), BRIDGED, "mm"),
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
        off, where = _off(found.control_points(), wanted.control_points(), "control point") if same else (math.inf, "")
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


def _edges(reread: StepLens, lens: Lens) -> list[Check]:
    (faces, on_face), (rim, on_rim) = edges.off(reread.shape, lens)
    return [
        Check.at_most("solid: edges off the faces they bound", faces, BRIDGED, "mm", on_face),
        Check.at_most("solid: edges off the wall of the lens", rim, BRIDGED, "mm", on_rim),
    ]


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
