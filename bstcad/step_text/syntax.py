"""Is the text of a STEP file whole?  Asked before OCC reads it: some files that are not whole end the process there.

Part 21 in four questions: is each statement an entity, is each attribute a token of the language, does each reference
lead to an entity of the kind that geometry and topology need there, and does each spline have the knots it asks for?
The points in space, nearly all of a file, are taken out of it first and asked for by name.

Every pattern here takes a time in proportion to the text, whatever stands there: what repeats ends at a character that
it cannot hold, and statements are cut apart before they are matched.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Set
from dataclasses import dataclass

import numpy as np

from bstcad.step_text import space_points

DEEPEST = 16  # lists in one another; a lens has four
FARTHEST = 1e12  # of a point; a target may be 1e8 mm away
HIGHEST = 25  # degree of a spline; OCC goes no further
NAME = r"[1-9]\d{0,17}"  # an entity's number: one of 64 bits
REAL = r"[-+]?\d+\.\d*(?:E[-+]?\d+)?"
NUMBER = rf"(?:{REAL}|[-+]?\d{{1,18}})"
NUMBERS = rf"{NUMBER}(?:,{NUMBER})*"
COUNTS = r"\d{1,9}(?:,\d{1,9})*"
NO_TOKEN = re.compile(
    rf"[(,](?!(?:#{NAME}|{NUMBER}|\.\w+\.|[*$]|''|)[,)]|\(|[A-Z][A-Z_0-9]*\()[^,)]*|\)(?![,);A-Z])[^,)]*"
)
LARGE = re.compile(r"(?<!\d)\d{40,}|E\+?0*[1-9]\d{2,}")  # a number that overflows where it is squared
IN_FEW_NUMBERS = re.compile(rf"(?:CARTESIAN_POINT|DIRECTION)\('',\({REAL}(?:,{REAL}){{1,2}}\)\);")
STATEMENT = re.compile(rf"#({NAME})=([A-Z][A-Z_0-9]*)?(\(.*\))", re.DOTALL)

CURVE = r"(?:LINE|CIRCLE|ELLIPSE|B_SPLINE_CURVE_WITH_KNOTS|COMPLEX)"
SURFACE = r"(?:PLANE|\w+_SURFACE|SURFACE_OF_LINEAR_EXTRUSION|B_SPLINE_SURFACE_WITH_KNOTS|COMPLEX3)"
FRAME = "AXIS2_PLACEMENT_3D"
REFERENCES = {  # the kinds an entity refers to, in order; a 2 or 3 behind a kind is its number of dimensions
    "VECTOR": "DIRECTION[23]",
    "LINE": "CARTESIAN_POINT2 VECTOR2|CARTESIAN_POINT3 VECTOR3",
    "CIRCLE": r"AXIS2_PLACEMENT_[23]D",
    "ELLIPSE": r"AXIS2_PLACEMENT_[23]D",
    "AXIS2_PLACEMENT_3D": "CARTESIAN_POINT3(?: DIRECTION3){0,2}",
    "AXIS2_PLACEMENT_2D": "CARTESIAN_POINT2(?: DIRECTION2)?",
    "PLANE": FRAME,
    "SPHERICAL_SURFACE": FRAME,
    "CYLINDRICAL_SURFACE": FRAME,
    "CONICAL_SURFACE": FRAME,
    "SURFACE_OF_LINEAR_EXTRUSION": f"{CURVE}3 VECTOR3",
    "B_SPLINE_CURVE_WITH_KNOTS": "CARTESIAN_POINT2(?: CARTESIAN_POINT2)*|CARTESIAN_POINT3(?: CARTESIAN_POINT3)*",
    "B_SPLINE_SURFACE_WITH_KNOTS": "CARTESIAN_POINT3(?: CARTESIAN_POINT3)*",
    "PCURVE": f"{SURFACE} DEFINITIONAL_REPRESENTATION",
    "DEFINITIONAL_REPRESENTATION": f"{CURVE}2 COMPLEX",
    "SURFACE_CURVE": f"{CURVE}3(?: PCURVE)+",
    "SEAM_CURVE": f"{CURVE}3 PCURVE PCURVE",
    "EDGE_CURVE": rf"VERTEX_POINT VERTEX_POINT (?:SURFACE_CURVE|SEAM_CURVE|{CURVE}3)",
    "VERTEX_POINT": "CARTESIAN_POINT3",
    "ORIENTED_EDGE": "EDGE_CURVE",
    "EDGE_LOOP": "ORIENTED_EDGE(?: ORIENTED_EDGE)*",
    "FACE_BOUND": "EDGE_LOOP",
    "FACE_OUTER_BOUND": "EDGE_LOOP",
    "ADVANCED_FACE": rf"FACE_(?:OUTER_)?BOUND(?: FACE_(?:OUTER_)?BOUND)* {SURFACE}",
    "CLOSED_SHELL": "ADVANCED_FACE(?: ADVANCED_FACE)*",
    "MANIFOLD_SOLID_BREP": "CLOSED_SHELL",
}
AS_THEIR_POINTS = {"VECTOR", "LINE", "CIRCLE", "ELLIPSE", "B_SPLINE_CURVE_WITH_KNOTS"}  # in number of dimensions
SPLINE_CURVE = re.compile(
    rf"B_SPLINE_CURVE(?:_WITH_KNOTS\('',|\()(\d{{1,9}}),\(([#\d,]+)\),\.\w+\.,\.[TFU]\.,\.[TFU]\.(?:,|\)B_SPLINE_CURVE_WITH_KNOTS\()"
    rf"\(({COUNTS})\),\(({NUMBERS})\),\.\w+\.\)"
)


Statements = Mapping[str, tuple[str, str]]  # entity number -> (kind, attributes); a complex entity's kind is COMPLEX


@dataclass(frozen=True)
class Points:
    """The well-formed points in space of a file."""

    names: Set[str]  # entity numbers
    numbers: np.ndarray  # the same, ascending
    xyz: np.ndarray  # (n, 3), in that order, the file's unit of length

    def at(self, numbers: np.ndarray) -> np.ndarray:
        """The points of these numbers; KeyError names one that is no point."""
        rows = np.searchsorted(self.numbers, numbers).clip(max=len(self.numbers) - 1)
        wrong = numbers[self.numbers[rows] != numbers] if len(self.numbers) else numbers.ravel()
        if len(wrong):
            raise KeyError(f"#{wrong[0]}")
        return self.xyz[rows]


def read(data: str) -> tuple[Points, Statements]:
    """The points in space of a file and its other entities; ValueError in one sentence unless the file is whole.

    data: without strings ('' in their place) and without blanks.
    """
    start, end = data.find("DATA;"), data.rfind("ENDSEC;")
    if not 0 <= start < end:
        raise ValueError("the file is damaged (it has no DATA section); write it again")
    points, section = _points(data[start + len("DATA") : end])
    statements = _statements(section[1:])  # after the semicolon of DATA
    if not points.names.isdisjoint(statements):
        raise ValueError("the file is damaged (two entities share a number); write it again")
    _check_tokens(section)
    _check_references(statements, points.names)
    _check_curves(section)
    return points, statements


def _points(section: str) -> tuple[Points, str]:
    """(the points in space, the section without them)."""
    numbers, xyz, rest = space_points.take(section)
    if not np.isfinite(xyz).all():
        raise ValueError("a CARTESIAN_POINT is not finite; write the file again")
    if np.abs(xyz).max(initial=0.0) > FARTHEST:
        raise ValueError(f"a CARTESIAN_POINT is over {FARTHEST:g} away; write the file again")
    known = frozenset(map(str, numbers.tolist()))
    if len(known) != len(numbers):
        raise ValueError("the file is damaged (two entities share a number); write it again")
    order = np.argsort(numbers)
    return Points(known, numbers[order], xyz[order]), rest


def _statements(section: str) -> Statements:
    """Each statement is one entity, its brackets in pairs and nothing behind the last of them."""
    characters = np.frombuffer(section.encode("latin-1", "replace"), dtype=np.uint8)
    closing = characters == ord(")")
    depth = np.cumsum((characters == ord("(")).astype(np.int8) - closing, dtype=np.int32)
    ends = np.flatnonzero(characters == ord(";"))
    *bodies, rest = section.split(";")
    found = [STATEMENT.fullmatch(body) for body in bodies]
    last = np.flatnonzero(closing & (depth == 0))  # each statement's own bracket
    if rest or not found or None in found or depth[ends].any() or depth.min() < 0 or not np.array_equal(last + 1, ends):
        raise ValueError("the file is damaged (a statement is no entity); write it again")
    if depth.max() > DEEPEST:
        raise ValueError(f"the file is damaged (lists nested {depth.max()} deep); write it again")
    statements = {hit[1]: (hit[2] or "COMPLEX", hit[3]) for hit in found}
    if len(statements) != len(found):
        raise ValueError("the file is damaged (two entities share a number); write it again")
    return statements


def _check_tokens(section: str) -> None:
    stray = NO_TOKEN.search(section)
    if stray:
        raise ValueError(f"the file is damaged ('{stray.group()[1:30]}' is no value); write it again")
    large = LARGE.search(section)
    if large:
        raise ValueError(f"the file is damaged (a number as large as '{large.group()[:30]}'); write it again")
    in_numbers = section.count("=CARTESIAN_POINT(") + section.count("=DIRECTION(")
    if len(IN_FEW_NUMBERS.findall(section)) != in_numbers:
        raise ValueError("the file is damaged (a CARTESIAN_POINT or DIRECTION holds no numbers); write it again")


def _check_references(statements: Statements, points: Set[str]) -> None:
    for number, (kind, body) in statements.items():
        try:
            kinds = " ".join(_kinds(re.findall(r"#(\d+)", body), statements, points))
        except KeyError as error:
            raise ValueError(f"the file is damaged (entity #{error.args[0]} is missing); write it again") from error
        expected = REFERENCES.get(kind)
        if expected is not None and not re.fullmatch(expected, kinds):
            raise ValueError(f"the file is damaged ({kind} #{number} refers to '{kinds[:80]}'); write it again")


def _kinds(names: list[str], statements: Statements, points: Set[str]) -> list[str]:
    """The kinds of entities; a control net refers to nothing but points in space, and to all of them."""
    if points.issuperset(names):
        return ["CARTESIAN_POINT3"] * len(names)
    return [_kind(name, statements, points) for name in names]


def _kind(name: str, statements: Statements, points: Set[str]) -> str:
    """The kind of an entity, with 2 or 3 behind it where it lies in the plane of a face or in space."""
    if name in points:
        return "CARTESIAN_POINT3"
    kind, body = statements[name]
    if kind in ("CARTESIAN_POINT", "DIRECTION"):
        return f"{kind}{body.count(',')}"  # after the name
    if kind in AS_THEIR_POINTS or (kind == "COMPLEX" and "B_SPLINE_" in body):
        first = re.search(r"#(\d+)", body)  # a point, a direction or a placement
        return kind + _dimensions(first.group(1), statements, points) if first else kind
    return kind


def _dimensions(name: str, statements: Statements, points: Set[str]) -> str:
    """2, 3, or what is neither."""
    if name in points:
        return "3"
    kind, body = statements[name]
    return str(body.count(",")) if kind in ("CARTESIAN_POINT", "DIRECTION") else kind.rstrip("D")[-1]


def _check_curves(section: str) -> None:
    """Each B-spline curve has as many knots as its control points and degree ask for."""
    curves = SPLINE_CURVE.findall(section)
    if len(curves) != section.count("B_SPLINE_CURVE_WITH_KNOTS("):
        raise ValueError("the file is damaged (a B-spline curve is malformed); write it again")
    for degree, points, counts, values in curves:
        knots = np.array(values.split(","), dtype=np.float64)
        check_knots(np.array(counts.split(","), dtype=np.int64), knots, points.count("#"), int(degree))


def check_knots(counts: np.ndarray, knots: np.ndarray, points: int, degree: int) -> None:
    """ValueError unless so many control points have a spline of this degree on these knots, each so often."""
    if not 1 <= degree <= HIGHEST:
        raise ValueError(f"the file is damaged (a spline of degree {degree}); write it again")
    rising = np.isfinite(knots).all() and (np.diff(knots) > 0).all()
    if not rising or len(counts) != len(knots) or counts.min() < 1 or counts.sum() != points + degree + 1:
        raise ValueError(
            f"the file is damaged ({counts.sum()} knots for {points} control points of degree {degree}); write it again"
        )
