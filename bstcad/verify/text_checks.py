"""What a STEP file says as text, read by a parser that is not OCC, against the design."""

from __future__ import annotations

import numpy as np

from bstcad.optics.lens import Lens
from bstcad.optics.spline_basis import knots
from bstcad.step_text import part21
from bstcad.verify.verdict import Check

NET = 1e-11  # mm; what sixteen digits of text leave of a control point


def structure(text: part21.StepText, m: int) -> list[Check]:
    """Structure of the STEP file, read without OCC."""
    faces = [(text.surface, m)] + ([(text.front, len(text.front.control_points))] if text.front else [])
    plain = all(_plain(surface, points) for surface, points in faces)
    degrees = ", ".join(
        "rational, " * surface.rational + f"degree {surface.degrees[0]} x {surface.degrees[1]}" for surface, _ in faces
    )
    moved, knot = max(
        (off_by(full, knots(points), "")[0], off_by(values, np.arange(points - 1.0), f"in {axis}: knot")[1])
        for surface, points in faces
        for axis, full, values in zip("uv", surface.full_knots, surface.knots, strict=True)
    )
    units = f"{text.solids} solids, lengths in {text.unit}"
    return [
        Check.true("STEP text: one solid, in millimetres", text.solids == 1 and text.unit == "millimetre", units),
        Check.true("STEP text: every edge used twice, once each way", text.closed, _open_edge(text)),
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


def of_lens(text: part21.StepText, lens: Lens) -> list[Check]:
    """The STEP file as text, held to the design."""
    off, where = off_by(text.surface.control_points, lens.back.control_points(), "control point")
    checks = [*structure(text, lens.back.m), Check.at_most("STEP text: control points", off, NET, "mm", where)]
    if text.front is not None and lens.front.curvature is None:
        off, where = off_by(text.front.control_points, lens.front.control_points(), "control point")
        checks.append(Check.at_most("STEP text: control points of the front", off, NET, "mm", where))
    return checks


def off_by(found: np.ndarray, wanted: np.ndarray, what: str) -> tuple[float, str]:
    """(largest absolute difference, where that is); infinite if the shapes differ."""
    if found.shape != wanted.shape:
        return float("inf"), f"{what}s: {' x '.join(map(str, found.shape))}, not {' x '.join(map(str, wanted.shape))}"
    apart = np.abs(found - wanted)
    place = [int(i) for i in np.unravel_index(apart.argmax(), apart.shape)]
    return float(apart.max()), f"{what} {place[0] if len(place) == 1 else tuple(place[:2])}"
